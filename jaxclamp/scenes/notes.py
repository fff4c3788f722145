"""Notes on the unlikely: what is far from arteries that were measured or modelled. Nothing is refused."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxclamp.core.records import UNIT_FACTOR
from jaxclamp.physics.jaws import Spline
from jaxclamp.scenes import schema
from jaxclamp.scenes.checks import closed
from jaxclamp.scenes.scene import Scene
from jaxclamp.scenes.wording import CONVERSIONS, shortened, spoken


@dataclasses.dataclass(frozen=True)
class Sourced:
    """The range that a quantity has in sources, in the unit of scene files."""

    lower: float
    """least value"""
    upper: float
    """greatest value"""
    far: float
    """a value is far from the range if it is beyond an end by more than this factor"""
    source: str
    """who has the ends"""
    zero: bool = False
    """True if 0 leaves something out, on purpose"""

    def has(self, value: float) -> bool:
        """True unless a value is far from the range."""
        return (self.zero and value == 0.0) or self.lower / self.far <= value <= self.upper * self.far


GASSER_AND_HOLZAPFEL = "Gasser et al. 2002; Holzapfel, Gasser & Ogden 2000"

RANGES = {
    # mouse aorta inflated from 10 mmHg (C. Cavinato); human renal artery up to 215 mmHg, where clamps begin
    # to leak (Tryon et al.)
    "pressure": Sourced(1.33, 28.7, 2.0, "Cavinato; Tryon et al.", zero=True),
    # human LAD 1.044 +- 0.06 (Holzapfel et al. 2005); rabbit carotid to 1.9 (Holzapfel, Gasser & Ogden 2000)
    "axial_stretch": Sourced(0.984, 1.9, 1.2, "Holzapfel et al. 2005; Holzapfel, Gasser & Ogden 2000"),
    # human carotid from 60 deg (Sommer & Holzapfel 2012); superficial femoral up to 193 deg (Jadidi et al.)
    "opening_angle": Sourced(60.0, 193.0, 1.5, "Sommer & Holzapfel 2012; Jadidi et al.", zero=True),
    # rabbit carotid's adventitia (Holzapfel, Gasser & Ogden 2000); human aortic media (Peirlinck et al. 2024)
    "c": Sourced(0.3, 97.4, 2.0, "Holzapfel, Gasser & Ogden 2000; Peirlinck et al. 2024"),
    # rabbit carotid's adventitia (Holzapfel, Gasser & Ogden 2000); human iliac's (Gasser et al. 2006)
    "k1": Sourced(0.562, 997.0, 2.0, "Holzapfel, Gasser & Ogden 2000; Gasser et al. 2006", zero=True),
    "k2": Sourced(0.711, 525.0, 2.0, "Holzapfel, Gasser & Ogden 2000; Gasser et al. 2006", zero=True),
    # human LAD's media (Gasser et al. 2002); rabbit carotid's adventitia (Holzapfel, Gasser & Ogden 2000)
    "fibre_angle": Sourced(10.0, 62.0, 2.0, GASSER_AND_HOLZAPFEL, zero=True),
}
"""of quantities, by the name of their field"""
BULK_OVER_C = Sourced(370.0, np.inf, 4.0, "Gasser et al. 2002")
"""1e4 kPa over 27 kPa, a Poisson's ratio of 0.4987: tissue keeps its volume"""
CLOSING_STRETCH = Sourced(0.97, 1.08, 1.15, GASSER_AND_HOLZAPFEL)
"""of an outer layer round the one inside: adventitia of the human LAD, of the rabbit carotid"""

VOLUME_IN_BODY = 0.05
"""change of volume at a point of the artery in the body, where the three presets change by 0.3 to 1.8 %"""
VOLUME_AT_POINTS = (0.8, 1.25)
"""volume ratios at a point of any state"""
OUT_OF_PLACE = 0.25
"""how far a clamp may move aside over the lumen's radius in the body"""
GRIPPED = 0.02
"""coefficient of friction that any wet wall has under a jaw"""
CREASE = 1.0 / 2.4
"""ratio of the stretches along and across a free surface at which it creases, of a homogeneous neo-Hookean
solid (Hong, Zhao & Suo, Appl Phys Lett 95 (2009) 111901)"""


def notes(scene: Scene) -> list[str]:
    """What of a scene is far from sourced ranges of arteries, a sentence each."""
    artery = scene.artery
    said = [*_of(artery, "artery"), *_nesting(scene), *_profiles(scene)]
    for i, layer in enumerate(artery.layers):
        path = f"artery.layers[{i}]"
        said += [*_of(layer, path), *_of(layer.material, f"{path}.material")]
        ratio = float(np.min(np.asarray(layer.material.bulk) / np.asarray(layer.material.c)))
        if not BULK_OVER_C.has(ratio):
            said.append(
                f"{path}.material.bulk_kPa is {ratio:.3g} times c_kPa: an artery hardly changes its volume, "
                f"and is modelled with {BULK_OVER_C.lower:g} times or more ({BULK_OVER_C.source})"
            )
    return said


