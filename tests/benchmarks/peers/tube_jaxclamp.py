"""The tube with jaxclamp: `inflate` as its user calls it, and its Newton's method alone beside the others'.

jaxclamp models a quarter of the circumference by half the length, so that an artery of twice the
length has the same wedge. A time is that of `inflate` with everything in it: mesh, numbering,
symbolic factorisation, the load-free state (one factorisation that this tube would not need), the
physiological state from the analytic field, and the readings of both.
"""

from __future__ import annotations

import dataclasses
import os
import statistics
import time
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tube_work as work

import jaxclamp as jc
from jaxclamp.physics.materials import HGO
from jaxclamp.potential.energy import lumen_volume, with_equilibrium_pressure
from jaxclamp.potential.model import build_model
from jaxclamp.scenes.scene import Layer, Scene
from jaxclamp.solve.clamping import inflate
from jaxclamp.solve.linear_solvers import LinearSolver
from jaxclamp.solve.newton import Step, System
from jaxclamp.solve.newton import newton as own_newton
from jaxclamp.solve.results import Result
from jaxclamp.solve.stops import Held


def tube_scene(counts: Sequence[int], tolerance: float) -> Scene:
    """The tube as an artery; the clamp of the example scene is not used."""
    around, along, through = counts
    material = HGO(c=work.C, k1=work.K1, k2=work.K2, fibre_angle=work.FIBRE_ANGLE, bulk=work.BULK)
    layer = Layer(
        name="media",
        inner_radius=work.INNER_RADIUS,
        thickness=work.WALL,
        opening_angle=0.0,
        material=material,
    )
    scene = jc.load_scene("human-lad")
    artery = dataclasses.replace(
        scene.artery,
        length=2.0 * work.LENGTH,
        axial_stretch=work.STRETCH,
        pressure=work.PRESSURE,
        layers=(layer,),
    )
    mesh = dataclasses.replace(
        scene.mesh, circumferential=around, axial=along, radial=(through,), axial_grading=0.0
    )
    solver = dataclasses.replace(scene.solver, tolerance=tolerance)
    return dataclasses.replace(scene, artery=artery, mesh=mesh, solver=solver)


REACTIONS_SHARE = 1e-9
"""residual over reactions at which `inflate` stops; checked below to be no looser than the common stop"""


def newton_alone(scene: Scene, u: np.ndarray, pressures: Sequence[float]) -> work.Answer:
    """Its Newton's method from the start displacement that the other codes have."""
    model = build_model(scene)
    system = System(
        potential=model.solved(closing=False),
        solver=LinearSolver(model.pattern, scene.solver.linear_solver),
        tolerance=scene.solver.tolerance,
        length=work.INNER_RADIUS,
        pattern=model.pattern,
    )
    mesh = work.tube_mesh(scene.mesh.circumferential, scene.mesh.axial, *scene.mesh.radial)
    far = 1e3
    state = with_equilibrium_pressure(model.potential, jnp.asarray(mesh.points + u), jnp.asarray([far]))
    start = time.perf_counter()
    for p in pressures:
        state = own_newton(system, state, Step(Held(far), p, work.STRETCH)).state
    seconds = time.perf_counter() - start
    radius = float(state.x[model.marks.lumen_top, 1])
    return work.Answer(radius, system.newton_iterations, seconds)


def residual_share(result: Result) -> float:
    """|r_free| / |f_pressure| of an inflated artery."""
    potential, kept = result.model.potential, result.physiological.equilibrium
    load = work.PRESSURE * jax.grad(lumen_volume, argnums=1)(potential, kept.state.x)
    return float(np.linalg.norm(kept.lin.residual) / jnp.linalg.norm(load))


def slopes(scene: Scene, repeats: int) -> dict[str, Any]:
    """Derivatives of the radius by every float of the scene, at new solutions and once more at the last."""
    measure, taken = jc.physiological_lumen_radius(), []
    for _ in range(repeats + 1):
        result = inflate(scene)
        found, seconds = work.timed(lambda r=result: jax.block_until_ready(jc.value_and_gradient(r, measure)))
        taken.append(seconds)
    _, again = work.timed(
        lambda: jax.block_until_ready(jc.value_and_gradient(result, measure)), max(repeats, 3)
    )
    slope = found[0][1]
    material = slope.artery.layers[0].material
    values = {"c": material.c, "k1": material.k1, "k2": material.k2, "p": slope.artery.pressure}
    return {f"d_{name}": float(values[name]) for name in work.PARAMETERS} | {
        "seconds": statistics.median(taken[1:]),
        "first_seconds": taken[0],
        "again_seconds": again,
        "parameters": sum(np.size(leaf) for leaf in jax.tree_util.tree_leaves(slope)),
        "by": "one call; every float of the scene",
    }


def main() -> None:
    """Measure and print."""
    import_s, import_memory = work.process_age(), work.peak_memory()
    args = work.arguments("jaxclamp")
    repeats = 5 if np.prod(args.counts) <= work.SMALL else 1
    scene = tube_scene(args.counts, REACTIONS_SHARE)
    results, first = work.timed(lambda: inflate(scene))
    found: dict[str, Any] = {
        "code": "jaxclamp",
        "version": installed(),
        "mesh": args.counts,
        "radius_mm": results[0].measure(jc.physiological_lumen_radius()),
        "import_s": import_s,
        "first_s": first,
        "compiled_before": bool(os.environ.get("JAX_COMPILATION_CACHE_DIR")),
    }
    if not args.first_only:
        assert residual_share(results[0]) <= work.TOLERANCE
        results, seconds = work.timed(lambda: inflate(scene), repeats)
        found |= {
            "warm_s": seconds,
            "iterations": results[0].solver["newton_iterations"],
            "factorisations": results[0].solver["factorisations"],
            "linear_solver": results[0].solver["linear_solver"],
            "import_memory_MB": import_memory,
            "peak_memory_MB": work.peak_memory(),
        }
        mesh = work.tube_mesh(*args.counts)
        far, far_seconds = work.timed(lambda: newton_alone(scene, work.stretched(mesh), work.STEPS), repeats)
        found |= {
            "iteration_s": statistics.median(answer.newton_s for answer in far) / far[0].iterations,
            "stretched_start": {
                "warm_s": far_seconds,
                "iterations": far[0].iterations,
                "radius_mm": far[0].radius,
            },
            "analytic_start": {  # where `inflate` starts by itself
                "warm_s": seconds,
                "iterations": results[0].solver["newton_iterations"],
                "radius_mm": found["radius_mm"],
            },
            "gradient": slopes(scene, repeats),
            "peak_memory_with_gradient_MB": work.peak_memory(),
        }
    work.show(found, args.json)


def installed() -> str:
    """Version of the package, also where it is used from its folder."""
    try:
        return version("jaxclamp")
    except PackageNotFoundError:
        return "source"


if __name__ == "__main__":
    main()
