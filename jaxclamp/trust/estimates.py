"""How far the figures of a result may be off numerically, and where that comes from.

Four sources, each an estimate of (figure - exact figure), in the figure's unit:

- discretisation: the difference to a coarser twin of the scene, extrapolated with the element's order;
- bulk: the wall is not quite incompressible. With figure = exact + a / bulk, what is missing is the
  figure's derivative by log(bulk), at the solution: one linear solve, no iteration;
- contact stiffness: the jaws sink into the wall a little; as for the bulk modulus;
- contact smoothing: the jaws touch before they touch; with figure = exact + a smoothing.

The error of a figure is the sum of their sizes. It says nothing of the model: of constants, of symmetry.

Two clamps on one artery are wrong in much the same way, so that their difference is known far better than
either: the error of a difference is estimated source by source, the signed estimate of the one less that of
the other, and the sum of the sizes of what is left (`Estimate.__sub__`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import TypeVar

import jax
import numpy as np
from jax import Array

from jaxclamp.core.failures import EquilibriumError, Singular
from jaxclamp.observe.equilibria import Equilibria
from jaxclamp.observe.figures import FIGURES, POINT, WHOLE
from jaxclamp.observe.measures import Measure
from jaxclamp.scenes.address import get, replace
from jaxclamp.scenes.scene import Scene
from jaxclamp.solve.branch import ANOTHER, FOLLOWED
from jaxclamp.solve.clamping import clamp, inflate
from jaxclamp.solve.nested import coarser, on_coarser_mesh
from jaxclamp.solve.results import Result
from jaxclamp.solve.warm import predicted

CHANGE = 1e-3
"""relative change of a penalty for its derivative"""
SAME = 1e-4
"""how far two states of one equilibrium are apart at most, as part of the lumen's width"""
SOURCES = ("discretisation", "bulk", "contact_stiffness", "contact_smoothing")

Errors = dict[str, dict[str, float | None]]
Key = TypeVar("Key", bound=Hashable)


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A figure, or a difference of two, and what is known of how far it is off."""

    value: float
    """as computed"""
    sources: dict[str, float | None]
    """by `SOURCES`: estimates of (value - exact value), in the figure's unit; None if it is not known"""

    @property
    def error(self) -> float | None:
        """Sum of the sizes of the sources; None if one of them is not known."""
        known = [abs(part) for part in self.sources.values() if part is not None]
        return sum(known) if len(known) == len(self.sources) else None

    def __sub__(self, other: Estimate) -> Estimate:
        """The difference: what both have of an error cancels, source by source, before sizes are added."""
        left = {name: _difference(part, other.sources[name]) for name, part in self.sources.items()}
        return Estimate(self.value - other.value, left)


