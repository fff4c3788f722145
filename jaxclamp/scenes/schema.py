"""Records from tables of plain values and back, in the units of scene files.

The records' fields are the schema: a key is the field's name and unit (`radius_mm`), its range is
the field's, its default the field's. An abstract record (a material, a jaw) is chosen by the
value of its tag (`law = "hgo"`), or by the key that is there if the base says `CHOSEN_BY_KEY = True`
(a stop): a new record below such a base is known as soon as its class exists.
Numbers become floats in internal units (mm, kPa, mN, radians).
"""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Sequence
from datetime import date, time
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np

from jaxclamp.core.failures import BadKey
from jaxclamp.core.parts import is_shipped
from jaxclamp.core.records import UNIT_FACTOR, Range, concrete_subclasses
from jaxclamp.scenes.wording import did_you_mean, nearest, shortened

MOST_ITEMS = 200
"""longest list of numbers or of layers"""
LONGEST_TEXT = 200
"""characters of a title or a name"""
ONES_OWN = "one of your own is known once its file is imported: --import FILE, or jaxclamp.import_parts"


def refuse(path: str, value: Any, expected: str, choices: Sequence[str] = ()) -> BadKey:
    """The error for a value that is not what was expected; the nearest of `choices` is suggested."""
    near = nearest(value, list(choices)) if isinstance(value, str) else None
    hint = f"; did you mean {near}?" if near else ""
    return BadKey(f"{path} = {shown(value)}: expected {expected}{hint}")


