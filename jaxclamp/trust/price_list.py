"""The price list: what accuracy costs, over the numerical choices of a scene.

One choice at a time is varied around the scene's own (`ladder`); each variant is solved in a process of
its own, so that its memory is its own (`measure`); errors are against a reference (`price_list`): the
scene's figures extrapolated over three meshes (Richardson), less what its penalties add (`errors`).
"""

from __future__ import annotations

import dataclasses
import math
import multiprocessing
import os
import platform
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

from jaxclamp.core.failures import EquilibriumError, NoReference, SceneError, TooLittleMemory
from jaxclamp.core.parts import by_value, own_parts
from jaxclamp.core.progress import Progress
from jaxclamp.fem.landmarks import layer_of_P
from jaxclamp.observe.measures import smooth_peak_axial_stress
from jaxclamp.observe.stops import OcclusionStop
from jaxclamp.potential.tangent import linearise
from jaxclamp.scenes.address import replace
from jaxclamp.scenes.scene import MeshSettings, Scene
from jaxclamp.sensitivity.implicit import evaluate
from jaxclamp.solve.clamping import clamp
from jaxclamp.solve.linear_solvers import available
from jaxclamp.solve.results import Result, versions
from jaxclamp.trust.estimates import SOURCES, bulk_paths, estimate, figures, multiplied

STAGE = "accuracy"
"""of what is told while it is measured"""
REFERENCE_MESHES = (1.0, 1.5, 2.0)
"""elements per direction, over the scene's, that the reference is extrapolated from"""
WARM_UP = 0.02
"""occlusion of a short clamping that compiles everything before the one that is timed"""
ORDERS = (0.5, 4.0)
"""orders of convergence that are believed; otherwise the element's, 2"""
GRADIENT = "slope_of_smooth_peak_kPa"
"""derivative of the smooth peak (of the layer of P) by the logarithm of the jaw's size: all its
lengths and slopes in proportion"""


@dataclasses.dataclass(frozen=True)
class Rung:
    """One variant of a scene."""

    group: str
    """what is varied"""
    setting: str
    """and how, in words"""
    scene: Scene
    """with that choice"""
    single_precision: bool = False
    """judge the forces of float32 instead of solving"""


@dataclasses.dataclass(frozen=True)
class Price:
    """What a variant gave, and what it cost; `figures` is None where it has no solution."""

    group: str
    """what is varied"""
    setting: str
    """and how, in words"""
    figures: dict[str, float] | None
    """by key, in the key's unit"""
    failure: str | None = None
    """why there are none"""
    elements: int = 0
    """of the modelled part"""
    unknowns: int = 0
    """of the linear systems"""
    newton_iterations: int = 0
    """of the whole path"""
    seconds: float = math.nan
    """one clamping, compiled"""
    memory_MB: float | None = None
    """peak of a process that does nothing else"""


def ladder(scene: Scene) -> list[Rung]:
    """The variants: the mesh in all directions and in each, the element, penalties, and the solver."""
    return [*_meshes(scene), *_penalties(scene), *_solvers(scene)]


def _meshes(scene: Scene) -> Iterator[Rung]:
    own = scene.mesh
    variants = [("mesh", scaled(own, factor)) for factor in (0.5, 2 / 3, *REFERENCE_MESHES)]
    for direction in ("circumferential", "axial", "radial"):
        for factor in (0.5, 2.0):
            count = getattr(scaled(own, factor), direction)
            variants.append((direction, dataclasses.replace(own, **{direction: count})))
    if own.element != "q2p1":
        quadratic = dataclasses.replace(own, element="q2p1")
        variants += [("element", scaled(quadratic, factor)) for factor in (0.5, 0.7)]
    for group, mesh in variants:
        element = "" if mesh.element == own.element else f"{mesh.element} "
        yield Rung(group, f"{element}{counts(mesh)}", dataclasses.replace(scene, mesh=mesh))
    for points in (2, 8):
        mesh = dataclasses.replace(own, contact_points=points)
        yield Rung("contact points", f"{points} x {points}", dataclasses.replace(scene, mesh=mesh))


def _penalties(scene: Scene) -> Iterator[Rung]:
    for factor in (0.1, 10.0, 100.0):
        yield Rung("bulk", f"x {factor:g}", multiplied(scene, bulk_paths(scene), factor))
    for name, factors in (("stiffness", (0.1, 10.0, 100.0)), ("smoothing", (0.1, 10.0))):
        for factor in factors:
            yield Rung(f"contact {name}", f"x {factor:g}", multiplied(scene, (f"contact.{name}",), factor))


