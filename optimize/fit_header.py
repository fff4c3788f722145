"""Headers of test data: a quantity and its unit in one word, such as `outer_diameter_um` or
`pressure_mmHg_sd`."""

from __future__ import annotations

import dataclasses
import re

from jaxclamp.scenes.wording import did_you_mean, nearest, shortened

UNITS = {
    "pressure": {
        "kPa": 1.0,
        "Pa": 1e-3,
        "hPa": 0.1,
        "MPa": 1e3,
        "mmHg": 0.133322387415,
        "cmH2O": 0.0980665,
        "bar": 100.0,
        "psi": 6.894757293168,
    },
    "length": {"mm": 1.0, "um": 1e-3, "cm": 10.0, "m": 1e3},
    "force": {"mN": 1.0, "uN": 1e-3, "N": 1e3, "g": 9.80665, "mg": 9.80665e-3},
    "number": {"": 1.0},
}
"""internal units (mm, kPa, mN) in one of each unit that a header may name; g and mg are weights"""


@dataclasses.dataclass(frozen=True)
class Meaning:
    """What a column holds."""

    quantity: str
    """such as outer_radius; the words of `QUANTITIES`"""
    dimension: str
    """a key of `UNITS`"""
    factor: float = 1.0
    """of the quantity in what the column holds: half for a diameter"""


def _meanings() -> dict[str, Meaning]:
    """Every name that a column may have."""
    names = {
        Meaning("pressure", "pressure"): "pressure lumen_pressure",
        Meaning("inner_radius", "length"): "inner_radius lumen_radius radius_internal internal_radius",
        Meaning("outer_radius", "length"): "outer_radius radius_external external_radius",
        Meaning("inner_radius", "length", 0.5): "inner_diameter lumen_diameter internal_diameter",
        Meaning("outer_radius", "length", 0.5): "outer_diameter external_diameter",
        Meaning("wall_thickness", "length"): "wall_thickness thickness",
        Meaning("axial_stretch", "number"): "axial_stretch",
        Meaning("circumferential_stretch", "number"): "circumferential_stretch circ_stretch hoop_stretch",
        Meaning(
            "reduced_force", "force"
        ): "axial_force axial_force_transducer transducer_force reduced_axial_force",
        Meaning("wall_force", "force"): "axial_force_wall wall_force",
    }
    for direction, words in (("axial", "axial"), ("circumferential", "circumferential circ hoop")):
        for kind, said in (
            ("cauchy", ("", "cauchy_")),
            ("nominal", ("nominal_", "first_piola_", "engineering_")),
        ):
            known = " ".join(f"{word}_{each}stress" for word in words.split() for each in said)
            names[Meaning(f"{direction}_{kind}_stress", "pressure")] = known
    return {name: meaning for meaning, said in names.items() for name in said.split()}


MEANINGS = _meanings()
LAYER = "layer"
"""the column of text that says from which layer a flat piece is"""


@dataclasses.dataclass(frozen=True)
class Header:
    """A header that was understood."""

    meaning: Meaning
    unit: str
    """as written; "" for none"""
    deviation: bool
    """True for a column of standard deviations"""

    @property
    def factor(self) -> float:
        """Internal units of the quantity in one of the column."""
        return UNITS[self.meaning.dimension][self.unit] * self.meaning.factor


def understood(word: str) -> Header | str | None:
    """What a header says; None if it names nothing known here, a sentence if its unit is wrong.

    A word behind the unit, as in "outer_diameter_um_control", tells columns of one kind apart, one of which
    the user has to name. "pressure (mmHg)" is read as "pressure_mmHg". Names are known in either case, units
    as they are written.
    """
    plain = re.sub(r"\s*[(\[]\s*([^)\]]*?)\s*[)\]]", r"_\1", word.strip()).replace(" ", "_").rstrip("_")
    deviation = plain.lower().endswith("_sd")
    plain = plain[:-3] if deviation else plain
    if plain.lower() in MEANINGS:
        meaning, unit = MEANINGS[plain.lower()], ""
    else:
        name = max((n for n in MEANINGS if plain.lower().startswith(f"{n}_")), key=len, default="")
        if not name:
            return None
        meaning, unit = MEANINGS[name], plain[len(name) + 1 :]
    known = UNITS[meaning.dimension]
    if unit in known:
        return Header(meaning, unit, deviation)
    if any(each and unit.startswith(f"{each}_") for each in known):  # a group of animals, a side
        return None
    return _wrong_unit(unit, meaning, list(known))


def _wrong_unit(unit: str, meaning: Meaning, known: list[str]) -> str:
    said = meaning.quantity.replace("_", " ")
    if known == [""]:
        return f"expected no unit behind {said}, found {shortened(unit)!r}"
    listed = ", ".join(known)
    if not unit:
        return f"expected a unit in the name ({listed}), such as {meaning.quantity}_{known[0]}"
    other = next((dimension for dimension, units in UNITS.items() if unit in units), None)
    kind = f", which is of a {other}" if other else ""
    return f"expected the unit of a {meaning.dimension} ({listed}), found {shortened(unit)!r}{kind}"


def meant(word: str) -> str:
    """What an unknown header may have meant, or nothing; to be set behind it."""
    shorter = word.rpartition("_")[0]
    if isinstance(understood(shorter), Header):
        return f" (to read it: --column '{word}={shorter}')"
    known = [*MEANINGS, LAYER]
    return f"; {did_you_mean(word, known)}" if nearest(word, known) else ""
