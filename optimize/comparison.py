"""One artery in several clamps: at the scene's own stop, just closed, and pressed on with the same force.

Clamps are ranked by a measure at the scene's stop, the least first. Two whose difference is no more than its
error are tied: their numbers do not say which of them is the better one.
"""

from __future__ import annotations

import dataclasses
import math
import multiprocessing
import os
import tomllib
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxclamp import (
    ClosedStop,
    Estimate,
    Failure,
    Measure,
    PressedStop,
    Progress,
    Result,
    Scene,
    SceneError,
    by_value,
    clamp,
    load_scene,
    neighbours,
    require_possible,
    smooth_peak_axial_stress,
    versions,
    with_errors,
)
from jaxclamp.scenes.files import read_text
from jaxclamp.scenes.presets import presets
from jaxclamp.scenes.wording import did_you_mean, shortened
from optimize.named_measures import FILE_UNIT, in_words, named

QUARTER = 0.25
"""of its closing force, to which a clamp's slope is told before and after closure"""
BEYOND = 1.0 + 1.01 * QUARTER
"""the common force over the largest closing force of all clamps"""


@dataclasses.dataclass(frozen=True)
class Asked:
    """A clamp that is to be compared."""

    name: str
    """as asked for"""
    title: str
    """the first comment of its file"""
    source: str
    """the further comments of its file: where its numbers come from"""
    scene: Scene
    """the artery in it"""


@dataclasses.dataclass(frozen=True)
class Clamped:
    """A clamp on the artery, as far as it converged."""

    asked: Asked
    """which clamp"""
    at_stop: Result | None = None
    """at the scene's stop, with errors"""
    ranked: Estimate | None = None
    """the measure that ranks, at the scene's stop, in internal units"""
    closed: Result | None = None
    """with the lumen just closed"""
    pressed: Result | None = None
    """with the common force"""
    failures: tuple[str, ...] = ()
    """why what is missing is missing, or what is there may not be what a closing jaw comes to"""

    @property
    def closing_force_N(self) -> float | None:
        """Force on one jaw that just closes the lumen."""
        return None if self.closed is None else float(self.closed.final["clamp_force_N"])

    @property
    def rise_at_closure(self) -> float | None:
        """Slope of force over travel past closure, over that before it: the mark of a clamp that can be felt
        to close. See `rise`."""
        force = self.closing_force_N
        return None if self.pressed is None or force is None else rise(self.pressed, force)


@dataclasses.dataclass(frozen=True)
class Comparison:
    """What was compared, best first; clamps that failed come last."""

    title: str
    """of the scene"""
    rank_by: str
    """name of the measure that ranks, as in files"""
    measure: Measure
    """the same"""
    force_N: float | None
    """on one jaw, the same for all; None if no clamp closed"""
    clamps: tuple[Clamped, ...]
    """in order"""

    @property
    def unit(self) -> tuple[str, float]:
        """The measure's unit in files, and internal units in one of it."""
        return FILE_UNIT.get(self.measure.unit, (self.measure.unit, 1.0))

    def rank(self, place: int) -> int | None:
        """1 for the best and all that are tied with it, and so on; None for a clamp that failed."""
        rank = 1
        first = self.clamps[0].ranked
        for here in range(place + 1):
            value = self.clamps[here].ranked
            if value is None or first is None:
                return None
            if here and not tied(value, first):
                rank, first = here + 1, value
        return rank

    def to_dict(self) -> dict[str, Any]:
        """As in compare.json."""
        unit, factor = self.unit
        return {
            "title": self.title,
            "rank_by": self.rank_by,
            "unit": unit,
            "force_N": self.force_N,
            "clamps": [self._clamp(place, each, factor) for place, each in enumerate(self.clamps)],
            "versions": versions(),
        }

    def _clamp(self, place: int, each: Clamped, factor: float) -> dict[str, Any]:
        found, error = each.ranked, None if each.ranked is None else each.ranked.error
        reached = each.at_stop
        return {
            "rank": self.rank(place),
            "name": each.asked.name,
            "title": each.asked.title,
            "source": each.asked.source or None,
            "converged": reached is not None,
            "failure": "; ".join(each.failures) or None,
            "value": None if found is None else found.value / factor,
            "error": None if error is None else error / factor,
            "final": None if reached is None else reached.to_dict()["final"],
            "errors": None if reached is None else reached.errors,
            "closing_force_N": each.closing_force_N,
            "rise_at_closure": each.rise_at_closure,
            "closed": None if each.closed is None else each.closed.to_dict()["final"],
            "at_equal_force": None if each.pressed is None else each.pressed.to_dict()["final"],
        }


def tied(one: Estimate, other: Estimate) -> bool:
    """True if the difference is no more than its error, or that is not known."""
    difference = one - other
    return difference.error is None or abs(difference.value) <= difference.error


# ------------------------------------------------------------------------------- what is asked for


