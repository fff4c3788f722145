"""Study files (TOML): a scene, what may change, what is minimised and what must hold.

A bound of a constraint is a number, or "reference": the value of the scene's own clamp.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxclamp import Measure, Progress, Scene, SceneError, load_scene
from jaxclamp.scenes.address import describe
from jaxclamp.scenes.schema import shown, toml_value
from jaxclamp.scenes.wording import did_you_mean, shortened
from optimize.drivers import METHODS
from optimize.front import Front, front
from optimize.keys import one_line, overrides, read_file, require_known, whole
from optimize.named_measures import read_measure
from optimize.numbers import MOST, number
from optimize.problem import Constraint, DesignProblem, require_consistent
from optimize.starts import Budget
from optimize.study import Study, minimise
from optimize.variables import Variable

LONGEST_NAME = 1000
"""characters of the name of a scene or its file"""

REFERENCE = "reference"
"""a bound at the value of the scene's own clamp"""

KEYS = (
    "title",
    "scene",
    "set",
    "start",
    "method",
    "max_evaluations",
    "tolerance",
    "starts",
    "objective",
    "objectives",
    "points",
    "variables",
    "constraints",
)
"""what a study file may set"""


@dataclasses.dataclass(frozen=True)
class StudyFile:
    """What a study file asks for."""

    title: str
    """of the report"""
    problem: DesignProblem
    """scene, variables, objective, constraints"""
    method: str
    """a key of `drivers.METHODS`"""
    max_evaluations: int
    """of the start's own study"""
    tolerance: float
    """relative change of the objective that no longer matters"""
    starts: int
    """designs to start from: the file's, and others drawn between the bounds"""
    second: Measure | None = None
    """the other objective of a study with two"""
    points: int = 5
    """of the front of two objectives"""

    def run(
        self, folder: Path, resume: bool = False, progress: Callable[[Progress], Any] | None = None
    ) -> Study | Front:
        """Do the study in a folder. Raises SceneError, EquilibriumError, OSError."""
        if self.second is not None:
            budget = Budget(self.method, self.max_evaluations, self.tolerance)
            return front(self.problem, self.second, self.points, budget, folder, resume, progress)
        return minimise(
            self.problem,
            method=self.method,
            max_evaluations=self.max_evaluations,
            tolerance=self.tolerance,
            starts=self.starts,
            folder=folder,
            resume=resume,
            progress=progress,
        )


def load_study(name_or_path: str | Path) -> StudyFile:
    """The study of a preset or a TOML file. Raises SceneError."""
    return read_file(name_or_path, "study", _study)


def _study(table: dict[str, Any], folder: Path) -> StudyFile:
    require_known(table, KEYS)
    reference, start = _scenes(table, folder)
    layers = tuple(layer.name for layer in start.artery.layers)
    objective, second = _objectives(table, layers)
    problem = DesignProblem(
        scene=start,
        objective=objective,
        variables=tuple(
            _variable(item, start, f"variables[{i}]") for i, item in enumerate(_tables(table, "variables"))
        ),
        constraints=tuple(
            constraint
            for i, item in enumerate(_tables(table, "constraints"))
            for constraint in _constraints(item, layers, f"constraints[{i}]")
        ),
        reference=None if reference is start else reference,
    )
    require_consistent(problem)
    return StudyFile(
        title=one_line(table, "title", "Jaw study"),
        problem=problem,
        method=_choice(table, "method", "slsqp", tuple(METHODS)),
        max_evaluations=whole(table, "max_evaluations", 40, 1, 10_000),
        tolerance=number(table.get("tolerance", 1e-4), "tolerance", 1e-12, 1.0),
        starts=whole(table, "starts", 1, 1, 100 if second is None else 1),
        second=second,
        points=whole(table, "points", 5, 2, 100),
    )


