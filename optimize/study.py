"""A study: drive the design, keep every evaluation, verify the best, survive being killed.

The record of evaluations is the whole state of a study. Drivers are deterministic: a resumed study
starts its driver anew and answers from the record what was asked before, so that at most the
evaluation that was under way is repeated.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from jaxclamp import EquilibriumError, Progress, Result, SceneError, clamp, with_errors
from optimize.drivers import METHODS
from optimize.journal import Journal
from optimize.problem import DesignProblem
from optimize.record import Evaluation, Record
from optimize.resuming import take_over
from optimize.starts import Budget, answer, drive, elsewhere
from optimize.verification import Verification, verify

COLD_AGREES = 1e-4
"""relative difference of the objective between a warm and a cold solution of one design"""


@dataclasses.dataclass(frozen=True)
class Study:
    """What a study found."""

    problem: DesignProblem
    """what was studied"""
    method: str
    """a key of `optimize.drivers.METHODS`"""
    evaluations: tuple[Evaluation, ...]
    """of all starts, in order"""
    stopped_because: str
    """the driver's own words, or that the budget was spent"""
    start: Result
    """the start design, solved from scratch"""
    best: Result
    """the best design, solved from scratch"""
    best_design: np.ndarray
    """(n_variables,), internal units"""
    reference: Result | None
    """the clamp to compare with, solved from scratch"""
    verification: Verification | None
    """start, best and reference on a finer model; None if that was not asked for"""
    seconds: float
    """wall time"""

    def lines(self) -> list[str]:
        """What came of it, for a terminal."""
        p = self.problem
        named = {"start": self.start, "best": self.best}
        if self.reference is not None:
            named = {"reference": self.reference, **named}
        said = [f"  {self.stopped_because}, {len(self.evaluations)} designs", ""]
        for name, result in named.items():
            peaks = ", ".join(f"{k} {v:.4g}" for k, v in result.final["peak_axial_stress_kPa"].items())
            value = f"{result.measure(p.objective):.5g} {p.objective.unit}"
            said.append(f"    {name:<10}{p.objective} = {value}; true peaks {peaks} kPa")
        said += ["", "    best design"]
        for entry, value in zip(p.entries, self.best_design, strict=True):
            said.append(f"      {entry.name:<32}{value / entry.factor:>10.4g}")
        return said if self.verification is None else [*said, "", f"    {self.verification.sentence}"]

    def to_dict(self) -> dict[str, Any]:
        """The content of study.json."""
        objective, reference = self.problem.objective, self.reference
        return Record(self.problem, self.method, list(self.evaluations)).to_dict(
            start=self.start.final | {"errors": self.start.errors},
            best=self.best.final | {"errors": self.best.errors},
            best_design=self.best_design,
            reference=None
            if reference is None
            else {"objective": reference.measure(objective), **reference.final},
            stopped_because=self.stopped_because,
            verification=None if self.verification is None else self.verification.to_dict(),
            seconds=self.seconds,
        )


def minimise(
    problem: DesignProblem,
    *,
    method: str = "slsqp",
    max_evaluations: int = 40,
    tolerance: float = 1e-4,
    folder: str | Path | None = None,
    resume: bool = False,
    progress: Callable[[Progress], Any] | None = None,
    starts: int = 1,
    check_finer_mesh: bool = True,
) -> Study:
    """Find the design of least objective from the problem's scene on.

    method: "slsqp" or "mma" (with constraints), "l-bfgs-b" or "adam" (bounds only)
    max_evaluations: designs that are solved from each start, at most
    tolerance: relative change of the objective that no longer matters
    folder: where study.json and iterations.csv are kept up to date; with `resume`, continued there
    progress: hears of every evaluation
    starts: designs to start from, the problem's own and others drawn between the bounds; the others run
        in processes of their own (a script that asks for them needs `if __name__ == "__main__":`)
    check_finer_mesh: solve start and best on a finer mesh with stiffer and sharper contact, too

    Raises SceneError for a problem that makes no sense, EquilibriumError if the start has no solution,
    OSError if the folder cannot be written.
    """
    begun, tell = time.perf_counter(), progress or (lambda event: None)
    _check(problem, method)
    record = Record(problem, method, [])
    place = None if folder is None else Path(folder)
    budget = Budget(method, max_evaluations, tolerance)
    journal = None if place is None else Journal(place, resume)
    try:
        take_over(record, journal, tell)
        with elsewhere(problem, budget, starts - 1, place, resume) as others:
            first, stopped = drive(record, budget, journal, tell)
            if others:
                tell(Progress("optimising", 1.0, f"waiting for {len(others)} other starts"))
            for number, other in enumerate(others, 2):
                record.evaluations += [dataclasses.replace(e, start=number) for e in answer(other)]
        study = finish(record, first, stopped, tell, check_finer_mesh, begun)
        if journal is not None:
            journal.write(study.to_dict(), record.rows())
        return study
    finally:
        if journal is not None:
            journal.close()


