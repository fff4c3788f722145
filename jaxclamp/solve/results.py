"""What a clamping gives: its converged states, and the content of result.json."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.metadata
import math
import platform
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from jaxclamp.core.failures import EquilibriumError
from jaxclamp.core.parts import own_parts
from jaxclamp.observe import closure
from jaxclamp.observe.equilibria import Equilibria
from jaxclamp.observe.figures import FIGURES, NODES_SUNK
from jaxclamp.observe.measure import Measure, require_measure
from jaxclamp.observe.measures import PEAK_SHARPNESS
from jaxclamp.potential.energy import State
from jaxclamp.potential.kinds import needed
from jaxclamp.potential.model import Model
from jaxclamp.scenes.files import scene_table
from jaxclamp.scenes.notes import notes, notes_of_states
from jaxclamp.scenes.scene import Scene
from jaxclamp.solve.branch import ROUNDING, work
from jaxclamp.solve.linear_solvers import Factors
from jaxclamp.solve.newton import Equilibrium

if TYPE_CHECKING:
    from jaxclamp.pictures.plots import Picture


FINAL_KEYS = (*(figure.key for figure in FIGURES if figure.contract), "closing_force_N")
"""always in a result's `final`, null where no state converged"""


@dataclasses.dataclass(frozen=True)
class Kept:
    """One converged state and what was read off it."""

    stage: str
    """load-free, physiological or clamping"""
    equilibrium: Equilibrium
    """the state and its tangent"""
    values: dict[str, Any]
    """as in result.json: floats, and one dict per layer for peaks"""
    model: Model
    """what it is an equilibrium of: states of the closing path may be of a coarser mesh than the last"""

    def __repr__(self) -> str:
        """Its stage, and how far the lumen is closed."""
        return f"<{self.stage} state: {_brief(self.values)}>"

    @property
    def state(self) -> State:
        """Positions, pressures and jaw height."""
        return self.equilibrium.state