def asked_clamps(
    scene: str | Path, clamps: str, overrides: Sequence[str] = (), fidelity: str = "standard"
) -> tuple[Asked, ...]:
    """The scene with each clamp of a list such as "debakey-like,cylinder-3mm,my-jaw.toml".

    A preset or a file of a clamp, or of a jaw for both sides. Raises SceneError.
    """
    names = [name.strip() for name in clamps.split(",") if name.strip()]
    if len(names) < 2:
        raise SceneError("--clamps: expected two or more, such as cylinder-3mm,flat-2mm,my-jaw.toml")
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise SceneError(f"--clamps: {', '.join(twice)} is there twice")
    found = []
    for name in names:
        text, key = _clamp_or_jaw(name)
        comments = [line.lstrip("#").strip() for line in text.splitlines() if line.startswith("#")]
        one = load_scene(scene, [*overrides, f"{key}={quoted(name)}"], fidelity)
        title = comments[0] if comments else name
        found.append(Asked(name, title, " ".join(filter(None, comments[1:])), one))
    return tuple(found)


def _clamp_or_jaw(name: str) -> tuple[str, str]:
    """The text of a preset or file, and the key of a scene that it is the value of: a jaw has a shape."""
    known = {each.name for each in presets("clamp")}
    text, _ = read_text(name, "clamp" if name in known else "jaw")
    try:
        is_jaw = "shape" in tomllib.loads(text)
    except ValueError:  # refused with its line as the scene is read
        is_jaw = True
    return text, "clamp.jaw" if is_jaw else "clamp"


def quoted(text: str) -> str:
    """As a TOML string."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def ranking(text: str | None, layers: tuple[str, ...]) -> tuple[str, Measure]:
    """The full name and the measure of a name, such as "smooth_peak_axial_stress_kPa.adventitia".

    The unit may be left out; so may the layer, for the one called media or else the innermost. None: the
    smooth peak axial stress. Raises SceneError.
    """
    usual = "media" if "media" in layers else layers[0]
    key, _, layer = (text or smooth_peak_axial_stress.__name__).partition(".")
    known = {k: each for k, each in named().items() if set(each.required) <= {"layer"}}
    short = {each.factory.__name__: each for each in known.values()}
    chosen = known.get(key) or short.get(key)
    if chosen is None:
        raise SceneError(f"--rank {shortened(key)}: no such measure; {did_you_mean(key, list(known))}")
    if not chosen.arguments:
        if layer:
            raise SceneError(f"--rank: {key} is not of a layer, and {shortened(layer)} was given")
        return chosen.key, chosen.factory()
    if layer and layer not in layers:
        raise SceneError(f"--rank: {shortened(layer)} is no layer; expected one of {', '.join(layers)}")
    return f"{chosen.key}.{layer or usual}", chosen.factory(layer=layer or usual)


# ------------------------------------------------------------------------------------- the work


def compare(
    clamps: Sequence[Asked],
    rank_by: str,
    measure: Measure,
    processes: int | None = None,
    progress: Callable[[Progress], Any] | None = None,
) -> Comparison:
    """Solve all clamps, in processes of their own (1: in this one); one that fails does not stop the others.

    In a script, call it below `if __name__ == "__main__":`, as Python's pools of processes ask for.
    """
    tell = progress or (lambda event: None)
    for each in clamps:
        require_possible(each.scene)
    count = min(len(clamps), processes or max(1, (os.cpu_count() or 1)))
    found = _all(count, [(closing, each, measure) for each in clamps], tell, "clamping", clamps)
    forces = [each.closing_force_N for each in found if each.closing_force_N is not None]
    force = BEYOND * max(forces) if forces else None
    if force is not None:
        found = _all(count, [(pressing, each, force) for each in found], tell, "pressing", clamps)
    least = lambda each: math.inf if each.ranked is None else each.ranked.value  # noqa: E731
    return Comparison(clamps[0].scene.title, rank_by, measure, force, tuple(sorted(found, key=least)))


def closing(asked: Asked, measure: Measure) -> Clamped:
    """A clamp at the scene's stop, and with the lumen just closed."""
    found = Clamped(asked)
    try:
        reached = clamp(asked.scene)
        near = neighbours(reached)
        estimate = near.estimates((measure,))[measure]
        found = dataclasses.replace(found, at_stop=with_errors(reached, near), ranked=estimate)
        found = _doubted(found, reached, "at the stop")
    except Failure as error:
        found = _failed(found, str(error))
    try:
        stop = ClosedStop(kind="closed", closed=True, closure=jnp.asarray(1.0))
        shut = dataclasses.replace(asked.scene, stop=stop)
        result = clamp(shut)
        return _doubted(dataclasses.replace(found, closed=result), result, "closed")
    except Failure as error:
        return _failed(found, f"not closed: {error}")