def _check(problem: DesignProblem, method: str) -> None:
    """Raise SceneError for variables that make no sense or a method that cannot solve the problem."""
    chosen = METHODS.get(method)
    if chosen is None:
        raise SceneError(f"method = '{method}': expected one of {', '.join(METHODS)}")
    if problem.constraints and not chosen.constrained:
        able = ", ".join(name for name, m in METHODS.items() if m.constrained)
        raise SceneError(f"method = '{method}' takes no constraints: expected one of {able}")
    _ = problem.entries


def finish(
    record: Record,
    first: Result | None,
    stopped: str,
    tell: Callable[[Progress], Any],
    check_finer_mesh: bool,
    begun: float,
) -> Study:
    """Solve start and best from scratch, drop designs that a cold solution does not find, verify.

    first: the solution of the start design from scratch, if it is at hand; stopped: why the driver ended;
    begun: when the study began, by `time.perf_counter`

    Raises EquilibriumError if the start has no solution.
    """
    tell(Progress("verifying", 0.0, "start and best from scratch"))
    start = first or clamp(record.problem.scene)
    best, result, reference = _solved_cold(record, start, tell)
    tell(Progress("verifying", 0.2, "how far the figures may be off"))
    start, result = with_errors(start), with_errors(result)
    verification = None
    if check_finer_mesh:
        tell(Progress("verifying", 0.3, "on a finer mesh, with stiffer and sharper contact"))
        compared = {} if reference is None else {"reference": reference}
        verification = verify(record.problem, {**compared, "start": start, "best": result})
    tell(Progress("verifying", 1.0, "" if verification is None else verification.sentence))
    return Study(
        problem=record.problem,
        method=record.method,
        evaluations=tuple(record.evaluations),
        stopped_because=stopped,
        start=start,
        best=result,
        best_design=best.design,
        reference=reference,
        verification=verification,
        seconds=time.perf_counter() - begun,
    )


def _solved_cold(
    record: Record, start: Result, tell: Callable[[Progress], Any]
) -> tuple[Evaluation, Result, Result | None]:
    """The best evaluation, its solution from scratch, and that of the reference, solved aside."""
    reference = record.problem.reference
    with ThreadPoolExecutor(1) as pool:
        aside = None if reference is None else pool.submit(clamp, reference)
        best, result = _found_cold(record, start)
        try:
            return best, result, None if aside is None else aside.result()
        except EquilibriumError as error:  # the study stands without it
            tell(Progress("verifying", 0.2, f"no reference: {error}"))
            return best, result, None


def _found_cold(record: Record, start: Result) -> tuple[Evaluation, Result]:
    """The best evaluation whose state a cold solution finds again, and that solution.

    Evaluations that are not found again are marked as failed.
    """
    problem = record.problem
    while (best := record.best()) is not None and best is not record.evaluations[0]:
        reason = "a solution from scratch does not find this state"
        try:
            result = clamp(problem.scene_at(best.design))
            value = result.measure(problem.objective)
            if abs(value - best.values[0]) <= COLD_AGREES * abs(best.values[0]):
                return best, result
        except EquilibriumError as error:
            reason = f"{reason}: {error}"
        place = next(i for i, e in enumerate(record.evaluations) if e is best)
        record.evaluations[place] = dataclasses.replace(best, failure=reason)
    assert best is not None
    return best, start
