"""What a gradient and a neighbouring design cost. Run by `make bench`; ratios are the point.

Value and gradient for 20 variables should cost at most 1.15 times the value alone, and a neighbouring
design at most 15 % of a cold clamping.
"""

from __future__ import annotations

import statistics
import time

import numpy as np
import pytest

import jaxclamp as jc
from optimize import DesignProblem, Variable
from optimize.evaluator import gradients

pytestmark = pytest.mark.benchmark

PEAK = jc.smooth_peak_axial_stress("media")
MOVE = 0.01
"""change of each slope from one evaluation to the next"""


def with_slopes(count: int) -> DesignProblem:
    """The study's artery and a spline of `count` slopes, on the mesh of the study."""
    z = np.arange(1, count + 1) * 2.0 / (count + 0.5)
    slopes = (0.8 * z / np.sqrt(9.0 - z**2)).tolist()
    jaw = f'clamp.jaw={{shape="spline", half_width_mm=2.0, slopes={slopes}, edge_radius_mm=1.0}}'
    return DesignProblem(jc.load_scene("human-lad", [jaw]), PEAK, (Variable("clamp.jaw.slopes", -1.0, 3.0),))


@pytest.mark.parametrize("count", [5, 20])
def test_gradient_and_neighbour(count):
    problem = with_slopes(count)
    jc.clamp(problem.scene)
    start = time.perf_counter()
    cold = jc.clamp(problem.scene)
    cold_time = time.perf_counter() - start
    rng = np.random.default_rng(0)
    designs = [problem.start + MOVE * rng.uniform(-1.0, 1.0, count) for _ in range(12)]
    gradients(problem, jc.clamp(problem.scene_at(designs[0]), guess=cold))

    state = {"last": cold, "iterations": 0}

    def value(design: np.ndarray) -> None:
        state["last"] = jc.clamp(problem.scene_at(design), guess=state["last"])
        state["iterations"] += state["last"].solver["newton_iterations"]

    values, both = [], []
    for design in designs[1:]:
        start = time.perf_counter()
        value(design)
        solved = time.perf_counter()
        gradients(problem, state["last"])
        values.append(solved - start)
        both.append(time.perf_counter() - start)
    alone, together = statistics.median(values), statistics.median(both)
    print(
        f"\n{count} slopes: cold {cold_time:.2f} s; neighbour {alone:.3f} s "
        f"({alone / cold_time:.1%} of cold, {state['iterations'] / len(values):.1f} iterations); "
        f"value and gradient over value {together / alone:.3f}"
    )
