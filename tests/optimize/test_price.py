"""What a design costs: differences with their errors, the table of injuries, bounds at the reference."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.cli import main
from jaxclamp.pictures.fields import contact_along
from jaxclamp.scenes.presets import presets as shipped
from jaxclamp.show.console import as_json
from optimize import Constraint, DesignProblem, Variable
from optimize.evaluator import Evaluator
from optimize.figures import labelled, limits, plot_convergence, plot_limits, plot_profiles, profile
from optimize.gains import Gain
from optimize.named_measures import in_words
from optimize.price import BETTER, SAME, UNKNOWN, WORSE, Change, Compared, injuries
from optimize.problem import require_consistent
from optimize.record import Evaluation, Record
from optimize.study import agrees
from optimize.study_file import load_study
from optimize.verification import Verification

SMALL = ["mesh.circumferential=5", "mesh.axial=8", "mesh.radial=[2, 1]", "stop.occlusion=0.7"]
PEAK, FORCE = jc.smooth_peak_axial_stress("media"), jc.clamp_force()
PRESSURE = jc.smooth_peak_contact_pressure()


def estimate(value: float, *sources: float | None) -> jc.Estimate:
    return jc.Estimate(value, {f"source {i}": source for i, source in enumerate(sources)})


# --- errors of differences ------------------------------------------------------------------------


def test_what_two_clamps_have_in_common_cancels():
    """By hand: 3 ± (0.5 + 0.25) from figures that are off by 2 + 0.5 and 1.5 + 0.75."""
    difference = estimate(13.0, 2.0, -0.5) - estimate(10.0, 1.5, -0.75)
    assert difference.value == 3.0
    assert difference.sources == {"source 0": 0.5, "source 1": 0.25}
    assert difference.error == 0.75
    assert (estimate(13.0, 2.0, None) - estimate(10.0, 1.5, 1.0)).error is None


@pytest.fixture(scope="module")
def pair() -> tuple[jc.Result, jc.Result]:
    """A cylinder and one that is a little wider."""
    first = jc.clamp(jc.load_scene("human-lad", SMALL))
    return first, jc.clamp(jc.replace(first.scene, "clamp.jaw.radius", 3.1), guess=first)


def test_measures_have_the_errors_of_their_figures(pair):
    first = pair[0]
    near = jc.neighbours(first)
    found = near.estimates((PEAK, FORCE))
    errors = jc.with_errors(first, near).errors
    assert found[PEAK].error == pytest.approx(errors["smooth_peak_axial_stress_kPa.media"]["error"], rel=1e-6)
    assert found[FORCE].error == pytest.approx(1e3 * errors["clamp_force_N"]["error"], rel=1e-6)
    assert (found[PEAK] - found[PEAK]).error == 0.0


@pytest.mark.slow
def test_a_small_difference_is_known_better_than_what_it_is_of(pair):
    """And the estimate is right: on twice the elements each way the difference moves by about its error."""
    a, b = (jc.neighbours(result).estimates((FORCE,))[FORCE] for result in pair)
    difference = b - a
    assert difference.error < 0.3 * min(a.error, b.error)
    settings = pair[0].scene.mesh
    mesh = dataclasses.replace(settings, circumferential=10, axial=16, radial=(4, 2))
    fine = [jc.clamp(dataclasses.replace(r.scene, mesh=mesh), guess=r).measure(FORCE) for r in pair]
    assert abs((fine[1] - fine[0]) - difference.value) < 3.0 * difference.error


# --- the table of injuries ------------------------------------------------------------------------


def compared(best: dict, other: dict, name: str = "reference") -> Compared:
    return Compared(PEAK, {name: other, "best": best})


def test_every_injury_is_there_once_and_by_layer():
    found = injuries(("media", "adventitia"))
    assert len(set(found)) == len(found) == 12
    assert {PRESSURE, FORCE, jc.mean_contact_pressure(), PEAK, jc.mean_damage("adventitia")} <= set(found)


@pytest.mark.parametrize(
    ("best", "other", "word"),
    [
        (estimate(2.0, 0.1), estimate(1.0, 0.0), WORSE),
        (estimate(1.0, 0.1), estimate(2.0, 0.0), BETTER),
        (estimate(2.0, 1.5), estimate(1.0, 0.0), SAME),
        (estimate(2.0, 1.5), estimate(1.0, 1.4), WORSE),  # both uncertain, their difference is not
        (estimate(2.0, None), estimate(1.0, 0.0), UNKNOWN),
        (estimate(-3.0, 0.1), estimate(-2.0, 0.1), BETTER),
    ],
)
def test_words_of_a_change(best, other, word):
    change = Change(FORCE, best, other)
    assert change.word == word
    row = change.to_dict("reference")
    assert row["word"] == word
    assert row["difference"] == best.value - other.value


def test_the_worst_is_said_in_one_sentence():
    best = {PEAK: estimate(27.0, 1.0), PRESSURE: estimate(60.0, 2.0), FORCE: estimate(570.0, 1.0)}
    other = {PEAK: estimate(31.0, 0.5), PRESSURE: estimate(30.0, 1.0), FORCE: estimate(480.0, 1.0)}
    found = compared(best, other)
    assert found.sentence == (
        "the price: the smooth peak contact pressure is 30 ± 1 kPa higher than the reference's (100.0%)"
    )
    unsure = best | {PRESSURE: estimate(60.0, 41.0)}
    assert compared(unsure, other).sentence == (
        "the price: the smooth peak contact pressure is 30 ± 40 kPa higher than the reference's (100.0%), "
        "within error; beyond its error, the clamp force is 90 ± 0 mN higher than the reference's (18.8%)"
    )
    assert found.gain("reference") == Gain(31.0, 27.0, "kPa", 0.5)
    assert [row["measure"] for row in found.to_dict()["price"]] == [
        "smooth peak contact pressure",
        "clamp force",
    ]
    assert compared(other, other).sentence == "no other injury measure is higher than the reference's"
    assert compared(best, other, "start").other == "start"


def test_a_gain_says_when_it_is_within_its_error():
    assert str(Gain(31.2, 31.0, "kPa", 0.5)) == "0.2 ± 0.5 kPa lower (0.6%), within its error"
    assert str(Gain(31.0, 27.0, "kPa", 0.5)) == "4 ± 0.5 kPa lower (12.9%)"


def test_verification_takes_its_errors_from_what_was_compared():
    before = compared({PEAK: estimate(80.0, 3.0)}, {PEAK: estimate(100.0, 2.0)}, "start")
    after = compared({PEAK: estimate(90.0, 3.5)}, {PEAK: estimate(110.0, 2.0)}, "start")
    found = Verification(
        {"start": 100.0, "best": 80.0}, {"start": 110.0, "best": 90.0}, {}, None, 600, "kPa", before, after
    )
    assert found.to_dict()["gain_error"] == 1.5
    assert found.to_dict()["gains"]["start"] == {"difference": 20.0, "error": 1.5, "share": 20.0 / 110.0}
    assert "20 ± 1.5 kPa lower" in found.sentence
    assert "20 ± 1 kPa lower" in found.sentence


def test_measures_in_words():
    assert in_words(PEAK) == "smooth peak axial stress of the media"
    assert labelled(PEAK) == "Smooth peak axial stress of the media, kPa"
    assert in_words(jc.volume_above("media", 20.0)) == "volume above 20 kPa of the media"
    assert in_words(jc.holding_force(0.05)) == "holding force at a friction of 0.05"
    assert in_words(jc.mean_damage("media", 1.26)) == "mean damage of the media (onset stretch 1.26)"
    assert in_words(jc.Measure("mine", "", lambda e: 0.0, ("a", 2.0))) == "mine(a, 2.0)"


def test_convergence_is_drawn_without_a_feasible_design():
    """A study may never meet its constraints, and still has a page."""
    asked = problem(Constraint(FORCE, upper=1.0))
    tried = [Evaluation(asked.start, np.array([v, 5.0]), np.zeros((2, 3)), 5) for v in (31.0, 30.0)]
    axes = plot_convergence(SimpleNamespace(problem=asked, evaluations=tried)).axes[0]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["violates a constraint"]


def test_the_record_of_a_face_that_falls_can_be_written():
    """Its violation comes from the design, not from a measure, and decides what the best design is called."""
    asked = problem(rising=True)
    falling = Evaluation(np.array([0.6, 0.3, 0.9]), np.array([30.0]), np.zeros((1, 3)), 5)
    content = json.loads(as_json(Record(asked, "slsqp", [falling]).to_dict()))
    assert content["best_is_feasible"] is False
    assert content["iterations"][0]["violation"] == pytest.approx(0.15)  # 0.3 of bounds that are 2 apart


def test_the_objective_is_drawn_over_what_is_constrained(pair):
    """One panel for each bound of the artery, none for one of the shape; designs by what they keep."""
    asked = problem(Constraint(jc.jaw_curvature(), upper=1.0), Constraint(FORCE, 100.0, 200.0))
    tried = [
        Evaluation(asked.start, np.array([31.0, 0.5, force]), np.zeros((3, 3)), 5) for force in (150.0, 250.0)
    ]
    first, second = pair
    study = SimpleNamespace(problem=asked, evaluations=tried, reference=None, start=first, best=second)
    assert [place for place, _ in limits(study)] == [1]
    (axes,) = plot_limits(study).axes
    drawn = {line.get_label(): np.asarray(line.get_xydata()).tolist() for line in axes.lines}
    assert drawn["feasible"] == [[150.0, 31.0]]
    assert drawn["violates a constraint"] == [[250.0, 31.0]]
    assert drawn["best"] == [[second.measure(FORCE), second.measure(PEAK)]]
    assert [line.get_xdata()[0] for line in axes.lines if len(set(line.get_xdata())) == 1][2:4] == [
        100.0,
        200.0,
    ]
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels.count("bound") == 1


def with_jaw(jaw: str) -> SimpleNamespace:
    return SimpleNamespace(scene=jc.load_scene("human-lad", [f"clamp.jaw={jaw}"]))


STEEP = '{shape="spline", half_width_mm=2.0, slopes=[8.0, 10.0, 20.0], edge_radius_mm=0.8}'


def test_faces_are_drawn_whole():
    """A cylinder by its circle, a spline steeper than any that is shipped by its own height."""
    bar, steep = with_jaw("cylinder-3mm"), with_jaw(STEEP)
    z, y = profile(bar)
    np.testing.assert_allclose(y, 3.0 - np.sqrt(9.0 - z**2), atol=0.01)
    z, y = profile(steep)
    jaw, face = steep.scene.clamp.jaw, np.isfinite(y)
    inner = np.abs(z) < 1.7
    np.testing.assert_allclose(y[inner], jaw.height(np.abs(z[inner]))[0], atol=1e-9)
    assert np.nanmax(y) > float(jaw.height(np.asarray(1.99))[0]) > 15.0
    axes = plot_profiles(SimpleNamespace(reference=None, start=bar, best=steep)).axes[0]
    assert axes.get_ylim()[0] < 0.0 < np.nanmax(y) < axes.get_ylim()[1]
    assert axes.get_xlim()[0] < -3.0 < 3.0 < axes.get_xlim()[1]
    assert np.ptp(z[face]) > 3.9


def test_the_contact_pressure_along_the_artery_has_the_reported_peak(pair):
    z, pressure = contact_along(pair[0].model, pair[0].states[-1].state)
    assert np.max(pressure) == pytest.approx(pair[0].final["max_contact_pressure_kPa"], rel=1e-9)
    assert np.all(np.diff(z) > 0.0)
    np.testing.assert_allclose(z, -z[::-1])
    assert len(z) == 16  # eight rings of the modelled half, and their images


# --- bounds ---------------------------------------------------------------------------------------


def problem(*constraints: Constraint, reference: bool = True, rising: bool = False) -> DesignProblem:
    jaw = 'clamp.jaw={shape="spline", half_width_mm=2.0, slopes=[0.3, 0.6, 0.9], edge_radius_mm=1.0}'
    return DesignProblem(
        jc.load_scene("human-lad", [*SMALL, jaw]),
        PEAK,
        (Variable("clamp.jaw.slopes", 0.0, (1.0, 2.0, 2.0), rising=rising),),
        constraints,
        jc.load_scene("human-lad", SMALL) if reference else None,
    )


def test_a_bound_at_the_reference_becomes_its_value(pair):
    asked = problem(Constraint(FORCE, upper=1.0, relative=True), Constraint(PEAK, lower=2.0))
    found = asked.against(pair[0])
    assert found.constraints[0].upper == pytest.approx(pair[0].measure(FORCE), rel=1e-5)
    assert found.constraints[0].lower == -np.inf
    assert not found.is_relative
    assert found.constraints[1] == asked.constraints[1]


@pytest.mark.parametrize(
    ("constraints", "said"),
    [
        ((Constraint(FORCE, 5.0, 3.0),), "no value is at least 5 mN and at most 3 mN"),
        ((Constraint(FORCE, lower=5.0), Constraint(FORCE, upper=3.0)), "contradict each other"),
        ((Constraint(FORCE, lower=float("nan")),), "contradict each other"),
        ((Constraint(FORCE, 2.0, 1.0, relative=True),), "2 times the reference's"),
    ],
)
def test_constraints_that_no_design_can_meet_are_refused(constraints, said):
    with pytest.raises(jc.SceneError, match=said):
        require_consistent(problem(*constraints))


def test_constraints_on_several_measures_are_consistent():
    require_consistent(problem(Constraint(FORCE, lower=5.0), Constraint(PEAK, upper=3.0)))
    require_consistent(problem(Constraint(FORCE, 5.0, 5.0)))


def test_a_relative_bound_needs_a_reference():
    with pytest.raises(jc.SceneError, match="no reference"):
        require_consistent(problem(Constraint(FORCE, upper=1.0, relative=True), reference=False))


def test_slopes_that_have_to_rise_are_margins_and_violations():
    """Against differences: a linear constraint of the driver on the scaled design."""
    asked = problem(rising=True)
    assert asked.rises.tolist() == [[0, 1], [1, 2]]
    lower, upper = asked.bounds
    designs = [np.array(d) for d in ([0.3, 0.6, 0.9], [0.31, 0.6, 0.9], [0.3, 0.61, 0.9], [0.3, 0.9, 0.5])]
    solved = [Evaluation(d, np.array([30.0]), np.zeros((1, 3)), 5) for d in designs]
    known = Evaluator(Record(asked, "slsqp", solved), None, 4, lambda event: None)
    at = lambda d: known._margins((d - lower) / (upper - lower))
    values, slopes = at(designs[0])
    for i in (0, 1):
        moved = at(designs[i + 1])[0]
        step = 0.01 / (upper - lower)[i]
        np.testing.assert_allclose((moved - values) / step, slopes[:, i], atol=1e-9)
    assert solved[0].violation(asked) == 0.0
    assert solved[3].violation(asked) == pytest.approx(0.2)  # 0.9 to 0.5, of a range of 2


@pytest.mark.parametrize(
    ("cold", "warm", "start", "same"),
    [
        (-8.0, -8.0001, -5.0, True),
        (-8.0, -8.1, -5.0, False),
        (1e-17, 0.0, 3.0, True),
        (0.1, 0.0, 3.0, False),
        (1e-17, 0.0, 0.0, True),
        (100.0, 100.1, 50.0, False),
    ],
)
def test_cold_and_warm_agree_for_objectives_of_any_sign(cold, warm, start, same):
    assert agrees(cold, warm, start) is same


# --- in files -------------------------------------------------------------------------------------

STUDY = """
scene = "human-lad"
set = ["mesh.circumferential=5", "mesh.axial=8", "mesh.radial=[2, 1]", "stop.occlusion=0.7"]
max_evaluations = 3

