"""The tube that every code solves, and how it is timed. NumPy only, so that it runs in any environment.

A 90 deg wedge of a one-layer artery (closed ring, no residual stress): inner radius 2 mm, wall
0.74 mm, length 10 mm, both ends held at an axial stretch of 1.1 and free to move radially, 13.33 kPa
as follower load on the deformed lumen. Law per reference volume, kPa:

    c/2 (I1_bar - 3) + sum_i k1/(2 k2) {exp[k2 <I4_bar,i - 1>^2] - 1} + bulk/2 (J - 1)^2

with two fibre families at +-10 deg from the circumference. Trilinear hexahedra, 2 x 2 x 2 Gauss
points, J of the last term averaged over the element (Q1/P0).

Every script gives `main` three functions: build(mesh) -> problem; solve(problem, u, pressures) ->
Answer from the start displacement u; gradient(problem, answer) -> {"c", "k1", "k2", "p"}.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

INNER_RADIUS, WALL, LENGTH = 2.0, 0.74, 10.0
STRETCH, PRESSURE = 1.1, 13.33
C, K1, K2, FIBRE_ANGLE, BULK = 27.0, 0.64, 3.54, np.deg2rad(10.0), 1e4
TOLERANCE = 1e-8
"""Newton stops at |r_free| <= TOLERANCE |f_pressure|"""
STEPS = (0.5 * PRESSURE, PRESSURE)
"""pressures solved for from the stretched tube; one step diverges"""
MOST_ITERATIONS = 40
SMALL = 2000
"""up to so many elements a time is the median of five"""
PARAMETERS = ("c", "k1", "k2", "p")


@dataclasses.dataclass(frozen=True)
class TubeMesh:
    """Structured hexahedra of the wedge; theta = 0 is the x axis, z = 0 one end."""

    counts: tuple[int, int, int]
    """elements round, along, through the wall"""
    points: np.ndarray
    """mm, (n_nodes, 3)"""
    cells: np.ndarray
    """(n_cells, 8), local axes (radial, circumferential, axial), bottom face counter-clockwise, then top"""
    inner_facets: np.ndarray
    """(n_facets, 4), counter-clockwise as seen from the lumen"""

    def grid(self) -> np.ndarray:
        """Node numbers, (n_z, n_theta, n_r)."""
        around, along, through = self.counts
        return np.arange(len(self.points)).reshape(along + 1, around + 1, through + 1)

    @property
    def inner(self) -> np.ndarray:
        """Nodes of the lumen."""
        return self.grid()[:, :, 0].ravel()

    @property
    def held(self) -> np.ndarray:
        """True where a displacement is prescribed, (n_nodes, 3)."""
        grid = self.grid()
        held = np.zeros((len(self.points), 3), dtype=bool)
        held[grid[:, -1].ravel(), 0] = True
        held[grid[:, 0].ravel(), 1] = True
        held[grid[[0, -1]].ravel(), 2] = True
        return held

    @property
    def free(self) -> np.ndarray:
        """Degrees of freedom 3 node + component that are unknown."""
        return np.flatnonzero(~self.held.ravel())

    def radius_weights(self) -> np.ndarray:
        """d radius / d u, (n_nodes, 3): the lumen radius is measured on the x axis, at z = 0."""
        weights = np.zeros((len(self.points), 3))
        weights[self.grid()[0, 0, 0], 0] = 1.0
        return weights

    def radius(self, u: np.ndarray) -> float:
        """Deformed lumen radius, mm."""
        return INNER_RADIUS + float(np.sum(self.radius_weights() * u))


def tube_mesh(around: int, along: int, through: int) -> TubeMesh:
    """Uniform mesh of the wedge."""
    z, theta, r = np.meshgrid(
        np.linspace(0.0, LENGTH, along + 1),
        np.linspace(0.0, 0.5 * np.pi, around + 1),
        np.linspace(INNER_RADIUS, INNER_RADIUS + WALL, through + 1),
        indexing="ij",
    )
    points = np.stack([r * np.cos(theta), r * np.sin(theta), z], axis=-1).reshape(-1, 3)
    points[np.abs(points) < 1e-12] = 0.0
    n = np.arange(len(points)).reshape(z.shape)
    bottom = [n[:, :-1, :-1], n[:, :-1, 1:], n[:, 1:, 1:], n[:, 1:, :-1]]
    cells = np.stack([b[s].ravel() for s in (slice(None, -1), slice(1, None)) for b in bottom], axis=1)
    s = n[:, :, 0]
    facets = np.stack([v.ravel() for v in (s[:-1, :-1], s[1:, :-1], s[1:, 1:], s[:-1, 1:])], axis=1)
    return TubeMesh((around, along, through), points, cells, facets)


def moved(mesh: TubeMesh, inner_radius: float) -> np.ndarray:
    """Displacement of the incompressible stretched tube with a given lumen radius, mm, (n_nodes, 3)."""
    x = mesh.points.copy()
    squared = x[:, 0] ** 2 + x[:, 1] ** 2
    share = np.sqrt((inner_radius**2 + (squared - INNER_RADIUS**2) / STRETCH) / squared)
    x[:, :2] *= share[:, None]
    x[:, 2] *= STRETCH
    return x - mesh.points


def stretched(mesh: TubeMesh) -> np.ndarray:
    """Displacement of the tube stretched without pressure, isotropically in its cross-section, mm."""
    return moved(mesh, INNER_RADIUS / np.sqrt(STRETCH))


def pressure_carried(inner_radius: float) -> float:
    """Pressure in equilibrium with a lumen radius, incompressible wall: int (s_theta - s_r) dr / r, kPa."""
    x, w = np.polynomial.legendre.leggauss(60)
    R = INNER_RADIUS + WALL * 0.5 * (1.0 + x)
    r = np.sqrt(inner_radius**2 + (R**2 - INNER_RADIUS**2) / STRETCH)
    hoop = r / R
    E = np.maximum((hoop * np.cos(FIBRE_ANGLE)) ** 2 + (STRETCH * np.sin(FIBRE_ANGLE)) ** 2 - 1.0, 0.0)
    fibres = 4.0 * K1 * E * np.exp(K2 * E**2) * (hoop * np.cos(FIBRE_ANGLE)) ** 2
    difference = C * hoop**2 + fibres - C / (hoop * STRETCH) ** 2
    return float(np.sum(0.5 * WALL * w * difference * R / (STRETCH * r**2)))


def analytic(mesh: TubeMesh) -> np.ndarray:
    """Displacement of the incompressible tube at the full pressure, mm."""
    low, high = INNER_RADIUS, 2.0 * INNER_RADIUS
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if pressure_carried(middle) < PRESSURE else (low, middle)
    return moved(mesh, low)


@dataclasses.dataclass
class Answer:
    """A solved tube."""

    radius: float
    """deformed lumen radius, mm"""
    iterations: int
    """linear systems solved"""
    newton_s: float
    """time of those iterations, s"""
    state: Any = None


Linearised = tuple[np.ndarray, Any, float]


def newton(
    linearise: Callable[[Any, float], Linearised],
    correct: Callable[[Any, Any, np.ndarray], Any],
    u: Any,
    pressures: Sequence[float],
) -> tuple[Any, int, float]:
    """Newton's method in steps of pressure, for codes whose own loop has another stop.

    linearise(u, p): free residual, what `correct` needs as tangent, and |f_pressure|
    correct(u, tangent, residual): the next u

    Returns u, the number of iterations and their time.
    """
    start, iterations = time.perf_counter(), 0
    for p in pressures:
        for _ in range(MOST_ITERATIONS):
            residual, tangent, load = linearise(u, p)
            if np.linalg.norm(residual) <= TOLERANCE * load:
                break
            u = correct(u, tangent, residual)
            iterations += 1
        else:
            raise RuntimeError(f"no equilibrium at {p} kPa")
    return u, iterations, time.perf_counter() - start


def process_age() -> float | None:
    """Seconds since this process was started; None where the system does not tell."""
    try:
        with open("/proc/self/stat") as file:
            ticks = int(file.read().rsplit(")", 1)[1].split()[19])
        return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError):
        return None


def peak_memory() -> float | None:
    """Largest memory of this process so far, MB; None where the system does not tell."""
    try:
        import resource
    except ImportError:
        return None
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def timed(run: Callable[[], Any], repeats: int = 1) -> tuple[list[Any], float]:
    """Results and median time, s."""
    results, taken = [], []
    for _ in range(repeats):
        start = time.perf_counter()
        results.append(run())
        taken.append(time.perf_counter() - start)
    return results, statistics.median(taken)


def main(
    code: str,
    package: str,
    build: Callable[[TubeMesh], Any],
    solve: Callable[[Any, np.ndarray, Sequence[float]], Answer],
    gradient: Callable[[Any, Answer], dict[str, float]] | None = None,
    gradient_by: str = "",
) -> None:
    """Measure a code on the mesh of the command line and print what was found.

    gradient_by: what the code does for the derivative and what its user has to write
    """
    import_s, import_memory = process_age(), peak_memory()
    args = arguments(code)
    mesh = tube_mesh(*args.counts)
    repeats = 5 if len(mesh.cells) <= SMALL else 1

    started = time.perf_counter()
    problem = build(mesh)
    build_s = time.perf_counter() - started
    answer = solve(problem, stretched(mesh), STEPS)
    found: dict[str, Any] = {
        "code": code,
        "version": version(package),
        "mesh": args.counts,
        "radius_mm": answer.radius,
        "import_s": import_s,
        "build_s": build_s,
        "first_s": time.perf_counter() - started,
    }
    if not args.first_only:
        found |= warm(mesh, problem, solve, repeats)
        found["import_memory_MB"] = import_memory
        found["peak_memory_MB"] = peak_memory()
        if gradient is not None:
            found["gradient"] = slopes(problem, solve, gradient, mesh, repeats) | {"by": gradient_by}
            found["peak_memory_with_gradient_MB"] = peak_memory()
        else:
            found["gradient"] = None
    show(found, args.json)


def arguments(code: str) -> argparse.Namespace:
    """The command line of every script."""
    parser = argparse.ArgumentParser(description=f"The one-layer tube with {code}.")
    parser.add_argument("counts", type=int, nargs=3, metavar="N", help="elements round, along, through")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    parser.add_argument("--first-only", action="store_true", help="only the first solve")
    return parser.parse_args()


def warm(mesh: TubeMesh, problem: Any, solve: Callable[..., Answer], repeats: int) -> dict[str, Any]:
    """Times of a second solve, from the stretched tube and from the analytic field."""
    far, seconds = timed(lambda: solve(problem, stretched(mesh), STEPS), repeats)
    near, near_seconds = timed(lambda: solve(problem, analytic(mesh), (PRESSURE,)), repeats)
    return {
        "warm_s": seconds,
        "iterations": far[0].iterations,
        "iteration_s": statistics.median(answer.newton_s for answer in far) / far[0].iterations,
        "analytic_start": {
            "warm_s": near_seconds,
            "iterations": near[0].iterations,
            "radius_mm": near[0].radius,
        },
    }


def slopes(
    problem: Any,
    solve: Callable[..., Answer],
    gradient: Callable[[Any, Answer], dict[str, float]],
    mesh: TubeMesh,
    repeats: int,
) -> dict[str, Any]:
    """Derivatives of the radius, mm per unit of each parameter, and their time at a new solution.

    Every repetition solves the tube again first, so that nothing is left over from the gradient before.
    """
    taken = []
    for _ in range(repeats + 1):
        answer = solve(problem, analytic(mesh), (PRESSURE,))
        values, seconds = timed(lambda a=answer: gradient(problem, a))
        taken.append(seconds)
    return {f"d_{name}": float(values[0][name]) for name in PARAMETERS} | {
        "seconds": statistics.median(taken[1:]),
        "first_seconds": taken[0],
    }


def show(found: dict[str, Any], as_json: bool) -> None:
    """Print what was measured."""
    if as_json:
        print(json.dumps(found), flush=True)
        return
    for name, value in found.items():
        print(f"{name:20s} {value}")