def _difference(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b


def figures(result: Result) -> dict[str, float]:
    """The main figures of a result by key: of the body, then of the last state, KEY.LAYER for layers."""
    assert result.physiological is not None
    body = result.physiological.values
    found = {
        "physiological.lumen_radius_mm": 0.5 * body["lumen_height_mm"],
        "physiological.axial_stress_at_P_kPa": body["axial_stress_at_P_kPa"],
    }
    if result.states[-1].stage == "clamping":
        for key in (figure.key for figure in FIGURES if figure.order is not None):
            value = result.final[key]
            parts = value.items() if isinstance(value, dict) else [("", value)]
            found |= {f"{key}.{layer}" if layer else key: float(part) for layer, part in parts}
    return found


@dataclasses.dataclass(frozen=True)
class Neighbours:
    """A result, the same scene on a coarser mesh, and to first order with other penalties.

    They are solved once; any number of figures and measures can then be estimated.
    """

    result: Result
    """whose errors are asked for"""
    twin: Result | None
    """on a coarser mesh; None if that has no equilibrium"""
    ratio: float
    """elements of the scene over elements of the twin, per direction"""
    penalised: dict[str, tuple[Result | None, float]]
    """by source: the result with a penalty raised by `CHANGE` (None if it was refused), and the sign of
    the source against the derivative by the penalty's logarithm"""

    def estimates(self, measures: Sequence[Measure]) -> dict[Measure, Estimate]:
        """Measures with their errors, in internal units; the result has reached its stop."""

        def read(result: Result) -> dict[Measure, float]:
            result.require(any(m.needs_stop for m in measures))
            return dict(zip(measures, map(float, _measured(tuple(measures), result.equilibria)), strict=True))

        return self.read(read, lambda m: WHOLE if m.name in WHOLES else POINT)

    def read(
        self, read: Callable[[Result], dict[Key, float]], order: Callable[[Key], float]
    ) -> dict[Key, Estimate]:
        """Numbers of the result by key, with their errors; order: with which a number converges."""
        values = read(self.result)
        twin = None if self.twin is None else read(self.twin)
        others = {
            name: (None if near is None else read(near), sign)
            for name, (near, sign) in self.penalised.items()
        }
        return {
            key: Estimate(
                value,
                {
                    "discretisation": None
                    if twin is None
                    else (value - twin[key]) / (1.0 - self.ratio ** order(key))
                }
                | {
                    name: None if near is None else _finite(sign * (near[key] - value) / CHANGE)
                    for name, (near, sign) in others.items()
                },
            )
            for key, value in values.items()
        }


def _measures(measures: tuple[Measure, ...], equilibria: Equilibria) -> list[Array]:
    return [measure(equilibria) for measure in measures]


# called once for each neighbour, it is compiled for a short compilation rather than for speed
_measured = partial(jax.jit, static_argnums=0, compiler_options={"xla_backend_optimization_level": 0})(
    _measures
)

WHOLES = (
    "clamp_force",
    "jaw_travel",
    "lumen_height",
    "lumen_width",
    "lumen_area",
    "mean_contact_pressure",
    "stored_energy",
    "physiological_lumen_radius",
)
"""measures that converge as figures of the whole; any other is taken to converge as one at a point"""


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def neighbours(result: Result) -> Neighbours:
    """What the errors of a result are read off: some iterations on a coarser twin, a few linear solves."""
    penalties = {
        "bulk": (bulk_paths(result.scene), -1.0),
        "contact_stiffness": (("contact.stiffness",), -1.0),
        "contact_smoothing": (("contact.smoothing",), 1.0),
    }
    twin, ratio = _twin(result)
    penalised = {name: (_penalised(result, paths), sign) for name, (paths, sign) in penalties.items()}
    return Neighbours(result, twin, ratio, penalised)


def estimate(result: Result, near: Neighbours | None = None) -> Errors:
    """Errors by figure: `value`, `error` (None if it is not known) and the four signed sources."""
    found = (near or neighbours(result)).read(figures, _order)
    return {key: {"value": e.value, "error": e.error} | e.sources for key, e in found.items()}


def with_errors(result: Result, near: Neighbours | None = None) -> Result:
    """The result with its errors estimated, from its neighbours if they are at hand.

    An answer that was followed from another result's is held against the closing path, on the coarser twin.
    """
    near = near or neighbours(result)
    solver = result.solver | {"branch": _examined(result, near.twin)}
    return dataclasses.replace(result, errors=estimate(result, near), solver=solver)


def _examined(result: Result, twin: Result | None) -> str | None:
    """The result's branch; a followed one is another equilibrium if its twin is not where closing leads.

    The same on both ways proves nothing: a coarser mesh has fewer equilibria to be told apart.
    """
    branch: str | None = result.solver["branch"]
    if branch != FOLLOWED or twin is None or twin.solver["branch"] != FOLLOWED:
        return branch
    try:
        closed = clamp(twin.scene)
    except EquilibriumError:
        return branch
    ends = [np.asarray(r.states[-1].state.x) for r in (closed, twin)]
    apart = float(np.max(np.abs(ends[0] - ends[1])))
    if apart <= SAME * float(twin.final["lumen_width_mm"]):
        return branch
    forces = [f"{r.final['clamp_force_N']:.4g} N" for r in (closed, twin)]
    said = "on a coarser mesh, closing anew leads to a jaw force of {}, following this one to {}"
    return f"{ANOTHER}: {said.format(*forces)}"


def bulk_paths(scene: Scene) -> tuple[str, ...]:
    """Paths of the layers' bulk moduli."""
    return tuple(f"artery.layers[{i}].material.bulk" for i in range(len(scene.artery.layers)))


def _twin(result: Result) -> tuple[Result | None, float]:
    """The scene on a coarser mesh, if it has an equilibrium there, and how much coarser per direction."""
    ratio = coarser(result.scene.mesh)[1]
    if result.coarser is not None:  # on which its closing path was walked
        return result.coarser, ratio
    scene = on_coarser_mesh(result.scene)
    solve: Callable[..., Result] = clamp if result.states[-1].stage == "clamping" else inflate
    try:
        return None if scene is None else solve(scene, guess=result), ratio
    except EquilibriumError:
        return None, ratio


def _order(key: str) -> float:
    """Order with which the figure of a key such as "peak_axial_stress_kPa.media" converges."""
    name = key.removeprefix("physiological.").split(".")[0]
    orders = {figure.key: figure.order for figure in FIGURES}
    return orders.get(name) or WHOLE


def _penalised(result: Result, paths: tuple[str, ...]) -> Result | None:
    """The result with a penalty's constants raised by `CHANGE`, to first order; None if it is refused."""
    try:
        return predicted(result, multiplied(result.scene, paths, 1.0 + CHANGE))
    except (EquilibriumError, Singular):  # the result stays, its error is not known
        return None


def multiplied(scene: Scene, paths: tuple[str, ...], factor: float) -> Scene:
    """A scene with the numbers at some addresses (of penalties, such as layers' bulk moduli) multiplied."""
    for path in paths:
        scene = replace(scene, path, factor * get(scene, path))
    return scene
