"""What `jaxclamp show` says of a scene, against what the engine then makes of it."""

import pytest

import jaxclamp as jc
from jaxclamp.potential.model import build_model
from jaxclamp.show.description import describe, warnings

SMALL = ["mesh.circumferential=3", "mesh.axial=3", "mesh.radial=[1, 1]"]


@pytest.mark.parametrize("pressure", [0.0, 13.33])
def test_the_terms_there_are_are_listed(pressure):
    described = describe(jc.load_scene("human-lad", [f"artery.pressure_kPa={pressure}"], "seed"))
    assert described["unknowns"] == 4266
    assert ("blood pressure" in described["terms"]) == (pressure > 0.0)
    assert set(described["terms"]) >= {"wall: media", "wall: adventitia", "incompressibility", "jaw contact"}
    assert all(len(reason) > 20 for reason in described["terms"].values())


@pytest.mark.parametrize(
    ("symmetry", "share", "words"),
    [
        ("auto", "1/8", "one eighth: a quarter of the circumference by half the length"),
        ("xz", "1/4", "one quarter: one side of the circumference by half the length"),
        ("z", "1/2", "one half: the whole circumference by half the length"),
        ("none", "1", "the whole artery"),
    ],
)
def test_the_modelled_part_is_named_and_counted(symmetry, share, words):
    scene = jc.load_scene("human-lad", [*SMALL, f"mesh.symmetry={symmetry}"])
    described, model = describe(scene), build_model(scene)
    assert described["symmetry"] == share
    assert described["modelled"].startswith(words)
    assert described["unknowns"] == model.pattern.n
    assert described["elements"] == model.mesh.n_cells
    assert described["predicted_seconds"] > 0.0


@pytest.mark.parametrize("symmetry", ["xyz", "xy", "none"])
def test_an_edge_too_sharp_for_the_mesh_is_warned_of(symmetry):
    jaw = 'clamp.jaw={shape="flat", half_width_mm=1.0, edge_radius_mm=0.2}'
    (said,) = warnings(jc.load_scene("human-lad", [*SMALL, jaw, f"mesh.symmetry={symmetry}"]))
    assert said == warnings(jc.load_scene("human-lad", [*SMALL, jaw]))[0]
    assert said.startswith("the jaw's least radius of curvature is 0.2 mm")
    assert warnings(jc.load_scene("human-lad", [f"mesh.symmetry={symmetry}"])) == []
