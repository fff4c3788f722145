"""What two objectives cost each other: designs that are best in the one for a limit on the other.

The ends are the designs of least first and of least second objective. In between the first is minimised
under limits on the second, evenly spread between its values at the ends (epsilon-constraints). Every point
is a search of its own with its own journal, begun at the best design that the searches before it have met.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxclamp import (
    Estimate,
    Failure,
    Measure,
    Progress,
    Result,
    SceneError,
    clamp,
    own_parts,
    versions,
)
from optimize.gains import with_error
from optimize.journal import Journal
from optimize.named_measures import in_words
from optimize.problem import Constraint, DesignProblem, rounded
from optimize.record import FEASIBLE, Evaluation, Record
from optimize.resuming import asked_before, take_over
from optimize.starts import Budget, drive
from optimize.study import compare, found_cold, require_solvable, with_bounds

BEATEN, WITHIN = "beaten", "beaten within its error"


@dataclasses.dataclass(frozen=True)
class Point:
    """A design of the front."""

    folder: str
    """of its search"""
    limit: float | None
    """on the second objective, internal units; None at an end"""
    design: np.ndarray
    """(n_variables,), internal units"""
    violation: float
    """of the constraints, relative"""
    result: Result
    """solved from scratch"""
    evaluations: int
    """of its search"""
    stopped_because: str
    """the driver's own words, or that the budget was spent"""


@dataclasses.dataclass(frozen=True)
class Front:
    """What a study with two objectives found."""

    problem: DesignProblem
    """with the first objective"""
    second: Measure
    """the other objective"""
    points: tuple[Point, ...]
    """from the least first objective to the least second one"""
    estimates: dict[str, dict[Measure, Estimate]]
    """both objectives with their errors: of each point by its folder, of the start, of the reference"""
    seconds: float
    """wall time"""

    @property
    def objectives(self) -> tuple[Measure, Measure]:
        """Both."""
        return self.problem.objective, self.second

    def values(self, name: str) -> tuple[Estimate, Estimate]:
        """Both objectives of a point (by its folder), of the start or of the reference."""
        first, second = (self.estimates[name][m] for m in self.objectives)
        return first, second

    @property
    def others(self) -> list[str]:
        """The clamps beside the points: start and reference, as far as they have an equilibrium."""
        return [name for name in self.estimates if name in ("start", "reference")]

    def lines(self) -> list[str]:
        """What came of it, for a terminal."""
        first, second = (f"{in_words(m)} ({m.unit})" for m in self.objectives)
        said = [f"  {first}, {second}"]
        for name in self.estimates:
            a, b = (with_error(e.value, e.error, "") for e in self.values(name))
            said.append(f"    {name:<12}{a:<18}{b:<18}{self.standing(name)}".rstrip())
        return said

    @property
    def warning(self) -> str | None:
        """What a reader has to know; None if nothing."""
        bad = [point.folder for point in self.points if point.violation > FEASIBLE]
        return f"no design met the constraints of {', '.join(bad)}" if bad else None

    def standing(self, name: str) -> str:
        """`BEATEN` if another clamp is better in one objective and no worse in the other; blank if none is.

        `WITHIN` if each clamp that beats it does so by no more than the error of the difference.
        """
        leads = [
            [own - its for own, its in zip(self.values(name), self.values(other), strict=True)]
            for other in self.estimates
        ]
        beating = [lead for lead in leads if min(d.value for d in lead) >= 0.0 < max(d.value for d in lead)]
        if not beating:
            return ""
        return BEATEN if any(d.value > (d.error or 0.0) for lead in beating for d in lead) else WITHIN

    def rows(self) -> list[dict[str, Any]]:
        """The rows of iterations.csv: one for each point, file units for the design."""
        names = [str(m) for m in self.objectives]
        entries = self.problem.entries
        return [
            {"point": p.folder, **dict(zip(names, self._numbers(p.folder)["objectives"], strict=True))}
            | {f"error of {n}": e for n, e in zip(names, self._numbers(p.folder)["errors"], strict=True)}
            | {e.name: v / e.factor for e, v in zip(entries, p.design, strict=True)}
            for p in self.points
        ]

    def _numbers(self, name: str) -> dict[str, list[float | None]]:
        """Values and errors of both objectives, as in study.json."""
        found = self.values(name)
        return {"objectives": [e.value for e in found], "errors": [e.error for e in found]}

    def to_dict(self) -> dict[str, Any]:
        """The content of study.json."""
        factors = np.array([entry.factor for entry in self.problem.entries])
        return {
            "title": self.problem.scene.title,
            "objectives": [f"{m} [{m.unit}]" for m in self.objectives],
            "design": {
                "names": [entry.name for entry in self.problem.entries],
                "units": [entry.unit for entry in self.problem.entries],
            },
            "front": [
                {
                    "folder": p.folder,
                    "limit": p.limit,
                    **self._numbers(p.folder),
                    "design": (p.design / factors).tolist(),
                    "violation": p.violation,
                    "beaten": self.standing(p.folder) != "",
                    "beaten_within_error": self.standing(p.folder) == WITHIN,
                    "evaluations": p.evaluations,
                    "stopped_because": p.stopped_because,
                    "final": p.result.final,
                }
                for p in self.points
            ],
            **{name: self._numbers(name) for name in self.others},
            "cost": {"wall_s": self.seconds},
            "own_parts": own_parts(
                self.problem.scene, self.problem.reference, self.problem.measures, self.second
            ),
            "versions": versions(),
        }


