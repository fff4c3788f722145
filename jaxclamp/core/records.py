"""Records: frozen dataclasses that JAX sees as pytrees, whose fields say their unit and their range.

A field is one of three things:

* a *quantity* -- a float (or an array of floats) that can be differentiated; it carries the unit
  used in scene files and the open or closed interval that makes sense;
* a *static* choice -- a string, an integer or a tuple of them, part of the compiled program;
* another record.

Records hold no behaviour at construction: they are rebuilt by JAX with tracers inside, so checks
live in `jaxclamp.scenes.scene`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, TypeVar, dataclass_transform

import jax

Array = jax.Array
Record = TypeVar("Record")

# Internal units are mm, kPa, mN and radians: factor from the unit of the scene file.
UNIT_FACTOR = {
    "": 1.0,
    "mm": 1.0,
    "kPa": 1.0,
    "kPa_per_mm": 1.0,
    "deg": math.pi / 180.0,
    "N": 1e3,
}


@dataclasses.dataclass(frozen=True)
class Range:
    """Unit and sensible interval of a quantity, in the unit of the scene file."""

    unit: str
    lower: float
    upper: float
    open_lower: bool = False

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
    """A differentiable float (`many`: an array of floats) with its file unit and its range."""
    metadata = {"range": Range(unit, lower, upper, open_lower), "many": many}
    return dataclasses.field(metadata=metadata, default=default)


def static(default: Any = dataclasses.MISSING, choices: tuple[str, ...] = ()) -> Any:
    """A choice that is part of the compiled program (hashable)."""
    metadata = {"static": True, "choices": choices}
    return dataclasses.field(metadata=metadata, default=default)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(quantity, static))
def record(cls: type[Record]) -> type[Record]:
    """Make `cls` a frozen, keyword-only dataclass and a JAX pytree."""
    frozen: Any = dataclasses.dataclass(frozen=True, kw_only=True)(cls)
    fields = dataclasses.fields(frozen)
    meta = [f.name for f in fields if f.metadata.get("static")]
    data = [f.name for f in fields if not f.metadata.get("static")]
    jax.tree_util.register_dataclass(frozen, data_fields=data, meta_fields=meta)
    return frozen


def concrete_subclasses(base: type) -> list[type]:
    """All records below an abstract base, in order of definition: the only registry there is."""
    below: list[type] = base.__subclasses__()
    return [cls for cls in below if dataclasses.is_dataclass(cls)]


def shape_of(tree: Any, describe: Callable[[Any], Any] = lambda leaf: getattr(leaf, "shape", ())) -> Any:
    """The static skeleton of a record: its tree structure and the shape of each leaf."""
    leaves, structure = jax.tree_util.tree_flatten(tree)
    return structure, tuple(describe(leaf) for leaf in leaves)
