"""Clamps that are not two like jaws square across the artery: balance, mirror images, gradients, refusals."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.core.failures import SceneError
from jaxclamp.scenes.address import describe, get
from jaxclamp.scenes.files import loads_scene
from jaxclamp.scenes.presets import presets
from jaxclamp.show.description import describe as said_of

COUNTS = [
    *("mesh.circumferential=4", "mesh.axial=6", "mesh.radial=[2, 1]"),
    *("mesh.circumferential_grading=0.4", "stop.occlusion=0.6"),
]
FLAT = 'shape="flat", half_width_mm=2.0, edge_radius_mm=0.5'


def toothed(profile: str, pitch: float, depth: float, more: str = "") -> tuple[str, ...]:
    teeth = f'profile="{profile}", pitch_mm={pitch}, depth_mm={depth}'
    return (f"clamp.jaw={{{FLAT}, teeth={{{teeth}{more}}}}}",)


CROSSED = 'teeth={profile="sine", direction="both", pitch_mm=2.0, depth_mm=0.2}'
CLAMPS: dict[str, tuple[str, ...]] = {
    "unlike": ("clamp.upper=flat-2mm", "clamp.lower=cylinder-3mm"),
    "toothed": toothed("sine", 2.0, 0.2),
    "wedges beside the middle": toothed("wedge", 2.0, 0.2, ", phase=0.2, tip_radius_mm=0.3"),
    "crossed and crowned": (f"clamp.jaw={{{FLAT}, crown={{rise_mm=0.5, half_width_mm=3.0}}, {CROSSED}}}",),
    "oblique": ("clamp.oblique_deg=10",),
    "hinged": ("clamp.closing={hinge_distance_mm=20}",),
    "partial": ("clamp.reach_mm=3", "stop={travel_mm=0.3}"),
}
SHARE = {"unlike": "1/4", "toothed": "1/8", "wedges beside the middle": "1/4", "crossed and crowned": "1/8"}
SHARE |= {"oblique": "1/2", "hinged": "1/4", "partial": "1/4"}
FLOATS = {
    "unlike": ("clamp.upper.half_width", "clamp.lower.radius", "artery.pressure"),
    "toothed": ("clamp.jaw.teeth.pitch", "clamp.jaw.teeth.depth"),
    "wedges beside the middle": tuple(
        f"clamp.jaw.teeth.{name}" for name in ("pitch", "depth", "phase", "tip_radius")
    ),
    "crossed and crowned": ("clamp.jaw.crown.rise", "clamp.jaw.crown.half_width", "clamp.jaw.teeth.pitch"),
    "oblique": ("clamp.oblique",),
    "hinged": ("clamp.closing.hinge_distance",),
    "partial": ("clamp.reach", "artery.layers[0].thickness"),
}


def scene(*overrides: str) -> jc.Scene:
    return jc.load_scene("human-lad", [*COUNTS, *overrides])


@functools.cache
def clamped(name: str) -> jc.Result:
    return jc.clamp(jc.replace(scene(*CLAMPS[name]), "solver.tolerance", 1e-12))


@pytest.mark.slow
@pytest.mark.parametrize("name", CLAMPS)
def test_forces_balance_upper_against_lower_too(name):
    result = clamped(name)
    assert result.final["force_balance_error"] < 1e-8
    assert result.to_dict()["model"]["symmetry"] == SHARE[name]
    assert result.final["negative_pivots"] == 0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "path"), [(n, p) for n, paths in FLOATS.items() for p in paths])
def test_gradients_by_what_a_clamp_is(name, path):
    """Central differences approach the gradient with the square of the step, down to their noise."""
    result = clamped(name)
    measures = (jc.smooth_peak_axial_stress("media"), jc.clamp_force(), jc.lumen_width())
    _, slopes = jc.gradients(result, measures, [path])
    value = float(get(result.scene, path))
    least = np.full(len(measures), np.inf)
    for step in (3e-4, 3e-5, 1e-5):
        by = step * max(abs(value), 0.1)
        ends = [jc.clamp(jc.replace(result.scene, path, value + s * by), guess=result) for s in (1, -1)]
        found = [(ends[0].measure(m) - ends[1].measure(m)) / (2.0 * by) for m in measures]
        least = np.minimum(least, np.abs(found - np.ravel(slopes)))
    unit = max(abs(value), 0.1)
    sizes = np.abs(np.ravel(slopes)) + 1e-3 * np.abs([result.measure(m) for m in measures]) / unit
    assert np.all(least <= 1e-6 * sizes), least / sizes


@pytest.mark.slow
def test_a_clamp_upside_down_holds_the_mirrored_artery():
    up, down = clamped("unlike"), jc.clamp(scene("clamp.upper=cylinder-3mm", "clamp.lower=flat-2mm"))
    for key in ("clamp_force_N", "lumen_width_mm", "lumen_area_mm2", "max_contact_pressure_kPa"):
        assert down.final[key] == pytest.approx(up.final[key], rel=1e-8), key
    assert down.final["clamp_height_mm"] == pytest.approx(-up.final["clamp_height_mm"], rel=1e-8)
    place, mirrored = (np.asarray(r.states[-1].state.x) for r in (up, down))
    grid = up.model.mesh.grid
    place, mirrored = (x.reshape(*grid[::-1], 3) for x in (place, mirrored))
    np.testing.assert_allclose(mirrored[:, ::-1] * [1, -1, 1], place, atol=1e-7)


@pytest.mark.slow
def test_a_clamp_turned_the_other_way_holds_the_mirrored_artery():
    here, there = clamped("oblique"), jc.clamp(scene("clamp.oblique_deg=-10"))
    for key in ("clamp_force_N", "lumen_width_mm", "lumen_area_mm2"):
        assert there.final[key] == pytest.approx(here.final[key], rel=1e-8), key


@pytest.mark.slow
def test_two_like_jaws_are_the_same_said_in_either_way():
    """A pair with one jaw on both sides is one of like jaws; made by hand, it is solved on a larger model."""
    like = scene("clamp.upper=cylinder-3mm", "clamp.lower=cylinder-3mm")
    assert list(like.clamp.kinds) == ["jaw"]
    jaw = like.clamp.jaw
    pair = jc.replace(like, "clamp", type(like.clamp)(upper=jaw, lower=jaw))
    one, two = jc.clamp(like), jc.clamp(pair)
    assert two.to_dict()["model"]["symmetry"] == "1/4"
    for key in ("clamp_force_N", "lumen_width_mm", "max_contact_pressure_kPa"):
        assert two.final[key] == pytest.approx(one.final[key], rel=1e-8), key
    assert two.final["clamp_height_mm"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("choice", ["xyz", "xz"])
def test_walls_that_meet_are_the_same_with_and_without_the_plane_between_them(choice):
    """Opposite walls against each other, or both against the plane of symmetry: the same closed lumen."""
    result = jc.clamp(scene("clamp.jaw=flat-2mm", "stop={closed=true}", f"mesh.symmetry={choice}"))
    reference = jc.clamp(scene("clamp.jaw=flat-2mm", "stop={closed=true}"))
    for key in ("clamp_force_N", "intima_contact_area_mm2", "lumen_overlap_mm", "intima_force_share"):
        assert result.final[key] == pytest.approx(reference.final[key], rel=1e-6), key


def test_the_model_is_as_large_as_the_clamp_asks_for():
    share = {name: said_of(scene(*overrides))["symmetry"] for name, overrides in CLAMPS.items()}
    assert share == SHARE
    whole = said_of(scene(*CLAMPS["unlike"], *CLAMPS["oblique"]))
    assert whole["symmetry"] == "1"
    assert "'flat' and 'cylinder' jaws" in whole["terms"]["jaw contact"]


FIVE = "length_mm=20, width_mm=1, edge_radius_mm=0.5, tooth_pitch_mm=1, tooth_depth_mm=0"
REFUSED = {
    ("clamp.upper=flat-2mm",): "clamp = { upper",
    ("clamp.oblique_deg=10", "mesh.symmetry=xyz"): "mesh.symmetry",
    ("clamp.reach_mm=0",): "clamp.reach_mm",
    ("clamp.reach_mm=0.01",): "so that the jaws reach the artery",
    ("clamp.closing={hinge_distance_mm=2}",): "a hinge beside the artery",
    toothed("sine", 2.0, 0.6): "clamp.jaw.teeth.depth_mm",
    toothed("sine", 0.3, 0.4): "at most the pitch",
    toothed("sine", 0.2, 0.1): "contact points",
    toothed("saw", 2.0, 0.1): "sine, ",
    toothed("wedge", 2.0, 0.1, ", tip_radius_mm=3.0"): "tip_radius_mm",
    (f'clamp.jaw={{shape="measured", {FIVE}}}',): "less than half the width",
}


@pytest.mark.parametrize("overrides", REFUSED, ids=lambda o: o[-1][:60])
def test_impossible_clamps_are_refused_in_one_sentence(overrides):
    with pytest.raises(SceneError) as caught:
        scene(*overrides)
    said = str(caught.value)
    assert REFUSED[overrides].replace('"', "") in said.replace('"', "")
    assert "\n" not in said


@pytest.mark.parametrize("name", CLAMPS)
def test_clamps_are_written_and_read_again(name):
    one = scene(*CLAMPS[name])
    again = loads_scene(jc.dump_scene(one))
    assert jax.tree_util.tree_structure(again) == jax.tree_util.tree_structure(one)
    assert again == one


def test_an_address_of_what_is_not_there_says_so():
    with pytest.raises(SceneError, match="is not there"):
        describe(scene(), "clamp.oblique")
    assert jc.replace(scene(), "clamp.oblique", 0.1).clamp.planes == "y"


@pytest.mark.parametrize("name", [each.name for each in presets("clamp")])
def test_every_clamp_that_ships_can_be_modelled_and_says_where_its_numbers_are_from(name):
    found = said_of(jc.load_scene("human-lad", [f"clamp={name}"]))
    assert found["terms"]["jaw contact"].startswith("rigid")
    assert "illustrative" in next(each for each in presets("clamp") if each.name == name).text
