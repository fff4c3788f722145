"""Addresses of the values of a scene, such as "artery.layers[0].material.c" or "clamp.jaw.slopes[1]".

An address is a chain of field names, each with positions in a list or an array behind it. A name may carry
its unit as in a scene file ("artery.layers[0].material.c_kPa", "stop.force_N"); the value is then in that
unit, and in internal units (mm, kPa, mN, radians) otherwise. All of it works on traced values.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any, NamedTuple, get_args

import jax.numpy as jnp
import numpy as np

from jaxclamp.core.failures import BadAddress, BadKey, SceneError
from jaxclamp.core.records import UNIT_FACTOR, Range
from jaxclamp.scenes.schema import file_key, in_file_unit
from jaxclamp.scenes.values import check_part, check_value, hints_of, numbers
from jaxclamp.scenes.wording import did_you_mean, shortened

LONGEST = 300
"""characters of an address"""

_PART = re.compile(r"([A-Za-z0-9_-]+)((?:\[[0-9]+\])*)")

Step = str | int
"""a field's name, or a position in a list, from 0"""


class Place(NamedTuple):
    """A number of a scene, or a list or array of numbers, and what is known of it."""

    path: str
    """its address without units, such as "clamp.jaw.slopes[1]"; for values in internal units"""
    key: str
    """the same with its unit, as in scene files"""
    value: Any
    """a float, or an array of them; in internal units (mm, kPa, mN, radians)"""
    range: Range
    """its unit and its limits, in the unit of scene files"""

    @property
    def factor(self) -> float:
        """Internal units in one unit of scene files."""
        return UNIT_FACTOR[self.range.unit]


class _Found(NamedTuple):
    """The value at the end of an address, and the way to it."""

    value: Any
    nodes: tuple[Any, ...]
    """what each step was taken from"""
    steps: tuple[Step, ...]
    """the steps, names without units"""
    field: dataclasses.Field[Any] | None
    """the field that the value is, or is an item of"""
    factor: float
    """internal units in the unit that the address names"""


def steps(address: str) -> tuple[Step, ...]:
    """Names and positions of an address. Raises BadAddress if it is none."""
    fits = isinstance(address, str) and len(address) <= LONGEST
    matches = [_PART.fullmatch(part) for part in address.split(".")] if fits else [None]
    found: list[Step] = []
    for match in matches:
        if match is None:
            raise BadAddress(
                f"{_said(address)} is not an address such as artery.layers[0].material.c "
                f"(at most {LONGEST} characters)"
            )
        found += [match[1], *map(int, re.findall("[0-9]+", match[2]))]
    return tuple(found)


def text(path: tuple[Step, ...]) -> str:
    """The address with the given steps."""
    return "".join(f"[{s}]" if isinstance(s, int) else f".{s}" for s in path).removeprefix(".")


def get(scene: Any, address: str) -> Any:
    """The value at an address: in the unit that its name carries, else in internal units.

    Raises BadAddress, a SceneError and a KeyError, if there is no such place.
    """
    found = _find(scene, address)
    if found.factor == 1.0 or found.value is None:
        return found.value
    if isinstance(found.value, int | float):
        return in_file_unit(found.value, found.factor)
    return found.value / found.factor


def replace(scene: Any, address: str, value: Any) -> Any:
    """A copy of `scene` with the value at an address replaced, such as "artery.layers[0].material.c".

    value: in internal units (mm, kPa, mN, radians), or in the unit that the address names ("stop.force_N");
    it may be traced. An item of an array ("clamp.jaw.slopes[1]") makes the array one of JAX.

    Raises BadAddress, a SceneError and a KeyError, if there is no such place, and SceneError for a value of a
    kind that cannot stand there. Ranges are seen when the scene is solved: gradients and directions are
    scenes too, whose floats may have any value.
    """
    found = _find(scene, address)
    inside = _internal(value, found.factor)
    try:
        _check(found, inside)
    except BadKey as error:
        raise SceneError(str(error)) from None
    return _put(found, inside)


def _internal(value: Any, factor: float) -> Any:
    """A value in internal units; what is no number is left as it is."""
    return value if factor == 1.0 or isinstance(value, str | bool | None) else value * factor


