"""Words for refusals: what was probably meant, in which unit, and nothing that is too long to read."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from contextlib import suppress
from itertools import chain
from typing import Any

from jaxclamp.core.records import UNIT_FACTOR

LONGEST_ECHO = 60
"""characters of what a user wrote that are repeated to them"""
MOST_KNOWN = 40
"""names that are listed where none is near"""

CONVERSIONS = {
    "mmHg": ("kPa", 0.133322),
    "cmH2O": ("kPa", 0.0980665),
    "Pa": ("kPa", 1e-3),
    "hPa": ("kPa", 0.1),
    "MPa": ("kPa", 1e3),
    "bar": ("kPa", 100.0),
    "psi": ("kPa", 6.89476),
    "um": ("mm", 1e-3),
    "cm": ("mm", 10.0),
    "m": ("mm", 1e3),
    "rad": ("deg", 57.2958),
    "mN": ("N", 1e-3),
    "kN": ("N", 1e3),
    "g": ("N", 9.80665e-3),
    "cm2": ("mm2", 100.0),
    "MPa_per_mm": ("kPa_per_mm", 1e3),
}
"""units that scene files do not use: the one they use, and how many of it one is"""

_UNITS = sorted({*filter(None, UNIT_FACTOR), *CONVERSIONS}, key=len, reverse=True)


def shortened(text: str, longest: int = LONGEST_ECHO) -> str:
    """The text, cut to `longest` characters."""
    return text if len(text) <= longest else text[: longest - 3] + "..."


def split_unit(word: str) -> tuple[str, str]:
    """The name and the unit of a key: ("radius", "mm") of "radius_mm"; the unit is "" if there is none."""
    exact = (unit for unit in _UNITS if word.endswith(f"_{unit}"))
    other_case = (unit for unit in _UNITS if word.lower().endswith(f"_{unit.lower()}"))
    unit = next(chain(exact, other_case), "")
    return (word[: -len(unit) - 1], unit) if unit else (word, "")


def nearest(word: str, known: Sequence[str]) -> str | None:
    """What was probably meant: the same word with the right unit, or one that differs by a slip."""
    word = word[:LONGEST_ECHO]
    name, unit = split_unit(word)
    by_name = {split_unit(k)[0]: k for k in reversed(known)}
    same = [k for k in known if k.lower() == word.lower() or k.startswith(f"{word}_")]
    if unit and name in by_name:
        same.append(by_name[name])
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    if unit:
        close += [by_name[n] for n in difflib.get_close_matches(name, list(by_name), n=1, cutoff=0.5)]
    return next(iter(same + close), None)


def did_you_mean(word: str, known: Sequence[str], value: Any = None) -> str:
    """'did you mean X?', with the conversion of a wrong unit, or what is known where nothing is near.

    value: what was given under that name, which is converted too if it is a number
    """
    near = nearest(word, known)
    if near is None:
        more = ", ..." if len(known) > MOST_KNOWN else ""
        return f"known here: {', '.join(shortened(k) for k in known[:MOST_KNOWN])}{more}"
    given, expected = split_unit(word)[1], split_unit(near)[1]
    target, factor = CONVERSIONS.get(given, ("", 1.0))
    said = f"did you mean {shortened(near)}?{_about_units(given, expected)}"
    if target and target == expected and isinstance(value, int | float) and not isinstance(value, bool):
        with suppress(OverflowError):  # digits in hundreds
            said += f": {shortened(near)} = {value * factor:.6g}"
    return said


def _about_units(given: str, expected: str) -> str:
    """What to know of the unit that was given where another one, or none, is expected."""
    if given in ("", expected):
        return ""
    if not expected:
        return " (it has no unit)"
    target, factor = CONVERSIONS.get(given, ("", 1.0))
    if target == expected:
        return f" (1 {spoken(given)} = {factor:g} {spoken(expected)})"
    return f" (it is in {spoken(expected)})"


def spoken(unit: str) -> str:
    """A unit as it is read: kPa/mm for kPa_per_mm."""
    return unit.replace("_per_", "/")
