"""Clamps compared on one artery: ranks and ties, the states, a clamp that fails, the command as typed."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.cli import main
from jaxclamp.pictures.plots import png
from optimize.comparison import (
    Asked,
    Clamped,
    Comparison,
    _doubted,
    asked_clamps,
    compare,
    lines,
    path,
    ranking,
    rise,
    tied,
)
from optimize.comparison_report import plates_of
from optimize.figures import profile

SMALL = ["mesh.circumferential=5", "mesh.axial=8", "mesh.radial=[2, 1]"]
LAYERS = ("media", "adventitia")


def estimate(value: float, *sources: float | None) -> jc.Estimate:
    return jc.Estimate(value, dict(zip("abcd", sources, strict=False)))


def clamped(name: str, ranked: jc.Estimate | None, *failures: str) -> Clamped:
    scene = jc.load_scene("human-lad", SMALL)
    return Clamped(Asked(name, name, "", scene), ranked=ranked, failures=failures)


def test_what_both_have_of_an_error_does_not_tie_them():
    assert not tied(estimate(10.0, 3.0), estimate(11.0, 3.5))
    assert tied(estimate(10.0, 3.0), estimate(11.0, 4.5))
    assert tied(estimate(10.0, None), estimate(99.0, 1.0))  # nothing is known of the difference


def test_ranks_of_ties_and_of_clamps_that_failed():
    values = [estimate(10.0, 0.0), estimate(11.0, 2.0), estimate(14.0, 0.5), estimate(14.2, 0.8), None]
    clamps = tuple(
        clamped(name, value, *(["it slips"] if value is None else []))
        for name, value in zip("abcde", values, strict=True)
    )
    by, measure = ranking("clamp_force", LAYERS)
    found = Comparison("", by, measure, None, clamps)
    assert [found.rank(place) for place in range(5)] == [1, 1, 3, 3, None]
    table = lines(found)
    assert table[1].startswith("1 =  a")
    assert table[3].startswith("3 =  c")
    assert table[5].startswith("–")
    assert table[-1] == "e: it slips"


@pytest.mark.parametrize(
    ("asked", "name"),
    [
        (None, "smooth_peak_axial_stress_kPa.media"),
        ("smooth_peak_axial_stress", "smooth_peak_axial_stress_kPa.media"),
        ("smooth_peak_axial_stress_kPa.adventitia", "smooth_peak_axial_stress_kPa.adventitia"),
        ("clamp_force_N", "clamp_force_N"),
        ("clamp_force", "clamp_force_N"),
        ("mean_damage", "mean_damage.media"),
        ("smooth_peak_damage.adventitia", "smooth_peak_damage.adventitia"),
        ("smooth_peak_axial_strain_gradient", "smooth_peak_axial_strain_gradient_per_mm"),
        ("intima_contact_area", "intima_contact_area_mm2"),
    ],
)
def test_names_of_measures(asked, name):
    assert ranking(asked, LAYERS)[0] == name


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("clamp_farce_N", "did you mean clamp_force_N"),
        ("clamp_force_N.media", "not of a layer"),
        ("smooth_peak_axial_stress_kPa.intima", "one of media, adventitia"),
        ("volume_above", "no such measure"),
        ("mean_damage.intima", "one of media, adventitia"),
    ],
)
def test_measures_that_there_are_not(asked, said):
    with pytest.raises(jc.SceneError, match=said):
        ranking(asked, LAYERS)


@pytest.mark.parametrize(
    ("clamps", "said"),
    [
        ("cylinder-3mm", "expected two or more"),
        ("cylinder-3mm,cylinder-3mm", "is there twice"),
        ("cylinder-3mm,cilinder-1mm", "cylinder-1mm"),
        ("cylinder-3mm,no-such.toml", "there is no such file"),
    ],
)
def test_clamps_that_there_are_not(clamps, said):
    with pytest.raises(jc.SceneError, match=said):
        asked_clamps("human-lad", clamps, SMALL)


def test_rise_of_a_piecewise_linear_force():
    """Slopes 1 up to 2 N, 4 from there: closed at 2 N, the last and the next half newton take 1/2 and 1/8."""
    travel = np.array([0.1, 1.0, 2.0, 2.5])
    force = np.where(travel <= 2.0, travel, 2.0 + 4.0 * (travel - 2.0))
    known = [
        {"stage": "clamping", "mesh": "own", "jaw_travel_mm": d, "clamp_force_N": F}
        for d, F in zip(travel, force, strict=True)
    ]

    @dataclasses.dataclass
    class Told:
        history: list

    assert rise(Told(known), 2.0) == pytest.approx(4.0)
    assert rise(Told(known), 3.5) is None  # pressed on by less than a quarter
    coarser = {"stage": "clamping", "mesh": "coarser"}
    way = [
        coarser | {"jaw_travel_mm": d, "clamp_force_N": F} for d, F in ((0.05, 0.04), (2.1, 1.9), (1.9, 2.2))
    ]
    assert path(Told([*way, *known[2:]])) == ([0.05, 2.0, 2.5], [0.04, 2.0, 4.0])  # no step back
    known[2]["clamp_force_N"] = 0.5  # it snapped
    assert rise(Told(known), 2.0) is None


def test_faces_steeper_than_a_height_can_tell_are_drawn():
    """The sides of a jaw with a sharp edge have no one height: their profile is not a number there."""
    found = []
    for name in ("cylinder-3mm", "wide-nearly-flat"):
        few = [*SMALL, "stop={ travel_mm = 0.1 }", f"clamp.jaw={name}"]
        result = jc.clamp(jc.load_scene("human-lad", few))
        asked = Asked(name, name, "", result.scene)
        found.append(Clamped(asked, at_stop=result, ranked=estimate(1.0 + len(found), 0.1)))
    assert np.any(np.isnan(profile(found[1].at_stop)[1]))
    plates = plates_of(Comparison("", *ranking(None, LAYERS), None, tuple(found)))
    assert [plate.name for plate in plates] == ["ranking", "axial_stress", "damage"]
    assert all(len(png(plate.figure, 50)) > 5000 for plate in plates)


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A wide jaw, a narrow one, and one that slips between the contact points, from the command line."""
    folder = tmp_path_factory.mktemp("compared")
    sharp = folder / "sharp edge.toml"
    sharp.write_text('# A wire\n#\n# made up\nshape = "cylinder"\nradius_mm = 0.05\n')
    jaws = f"cylinder-3mm,cylinder-1mm,{sharp}"
    options = [part for each in SMALL for part in ("--set", each)]
    code = main(["compare", "human-lad", "--clamps", jaws, "--out", str(folder / "out"), "-q", *options])
    return code, folder / "out"


