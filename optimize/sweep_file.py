"""Sweep files (TOML): a scene, and what is varied: grids, Latin hypercubes, rows of a CSV file.

Every job is the complete text of its scene: it needs no file where it is solved.
"""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import itertools
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxclamp import Scene, SceneError, dump_scene, load_scene, own_parts
from jaxclamp.scenes.address import describe
from jaxclamp.scenes.schema import shown, toml_value
from jaxclamp.scenes.wording import shortened
from optimize.keys import one_line, overrides, read_file, require_known, whole
from optimize.numbers import MOST, number

KEYS = (
    "title",
    "scene",
    "set",
    "fidelity",
    "vary",
    "csv",
    "samples",
    "seed",
    "time_limit_s",
    "jobs_per_worker",
)
"""what a sweep file may set"""
MOST_JOBS = 1_000_000
NAME, SCENE = "name", "scene"
"""columns of a CSV file that are no keys of a scene"""


@dataclasses.dataclass(frozen=True)
class Job:
    """One scene of a sweep."""

    number: int
    """from 1"""
    name: str
    """of its row, if that has one"""
    varied: dict[str, Any]
    """what is its own, by key, in the units of scene files"""
    text: str | None
    """the complete scene; None for one that is refused"""
    refusal: str | None = None
    """why there is none"""
    shape: tuple[int, ...] = ()
    """of its mesh: jobs alike share compiled programs"""
    own: str = ""
    """digests of the files that its own parts come from"""


@dataclasses.dataclass(frozen=True)
class Sweep:
    """What a sweep file asks for."""

    title: str
    """of the report"""
    jobs: tuple[Job, ...]
    """in order"""
    time_limit_s: float
    """that a job may take"""
    jobs_per_worker: int
    """after which a process is replaced by a new one"""

    @property
    def digest(self) -> str:
        """A word that changes with any scene."""
        parts = [
            f"{job.number} {job.name} {job.varied} {job.text or job.refusal} {job.own}" for job in self.jobs
        ]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def load_sweep(path: str | Path) -> Sweep:
    """The sweep of a TOML file. Raises SceneError; a scene that is refused is a job that says so."""
    return read_file(Path(path), "sweep", _sweep)


def _sweep(table: dict[str, Any], folder: Path) -> Sweep:
    require_known(table, KEYS)
    scene, fixed = table.get("scene"), overrides(table)
    if not isinstance(scene, str):
        raise SceneError(f"scene = {shown(scene)}: expected a preset or a scene file")
    fidelity = table.get("fidelity", "standard")
    base = load_scene(_beside(folder, scene), fixed, fidelity)  # refused here, if it is no job's fault
    jobs = []
    for place, (name, own_scene, varied) in enumerate(_varied(table, base, folder), 1):
        if place > MOST_JOBS:
            raise SceneError(f"the sweep has more than {MOST_JOBS} jobs")
        jobs.append(_job(place, name, _beside(folder, own_scene or scene), varied, fixed, fidelity))
    if not jobs:
        raise SceneError("nothing is varied: expected [[vary]] tables, or csv = a file of rows")
    title = one_line(table, "title", "Sweep")
    limit = number(table.get("time_limit_s", 3600.0), "time_limit_s", 1.0, 1e7)
    return Sweep(title, tuple(jobs), limit, whole(table, "jobs_per_worker", 500, 1, MOST_JOBS))


def _job(
    place: int, name: str, scene: str | Path, varied: dict[str, Any], fixed: list[str], fidelity: str
) -> Job:
    """A job with its scene, or with why there is none."""
    try:
        found = load_scene(scene, [*fixed, *(f"{k}={toml_value(v)}" for k, v in varied.items())], fidelity)
        mesh = found.mesh
        shape = (mesh.circumferential, mesh.axial, *mesh.radial)
        own = " ".join(f"{part['part']} {part['sha256']}" for part in own_parts(found))
        return Job(place, name, varied, dump_scene(found), shape=shape, own=own)
    except SceneError as error:
        return Job(place, name, varied, None, str(error))


def _beside(folder: Path, scene: str) -> str | Path:
    return folder / scene if Path(scene).suffix == ".toml" else scene


