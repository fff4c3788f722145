"""Where designs start: the problem's own scene, and others drawn between the bounds.

Other starts are studies of their own, each in a process and a folder of its own.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

from jaxclamp import (
    EquilibriumError,
    Progress,
    Result,
    Scene,
    SceneError,
    WorkerLost,
    by_value,
    cores,
    require_memory_for,
    require_possible,
)
from optimize.drivers import METHODS, Enough
from optimize.evaluator import Evaluator
from optimize.journal import Journal
from optimize.problem import DesignProblem
from optimize.record import Evaluation, Record
from optimize.resuming import take_over

MOST_DRAWS = 64
"""rounds of eight draws in which other starts that make sense are looked for"""


Found = tuple[list[Evaluation], list[Progress]]
"""evaluations from another start, and what is to be told of the journal that they are partly from"""


@dataclasses.dataclass(frozen=True)
class Budget:
    """How a driver is to work, and how long."""

    method: str
    """a key of `optimize.drivers.METHODS`"""
    max_evaluations: int
    """on record, those of an earlier run among them"""
    tolerance: float
    """relative change of the objective that no longer matters"""


def drive(
    record: Record,
    budget: Budget,
    journal: Journal | None,
    tell: Callable[[Progress], Any],
    near: tuple[np.ndarray, Result] | None = None,
) -> tuple[Result | None, str]:
    """Let the driver work until it is content or the budget is spent; the record grows.

    near: a design and its solution to start from; None: the start is solved from scratch

    Returns the solution of the start design (None if that was on record) and why the driver ended.
    Raises EquilibriumError or SceneError if the start has no equilibrium, OSError from the journal.
    """
    evaluator = Evaluator(record, journal, budget.max_evaluations, tell, near)
    try:
        stopped = METHODS[budget.method].drive(evaluator.target(budget.tolerance))
    except Enough:
        stopped = f"{budget.max_evaluations} evaluations"
    return evaluator.first, stopped


def is_possible(scene: Scene) -> bool:
    """True unless a scene file with these values would be refused."""
    try:
        require_possible(scene)
    except SceneError:
        return False
    return True


def other_starts(problem: DesignProblem, count: int) -> list[np.ndarray]:
    """At most `count` designs (n_variables,) that make sense, spread over the box, internal units.

    A scrambled Sobol' sequence with a fixed seed: the same designs every time.
    """
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


def require_room(problem: DesignProblem, starts: int) -> None:
    """Raise TooLittleMemory if the processes of so many starts will not fit into memory at once."""
    require_memory_for(problem.scene, 1 + at_once(starts - 1))


def at_once(others: int) -> int:
    """Processes that work on so many other starts at a time."""
    return min(others, cores())


@contextmanager
def elsewhere(
    problem: DesignProblem, budget: Budget, count: int, folder: Path | None, resume: bool
) -> Iterator[list[Future[Found]]]:
    """Studies from `count` other starts in processes of their own; waited for if the block fails.

    folder: the journals are kept in its subfolders start-2, start-3 and so on; None: nowhere
    """
    if count < 1:
        yield []
        return
    pool = ProcessPoolExecutor(at_once(count), mp_context=multiprocessing.get_context("spawn"))
    try:
        yield [
            pool.submit(
                by_value(
                    from_another_start,
                    dataclasses.replace(problem, scene=problem.scene_at(design)),
                    budget,
                    None if folder is None else folder / f"start-{number}",
                    resume,
                ),
            )
            for number, design in enumerate(other_starts(problem, count), 2)
        ]
    finally:
        pool.shutdown(cancel_futures=True)


def answer(other: Future[Found]) -> Found:
    """What another start found. Raises WorkerLost if its process has ended."""
    try:
        return other.result()
    except BrokenExecutor:
        raise WorkerLost(
            "the process of another start has ended, perhaps for lack of memory: what it found is kept, "
            "continue with --resume"
        ) from None


def from_another_start(problem: DesignProblem, budget: Budget, folder: Path | None, resume: bool) -> Found:
    """The evaluations of a study of its own from the problem's scene; none if that has no equilibrium.

    Raises SceneError for a journal of another study or without a sound row, OSError if its folder cannot be
    written.
    """
    record = Record(problem, budget.method, [])
    told: list[Progress] = []
    journal = None if folder is None else Journal(folder, resume)
    try:
        take_over(record, journal, told.append)
        with suppress(EquilibriumError, SceneError):  # a start without equilibrium leaves nothing to keep
            drive(record, budget, journal, lambda event: None)
            return record.evaluations, told
        return [], told
    finally:
        if journal is not None:
            journal.close()
