"""The way downhill: back to the equilibrium it was pushed from, with the cells' volumes kept on the way."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.potential.energy import State
from jaxclamp.solve.descent import VOLUMES_KEPT, _with_their_volumes, descend
from jaxclamp.solve.stages import Clamping
from jaxclamp.solve.stops import Held

SMALL = ["mesh.circumferential=6", "mesh.axial=8", "mesh.radial=[2, 1]", "stop.occlusion=0.7"]


@pytest.fixture(scope="module")
def closed() -> tuple[jc.Result, Clamping]:
    """A clamped artery, and what solves it further."""
    result = jc.clamp(jc.load_scene("human-lad", SMALL))
    clamping = Clamping(result.model, lambda event: None)
    clamping.use_terms(closing=True)
    clamping.refer_to(result.physiological.state)
    return result, clamping


def pushed(result: jc.Result, by: float) -> State:
    """The last state with its free nodes moved at random by up to so many mm."""
    state, free = result.states[-1].state, np.asarray(result.model.discretisation.layout.free)
    x = np.asarray(state.x).ravel().copy()
    x[free] += np.random.default_rng(0).uniform(-by, by, len(free))
    return dataclasses.replace(state, x=jax.device_put(x.reshape(-1, 3)))


def test_volumes_are_given_back(closed):
    result, clamping = closed
    system, pressure = clamping.system, float(result.scene.artery.pressure)
    before = system.linearise(pushed(result, 2e-3), pressure)
    system.solver.factor(before.values)
    _, after = _with_their_volumes(system, pushed(result, 2e-3), before, pressure)
    assert np.linalg.norm(before.missing) > 10.0 * before.imbalance
    assert np.linalg.norm(after.missing) <= VOLUMES_KEPT * after.imbalance
    assert after.energy < before.energy


def test_it_leads_back(closed):
    result, clamping = closed
    last = result.states[-1].equilibrium
    step = clamping.step(Held(float(last.state.jaw_height)))
    found = descend(clamping.system, pushed(result, 5e-3), step)
    assert found.negative_pivots == 0
    assert found.lin.energy == pytest.approx(last.lin.energy, rel=1e-10)
    np.testing.assert_allclose(np.asarray(found.state.x), np.asarray(last.state.x), atol=1e-6)


def test_nearly_incompressible_walls_settle_on_the_finer_mesh():
    """A hundred times the bulk modulus: a softer one leads down the narrow valley, then it is stiffened."""
    stiff = [f"artery.layers[{i}].material.bulk_kPa=1e6" for i in (0, 1)]
    result = jc.clamp(jc.load_scene("human-lad", [*stiff, "mesh.radial_grading=0"]))
    assert result.coarser is not None, "its path was walked on the coarser mesh"
    assert result.solver["branch"] == "closing path"
    assert result.solver["newton_iterations"] < 150  # 102 when this was written, 266 without the easing
