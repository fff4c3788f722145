"""Constants of a wall from test data: the whole way, from files to a fitted scene with its confidence.

Everything compared is a JAX function of the scene (`jaxclamp.inflated_tube`, `jaxclamp.flat_piece`), so that
Jacobians are exact.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxclamp import Progress, Scene, SceneError, replace, versions
from jaxclamp.scenes.address import get
from jaxclamp.scenes.wording import did_you_mean, shortened
from optimize.fit_confidence import Better, Confidence, confidence
from optimize.fit_data import Data, load_data
from optimize.fit_model import GIVENS, Problem, experiment, problem
from optimize.fit_parameters import Freedom, freedom
from optimize.fit_search import Best, Search, moved, patterned

MOST_STARTS = 1000
"""starts"""
POOR = 0.3
"""a column is not followed if its residuals are a pattern of more than this share of the column's spread"""
AGAIN = 5
"""how often a better optimum that a profile comes across is taken up"""


@dataclasses.dataclass(frozen=True)
class Residuals:
    """What is left of a column."""

    rms: float
    """root mean square, unit of the column"""
    unit: str
    """as the file has it"""
    n: int
    """values compared"""


@dataclasses.dataclass(frozen=True)
class Fit:
    """Fitted constants, how sure they are, and what the law leaves of the data."""

    scene: Scene
    """with the fitted numbers"""
    freedom: Freedom
    """what was free"""
    problem: Problem
    """what was compared"""
    best: Best
    """the optimum"""
    confidence: Confidence
    """how sure it is"""
    predicted: np.ndarray
    """(n,) internal units, in order of `Problem.measured`"""
    residuals: Mapping[str, Residuals]
    """by column"""
    follows: bool
    """False if the law cannot follow the data"""
    warnings: tuple[str, ...]
    """what to know, a sentence each"""

    @property
    def values(self) -> list[float]:
        """Fitted numbers, units of scene files."""
        return [float(v) for v in self.freedom.values(self.best.x)]

    def to_dict(self) -> dict[str, Any]:
        """As in fit.json."""
        parameters = {}
        for parameter, value, interval in zip(
            self.freedom.parameters, self.values, self.confidence.intervals, strict=True
        ):
            parameters[parameter.key] = {
                "value": value,
                "unit": parameter.unit,
                "standard_error": interval.standard_error,
                "lower": interval.lower,
                "upper": interval.upper,
                "identified": interval.identified,
                "bounded_below": interval.bounded[0],
                "bounded_above": interval.bounded[1],
                "start": parameter.start,
            }
        return {
            "title": self.scene.title,
            "converged": self.follows,
            "parameters": parameters,
            "ties": [f"{tie.left} = {tie.factor:g} * {tie.right}" for tie in self.freedom.ties],
            "correlation": self.confidence.correlation.tolist(),
            "covariance": self.confidence.covariance.tolist(),
            "residuals": {name: dataclasses.asdict(each) for name, each in self.residuals.items()},
            "not_identified": list(self.confidence.weak),
            "identified_combinations": list(self.confidence.strong),
            "warnings": list(self.warnings),
            "columns_weighed_by": self.best.weighed_by,
            "starts": {"tried": self.best.starts, "agreeing": self.best.agreeing},
            "files": [each.data.source for each in self.problem.experiments],
            "versions": versions(),
        }


@dataclasses.dataclass(frozen=True)
class Asked:
    """How a fit is done; the defaults are those of the command line."""

    free: Sequence[str] = ()
    """numbers that are fitted, all constants but bulk moduli if none is named; see `fit_parameters.freedom`
    """
    fixed: Sequence[str] = ()
    """numbers that are not"""
    ties: Sequence[str] = ()
    """such as adventitia.c = media.c / 10"""
    columns: Sequence[str] = ()
    """as "HEADER=NAME", for columns to be read by another name"""
    given: str = "radius"
    """what a tube is seen at: "radius", or "pressure" instead"""
    starts: int = 20
    """how many"""
    seed: int = 0
    """of the random starts"""


def fit(
    files: Sequence[Data],
    scene: Scene,
    asked: Asked | None = None,
    progress: Callable[[Progress], Any] | None = None,
) -> Fit:
    """Fit numbers of a scene to test data.

    Raises SceneError for data that cannot be compared, or that are fewer than the numbers.
    """
    asked = asked or Asked()
    free = freedom(scene, asked.free, asked.fixed, asked.ties)
    if asked.given not in GIVENS:
        raise SceneError(f"--given {shortened(asked.given)}: expected {' or '.join(GIVENS)}")
    together = problem([experiment(data, scene, asked.given) for data in files])
    _check_counts(together, free, asked.starts)
    return solved(Search(together, free), asked.starts, asked.seed, progress)


def solved(
    search: Search, starts: int, seed: int = 0, progress: Callable[[Progress], Any] | None = None
) -> Fit:
    """The fit of a problem that is compiled already."""
    tell = progress or (lambda event: None)
    best = search.best(starts, seed, tell)
    for _ in range(AGAIN):
        patterns = patterned(search, best.x, best.scatter)
        tell(Progress("confidence", 0.0, "profiles of the sum of squares"))
        try:
            sure = confidence(search, best, patterns)
        except Better as better:
            x, squares = search.minimise(better.x, best.scatter)
            others = (*best.others, (best.x, best.squares))
            best = dataclasses.replace(best, x=x, squares=squares, others=others, agreeing=1)
            continue
        tell(Progress("confidence", 1.0, ""))
        return _fitted(search, best, sure, patterns)
    said = "the sum of squares has too many optima"
    raise SceneError(f"{said}: expected more data, more starts (--starts), or fewer free numbers (--free)")


