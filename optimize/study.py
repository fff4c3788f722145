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

from jaxclamp import (
    EquilibriumError,
    Failure,
    Measure,
    Neighbours,
    Progress,
    Result,
    SceneError,
    clamp,
    neighbours,
    with_errors,
)
from optimize.drivers import METHODS
from optimize.journal import Journal
from optimize.named_measures import in_words
from optimize.price import Compared, injuries
from optimize.problem import DesignProblem, require_consistent
from optimize.record import FEASIBLE, Evaluation, Record
from optimize.resuming import take_over
from optimize.starts import Budget, answer, drive, elsewhere, require_room
from optimize.verification import Verification, verify

COLD_AGREES = 1e-4
"""difference of the objective between a warm and a cold solution of one design, relative to its size"""


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
    compared: Compared
    """objective and injury measures of start, best and reference, with their errors"""
    verification: Verification | None
    """start, best and reference on a finer model; None if that was not asked for"""
    seconds: float
    """wall time"""

    def lines(self) -> list[str]:
        """What came of it, for a terminal."""
        p, compared = self.problem, self.compared
        named = {"start": self.start, "best": self.best}
        if self.reference is not None:
            named = {"reference": self.reference, **named}
        said = [f"  {self.stopped_because}, {len(self.evaluations)} designs", ""]
        for name, result in named.items():
            peaks = ", ".join(f"{k} {v:.4g}" for k, v in result.final["peak_axial_stress_kPa"].items())
            said.append(
                f"    {name:<10}{in_words(p.objective)} {compared.value(name)}; true peaks {peaks} kPa"
            )
        said += ["", *(f"    {sentence}" for sentence in self.sentences)]
        said += ["", "    best design"]
        for entry, value in zip(p.entries, self.best_design, strict=True):
            said.append(f"      {entry.name:<32}{value / entry.factor:>10.4g}")
        return said if self.verification is None else [*said, "", f"    {self.verification.sentence}"]

    @property
    def sentences(self) -> list[str]:
        """The gain with the error of the difference, and its price."""
        found = {name: self.compared.gain(name) for name in ("reference", "start")}
        said = [f"best against {name}: {gain}" for name, gain in found.items() if gain is not None]
        if (off := self.evaluations[0].violation(self.problem)) > FEASIBLE:
            said.append(f"the start violates the constraints by {off:.1%}")
        return [*said, self.compared.sentence]

    def to_dict(self) -> dict[str, Any]:
        """The content of study.json."""
        objective, reference = self.problem.objective, self.reference
        return (
            Record(self.problem, self.method, list(self.evaluations)).to_dict(
                start=self.start.final | {"errors": self.start.errors},
                best=self.best.final | {"errors": self.best.errors},
                best_design=self.best_design,
                reference=None
                if reference is None
                else {
                    "objective": reference.measure(objective),
                    **reference.final,
                    "errors": reference.errors,
                },
                stopped_because=self.stopped_because,
                verification=None if self.verification is None else self.verification.to_dict(),
                seconds=self.seconds,
            )
            | self.compared.to_dict()
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
    TooLittleMemory if the starts that are solved at once do not fit, OSError if the folder cannot be written.
    """
    begun, tell = time.perf_counter(), progress or (lambda event: None)
    require_solvable(problem, method)
    require_room(problem, starts)
    problem, reference = with_bounds(problem, tell)
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
                found, told = answer(other)
                for event in told:
                    tell(event)
                record.evaluations += [dataclasses.replace(e, start=number) for e in found]
        study = finish(record, first, reference, stopped, tell, check_finer_mesh, begun)
        if journal is not None:
            journal.write(study.to_dict(), record.rows())
        return study
    finally:
        if journal is not None:
            journal.close()


def require_solvable(problem: DesignProblem, method: str) -> None:
    """Raise SceneError for variables that make no sense or a method that cannot solve the problem."""
    chosen = METHODS.get(method)
    if chosen is None:
        raise SceneError(f"method = '{method}': expected one of {', '.join(METHODS)}")
    require_consistent(problem)
    if (problem.constraints or problem.rises.size) and not chosen.constrained:
        able = ", ".join(name for name, m in METHODS.items() if m.constrained)
        raise SceneError(f"method = '{method}' takes no constraints: expected one of {able}")


def with_bounds(
    problem: DesignProblem, tell: Callable[[Progress], Any]
) -> tuple[DesignProblem, Result | None]:
    """The problem with every bound a number, and the reference's solution if that took one.

    Raises EquilibriumError if the reference has no solution, SceneError if the bounds contradict each other.
    """
    if not problem.is_relative or problem.reference is None:
        return problem, None
    tell(Progress("optimising", 0.0, "the reference, which bounds are relative to"))
    reference = clamp(problem.reference)
    problem = problem.against(reference)
    require_consistent(problem)
    return problem, reference


def finish(
    record: Record,
    first: Result | None,
    reference: Result | None,
    stopped: str,
    tell: Callable[[Progress], Any],
    check_finer_mesh: bool,
    begun: float,
) -> Study:
    """Solve start and best from scratch, drop designs that a cold solution does not find, verify.

    first, reference: the solutions of the start design and of the reference from scratch, if they are at
    hand; stopped: why the driver ended; begun: when the study began, by `time.perf_counter`

    Raises EquilibriumError if the start has no solution.
    """
    tell(Progress("verifying", 0.0, "start and best from scratch"))
    start = first or clamp(record.problem.scene)
    best, result, reference = solved_cold(record, start, reference, tell)
    tell(Progress("verifying", 0.2, "how far the figures and their differences may be off"))
    asked = {} if reference is None else {"reference": reference}
    asked |= {"start": start, "best": result}
    measures = compared_measures(record.problem)
    results, compared = compare(record.problem.objective, asked, measures)
    verification = None
    if check_finer_mesh:
        tell(Progress("verifying", 0.3, "on a finer mesh, with stiffer and sharper contact"))
        verification = verify(record.problem, results, measures, compared)
    tell(Progress("verifying", 1.0, "" if verification is None else verification.sentence))
    return Study(
        problem=record.problem,
        method=record.method,
        evaluations=tuple(record.evaluations),
        stopped_because=stopped,
        start=results["start"],
        best=results["best"],
        best_design=best.design,
        reference=results.get("reference"),
        compared=compared,
        verification=verification,
        seconds=time.perf_counter() - begun,
    )


def compared_measures(problem: DesignProblem) -> tuple[Measure, ...]:
    """The objective and every injury measure of the problem's artery."""
    layers = tuple(layer.name for layer in problem.scene.artery.layers)
    return tuple(dict.fromkeys((problem.objective, *injuries(layers))))


def compare(
    objective: Measure, results: dict[str, Result], measures: tuple[Measure, ...]
) -> tuple[dict[str, Result], Compared]:
    """The results with the errors of their figures, and their measures with theirs."""
    found, estimates = {}, {}
    known: dict[int, Neighbours] = {}
    for name, result in results.items():
        near = known[id(result)] = known.get(id(result)) or neighbours(result)  # the start may be the best
        found[name], estimates[name] = with_errors(result, near), near.estimates(measures)
    return found, Compared(objective, estimates)


def solved_cold(
    record: Record, start: Result, known: Result | None, tell: Callable[[Progress], Any]
) -> tuple[Evaluation, Result, Result | None]:
    """The best evaluation, its solution from scratch, and that of the reference, solved aside."""
    reference = record.problem.reference if known is None else None
    with ThreadPoolExecutor(1) as pool:
        aside = None if reference is None else pool.submit(clamp, reference)
        best, result = found_cold(record, start)
        try:
            return best, result, known if aside is None else aside.result()
        except Failure as error:  # the study stands without it
            tell(Progress("verifying", 0.2, f"no reference: {error}"))
            return best, result, None


def found_cold(record: Record, start: Result | None) -> tuple[Evaluation, Result]:
    """The best evaluation whose state a cold solution finds again, and that solution.

    Evaluations that are not found again are marked as failed. start: the solution of the first evaluation, if
    it is at hand. Raises EquilibriumError if nothing else is left and that has none.
    """
    problem = record.problem
    first = record.evaluations[0]
    while (best := record.best()) is not None and best is not first:
        reason = "a solution from scratch does not find this state"
        try:
            result = clamp(problem.scene_at(best.design))
            value = result.measure(problem.objective)
            if agrees(value, float(best.values[0]), float(first.values[0])):
                return best, result
        except EquilibriumError as error:
            reason = f"{reason}: {error}"
        place = next(i for i, e in enumerate(record.evaluations) if e is best)
        record.evaluations[place] = dataclasses.replace(best, failure=reason)
    assert best is not None
    return best, start or clamp(problem.scene)


def agrees(cold: float, warm: float, start: float) -> bool:
    """True if a cold and a warm solution of a design have the same objective.

    What counts as the same is relative to the objective's size there or at the start, whichever is
    greater: the objective itself may be zero.
    """
    return abs(cold - warm) <= COLD_AGREES * (max(abs(warm), abs(start)) or 1.0)