def _put(found: _Found, value: Any) -> Any:
    """A copy of the scene with another value at a place."""
    for node, step in zip(reversed(found.nodes), reversed(found.steps), strict=True):
        value = _with(node, step, value)
    return value


def _check(found: _Found, value: Any) -> None:
    """Raise BadKey for a value of a kind that cannot stand at a place."""
    last = max(i for i, step in enumerate(found.steps) if isinstance(step, str))
    owner, name = found.nodes[last], found.steps[last]
    field = next(f for f in dataclasses.fields(owner) if f.name == name)
    hint = hints_of(type(owner)).get(field.name)
    key = text((*found.steps[:last], file_key(field), *found.steps[last + 1 :]))
    whole = last == len(found.steps) - 1
    if value is None and field.default is None:
        return
    if "range" in field.metadata:
        numbers(value, field.metadata["range"], key)
    elif whole or field.metadata.get("static"):  # an item of a list of whole numbers is seen as a list
        check_value(field, hint, value if whole else (value,), key, ranges=False)
    else:
        check_part(next(iter(get_args(hint)), None), value, key, ranges=False)


def describe(scene: Any, address: str) -> Place:
    """The number, list or array at an address with its names and its range.

    Raises BadAddress, a SceneError and a KeyError, if there is no such place or it holds no number that can
    be differentiated.
    """
    found = _find(scene, address)
    if found.field is None or "range" not in found.field.metadata:
        raise BadAddress(
            f"{_said(address)} is a choice or a part of the scene: expected a number of the scene, such as "
            "clamp.jaw.radius_mm"
        )
    if found.value is None:
        raise BadAddress(f"{_said(address)} is not there in this scene: give it a value first")
    last = max(i for i, step in enumerate(found.steps) if isinstance(step, str))
    keyed = (*found.steps[:last], file_key(found.field), *found.steps[last + 1 :])
    return Place(text(found.steps), text(keyed), found.value, found.field.metadata["range"])


def _find(scene: Any, address: str) -> _Found:
    """Follow an address from a record. Raises BadAddress where it ends too early."""
    node, nodes = scene, []
    names: list[Step] = []
    field: dataclasses.Field[Any] | None = None
    factor = 1.0
    for step in steps(address):
        nodes.append(node)
        if isinstance(step, int):
            node = _item(node, step, address)
            names.append(step)
            field = field if field is not None and "range" in field.metadata else None
        else:
            field = _field(node, step, address)
            node = getattr(node, field.name)
            names.append(field.name)
            factor = UNIT_FACTOR[field.metadata["range"].unit] if step != field.name else 1.0
    return _Found(node, tuple(nodes), tuple(names), field, factor)


def _field(node: Any, name: str, address: str) -> dataclasses.Field[Any]:
    """The field of a record with a name, or with a name and unit."""
    fields = dataclasses.fields(node) if dataclasses.is_dataclass(node) else ()
    found = next((f for f in fields if name in (f.name, file_key(f))), None)
    if found is None:
        known = [file_key(f) for f in fields]
        reason = did_you_mean(name, known) if known else f"{_said(name)} is asked of what has no fields"
        raise BadAddress(f"{_said(address)} does not exist; {reason}")
    return found


def _item(node: Any, position: int, address: str) -> Any:
    """An item of a tuple or of an array."""
    size = len(node) if isinstance(node, tuple) else next(iter(np.shape(node)), 0)
    if position >= size:
        expected = f"a position from [0] to [{size - 1}]" if size else "no position, for it is not a list"
        raise BadAddress(f"{_said(address)} does not exist: expected {expected}")
    return node[position]


def _with(node: Any, step: Step, value: Any) -> Any:
    """A copy of a record, a tuple or an array with one part changed."""
    if isinstance(step, str):
        return dataclasses.replace(node, **{step: value})
    if isinstance(node, tuple):
        return (*node[:step], value, *node[step + 1 :])
    array = jnp.asarray(node)
    if not jnp.issubdtype(array.dtype, jnp.inexact):
        array = array.astype(float)
    return array.at[step].set(jnp.asarray(value, array.dtype))


def _said(address: Any) -> str:
    """What was written, not too long and on one line."""
    return ascii(shortened(address)) if isinstance(address, str) else shortened(repr(address))
