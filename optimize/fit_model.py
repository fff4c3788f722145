"""What the layered tube and the flat piece predict for test data: residuals as JAX functions of a scene.

A tube is seen at its measured radius, and what is compared is the pressure and the force there ("radius" is
given, as is usual for arteries, whose pressure grows without bound while their radius does not); or at its
pressure, and what is compared is the radius ("pressure" is given).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp import Scene, SceneError, flat_piece, inflated_tube
from optimize.fit_data import Column, Data

GIVENS = ("radius", "pressure")
"""what a tube is seen at"""
RADII = ("outer_radius", "inner_radius")
"""which radius a tube is seen at, if both were measured: the outer one, which is seen"""
TUBE = (*RADII, "wall_thickness", "pressure", "reduced_force", "wall_force")
"""quantities of a tube"""
STRESSES = tuple(f"{d}_{kind}_stress" for d in ("circumferential", "axial") for kind in ("cauchy", "nominal"))
STRETCHES = ("circumferential_stretch", "axial_stretch")

Predicted = dict[str, Array]
"""quantities (n,) by name, internal units"""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """One file: what is compared in it, and how that is predicted."""

    data: Data
    """as read"""
    kind: str
    """tube or flat piece, in words"""
    compared: tuple[Column, ...]
    """columns that are compared"""
    along: Column
    """the column against which they are drawn"""
    predict: Callable[[Scene], Predicted]
    """a JAX function"""

    @property
    def unused(self) -> tuple[str, ...]:
        """Headers of the file that nothing is made of."""
        used = {column.name for column in (*self.compared, self.along)} | set(STRETCHES)
        return tuple(
            c.name for c in self.data.columns.values() if c.name not in used and c.quantity not in used
        )


def experiment(data: Data, scene: Scene, given: str | None = None) -> Experiment:
    """What a file is a test of. Raises SceneError for one that cannot be compared with anything."""
    if not data.lacks(*TUBE):
        return _tube(data, given or "radius")
    if not data.lacks(*STRESSES) and not data.lacks(*STRETCHES):
        return _flat(data, scene)
    raise SceneError(
        f"{data.source}: expected pressure and a radius (or diameter) of a tube, or stretches and "
        f"stresses of a flat piece, found {', '.join(c.name for c in data.columns.values())}"
    )


def _tube(data: Data, given: str) -> Experiment:
    columns = data.columns
    radius = next((columns[name] for name in RADII if name in columns), None)
    pressure = columns.get("pressure")
    seen = radius if radius is not None and (given == "radius" or pressure is None) else pressure
    if seen is None:
        raise SceneError(f"{data.source}: expected a column of pressures or of radii, such as pressure_mmHg")
    _require_all(data, seen)
    twice = {"wall_force"} if "reduced_force" in columns else set()  # one is made of the other
    compared = tuple(columns[n] for n in TUBE if n in columns and columns[n] is not seen and n not in twice)
    if not compared:
        raise SceneError(
            f"{data.source}: expected something to compare beside {seen.name}: pressure, a radius or a force"
        )
    measured = columns.get("axial_stretch")
    if measured is not None:
        _require_all(data, measured)
    at = jnp.asarray(seen.values)

    def predict(scene: Scene) -> Predicted:
        stretch = scene.artery.axial_stretch if measured is None else jnp.asarray(measured.values)
        stretch = jnp.broadcast_to(jnp.asarray(stretch), at.shape)
        tube = inflated_tube(scene.artery.layers, stretch, **{seen.quantity: at})
        return {
            "pressure": tube.pressure,
            "inner_radius": tube.inner_radius,
            "outer_radius": tube.outer_radius,
            "wall_thickness": tube.outer_radius - tube.inner_radius,
            "reduced_force": tube.reduced_force,
            "wall_force": tube.wall_force,
        }

    return Experiment(data, "tube", compared, seen, predict)


def _flat(data: Data, scene: Scene) -> Experiment:
    numbers = _layers(data, scene)
    columns = data.columns
    stretches = {name: columns[name] for name in STRETCHES if name in columns}
    for column in stretches.values():
        _require_all(data, column)
    compared = tuple(columns[name] for name in STRESSES if name in columns)
    free = next((name for name in STRETCHES if name not in stretches), None)
    if free is not None:
        pulled = next(iter(stretches))
        wrong = next(
            (c for c in compared if not c.quantity.startswith(pulled.removesuffix("_stretch"))), None
        )
        if wrong is not None:
            raise SceneError(
                f"{data.source}: column {wrong.name!r} is of the direction that {stretches[pulled].name!r} "
                f"leaves free: expected a column of the {free.replace('_', ' ')} beside it"
            )
    values = {name: jnp.asarray(column.values) for name, column in stretches.items()}

    def predict(scene: Scene) -> Predicted:
        parts = []
        for number in sorted(set(numbers)):
            rows = np.array([n == number for n in numbers])
            piece = flat_piece(scene.artery.layers[number].material, **values)
            parts.append((rows, piece))
        found: Predicted = {}
        for direction in ("circumferential", "axial"):
            cauchy = _rowwise([(rows, getattr(piece, f"{direction}_stress")) for rows, piece in parts])
            stretch = _rowwise([(rows, getattr(piece, f"{direction}_stretch")) for rows, piece in parts])
            found |= {f"{direction}_cauchy_stress": cauchy, f"{direction}_nominal_stress": cauchy / stretch}
        return found

    return Experiment(data, "flat piece", compared, next(iter(stretches.values())), predict)


def _rowwise(parts: Sequence[tuple[np.ndarray, Array]]) -> Array:
    """One array whose rows are each of the part that they belong to."""
    whole = jnp.zeros_like(parts[0][1])
    for rows, values in parts:
        whole = jnp.where(jnp.asarray(rows), values, whole)
    return whole


def _layers(data: Data, scene: Scene) -> list[int]:
    """The layer of every row of a flat piece's test, counted from 0 inside."""
    names = [layer.name for layer in scene.artery.layers]
    if not data.layers:
        if len(names) > 1:
            raise SceneError(
                f"{data.source}: expected a column 'layer' that says of which layer the piece is "
                f"({', '.join(names)})"
            )
        return [0] * data.rows
    unknown = next((name for name in data.layers if name not in names), None)
    if unknown is not None:
        raise SceneError(f"{data.source}, column 'layer': expected {' or '.join(names)}, found {unknown!r}")
    return [names.index(name) for name in data.layers]


