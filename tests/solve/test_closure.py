"""Closed all the way, and pressed on: what is left of the lumen, the force it takes, and its derivatives."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.observe import closure
from jaxclamp.observe.closure import CLOSED
from jaxclamp.observe.points import deformation_gradient
from jaxclamp.solve import limits
from jaxclamp.solve.clamping import inflate

COARSE = ["mesh.circumferential=7", "mesh.axial=10", "mesh.radial=[3,2]", "mesh.circumferential_grading=2"]
WALL = 0.74
"""thickness of the stress-free layers of human-lad together, mm"""


def human_lad(*overrides: str) -> jc.Scene:
    return jc.load_scene("human-lad", [*COARSE, *overrides])


@pytest.fixture(scope="module")
def closed() -> jc.Result:
    return jc.clamp(human_lad("stop.closed=true"))


@pytest.fixture(scope="module")
def pressed(closed) -> jc.Result:
    force = 5.0 * closed.final["closing_force_N"]
    return jc.clamp(human_lad("stop.closed=true", f"stop.force_N={force!r}"))


def test_nothing_is_left_of_the_lumen(closed):
    final = closed.final
    assert closed.solver["branch"] == "closing path"
    assert final["closed"] is True
    assert final["lumen_area_share"] <= 1.0 - CLOSED + 1e-9
    assert final["lumen_opening_mm"] <= 0.02 * closed.to_dict()["physiological"]["lumen_radius_mm"]
    assert final["intima_force_share"] >= (1.0 - 1e-9) * closure.CARRIED
    assert 0.0 <= final["lumen_overlap_mm"] <= 0.005 * WALL
    assert final["closing_force_N"] == final["clamp_force_N"]
    assert 0.0 < final["closed_length_mm"] < 6.0
    assert final["force_balance_error"] <= 1e-6


def test_before_it_is_closed_there_is_no_closing_force():
    final = jc.clamp(human_lad("stop.occlusion=0.8")).final
    assert final["closed"] is False
    assert final["closing_force_N"] is None
    assert final["intima_contact_area_mm2"] == 0.0
    assert final["closed_length_mm"] == 0.0


def test_pressed_on_to_five_times_the_closing_force(closed, pressed):
    final = pressed.final
    assert final["clamp_force_N"] == pytest.approx(5.0 * closed.final["closing_force_N"], rel=1e-8)
    assert final["closing_force_N"] == pytest.approx(closed.final["closing_force_N"], rel=1e-7)
    assert final["closed"] is True
    assert final["lumen_overlap_mm"] <= 0.005 * WALL
    assert final["intima_contact_area_mm2"] > 2.0 * closed.final["intima_contact_area_mm2"]
    assert final["closed_length_mm"] > closed.final["closed_length_mm"]
    assert final["force_balance_error"] <= 1e-6
    assert pressed.solver["negative_pivots"] == 0


def test_the_curve_of_force_rises_at_closure(pressed):
    """The seed's mark of a clamp: jaws that meet a closed lumen press on a solid."""
    table = pressed.history_table()
    own = np.array([record["mesh"] == pressed.scene.mesh.words for record in pressed.history])
    travel, force = table["jaw_travel_mm"][own], table["clamp_force_N"][own]
    order = np.argsort(travel)
    slope = np.diff(force[order]) / np.diff(travel[order])
    assert slope[-1] > 3.0 * slope[0] > 0.0


def test_a_force_that_does_not_close_is_refused():
    with pytest.raises(jc.EquilibriumError, match=r"'closed' takes 0\.\d+ N already, more than 0.2 N"):
        jc.clamp(human_lad("stop.closed=true", "stop.force_N=0.2"))


def test_a_force_beyond_99_percent_is_reached_from_nothing(pressed):
    force = pressed.final["clamp_force_N"]
    cold = jc.clamp(human_lad(f"stop={{force_N={force!r}}}"))
    assert cold.final["jaw_travel_mm"] == pytest.approx(pressed.final["jaw_travel_mm"], rel=1e-7)
    peaks = (r.final["smooth_peak_axial_stress_kPa"]["media"] for r in (cold, pressed))
    assert next(peaks) == pytest.approx(next(peaks), rel=1e-6)


