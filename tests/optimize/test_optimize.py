"""Design variables, drivers, and studies that survive being killed."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.cli import main
from jaxclamp.core.failures import NotConverged
from optimize import Constraint, DesignProblem, Variable, evaluator, minimise, starts
from optimize.drivers import METHODS, Enough, Target
from optimize.evaluator import evaluate, gradients
from optimize.journal import Journal, write_whole
from optimize.named_measures import named
from optimize.record import Record
from optimize.starts import other_starts
from optimize.study_file import load_study
from optimize.variables import entries, with_design
from optimize.verification import finer

SMALL = ["mesh.circumferential=6", "mesh.axial=16", "mesh.radial=[2, 1]", "stop.occlusion=0.9"]
PEAK = jc.smooth_peak_axial_stress("media")


def scene(*overrides: str) -> jc.Scene:
    return jc.load_scene("human-lad", [*SMALL, *overrides])


def one_slope(start: float = 1.2) -> DesignProblem:
    """A jaw of one shape parameter: flat it cuts with its edges, steep with its middle."""
    jaw = f'clamp.jaw={{shape="spline", half_width_mm=2.0, slopes=[{start}], edge_radius_mm=1.0}}'
    return DesignProblem(scene(jaw), PEAK, (Variable("clamp.jaw.slopes", 0.0, 1.5),))


# --- variables ----------------------------------------------------------------------------------


def test_entries_have_names_units_and_bounds():
    variables = (
        Variable("clamp.jaw.radius_mm", 1.0, 6.0),
        Variable("artery.layers[0].opening_angle", 2.0, 3.0),
        Variable("stop.occlusion"),
    )
    radius, angle, occlusion = entries(scene(), variables)
    assert (radius.name, radius.unit, radius.lower, radius.upper) == ("clamp.jaw.radius_mm", "mm", 1.0, 6.0)
    assert angle.name == "artery.layers[0].opening_angle_deg"
    assert angle.start / angle.factor == pytest.approx(160.0)
    assert (occlusion.lower, occlusion.upper) == (1e-4, 0.999)  # the range of the field


@pytest.mark.parametrize(
    ("variable", "said"),
    [
        (Variable("clamp.jaw.radios_mm", 1.0, 2.0), "did you mean radius_mm"),
        (Variable("clamp.jaw", 1.0, 2.0), "expected a number"),
        (Variable("mesh.axial", 1.0, 2.0), "expected a number"),
        (Variable("artery.layers[7].thickness", 0.1, 2.0), "does not exist"),
        (Variable("clamp.jaw.radius", 4.0, 6.0), "the start 3 is not within 4 to 6"),
        (Variable("clamp.jaw.radius", 6.0, 4.0), "bounds"),
        (Variable("clamp.jaw.radius", -1.0, 4.0), "not inside"),
        (Variable("clamp.jaw.radius", (1.0, 1.0), 4.0), "1 or 1 bounds"),
    ],
)
def test_variables_that_make_no_sense(variable, said):
    with pytest.raises(jc.SceneError, match=said.replace("(", r"\(")):
        entries(scene(), (variable,))


def test_a_design_is_put_into_the_scene():
    changed = with_design(scene(), ("clamp.jaw.radius", "artery.pressure"), np.array([4.0, 12.0]))
    assert (float(changed.clamp.jaw.radius), float(changed.artery.pressure)) == (4.0, 12.0)


# --- one evaluation -----------------------------------------------------------------------------


@pytest.mark.slow
def test_values_and_gradients_of_a_design():
    """Objective and constraints at once, against finite differences."""
    problem = dataclasses.replace(
        one_slope(),
        constraints=(Constraint(jc.clamp_force(), upper=300.0), Constraint(jc.jaw_curvature(), upper=2.0)),
    )
    first, result = evaluate(problem, problem.start, None)
    assert first.failure is None
    np.testing.assert_allclose(first.values, [result.measure(m) for m in problem.measures], rtol=1e-9)
    h = 1e-4
    ahead, behind = (evaluate(problem, problem.start + s * h, result)[0].values for s in (1.0, -1.0))
    np.testing.assert_allclose(first.gradients[:, 0], (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-10)


@pytest.mark.slow  # compiles the derivative of the whole scene into one program
def test_artery_and_jaw_vary_together():
    problem = DesignProblem(
        scene(), PEAK, (Variable("clamp.jaw.radius", 1.0, 6.0), Variable("artery.pressure", 5.0, 20.0))
    )
    result = jc.clamp(problem.scene)
    _, slopes = gradients(problem, result)
    _, gradient = jc.value_and_gradient(result, PEAK)
    expected = [float(gradient.clamp.jaw.radius), float(gradient.artery.pressure)]
    np.testing.assert_allclose(slopes[0], expected, rtol=1e-8)


def test_a_design_without_equilibrium_is_an_answer():
    problem = DesignProblem(scene(), PEAK, (Variable("clamp.jaw.radius", 1e-2, 6.0),))
    impossible = dataclasses.replace(problem, scene=jc.replace(problem.scene, "artery.pressure", 9e3))
    failed, result = evaluate(impossible, np.array([3.0]), None)
    assert result is None
    assert "no equilibrium" in failed.failure


# --- drivers on functions with known minima ------------------------------------------------------


def bowl(n_margins: int):
    """Minimum of |t - c|**2 over the box, with t[0] + t[1] <= 0.6 if constrained."""
    c = np.array([0.7, 0.4, 1.3])

    def margins(t):
        return np.array([0.6 - t[0] - t[1]])[:n_margins], np.array([[-1.0, -1.0, 0.0]])[:n_margins]

    return Target(
        np.full(3, 0.2), lambda t: (float((t - c) @ (t - c)), 2.0 * (t - c)), margins, n_margins, 1e-10
    )


@pytest.mark.parametrize("name", METHODS)
def test_drivers_find_a_minimum_on_the_bounds(name):
    asked = []
    target = bowl(0)
    spy = dataclasses.replace(target, objective=lambda t: (asked.append(t.copy()), target.objective(t))[1])
    METHODS[name].drive(spy)
    best = min(asked, key=lambda t: target.objective(t)[0])
    np.testing.assert_allclose(best, [0.7, 0.4, 1.0], atol=2e-2 if name == "adam" else 1e-4)
    assert all(np.all(t >= 0.0) and np.all(t <= 1.0) for t in asked)


@pytest.mark.parametrize("name", [name for name, method in METHODS.items() if method.constrained])
def test_drivers_keep_a_constraint(name):
    """The projection of c on t0 + t1 = 0.6 is (0.45, 0.15), t2 at its bound."""
    asked = []
    target = bowl(1)
    spy = dataclasses.replace(target, objective=lambda t: (asked.append(t.copy()), target.objective(t))[1])
    METHODS[name].drive(spy)
    np.testing.assert_allclose(asked[-1], [0.45, 0.15, 1.0], atol=1e-3)


@pytest.mark.parametrize("name", METHODS)
def test_drivers_end_when_it_is_enough(name):
    calls = []

    def objective(t):
        calls.append(t)
        if len(calls) > 1:
            raise Enough
        return float(t @ t), 2.0 * t

    with pytest.raises(Enough):
        METHODS[name].drive(dataclasses.replace(bowl(0), objective=objective))


# --- a study with a known optimum ----------------------------------------------------------------


@functools.cache
def scanned() -> tuple[float, float]:
    """Slope and objective of the best of a fine scan, by the parabola through its three lowest points."""
    problem, last = one_slope(), None
    slopes = np.array([*np.linspace(0.05, 0.2, 4), *np.linspace(0.22, 0.36, 8), *np.linspace(0.4, 1.2, 5)])
    values = []
    for slope in slopes:
        last = jc.clamp(problem.scene_at(np.array([slope])), guess=last)
        values.append(last.measure(PEAK))
    k = int(np.argmin(values))
    assert 0 < k < len(slopes) - 1, "the minimum is inside"
    a, b, c = np.polyfit(slopes[k - 1 : k + 2], values[k - 1 : k + 2], 2)
    return -b / (2 * a), c - b * b / (4 * a)


@pytest.mark.parametrize("start", [*(pytest.param(s, marks=pytest.mark.slow) for s in (0.1, 0.6)), 1.2])
@pytest.mark.parametrize(
    "method",
    ["slsqp", pytest.param("l-bfgs-b", marks=pytest.mark.slow), pytest.param("mma", marks=pytest.mark.slow)],
)
def test_the_known_optimum_is_found(method, start):
    """The minimum that a fine scan locates, from three starts."""
    slope, value = scanned()
    study = minimise(
        one_slope(start), method=method, max_evaluations=25, tolerance=1e-6, check_finer_mesh=False
    )
    assert study.best.measure(PEAK) == pytest.approx(value, rel=2e-3)
    assert study.best_design[0] == pytest.approx(slope, abs=0.02)


@pytest.mark.slow
def test_a_constraint_is_active_at_the_optimum():
    """A largest force below that of the free optimum: the best design uses all of it."""
    free = minimise(one_slope(), max_evaluations=20, check_finer_mesh=False)
    least = free.best.measure(jc.clamp_force())
    start_force = free.start.measure(jc.clamp_force())
    limit = 0.5 * (least + start_force)
    bound = Constraint(jc.clamp_force(), upper=limit)
    if start_force > least:
        bound = Constraint(jc.clamp_force(), lower=limit)
    study = minimise(
        dataclasses.replace(one_slope(), constraints=(bound,)), max_evaluations=20, check_finer_mesh=False
    )
    assert study.best.measure(jc.clamp_force()) == pytest.approx(limit, rel=2e-3)
    assert study.best.measure(PEAK) > free.best.measure(PEAK)


def test_a_failing_design_is_backed_off_from(monkeypatch):
    """A design injected to fail is logged, is not the best, and does not end the study."""
    import optimize.evaluator

    solve = optimize.evaluator.clamp
    met = []

    def fails_below(asked, **options):
        if 0.9 < float(asked.clamp.jaw.slopes[0]) < 1.15:
            met.append(float(asked.clamp.jaw.slopes[0]))
            failure = NotConverged("injected")
            raise jc.EquilibriumError("clamping", "somewhere", failure, "try something else")
        return solve(asked, **options)

    monkeypatch.setattr(optimize.evaluator, "clamp", fails_below)
    study = minimise(one_slope(), max_evaluations=30, check_finer_mesh=False)
    failed = [e for e in study.evaluations if e.failure is not None]
    assert len(failed) == len(met) >= 1
    assert all("injected" in e.failure for e in failed)
    assert not any(np.array_equal(e.design, study.best_design) for e in failed)
    assert study.best.measure(PEAK) <= study.start.measure(PEAK)


def test_a_state_that_a_cold_solution_does_not_find_is_no_design(monkeypatch):
    """The recorded best is made to disagree with its solution from scratch."""
    import optimize.evaluator

    measured = optimize.evaluator.evaluate

    def flattered(problem, design, near):
        found, result = measured(problem, design, near)
        wrong = abs(design[0] - 0.27) < 0.06 and found.failure is None
        return (dataclasses.replace(found, values=0.5 * found.values) if wrong else found), result

    monkeypatch.setattr(optimize.evaluator, "evaluate", flattered)
    study = minimise(one_slope(), max_evaluations=12, check_finer_mesh=False)
    lied = [e for e in study.evaluations if abs(e.design[0] - 0.27) < 0.06]
    assert lied
    assert not any(e.design is study.best_design for e in lied)
    assert all("from scratch" in e.failure for e in lied)


def test_the_first_design_is_told_before_it_is_solved(monkeypatch):
    def stop(problem, design, near):
        raise NotImplementedError

    told: list[jc.Progress] = []
    monkeypatch.setattr(evaluator, "evaluate", stop)
    with pytest.raises(NotImplementedError):
        evaluator.Evaluator(Record(one_slope(), "slsqp", []), None, 4, told.append).at(np.array([0.5]))
    assert [(event.fraction, event.message) for event in told] == [(0.0, "design 1, with compilation")]


def test_other_starts_are_possible_and_reproducible():
    problem = one_slope()
    first, again = other_starts(problem, 3), other_starts(problem, 3)
    np.testing.assert_array_equal(first, again)
    assert len({design.tobytes() for design in first}) == 3
    lower, upper = problem.bounds
    assert all(np.all(lower <= d) and np.all(d <= upper) for d in first)


def test_starts_that_do_not_fit_are_refused_before_anything_is_solved(monkeypatch):
    """As many processes as there are cores, and this one."""
    asked: list[int] = []

    def refuse(scene, processes):
        asked.append(processes)
        raise jc.TooLittleMemory("too little")

    monkeypatch.setattr(starts, "require_memory_for", refuse)
    monkeypatch.setattr(starts, "cores", lambda: 2)
    for count in (1, 2, 8):
        with pytest.raises(jc.TooLittleMemory):
            minimise(one_slope(), starts=count)
    assert asked == [1, 2, 3]


@pytest.mark.slow
def test_several_starts(tmp_path):
    study = minimise(one_slope(), max_evaluations=8, starts=3, folder=tmp_path, check_finer_mesh=False)
    assert {e.start for e in study.evaluations} == {1, 2, 3}
    assert (tmp_path / "start-2" / "study.json").exists()
    assert study.best.measure(PEAK) == pytest.approx(scanned()[1], rel=5e-3)


def test_the_finer_model_is_finer_and_harder():
    coarse = scene()
    fine = finer(coarse)
    assert fine.mesh.axial == 24
    assert float(fine.contact.stiffness) == 2.0 * float(coarse.contact.stiffness)
    assert float(fine.contact.smoothing) == 0.5 * float(coarse.contact.smoothing)


def test_bad_requests():
    bounded = dataclasses.replace(one_slope(), constraints=(Constraint(jc.clamp_force(), upper=1.0),))
    with pytest.raises(jc.SceneError, match="takes no constraints"):
        minimise(bounded, method="l-bfgs-b")
    with pytest.raises(jc.SceneError, match="expected one of"):
        minimise(one_slope(), method="newton")


# --- on disk --------------------------------------------------------------------------------------

STUDY = """
title = "One slope"
scene = "human-lad"
set = ["mesh.circumferential=6", "mesh.axial=16", "mesh.radial=[2, 1]", "stop.occlusion=0.9"]
max_evaluations = 12

