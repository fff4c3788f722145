"""A study: drive the design, keep every evaluation, verify the best, survive being killed.

The record of evaluations is the whole state of a study. Drivers are deterministic: a resumed study
starts its driver anew and answers from the record what was asked before, so that at most the
evaluation that was under way is repeated.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import multiprocessing
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

from jaxclamp import EquilibriumError, Progress, Result, SceneError, clamp, dump_scene
from jaxclamp.solve.linear_solvers import cores
from jaxclamp.solve.results import versions
from jaxclamp.trust.estimates import with_errors
from optimize.drivers import METHODS, Enough, Target
from optimize.journal import Journal
from optimize.problem import DesignProblem, Evaluation, evaluate, is_possible
from optimize.verification import Verification, verify

FEASIBLE = 1e-3
"""relative violation of a constraint that is still called feasible"""
FIRST_STEP = 0.1
"""first step of a driver, as part of the box of the bounds"""
KEPT_RESULTS = 3
"""solutions kept to start further designs from"""


@dataclasses.dataclass(frozen=True)
class Study:
    """What a study found."""

    problem: DesignProblem
    method: str
    evaluations: tuple[Evaluation, ...]
    stopped_because: str
    start: Result
    """the start design, solved from scratch"""
    best: Result
    """the best design, solved from scratch"""
    best_design: np.ndarray
    """internal units"""
    reference: Result | None
    """the clamp to compare with, solved from scratch"""
    verification: Verification | None
    seconds: float

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
        record = _Record(self.problem, self.method, list(self.evaluations))
        return record.to_dict(
            start=self.start.final | {"errors": self.start.errors},
            best=self.best.final | {"errors": self.best.errors},
            best_design=self.best_design,
            reference=None if self.reference is None else self.reference.final,
            reference_value=None
            if self.reference is None
            else self.reference.measure(self.problem.objective),
            stopped_because=self.stopped_because,
            verification=self.verification,
            seconds=self.seconds,
        )


@dataclasses.dataclass
class _Record:
    """The evaluations of a study, in order, and how they are written down."""

    problem: DesignProblem
    method: str
    evaluations: list[Evaluation]

    @property
    def fingerprint(self) -> str:
        """A word that changes with anything that the evaluations depend on."""
        p = self.problem
        parts = [dump_scene(p.scene), str(p.objective), self.method, repr(p.entries)]
        parts += [f"{c.measure} {c.lower} {c.upper}" for c in p.constraints]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]

    def best(self) -> Evaluation | None:
        """The feasible design of least objective; the least infeasible one if there is none."""
        solved = [e for e in self.evaluations if e.failure is None]
        rank = lambda e: (max(e.violation(self.problem), FEASIBLE), e.values[0])  # noqa: E731
        return min(solved, key=rank, default=None)

    def row(self, number: int, e: Evaluation) -> dict[str, Any]:
        """A row of iterations.csv: file units for the design, the measures' own for the rest."""
        solved = e.failure is None
        row: dict[str, Any] = {
            "evaluation": number,
            "start": e.start,
            "objective": e.values[0] if solved else "",
        }
        for constraint, value in zip(self.problem.constraints, e.values[1:], strict=True):
            row[f"{constraint.measure}"] = value if solved else ""
        row["violation"] = e.violation(self.problem) if solved else ""
        for entry, value in zip(self.problem.entries, e.design, strict=True):
            row[entry.name] = value / entry.factor
        return row | {"newton_iterations": e.newton_iterations, "failure": e.failure or ""}

    def rows(self) -> list[dict[str, Any]]:
        return [self.row(number + 1, e) for number, e in enumerate(self.evaluations)]

    def to_dict(self, **known: Any) -> dict[str, Any]:
        """The content of study.json as far as it is known."""
        p, best = self.problem, self.best()
        factors = np.array([entry.factor for entry in p.entries])
        in_file = lambda design: None if design is None else (design / factors).tolist()  # noqa: E731
        best_design = known.get("best_design", best.design if best else None)
        verification: Verification | None = known.get("verification")
        objective = f"{p.objective} [{p.objective.unit}]"

        def block(final: dict[str, Any] | None, evaluation: Evaluation | None) -> dict[str, Any] | None:
            value = None if evaluation is None or evaluation.failure else float(evaluation.values[0])
            return None if final is None else {"objective": value, **final}

        first = self.evaluations[0] if self.evaluations else None
        return {
            "title": p.scene.title,
            "objective": objective,
            "method": self.method,
            "fingerprint": self.fingerprint,
            "design": {
                "names": [entry.name for entry in p.entries],
                "units": [entry.unit for entry in p.entries],
                "lower": [entry.lower / entry.factor for entry in p.entries],
                "upper": [entry.upper / entry.factor for entry in p.entries],
                "start": in_file(p.start),
                "best": in_file(best_design),
            },
            "constraints": [
                {
                    "measure": str(c.measure),
                    "unit": c.measure.unit,
                    "lower": c.lower,
                    "upper": c.upper,
                    "best": None if best is None else float(best.values[1 + i]),
                }
                for i, c in enumerate(p.constraints)
            ],
            "start": block(known.get("start"), first),
            "best": block(known.get("best"), best),
            "reference": None
            if known.get("reference") is None
            else {"objective": known["reference_value"], **known["reference"]},
            "best_is_feasible": best is not None and best.violation(p) <= FEASIBLE,
            "evaluations": len(self.evaluations),
            "gradient_evaluations": sum(e.failure is None for e in self.evaluations),
            "iterations": [
                row
                | {
                    "design": e.design.tolist(),
                    "values": e.values.tolist(),
                    "gradients": e.gradients.tolist(),
                }
                for row, e in zip(self.rows(), self.evaluations, strict=True)
            ],
            "stopped_because": known.get("stopped_because"),
            "verified_on_finer_mesh": None if verification is None else verification.to_dict(),
            "cost": {"wall_s": known.get("seconds")},
            "versions": versions(),
        }

    def read(self, found: dict[str, Any]) -> None:
        """Take over the evaluations of a study.json. Raises SceneError if it is of another study."""
        if found.get("fingerprint") != self.fingerprint:
            raise SceneError("the study in that folder is another one: its scene, variables or method differ")
        for row in (row for row in found["iterations"] if row["start"] == 1):
            missing = lambda v: np.array(v, dtype=object).astype(float)  # noqa: E731  null is nan
            self.evaluations.append(
                Evaluation(
                    design=np.array(row["design"], float),
                    values=missing(row["values"]),
                    gradients=missing(row["gradients"]),
                    newton_iterations=row["newton_iterations"],
                    failure=row["failure"] or None,
                )
            )


