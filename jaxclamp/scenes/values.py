"""The values of a scene made in Python, held to what a scene file may hold: types, choices and ranges."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, get_args, get_origin, get_type_hints

import jax
import numpy as np

from jaxclamp.core.records import UNIT_FACTOR, Range
from jaxclamp.physics.materials import Material
from jaxclamp.scenes import schema
from jaxclamp.scenes.schema import MOST_ITEMS, refuse

ROUNDING = 1e-12
"""relative difference to the end of a range that is none: units are changed back and forth"""
NUMBERS = (int, float, list, tuple, np.number, np.ndarray, jax.Array)


def check_values(record: Any, path: str = "") -> None:
    """Raise BadKey for the first value that no scene file could hold; traced values are not known.

    What a file cannot hold and Python can: constants of a material that are arrays over points.
    """
    hints = hints_of(type(record))
    for field in dataclasses.fields(record):
        value, name = getattr(record, field.name), schema.join(path, schema.file_key(field))
        check_value(field, hints.get(field.name), value, name)
        if "range" in field.metadata and not isinstance(record, Material):
            _check_shape(value, field, name)


def hints_of(cls: type) -> dict[str, Any]:
    """Types of a record's fields; none where they are names that this process does not know."""
    try:
        return get_type_hints(cls)
    except NameError:  # of a class that came here from another process
        return {}


def check_value(field: dataclasses.Field[Any], hint: Any, value: Any, path: str) -> None:
    """Raise BadKey unless a value may stand in a field of a record; hint: its type, None if not known."""
    if "range" in field.metadata:
        check_quantity(value, field.metadata["range"], path)
    elif field.metadata.get("static"):
        if hint is not None and not schema.is_tag(field):
            schema.check_static(field, hint, list(value) if isinstance(value, tuple) else value, path)
    elif get_origin(hint) is tuple:
        if not isinstance(value, tuple) or not 1 <= len(value) <= MOST_ITEMS:
            raise refuse(path, _words(value), f"a tuple of 1 to {MOST_ITEMS} parts of a scene")
        for i, item in enumerate(value):
            check_part(get_args(hint)[0], item, f"{path}[{i}]")
    else:
        check_part(hint, value, path)


def check_part(kind: Any, value: Any, path: str) -> None:
    """Raise BadKey unless a value is a record of a kind (None: any) with sound values."""
    if not dataclasses.is_dataclass(value) or (isinstance(kind, type) and not isinstance(value, kind)):
        name = kind.__name__ if isinstance(kind, type) else "part of a scene"
        raise refuse(path, _words(value), f"a {name}")
    check_values(value, path)


def check_quantity(value: Any, interval: Range, path: str) -> None:
    """Raise BadKey unless a number in internal units, or each item of an array, is in range."""
    if isinstance(value, jax.core.Tracer):
        return
    if isinstance(value, bool) or not isinstance(value, NUMBERS):
        raise refuse(path, _words(value), str(interval))
    try:
        numbers = np.asarray(value, float) / UNIT_FACTOR[interval.unit]
    except (TypeError, ValueError, OverflowError):
        raise refuse(path, _words(value), str(interval)) from None
    inside = (numbers > interval.lower) & (numbers < interval.upper)
    for position in np.argwhere(~inside):
        number = numbers[tuple(position)]
        if not _contains(interval, float(number)):
            where = path + "".join(f"[{i}]" for i in position)
            raise refuse(where, _said(value, float(number)), str(interval))


def _contains(interval: Range, number: float) -> bool:
    if interval.contains(number):
        return True
    ends = (interval.upper,) if interval.open_lower else (interval.lower, interval.upper)
    return any(end != 0.0 and math.isclose(number, end, rel_tol=ROUNDING) for end in ends)


def _check_shape(value: Any, field: dataclasses.Field[Any], path: str) -> None:
    """One number, or a list of numbers that is not too long."""
    n = 1 if isinstance(value, jax.core.Tracer) else np.size(value)
    if np.ndim(value) != int(field.metadata["many"]) or not 1 <= n <= MOST_ITEMS:
        expected = f"a list of 1 to {MOST_ITEMS} numbers" if field.metadata["many"] else "one number"
        raise refuse(path, f"array of shape {np.shape(value)}", expected)


def _said(value: Any, number: float) -> Any:
    """A number as it was written, where that is possible."""
    return value if isinstance(value, int) and value == number else number


def _words(value: Any) -> Any:
    """What was found, for a refusal."""
    return value if isinstance(value, str | bool | int | float) else repr(value)