def _check_counts(together: Problem, free: Freedom, starts: int) -> None:
    if not 1 <= starts <= MOST_STARTS:
        raise SceneError(f"--starts {starts}: expected a whole number from 1 to {MOST_STARTS}")
    if together.measured.size <= len(free.parameters):
        sources = ", ".join(each.data.source for each in together.experiments)
        raise SceneError(
            f"{sources}: expected more values to compare than the {len(free.parameters)} free numbers, found "
            f"{together.measured.size}; fix some (--fix) or tie them (--tie)"
        )


def _fitted(search: Search, best: Best, sure: Confidence, patterns: list[int]) -> Fit:
    together, free = search.problem, search.freedom
    predicted = search.predicted(best.x)
    scene = free.scene
    for path in [p.path for p in free.parameters] + [tie.left for tie in free.ties]:
        scene = replace(scene, path, float(get(free.scene_at(jnp.asarray(best.x)), path)))
    left = predicted - together.measured
    residuals = {}
    for k, name in enumerate(together.names):
        column, part = together.unit(k), left[together.group == k]
        residuals[name] = Residuals(float(np.sqrt(np.mean(part**2))) / column.factor, column.unit, part.size)
    poor, said = _patterns(search, best, left, patterns)
    return Fit(
        scene,
        free,
        together,
        best,
        sure,
        predicted,
        residuals,
        not poor,
        tuple(said + _notes(search, best, sure, patterns)),
    )


def _patterns(search: Search, best: Best, left: np.ndarray, patterns: list[int]) -> tuple[bool, list[str]]:
    """Whether the law cannot follow the data, and the patterns in words."""
    poor, said = False, []
    for number in patterns:
        experiment_number, begin, end = search.problem.runs[number]
        each, column = search.problem.experiments[experiment_number], search.problem.column(number)
        order = search.order(number)
        part, kept = left[begin:end][order], ~np.isnan(column.values)
        along, measured = each.along.values[kept][order], column.values[kept]
        changes = int(np.sum((part[1:] > 0.0) != (part[:-1] > 0.0)))
        worst = int(np.argmax(np.abs(part)))
        within = column.deviation is not None and np.mean((part / column.deviation[kept][order]) ** 2) <= 1.0
        lost = np.sqrt(np.mean(part**2)) > POOR * np.std(measured) and not within
        poor = poor or bool(lost)
        how = "the law cannot follow" if lost else "the law does not quite follow"
        said.append(
            f"{each.data.source}: {how} {column.name}: residuals change their sign {changes} times in "
            f"{part.size} rows, which is a pattern and no scatter; the largest is "
            f"{part[worst] / column.factor:+.3g} {column.unit} at "
            f"{each.along.name} {along[worst] / each.along.factor:.4g}"
        )
    return poor, said


def _notes(search: Search, best: Best, sure: Confidence, patterns: list[int]) -> list[str]:
    """What else to know."""
    said = []
    if patterns:
        said.append(
            f"residuals that are no scatter count as {sure.independent:.3g} independent values in the "
            "confidence, which does not cover what the law itself gets wrong"
        )
    said += [f"{text[0].upper()}{text[1:]}" for text in sure.weak]
    said += [_rival(search, best.x, other) for other in sure.rivals]
    if best.agreeing < max(2, best.starts // 4) and best.starts > 1 and not sure.rivals:
        said.append(
            f"only {best.agreeing} of {best.starts} starts ended at this optimum: try more (--starts)"
        )
    movable = moved(search, best.x)
    for k, name in enumerate(search.problem.names):
        if not movable[k]:
            said.append(f"{name} does not depend on what was fitted")
    for each in search.problem.experiments:
        said += [f"{each.data.source}: {name} was not used" for name in (*each.unused, *each.data.ignored)]
    return said


def _rival(search: Search, x: np.ndarray, other: np.ndarray) -> str:
    """Where another optimum is, by the numbers that differ most."""
    numbers = sorted(range(x.size), key=lambda i: -abs(x[i] - other[i]))[:4]
    parts = [
        f"{search.freedom.name(i)} {float(p.value(other[i])):.3g} {p.unit}".strip()
        for i, p in enumerate(search.freedom.parameters)
        if i in numbers
    ]
    return f"another optimum fits about as well, which the confidence spans: {', '.join(parts)}"


def fit_files(
    paths: Sequence[str | Path],
    scene: Scene,
    asked: Asked | None = None,
    progress: Callable[[Progress], Any] | None = None,
) -> Fit:
    """`fit` of CSV files. Raises SceneError."""
    asked = asked or Asked()
    renamed = _renamed(asked.columns)
    data = [load_data(path, renamed) for path in paths]
    known = {head for each in data for head in each.heads}
    if lost := next((head for head in renamed if head not in known), None):
        raise SceneError(f"--column {lost}: {did_you_mean(lost, sorted(known))}")
    return fit(data, scene, asked, progress)


def _renamed(columns: Sequence[str]) -> dict[str, str]:
    found = {}
    for text in columns:
        head, mark, name = text.rpartition("=")
        if not mark or not head.strip() or not name.strip():
            raise SceneError(
                f"--column {text!r}: expected HEADER=NAME, such as 'OD control=outer_diameter_um'"
            )
        found[head.strip()] = name.strip()
    return found