[start]
jaw = { shape = "spline", half_width_mm = 2.0, slopes = [0.4, 0.8], edge_radius_mm = 1.0 }

[objective]
measure = "smooth_peak_axial_stress_kPa"
layer = "media"

[[variables]]
key = "clamp.jaw.slopes"
lower = 0.0
upper = 2.0
rising = true

[[constraints]]
measure = "smooth_peak_contact_pressure_kPa"
lower = 0.5
upper = "reference"
"""
TWO = """
[[objectives]]
measure = "smooth_peak_axial_stress_kPa"
layer = "media"

[[objectives]]
measure = "smooth_peak_contact_pressure_kPa"
"""


def written(folder: Path, text: str = STUDY) -> Path:
    path = folder / "study.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_bound_at_the_reference_is_read(tmp_path):
    found = load_study(written(tmp_path)).problem
    assert found.constraints == (
        Constraint(PRESSURE, lower=0.5),
        Constraint(PRESSURE, upper=1.0, relative=True),
    )
    assert found.variables[0].rising


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('upper = "reference"', 'upper = "refrence"', 'expected "reference" or a number'),
        ('upper = "reference"', "upper = 0.25", "contradict each other"),
        ("rising = true", 'rising = "yes"', "expected true or false"),
        ("rising = true", "risin = true", "did you mean rising"),
        ("clamp.jaw.slopes", "clamp.jaw.half_width_mm", "single number cannot be rising"),
        ("max_evaluations = 3", "points = 3", "two [[objectives]]"),
        ("[[constraints]]", TWO + "[[constraints]]", "found both"),
    ],
)
def test_a_wrong_bound_is_one_sentence_and_exit_code_2(tmp_path, capsys, old, new, said):
    path = written(tmp_path, STUDY.replace(old, new))
    assert main(["optimise", str(path), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert said in captured.err


def test_a_bound_at_the_reference_of_a_study_without_one_is_refused(tmp_path):
    text = STUDY.replace("[start]\njaw", "# jaw").replace("jaw.slopes", "jaw.radius_mm")
    text = text.replace("rising = true", "").replace("lower = 0.0", "lower = 1.0").replace("= 2.0", "= 4.0")
    with pytest.raises(jc.SceneError, match="no reference clamp"):
        load_study(written(tmp_path, text))


def test_shipped_studies_are_read_and_listed(capsys):
    studies = [preset.name for preset in shipped() if preset.kind == "study"]
    assert {"human-lad-jaw", "human-lad-jaw-unbounded", "human-lad-jaw-front"} <= set(studies)
    for name in studies:
        load_study(name)
    assert load_study("human-lad-jaw").problem.is_relative
    assert not load_study("human-lad-jaw-unbounded").problem.is_relative
    assert load_study("human-lad-jaw-front").second == PRESSURE
    assert main(["presets"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in studies)
