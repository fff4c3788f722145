"""A design problem: what may change, what is minimised, and what must hold.

A bound may be relative to the reference clamp. It becomes a number once that clamp is solved (`against`).
"""

from __future__ import annotations

import dataclasses
import math
from functools import cached_property

import numpy as np

from jaxclamp import Measure, Result, Scene, SceneError
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
    relative: bool = False
    """True: the bounds are multiples of the reference clamp's value"""
    reference: float | None = None
    """the reference clamp's value, of bounds that were multiples of it"""

    @property
    def sides(self) -> tuple[tuple[float, float], ...]:
        """The finite bounds, each with the sign of its margin: sign (value - bound) >= 0."""
        found = ((self.lower, 1.0), (self.upper, -1.0))
        return tuple((bound, sign) for bound, sign in found if math.isfinite(bound))

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

    @cached_property
    def rises(self) -> np.ndarray:
        """Pairs of components of the design of which the second is at least the first, (n_pairs, 2)."""
        rising = {describe(self.scene, v.path).key for v in self.variables if v.rising}
        names = [entry.name.rpartition("[") for entry in self.entries]
        pairs = [(i - 1, i) for i in range(1, len(names)) if names[i][0] in rising]
        return np.array([p for p in pairs if names[p[0]][0] == names[p[1]][0]], int).reshape(-1, 2)

    def climbs(self, design: np.ndarray) -> np.ndarray:
        """How far each pair of `rises` rises, relative to the bounds' distance, (n_pairs,)."""
        lower, upper = self.bounds
        first, second = self.rises.T
        return (design[second] - design[first]) / (upper - lower)[second]

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

    def begun_at(self, design: np.ndarray) -> DesignProblem:
        """The problem with another start, (n_variables,), internal units.

        It is rounded to `DIGITS` in the units of the scene file, so that a journal says all of it.
        """
        factors = np.array([entry.factor for entry in self.entries])
        start = np.array([rounded(value) for value in design / factors]) * factors
        return dataclasses.replace(self, scene=self.scene_at(np.clip(start, *self.bounds)))

    @property
    def is_relative(self) -> bool:
        """True if a bound is relative to the reference, so that this has to be solved first."""
        return any(constraint.relative for constraint in self.constraints)

    def against(self, reference: Result) -> DesignProblem:
        """The problem with bounds in numbers, from the reference clamp's solution.

        They are rounded to `DIGITS`, so that a study that is resumed asks the same.
        """
        return dataclasses.replace(
            self, constraints=tuple(_absolute(constraint, reference) for constraint in self.constraints)
        )


DIGITS = 6
"""of a bound or a start that is taken from a solution"""


def rounded(value: float) -> float:
    """The value with `DIGITS` digits."""
    return float(f"{value:.{DIGITS}g}")


def _absolute(c: Constraint, reference: Result) -> Constraint:
    """The constraint with its bounds in internal units."""
    if not c.relative:
        return c
    value = reference.measure(c.measure)
    bound = lambda side: rounded(side * value) if math.isfinite(side) else side  # noqa: E731
    return Constraint(c.measure, bound(c.lower), bound(c.upper), reference=value)


def require_consistent(problem: DesignProblem) -> None:
    """Raise SceneError for variables that make no sense, and for constraints that no design can meet."""
    _ = problem.entries, problem.rises
    if problem.is_relative and problem.reference is None:
        raise SceneError("a constraint is relative to the reference, but the study has no reference clamp")
    found: dict[tuple[Measure, bool], tuple[float, float]] = {}
    for c in problem.constraints:
        key = c.measure, c.relative
        lower, upper = found.get(key, (-math.inf, math.inf))
        found[key] = lower, upper = max(lower, c.lower), min(upper, c.upper)
        if not (lower <= upper and c.lower <= c.upper):
            unit = " times the reference's" if c.relative else f" {c.measure.unit}".rstrip()
            raise SceneError(
                f"the constraints on {c.measure} contradict each other: "
                f"no value is at least {lower:g}{unit} and at most {upper:g}{unit}"
            )