@dataclasses.dataclass(frozen=True)
class Result:
    """Every converged state of a clamping."""

    model: Model
    """the scene made ready"""
    states: tuple[Kept, ...]
    """load-free, physiological, then closing, in order"""
    failure: EquilibriumError | None
    """why the stop was not reached; None if it was"""
    solver: dict[str, Any]
    """counts and checks, as in result.json"""
    cost: dict[str, Any]
    """times and memory, as in result.json"""
    factors: Factors = dataclasses.field(repr=False)
    """of its tangents, for derivatives"""
    every_term: bool = False
    """solved with terms that its stop seemed not to need"""
    coarser: Result | None = None
    """the same on the coarser mesh on which its closing path was walked; None if that was its own"""
    errors: dict[str, dict[str, float | None]] | None = None
    """how far the main figures may be off, see `jaxclamp.trust.estimates`; None if it was not asked for"""
    versions: dict[str, str] = dataclasses.field(default_factory=lambda: versions())
    """of what its numbers depend on, where they were made"""

    write_outputs: ClassVar[Callable[[Result, Path], list[Path]]]
    """what `write` does; given by the package's door, because it lies above"""

    def __repr__(self) -> str:
        """What came of it, and whether it is known how far its figures may be off."""
        reached = f"{len(self.states)} states"
        if self.states:
            reached += f", {_brief(self.states[-1].values)}"
        if self.failure is not None:
            reached += f"; NOT CONVERGED in stage '{self.failure.stage}', see .failure"
        known = "not estimated, see jaxclamp.with_errors" if self.errors is None else "in .errors"
        return f"<Result of {self.scene.title!r}: {reached}; numerical errors: {known}>"

    def measure(self, measure: Measure) -> float:
        """The value of a measure in internal units (mm, kPa, mN, uJ), from the states at hand.

        Raises EquilibriumError if the stop was not reached, ValueError if it was not asked for.
        """
        self.require(require_measure(measure).needs_stop)
        return float(measure(self.equilibria))

    def require(self, to_stop: bool) -> None:
        """Raise EquilibriumError or ValueError unless there is something to measure or differentiate."""
        if self.failure is not None:
            raise self.failure
        if to_stop and self.states[-1].stage != "clamping":
            raise ValueError("this result is of the artery without its clamp: use jaxclamp.clamp")

    @property
    def equilibria(self) -> Equilibria:
        """The scene with its state in the body and, if it was closed, its last one: what measures look at."""
        assert self.physiological is not None
        last = self.states[-1]
        closed = (last.state,) if last.stage == "clamping" else ()
        return Equilibria(
            potential=self.model.potential,
            marks=self.model.marks,
            states=(self.physiological.state, *closed),
            injury=self.scene.injury,
        )

    @property
    def scene(self) -> Scene:
        """The scene that was solved."""
        return self.model.scene

    @property
    def converged(self) -> bool:
        """True if the stop was reached."""
        return self.failure is None

    def _stage(self, stage: str) -> list[Kept]:
        return [kept for kept in self.states if kept.stage == stage]

    @property
    def load_free(self) -> Kept | None:
        """The state without loads; None if it did not converge."""
        return next(iter(self._stage("load-free")), None)

    def load_free_like(self, kept: Kept) -> Kept | None:
        """The state without loads on the mesh of one of the states."""
        if self.coarser is None or kept.model is self.model:
            return self.load_free
        return self.coarser.load_free_like(kept)

    def in_body_like(self, kept: Kept) -> Kept | None:
        """The state in the body on the mesh of one of the states."""
        if self.coarser is None or kept.model is self.model:
            return self.physiological
        return self.coarser.in_body_like(kept)

    @property
    def physiological(self) -> Kept | None:
        """The state in the body; None if it did not converge."""
        return next(iter(self._stage("physiological")), None)

    @property
    def on_the_way(self) -> list[Kept]:
        """States under the closing jaws before the last one."""
        return [kept for kept in self.states[:-1] if kept.stage == "clamping"]

    @property
    def closing(self) -> list[Kept]:
        """The physiological state and all states with the jaws on the artery."""
        return self._stage("physiological") + self._stage("clamping")

    @property
    def history(self) -> list[dict[str, Any]]:
        """One record per converged state from the physiological one on."""
        return [self._record(kept) for kept in self.closing]

    @property
    def final(self) -> dict[str, Any]:
        """The record of the last converged state; None everywhere if it is not the artery in the body."""
        return self.history[-1] if self.history else dict.fromkeys(FINAL_KEYS)

    def _record(self, kept: Kept) -> dict[str, Any]:
        """A state's record."""
        e = kept.equilibrium
        seen = {key: value for key, value in kept.values.items() if key != NODES_SUNK}
        return (
            {"stage": kept.stage}
            | seen
            | {
                "closing_force_N": self._closing_force() if kept.values["closed"] else None,
                "negative_pivots": e.negative_pivots,
                "snapped": e.snapped,
                "newton_iterations": e.iterations,
                "mesh": kept.model.scene.mesh.words,
            }
        )

    def _closing_force(self) -> float | None:
        """Force on one jaw as the lumen is just closed, N; None if no state is at that very stop."""
        at_closure = lambda kept: abs(kept.values["closure"] - 1.0) < closure.ROUNDING  # noqa: E731
        on_own_mesh = (kept for kept in self._stage("clamping") if kept.model is self.model)
        first = next(filter(at_closure, on_own_mesh), None)
        return None if first is None else first.values["clamp_force_N"]

    def history_table(self) -> dict[str, np.ndarray]:
        """The history by column, each (n_states,): made for `pandas.DataFrame` and the like.

        Columns are called as in history.csv: name and unit (`clamp_force_N`), with the layer's name behind
        (`peak_axial_stress_kPa.media`) and the axis of a place (`peak_axial_stress_location_mm.media.z`).
        Numbers that are not defined are nan.
        """
        rows = [dict(flat(record)) for record in self.history]
        names = list(dict.fromkeys(name for row in rows for name in row))
        return {name: np.array([_number(row.get(name)) for row in rows]) for name in names}

    # --- files ----------------------------------------------------------------------------------------

    def save(self, path: str | Path) -> Path:
        """Write everything to one HDF5 file that `jaxclamp.load_result` reads back; returns where it is.

        States, scene, history, errors and failure, to the last bit. Raises OSError, with nothing half
        written; SceneError for a scene that could not be read back.
        """
        from jaxclamp.solve.saving import save

        return save(self, path)

    def write(self, folder: str | Path) -> list[Path]:
        """Write what `jaxclamp run --out` leaves into a folder (made if missing); returns the files.

        README.md in it says what they are. Files of an earlier result there are replaced. Raises OSError,
        with nothing half written; FileExistsError where files of such names are there without such a result.
        """
        return Result.write_outputs(self, Path(folder))

    def to_dict(self) -> dict[str, Any]:
        """The content of result.json."""
        scene = self.scene
        load_free, base = self.load_free, self.physiological
        return {
            "title": scene.title,
            "converged": self.converged,
            "failure": None if self.failure is None else str(self.failure),
            "scene": scene_table(scene),
            "load_free": {
                "lumen_radius_mm": _radius(load_free),
                "outer_radius_mm": load_free and load_free.values["outer_radius_mm"],
            },
            "physiological": {
                "lumen_radius_mm": _radius(base),
                "outer_radius_mm": base and base.values["outer_radius_mm"],
                "axial_stress_at_P_kPa": base and base.values["axial_stress_at_P_kPa"],
                "circumferential_stress_at_P_kPa": base and base.values["circumferential_stress_at_P_kPa"],
            },
            "final": self.final,
            "errors": self.errors,
            "history": self.history,
            "model": {
                "symmetry": self.model.symmetry.share,
                "modelled": self.model.symmetry.words,
                "elements": self.model.mesh.n_cells,
                "element": scene.mesh.element,
                "unknowns": self.model.pattern.n,
                "terms": needed(scene, every_term=self.every_term),
                "peak_sharpness": PEAK_SHARPNESS,
            },
            "solver": self.solver,
            "cost": self.cost,
            "notes": notes(scene) + notes_of_states(self.history),
            "own_parts": own_parts(scene),
            "versions": self.versions,
        }

    # --- figures: matplotlib is imported when one is drawn ------------------------------------------

    def plot_wall_stress(self) -> Picture:
        """Circumferential and axial stress through the wall, load-free and in the body."""
        from jaxclamp.pictures import plots

        return plots.plot_wall_stress(self)

    def plot_sections(self) -> Picture:
        """Deformed cross-sections and longitudinal sections with the jaws, states A to F."""
        from jaxclamp.pictures import plots

        return plots.plot_sections(self)

    def plot_stress_at_P(self) -> Picture:
        """Normalised axial and circumferential stress at P against jaw travel."""
        from jaxclamp.pictures import plots

        return plots.plot_stress_at_P(self)

    def plot_axial_stress_maps(self) -> Picture:
        """Axial stress of every layer in the last state."""
        from jaxclamp.pictures import plots

        return plots.plot_axial_stress_maps(self)

    def plot_damage_maps(self) -> Picture:
        """Damage of every layer in the last state."""
        from jaxclamp.pictures import plots

        return plots.plot_damage_maps(self)

    def plot_force_travel(self) -> Picture:
        """Jaw force and occlusion against jaw travel."""
        from jaxclamp.pictures import plots

        return plots.plot_force_travel(self)