def front(
    problem: DesignProblem,
    second: Measure,
    count: int,
    budget: Budget,
    folder: Path,
    resume: bool = False,
    progress: Callable[[Progress], Any] | None = None,
) -> Front:
    """The front of the problem's objective and a second measure, `count` points, at least the two ends.

    folder: every search keeps its journal in a subfolder, point-1 and so on; with `resume`, goes on there

    Raises SceneError for a problem that makes no sense, EquilibriumError if the start or the reference has no
    solution, OSError if the folder cannot be written.
    """
    begun, tell = time.perf_counter(), progress or (lambda event: None)
    require_solvable(limited(problem, second, None), budget.method)
    journal = Journal(folder, resume)
    try:
        if journal.found is not None and "front" not in journal.found:
            raise SceneError(f"{journal.path}: the study in that folder is another one, of one objective")
        bounded, reference = with_bounds(problem, tell)
        points = Searches(bounded, second, budget, folder, resume, tell).points(count)
        if reference is None and problem.reference is not None:
            reference = _clamped(problem.reference, "reference", tell)
        others = {"start": _clamped(problem.scene, "start", tell), "reference": reference}
        asked = {p.folder: p.result for p in points}
        asked |= {name: result for name, result in others.items() if result is not None}
        tell(Progress("errors", 0.0, "how far both objectives of each point may be off"))
        results, compared = compare(problem.objective, asked, (problem.objective, second))
        points = tuple(dataclasses.replace(p, result=results[p.folder]) for p in points)
        found = Front(problem, second, points, compared.estimates, time.perf_counter() - begun)
        journal.write(found.to_dict(), found.rows())
        return found
    finally:
        journal.close()


def _clamped(scene: Any, name: str, tell: Callable[[Progress], Any]) -> Result | None:
    """The scene's solution; None, said in one sentence, if it has none: the front stands without it."""
    try:
        return clamp(scene)
    except Failure as error:
        tell(Progress("errors", 0.0, f"no {name}: {error}"))
        return None


class Searches:
    """The searches of a front, each begun at the best design known by then."""

    def __init__(
        self,
        problem: DesignProblem,
        second: Measure,
        budget: Budget,
        folder: Path,
        resume: bool,
        tell: Callable[[Progress], Any],
    ) -> None:
        self.problem, self.second, self.budget, self.folder = problem, second, budget, folder
        self.resume, self.tell = resume, tell
        self.known: list[Evaluation] = []
        """of all searches; values: first and second objective, then what is constrained"""

    def points(self, count: int) -> tuple[Point, ...]:
        """From the least first objective to the least second one."""
        begin, end = self._point(1, None), self._point(count, None, swapped=True)
        first, last = (point.result.measure(self.second) for point in (begin, end))
        limits = [rounded(limit) for limit in np.linspace(first, last, count)[1:-1].tolist()]
        between = [self._point(number, limit) for number, limit in enumerate(limits, 2)]
        return (begin, *between, end)

    def _point(self, number: int, limit: float | None, swapped: bool = False) -> Point:
        """The best design in the first objective for a limit on the second; swapped: in the second."""
        name = f"point-{number}"
        objective = self.second if swapped else self.problem.objective
        self.tell(Progress(name, 0.0, f"minimising the {in_words(objective)}"))
        heard = lambda event: self.tell(dataclasses.replace(event, stage=name))  # noqa: E731
        journal = Journal(self.folder / name, self.resume)
        try:
            problem, near = self._begun(journal.found, limit, swapped)
            record = Record(problem, self.budget.method, [])
            take_over(record, journal, heard)
            _, stopped = drive(record, self.budget, journal, heard, near)
            best, result = found_cold(record, None)
            said = record.to_dict(best=result.final, best_design=best.design, stopped_because=stopped)
            journal.write(said, record.rows())
        finally:
            journal.close()
        self.tell(Progress(name, 1.0, stopped))
        self.known += [_swapped(e, swapped) for e in record.evaluations]
        cold = dataclasses.replace(best, values=np.array([result.measure(m) for m in problem.measures]))
        limit = problem.constraints[0].upper
        return Point(
            name,
            limit if math.isfinite(limit) else None,
            best.design,
            cold.violation(problem),
            result,
            len(record.evaluations),
            stopped,
        )

    def _begun(
        self, found: dict[str, Any] | None, limit: float | None, swapped: bool
    ) -> tuple[DesignProblem, tuple[np.ndarray, Result] | None]:
        """The problem of a point from its start on, and a design there with its solution from scratch.

        found: the journal of an earlier run, whose start and limit hold: those that follow from the other
        points may have other last digits by now, or be better with a greater budget
        """
        before = asked_before(found, self.problem.start.size)
        start, limit = (None, limit) if before is None else before
        problem = limited(self.problem, self.second, limit, swapped)
        if not self.known:
            return problem, None
        if start is not None:
            return problem.begun_at(start * [entry.factor for entry in problem.entries]), None
        known = Record(problem, self.budget.method, [_swapped(e, swapped) for e in self.known])
        best, result = found_cold(known, None)
        return problem.begun_at(best.design), (best.design, result)


def _swapped(e: Evaluation, swapped: bool) -> Evaluation:
    """An evaluation with its first two measures swapped, or as it is."""
    if not swapped:
        return e
    order = [1, 0, *range(2, len(e.values))]
    return dataclasses.replace(e, values=e.values[order], gradients=e.gradients[order])


def limited(
    problem: DesignProblem, second: Measure, limit: float | None, swapped: bool = False
) -> DesignProblem:
    """The problem with a limit on the second objective, which is measured in any case.

    swapped: the second objective is minimised, and the first one is measured
    """
    first, other = (second, problem.objective) if swapped else (problem.objective, second)
    limits = Constraint(other) if limit is None else Constraint(other, upper=limit)
    return dataclasses.replace(problem, objective=first, constraints=(limits, *problem.constraints))
