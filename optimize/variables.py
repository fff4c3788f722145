"""Design variables: floats of a scene that may change, with their bounds and units."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp import UNIT_FACTOR, Scene, SceneError, did_you_mean, file_key, replace


@dataclasses.dataclass(frozen=True)
class Variable:
    """A float of the scene that the design may change, or all floats of a list.

    path: as for `jaxclamp.replace`, such as "clamp.jaw.radius"; the unit of the scene file may follow
    lower, upper: bounds in internal units (mm, kPa, mN, radians), one for all items of a list or one
    for each; None: the range of the field
    """

    path: str
    lower: float | tuple[float, ...] | None = None
    upper: float | tuple[float, ...] | None = None


@dataclasses.dataclass(frozen=True)
class Entry:
    """One component of the design vector."""

    name: str
    """key of a scene file, with [i] for an item of a list"""
    unit: str
    """of the scene file; "" for a plain number"""
    factor: float
    """internal units in one unit of the scene file"""
    lower: float
    """bounds and start, internal units"""
    upper: float
    start: float


@dataclasses.dataclass(frozen=True)
class Place:
    """A float of a scene, or a list of floats, and what the scene file says of it."""

    path: str
    """its address, without units"""
    value: Any
    """a float or an array of floats, internal units"""
    unit: str
    """of the scene file; "" for a plain number"""
    lower: float
    """the field's range, in the file's unit"""
    upper: float

    @property
    def factor(self) -> float:
        """Internal units in one unit of the scene file."""
        return UNIT_FACTOR[self.unit]

    @property
    def key(self) -> str:
        """The address as a scene file would write it."""
        return f"{self.path}_{self.unit}" if self.unit else self.path


def find(scene: Scene, path: str) -> Place:
    """The float or list of floats at an address, which may carry its unit as in a scene file.

    Raises SceneError for what does not exist or is no float.
    """
    node: Any = scene
    names, field = [], None
    for part in path.split("."):
        name, node, field = _step(node, part, path)
        names.append(name)
    if field is None or "range" not in field.metadata:
        raise SceneError(f"{path}: expected a number of the scene, such as clamp.jaw.radius_mm")
    interval = field.metadata["range"]
    return Place(".".join(names), node, interval.unit, interval.lower, interval.upper)


def _step(node: Any, part: str, path: str) -> tuple[str, Any, dataclasses.Field[Any] | None]:
    """Name without unit, value and field of one part of an address; no field for an item of a list."""
    match = re.fullmatch(r"([A-Za-z_]\w*)(?:\[(\d+)\])?", part)
    fields = dataclasses.fields(node) if dataclasses.is_dataclass(node) else ()
    found = next((f for f in fields if match and match[1] in (f.name, file_key(f))), None)
    if match is None or found is None:
        known = [file_key(f) for f in fields if not f.metadata.get("static")]
        raise SceneError(f"{path}: '{part}' does not exist; {did_you_mean(part, known)}")
    value = getattr(node, found.name)
    if match[2] is None:
        return found.name, value, found
    if not isinstance(value, tuple) or int(match[2]) >= len(value):
        raise SceneError(f"{path}: '{part}' does not exist")
    return part.replace(match[1], found.name), value[int(match[2])], None


def entries(scene: Scene, variables: tuple[Variable, ...]) -> tuple[Entry, ...]:
    """The components of the design vector, in order.

    Raises SceneError for a path that is no float, for bounds that make no sense, and for no variable.
    """
    found = [entry for variable in variables for entry in _entries(find(scene, variable.path), variable)]
    if not found:
        raise SceneError("a study needs at least one variable")
    if len({entry.name for entry in found}) < len(found):
        raise SceneError("a variable is named twice")
    return tuple(found)


def _entries(place: Place, variable: Variable) -> list[Entry]:
    """The components of one variable, with their bounds checked."""
    values = np.atleast_1d(np.asarray(place.value, dtype=float))
    lowest = _bounds(variable.lower, place.lower * place.factor, values.size, place.key)
    highest = _bounds(variable.upper, place.upper * place.factor, values.size, place.key)
    names = [place.key] if np.ndim(place.value) == 0 else [f"{place.key}[{i}]" for i in range(values.size)]
    found = [
        Entry(name, place.unit, place.factor, lower, upper, start)
        for name, lower, upper, start in zip(names, lowest, highest, values.tolist(), strict=True)
    ]
    for entry in found:
        _check(entry, place)
    return found


def _bounds(given: float | tuple[float, ...] | None, default: float, count: int, key: str) -> list[float]:
    """A bound for each item."""
    bounds = np.ravel(default if given is None else given).astype(float).tolist()
    if len(bounds) not in (1, count):
        raise SceneError(f"{key}: expected 1 or {count} bounds, found {len(bounds)}")
    return bounds if len(bounds) == count else bounds * count


def _check(entry: Entry, place: Place) -> None:
    """Raise SceneError unless start and bounds lie inside each other and the field's range."""
    lower, upper = entry.lower / entry.factor, entry.upper / entry.factor
    if not (entry.lower < entry.upper and place.lower <= lower and upper <= place.upper):
        raise SceneError(
            f"{entry.name}: bounds {lower:g} to {upper:g} are not inside {place.lower:g} to {place.upper:g}"
        )
    if not entry.lower <= entry.start <= entry.upper:
        raise SceneError(
            f"{entry.name}: the start {entry.start / entry.factor:g} is not within {lower:g} to {upper:g}"
        )


def with_design(scene: Scene, paths: tuple[str, ...], design: Array | np.ndarray) -> Scene:
    """The scene with the floats at `paths` taken from the vector (n_floats,), internal units.

    paths: without units, as in `Place.path`. A JAX function of scene and vector.
    """
    position = 0
    for path in paths:
        shape = jnp.shape(find(scene, path).value)
        count = int(np.prod(shape))
        scene = replace(scene, path, design[position : position + count].reshape(shape))
        position += count
    return scene