def _objectives(table: dict[str, Any], layers: tuple[str, ...]) -> tuple[Measure, Measure | None]:
    """What is minimised, and the other objective of a study with [[objectives]]."""
    if "objectives" not in table:
        if "points" in table:
            raise SceneError("points: they are of a front, of a study with two [[objectives]]")
        return read_measure(table.get("objective"), "objective", layers)[0], None
    if "objective" in table:
        raise SceneError("objective: expected either [objective] or two [[objectives]], found both")
    items = _tables(table, "objectives")
    if len(items) != 2:
        raise SceneError(f"objectives: expected two tables, found {len(items)}")
    first, second = (read_measure(item, f"objectives[{i}]", layers)[0] for i, item in enumerate(items))
    if first == second:
        raise SceneError(f"objectives: expected two measures, found {first} twice")
    return first, second


def _scenes(table: dict[str, Any], folder: Path) -> tuple[Scene, Scene]:
    """The scene as it is, and with the jaw to start from."""
    name = table.get("scene")
    if not isinstance(name, str) or len(name) > LONGEST_NAME:
        raise SceneError(f"scene = {shown(name)}: expected a preset or a scene file")
    beside = folder / name
    scene: str | Path = beside if Path(name).suffix == ".toml" else name
    changes = overrides(table)
    reference = _loaded(scene, changes)
    if "start" not in table:
        return reference, reference
    start = table["start"]
    if not isinstance(start, dict) or set(start) != {"jaw"}:
        raise SceneError("start: expected a table with jaw = a jaw's name or table")
    try:
        jaw = toml_value(start["jaw"])
    except (ValueError, RecursionError):  # an integer of thousands of digits, a list of lists of lists
        raise SceneError("start.jaw: expected numbers that a jaw can have, found one too long") from None
    return reference, _loaded(scene, [*changes, f"clamp.jaw={jaw}"])


def _loaded(scene: str | Path, changes: list[str]) -> Scene:
    """The scene with its overrides. Raises SceneError, also for a name that no file can have."""
    try:
        return load_scene(scene, changes)
    except OSError as error:
        said = f"expected a preset or a scene file ({error.strerror})"
        raise SceneError(f"scene = {shown(str(scene))}: {said}") from None


def _tables(table: dict[str, Any], key: str) -> list[Any]:
    items = table.get(key, [])
    if not isinstance(items, list):
        raise SceneError(f"{key}: expected a list of tables, [[{key}]]")
    return items


def _variable(item: Any, scene: Scene, path: str) -> Variable:
    if not isinstance(item, dict) or not isinstance(item.get("key"), str):
        raise SceneError(f"{path}: expected a table with key, lower and upper")
    known = ("key", "lower", "upper", "rising")
    for name in item:
        if name not in known:
            raise SceneError(f"unknown key {path}.{shortened(name)}; {did_you_mean(name, list(known))}")
    rising = item.get("rising", False)
    if not isinstance(rising, bool):
        raise SceneError(f"{path}.rising = {shown(rising)}: expected true or false")
    factor = describe(scene, item["key"]).factor

    def bound(side: str) -> tuple[float, ...] | None:
        if side not in item:
            return None
        given = item[side] if isinstance(item[side], list) else [item[side]]
        return tuple(factor * number(v, f"{path}.{side}", -MOST, MOST) for v in given)

    return Variable(item["key"], bound("lower"), bound("upper"), rising)


def _constraints(item: Any, layers: tuple[str, ...], path: str) -> list[Constraint]:
    """The constraints of a table: one for its numbers, one for its bounds at the reference's value."""
    measure, factor = read_measure(item, path, layers, ("lower", "upper"))
    sides = {side: item[side] for side in ("lower", "upper") if side in item}
    if not sides:
        raise SceneError(f"{path}: expected lower, upper or both")
    relative = {side: 1.0 for side, value in sides.items() if value == REFERENCE}
    bounds = {
        side: factor * number(value, f"{path}.{side}", -MOST, MOST, f'"{REFERENCE}" or a number')
        for side, value in sides.items()
        if side not in relative
    }
    given = ((bounds, False), (relative, True))
    return [
        Constraint(measure, b.get("lower", -math.inf), b.get("upper", math.inf), is_relative)
        for b, is_relative in given
        if b
    ]


def _choice(table: dict[str, Any], key: str, default: str, choices: tuple[str, ...]) -> str:
    value = table.get(key, default)
    if value not in choices:
        raise SceneError(f"{key} = {shown(value)}: expected one of {', '.join(choices)}")
    return str(value)
