"""A measure: one number of the equilibria of a scene; and arithmetic with measures.

    price = jc.smooth_peak_axial_stress("media") / jc.kPa + 0.1 * jc.clamp_force() / jc.N

is a measure again. Units multiply and divide; both sides of a sum need the same one. A measure without a
unit, such as a force over N, may be added to any other and counts in that one's unit: it has been weighed
against it on purpose. A bare number may not: `peak - 30 * jc.kPa`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax import Array

from jaxclamp.core import units
from jaxclamp.core.surroundings import require_fit


@dataclasses.dataclass(frozen=True)
class Measure:
    """A scalar function of the equilibria. Two measures of one name, function and arguments are equal."""

    name: str
    """such as smooth_peak_axial_stress"""
    unit: str
    """internal unit: mm, kPa, mN, uJ, or none"""
    function: Callable[..., Array]
    """of the `Equilibria` and the arguments: a JAX scalar"""
    arguments: tuple[Any, ...] = ()
    """such as a layer's name: texts, numbers, measures"""
    needs_stop: bool = True
    """False: the physiological state is all that it needs"""

    __array_ufunc__ = None  # a number of NumPy on the left leaves the arithmetic to us

    def __call__(self, equilibria: Any) -> Array:
        """The value in internal units, a JAX scalar."""
        return self.function(equilibria, *self.arguments)

    def __str__(self) -> str:
        if self.function in _STRENGTH:
            return self.name
        inside = ", ".join(map(str, self.arguments))
        return f"{self.name}({inside})"

    def __add__(self, other: Any) -> Measure:
        return _sum("+", self, other)

    def __radd__(self, other: Any) -> Measure:
        return _sum("+", other, self)

    def __sub__(self, other: Any) -> Measure:
        return _sum("-", self, other)

    def __rsub__(self, other: Any) -> Measure:
        return _sum("-", other, self)

    def __neg__(self) -> Measure:
        return -1.0 * self

    def __mul__(self, other: Any) -> Measure:
        return _product("*", self, other)

    def __rmul__(self, other: Any) -> Measure:
        return _product("*", other, self)

    def __truediv__(self, other: Any) -> Measure:
        return _product("/", self, other)

    def __rtruediv__(self, other: Any) -> Measure:
        return _product("/", other, self)

    def __pow__(self, power: Any) -> Measure:
        return _power(self, power)


def require_measure(found: Any) -> Measure:
    """The measure, or a TypeError that says what to write instead; Unfit if this process cannot compute."""
    require_fit()
    if isinstance(found, Measure):
        return found
    name = getattr(found, "__name__", None)
    said = f"the function {name}; call it, such as {name}()" if callable(found) and name else repr(found)
    raise TypeError(f"expected a measure, found {said}")


# --- units and numbers: measures that look at nothing ----------------------------------------------------


def _constant(_: Any, value: float) -> Array:
    return jax.numpy.asarray(value)


def _unit(name: str, unit: str, value: float = 1.0) -> Measure:
    return Measure(name, unit, _constant, (value,), needs_stop=False)


mm, mm2, kPa, uJ = (_unit(name, name) for name in ("mm", "mm2", "kPa", "uJ"))
mN, N = _unit("mN", "mN"), _unit("N", "mN", 1e3)
UNITS = {"mm": mm, "mm2": mm2, "kPa": kPa, "uJ": uJ, "mN": mN, "N": N}
"""to weigh measures with, by name: `0.1 * clamp_force() / N`, `peak - 30 * kPa`"""


def _operand(value: Any) -> Measure:
    """A measure, or a number as one. Raises TypeError, ValueError."""
    if isinstance(value, jax.core.Tracer):
        raise TypeError(
            "a traced number cannot be part of a measure: weigh its value, w * jaxclamp.evaluate(scene, m)"
        )
    if isinstance(value, bool) or not (
        isinstance(value, int | float | np.number) or (isinstance(value, Array) and value.ndim == 0)
    ):
        return require_measure(value)
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{number} cannot be part of a measure: expected a finite number")
    return Measure(f"{number:g}", "", _constant, (number,), needs_stop=False)


# --- arithmetic --------------------------------------------------------------------------------------------


def _plus(e: Any, a: Measure, b: Measure) -> Array:
    return a(e) + b(e)


def _minus(e: Any, a: Measure, b: Measure) -> Array:
    return a(e) - b(e)


def _times(e: Any, a: Measure, b: Measure) -> Array:
    return a(e) * b(e)


def _over(e: Any, a: Measure, b: Measure) -> Array:
    return a(e) / b(e)


def _to_the(e: Any, a: Measure, power: float) -> Array:
    return a(e) ** power


_FUNCTIONS = {"+": _plus, "-": _minus, "*": _times, "/": _over}
_STRENGTH: dict[Callable[..., Array], int] = {
    _plus: 1,
    _minus: 1,
    _times: 2,
    _over: 2,
    _to_the: 3,
    _constant: 4,
}
"""how strongly an expression holds together, for brackets in names"""


def _said(measure: Measure, within: int) -> str:
    """An operand as part of a name, in brackets where it holds together no more than `within`."""
    return f"({measure})" if _STRENGTH.get(measure.function, 4) <= within else str(measure)


def _combined(symbol: str, a: Measure, b: Measure, unit: str) -> Measure:
    function = _FUNCTIONS[symbol]
    strength = _STRENGTH[function]
    right = _said(b, strength if symbol in "-/" else strength - 1)
    name = f"{_said(a, strength - 1)} {symbol} {right}"
    return Measure(name, unit, function, (a, b), a.needs_stop or b.needs_stop)


def _sum(symbol: str, left: Any, right: Any) -> Measure:
    """left + right or left - right. Raises TypeError where their units do not add."""
    a, b = _operand(left), _operand(right)
    if units.dimensions(a.unit) != units.dimensions(b.unit):
        numbers = [m for m in (a, b) if m.function is _constant and not m.unit]
        if numbers:
            unit = a.unit or b.unit
            what = f"{unit}, such as {numbers[0]} * jaxclamp.{unit}" if unit in UNITS else unit
            raise TypeError(f"{a} {symbol} {b}: the number {numbers[0]} has no unit, expected one in {what}")
        if a.unit and b.unit:
            raise TypeError(
                f"{a} {symbol} {b}: {a.unit} and {b.unit} do not add; divide each by a unit first, such as "
                f"jaxclamp.{a.unit if a.unit in UNITS else 'kPa'}"
            )
    return _combined(symbol, a, b, a.unit or b.unit)


def _product(symbol: str, left: Any, right: Any) -> Measure:
    a, b = _operand(left), _operand(right)
    return _combined(symbol, a, b, units.product(a.unit, b.unit, 1 if symbol == "*" else -1))


def _power(base: Measure, power: Any) -> Measure:
    """base ** power. Raises TypeError where the unit would not be one."""
    number = float(power) if isinstance(power, int | float | np.number) else math.nan
    if not math.isfinite(number) or (base.unit and number != int(number)):
        wanted = "a whole number" if base.unit else "a number"
        raise TypeError(
            f"{base} ** {power!r}: expected {wanted} as the power of a measure in {base.unit or '1'}"
        )
    unit = units.product("", base.unit, int(number)) if base.unit else ""
    return Measure(f"{_said(base, 3)} ** {number:g}", unit, _to_the, (base, number), base.needs_stop)
