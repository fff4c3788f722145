"""How far the figures of a result may be off numerically, and where that comes from.

Four sources, each an estimate of (figure - exact figure), in the figure's unit:

- discretisation: the difference to a coarser twin of the scene, extrapolated with the element's order;
- bulk: the wall is not quite incompressible. With figure = exact + a / bulk, what is missing is the
  figure's derivative by log(bulk), at the solution: one linear solve, no iteration;
- contact stiffness: the jaws sink into the wall a little; as for the bulk modulus;
- contact smoothing: the jaws touch before they touch; with figure = exact + a smoothing.

The error of a figure is the sum of their sizes. It says nothing of the model: of constants, of symmetry.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import jax
import numpy as np

from jaxclamp.core.failures import EquilibriumError, Singular
from jaxclamp.observe.figures import FIGURES, WHOLE
from jaxclamp.scenes.address import get, replace
from jaxclamp.scenes.scene import MeshSettings, Scene
from jaxclamp.solve.branch import ANOTHER, FOLLOWED
from jaxclamp.solve.clamping import clamp, inflate
from jaxclamp.solve.results import Result
from jaxclamp.solve.warm import predicted

CHANGE = 1e-3
"""relative change of a penalty for its derivative"""
COARSENINGS = (1.3, 2.0)
"""elements of the scene over elements of its twin, per direction"""
SAME = 1e-4
"""how far two states of one equilibrium are apart at most, as part of the lumen's width"""
SOURCES = ("discretisation", "bulk", "contact_stiffness", "contact_smoothing")

Errors = dict[str, dict[str, float | None]]


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


def coarser(mesh: MeshSettings) -> tuple[MeshSettings, float]:
    """A mesh coarsened as evenly in all directions as whole numbers allow, and by how much per direction."""
    counts = np.array([mesh.circumferential, mesh.axial, *mesh.radial], float)
    least = np.array([2, 2, *[1] * len(mesh.radial)])

    def unevenness(factor: float) -> float:
        return float(np.ptp(np.log(counts / np.maximum(np.round(counts / factor), least))))

    factor = min(np.linspace(*COARSENINGS, 71), key=unevenness)
    fewer = np.maximum(np.round(counts / factor), least).astype(int).tolist()
    coarse = dataclasses.replace(mesh, circumferential=fewer[0], axial=fewer[1], radial=tuple(fewer[2:]))
    cells = [m.circumferential * m.axial * sum(m.radial) for m in (mesh, coarse)]
    return coarse, (cells[0] / cells[1]) ** (1.0 / 3.0)


def estimate(result: Result) -> Errors:
    """Errors by figure: `value`, `error` (None if it is not known) and the four signed sources."""
    return _estimate(result, coarser_twin(result))


def _estimate(result: Result, twin: Result | None) -> Errors:
    values = figures(result)
    sources = {
        "discretisation": _from_the_mesh(result, twin, values),
        "bulk": _from_a_penalty(result, values, bulk_paths(result.scene), -1.0),
        "contact_stiffness": _from_a_penalty(result, values, ("contact.stiffness",), -1.0),
        "contact_smoothing": _from_a_penalty(result, values, ("contact.smoothing",), 1.0),
    }
    return {
        key: {"value": value, "error": _total([part[key] for part in sources.values()])}
        | {name: part[key] for name, part in sources.items()}
        for key, value in values.items()
    }


def with_errors(result: Result) -> Result:
    """The result with its errors estimated: some iterations on a coarser twin, a few linear solves.

    An answer that was followed from a neighbour's is held against the closing path, on the coarser twin.
    """
    twin = coarser_twin(result)
    solver = result.solver | {"branch": _examined(result, twin)}
    return dataclasses.replace(result, errors=_estimate(result, twin), solver=solver)


def coarser_twin(result: Result) -> Result | None:
    """The scene on a coarser mesh, solved from the result; None if it has no equilibrium, or no such mesh."""
    if any(np.ndim(leaf) > 1 for leaf in jax.tree_util.tree_leaves(result.scene.artery)):
        return None  # constants of each point belong to one mesh
    scene = dataclasses.replace(result.scene, mesh=coarser(result.scene.mesh)[0])
    solve: Callable[..., Result] = clamp if result.states[-1].stage == "clamping" else inflate
    try:
        return solve(scene, guess=result)
    except EquilibriumError:
        return None


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
    apart = float(np.max(np.abs(np.asarray(closed.states[-1].state.x - twin.states[-1].state.x))))
    if apart <= SAME * float(twin.final["lumen_width_mm"]):
        return branch
    forces = [f"{r.final['clamp_force_N']:.4g} N" for r in (closed, twin)]
    said = "on a coarser mesh, closing anew leads to a jaw force of {}, following this one to {}"
    return f"{ANOTHER}: {said.format(*forces)}"


def bulk_paths(scene: Scene) -> tuple[str, ...]:
    """Paths of the layers' bulk moduli."""
    return tuple(f"artery.layers[{i}].material.bulk" for i in range(len(scene.artery.layers)))


def _total(parts: list[float | None]) -> float | None:
    known = [abs(part) for part in parts if part is not None]
    return sum(known) if len(known) == len(parts) else None


def _from_the_mesh(result: Result, twin: Result | None, values: dict[str, float]) -> dict[str, float | None]:
    """Figure less the figure on an infinitely fine mesh; None without a twin."""
    if twin is None:
        return dict.fromkeys(values)
    ratio, coarse = coarser(result.scene.mesh)[1], figures(twin)
    return {key: (value - coarse[key]) / (1.0 - ratio ** _order(key)) for key, value in values.items()}


def _order(key: str) -> float:
    """Order with which the figure of a key such as "peak_axial_stress_kPa.media" converges."""
    name = key.removeprefix("physiological.").split(".")[0]
    orders = {figure.key: figure.order for figure in FIGURES}
    return orders.get(name) or WHOLE


def _from_a_penalty(
    result: Result, values: dict[str, float], paths: tuple[str, ...], sign: float
) -> dict[str, float | None]:
    """Sign times the derivative of each figure by the logarithm of a penalty's constants; None if refused."""
    scene = multiplied(result.scene, paths, 1.0 + CHANGE)
    try:
        near = figures(predicted(result, scene))
    except (
        EquilibriumError,
        Singular,
    ):  # the result stays, its error is not known
        return dict.fromkeys(values)
    slopes = {key: sign * (near[key] - value) / CHANGE for key, value in values.items()}
    return {key: slope if math.isfinite(slope) else None for key, slope in slopes.items()}


def multiplied(scene: Scene, paths: tuple[str, ...], factor: float) -> Scene:
    """A scene with the numbers at some addresses (of penalties, such as layers' bulk moduli) multiplied."""
    for path in paths:
        scene = replace(scene, path, factor * get(scene, path))
    return scene