def _varied(table: dict[str, Any], base: Scene, folder: Path) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Name, scene and what is its own of every job."""
    lists, ranges = _vary(table, base)
    rows = _rows(table["csv"], folder) if "csv" in table else iter([("", "", {})])
    samples = _samples(table, ranges)
    grid = [dict(zip(lists, values, strict=True)) for values in itertools.product(*lists.values())]
    if "csv" not in table and not lists and not ranges:
        return
    for (name, scene, row), point, sample in itertools.product(rows, grid, samples):
        yield name, scene, row | point | sample


def _vary(table: dict[str, Any], base: Scene) -> tuple[dict[str, list[Any]], dict[str, tuple[float, float]]]:
    """Lists of values, and ranges, by key."""
    items = table.get("vary", [])
    if not isinstance(items, list):
        raise SceneError("vary: expected a list of tables, [[vary]]")
    lists: dict[str, list[Any]] = {}
    ranges: dict[str, tuple[float, float]] = {}
    for i, item in enumerate(items):
        path = f"vary[{i}]"
        if not isinstance(item, dict) or not isinstance(item.get("key"), str):
            raise SceneError(f"{path}: expected a table with key, and with values or lower and upper")
        key = item["key"]
        if key in lists or key in ranges:
            raise SceneError(f"{path}.key = {shown(key)}: it is varied already")
        if set(item) == {"key", "values"}:
            values = item["values"]
            if not isinstance(values, list) or not values:
                raise SceneError(f"{path}.values = {shown(values)}: expected a list of values")
            try:
                json.dumps(values)
            except TypeError:
                raise SceneError(f"{path}.values = {shown(values)}: dates and times are no values") from None
            lists[key] = values
        elif set(item) == {"key", "lower", "upper"}:
            describe(base, key)  # a float of the scene
            lower, upper = (number(item[side], f"{path}.{side}", -MOST, MOST) for side in ("lower", "upper"))
            if not lower < upper:
                raise SceneError(f"{path}: lower = {lower:g} is not below upper = {upper:g}")
            ranges[key] = lower, upper
        else:
            raise SceneError(f"{path}: expected key with values, or key with lower and upper")
    return lists, ranges


def _samples(table: dict[str, Any], ranges: dict[str, tuple[float, float]]) -> list[dict[str, float]]:
    """A Latin hypercube over the ranges; one empty sample without any."""
    from scipy.stats import qmc

    if not ranges:
        if "samples" in table:
            raise SceneError("samples: there are no ranges (lower and upper) to draw them from")
        return [{}]
    count = whole(table, "samples", None, 1, MOST_JOBS)
    seed = table.get("seed", 0)
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise SceneError(f"seed = {shown(seed)}: expected a whole number from 0")
    unit = qmc.LatinHypercube(d=len(ranges), rng=np.random.default_rng(seed)).random(count)
    lower, upper = np.array(list(ranges.values())).T
    drawn = lower + unit * (upper - lower)
    return [dict(zip(ranges, map(float, row), strict=True)) for row in drawn]


def _rows(file: Any, folder: Path) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Name, scene and keys with values of each row of a CSV file."""
    if not isinstance(file, str):
        raise SceneError(f"csv = {shown(file)}: expected the path of a CSV file")
    path = folder / file
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            lines = [
                (line, row) for line, row in enumerate(csv.reader(stream), 1) if any(map(str.strip, row))
            ]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SceneError(f"csv = {shown(file)}: {getattr(error, 'strerror', None) or error}") from None
    if not lines:
        raise SceneError(f"csv = {shown(file)}: it is empty; expected a header of keys and rows of values")
    header = [name.strip() for name in lines[0][1]]
    if twice := next((name for name in header if header.count(name) > 1), None):
        raise SceneError(f"csv = {shown(file)}, line {lines[0][0]}: {shortened(twice)!r} is there twice")
    for line, row in lines[1:]:
        if len(row) > len(header):
            said = f"{len(row)} values for the {len(header)} columns of the header"
            raise SceneError(f"csv = {shown(file)}, line {line}: {said}")
        cells = dict(zip(header, map(str.strip, row), strict=False))
        name, scene = cells.pop(NAME, ""), cells.pop(SCENE, "")
        yield name, scene, {key: _cell(text) for key, text in cells.items() if text}


def _cell(text: str) -> float | str:
    """A number if it is one, else the text."""
    try:
        value = float(text)
    except ValueError:
        return text
    return value if math.isfinite(value) else text
