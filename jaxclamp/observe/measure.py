"""A measure: one number of the equilibria of a scene, with its unit; measures combine like numbers."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import Array

from jaxclamp.core.surroundings import require_fit
from jaxclamp.observe.equilibria import Equilibria
from jaxclamp.observe.units import combined


@dataclasses.dataclass(frozen=True)
class Measure:
    """A scalar function of the equilibria. Two measures of one name and arguments are equal."""

    name: str
    """such as smooth_peak_axial_stress"""
    unit: str
    """internal unit: mm, kPa, mN, uJ, or none"""
    function: Callable[..., Array]
    """of the equilibria and the arguments: a JAX scalar"""
    arguments: tuple[str | float | Measure, ...] = ()
    """such as a layer's name; the operands of a sum"""
    needs_stop: bool = True
    """False: the physiological state is all that it needs"""

    def __call__(self, equilibria: Equilibria) -> Array:
        """The value in internal units, a JAX scalar."""
        return self.function(equilibria, *self.arguments)

    def __str__(self) -> str:
        if self.function is _constant:
            return self.name
        if self.function in _WRITTEN:
            return _WRITTEN[self.function].format(*map(str, self.arguments))
        inside = ", ".join(map(str, self.arguments))
        return f"{self.name}({inside})"

    # A pure number counts in the unit of what it is added to; anything else has to have that unit.

    def __add__(self, other: Measure | float) -> Measure:
        return _joined(_added, self, other, _common_unit(self, other))

    def __radd__(self, other: float) -> Measure:
        return _joined(_added, other, self, self.unit)

    def __neg__(self) -> Measure:
        return -1.0 * self

    def __sub__(self, other: Measure | float) -> Measure:
        return _joined(_subtracted, self, other, _common_unit(self, other))

    def __rsub__(self, other: float) -> Measure:
        return _joined(_subtracted, other, self, self.unit)

    def __mul__(self, other: Measure | float) -> Measure:
        return _joined(_multiplied, self, other, combined(self.unit, _unit(other), 1.0))

    def __rmul__(self, other: float) -> Measure:
        return _joined(_multiplied, other, self, self.unit)

    def __truediv__(self, other: Measure | float) -> Measure:
        return _joined(_divided, self, other, combined(self.unit, _unit(other), -1.0))

    def __rtruediv__(self, other: float) -> Measure:
        return _joined(_divided, other, self, combined("", self.unit, -1.0))

    def __pow__(self, power: float) -> Measure:
        return _joined(_raised, self, power, combined("", self.unit, _number(power)))


def _number(value: Any) -> float:
    """A finite number. Raises TypeError for anything else, a measure's factory among them."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise TypeError(f"measures combine with measures and finite numbers, found {_described(value)}")
    return float(value)


def _unit(value: Measure | float) -> str:
    return value.unit if isinstance(value, Measure) else ""


def _common_unit(first: Measure, second: Measure | float) -> str:
    """The unit of a sum. Raises ValueError if there is none."""
    units = [unit for unit in (first.unit, _unit(second)) if unit]
    if len(set(units)) > 1:
        raise ValueError(
            f"{first} is in {units[0]} and {second} in {units[1]}: expected one unit in a sum; "
            "divide by jc.N, jc.kPa or jc.mm to weigh them"
        )
    return units[0] if units else ""


def _joined(operation: Callable[..., Array], first: Any, second: Any, unit: str) -> Measure:
    """A measure of two operands, each a measure or a number."""
    known = tuple(each if isinstance(each, Measure) else _number(each) for each in (first, second))
    needs_stop = any(each.needs_stop for each in known if isinstance(each, Measure))
    return Measure(operation.__name__.strip("_"), unit, operation, known, needs_stop)


def _value(e: Equilibria, operand: Measure | float) -> Any:
    return operand(e) if isinstance(operand, Measure) else operand


def _added(e: Equilibria, a: Measure | float, b: Measure | float) -> Array:
    return jnp.asarray(_value(e, a) + _value(e, b))


def _subtracted(e: Equilibria, a: Measure | float, b: Measure | float) -> Array:
    return jnp.asarray(_value(e, a) - _value(e, b))


def _multiplied(e: Equilibria, a: Measure | float, b: Measure | float) -> Array:
    return jnp.asarray(_value(e, a) * _value(e, b))


def _divided(e: Equilibria, a: Measure | float, b: Measure | float) -> Array:
    return jnp.asarray(_value(e, a) / _value(e, b))


def _raised(e: Equilibria, a: Measure | float, b: Measure | float) -> Array:
    return jnp.asarray(_value(e, a) ** _value(e, b))


def _constant(e: Equilibria, value: float) -> Array:
    return jnp.asarray(value)


_WRITTEN: dict[Callable[..., Array], str] = {
    _added: "({} + {})",
    _subtracted: "({} - {})",
    _multiplied: "{} * {}",
    _divided: "{} / ({})",
    _raised: "({})**{}",
}
"""how a measure of others is written"""

N = Measure("N", "mN", _constant, (1000.0,), needs_stop=False)
"""one newton, to weigh measures by: `jc.clamp_force() / jc.N` is a pure number"""
kPa = Measure("kPa", "kPa", _constant, (1.0,), needs_stop=False)
"""one kilopascal"""
mm = Measure("mm", "mm", _constant, (1.0,), needs_stop=False)
"""one millimetre"""


def _described(found: Any) -> str:
    """What was found where a measure was meant, and what to write instead."""
    name = getattr(found, "__name__", None)
    return f"the function {name}; call it, such as {name}()" if callable(found) and name else repr(found)


def require_measure(found: Any) -> Measure:
    """The measure, or a TypeError that says what to write instead; Unfit if this process cannot compute."""
    require_fit()
    if isinstance(found, Measure):
        return found
    raise TypeError(f"expected a measure, found {_described(found)}")
