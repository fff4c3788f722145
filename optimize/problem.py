"""A design problem: what may change, what is minimised, and what must hold."""

from __future__ import annotations

import dataclasses
import math
from functools import cached_property

import numpy as np

from jaxclamp import Measure, Scene
from jaxclamp.scenes.address import describe
from optimize.variables import Entry, Variable, entries, with_design


@dataclasses.dataclass(frozen=True)
class Constraint:
    """lower <= measure <= upper, in internal units (mm, kPa, mN)."""

    measure: Measure
    """what is bounded"""
    lower: float = -math.inf
    """internal units"""
    upper: float = math.inf
    """internal units"""

    @property
    def scale(self) -> float:
        """Size of the bounds, for relative violations."""
        return max((abs(b) for b in (self.lower, self.upper) if math.isfinite(b)), default=1.0) or 1.0

    def violation(self, value: float) -> float:
        """How far `value` is outside, relative to the bounds; 0 inside."""
        return max(self.lower - value, value - self.upper, 0.0) / self.scale


@dataclasses.dataclass(frozen=True)
class DesignProblem:
    """Minimise a measure of the scene over some of its floats, subject to constraints."""

    scene: Scene
    """the start design"""
    objective: Measure
    """what is minimised"""
    variables: tuple[Variable, ...]
    """what may change"""
    constraints: tuple[Constraint, ...] = ()
    """what must hold"""
    reference: Scene | None = None
    """another clamp to compare with, such as the one in use"""

    @cached_property
    def entries(self) -> tuple[Entry, ...]:
        """The components of the design vector, (n_variables,). Raises SceneError."""
        return entries(self.scene, tuple(self.variables))

    @cached_property
    def paths(self) -> tuple[str, ...]:
        """Addresses of the variables in the scene, without units; a list of floats is one of them.

        Raises SceneError.
        """
        return tuple(describe(self.scene, variable.path).path for variable in self.variables)

    @property
    def measures(self) -> tuple[Measure, ...]:
        """The objective, then what is constrained, (n_measures,)."""
        return (self.objective, *(constraint.measure for constraint in self.constraints))

    @property
    def start(self) -> np.ndarray:
        """The start design, (n_variables,), internal units."""
        return np.array([entry.start for entry in self.entries])

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds, (n_variables,) each, internal units."""
        return np.array([e.lower for e in self.entries]), np.array([e.upper for e in self.entries])

    def scene_at(self, design: np.ndarray) -> Scene:
        """The scene with a design, (n_variables,), internal units."""
        return with_design(self.scene, self.paths, np.asarray(design, float))
