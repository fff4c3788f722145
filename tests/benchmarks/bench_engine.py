"""What a clamping costs. Run by `make bench`; times are of this machine, ratios are the point.

One tangent should cost no more than one factorisation; the whole path no more than 80 iterations and
2.5 times (iterations x one factorisation).
"""

from __future__ import annotations

import dataclasses
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import pytest

import jaxclamp as jc
from jaxclamp.fem.tube import closed_positions
from jaxclamp.potential.energy import State, with_equilibrium_pressure
from jaxclamp.potential.model import Model, build_model
from jaxclamp.potential.tangent import linearise
from jaxclamp.solve.linear_solvers import LinearSolver

pytestmark = pytest.mark.benchmark

MESHES = {"10x15x8": (10, 15, (5, 3)), "20x30x16": (20, 30, (10, 6))}
REPEATS = 20

IN_A_NEW_PROCESS = """
import json, time
import jax
start = time.perf_counter()
import jaxclamp as jc
imported = time.perf_counter()
result = jc.clamp(jc.load_scene("human-lad"))
first = time.perf_counter()
again = jc.clamp(jc.load_scene("human-lad"))
second = time.perf_counter()
peak = jc.smooth_peak_axial_stress("media")
jc.gradients(again, [peak])
first_gradient = time.perf_counter()
for _ in range(10):
    jc.gradients(again, [peak])
gradient = (time.perf_counter() - first_gradient) / 10
begun = time.perf_counter()
jax.grad(lambda r: jc.evaluate(jc.replace(again.scene, "clamp.jaw.radius", r), peak))(3.0)
composed = time.perf_counter()
print(json.dumps({
    "import": imported - start, "first": first - imported, "second": second - first,
    "memory": again.cost["peak_memory_MB"], "solver": again.solver,
    "cost": again.cost, "first gradient": first_gradient - second, "gradient": gradient,
    "composed": composed - begun,
}))
"""


def table(title: str, head: list[str], rows: list[list[Any]]) -> None:
    """Print aligned columns."""
    texts = [head] + [[f"{v:.3g}" if isinstance(v, float) else str(v) for v in row] for row in rows]
    widths = [max(len(line[i]) for line in texts) for i in range(len(head))]
    print(f"\n{title}")
    for line in texts:
        print("  " + "  ".join(text.rjust(width) for text, width in zip(line, widths, strict=True)))


def seconds(run: Callable[[], Any]) -> float:
    """Median time of a few runs, after one to warm up."""
    run()
    taken = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        run()
        taken.append(time.perf_counter() - start)
    return statistics.median(taken)


def scene(counts: tuple[int, int, tuple[int, ...]]) -> jc.Scene:
    """The seed's scene on another mesh."""
    base = jc.load_scene("human-lad")
    circumferential, axial, radial = counts
    settings = dataclasses.replace(base.mesh, circumferential=circumferential, axial=axial, radial=radial)
    return dataclasses.replace(base, mesh=settings)


def closed_state(counts: tuple[int, int, tuple[int, ...]]) -> tuple[Model, State]:
    """The artery closed, without load: assembly and factorisation cost the same in every state."""
    model = build_model(scene(counts))
    x = closed_positions(model.mesh, model.scene.mesh, model.scene.artery)
    return model, with_equilibrium_pressure(model.potential, x, jnp.asarray([1e3]))


def test_tangent_against_factorisation():
    rows = []
    for name, counts in MESHES.items():
        model, state = closed_state(counts)
        every_term = model.solved(closing=True)
        assemble = lambda p=every_term, s=state, m=model: linearise(p, s, m.pattern)
        values = assemble().values
        solver = LinearSolver(model.pattern)
        tangent = seconds(assemble)
        factor = seconds(lambda s=solver, v=values: s.factor(v))
        rows.append([name, model.pattern.n, solver.name, 1e3 * tangent, 1e3 * factor, tangent / factor])
    table(
        "linearise against one numeric factorisation (median, ms)",
        ["mesh", "unknowns", "solver", "linearise", "factor", "ratio"],
        rows,
    )


