"""The whole path on a small mesh: checks, stops, continuations, starts and variants of one clamping."""

from __future__ import annotations

import dataclasses
import functools
import json
import math

import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.observe.stops import ForceStop, OcclusionStop, TravelStop
from jaxclamp.physics.jaws import Flat, Spline
from jaxclamp.physics.materials import GOH, NeoHookean
from jaxclamp.solve.linear_solvers import available
from tube import MEDIA, SEED_STRETCH, Compressible
from walks import mesh

OCCLUSION = 0.8


def small(**changes) -> jc.Scene:
    """The seed's artery and clamp on 6 x 8 x (2 + 1) elements; `changes` by path with dots as __."""
    scene = dataclasses.replace(
        jc.load_scene("human-lad"),
        mesh=mesh("q1p0", 6, 8, (2, 1)),
        stop=OcclusionStop(occlusion=OCCLUSION),
    )
    for path, value in changes.items():
        scene = jc.replace(scene, path.replace("__", "."), value)
    return scene


@functools.cache
def reference() -> jc.Result:
    return jc.clamp(small())


def assert_sound(result: jc.Result) -> None:
    """What holds of every converged clamping."""
    assert result.converged
    for record in result.history:
        assert record["force_balance_error"] < 1e-6
        assert record["J_min"] > 0.0
        assert record["max_penetration_mm"] < 0.1
        assert record["residual_mN"] < 1e-5
    assert result.solver["work_balance_error"] < 1e-2
    assert result.final["clamp_force_N"] > 0.0


def assert_same_state(a: jc.Result, b: jc.Result, tolerance: float = 1e-6) -> None:
    """The last states agree: positions in mm, jaw height in mm."""
    x, y = (np.asarray(r.states[-1].state.x) for r in (a, b))
    np.testing.assert_allclose(x, y, rtol=0.0, atol=tolerance)
    assert float(a.states[-1].state.jaw_height) == pytest.approx(
        float(b.states[-1].state.jaw_height), abs=tolerance
    )


def test_reference_is_sound_and_reaches_its_stop():
    result = reference()
    assert_sound(result)
    final, base = result.final, result.history[0]
    assert final["occlusion"] == pytest.approx(OCCLUSION, abs=1e-7)
    assert final["lumen_height_mm"] == pytest.approx((1 - OCCLUSION) * base["lumen_height_mm"], rel=1e-6)
    assert final["lumen_width_mm"] > base["lumen_width_mm"]
    assert final["axial_stress_ratio_at_P"] > 1.5
    assert final["circumferential_stress_ratio_at_P"] < 0.9
    assert base["clamp_force_N"] == 0.0
    assert result.load_free.values["lumen_height_mm"] < base["lumen_height_mm"]


def test_history_is_monotone():
    history = reference().history
    assert len(history) >= 4
    assert [record["stage"] for record in history] == ["physiological"] + ["clamping"] * (len(history) - 1)
    for key in ("jaw_travel_mm", "occlusion", "clamp_force_N", "area_occlusion"):
        values = [record[key] for record in history]
        assert np.all(np.diff(values) > 0.0), key


def test_force_is_minus_the_slope_of_the_energy_over_travel():
    """Two stops a little apart: the energy of the whole artery rises by force times travel, two jaws."""
    h = 1e-3
    travel = reference().final["jaw_travel_mm"]
    ends = [
        jc.clamp(small(stop=TravelStop(travel=travel + sign * h)), guess=reference()).final
        for sign in (-1.0, 1.0)
    ]
    slope = (ends[1]["total_energy_uJ"] - ends[0]["total_energy_uJ"]) / (2.0 * h)  # mN
    assert slope == pytest.approx(2.0 * 1e3 * reference().final["clamp_force_N"], rel=1e-5)