@pytest.mark.slow
def test_the_command_writes_what_it_found(compared):
    code, out = compared
    assert code == 0
    content = json.loads((out / "compare.json").read_text())
    assert (content["rank_by"], content["unit"]) == ("smooth_peak_axial_stress_kPa.media", "kPa")
    assert [each["name"] for each in content["clamps"][:2]] == ["cylinder-3mm", "cylinder-1mm"]
    wide, narrow, wire = content["clamps"]
    assert wide["value"] < narrow["value"]
    assert (wire["converged"], wire["rank"], wire["final"]) == (False, None, None)
    assert "contact points" in wire["failure"]
    assert (wire["title"], wire["source"]) == ("A wire", "made up")
    for each in (wide, narrow):
        assert each["final"]["occlusion"] == pytest.approx(0.925, abs=1e-6)
        assert each["value"] == pytest.approx(each["final"]["smooth_peak_axial_stress_kPa"]["media"])
        assert each["closed"]["closed"] is True
        assert each["closing_force_N"] == pytest.approx(each["closed"]["clamp_force_N"])
        assert each["at_equal_force"]["clamp_force_N"] == pytest.approx(content["force_N"], rel=1e-6)
        assert each["rise_at_closure"] > 1.0
    page = (out / "report.html").read_text()
    assert "What failed, or is in doubt" in page
    assert page.count("<figure") == 3
    assert (out / "clamps" / "cylinder-1mm" / "result.json").exists()


@pytest.mark.slow
def test_in_one_process_the_same():
    scene = asked_clamps("human-lad", "cylinder-3mm,cylinder-1mm", SMALL)
    by, measure = ranking("clamp_force_N", LAYERS)
    found = compare(scene, by, measure, processes=1)
    assert [each.asked.name for each in found.clamps] == ["cylinder-1mm", "cylinder-3mm"]
    direct = jc.clamp(scene[0].scene).final["clamp_force_N"]
    assert found.to_dict()["clamps"][1]["value"] == pytest.approx(direct, rel=1e-9)


def test_bad_input_is_one_sentence(capsys, tmp_path):
    jaws = ["--clamps", "cylinder-3mm,flat-2mm"]
    assert main(["compare", "human-lad", *jaws, "--rank", "beauty", "--out", str(tmp_path / "x")]) == 2
    said = capsys.readouterr().err
    assert "no such measure" in said
    assert said.count("\n") == 1
    assert not (tmp_path / "x").exists()
    assert main(["compare", "human-lad", "--clamps", "cylinder-3mm"]) == 2
    (tmp_path / "report.html").write_text("mine")
    assert main(["compare", "human-lad", *jaws, "--out", str(tmp_path)]) == 2
    assert "report.html" in capsys.readouterr().err
    assert (tmp_path / "report.html").read_text() == "mine"


def test_another_equilibrium_is_told():
    """As `run` warns of it: a rank from a state that closing jaws do not come to is no answer."""

    @dataclasses.dataclass
    class Found:
        solver: dict

    known = clamped("a", estimate(1.0, 0.1))
    assert _doubted(known, Found({"branch": "closing path"}), "closed").failures == ()
    assert _doubted(known, Found({"branch": "another equilibrium: x"}), "closed").failures == (
        "closed: another equilibrium: x",
    )