def _solvers(scene: Scene) -> Iterator[Rung]:
    settings: list[tuple[str, str, dict[str, Any]]] = [
        ("tolerance", f"{t:g}", {"tolerance": t}) for t in (1e-4, 1e-6, 1e-12)
    ]
    settings += [("linear solver", name, {"linear_solver": name}) for name in available(1)]
    for group, setting, changes in settings:
        solver = dataclasses.replace(scene.solver, **changes)
        yield Rung(group, setting, dataclasses.replace(scene, solver=solver))
    yield Rung("precision", "float32 forces", scene, single_precision=True)


def scaled(mesh: MeshSettings, factor: float) -> MeshSettings:
    """A mesh with `factor` times the elements in each direction."""
    times = lambda n, least: max(math.floor(n * factor + 0.5), least)  # noqa: E731
    return dataclasses.replace(
        mesh,
        circumferential=times(mesh.circumferential, 2),
        axial=times(mesh.axial, 2),
        radial=tuple(times(n, 1) for n in mesh.radial),
    )


def counts(mesh: MeshSettings) -> str:
    """Elements round, along and through, such as "10x15x8"."""
    return f"{mesh.circumferential}x{mesh.axial}x{sum(mesh.radial)}"


def solve(rung: Rung) -> Price:
    """Solve a variant in this process."""
    try:
        clamp(
            dataclasses.replace(
                rung.scene, stop=OcclusionStop(kind="occlusion", occlusion=jnp.asarray(WARM_UP))
            )
        )
        start = time.perf_counter()
        result = clamp(rung.scene)
        seconds = time.perf_counter() - start
    except (EquilibriumError, SceneError, TooLittleMemory) as error:
        return Price(rung.group, rung.setting, None, str(error))
    memory = result.cost["peak_memory_MB"]
    found: dict[str, float] | None = figures(result) | {GRADIENT: slope_by_jaw_size(result)}
    failure = None
    if rung.single_precision:
        found, failure = _in_single_precision(result)
    model = result.model
    return Price(
        rung.group,
        rung.setting,
        found,
        failure,
        model.mesh.n_cells,
        model.pattern.n,
        result.solver["newton_iterations"],
        seconds,
        memory,
    )


def slope_by_jaw_size(result: Result) -> float:
    """Derivative of the smooth axial peak of the layer of P by the logarithm of the jaw's size, kPa."""
    scene = result.scene
    measure = smooth_peak_axial_stress(inner_layer(scene))
    jaw = jax.tree_util.tree_map(lambda leaf: np.asarray(leaf, float), scene.clamp.jaw)
    peak = lambda j: evaluate(replace(scene, "clamp.jaw", j), measure, guess=result)  # noqa: E731
    pairs = zip(*map(jax.tree_util.tree_leaves, (jaw, jax.grad(peak)(jaw))), strict=True)
    return float(sum(np.vdot(a, b) for a, b in pairs))


def inner_layer(scene: Scene) -> str:
    """Name of the layer that P is on."""
    names = tuple(layer.name for layer in scene.artery.layers)
    return names[layer_of_P(names)]


def _in_single_precision(result: Result) -> tuple[None, str]:
    """What the forces of float32 leave at the solution of float64: they cannot be solved to less."""
    single = lambda tree: jax.tree_util.tree_map(  # noqa: E731
        lambda a: np.asarray(a, np.float32) if np.asarray(a).dtype == np.float64 else a, tree
    )
    last = result.states[-1].equilibrium
    with jax.numpy_dtype_promotion("standard"):
        model = result.model
        lin = linearise(single(model.potential), single(last.state), model.pattern)
    left = float(np.linalg.norm(np.asarray(lin.residual, float))) / float(last.lin.reactions)
    return None, (
        f"forces of float32 leave {left:.1g} of the reactions at the solution of float64: not admissible"
        if math.isfinite(left)
        else "forces of float32 are not finite: the laws' guard against overflow needs the range of float64"
    )


def measure(rungs: list[Rung], tell: Callable[[Progress], Any]) -> list[Price]:
    """Solve every variant in a process of its own, one after the other."""
    found: list[Price] = []
    context = multiprocessing.get_context("spawn")
    for number, rung in enumerate(rungs):
        said = f"variant {number + 1} of {len(rungs)}, {rung.group}: {rung.setting}"
        tell(Progress(STAGE, number / len(rungs), said))
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            try:
                found.append(pool.submit(by_value(solve, rung)).result())
            except (MemoryError, OSError, BrokenExecutor, jax.errors.JaxRuntimeError) as error:
                # out of memory, in one of the ways in which that shows
                found.append(Price(rung.group, rung.setting, None, f"the machine refused: {error}"))
    tell(Progress(STAGE, 1.0, f"{len(rungs)} variants"))
    return found


# ------------------------------------------------------------------------------- errors


