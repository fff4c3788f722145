"""What closes the equations of equilibrium: a condition on the state, and its row in Newton's border.

A stop is a measure and a target (`observe.stops`); its row is the derivative of that measure by the
unknowns, from `jax.grad`. Where a closing goes by itself, its condition is a stop with a nearer target.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
from jax import Array

from jaxclamp.observe.equilibria import Equilibria
from jaxclamp.potential.energy import State, settled
from jaxclamp.potential.terms import Potential
from jaxclamp.scenes.scene import Stop


@dataclasses.dataclass(frozen=True)
class Row:
    """A condition at a state: how far off, and its derivatives."""

    error: float
    """measure less target, in the measure's unit"""
    by_x: np.ndarray
    """by the unknowns, (n_free,)"""
    by_q: np.ndarray
    """by the rigid coordinates, (n_q,)"""


@dataclasses.dataclass(frozen=True)
class Held:
    """The jaw stays at a height, mm."""

    height: float
    """of the jaw's lowest point above the axis, mm"""

    def row(self, state: State, n_free: int) -> Row:
        """The condition at a state."""
        by_q = np.eye(1, len(state.q))[0]
        return Row(float(state.jaw_height) - self.height, np.zeros(n_free), by_q)


@dataclasses.dataclass(frozen=True)
class Until:
    """The jaw moves until the measure of a stop has a value."""

    stop: Stop
    """with the measure"""
    target: float
    """internal units"""
    equilibria: Equilibria
    """of which the last state is the one sought"""

    def row(self, state: State, n_free: int) -> Row:
        """The condition at a state."""
        known = dataclasses.replace(self.equilibria, states=(self.equilibria.body, state))
        value, by_x, by_q = jax.device_get(stop_row(self.stop, known))
        return Row(float(value) - self.target, by_x, by_q)


Condition = Held | Until


@jax.jit
def stop_row(stop: Stop, equilibria: Equilibria) -> tuple[Array, Array, Array]:
    """The measure of a stop at the last state, and its derivatives by the unknowns (n_free,) and q (n_q,)."""
    e = equilibria

    def of(x: Array, q: Array) -> Array:
        return stop.measure(dataclasses.replace(e, states=(e.body, settled(e.potential, x, q))))

    value, (by_x, by_q) = jax.value_and_grad(of, argnums=(0, 1))(e.last.x, e.last.q)
    return value, by_x.ravel()[e.potential.layout.free], by_q


def stop_residual(stop: Stop, marks: Any, potential: Potential, states: tuple[State, ...]) -> Array:
    """Measure less target at some states: the equation of the stop."""
    return stop.measure(Equilibria(potential=potential, marks=marks, states=states)) - stop.target()
