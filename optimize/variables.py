"""Design variables: floats of a scene that may change, with their bounds and units."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp import Scene, SceneError, replace
from jaxclamp.scenes.address import Place, describe, get


@dataclasses.dataclass(frozen=True)
class Variable:
    """A float of the scene that the design may change, or all floats of a list.

    path: as for `jaxclamp.replace`, such as "clamp.jaw.radius"; the unit of the scene file may follow
    lower, upper: bounds in internal units (mm, kPa, mN, radians), one for all items of a list or one
    for each; None: the range of the field
    """

    path: str
    """as for `jaxclamp.replace`"""
    lower: float | tuple[float, ...] | None = None
    """internal units"""
    upper: float | tuple[float, ...] | None = None
    """internal units"""
    rising: bool = False
    """True: no item of the list is less than the one before, as slopes of a convex face are"""


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
    """internal units"""
    upper: float
    """internal units"""
    start: float
    """internal units"""


def entries(scene: Scene, variables: tuple[Variable, ...]) -> tuple[Entry, ...]:
    """The components of the design vector, in order.

    Raises SceneError for a path that is no float, for bounds that make no sense, and for no variable.
    """
    found = [entry for variable in variables for entry in _entries(describe(scene, variable.path), variable)]
    if not found:
        raise SceneError("a study needs at least one variable")
    if len({entry.name for entry in found}) < len(found):
        raise SceneError("a variable is named twice")
    return tuple(found)


def _entries(place: Place, variable: Variable) -> list[Entry]:
    """The components of one variable, with their bounds checked."""
    if variable.rising and np.ndim(place.value) == 0:
        raise SceneError(f"{place.key}: a single number cannot be rising, only a list of them can")
    values = np.atleast_1d(np.asarray(place.value, dtype=float))
    lowest = _bounds(variable.lower, place.range.lower * place.factor, values.size, place.key)
    highest = _bounds(variable.upper, place.range.upper * place.factor, values.size, place.key)
    names = [place.key] if np.ndim(place.value) == 0 else [f"{place.key}[{i}]" for i in range(values.size)]
    found = [
        Entry(name, place.range.unit, place.factor, lower, upper, start)
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
    if not (entry.lower < entry.upper and place.range.lower <= lower and upper <= place.range.upper):
        raise SceneError(
            f"{entry.name}: bounds {lower:g} to {upper:g} are not inside "
            f"{place.range.lower:g} to {place.range.upper:g}"
        )
    if not entry.lower <= entry.start <= entry.upper:
        raise SceneError(
            f"{entry.name}: the start {entry.start / entry.factor:g} is not within {lower:g} to {upper:g}"
        )


def with_design(scene: Scene, paths: tuple[str, ...], design: Array | np.ndarray) -> Scene:
    """The scene with the floats at `paths` taken from the vector (n_floats,), internal units.

    paths: without units, as in `Place.path` of `jaxclamp.scenes.address`. A JAX function of scene and vector.
    """
    position = 0
    for path in paths:
        shape = jnp.shape(get(scene, path))
        count = int(np.prod(shape))
        scene = replace(scene, path, design[position : position + count].reshape(shape))
        position += count
    return scene