def pressing(found: Clamped, force_N: float) -> Clamped:
    """The same, pressed on with a force."""
    if found.closed is None:
        return found
    stop = PressedStop(kind="pressed", closed=True, force=jnp.asarray(1e3 * force_N))
    scene = dataclasses.replace(found.asked.scene, stop=stop)
    try:
        result = clamp(scene)
        return _doubted(dataclasses.replace(found, pressed=result), result, f"at {force_N:.4g} N")
    except Failure as error:
        return _failed(found, f"not pressed to {force_N:.4g} N: {error}")


def _doubted(found: Clamped, result: Result, where: str) -> Clamped:
    """The same, with a word where a closing jaw need not come to the result: as `run` warns of it."""
    branch = str(result.solver["branch"] or "")
    return _failed(found, f"{where}: {branch}") if branch.startswith("another") else found


def _failed(found: Clamped, why: str) -> Clamped:
    return dataclasses.replace(found, failures=(*found.failures, why))


def _all(
    count: int,
    calls: list[tuple[Callable[..., Clamped], Any, Any]],
    tell: Callable[[Progress], Any],
    stage: str,
    clamps: Sequence[Asked],
) -> list[Clamped]:
    """The values of all calls, in order."""
    done: list[Clamped | None] = [None] * len(calls)

    def note(place: int, value: Clamped) -> None:
        done[place] = value
        ready = sum(each is not None for each in done)
        said = f"{clamps[place].name}{': failed' if value.failures else ''}"
        tell(Progress(stage, ready / len(calls), said))

    tell(Progress(stage, 0.0, f"{len(calls)} clamps"))
    if count == 1:
        for place, (function, *arguments) in enumerate(calls):
            note(place, function(*arguments))
    else:
        with ProcessPoolExecutor(count, multiprocessing.get_context("spawn")) as pool:
            places: dict[Future[Clamped], int] = {
                pool.submit(by_value(*call)): place for place, call in enumerate(calls)
            }
            for future in as_completed(places):
                place = places[future]
                try:
                    note(place, future.result())
                except Exception as error:  # the process died, or its answer does not travel
                    kept = calls[place][1]
                    kept = kept if isinstance(kept, Clamped) else Clamped(kept)
                    note(place, _failed(kept, f"its process ended: {type(error).__name__}: {error}"))
    return [each for each in done if each is not None]


def path(result: Result) -> tuple[list[float], list[float]]:
    """Travel of each jaw, mm, and force on it, N, of the states on the way to a closed lumen and beyond.

    Where the way was walked on a coarser mesh, its states up to the first of the scene's own are of that
    mesh, as far as they lie before that one in both.
    """
    records = [record for record in result.history if record["stage"] == "clamping"]
    points = [(r["jaw_travel_mm"], r["clamp_force_N"]) for r in records]
    first = next(place for place, r in enumerate(records) if r["mesh"] == records[-1]["mesh"])
    before = [p for p in points[:first] if all(a < b for a, b in zip(p, points[first], strict=True))]
    travel, force = zip(*before, *points[first:], strict=True)
    return list(travel), list(force)


def rise(pressed: Result, closing_force_N: float) -> float | None:
    """Travel of a jaw over the last quarter of its closing force, over that for a quarter more."""
    travel, force = path(pressed)
    if len(force) < 2 or any(b <= a for a, b in pairwise(force)):
        return None  # a snap: the way has no one stiffness
    shares = np.array([1.0 - QUARTER, 1.0, 1.0 + QUARTER]) * closing_force_N
    if not force[0] <= shares[0] or not shares[-1] <= force[-1]:
        return None
    before, after = np.diff(np.interp(shares, force, travel))
    return float(before / after)


def lines(found: Comparison) -> list[str]:
    """The table for a terminal."""
    unit, factor = found.unit
    head = [
        "",
        "clamp",
        f"{in_words(found.measure)}, {unit}".rstrip(", "),
        "force, N",
        "closes at, N",
        "rise",
    ]
    rows = [head, *(row(found, place, factor) for place in range(len(found.clamps)))]
    widths = [max(len(cells[i]) for cells in rows) for i in range(len(head))]
    text = ["  ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)) for cells in rows]
    failed = [f"{each.asked.name}: {'; '.join(each.failures)}" for each in found.clamps if each.failures]
    return [line.rstrip() for line in (*text, *failed)]


def row(found: Comparison, place: int, factor: float) -> list[str]:
    """Rank, name, measure with its error, force at the stop, closing force and rise."""
    each, rank = found.clamps[place], found.rank(place)
    number = lambda value: "–" if value is None else f"{value:.4g}"  # noqa: E731
    same = rank is not None and any(found.rank(i) == rank for i in range(len(found.clamps)) if i != place)
    value = "–"
    if each.ranked is not None:
        error = each.ranked.error
        value = f"{each.ranked.value / factor:.4g} ± {'?' if error is None else f'{error / factor:.2g}'}"
    force = None if each.at_stop is None else float(each.at_stop.final["clamp_force_N"])
    return [
        "–" if rank is None else f"{rank}{' =' if same else ''}",
        each.asked.name,
        value,
        number(force),
        number(each.closing_force_N),
        number(each.rise_at_closure),
    ]