CONTRACT_FINAL = [
    "jaw_travel_mm",
    "lumen_height_mm",
    "lumen_width_mm",
    "occlusion",
    "lumen_area_mm2",
    "area_occlusion",
    "clamp_force_N",
    "max_contact_pressure_kPa",
    "max_penetration_mm",
    "axial_stress_at_P_kPa",
    "axial_stress_ratio_at_P",
    "circumferential_stress_ratio_at_P",
    "peak_axial_stress_kPa",
    "peak_axial_stress_location_mm",
    "smooth_peak_axial_stress_kPa",
    "J_min",
    "J_max",
]
CONTRACT = {
    "load_free": ["lumen_radius_mm", "outer_radius_mm"],
    "physiological": [
        "lumen_radius_mm",
        "outer_radius_mm",
        "axial_stress_at_P_kPa",
        "circumferential_stress_at_P_kPa",
    ],
    "final": CONTRACT_FINAL,
    "model": ["symmetry", "elements", "unknowns", "terms"],
    "solver": ["load_steps", "newton_iterations", "factorisations", "residual_mN", "force_balance_error"],
    "cost": ["wall_s", "compile_s", "assembly_s", "factor_s", "peak_memory_MB"],
}


def test_to_dict_keeps_the_contract():
    content = reference().to_dict()
    text = json.dumps(content, allow_nan=False)
    assert json.loads(text)["title"] == content["title"]
    assert content["converged"] is True
    for group, keys in CONTRACT.items():
        assert set(keys) <= set(content[group]), group
    for record in content["history"]:
        assert set(CONTRACT_FINAL) <= set(record)
    for name in ("peak_axial_stress_kPa", "peak_axial_stress_location_mm", "smooth_peak_axial_stress_kPa"):
        assert set(content["final"][name]) == {"media", "adventitia"}
    peak, smooth = content["final"]["peak_axial_stress_kPa"], content["final"]["smooth_peak_axial_stress_kPa"]
    assert all(0.3 * peak[layer] < smooth[layer] <= peak[layer] for layer in peak)
    assert {"python", "jax", "numpy", "scipy"} <= set(content["versions"])
    assert content["model"]["elements"] == 6 * 8 * 3
    assert content["model"]["unknowns"] == reference().model.pattern.n


# ------------------------------------------------------------------ one state, however it is reached


def test_stop_by_travel():
    result = jc.clamp(small(stop=TravelStop(travel=reference().final["jaw_travel_mm"])))
    assert_sound(result)
    assert_same_state(result, reference())


def test_stop_by_force():
    result = jc.clamp(small(stop=ForceStop(force=1e3 * reference().final["clamp_force_N"])))
    assert_sound(result)
    assert_same_state(result, reference(), 1e-5)


def test_continuation_by_travel():
    result = jc.clamp(small(solver__continuation="travel"))
    assert_sound(result)
    assert_same_state(result, reference())


def test_warm_start_from_a_neighbour():
    """From a jaw of another radius and a softer media, and no more work than a cold start."""
    neighbour = small(clamp__jaw__radius=2.6, artery__layers=_softer())
    warm = jc.clamp(small(), guess=jc.clamp(neighbour))
    assert_sound_end(warm)
    assert_same_state(warm, reference())
    assert warm.solver["newton_iterations"] < reference().solver["newton_iterations"]


def _softer():
    layers = small().artery.layers
    return (jc.replace(layers[0], "material.c", 24.0), layers[1])


def assert_sound_end(result: jc.Result) -> None:
    """The last state of a warm start, which keeps no closing history."""
    assert result.converged
    assert result.final["force_balance_error"] < 1e-6
    assert result.final["J_min"] > 0.0


@pytest.mark.parametrize("name", available())
def test_linear_solvers_agree(name):
    result = jc.clamp(small(solver__linear_solver=name))
    assert result.solver["linear_solver"] == name
    assert_same_state(result, reference())


def test_no_pressure():
    """Without blood pressure the artery is closed from its stretched, load-free state."""
    result = jc.clamp(small(artery__pressure=0.0, stop__occlusion=0.6))
    assert_sound(result)
    assert "blood pressure" not in result.to_dict()["model"]["terms"]
    assert result.final["clamp_force_N"] < 0.5 * reference().final["clamp_force_N"]


# ------------------------------------------------------------------ what cannot be done