DGEMM = """
import time, numpy as np
a = np.random.default_rng(0).normal(size=(2000, 2000))
taken = []
for _ in range(7):
    start = time.perf_counter()
    a @ a
    taken.append(time.perf_counter() - start)
print(sorted(taken)[3])
"""


def dgemm_seconds() -> float:
    """Product of two 2000 x 2000 matrices on one core: what a second is worth on this machine."""
    one = dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"), "1")
    done = subprocess.run(
        [sys.executable, "-c", DGEMM], env=os.environ | one, capture_output=True, text=True, check=True
    )
    return float(done.stdout)


def fresh(cache: str | None) -> dict[str, str]:
    """The environment of a new process with or without a folder of compiled kernels."""
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    if cache is not None:
        environment["JAX_COMPILATION_CACHE_DIR"] = cache
    return environment


def new_process(cache: str | None) -> dict[str, Any]:
    """The seed's scene twice in a new process, and gradients of its peak."""
    done = subprocess.run(
        [sys.executable, "-c", IN_A_NEW_PROCESS],
        env=fresh(cache),
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


def command_line(cache: str | None, folder: str) -> float:
    """Wall time of `jaxclamp run human-lad` with all its files, s."""
    start = time.perf_counter()
    command = [sys.executable, "-m", "jaxclamp", "run", "human-lad", "--out", folder, "--quiet"]
    subprocess.run(command, env=fresh(cache), capture_output=True, check=True)
    return time.perf_counter() - start


def test_the_whole_path():
    with tempfile.TemporaryDirectory() as cache:
        new_process(cache)  # fills the cache
        runs = {"no cache": new_process(None), "cache filled": new_process(cache)}
        with tempfile.TemporaryDirectory() as folder:
            command_line(cache, folder)
            commands = {"no cache": command_line(None, folder), "cache filled": command_line(cache, folder)}
    product = dgemm_seconds()
    print(f"\na product of two 2000 x 2000 matrices on one core: {1e3 * product:.0f} ms")
    table(
        "the seed's scene in a new process (s)",
        ["", "import", "first run", "import + first", "second run", "peak memory MB"],
        [
            [name, r["import"], r["first"], r["import"] + r["first"], r["second"], r["memory"]]
            for name, r in runs.items()
        ],
    )
    table(
        "after it (s)",
        ["", "first gradient", "a further one", "first jax.grad(evaluate)", "jaxclamp run"],
        [
            [name, r["first gradient"], r["gradient"], r["composed"], commands[name]]
            for name, r in runs.items()
        ],
    )
    warm = runs["cache filled"]
    factor = warm["cost"]["factor_s"] / warm["solver"]["factorisations"]
    iterations = warm["solver"]["newton_iterations"]
    table(
        "the seed's scene, warm",
        [
            "wall s",
            "in products",
            "iterations",
            "factorisations",
            "load steps",
            "one factor ms",
            "wall / (iterations x factor)",
        ],
        [
            [
                warm["second"],
                warm["second"] / product,
                iterations,
                warm["solver"]["factorisations"],
                warm["solver"]["load_steps"],
                1e3 * factor,
                warm["second"] / (iterations * factor),
            ]
        ],
    )


def test_the_fine_mesh():
    start = time.perf_counter()
    jc.clamp(scene(MESHES["20x30x16"]))
    first = time.perf_counter()
    result = jc.clamp(scene(MESHES["20x30x16"]))
    warm = time.perf_counter() - first
    table(
        "the seed's scene on 20x30x16 elements",
        ["first run s", "warm s", "in products", "iterations", "one factor ms", "peak memory MB"],
        [
            [
                first - start,
                warm,
                warm / dgemm_seconds(),
                result.solver["newton_iterations"],
                1e3 * result.cost["factor_s"] / result.solver["factorisations"],
                result.cost["peak_memory_MB"],
            ]
        ],
    )


if __name__ == "__main__":
    test_tangent_against_factorisation()
    test_the_whole_path()
    test_the_fine_mesh()