@dataclasses.dataclass(frozen=True)
class Limit:
    """A figure extrapolated to an infinitely fine mesh."""

    value: float
    """in the figure's unit"""
    order: float
    """of convergence"""
    believed: bool
    """the order was found from three meshes; otherwise it is the element's"""
    spread: float
    """distance to the figure of the finest mesh"""


def richardson(sizes: list[float], values: list[float]) -> Limit:
    """The limit of values on three meshes of decreasing cell size: q = q_0 + a h**order."""
    (h1, h2, h3), (q1, q2, q3) = sizes, values

    def miss(order: float) -> float:
        return (q1 - q2) * (h2**order - h3**order) - (q2 - q3) * (h1**order - h2**order)

    believed = miss(ORDERS[0]) * miss(ORDERS[1]) < 0.0
    order = float(brentq(miss, *ORDERS)) if believed else 2.0
    value = q3 + (q3 - q2) * h3**order / (h2**order - h3**order)
    return Limit(value, order, believed, abs(value - q3))


@dataclasses.dataclass(frozen=True)
class PriceList:
    """Every variant with its errors."""

    title: str
    """of the scene"""
    layer: str
    """name of the layer of P"""
    prices: list[Price]
    """of every variant"""
    limits: dict[str, Limit]
    """by key of the figure"""
    exact: dict[str, float]
    """the reference: extrapolated over meshes, less what the penalties add"""
    sources: dict[str, dict[str, float | None]]
    """of the scene itself: signed error of each figure by source"""
    own_parts: list[dict[str, str | None]] = dataclasses.field(default_factory=list)
    """laws, jaws and stops of a user's own, with the digests of their files"""

    def error(self, price: Price, key: str) -> float | None:
        """Relative error of a figure of a variant."""
        if price.figures is None or key not in price.figures or not self.exact[key]:
            return None
        return abs(price.figures[key] / self.exact[key] - 1.0)

    def front(self, key: str) -> list[Price]:
        """The variants that no other beats in both time and error of a figure, cheapest first."""
        known = [(p.seconds, e, p) for p in self.prices if (e := self.error(p, key)) is not None]
        found: list[Price] = []
        least = math.inf
        for _, error, price in sorted(known, key=lambda each: each[:2]):
            if error < least:
                least = error
                found.append(price)
        return found

    def to_dict(self) -> dict[str, Any]:
        """The content of accuracy.json."""
        return {
            "title": self.title,
            "machine": machine(),
            "versions": versions(),
            "own_parts": self.own_parts,
            "reference": {
                key: {"exact": self.exact[key], "limit_of_meshes": dataclasses.asdict(limit)}
                for key, limit in self.limits.items()
            },
            "sources": self.sources,
            "variants": [
                dataclasses.asdict(p) | {"errors": {key: self.error(p, key) for key in self.exact}}
                for p in self.prices
            ],
            "front": {key: [f"{p.group}: {p.setting}" for p in self.front(key)] for key in self.exact},
        }


def machine() -> str:
    """What the times are of."""
    return f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}"


def price_list(scene: Scene, progress: Callable[[Progress], Any] | None = None) -> PriceList:
    """Measure what accuracy costs for a scene.

    Raises EquilibriumError if the scene has no solution, NoReference if a finer mesh has none.
    """
    tell, rungs = progress or (lambda event: None), ladder(scene)
    share = 1.0 / (1 + len(rungs))
    tell(Progress(STAGE, 0.0, f"the scene itself, then {len(rungs)} variants of it; compiling"))
    last = lambda e: tell(Progress(STAGE, 0.0, f"the scene itself, {e.stage}: {e.message}"))  # noqa: E731
    own = clamp(scene, progress=last)
    tell(Progress(STAGE, 0.0, "the scene itself: where its errors come from"))
    sources = estimate(own)
    heard = lambda e: tell(dataclasses.replace(e, fraction=share + (1.0 - share) * e.fraction))  # noqa: E731
    prices = measure(rungs, heard)
    by_mesh = {p.setting: p for p in prices if p.group == "mesh"}
    fine = [by_mesh[counts(scaled(scene.mesh, factor))] for factor in REFERENCE_MESHES]
    solved = [(p, p.figures) for p in fine if p.figures is not None]
    if len(solved) < len(fine):
        failed = next(p for p in fine if p.figures is None)
        raise NoReference(f"no reference for the errors on {failed.setting} elements: {failed.failure}")
    sizes = [p.elements ** (-1.0 / 3.0) for p, _ in solved]
    limits = {key: richardson(sizes, [values[key] for _, values in solved]) for key in solved[0][1]}
    exact = {
        key: limit.value - sum(sources.get(key, {}).get(name) or 0.0 for name in SOURCES[1:])
        for key, limit in limits.items()
    }
    return PriceList(scene.title, inner_layer(scene), prices, limits, exact, sources, own_parts(scene))