[start]
jaw = { shape = "spline", half_width_mm = 2.0, slopes = [1.2], edge_radius_mm = 1.0 }

[objective]
measure = "smooth_peak_axial_stress_kPa"
layer = "media"

[[variables]]
key = "clamp.jaw.slopes"
lower = 0.0
upper = 2.0

[[constraints]]
measure = "clamp_force_N"
upper = 5.0
"""


def written(folder: Path, text: str = STUDY) -> Path:
    path = folder / "study.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_study_file_is_read(tmp_path):
    study = load_study(written(tmp_path))
    problem = study.problem
    assert study.title == "One slope"
    assert problem.objective == PEAK
    assert problem.constraints[0].upper == 5000.0  # N to mN
    assert problem.reference.clamp.jaw.shape == "cylinder"
    assert problem.scene.clamp.jaw.shape == "spline"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('scene = "human-lad"', 'scene = "human-lat"', "human-lat"),
        ("max_evaluations = 12", "max_evaluations = 0", "whole number"),
        ("max_evaluations = 12", "max_evaluation = 12", "did you mean max_evaluations"),
        ('key = "clamp.jaw.slopes"', 'key = "clamp.jaw.slope"', "slope"),
        ("lower = 0.0", "lower = nan", "expected a number"),
        ('measure = "clamp_force_N"', 'measure = "clamp_force"', "did you mean clamp_force_N"),
        ("upper = 5.0", "uper = 5.0", "did you mean upper"),
        ('layer = "media"', 'layer = "intima"', "expected one of media, adventitia"),
        ('layer = "media"', "", "expected the name of a layer"),
        ("slopes = [1.2]", "slopes = [-1.2]", "lowest point"),
        ("[start]", "[start", "not valid TOML"),
        ("max_evaluations = 12", 'method = "adam"', None),
    ],
)
def test_a_wrong_study_is_one_sentence_and_exit_code_2(tmp_path, capsys, old, new, said):
    path = written(tmp_path, STUDY.replace(old, new))
    assert main(["optimise", str(path), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert said is None or said in captured.err
    assert not (tmp_path / "out" / "study.json").exists()


VOLUME = '[[constraints]]\nmeasure = "volume_above"\nlayer = "media"\nstress = {}\nupper = 0.5\n'
DAMAGE = '[[constraints]]\nmeasure = "mean_damage"\nlayer = "media"\nonset_stretch = {}\nupper = 0.5\n'


@pytest.mark.parametrize("number", ["9" * 400, "-" + "9" * 400, "0x" + "f" * 6000, "1e400", "inf", "nan"])
@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("max_evaluations = 12", "tolerance = {}", "tolerance = "),
        ("max_evaluations = 12", "starts = {}", "starts = "),
        ("lower = 0.0", "lower = {}", "variables[0].lower = "),
        ("upper = 5.0", "upper = {}", "constraints[0].upper = "),
        ('layer = "media"', "layer = {}", "objective.layer = "),
        ("slopes = [1.2]", "slopes = [{}]", "jaw"),
        ("[[constraints]]", VOLUME + "[[constraints]]", "constraints[0].stress = "),
        ("[[constraints]]", DAMAGE + "[[constraints]]", "constraints[0].onset_stretch = "),
    ],
)
def test_numbers_that_no_float_can_hold_are_one_sentence(tmp_path, capsys, old, new, key, number):
    path = written(tmp_path, STUDY.replace(old, new.format(number)))
    assert main(["optimise", str(path), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert key in said
    assert "expected" in said
    assert len(said) < 500


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('measure = "clamp_force_N"', 'measure = "{}"', "no such measure"),
        ('layer = "media"', 'layer = "{}"', "expected one of media"),
        ('scene = "human-lad"', 'scene = "{}"', "expected a preset or a scene file"),
        ('scene = "human-lad"', 'scene = "{}.toml"', "expected a preset or a scene file"),
        ("max_evaluations = 12", "{} = 12", "unknown key"),
        ("lower = 0.0", "{} = 0.0", "unknown key variables[0]"),
        ("upper = 5.0", "{} = 5.0", "unknown key constraints[0]"),
    ],
)
def test_long_names_are_not_echoed_whole(tmp_path, old, new, said):
    with pytest.raises(jc.SceneError) as refused:
        load_study(written(tmp_path, STUDY.replace(old, new.format("x" * 100_000))))
    assert said in str(refused.value)
    assert len(str(refused.value)) < 1000


@pytest.mark.parametrize(
    "key", ["artery.layers[999999999999].thickness_mm", "clamp.jaw.slopes[999999999999]"]
)
def test_a_position_far_beyond_a_list_is_one_sentence(tmp_path, key):
    with pytest.raises(jc.SceneError, match="expected a position from") as refused:
        load_study(written(tmp_path, STUDY.replace("clamp.jaw.slopes", key)))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("onset", "found"), [("", 1.49), ("onset_stretch = 1.26\n", 1.26)])
def test_a_study_may_say_where_damage_begins(tmp_path, onset, found):
    table = DAMAGE.replace("onset_stretch = {}\n", onset)
    study = load_study(written(tmp_path, STUDY.replace("[[constraints]]", table + "[[constraints]]")))
    assert study.problem.constraints[0].measure == jc.mean_damage("media", found)


@pytest.mark.parametrize("onset", ["1.0", "-2.0", '"1.49"', "true"])
def test_an_onset_that_is_none_is_refused(tmp_path, onset):
    table = DAMAGE.format(onset) + "[[constraints]]"
    with pytest.raises(jc.SceneError, match=r"onset_stretch = .*expected a stretch from 1\.001 to 100"):
        load_study(written(tmp_path, STUDY.replace("[[constraints]]", table)))


def test_every_named_measure_is_a_measure_of_a_result():
    problem, unit = one_slope(), {"mN": "N", "1/mm": "per_mm"}
    result = jc.clamp(problem.scene)
    for key, found in named().items():
        given = {"layer": "media", "stress": 20.0, "onset_stretch": 1.27, "friction": 0.05}
        measure = found.factory(**{name: given[name] for name in found.arguments})
        assert math.isfinite(result.measure(measure)), key
        assert key.endswith(unit.get(measure.unit, measure.unit))


def test_measures_agree_with_the_record():
    result = jc.clamp(one_slope().scene)
    final = result.final
    assert result.measure(jc.clamp_force()) == pytest.approx(1e3 * final["clamp_force_N"], rel=1e-10)
    assert result.measure(jc.jaw_travel()) == pytest.approx(final["jaw_travel_mm"], rel=1e-12)
    assert result.measure(jc.lumen_area()) == pytest.approx(final["lumen_area_mm2"], rel=1e-12)
    assert result.measure(jc.axial_stress_at_P()) == pytest.approx(final["axial_stress_at_P_kPa"], rel=1e-9)
    assert result.measure(PEAK) == pytest.approx(final["smooth_peak_axial_stress_kPa"]["media"], rel=1e-9)
    assert result.measure(jc.mean_contact_pressure()) == pytest.approx(final["mean_contact_pressure_kPa"])
    assert result.measure(jc.jaw_half_width()) == 3.0
    area = result.measure(jc.jaw_contact_area())
    assert area == pytest.approx(final["contact_area_mm2"], rel=1e-9)
    # the mean pressure is the integral over both jaws over the area of both
    held = 2.0 * 0.05 * area * result.measure(jc.mean_contact_pressure())
    assert result.measure(jc.holding_force(0.05)) == pytest.approx(held, rel=1e-9)
    assert held >= 2.0 * 0.05 * result.measure(jc.clamp_force())  # a face that is bent presses sideways, too


@pytest.mark.slow
def test_the_command_line_does_a_study(tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["optimise", str(written(tmp_path)), "--out", str(out), "--json", "--quiet"]) == 0
    study = json.loads(capsys.readouterr().out)
    assert study == json.loads((out / "study.json").read_text())
    assert study["evaluations"] == len(study["iterations"]) <= 12
    assert study["best"]["objective"] < study["start"]["objective"]
    assert study["best"]["smooth_peak_axial_stress_kPa"]["media"] == pytest.approx(study["best"]["objective"])
    assert study["design"]["names"] == ["clamp.jaw.slopes[0]"]
    verified = study["verified_on_finer_mesh"]
    assert set(verified) >= {"reference", "start", "best"}
    fine = verified["start"]["objective"], verified["best"]["objective"]
    assert verified["gain_difference"] == pytest.approx(fine[0] - fine[1])
    assert verified["gain"] == pytest.approx(1.0 - fine[1] / fine[0])
    for found in (study, verified):
        gain = found["gains"]["start"]
        fell = found["start"]["objective"] - found["best"]["objective"]
        assert gain["difference"] == pytest.approx(fell)
        assert gain["error"] >= 0.0
        assert {row["measure"] for row in found["price"]} >= {"clamp force", "smooth peak contact pressure"}
        assert all(row["reference"] is not None for row in found["price"])
    assert verified["gain_error"] == verified["gains"]["start"]["error"]
    text = (out / "report.html").read_text(encoding="utf-8")
    assert "Smooth peak axial stress of the media, kPa: best" in text
    assert "The price: everything else that injures" in text
    rows = (out / "iterations.csv").read_text().splitlines()
    assert len(rows) == study["evaluations"] + 1
    for name in (
        "report.html",
        "figures/profiles.png",
        "figures/contact_pressure.png",
        "figures/stress_difference.png",
        "figures/stress.png",
        "start/report.html",
    ):
        assert (out / name).stat().st_size > 1000
    best = jc.load_scene(out / "best" / "scene.toml")
    assert jc.clamp(best).measure(PEAK) == pytest.approx(study["best"]["objective"], rel=1e-6)

    # a second study there needs --resume, and then has nothing left to solve
    assert main(["optimise", str(written(tmp_path)), "--out", str(out), "--quiet"]) == 2
    assert "--resume" in capsys.readouterr().err
    assert main(["optimise", str(written(tmp_path)), "--out", str(out), "--quiet", "--resume", "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["iterations"] == study["iterations"]
    assert again["design"]["best"] == study["design"]["best"]
    other = written(tmp_path, STUDY.replace("slopes = [1.2]", "slopes = [1.1]"))
    assert main(["optimise", str(other), "--out", str(out), "--quiet", "--resume"]) == 2
    assert "another one" in capsys.readouterr().err


def test_one_folder_holds_one_study_at_a_time(tmp_path):
    held = Journal(tmp_path, resume=False)
    with pytest.raises(jc.SceneError, match="another study is writing"):
        Journal(tmp_path, resume=True)
    held.close()
    Journal(tmp_path, resume=False).close()


def test_a_full_disk_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "study.json"
    write_whole(path, "before")

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_whole(path, "after")
    assert path.read_text() == "before"
    assert [p.name for p in tmp_path.iterdir()] == ["study.json"]


def test_a_full_disk_is_exit_code_4(tmp_path, capsys, monkeypatch):
    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert main(["optimise", str(written(tmp_path)), "--out", str(tmp_path / "out"), "--quiet"]) == 4
    assert "No space left" in capsys.readouterr().err


@pytest.mark.slow
def test_killed_at_random_moments_it_ends_at_the_same_design(tmp_path):
    """kill -9 ten times over; every resumed study goes on, and the last arrives where one run does."""
    path = written(tmp_path, STUDY.replace("slopes = [1.2]", "slopes = [1.2, 1.3, 1.4]"))
    command = [sys.executable, "-m", "jaxclamp", "optimise", str(path), "--quiet"]
    begun = time.perf_counter()
    subprocess.run([*command, "--out", str(tmp_path / "whole")], check=True)
    whole_time = time.perf_counter() - begun
    whole = json.loads((tmp_path / "whole" / "study.json").read_text())
    chance = random.Random(7)
    out = tmp_path / "killed"
    counts = []
    for _ in range(10):
        process = subprocess.Popen([*command, "--out", str(out), "--resume"])
        time.sleep(chance.uniform(0.2, 1.0) * whole_time)
        process.send_signal(signal.SIGKILL)
        process.wait()
        if (out / "study.json").exists():
            counts.append(json.loads((out / "study.json").read_text())["evaluations"])
    assert counts == sorted(counts), "nothing that was written is lost"
    subprocess.run([*command, "--out", str(out), "--resume"], check=True)
    killed = json.loads((out / "study.json").read_text())
    assert killed["evaluations"] <= whole["evaluations"] + 2
    np.testing.assert_allclose(killed["design"]["best"], whole["design"]["best"], atol=1e-3)
    assert killed["best"]["objective"] == pytest.approx(whole["best"]["objective"], rel=1e-5)
