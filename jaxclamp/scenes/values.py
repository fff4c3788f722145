"""The values of a scene made in Python, held to what a scene file may hold: types, choices and ranges."""

from __future__ import annotations

import dataclasses
from typing import Any, get_args, get_origin, get_type_hints

import jax
import numpy as np

from jaxclamp.core.records import UNIT_FACTOR, Range
from jaxclamp.physics.materials import Material
from jaxclamp.scenes import schema
from jaxclamp.scenes.schema import MOST_ITEMS, refuse

BEYOND = 1e-6
"""differences may step over the end of a range by this part of it (of the other end, if it is 0)"""
NUMBERS = (int, float, list, tuple, np.number, np.ndarray, jax.Array)


def check_values(record: Any, path: str = "", ranges: bool = True) -> None:
    """Raise BadKey for the first value that no scene file could hold; traced values are not known.

    What a file cannot hold and Python can: constants of a material that are arrays over points.
    ranges: False if numbers may have any value
    """
    hints = hints_of(type(record))
    for field in dataclasses.fields(record):
        value, name = getattr(record, field.name), schema.join(path, schema.file_key(field))
        check_value(field, hints.get(field.name), value, name, ranges)
        if "range" in field.metadata and value is not None and not isinstance(record, Material):
            _check_shape(value, field, name)


def hints_of(cls: type) -> dict[str, Any]:
    """Types of a record's fields; none where they are names that this process does not know."""
    try:
        return get_type_hints(cls)
    except NameError:  # of a class that came here from another process
        return {}


def check_value(field: dataclasses.Field[Any], hint: Any, value: Any, path: str, ranges: bool = True) -> None:
    """Raise BadKey unless a value may stand in a field of a record; hint: its type, None if not known."""
    hint = schema.present(hint)
    if value is None and field.default is None:
        return
    if "range" in field.metadata:
        (check_quantity if ranges else numbers)(value, field.metadata["range"], path)
    elif field.metadata.get("static"):
        if hint is not None and not schema.is_tag(field):
            schema.check_static(field, hint, list(value) if isinstance(value, tuple) else value, path)
    elif get_origin(hint) is tuple:
        least = 0 if field.default == () else 1
        if not isinstance(value, tuple) or not least <= len(value) <= MOST_ITEMS:
            raise refuse(path, _words(value), f"a tuple of {least} to {MOST_ITEMS} parts of a scene")
        for i, item in enumerate(value):
            check_part(get_args(hint)[0], item, f"{path}[{i}]", ranges)
    else:
        check_part(hint, value, path, ranges)


def check_part(kind: Any, value: Any, path: str, ranges: bool = True) -> None:
    """Raise BadKey unless a value is a record of a kind (None: any) with sound values."""
    if not dataclasses.is_dataclass(value) or (isinstance(kind, type) and not isinstance(value, kind)):
        name = kind.__name__ if isinstance(kind, type) else "part of a scene"
        raise refuse(path, _words(value), f"a record {name}")
    check_values(value, path, ranges)


def numbers(value: Any, interval: Range, path: str) -> np.ndarray | None:
    """A number in internal units, or an array of them, in the unit of its range; None if it is traced.

    Raises BadKey for what is none.
    """
    if isinstance(value, jax.core.Tracer):
        return None
    try:
        if not isinstance(value, bool) and isinstance(value, NUMBERS):
            found = np.asarray(float(value) if isinstance(value, int) else value)
            if found.dtype.kind in "iuf":
                return found / UNIT_FACTOR[interval.unit]
    except (TypeError, ValueError, OverflowError):  # lists of unlike lengths, digits in hundreds
        pass
    raise refuse(path, _words(value), str(interval))


def check_quantity(value: Any, interval: Range, path: str) -> None:
    """Raise BadKey unless a number in internal units, or each item of an array, is in range."""
    known = numbers(value, interval, path)
    if known is None:
        return
    lower, upper = _ends(interval)
    inside = (known > lower) & (known < upper)
    for position in np.argwhere(~inside):
        where, number = path + "".join(f"[{i}]" for i in position), float(known[tuple(position)])
        raise refuse(where, value if isinstance(value, int) and value == number else number, str(interval))


def _ends(interval: Range) -> tuple[float, float]:
    """Beyond the ends of a range, as far as differences may go."""
    lower, upper = interval.lower, interval.upper
    below = 0.0 if interval.open_lower else BEYOND * (abs(lower) or abs(upper))
    return lower - below, upper + BEYOND * (abs(upper) or abs(lower))


def _check_shape(value: Any, field: dataclasses.Field[Any], path: str) -> None:
    """One number, or a list of numbers that is not too long."""
    n = 1 if isinstance(value, jax.core.Tracer) else np.size(value)
    if np.ndim(value) != int(field.metadata["many"]) or not 1 <= n <= MOST_ITEMS:
        expected = f"a list of 1 to {MOST_ITEMS} numbers" if field.metadata["many"] else "one number"
        raise refuse(path, f"array of shape {np.shape(value)}", expected)


def _words(value: Any) -> Any:
    """What was found, for a refusal."""
    return value if isinstance(value, str | bool | int | float) else repr(value)