def notes_of_states(history: list[dict[str, Any]]) -> list[str]:
    """What of the volume ratios J of converged states is far from 1; history: as in result.json."""
    if not history:
        return []
    said = []
    body, last = history[0], history[-1]
    least, most = (float(body[key]) for key in ("J_min", "J_max"))
    if max(1.0 - least, most - 1.0) > VOLUME_IN_BODY:
        said.append(
            f"J is {least:.3g} to {most:.3g} in the body: the wall changes its volume, as an artery does not "
            "(use a greater bulk_kPa)"
        )
    least, most = (float(last[key]) for key in ("J_min", "J_max"))
    if least < VOLUME_AT_POINTS[0] or most > VOLUME_AT_POINTS[1]:
        said.append(
            f"J is {least:.3g} to {most:.3g} at single points of the last state, off by more than 5 % in "
            f"{last['J_share_off']:.2g} of the wall: strain and stress are not resolved there. Peaks of "
            "stress at the fold depend on the mesh; force, lumen, and media under the jaw hardly do"
        )
    radius = 0.5 * float(body["lumen_height_mm"])
    side, jaws = float(last["side_force_N"]), float(last["clamp_force_N"])
    if side > GRIPPED * 2.0 * jaws:
        said.append(
            f"{side:.2g} N hold the artery sideways between jaws that press with {jaws:.2g} N each: without "
            f"a coefficient of friction of {side / (2.0 * jaws):.2g} it would slide"
        )
    if abs(height := float(last["clamp_height_mm"])) > OUT_OF_PLACE * radius:
        said.append(
            f"the jaws, which are not alike, have bent the artery {abs(height):.2g} mm out of line, held by "
            "its ends alone: what surrounds it in the body is not modelled"
        )
    if (ratio := float(last["fold_stretch_ratio"])) < CREASE:
        said.append(
            f"the inner wall at the fold is stretched {ratio:.3g} times as much along as across; a free "
            f"surface creases below {CREASE:.3g}: a crease has no size of its own, and no mesh resolves it"
        )
    return said


def _of(record: Any, path: str) -> Iterator[str]:
    """Of the quantities of a record."""
    for key, field in schema.fields_by_key(type(record)).items():
        known = RANGES.get(field.name)
        if known is None or "range" not in field.metadata:
            continue
        unit = field.metadata["range"].unit
        values = np.ravel(np.asarray(getattr(record, field.name), float)) / UNIT_FACTOR[unit]
        far = next((float(v) for v in values if not known.has(v)), None)
        if far is not None:
            in_unit = f" {spoken(unit)}" if unit else ""
            yield (
                f"{path}.{key} = {far:.6g} is far from the {known.lower:g} to {known.upper:g}{in_unit} that "
                f"arteries have in {known.source}{_in_other_unit(far, unit, known)}"
            )


def _in_other_unit(value: float, unit: str, known: Sourced) -> str:
    """What the number would be if it was meant in a unit in which it is likely."""
    for other, (target, factor) in CONVERSIONS.items():
        if target == unit and known.lower <= value * factor <= known.upper:
            return f"; if it is in {spoken(other)}, write {value * factor:.4g}"
    return ""


def _profiles(scene: Scene) -> Iterator[str]:
    """Of jaws that were fitted to the points of a file."""
    for name, jaw in scene.clamp.kinds.items():
        if isinstance(jaw, Spline) and jaw.profile_residual is not None:
            off = 1e3 * float(jaw.profile_residual)
            yield (
                f"clamp.{name}: a spline of {np.size(jaw.slopes)} slopes stands for the points of a file, of "
                f"which the farthest is {off:.2g} um off"
            )


def _nesting(scene: Scene) -> Iterator[str]:
    """Of layers that do not fit round the one inside."""
    inner_squared = None
    for i, layer in enumerate(scene.artery.layers):
        inner_squared, stretch = closed(layer, inner_squared, f"artery.layers[{i}].opening_angle_deg")
        if i and not CLOSING_STRETCH.has(stretch):
            yield (
                f"artery.layers[{i}], {shortened(layer.name)}, does not nest: closing round the layer inside "
                f"stretches its circumference {stretch:.3g}-fold, far from the {CLOSING_STRETCH.lower:g} to "
                f"{CLOSING_STRETCH.upper:g} of {CLOSING_STRETCH.source}; layers go from inside to outside"
            )
