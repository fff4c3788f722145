"""The unlikely is noted in a sentence, and nothing is refused for it."""

import dataclasses

import pytest

import jaxclamp as jc
from jaxclamp.cli import main
from jaxclamp.scenes.notes import RANGES, notes, notes_of_states
from jaxclamp.scenes.presets import presets

MEDIA = "artery.layers[0].material"


@pytest.mark.parametrize("name", [p.name for p in presets() if p.kind == "scene"])
def test_arteries_of_sources_have_no_note(name):
    assert notes(jc.load_scene(name)) == []


@pytest.mark.parametrize(
    ("override", "said"),
    [
        # case 19: mmHg as kPa, MPa as kPa, a bulk modulus of 3.7 c
        ("artery.pressure_kPa=100", "artery.pressure_kPa = 100 is far from the 1.33 to 28.7 kPa that"),
        ("artery.pressure_kPa=100", "; if it is in mmHg, write 13.33"),
        (f"{MEDIA}.c_kPa=0.027", "c_kPa = 0.027 is far from the 0.3 to 97.4 kPa"),
        (f"{MEDIA}.c_kPa=0.027", "; if it is in MPa, write 27"),
        (f"{MEDIA}.bulk_kPa=99.9", f"{MEDIA}.bulk_kPa is 3.7 times c_kPa: an artery hardly"),
        (f"{MEDIA}.k1_kPa=640000", "; if it is in Pa, write 640"),
        (f"{MEDIA}.k2=3540", "k2 = 3540 is far from the 0.711 to 525 that arteries have"),
        (f"{MEDIA}.fibre_angle_deg=0.698", "; if it is in rad, write 39.99"),
        ("artery.layers[1].opening_angle_deg=2.09", "; if it is in rad, write 119.7"),
        ("artery.layers[1].opening_angle_deg=-60", "opening_angle_deg = -60 is far from the 60 to 193 deg"),
        ("artery.axial_stretch=3", "axial_stretch = 3 is far from the 0.984 to 1.9 that arteries have"),
        ("artery.layers[1].inner_radius_mm=5", "artery.layers[1], adventitia, does not nest: closing round"),
    ],
)  # fmt: skip
def test_what_is_far_from_sourced_ranges_is_noted(override, said):
    assert said in "\n".join(notes(jc.load_scene("human-lad", [override])))


def test_layers_in_swapped_order_do_not_nest():
    for name, stretch in (("human-lad", "1.37"), ("rabbit-carotid", "1.31")):
        scene = jc.load_scene(name)
        (said,) = notes(jc.replace(scene, "artery.layers", scene.artery.layers[::-1]))
        assert said.startswith("artery.layers[1], media, does not nest")
        assert f"its circumference {stretch}-fold" in said


def test_what_is_left_out_on_purpose_is_not_noted():
    zeros = [f"{MEDIA}.{key}=0" for key in ("k1_kPa", "k2", "fibre_angle_deg")]
    assert notes(jc.load_scene("human-lad", ["artery.pressure_kPa=0", *zeros])) == []


def test_a_constant_per_point_is_noted_by_the_value_that_is_far():
    scene = jc.replace(jc.load_scene("human-lad"), f"{MEDIA}.c", [[27.0, 300.0]])
    c, bulk = notes(scene)
    assert c.startswith(f"{MEDIA}.c_kPa = 300 is far")
    assert bulk.startswith(f"{MEDIA}.bulk_kPa is 33.3 times c_kPa")


def test_the_ends_of_ranges_are_not_far():
    for known in RANGES.values():
        assert known.has(known.lower)
        assert known.has(known.upper)
        assert not known.has(known.upper * known.far * 1.01)
        assert not dataclasses.replace(known, zero=False).has(0.0)


def test_volumes_that_change_are_noted():
    place = {"side_force_N": 0.0, "clamp_height_mm": 0.0, "clamp_force_N": 0.5}
    rest = {"J_share_off": 0.02, "fold_stretch_ratio": 0.5, **place}
    tube = {"lumen_height_mm": 5.0}
    body, last = {"J_min": 1.001, "J_max": 1.003, **tube}, {"J_min": 0.85, "J_max": 1.13, **rest}
    assert notes_of_states([]) == []
    assert notes_of_states([body, last]) == []
    (said,) = notes_of_states([body, {"J_min": 0.7, "J_max": 1.26, **rest}])
    assert said.startswith(
        "J is 0.7 to 1.26 at single points of the last state, off by more than 5 % in 0.02 of"
    )
    (said,) = notes_of_states([body, {**last, "fold_stretch_ratio": 0.4}])
    assert "surface creases below 0.417" in said
    (said,) = notes_of_states([body, {**last, "side_force_N": 0.1}])
    assert "coefficient of friction of 0.1 " in said
    (said,) = notes_of_states([body, {**last, "clamp_height_mm": 0.7}])
    assert said.startswith("the jaws, which are not alike, have bent the artery 0.7 mm")
    (said,) = notes_of_states([{"J_min": 0.99, "J_max": 1.06, **tube}, last])
    assert said.startswith("J is 0.99 to 1.06 in the body: the wall changes its volume")


def test_show_tells_and_results_keep_them(capsys):
    mesh = ["mesh.circumferential=4", "mesh.axial=6", "mesh.radial=[1,1]", "stop.occlusion=0.05"]
    soft = [f"{MEDIA}.bulk_kPa=99.9", f"{MEDIA}.c_kPa=27"]
    sets = [word for override in (*mesh, *soft) for word in ("--set", override)]
    said = f"{MEDIA}.bulk_kPa is 3.7 times c_kPa"
    assert main(["show", "human-lad", *sets]) == 0
    assert f"  notes\n    {said}" in capsys.readouterr().out
    result = jc.clamp(jc.load_scene("human-lad", [*mesh, *soft]))
    of_scene, of_states = result.to_dict()["notes"]
    assert of_scene.startswith(said)
    assert of_states.startswith("J is ")
    assert "in the body: the wall changes its volume" in of_states