class _Asker:
    """Answers a driver: from the record if it can, else by solving; writes everything down."""

    def __init__(
        self,
        record: _Record,
        journal: Journal | None,
        most: int,
        tell: Callable[[Progress], Any],
    ) -> None:
        self.record, self.journal, self.most, self.tell = record, journal, most, tell
        self.problem = record.problem
        self.lower, self.upper = self.problem.bounds
        self.known = {e.design.tobytes(): e for e in record.evaluations}
        self.near: list[tuple[np.ndarray, Result]] = []
        self.first: Result | None = None
        self.begun, self.solved = time.perf_counter(), 0
        self.last_good: Evaluation | None = None

    def at(self, t: np.ndarray) -> Evaluation:
        """The evaluation at a point of the unit box. Raises Enough, and EquilibriumError at the start."""
        design = self.lower + np.clip(np.asarray(t, float), 0.0, 1.0) * (self.upper - self.lower)
        found = self.known.get(design.tobytes())
        if found is None:
            if len(self.record.evaluations) >= self.most:
                raise Enough
            found = self.solve(design)
        if found.failure is None:
            self.last_good = found
        return found

    def solve(self, design: np.ndarray) -> Evaluation:
        distance = lambda kept: float(np.max(np.abs(kept[0] - design) / (self.upper - self.lower)))  # noqa: E731
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
        self.report(found)
        return found

    def report(self, found: Evaluation) -> None:
        count, unit = len(self.record.evaluations), self.problem.objective.unit
        left = (self.most - count) * (time.perf_counter() - self.begun) / self.solved
        best = self.record.best()
        if found.failure is not None:
            said = f"no equilibrium, backing off: {found.failure}"
        else:
            said = f"objective {found.values[0]:.5g} {unit}"
            if self.problem.constraints:
                said += f", constraints violated by {found.violation(self.problem):.1%}"
        if best is not None:
            said += f", best {best.values[0]:.5g}"
        self.tell(Progress("optimising", count / self.most, f"{said}, at most {left:.0f} s left"))

    # --- as a driver sees it ------------------------------------------------------------------------

    def target(self, tolerance: float) -> Target:
        p, width = self.problem, self.upper - self.lower
        start = np.clip((p.start - self.lower) / width, 0.0, 1.0)
        self.first_design = self.lower + start * width
        first = self.begin(start)
        size = abs(float(first.values[0])) or 1.0
        steepest = float(np.linalg.norm(first.gradients[0] * width)) / size
        # drivers begin with a step as long as the gradient: let it be a modest part of the box
        scale = size * max(steepest, 1e-6) / FIRST_STEP

        def objective(t: np.ndarray) -> tuple[float, np.ndarray]:
            found, good = self.at(t), self.last_good
            assert good is not None
            if found.failure is None:
                return float(found.values[0]) / scale, found.gradients[0] * width / scale
            # a wall around a design that has no equilibrium, rising from the last one that has
            back = np.asarray(t) - (good.design - self.lower) / width
            return float(good.values[0]) / scale + float(back @ back) + FIRST_STEP, 2.0 * back

        def margins(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            found = self.at(t)
            if found.failure is not None:
                assert self.last_good is not None
                found = self.last_good
            values, slopes = [], []
            for c, value, slope in zip(p.constraints, found.values[1:], found.gradients[1:], strict=True):
                for bound, sign in ((c.lower, 1.0), (c.upper, -1.0)):
                    if math.isfinite(bound):
                        values.append(sign * (value - bound) / c.scale)
                        slopes.append(sign * slope * width / c.scale)
            return np.array(values), np.array(slopes).reshape(len(values), width.size)

        n_margins = sum(math.isfinite(b) for c in p.constraints for b in (c.lower, c.upper))
        return Target(start, objective, margins, n_margins, tolerance * size / scale)

    def begin(self, start: np.ndarray) -> Evaluation:
        """The start design. Raises EquilibriumError if it has no equilibrium."""
        found = self.at(start)
        if found.failure is not None:
            clamp(self.problem.scene_at(found.design))  # raises, with what did converge
            raise SceneError(f"the start design has no equilibrium: {found.failure}")
        return found


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
    tolerance: relative change of the objective that no longer matters
    starts: designs to start from, the problem's own and others drawn between the bounds; the others run
        in processes of their own (a script that asks for them needs `if __name__ == "__main__":`)
    folder: where study.json and iterations.csv are kept up to date; with `resume`, continued there

    Raises SceneError for a problem that makes no sense, EquilibriumError if the start has no solution.
    """
    begun, tell = time.perf_counter(), progress or (lambda event: None)
    chosen = METHODS.get(method)
    if chosen is None:
        raise SceneError(f"method = '{method}': expected one of {', '.join(METHODS)}")
    if problem.constraints and not chosen.constrained:
        able = ", ".join(name for name, m in METHODS.items() if m.constrained)
        raise SceneError(f"method = '{method}' takes no constraints: expected one of {able}")
    record = _Record(problem, method, [])
    _ = problem.entries
    place = None if folder is None else Path(folder)
    budget = _Budget(method, max_evaluations, tolerance)
    journal = None if place is None else Journal(place, resume)
    try:
        if journal is not None and journal.found:
            record.read(journal.found)
        with _elsewhere(problem, budget, starts - 1, place, resume) as others:
            first, stopped = _drive(record, budget, journal, tell)
            if others:
                tell(Progress("optimising", 1.0, f"waiting for {len(others)} other starts"))
            for number, other in enumerate(others, 2):
                record.evaluations += [dataclasses.replace(e, start=number) for e in other.result()]
        study = _finish(record, first, stopped, tell, check_finer_mesh, begun)
        if journal is not None:
            journal.write(study.to_dict(), record.rows())
        return study
    finally:
        if journal is not None:
            journal.close()


@dataclasses.dataclass(frozen=True)
class _Budget:
    method: str
    max_evaluations: int
    tolerance: float


def _drive(
    record: _Record, budget: _Budget, journal: Journal | None, tell: Callable[[Progress], Any]
) -> tuple[Result | None, str]:
    """Let the driver work until it is content or the budget is spent; the first result, and why it ended."""
    asker = _Asker(record, journal, budget.max_evaluations, tell)
    try:
        stopped = METHODS[budget.method].drive(asker.target(budget.tolerance))
    except Enough:
        stopped = f"{budget.max_evaluations} evaluations"
    return asker.first, stopped


@contextmanager
def _elsewhere(
    problem: DesignProblem, budget: _Budget, count: int, folder: Path | None, resume: bool
) -> Iterator[list[Future[list[Evaluation]]]]:
    """Studies from other starts in processes of their own; ended with the block if it fails."""
    if count < 1:
        yield []
        return
    pool = ProcessPoolExecutor(min(count, cores()), mp_context=multiprocessing.get_context("spawn"))
    try:
        yield [
            pool.submit(
                _from_another_start,
                dataclasses.replace(problem, scene=problem.scene_at(design)),
                budget,
                None if folder is None else folder / f"start-{number}",
                resume,
            )
            for number, design in enumerate(other_starts(problem, count), 2)
        ]
    finally:
        pool.shutdown(cancel_futures=True)


def other_starts(problem: DesignProblem, count: int) -> list[np.ndarray]:
    """Designs spread over the box (a scrambled Sobol' sequence with a fixed seed) that make sense."""
    lower, upper = problem.bounds
    draws = scipy.stats.qmc.Sobol(lower.size, rng=np.random.default_rng(0))
    found: list[np.ndarray] = []
    for _ in range(MOST_DRAWS):
        for t in draws.random(8):
            # half way to the start: the box's corners are seldom sensible
            design = 0.5 * (problem.start + lower + t * (upper - lower))
            if is_possible(problem.scene_at(design)):
                found.append(design)
        if len(found) >= count:
            break
    return found[:count]


MOST_DRAWS = 64


def _from_another_start(
    problem: DesignProblem, budget: _Budget, folder: Path | None, resume: bool
) -> list[Evaluation]:
    """The evaluations of a study from another start; none if that has no equilibrium."""
    record = _Record(problem, budget.method, [])
    journal = None if folder is None else Journal(folder, resume)
    try:
        if journal is not None and journal.found:
            record.read(journal.found)
        _drive(record, budget, journal, lambda event: None)
    except (EquilibriumError, SceneError):
        return []
    finally:
        if journal is not None:
            journal.close()
    return record.evaluations


COLD_AGREES = 1e-4
"""relative difference of the objective between a warm and a cold solution of one design"""


def _finish(
    record: _Record,
    first: Result | None,
    stopped: str,
    tell: Callable[[Progress], Any],
    check_finer_mesh: bool,
    begun: float,
) -> Study:
    """Solve start and best from scratch, drop designs that a cold solution does not find, verify."""
    problem = record.problem
    tell(Progress("verifying", 0.0, "start and best from scratch"))
    start = first or clamp(problem.scene)
    with ThreadPoolExecutor(1) as pool:
        aside = None if problem.reference is None else pool.submit(clamp, problem.reference)
        best, result = _found_cold(record, start)
        try:
            reference = None if aside is None else aside.result()
        except EquilibriumError as error:  # the study stands without it
            reference = None
            tell(Progress("verifying", 0.2, f"no reference: {error}"))
    tell(Progress("verifying", 0.2, "how far the figures may be off"))
    start, result = with_errors(start), with_errors(result)
    verification = None
    if check_finer_mesh:
        tell(Progress("verifying", 0.3, "on a finer mesh, with stiffer and sharper contact"))
        compared = {} if reference is None else {"reference": reference}
        verification = verify(problem, {**compared, "start": start, "best": result})
    tell(Progress("verifying", 1.0, "" if verification is None else verification.sentence))
    return Study(
        problem=problem,
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


def _found_cold(record: _Record, start: Result) -> tuple[Evaluation, Result]:
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
