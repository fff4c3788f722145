"""A design problem, and one evaluation of it: values, gradients, and what to do when it fails."""

from __future__ import annotations

import dataclasses
import math
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp import EquilibriumError, Result, Scene, SceneError, clamp
from jaxclamp.observe.measures import Measure
from jaxclamp.potential.model import Discretisation
from jaxclamp.scenes.files import require_possible
from jaxclamp.sensitivity.implicit import Unknowns, implicit, register, see, solution
from optimize.parameters import Entry, Variable, entries, resolve, with_design


@dataclasses.dataclass(frozen=True)
class Constraint:
    """lower <= measure <= upper, in internal units (mm, kPa, mN)."""

    measure: Measure
    lower: float = -math.inf
    upper: float = math.inf

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
    variables: tuple[Variable, ...]
    constraints: tuple[Constraint, ...] = ()
    reference: Scene | None = None
    """another clamp to compare with, such as the one in use"""

    @cached_property
    def entries(self) -> tuple[Entry, ...]:
        """The components of the design vector. Raises SceneError."""
        return entries(self.scene, tuple(self.variables))

    @cached_property
    def paths(self) -> tuple[str, ...]:
        return tuple(resolve(self.scene, variable.path)[0] for variable in self.variables)

    @property
    def measures(self) -> tuple[Measure, ...]:
        """The objective and what is constrained."""
        return (self.objective, *(constraint.measure for constraint in self.constraints))

    @property
    def start(self) -> np.ndarray:
        """The start design, internal units."""
        return np.array([entry.start for entry in self.entries])

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds, internal units."""
        return np.array([e.lower for e in self.entries]), np.array([e.upper for e in self.entries])

    def scene_at(self, design: np.ndarray) -> Scene:
        """The scene with a design, internal units."""
        return with_design(self.scene, self.paths, np.asarray(design, float))


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """What is known of one design."""

    design: np.ndarray
    values: np.ndarray
    """objective, then what is constrained; internal units"""
    gradients: np.ndarray
    """their derivatives, (n_measures, n_variables)"""
    newton_iterations: int
    start: int = 1
    """number of the start design it was reached from"""
    failure: str | None = None
    """why there is no equilibrium; values and gradients mean nothing then"""

    def violation(self, problem: DesignProblem) -> float:
        """Largest relative violation of a constraint."""
        pairs = zip(problem.constraints, self.values[1:], strict=True)
        return max((constraint.violation(float(value)) for constraint, value in pairs), default=0.0)


@partial(jax.jit, static_argnums=(0, 1))
def _values_and_gradients(
    measures: tuple[Measure, ...],
    paths: tuple[str, ...],
    design: Array,
    scene: Scene,
    parts: Discretisation,
    u: Unknowns,
    ticket: Array,
) -> tuple[Array, Array]:
    """All measures at a known solution, and their derivatives by the design."""

    def values(vector: Array) -> Array:
        changed = with_design(scene, paths, vector)
        seen = see(changed, parts, implicit(changed, parts, u, ticket))
        return jnp.stack([measure(seen) for measure in measures])

    value, pull = jax.vjp(values, design)
    return value, jax.vmap(lambda row: pull(row)[0])(jnp.eye(len(measures)))


def gradients(problem: DesignProblem, result: Result) -> tuple[np.ndarray, np.ndarray]:
    """Values of the measures at a result of the problem's scene, and their derivatives by the design.

    One adjoint solve per measure with the factors at hand, whatever the number of variables.
    """
    known = solution(result, to_stop=True)
    vector = _design_of(problem, result.scene)
    scene = jax.tree_util.tree_map(lambda leaf: np.asarray(leaf, float), result.scene)
    values, slopes = _values_and_gradients(
        problem.measures, problem.paths, vector, scene, result.model.discretisation, known.u, register(known)
    )
    return np.asarray(values), np.asarray(slopes)


def _design_of(problem: DesignProblem, scene: Scene) -> np.ndarray:
    parts: list[Any] = [np.ravel(np.asarray(resolve(scene, path)[1], float)) for path in problem.paths]
    return np.concatenate(parts)


def is_possible(scene: Scene) -> bool:
    """True unless a scene file with these values would be refused."""
    try:
        require_possible(scene)
    except SceneError:
        return False
    return True


def evaluate(
    problem: DesignProblem, design: np.ndarray, near: Result | None
) -> tuple[Evaluation, Result | None]:
    """Solve a design, from a neighbour's solution if there is one. A failure is an answer, no error."""
    design = np.asarray(design, float)
    scene = problem.scene_at(design)
    try:
        require_possible(scene)
        result = clamp(scene, guess=near)
    except (EquilibriumError, SceneError) as error:
        n = len(problem.measures)
        nothing = np.full(n, math.nan), np.full((n, design.size), math.nan)
        return Evaluation(design, *nothing, newton_iterations=0, failure=str(error)), None
    values, slopes = gradients(problem, result)
    return Evaluation(design, values, slopes, result.solver["newton_iterations"]), result
