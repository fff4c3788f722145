"""Units of measures: internal units are coherent, so that a unit is two exponents.

mN = kPa mm^2 and uJ = kPa mm^3: every internal unit is kPa^a mm^b.
"""

from __future__ import annotations

EXPONENTS = {
    "": (0.0, 0.0),
    "kPa": (1.0, 0.0),
    "mm": (0.0, 1.0),
    "mm2": (0.0, 2.0),
    "1/mm": (0.0, -1.0),
    "mN": (1.0, 2.0),
    "uJ": (1.0, 3.0),
}
"""of kPa and of mm in each unit that has a name"""


def exponents(unit: str) -> tuple[float, float]:
    """Exponents of kPa and mm in an internal unit. Raises ValueError for one that is none."""
    if unit in EXPONENTS:
        return EXPONENTS[unit]
    found = {"kPa": 0.0, "mm": 0.0}
    for part in unit.split(" "):
        base, _, power = part.partition("^")
        try:
            found[base] = {"": 1.0}.get(power) or float(power)
        except ValueError:
            found[""] = 0.0
    if set(found) != {"kPa", "mm"}:
        raise ValueError(f"unit {unit!r}: expected one of {', '.join(repr(u) for u in EXPONENTS)}")
    return found["kPa"], found["mm"]


def unit_of(powers: tuple[float, float]) -> str:
    """The unit with these exponents of kPa and mm: its name, or such as "kPa^2 mm"."""
    for name, known in EXPONENTS.items():
        if known == powers:
            return name
    parts = [f"{base}^{power:g}" for base, power in zip(("kPa", "mm"), powers, strict=True) if power]
    return " ".join(part.removesuffix("^1") for part in parts)


def combined(first: str, second: str, power: float) -> str:
    """The unit of `first` times `second` to a power."""
    a, b = exponents(first), exponents(second)
    return unit_of((a[0] + power * b[0], a[1] + power * b[1]))