def test_inner_walls_that_meet_are_counted_by_hand(pressed):
    """Force from pressure times area at the points, against the gradient of the potential."""
    e = pressed.equilibria
    (group,) = e.potential.of("intima contact")
    here = group.here("intima contact")
    y = here.rule.position[:, 0] @ np.asarray(e.last.x)[np.asarray(group.nodes), 1]
    s, k = float(here.contact.intima_onset), float(here.contact.intima_stiffness)
    deep = np.maximum(-y - s, 0.0)  # beyond the onset the law is linear
    onset = np.clip(-y, 0.0, 2.0 * s)
    pressure = np.where(-y < 2.0 * s, k * onset**2 / (4.0 * s), k * deep)
    total = 4.0 * np.sum(pressure * np.asarray(here.dA)) * 1e-3
    assert total == pytest.approx(pressed.final["lumen_contact_force_N"], rel=1e-9)
    ratio = pressed.final["lumen_contact_force_N"] / pressed.final["clamp_force_N"]
    assert pressed.final["intima_force_share"] == pytest.approx(ratio, rel=1e-9)


def test_a_crease_is_measured_where_the_wall_is_round():
    """Normal stretch 1 / |F^-T e_r|, by inverting F."""
    result = inflate(human_lad("stop.closed=true"))
    e = result.equilibria
    F = np.asarray(deformation_gradient(e, "media"))
    inverse = np.linalg.inv(np.moveaxis(F, (0, 1), (-2, -1)))
    ratio = np.linalg.norm(F[:, 1], axis=0) * np.linalg.norm(inverse[..., 0, :], axis=-1)
    assert float(closure.fold_stretch_ratio(e)) == pytest.approx(np.min(ratio), rel=1e-12)


def test_crumpled_walls_are_refused(monkeypatch):
    """With a limit that the wall of this mesh does not keep: what did converge stays."""
    assert limits.crumpled({"J_min_away_from_fold": 0.45, "J_max_away_from_fold": 1.6}) is None
    assert limits.crumpled({"J_min_away_from_fold": 0.9, "J_max_away_from_fold": 3.35}) is not None
    monkeypatch.setattr(limits, "CRUMPLED", (0.95, 1.05))
    with pytest.raises(jc.EquilibriumError, match=r"cells crumple \(J is .* refine the mesh") as caught:
        jc.clamp(human_lad("stop.closed=true", "solver.path_mesh=own"))
    assert caught.value.result.final["closed"] is False
    assert 0.0 < caught.value.result.final["occlusion"] < 1.0


MEASURES = (jc.clamp_force(), jc.smooth_peak_axial_stress("media"), jc.jaw_travel())
PATHS = ("clamp.jaw.radius", "artery.pressure", "artery.layers[0].thickness", "artery.layers[0].material.c")


@pytest.mark.slow
@pytest.mark.parametrize("stop", ["occlusion = 0.925", "occlusion = 0.99", "closed = true", "pressed"])
def test_gradients_through_closure(stop, closed):
    """V-test: central differences over a range of steps fall to 1e-6 of the gradient, or less."""
    force = 2.0 * closed.final["closing_force_N"]
    text = f"closed = true, force_N = {force!r}" if stop == "pressed" else stop
    scene = human_lad(f"stop={{{text}}}")
    scene = dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, tolerance=1e-12))
    base = jc.clamp(scene)
    paths = (*PATHS, "stop.force") if stop == "pressed" else PATHS
    met = (jc.intima_contact_area(),) if "occlusion" not in stop else ()  # inner walls press on each other
    measures = (*MEASURES, *met)
    _, gradients = jc.gradients(base, measures, paths=paths)
    for j, path in enumerate(paths):
        value = float(jc.scenes.address.get(scene, path))
        scale = np.array([abs(base.measure(m)) for m in measures])
        best = np.full(len(measures), np.inf)
        for h in (1e-4, 3e-5, 1e-5, 3e-6, 1e-6, 3e-7):
            ends = [jc.clamp(jc.replace(scene, path, value * (1.0 + s * h)), guess=base) for s in (1.0, -1.0)]
            plus, minus = (np.array([end.measure(m) for m in measures]) for end in ends)
            slope = (plus - minus) / (2.0 * h * value)
            size = np.maximum(np.abs(gradients[:, j]), 1e-3 * scale / value)
            best = np.minimum(best, np.abs(slope - gradients[:, j]) / size)
        assert np.all(best < 1e-6), (path, best)