@pytest.mark.parametrize("stop", [TravelStop(travel=8.0), ForceStop(force=1e7)], ids=["travel", "force"])
def test_a_stop_out_of_reach_keeps_what_converged(stop):
    with pytest.raises(jc.EquilibriumError) as caught:
        jc.clamp(small(stop=stop))
    error = caught.value
    assert error.stage == "clamping"
    assert "\n" not in str(error)
    kept = error.result
    assert not kept.converged
    assert kept.physiological is not None
    assert len(kept.history) > 2
    assert all(record["J_min"] > 0.0 for record in kept.history)
    content = kept.to_dict()
    assert content["converged"] is False
    assert content["failure"] == str(error)
    json.dumps(content, allow_nan=False)


# ------------------------------------------------------------------ variants of the model


@pytest.mark.slow
def test_one_layer_with_printed_equation_10_and_a_spline_jaw():
    """The media alone at 4 kPa; its fibres are softer by Eq. (10), so that it is wider than by Eq. (4)."""
    media = small().artery.layers[0]
    printed = dataclasses.replace(media, material=dataclasses.replace(media.material, fibre_energy="eq10"))
    jaw = Spline(half_width=2.5, slopes=np.array([0.05, 0.15, 0.3, 0.5]), edge_radius=1.0)
    result = jc.clamp(
        small(artery__layers=(printed,), artery__pressure=4.0, mesh__radial=(3,), clamp__jaw=jaw)
    )
    assert_sound(result)
    assert set(result.final["peak_axial_stress_kPa"]) == {"media"}
    assert result.final["occlusion"] == pytest.approx(OCCLUSION, abs=1e-7)
    radii = [
        Compressible((dataclasses.replace(MEDIA, law=law),), 4.0, SEED_STRETCH, 1e4).inner_radius
        for law in ("eq4", "eq10")
    ]
    radius = 0.5 * result.history[0]["lumen_height_mm"]
    assert radius == pytest.approx(radii[1], rel=3e-3)  # of the mesh, see the tube's convergence
    assert abs(radii[0] / radii[1] - 1.0) > 1.5e-2


@pytest.mark.slow
def test_three_layers_of_three_laws_and_a_flat_jaw():
    media, adventitia = small().artery.layers
    dispersed = GOH(c=2.7, k1=5.1, k2=15.4, dispersion=0.1, fibre_angle=math.radians(40.0), bulk=1e4)
    skin = dataclasses.replace(
        adventitia,
        name="skin",
        inner_radius=adventitia.inner_radius + adventitia.thickness,
        thickness=0.1,
        material=NeoHookean(c=2.0, bulk=1e4),
    )
    layers = (media, dataclasses.replace(adventitia, material=dispersed), skin)
    jaw = Flat(half_width=2.0, edge_radius=1.0)
    settings = mesh("q1pz", 6, 8, (2, 1, 1))  # the thin skin of long q1p0 cells crumples under the jaw
    result = jc.clamp(small(artery__layers=layers, mesh=settings, clamp__jaw=jaw))
    assert_sound(result)
    assert set(result.final["peak_axial_stress_kPa"]) == {"media", "adventitia", "skin"}


@pytest.mark.slow
def test_quadratic_elements():
    """27-node elements on a coarse mesh, against 8-node ones on a mesh of as many nodes."""
    result = jc.clamp(small(mesh=mesh("q2p1", 4, 5, (1, 1)), stop__occlusion=0.6))
    assert_sound(result)
    assert result.model.mesh.element.name == "q2p1"
    # semi-analytic, bulk 1e4: 2.5101 mm
    assert result.history[0]["lumen_height_mm"] == pytest.approx(2.0 * 2.5101, rel=1e-3)


# ------------------------------------------------------------------ the study of 2002

# Human LAD between cylinders of radius 3 mm, 10 x 15 x (5 + 3) elements, closed to 92.5 %.
# Printed there: lumen radius 2.52 mm, then 0.378 x 5.983 mm and "about four times" the axial stress at P.
# An independent code on this mesh: Eq. (4) 2.512 mm, 0.377 x 5.982 mm, x 4.23, x 0.32, 0.47 N;
# Eq. (10) 2.524 mm, 0.378 x 6.047 mm.