def flat(record: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """A record's numbers by column: KEY, KEY.LAYER, KEY.LAYER.x for places, KEY[0].NAME for thresholds."""
    for key, value in record.items():
        if isinstance(value, list) and (not value or isinstance(value[0], dict)):
            for number, item in enumerate(value):
                numbers = {k: v for k, v in item.items() if isinstance(v, float)}
                yield from flat(numbers, f"{prefix}{key}[{number}].")
            continue
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        elif isinstance(value, list | tuple):
            yield from ((f"{prefix}{key}.{axis}", v) for axis, v in zip("xyz", value, strict=False))
        else:
            yield prefix + key, value


def _number(value: Any) -> Any:
    return math.nan if value is None else value


def _brief(values: dict[str, Any]) -> str:
    """The main figures of a state in a few words."""
    occlusion, force = values["occlusion"], values["clamp_force_N"]
    return f"occlusion {occlusion:.1%}, jaw force {force:.3g} N"


def _radius(kept: Kept | None) -> float | None:
    return None if kept is None else 0.5 * kept.values["lumen_height_mm"]


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on; behind jaxclamp's a digest of its sources: 0.1.0+1a2b3c4d."""
    names = ("jaxclamp", "jax", "jaxlib", "numpy", "scipy")
    found = {"python": platform.python_version()}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    found["jaxclamp"] += f"+{_digest_of(Path(__file__).parents[1])}"
    return found


@functools.cache
def _digest_of(package: Path) -> str:
    """The beginning of a digest of the Python files of a package: changes of the code between versions."""
    whole = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        content = path.read_bytes()
        whole.update(f"{path.relative_to(package).as_posix()} {len(content)}\n".encode() + content)
    return whole.hexdigest()[:8]


def work_balance(closing: list[Kept]) -> float | None:
    """Work of the jaws (`branch.work`) against the change of total energy over the closing.

    Relative to all work done, back and forth, and no less than what rounding leaves of the energy.
    """
    if len(closing) < 3:
        return None
    steps = [work(a.equilibrium, b.equilibrium) for a, b in pairwise(closing)]
    levels = [float(kept.equilibrium.lin.energy) for kept in closing]
    least = ROUNDING * max(map(abs, levels)) + 1e-300
    return abs(sum(steps) - (levels[-1] - levels[0])) / max(sum(map(abs, steps)), least)