def shown(value: Any) -> str:
    """A value as it would stand in TOML, on one line and not too long."""
    try:
        text = toml_value(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, a list of lists of lists
        text = "..."
    return shortened(text)


def join(path: str, key: str) -> str:
    """The path of a key in the table at `path`."""
    return f"{path}.{bare(key)}" if path else bare(key)


# ------------------------------------------------------------------------------- fields and keys


def file_key(field: dataclasses.Field[Any]) -> str:
    """The key of a field: its name, and the unit of its quantity."""
    interval = field.metadata.get("range")
    return f"{field.name}_{interval.unit}" if interval is not None and interval.unit else field.name


def is_tag(field: dataclasses.Field[Any]) -> bool:
    """True for a string that is fixed by the class, such as a law's name."""
    return (
        bool(field.metadata.get("static"))
        and isinstance(field.default, str)
        and field.default != ""
        and not field.metadata.get("choices")
    )


def fields_by_key(cls: type) -> dict[str, dataclasses.Field[Any]]:
    """The fields that a file can set, by their key."""
    return {file_key(f): f for f in dataclasses.fields(cls) if not is_tag(f)}


def is_chosen_by_key(base: Any) -> bool:
    """True for a base whose records are told apart by their keys (itself, not the records below it)."""
    return bool(vars(base).get("CHOSEN_BY_KEY", False)) and not dataclasses.is_dataclass(base)


def keys_below(base: type) -> list[str]:
    """The keys of the records below a base that is chosen by key."""
    return list(dict.fromkeys(key for cls in concrete_subclasses(base) for key in fields_by_key(cls)))


def choices_below(base: type) -> list[str]:
    """What a table has to hold for each of the records below a base that is chosen by key."""
    return [" with ".join(_required_keys(cls)) for cls in concrete_subclasses(base)]


def _required_keys(cls: type) -> list[str]:
    hints = get_type_hints(cls)
    return [key for key, field in fields_by_key(cls).items() if is_required(field, hints[field.name])]


def present(hint: Any) -> Any:
    """The type of what may be left out, of `X | None`: X; any other type as it is."""
    kinds = [kind for kind in get_args(hint) if kind is not type(None)]
    return kinds[0] if len(kinds) == 1 and type(None) in get_args(hint) else hint


def tag_of(cls: type) -> tuple[str, str]:
    """Name and value of the tag of a record class; blank for one without."""
    return next(((f.name, str(f.default)) for f in dataclasses.fields(cls) if is_tag(f)), ("", ""))


def is_required(field: dataclasses.Field[Any], hint: Any) -> bool:
    """True unless the field has a default, or is a record all of whose fields have one."""
    if field.default is not dataclasses.MISSING:
        return False
    if not dataclasses.is_dataclass(hint):
        return True
    hints = get_type_hints(hint)
    return any(is_required(f, hints[f.name]) for f in dataclasses.fields(hint))


# ------------------------------------------------------------------------------------- reading


def read(kind: Any, table: Any, path: str = "") -> Any:
    """The record of class `kind` (a base, or a record itself) that `table` describes. Raises BadKey."""
    if not isinstance(table, dict):
        raise refuse(path, table, f"a table with {_main_keys(kind)}")
    if is_chosen_by_key(kind):
        return _read_record(_by_key(kind, table, path), table, path)
    if inspect.isabstract(kind):
        kind = _tagged(kind, table, path)
        tag, name = tag_of(kind)
        untagged = {key: value for key, value in table.items() if key != tag}
        return _read_record(kind, untagged, path, f" of {tag} = {quoted(name)}")
    return _read_record(kind, table, path)


def _main_keys(kind: Any) -> str:
    if is_chosen_by_key(kind):
        return f"exactly one of {', '.join(choices_below(kind))}"
    if inspect.isabstract(kind):
        return f"{tag_of(concrete_subclasses(kind)[0])[0]} = one of {_listed(_tags(kind))}"
    return ", ".join(fields_by_key(kind))


def _tags(base: type) -> dict[str, type]:
    """The records below a base by their tag; of two that share one, the shipped one, else the last."""
    found: dict[str, type] = {}
    for cls in concrete_subclasses(base):
        tag = tag_of(cls)[1]
        if tag and not (tag in found and is_shipped(found[tag])):
            found[tag] = cls
    return found


def _listed(words: Any) -> str:
    return ", ".join(toml_value(word) for word in words)


def _tagged(base: type, table: dict[str, Any], path: str) -> type:
    """The record below `base` that the table's tag names."""
    known = _tags(base)
    tag = tag_of(next(iter(known.values())))[0]
    if tag not in table:
        raise BadKey(f"{join(path, tag)} is missing: expected one of {_listed(known)}")
    chosen = table[tag]
    if not isinstance(chosen, str) or chosen not in known:
        refused = refuse(join(path, tag), chosen, f"one of {_listed(known)}", list(known))
        raise refused if nearest(str(chosen), list(known)) else BadKey(f"{refused} ({ONES_OWN})")
    return known[chosen]


def _by_key(base: type, table: dict[str, Any], path: str) -> type:
    """The one record below `base` that the keys of the table belong to."""
    _refuse_unknown(table, keys_below(base), path)
    chosen = [
        cls
        for cls in concrete_subclasses(base)
        if set(_required_keys(cls)) <= set(table) <= set(fields_by_key(cls))
    ]
    if len(chosen) != 1:
        raise refuse(path, table, _main_keys(base))
    return chosen[0]


def _refuse_unknown(table: dict[str, Any], known: list[str], path: str, of: str = "") -> None:
    for key in table:
        if key not in known:
            place = f"{path}.{shortened(bare(key))}" if path else shortened(bare(key))
            raise BadKey(f"unknown key {place}{of}; {did_you_mean(key, known, table[key])}")


def _read_record(cls: type, table: dict[str, Any], path: str, of: str = "") -> Any:
    known = fields_by_key(cls)
    _refuse_unknown(table, list(known), path, of)
    hints = get_type_hints(cls)
    values = {}
    for key, field in known.items():
        if key in table:
            values[field.name] = _read_field(field, present(hints[field.name]), table[key], join(path, key))
        elif is_required(field, hints[field.name]):
            raise BadKey(f"{join(path, key)} is missing: expected {_wanted(field, hints)}")
        elif field.default is dataclasses.MISSING:
            values[field.name] = read(hints[field.name], {}, join(path, key))
    return cls(**values)


def _wanted(field: dataclasses.Field[Any], hints: dict[str, Any]) -> str:
    """What a missing key should hold."""
    hint = hints[field.name]
    if "range" in field.metadata:
        return _expected(field.metadata["range"], field.metadata["many"])
    if field.metadata.get("static"):
        return _static_wanted(field, hint)
    return "a list of tables" if get_origin(hint) is tuple else f"a table with {_main_keys(hint)}"


def _expected(interval: Range, many: bool) -> str:
    return f"a list of numbers, each {str(interval).removeprefix('a number ')}" if many else str(interval)


def _read_field(field: dataclasses.Field[Any], hint: Any, value: Any, path: str) -> Any:
    if "range" in field.metadata:
        interval = field.metadata["range"]
        if field.metadata["many"]:
            items = _items(value, path, _expected(interval, many=True))
            return np.array([_quantity(item, interval, f"{path}[{i}]") for i, item in enumerate(items)])
        return _quantity(value, interval, path)
    if field.metadata.get("static"):
        return check_static(field, hint, value, path)
    if get_origin(hint) is tuple:
        inner = get_args(hint)[0]
        items = _items(value, path, "a list of tables")
        return tuple(read(inner, item, f"{path}[{i}]") for i, item in enumerate(items))
    return read(hint, value, path)


def _items(value: Any, path: str, expected: str) -> list[Any]:
    if not isinstance(value, list) or not 1 <= len(value) <= MOST_ITEMS:
        raise refuse(path, value, f"{expected} (1 to {MOST_ITEMS} of them)")
    return value


def _quantity(value: Any, interval: Range, path: str) -> float:
    """A number in the file's unit, as a float in internal units."""
    number = _number(value)
    if number is None or not interval.contains(number):
        raise refuse(path, value, str(interval))
    return number * UNIT_FACTOR[interval.unit]


def _number(value: Any) -> float | None:
    """A TOML number as a finite float, None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _static_wanted(field: dataclasses.Field[Any], hint: Any) -> str:
    if field.metadata.get("choices"):
        return f"one of {_listed(field.metadata['choices'])}"
    if hint is bool:
        return "true"
    if hint is str:
        return f"a text on one line, at most {LONGEST_TEXT} characters"
    if get_origin(hint) is tuple:
        return "a list of whole numbers"
    return "a whole number" if hint is int else "a number"


def check_static(field: dataclasses.Field[Any], hint: Any, value: Any, path: str) -> Any:
    """A choice of a file (a list for a tuple) as the record holds it. Raises BadKey."""
    expected = _static_wanted(field, hint)
    if get_origin(hint) is tuple:
        items = _items(value, path, expected)
        if all(_is_whole(item) for item in items):
            return tuple(items)
    elif (
        (hint is int and _is_whole(value))
        or (hint is str and _is_text(value, field))
        or (hint is bool and value is True)
    ):
        return value
    elif hint is float and _number(value) is not None:
        return _number(value)
    raise refuse(path, value, expected, field.metadata.get("choices", ()))


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**31


def _is_text(value: Any, field: dataclasses.Field[Any]) -> bool:
    if not isinstance(value, str):
        return False
    choices = field.metadata.get("choices")
    return value in choices if choices else value.isprintable() and len(value) <= LONGEST_TEXT


# ------------------------------------------------------------------------------------- writing


def table(record: Any, path: str = "") -> dict[str, Any]:
    """The table that `read` turns into an equal record: the tag first, then every key that is there.

    path: where the record is, for refusals. Raises BadKey for an array where a file holds one number.
    """
    result: dict[str, Any] = {}
    for field in dataclasses.fields(record):
        value, key = getattr(record, field.name), file_key(field)
        if value is None and field.default is None:
            continue
        if is_tag(field):
            if _is_chosen_by_tag(type(record)):
                result[key] = value
        elif "range" in field.metadata:
            result[key] = _numbers(field, value, join(path, key))
        elif field.metadata.get("static"):
            result[key] = list(value) if isinstance(value, tuple) else value
        elif isinstance(value, tuple) and not value:
            continue  # as in a file without it
        elif isinstance(value, tuple):
            result[key] = [table(item, f"{join(path, key)}[{i}]") for i, item in enumerate(value)]
        else:
            result[key] = table(value, join(path, key))
    return result


def _is_chosen_by_tag(cls: type) -> bool:
    return any(inspect.isabstract(base) and not is_chosen_by_key(base) for base in cls.__mro__)


def _numbers(field: dataclasses.Field[Any], value: Any, path: str) -> float | list[float]:
    """A quantity in the file's unit: one number, or a list of them."""
    factor, many = UNIT_FACTOR[field.metadata["range"].unit], field.metadata["many"]
    numbers = np.asarray(value, dtype=float)
    if numbers.ndim != int(many):
        expected = "a list of numbers" if many else "one number"
        raise BadKey(f"{path} is an array of shape {numbers.shape}: a scene file holds {expected} there")
    return (
        [in_file_unit(v, factor) for v in numbers.tolist()] if many else in_file_unit(float(numbers), factor)
    )


def in_file_unit(value: float, factor: float) -> float:
    """The shortest number that, times `factor`, gives `value` again (else the nearest one)."""
    exact = value / factor
    candidates = [float(f"{exact:.{digits}g}") for digits in (14, 15, 16)]
    candidates += [exact, math.nextafter(exact, -math.inf), math.nextafter(exact, math.inf)]
    return next((number for number in candidates if number * factor == value), exact)


def toml_value(value: Any) -> str:
    """A value on one line of TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, dict):
        inside = ", ".join(f"{bare(key)} = {toml_value(item)}" for key, item in value.items())
        return f"{{ {inside} }}" if inside else "{}"
    if isinstance(value, list):
        return f"[{', '.join(toml_value(item) for item in value)}]"
    if isinstance(value, date | time):
        return value.isoformat()
    return repr(value)


def quoted(text: str) -> str:
    """A TOML string; whatever cannot be printed is escaped."""
    escape = {'"': '\\"', "\\": "\\\\"}
    return '"' + "".join(escape.get(c, c if c.isprintable() else f"\\U{ord(c):08x}") for c in text) + '"'


def bare(key: str) -> str:
    """A TOML key, in quotes where it needs them."""
    return key if key and all(c.isascii() and (c.isalnum() or c in "-_") for c in key) else quoted(key)
