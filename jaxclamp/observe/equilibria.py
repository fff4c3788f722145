"""What is known of a scene once it is solved: its potential and a trajectory of equilibria."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
from jax import Array

from jaxclamp.core.records import record
from jaxclamp.fem.landmarks import Landmarks
from jaxclamp.observe.stresses import Stresses, layer_stresses
from jaxclamp.physics.jaws import Jaw
from jaxclamp.potential.energy import State, stored_energy
from jaxclamp.potential.terms import JAWS, Potential
from jaxclamp.scenes.scene import InjuryThreshold


@record
class Equilibria:
    """A scene's potential and its equilibria in order; what measures, stops and figures look at."""

    potential: Potential
    """with every term, at the scene's pressure"""
    marks: Landmarks
    """where figures are read"""
    states: tuple[State, ...]
    """in the body, then closing; the last is the one asked about"""
    known_stresses: tuple[tuple[Stresses, ...], ...] | None = None
    """by state and layer, where they are at hand"""
    known_wall: tuple[Any, Any] | None = None
    """energy of the wall in the last state, uJ, and its derivative by the nodes, mN, (n_nodes, 3), where they
    are at hand"""
    injury: tuple[InjuryThreshold, ...] = ()
    """the thresholds of the scene's user"""

    @property
    def body(self) -> State:
        """The physiological state: under blood pressure and stretch, without the clamp."""
        return self.states[0]

    @property
    def last(self) -> State:
        """The state that is asked about: at the stop, for a measure of a whole clamping."""
        return self.states[-1]

    @property
    def in_body(self) -> Equilibria:
        """The physiological state as the one asked about."""
        known = None if self.known_stresses is None else self.known_stresses[:1]
        return dataclasses.replace(self, states=self.states[:1], known_stresses=known, known_wall=None)

    @property
    def jaw(self) -> Jaw:
        """The jaw's shape."""
        jaw: Jaw = self.potential.of(JAWS)[0].here(JAWS).jaw
        return jaw

    def stresses(self, layer: int) -> Stresses:
        """Stress at the quadrature points of a layer in the last state."""
        if self.known_stresses is not None:
            return self.known_stresses[-1][layer]
        return layer_stresses(self.potential, self.last, layer)

    def wall(self) -> tuple[Array, Array]:
        """Energy of the modelled wall in the last state, uJ, and its derivative by the nodes, mN."""
        if self.known_wall is not None:
            return self.known_wall
        return jax.value_and_grad(stored_energy, argnums=1)(self.potential, self.last.x)
