"""Stated confidence against the truth: the human LAD from its own noisy curves, many times over."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.scenes.address import get
from optimize.fit import solved
from optimize.fit_data import loads_data
from optimize.fit_model import experiment, problem
from optimize.fit_parameters import freedom
from optimize.fit_search import Search

FAR_OFF = {0: "c_kPa=15 k1_kPa=2 k2=2 fibre_angle_deg=30", 1: "c_kPa=6 k1_kPa=2 k2=6 fibre_angle_deg=30"}
NOISE = 0.01
"""standard deviation, of each pressure and of the largest force"""


def curves(seed: int) -> str:
    """Pressure, outer radius and force at three stretches, 90 rows, with noise in pressure and force."""
    random, scene = np.random.default_rng(seed), jc.load_scene("human-lad")
    grid = np.meshgrid([1.0, 1.1, 1.2], np.linspace(1.0, 20.0, 30), indexing="ij")
    stretch, pressure = (part.ravel() for part in grid)
    tube = jc.inflated_tube(scene.artery.layers, jnp.asarray(stretch), pressure=jnp.asarray(pressure))
    force = np.asarray(tube.reduced_force)
    columns = {
        "axial_stretch": stretch,
        "outer_radius_mm": np.asarray(tube.outer_radius),
        "pressure_kPa": pressure * (1.0 + NOISE * random.standard_normal(90)),
        "pressure_kPa_sd": NOISE * pressure,
        "axial_force_mN": force + NOISE * np.abs(force).max() * random.standard_normal(90),
    }
    rows = zip(*columns.values(), strict=True)
    return "\n".join([",".join(columns), *(",".join(f"{v:.12g}" for v in row) for row in rows)])


def covered(replicas: int) -> dict[str, int]:
    """How often the stated 95 % interval of each constant holds the true one."""
    changed = [
        f"artery.layers[{layer}].material.{each}" for layer, text in FAR_OFF.items() for each in text.split()
    ]
    truth, start = jc.load_scene("human-lad"), jc.load_scene("human-lad", changed)
    read = lambda seed: problem([experiment(loads_data(curves(seed)), start)])
    search = Search(read(1000), freedom(start))
    found = {parameter.key: 0 for parameter in search.freedom.parameters}
    for seed in range(1000, 1000 + replicas):
        search.problem = dataclasses.replace(search.problem, measured=read(seed).measured)
        for key, interval in zip(found, solved(search, 20, seed).confidence.intervals, strict=True):
            found[key] += interval.lower <= float(get(truth, key)) <= interval.upper
    return found


@pytest.mark.slow
def test_true_constants_lie_inside_the_stated_confidence():
    """Of 100 replicas, 95 on average; 90 or more of each constant."""
    found = covered(100)
    assert len(found) == 8
    assert min(found.values()) >= 90, found
