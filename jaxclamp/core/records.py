"""Records: frozen dataclasses that JAX sees as pytrees, whose fields say their unit and their range.

A field is one of three things:

* a *quantity* -- a float (or an array of floats) that can be differentiated; it carries the unit
  used in scene files and the open or closed interval that makes sense;
* a *static* choice -- a string, an integer or a tuple of them, part of the compiled program;
* another record.

Records hold no behaviour at construction: they are rebuilt by JAX with tracers inside, so checks
live in `jaxclamp.scenes.checks`. Two records of one class are equal if all their values are, arrays
item by item.
"""

from __future__ import annotations

import copyreg
import dataclasses
import inspect
import math
import weakref
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar, dataclass_transform, get_type_hints

import jax
import numpy as np

Array = jax.Array
Record = TypeVar("Record")

UNIT_FACTOR = {
    "": 1.0,
    "mm": 1.0,
    "mm2": 1.0,
    "kPa": 1.0,
    "kPa_per_mm": 1.0,
    "deg": math.pi / 180.0,
    "N": 1e3,
}
"""internal units (mm, kPa, mN, radians) in one unit of a scene file"""


@dataclasses.dataclass(frozen=True)
class Range:
    """Unit and sensible interval of a quantity, in the unit of the scene file."""

    unit: str
    """a key of `UNIT_FACTOR`"""
    lower: float
    """least value, in that unit"""
    upper: float
    """greatest value, in that unit"""
    open_lower: bool = False
    """True if `lower` itself is outside"""

    def contains(self, value: float) -> bool:
        """True if `value` (in the file's unit) is finite and inside the interval."""
        above = value > self.lower if self.open_lower else value >= self.lower
        return math.isfinite(value) and above and value <= self.upper

    def __str__(self) -> str:
        unit = f" {self.unit.replace('_per_', '/')}" if self.unit else ""
        relation = "greater than" if self.open_lower else "at least"
        return f"a number {relation} {self.lower:g}{unit} and at most {self.upper:g}{unit}"


def quantity(
    unit: str,
    lower: float,
    upper: float,
    *,
    open_lower: bool = False,
    many: bool = False,
    default: Any = dataclasses.MISSING,
) -> Any:
    """A differentiable float (`many`: an array of floats, (n,)) with its file unit and its range.

    Raises ValueError for a unit that is not in `UNIT_FACTOR`.
    """
    if unit not in UNIT_FACTOR:
        raise ValueError(f"unit {unit!r}: expected one of {', '.join(repr(u) for u in UNIT_FACTOR)}")
    metadata = {"range": Range(unit, lower, upper, open_lower), "many": many}
    return dataclasses.field(metadata=metadata, default=default)


def static(default: Any = dataclasses.MISSING, choices: tuple[str, ...] = ()) -> Any:
    """A choice that is part of the compiled program (hashable).

    With a default and no `choices` a string is the tag of its class, such as a law's name.
    """
    metadata = {"static": True, "choices": choices}
    return dataclasses.field(metadata=metadata, default=default)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(quantity, static))
def record(cls: type[Record]) -> type[Record]:
    """Make `cls` a frozen, keyword-only dataclass and a JAX pytree, with `==` that gives a bool."""
    with suppress(NameError):  # here their names are known; not where the class may travel to
        hints = get_type_hints(cls)
        cls.__annotations__ = {name: hints[name] for name in inspect.get_annotations(cls)}
    frozen: Any = dataclasses.dataclass(frozen=True, kw_only=True, eq=False)(cls)
    frozen.__eq__, frozen.__hash__, frozen.__reduce__ = _equal, _hash, _reduce
    _make_known(frozen)
    return frozen


# "no default" is one object, which classes of records that travel have to find again
copyreg.pickle(type(dataclasses.MISSING), lambda _: "MISSING")

_known: weakref.WeakSet[type] = weakref.WeakSet()
"""the records that JAX of this process sees as pytrees"""
_withdrawn: weakref.WeakSet[type] = weakref.WeakSet()
"""the records that are no longer to be found below their bases"""


def _make_known(cls: type[Any]) -> None:
    """Have JAX see a record as a pytree."""
    fields = dataclasses.fields(cls)
    meta = [f.name for f in fields if f.metadata.get("static")]
    data = [f.name for f in fields if not f.metadata.get("static")]
    jax.tree_util.register_dataclass(cls, data_fields=data, meta_fields=meta)
    _known.add(cls)


def _reduce(self: Any) -> tuple[Any, ...]:
    """For pickle: the class with the values of its fields."""
    return _rebuilt, (type(self), *(getattr(self, f.name) for f in dataclasses.fields(self)))


def _rebuilt(cls: Any, *values: Any) -> Any:
    """A record of a class that may have travelled itself, from a script of another process."""
    if cls not in _known:
        _make_known(cls)
    names = (f.name for f in dataclasses.fields(cls))
    return cls(**dict(zip(names, values, strict=True)))


def _equal(self: Any, other: Any) -> Any:
    """True if both are of one class and hold the same values, arrays of the same shape item by item."""
    if type(self) is not type(other):
        return NotImplemented
    if self is other:
        return True
    for field in dataclasses.fields(self):
        a, b = getattr(self, field.name), getattr(other, field.name)
        if not (a == b if field.metadata.get("static") else _same(a, b)):
            return False
    return True


def _same(a: Any, b: Any) -> bool:
    """True if two pytrees have the same structure and the same leaves.

    The values of two tracers are not known: JAX raises its own error for them, since either answer might
    be wrong. (`np.array_equal` alone would swallow it and say False.)
    """
    leaves, others = jax.tree_util.tree_leaves(a), jax.tree_util.tree_leaves(b)
    structures: list[Any] = [jax.tree_util.tree_structure(tree) for tree in (a, b)]
    return bool(structures[0] == structures[1]) and all(
        x is y or np.array_equal(np.asarray(x), np.asarray(y)) for x, y in zip(leaves, others, strict=True)
    )


def _hash(self: Any) -> int:
    """Of the values; TypeError where one is an array. Values that are equal and have one have the same."""
    return hash((type(self), *(getattr(self, f.name) for f in dataclasses.fields(self))))


def concrete_subclasses(base: type) -> list[type]:
    """All records below an abstract base, in order of definition: the only registry there is."""
    found: list[type] = []
    below: list[type] = base.__subclasses__()
    for cls in below:
        found += [cls] if "__dataclass_fields__" in vars(cls) and cls not in _withdrawn else []
        found += concrete_subclasses(cls)
    return found


def withdraw(cls: type) -> None:
    """Have a record no longer found below its base; values of it stay what they are."""
    _withdrawn.add(cls)


def shape_of(tree: Any, describe: Callable[[Any], Any] = lambda leaf: getattr(leaf, "shape", ())) -> Any:
    """The static skeleton of a record: its tree structure and what `describe` says of each leaf.

    By default that is the leaf's shape, () for a float.
    """
    leaves, structure = jax.tree_util.tree_flatten(tree)
    return structure, tuple(describe(leaf) for leaf in leaves)
