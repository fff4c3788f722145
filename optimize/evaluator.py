"""Evaluate designs: one by itself, or one after another as a driver asks for them.

A driver sees a smooth function over the unit box. Behind it the `Evaluator` solves designs, each from
the nearest solution at hand, answers from the record what was asked before, and puts a wall around
designs that have no equilibrium.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from jaxclamp import EquilibriumError, Progress, Result, SceneError, clamp, require_possible
from jaxclamp import gradients as gradients_at
from optimize.drivers import Enough, Target
from optimize.journal import Journal
from optimize.problem import DesignProblem
from optimize.record import Evaluation, Record

FIRST_STEP = 0.1
"""first step of a driver, as part of the box of the bounds"""
KEPT_RESULTS = 3
"""solutions kept to start further designs from"""


def gradients(problem: DesignProblem, result: Result) -> tuple[np.ndarray, np.ndarray]:
    """Values of the problem's measures at a result of its scene, and their derivatives by the design.

    (n_measures,) and (n_measures, n_variables), internal units; see `jaxclamp.gradients`.
    Raises EquilibriumError if the stop was not reached.
    """
    return gradients_at(result, problem.measures, problem.paths)


def evaluate(
    problem: DesignProblem, design: np.ndarray, near: Result | None
) -> tuple[Evaluation, Result | None]:
    """Solve a design (n_variables,), internal units, from a neighbour's solution if there is one.

    A design that is impossible or has no equilibrium is an answer, no error: an `Evaluation` with its
    `failure`, and no result.
    """
    design = np.asarray(design, float)
    try:
        scene = problem.scene_at(design)
        require_possible(scene)
        result = clamp(scene, guess=near)
    except (EquilibriumError, SceneError) as error:
        n = len(problem.measures)
        nothing = np.full(n, math.nan), np.full((n, design.size), math.nan)
        return Evaluation(design, *nothing, newton_iterations=0, failure=str(error)), None
    values, slopes = gradients(problem, result)
    return Evaluation(design, values, slopes, result.solver["newton_iterations"]), result


class Evaluator:
    """Answers a driver: from the record if it can, else by solving; writes everything down.

    record: what is known already; it grows
    journal: where the record is kept on disk; None: nowhere
    most: evaluations on record at which it is `Enough`
    tell: hears of every evaluation
    near: a design and its solution to start from, if there is one at hand
    """

    def __init__(
        self,
        record: Record,
        journal: Journal | None,
        most: int,
        tell: Callable[[Progress], Any],
        near: tuple[np.ndarray, Result] | None = None,
    ) -> None:
        self.record, self.journal, self.most, self.tell = record, journal, most, tell
        self.problem = record.problem
        self.lower, self.upper = self.problem.bounds
        self.width = self.upper - self.lower
        self.known = {e.design.tobytes(): e for e in record.evaluations}
        self.near: list[tuple[np.ndarray, Result]] = [] if near is None else [near]
        """the designs solved last, and their solutions"""
        self.first: Result | None = None
        """the solution of the very first design, if that was not on record"""
        self.begun, self.solved = time.perf_counter(), 0
        self.last_good: Evaluation | None = None
        """the last answer that had an equilibrium"""

    def at(self, t: np.ndarray) -> Evaluation:
        """The evaluation at a point of the unit box, (n_variables,). Raises Enough, OSError."""
        design = self.lower + np.clip(np.asarray(t, float), 0.0, 1.0) * self.width
        found = self.known.get(design.tobytes())
        if found is None:
            if len(self.record.evaluations) >= self.most:
                raise Enough
            found = self._solve(design)
        if found.failure is None:
            self.last_good = found
        return found

    def target(self, tolerance: float) -> Target:
        """What a driver sees, scaled so that its first step is a modest part of the box.

        tolerance: relative change of the objective that no longer matters. Raises Enough if not even the
        start may be solved, EquilibriumError or SceneError if it has no equilibrium.
        """
        start = np.clip((self.problem.start - self.lower) / self.width, 0.0, 1.0)
        first = self._begin(start)
        size = abs(float(first.values[0])) or 1.0
        steepest = float(np.linalg.norm(first.gradients[0] * self.width)) / size
        # drivers begin with a step as long as the gradient
        scale = size * max(steepest, 1e-6) / FIRST_STEP
        return Target(
            start=start,
            objective=partial(self._objective, scale),
            margins=self._margins,
            n_margins=len(self.problem.rises) + sum(len(c.sides) for c in self.problem.constraints),
            tolerance=tolerance * size / scale,
        )

    def _begin(self, start: np.ndarray) -> Evaluation:
        """The start design. Raises EquilibriumError if it has no equilibrium."""
        found = self.at(start)
        if found.failure is not None:
            clamp(self.problem.scene_at(found.design))  # raises, with what did converge
            raise SceneError(f"the start design has no equilibrium: {found.failure}")
        return found

    def _objective(self, scale: float, t: np.ndarray) -> tuple[float, np.ndarray]:
        """The objective over its scale, and its derivatives by t."""
        found, good = self.at(t), self._good()
        if found.failure is None:
            return float(found.values[0]) / scale, found.gradients[0] * self.width / scale
        # a wall around a design that has no equilibrium, rising from the last one that has
        back = np.asarray(t) - (good.design - self.lower) / self.width
        return float(good.values[0]) / scale + float(back @ back) + FIRST_STEP, 2.0 * back

    def _margins(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the constraints leave, relative to their bounds, and its derivatives by t."""
        problem, found = self.problem, self.at(t)
        if found.failure is not None:
            found = self._good()
        # linear in the design: known even where there is no equilibrium
        design = self.lower + np.clip(np.asarray(t, float), 0.0, 1.0) * self.width
        values = list(problem.climbs(design))
        eye = np.eye(self.width.size)
        slopes = [eye[b] - eye[a] * self.width[a] / self.width[b] for a, b in problem.rises]
        rows = zip(problem.constraints, found.values[1:], found.gradients[1:], strict=True)
        for c, value, slope in rows:
            for bound, sign in c.sides:
                values.append(sign * (value - bound) / c.scale)
                slopes.append(sign * slope * self.width / c.scale)
        return np.array(values), np.array(slopes).reshape(len(values), self.width.size)

    def _good(self) -> Evaluation:
        """The last answer that had an equilibrium: the start's at least."""
        assert self.last_good is not None
        return self.last_good

    def _solve(self, design: np.ndarray) -> Evaluation:
        """Evaluate a new design and write it down."""
        if not self.solved:
            done = len(self.record.evaluations)
            self.tell(Progress("optimising", done / self.most, f"design {done + 1}, with compilation"))
        distance = lambda kept: float(np.max(np.abs(kept[0] - design) / self.width))  # noqa: E731
        # a tie, or nearly one, goes to the result solved last: the factors at hand are its own
        nearest = min(reversed(self.near), key=distance, default=None)
        found, result = evaluate(self.problem, design, None if nearest is None else nearest[1])
        if result is not None:
            self.first = result if self.first is None and not self.record.evaluations else self.first
            self.near = [*self.near[1 - KEPT_RESULTS :], (design, result)]
        self.known[design.tobytes()] = found
        self.record.evaluations.append(found)
        self.solved += 1
        if self.journal is not None:
            self.journal.write(self.record.to_dict(), self.record.rows())
        self._report(found)
        return found

    def _report(self, found: Evaluation) -> None:
        """Tell of an evaluation, of the best so far, and of the time that may be left."""
        count, unit = len(self.record.evaluations), self.problem.objective.unit
        left = (self.most - count) * (time.perf_counter() - self.begun) / self.solved
        best = self.record.best()
        if found.failure is not None:
            said = f"no equilibrium, backing off: {found.failure}"
        else:
            said = f"objective {found.values[0]:.5g} {unit}"
            if self.problem.constraints or self.problem.rises.size:
                said += f", constraints violated by {found.violation(self.problem):.1%}"
        if best is not None:
            said += f", best {best.values[0]:.5g}"
        self.tell(Progress("optimising", count / self.most, f"{said}, at most {left:.0f} s left"))
