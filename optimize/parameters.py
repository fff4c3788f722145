"""Design variables: floats of a scene, with their bounds and units."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp import Scene, SceneError, replace
from jaxclamp.core.records import UNIT_FACTOR, Range
from jaxclamp.scenes.presets import did_you_mean
from jaxclamp.scenes.schema import file_key


@dataclasses.dataclass(frozen=True)
class Variable:
    """A float of the scene that the design may change, or all floats of a list.

    path: as for `jaxclamp.replace`, such as "clamp.jaw.radius"
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
    factor: float
    """internal units in one unit of the scene file"""
    lower: float
    upper: float
    """in internal units"""
    start: float


def _step(node: Any, part: str, path: str) -> tuple[str, Any, dataclasses.Field[Any] | None]:
    """Name, value and field of one part of a path, which may carry its unit as in a scene file."""
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


def resolve(scene: Scene, path: str) -> tuple[str, Any, Range]:
    """The path without units, the value there and its range. Raises SceneError for what is no float."""
    node: Any = scene
    names, field = [], None
    for part in path.split("."):
        name, node, field = _step(node, part, path)
        names.append(name)
    if field is None or "range" not in field.metadata:
        raise SceneError(f"{path}: expected a number of the scene, such as clamp.jaw.radius_mm")
    return ".".join(names), node, field.metadata["range"]


def entries(scene: Scene, variables: tuple[Variable, ...]) -> tuple[Entry, ...]:
    """The components of the design vector, in order. Raises SceneError for bounds that make no sense."""
    found: list[Entry] = []
    for variable in variables:
        path, value, interval = resolve(scene, variable.path)
        factor = UNIT_FACTOR[interval.unit]
        key = f"{path}_{interval.unit}" if interval.unit else path
        values = np.atleast_1d(np.asarray(value, dtype=float))
        lowest = _bounds(variable.lower, interval.lower * factor, values.size, key)
        highest = _bounds(variable.upper, interval.upper * factor, values.size, key)
        for number, (start, lower, upper) in enumerate(zip(values.tolist(), lowest, highest, strict=True)):
            name = key if np.ndim(value) == 0 else f"{key}[{number}]"
            inside = interval.lower <= lower / factor and upper / factor <= interval.upper
            if not (lower < upper and inside):
                raise SceneError(
                    f"{name}: bounds {lower / factor:g} to {upper / factor:g} are not inside "
                    f"{interval.lower:g} to {interval.upper:g}"
                )
            if not lower <= start <= upper:
                raise SceneError(
                    f"{name}: the start {start / factor:g} is not within "
                    f"{lower / factor:g} to {upper / factor:g}"
                )
            found.append(Entry(name, interval.unit, factor, lower, upper, start))
    if not found:
        raise SceneError("a study needs at least one variable")
    if len({entry.name for entry in found}) < len(found):
        raise SceneError("a variable is named twice")
    return tuple(found)


def _bounds(given: float | tuple[float, ...] | None, default: float, count: int, key: str) -> list[float]:
    """A bound for each item."""
    bounds = np.ravel(default if given is None else given).astype(float).tolist()
    if len(bounds) not in (1, count):
        raise SceneError(f"{key}: expected 1 or {count} bounds, found {len(bounds)}")
    return bounds if len(bounds) == count else bounds * count


def with_design(scene: Scene, paths: tuple[str, ...], design: Array | np.ndarray) -> Scene:
    """The scene with the values at `paths` (without units) taken from the vector, internal units.

    A JAX function of scene and vector.
    """
    position = 0
    for path in paths:
        _, value, _ = resolve(scene, path)
        shape = jnp.shape(value)
        count = int(np.prod(shape))
        scene = replace(scene, path, design[position : position + count].reshape(shape))
        position += count
    return scene
