"""What units multiply to. Inside, every unit is a product of powers of mm and mN: no factors arise."""

from __future__ import annotations

import re

Dimensions = tuple[int, int]
"""powers of mm and of mN"""

KNOWN: dict[str, Dimensions] = {
    "": (0, 0),
    "mm": (1, 0),
    "mm2": (2, 0),
    "mm3": (3, 0),
    "1/mm": (-1, 0),
    "mN": (0, 1),
    "kPa": (-2, 1),
    "uJ": (1, 1),
    "mN/mm": (-1, 1),
    "kPa/mm": (-3, 1),
}
"""internal units that have a name"""
_NAMES = {dimensions: name for name, dimensions in KNOWN.items()}


def dimensions(unit: str) -> Dimensions:
    """Powers of mm and mN in an internal unit. Raises ValueError for any other."""
    if unit in KNOWN:
        return KNOWN[unit]
    found = re.fullmatch(r"mm\^(-?\d+) mN\^(-?\d+)", unit)
    if found is None:
        known = ", ".join(repr(name) for name in KNOWN)
        raise ValueError(f"unit {unit!r}: expected an internal unit, one of {known}")
    return int(found[1]), int(found[2])


def product(a: str, b: str, power: int = 1) -> str:
    """The unit of a value in unit `a` times a value in unit `b` to a whole power."""
    (mm, mN), (by_mm, by_mN) = dimensions(a), dimensions(b)
    found = mm + power * by_mm, mN + power * by_mN
    return _NAMES.get(found, f"mm^{found[0]} mN^{found[1]}")