def _require_all(data: Data, column: Column) -> None:
    """Refuse empty cells where a tube or a piece is seen at what they hold."""
    if np.any(empty := np.isnan(column.values)):
        row = int(np.argmax(empty)) + 1
        raise SceneError(
            f"{data.source}, row {row} of numbers, column {column.name!r}: expected a number in every row"
        )


@dataclasses.dataclass(frozen=True)
class Problem:
    """All files: residuals as one vector, each over its weight."""

    experiments: tuple[Experiment, ...]
    """one for each file"""
    names: tuple[str, ...]
    """columns that are compared; one of the same name in several files is one"""
    group: np.ndarray
    """(n,) position in `names` of each residual"""
    measured: np.ndarray
    """(n,) internal units"""
    weights: np.ndarray
    """(n,) standard deviations, internal units; 1 where the file gives none"""
    weighed: np.ndarray
    """(names,) True where the file gives standard deviations"""
    runs: tuple[tuple[int, int, int], ...]
    """of each column of each file: its experiment, and where its residuals begin and end"""

    def column(self, run: int) -> Column:
        """The column behind a run."""
        place = [k for k, (e, _, _) in enumerate(self.runs) if e == self.runs[run][0]].index(run)
        return self.experiments[self.runs[run][0]].compared[place]

    def unit(self, name: int) -> Column:
        """A column with a name, for its unit."""
        return next(c for e in self.experiments for c in e.compared if c.name == self.names[name])

    def predicted(self, scene: Scene) -> Array:
        """What is compared, predicted, (n,); a JAX function."""
        parts = []
        for each in self.experiments:
            found = each.predict(scene)
            parts += [found[c.quantity][np.flatnonzero(~np.isnan(c.values))] for c in each.compared]
        return jnp.concatenate(parts)


def problem(experiments: Sequence[Experiment]) -> Problem:
    """Put the files together. Raises SceneError if columns of one name have different units."""
    names: list[str] = []
    columns: list[Column] = []
    runs, group, measured, weights = [], [], [], []
    at = 0
    for number, each in enumerate(experiments):
        for column in each.compared:
            if column.name not in names:
                names.append(column.name)
                columns.append(column)
            place = names.index(column.name)
            if (columns[place].deviation is None) != (column.deviation is None):
                raise SceneError(
                    f"{each.data.source}: expected standard deviations of {column.name!r} in every file or "
                    "in none"
                )
            kept = ~np.isnan(column.values)
            size = int(kept.sum())
            group.append(np.full(size, place))
            measured.append(column.values[kept])
            weights.append(np.ones(size) if column.deviation is None else column.deviation[kept])
            runs.append((number, at, at + size))
            at += size
    weighed = np.array([column.deviation is not None for column in columns])
    return Problem(
        tuple(experiments),
        tuple(names),
        np.concatenate(group),
        np.concatenate(measured),
        np.concatenate(weights),
        weighed,
        tuple(runs),
    )
