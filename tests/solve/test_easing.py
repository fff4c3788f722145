"""Hard contact: softer on the way, the scene's own in every state that is kept."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.core.failures import TermMissing
from jaxclamp.potential.tangent import linearise
from jaxclamp.solve import easing
from jaxclamp.solve.branch import CLOSING_PATH

SMALL = ("mesh.circumferential=4", "mesh.axial=6", "mesh.radial=[2, 1]")
HARD = ("contact.stiffness_kPa_per_mm=2e4", "contact.smoothing_mm=0.001", "stop={ travel_mm = 0.8 }")


def scene() -> jc.Scene:
    return jc.load_scene("human-lad", (*SMALL, *HARD))


@functools.cache
def eased() -> jc.Result:
    return jc.clamp(scene())


@pytest.fixture
def walked(monkeypatch) -> jc.Result:
    """The same, all the way with its own contact."""
    eased()  # before, as it is kept for all tests
    monkeypatch.setattr(easing, "HARD", np.inf)
    return jc.clamp(scene())


def test_the_answer_is_that_of_a_path_with_its_own_contact(walked):
    assert (eased().solver["branch"], walked.solver["branch"]) == (CLOSING_PATH, CLOSING_PATH)
    np.testing.assert_allclose(eased().states[-1].state.x, walked.states[-1].state.x, rtol=0.0, atol=1e-7)
    for key in ("clamp_force_N", "axial_stress_at_P_kPa", "max_penetration_mm"):
        assert eased().final[key] == pytest.approx(walked.final[key], rel=1e-7)
    assert eased().solver["newton_iterations"] < 0.7 * walked.solver["newton_iterations"]


def test_every_state_that_is_kept_is_one_of_the_scene():
    result = eased()
    assert len(result.on_the_way) >= 2
    for kept in (*result.on_the_way, result.states[-1]):
        potential = result.model.solved(closing=True).at_pressure(kept.equilibrium.pressure)
        lin = linearise(potential, kept.state, result.model.pattern)
        assert np.linalg.norm(lin.residual) < 1e-8 * lin.reactions
        assert kept.equilibrium.negative_pivots == 0
    travels = [record["jaw_travel_mm"] for record in result.history if record["stage"] == "clamping"]
    assert travels == sorted(travels)
    assert travels[0] < 0.1  # first contact is there
    assert travels[-1] == pytest.approx(0.8, rel=1e-8)


def test_an_unstable_state_on_the_way_is_not_kept(monkeypatch):
    found = easing.newton
    unstable = lambda *known: dataclasses.replace(found(*known), negative_pivots=1)
    monkeypatch.setattr(easing, "newton", unstable)
    result = jc.clamp(scene())
    assert result.on_the_way == []
    np.testing.assert_array_equal(result.states[-1].state.x, eased().states[-1].state.x)


def test_a_term_that_is_missing_on_the_way_has_the_scene_s_own_path_walked(monkeypatch, walked):
    monkeypatch.setattr(easing, "HARD", 3.0)

    def missing(*known):
        raise TermMissing("inner walls meet")

    monkeypatch.setattr(easing, "newton", missing)
    np.testing.assert_array_equal(jc.clamp(scene()).states[-1].state.x, walked.states[-1].state.x)


def test_contact_that_fits_the_wall_is_not_softened():
    assert easing.with_softer_contact(jc.load_scene("human-lad")) is None
    softer = easing.with_softer_contact(scene())
    assert softer.contact.stiffness < scene().contact.stiffness
    assert softer.contact.smoothing > scene().contact.smoothing


def test_where_the_softer_path_leads_nowhere_the_scene_s_own_is_walked(monkeypatch, walked):
    monkeypatch.setattr(easing, "HARD", 3.0)
    monkeypatch.setattr("jaxclamp.solve.clamping._sure", lambda last, near: False)
    np.testing.assert_array_equal(jc.clamp(scene()).states[-1].state.x, walked.states[-1].state.x)
