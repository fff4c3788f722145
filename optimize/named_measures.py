"""The measures that a study file can name, with the units it writes them in."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

import jaxclamp as jc
from jaxclamp import Measure, SceneError
from jaxclamp.scenes.schema import ONES_OWN, shown
from jaxclamp.scenes.wording import did_you_mean, nearest, shortened
from optimize.numbers import MOST, number

FILE_UNIT = {"mN": ("N", 1e3), "1/mm": ("per_mm", 1.0)}
"""internal unit -> unit in files, and internal units in one of it; the others are the same"""
ONSETS = (1.001, 100.0)
"""least and greatest stretch at which damage may be said to begin"""
SAID_OF_NUMBERS = {"volume_above": " {:g} kPa", "holding_force": " at a friction of {:g}"}
"""by the measure's name, how its number is put into words; that of others is an onset stretch"""
FRICTIONS = (1e-4, 10.0)
"""least and greatest coefficient of friction"""


def _layer(value: Any, path: str, layers: tuple[str, ...]) -> str:
    """The name of one of the artery's layers. Raises SceneError."""
    if value is None:
        raise SceneError(f"{path} is missing: expected the name of a layer")
    if not isinstance(value, str):
        raise SceneError(f"{path} = {shown(value)}: expected the name of a layer")
    if value not in layers:
        raise SceneError(f"{path} = {shown(value)}: expected one of {', '.join(layers)}")
    return value


def _stress(value: Any, path: str, _layers: tuple[str, ...]) -> float:
    """A stress in kPa. Raises SceneError."""
    if value is None:
        raise SceneError(f"{path} is missing: expected a stress in kPa")
    return number(value, path, -MOST, MOST, "a stress in kPa")


def _onset_stretch(value: Any, path: str, _layers: tuple[str, ...]) -> float:
    """A stretch at which damage begins. Raises SceneError."""
    return number(value, path, *ONSETS, "a stretch")


def _friction(value: Any, path: str, _layers: tuple[str, ...]) -> float:
    """A coefficient of friction. Raises SceneError."""
    if value is None:
        raise SceneError(f"{path} is missing: expected a coefficient of friction")
    return number(value, path, *FRICTIONS, "a coefficient of friction")


_READERS: dict[str, Callable[[Any, str, tuple[str, ...]], Any]] = {
    "layer": _layer,
    "stress": _stress,
    "onset_stretch": _onset_stretch,
    "friction": _friction,
}


@dataclasses.dataclass(frozen=True)
class Named:
    """A measure as a file names it."""

    key: str
    """name and unit, such as "clamp_force_N"""
    factory: Callable[..., Measure]
    """makes the measure from its arguments"""
    factor: float
    """internal units in one unit of the file"""

    @property
    def arguments(self) -> tuple[str, ...]:
        """Further keys that the file can give, such as ("layer",)."""
        return tuple(inspect.signature(self.factory).parameters)

    @property
    def required(self) -> tuple[str, ...]:
        """Those of them that it has to give."""
        known = inspect.signature(self.factory).parameters
        return tuple(name for name, parameter in known.items() if parameter.default is parameter.empty)


def named() -> dict[str, Named]:
    """The measures that a file can name, shipped or of files that were imported, by their key, such as
    "clamp_force_N"."""
    found = {}
    for factory, example in jc.measures().items():
        if not example.needs_stop:  # no design of a clamp changes it
            continue
        unit, factor = FILE_UNIT.get(example.unit, (example.unit, 1.0))
        key = f"{factory.__name__}_{unit}" if unit else factory.__name__
        found[key] = Named(key, factory, factor)
    return found


def in_words(measure: Measure) -> str:
    """A measure for a reader, such as "smooth peak axial stress of the media"; a user's own as it prints."""
    if measure.name not in {factory.__name__ for factory in jc.MEASURES}:
        return str(measure)
    numbers = [a for a in measure.arguments if isinstance(a, float)]
    layer = [f" of the {a}" for a in measure.arguments if isinstance(a, str)][-1:]
    pattern = SAID_OF_NUMBERS.get(measure.name, " (onset stretch {:g})")
    said = [pattern.format(a) for a in numbers]
    of_layer = [*said, *layer] if measure.name == jc.volume_above.__name__ else [*layer, *said]
    return "".join([measure.name.replace("_", " "), *of_layer])


def read_measure(
    table: Any, path: str, layers: tuple[str, ...], others: tuple[str, ...] = ()
) -> tuple[Measure, float]:
    """The measure that a table of a study file asks for, and its factor. Raises SceneError.

    layers: names of the artery's layers; others: further keys that the table may have
    """
    known = named()
    if not isinstance(table, dict) or not isinstance(table.get("measure"), str):
        raise SceneError(f"{path}: expected a table with measure = one of {', '.join(known)}")
    key = table["measure"]
    if key not in known:
        said = did_you_mean(key, list(known))
        own = "" if nearest(key, list(known)) else f" ({ONES_OWN})"
        raise SceneError(f"{path}.measure = {shown(key)}: no such measure; {said}{own}")
    chosen = known[key]
    wanted = [name for name in chosen.arguments if name in table or name in chosen.required]
    given = {name: _READERS[name](table.get(name), f"{path}.{name}", layers) for name in wanted}
    allowed = ("measure", *chosen.arguments, *others)
    for name in table:
        if name not in allowed:
            raise SceneError(f"unknown key {path}.{shortened(name)}; {did_you_mean(name, list(allowed))}")
    return chosen.factory(**given), chosen.factor
