"""Go on from the study.json of an earlier run, which may be damaged or of another version.

Nothing that stands in it is trusted before it was looked at. The study goes on with the rows before the
first damaged one, and says so; if there is none, it ends as a `SceneError`, one sentence with the file, what
is wrong and what to do.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxclamp import Progress, SceneError, versions
from jaxclamp.scenes.wording import shortened
from optimize.journal import Journal
from optimize.numbers import finite
from optimize.record import Evaluation, Record

TOLD = ("jaxclamp", "jax", "numpy")
"""whose other versions a resumed study tells of"""
WAY_OUT = "move the file away or take another folder"
START_AGREES = 1e-9
"""difference of a design from the start, relative to the bounds' distance, that is rounding"""


class _Damaged(Exception):
    """What is wrong with a row."""


def take_over(record: Record, journal: Journal | None, tell: Callable[[Progress], Any]) -> None:
    """Add the evaluations that a journal holds and that were reached from the problem's own start.

    tell: hears, once each, that rows are damaged and that the journal was made by other versions. A damaged
    file is copied before it is brought back to its sound rows. Raises SceneError for a journal of another
    study or without a sound row, OSError if the folder cannot be written.
    """
    if journal is None or journal.found is None:
        return
    found, path = journal.found, journal.path
    if not isinstance(found.get("fingerprint"), str):
        raise SceneError(f"{path}: damaged, its fingerprint is missing or is no text; {WAY_OUT}")
    if found["fingerprint"] != record.fingerprint:
        raise SceneError(
            f"{path}: the study in that folder is another one: scene, variables, own parts or method differ"
        )
    own, wrong = _evaluations(found.get("iterations"), record, path)
    record.evaluations += own
    if wrong is not None:
        copy = journal.keep_copy()
        journal.write(record.to_dict(), record.rows())
        going_on = f"going on with the rows before it, the damaged file is kept as {copy.name}"
        tell(Progress("optimising", 0.0, f"{path}: {wrong}; {going_on}"))
    said = other_versions(found.get("versions"))
    if said is not None:
        tell(Progress("optimising", 0.0, f"the study in {journal.folder} was {said}"))


def asked_before(found: Any, n_variables: int) -> tuple[np.ndarray, float | None] | None:
    """Start design (n_variables,), file units, and upper bound of the first constraint of an earlier run.

    found: the content of its journal. The bound is None if it is infinite.

    Returns None if one of them is not there.
    """
    try:
        start = _numbers(found["design"]["start"], "start", n_variables, True)
        return start, finite(found["constraints"][0]["upper"])
    except (_Damaged, LookupError, TypeError):
        return None


def other_versions(found: Any) -> str | None:
    """What to say of a study made by these versions; None if they are those of this process.

    found: name -> version, as far as it is what it should be
    """
    made = found if isinstance(found, dict) else {}
    this = versions()
    differ = [name for name in TOLD if made.get(name) != this[name]]
    if not differ:
        return None
    by = ", ".join(f"{name} {_version(made.get(name))}" for name in differ)
    return f"made by {by}; this is {', '.join(f'{name} {this[name]}' for name in differ)}"


def _version(found: Any) -> str:
    """A version that a file names, fit to be printed."""
    good = isinstance(found, str) and found.isprintable() and found
    return shortened(found) if good else "of an unknown version"


def _evaluations(rows: Any, record: Record, path: Path) -> tuple[list[Evaluation], str | None]:
    """The evaluations of the problem's own start before the first damaged row, and what is wrong with that.

    Raises SceneError if there is a damaged row and none before it.
    """
    if not isinstance(rows, list):
        raise SceneError(f"{path}: damaged, its iterations are missing or are no list; {WAY_OUT}")
    found: list[Evaluation] = []
    wrong = None
    for number, row in enumerate(rows, 1):
        try:
            found.append(_evaluation(row, record))
        except _Damaged as damage:
            wrong = f"row {number} of its iterations {damage}"
            break
    own = [e for e in found if e.start == 1]
    if own and not _is_start(own[0], record):
        own, wrong = [], "row 1 of its iterations is not the start design"
    if wrong is not None and not own:
        raise SceneError(f"{path}: damaged, {wrong}, so that nothing is left to go on with; {WAY_OUT}")
    return own, wrong


def _is_start(evaluation: Evaluation, record: Record) -> bool:
    """True if the design is the problem's start, but for rounding."""
    lower, upper = record.problem.bounds
    distance = np.abs(evaluation.design - np.clip(record.problem.start, lower, upper))
    return bool(np.all(distance <= START_AGREES * (upper - lower)))


def _evaluation(row: Any, record: Record) -> Evaluation:
    """The evaluation that an item of "iterations" was written from. Raises _Damaged."""
    if not isinstance(row, dict):
        raise _Damaged("is no table")
    n_variables, n_measures = len(record.problem.entries), len(record.problem.measures)
    failure = _taken(row, "failure")
    if failure is not None and not isinstance(failure, str):
        raise _Damaged("has a failure that is no text")
    solved = not failure
    return Evaluation(
        design=_numbers(_taken(row, "design"), "design", n_variables, True),
        values=_numbers(_taken(row, "values"), "values", n_measures, solved),
        gradients=_matrix(_taken(row, "gradients"), n_measures, n_variables, solved),
        newton_iterations=_whole(row, "newton_iterations", 0),
        start=_whole(row, "start", 1),
        failure=failure or None,
    )


def _taken(row: dict[str, Any], key: str) -> Any:
    if key not in row:
        raise _Damaged(f"has no {key}")
    return row[key]


def _whole(row: dict[str, Any], key: str, least: int) -> int:
    value = _taken(row, key)
    if isinstance(value, bool) or not isinstance(value, int) or value < least or finite(value) is None:
        raise _Damaged(f"has a {key} that is no whole number from {least} on")
    return value


def _numbers(items: Any, name: str, count: int, known: bool) -> np.ndarray:
    """(count,), nan where the file has null, which it may unless the numbers have to be `known`."""
    if not isinstance(items, list) or len(items) != count:
        raise _Damaged(f"has {name} that are not {count} numbers")
    found = [np.nan if item is None and not known else finite(item) for item in items]
    if any(item is None for item in found):
        raise _Damaged(f"has {name} that are not {count} numbers")
    return np.array(found, float)


def _matrix(rows: Any, n_measures: int, n_variables: int, known: bool) -> np.ndarray:
    """(n_measures, n_variables), as `_numbers`."""
    if not isinstance(rows, list) or len(rows) != n_measures:
        raise _Damaged(f"has gradients that are not {n_measures} lists")
    found = [_numbers(row, "gradients", n_variables, known) for row in rows]
    return np.array(found).reshape(n_measures, n_variables)