def test_the_study_of_2002():
    result = jc.clamp(jc.load_scene("human-lad", fidelity="seed"))
    assert_sound(result)
    final, content = result.final, result.to_dict()
    assert content["model"]["elements"] == 1200
    assert content["physiological"]["lumen_radius_mm"] == pytest.approx(2.512, abs=1e-3)
    assert 0.3765 <= final["lumen_height_mm"] <= 0.3785
    assert final["lumen_width_mm"] == pytest.approx(5.98, abs=0.02)
    assert 4.0 < final["axial_stress_ratio_at_P"] < 4.5
    assert final["circumferential_stress_ratio_at_P"] < 0.5
    assert final["clamp_force_N"] == pytest.approx(0.48, abs=0.01)
    peak = final["peak_axial_stress_kPa"]
    assert peak["adventitia"] > peak["media"]
    assert not result.solver["snapped"]
    assert result.solver["negative_pivots"] in (0, None)


@pytest.mark.slow
def test_the_study_of_2002_with_printed_equation_10():
    result = jc.clamp(jc.load_scene("human-lad-eq10", fidelity="seed"))
    assert_sound(result)
    content, final = result.to_dict(), result.final
    assert content["physiological"]["lumen_radius_mm"] == pytest.approx(2.524, abs=1e-3)
    assert final["lumen_height_mm"] == pytest.approx(0.378, abs=1e-3)
    assert final["lumen_width_mm"] == pytest.approx(6.047, abs=0.02)


@pytest.mark.parametrize("occlusion", [0.97, 0.99])
def test_the_inner_walls_meet_and_carry_load(occlusion):
    """Past first contact of the intima with itself: still in balance, nothing sinks in far."""
    scene = jc.load_scene("human-lad", [f"stop.occlusion={occlusion}"])
    result = jc.clamp(scene)
    wall = result.physiological.values["outer_radius_mm"] - result.physiological.values["lumen_height_mm"] / 2
    assert result.final["occlusion"] == pytest.approx(occlusion, abs=1e-7)
    assert result.final["lumen_contact_force_N"] > 0.0
    assert result.final["lumen_contact_force_N"] < result.final["clamp_force_N"]
    assert 0.0 < result.final["lumen_overlap_mm"] < 0.2 * wall
    assert result.final["force_balance_error"] < 1e-8
    # a kink of the force, where walls touch within a step, is what the rule of the work misses: 1.3e-3 of it
    assert result.solver["work_balance_error"] < 2e-3
    open_states = [record for record in result.history if record["lumen_overlap_mm"] <= 0.0]
    assert all(record["lumen_contact_force_N"] == 0.0 for record in open_states)
    assert len(open_states) >= 3


def test_nothing_is_measured_or_differentiated_short_of_the_stop():
    """The states that did converge are kept, but they are not at the stop."""
    counts = ["mesh.circumferential=4", "mesh.axial=6", "mesh.radial=[2, 1]"]
    with pytest.raises(jc.EquilibriumError) as caught:
        jc.clamp(jc.load_scene("human-lad", [*counts, "stop={force_N=900}"]))
    partial = caught.value.result
    assert partial.states[-1].stage == "clamping"
    with pytest.raises(jc.EquilibriumError):
        partial.measure(jc.clamp_force())
    with pytest.raises(jc.EquilibriumError):
        jc.value_and_gradient(partial, jc.clamp_force())


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("artery.layers[0].thickness", -0.1, r"artery\.layers\[0\]\.thickness_mm = -0\.1: expected"),
        ("artery.pressure", float("nan"), r"artery\.pressure_kPa = nan: expected"),
        ("clamp.jaw.radius", 0.0, r"clamp\.jaw\.radius_mm = 0\.0: expected"),
        ("contact.stiffness", float("inf"), r"contact\.stiffness_kPa_per_mm = inf: expected"),
    ],
)
def test_nonsense_made_in_python_is_refused(path, value, said):
    with pytest.raises(jc.SceneError, match=said):
        jc.clamp(jc.replace(jc.load_scene("human-lad"), path, value))
