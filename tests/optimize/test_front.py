"""Fronts of two objectives: swept, resumed, drawn."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.cli import main
from optimize.front import BEATEN, WITHIN, Front, Point, Searches
from optimize.front_report import page, plot_front
from optimize.record import Evaluation
from optimize.starts import Budget
from optimize.study_file import load_study

STUDY = """
title = "Two objectives"
scene = "human-lad"
set = ["mesh.circumferential=5", "mesh.axial=8", "mesh.radial=[2, 1]", "stop.occlusion=0.6"]
max_evaluations = 6
points = 3

[start]
jaw = { shape = "spline", half_width_mm = 2.0, slopes = [0.4, 0.8], edge_radius_mm = 1.0 }

[[objectives]]
measure = "smooth_peak_axial_stress_kPa"
layer = "media"

[[objectives]]
measure = "smooth_peak_contact_pressure_kPa"

[[variables]]
key = "clamp.jaw.slopes"
lower = 0.0
upper = 2.0
"""
PEAK, PRESSURE = jc.smooth_peak_axial_stress("media"), jc.smooth_peak_contact_pressure()


def written(folder: Path, text: str = STUDY) -> Path:
    path = folder / "study.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("points = 3", "points = 1", "whole number from 2"),
        ("points = 3", "starts = 2", "starts = 2"),
        ('measure = "smooth_peak_contact_pressure_kPa"', 'measure = "clamp_force"', "clamp_force_N"),
        (
            '[[objectives]]\nmeasure = "smooth_peak_contact_pressure_kPa"',
            "",
            "expected two tables, found 1",
        ),
        (
            'measure = "smooth_peak_contact_pressure_kPa"',
            'measure = "smooth_peak_axial_stress_kPa"\nlayer = "media"',
            "expected two measures",
        ),
        ("points = 3", 'method = "adam"', "takes no constraints"),
    ],
)
def test_a_wrong_front_is_one_sentence_and_exit_code_2(tmp_path, capsys, old, new, said):
    path = written(tmp_path, STUDY.replace(old, new))
    assert main(["optimise", str(path), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert said in captured.err


def front_of(folder: Path, rows: dict[str, tuple[float, float]], errors: dict[str, float]) -> Front:
    """A made-up front; errors: of the first objective, of no source in common with the others."""
    asked = load_study(written(folder)).problem
    result: Any = SimpleNamespace(final={})
    points = [Point(n, None, asked.start, 0.0, result, 1, "") for n in rows if n.startswith("point")]
    estimates = {
        name: {
            PEAK: jc.Estimate(first, {"mesh": errors.get(name, 0.0)}),
            PRESSURE: jc.Estimate(second, {"mesh": 0.0}),
        }
        for name, (first, second) in rows.items()
    }
    return Front(asked, PRESSURE, tuple(points), estimates, 0.0)


ROWS = {"point-1": (1.0, 5.0), "point-2": (2.0, 3.0), "point-3": (2.5, 3.0), "point-4": (4.0, 1.0)}


def test_a_point_is_beaten_by_one_that_is_better_in_both(tmp_path):
    found = front_of(tmp_path, ROWS, {})
    assert [found.standing(name) for name in ROWS] == ["", "", BEATEN, ""]
    beside = front_of(tmp_path, ROWS | {"reference": (3.5, 0.5)}, {})
    assert [beside.standing(name) for name in ROWS] == ["", "", BEATEN, BEATEN]
    assert beside.others == ["reference"]


@pytest.mark.parametrize(
    ("errors", "word"),
    [
        ({"point-3": 0.6}, WITHIN),  # by 0.5 in the one objective, not at all in the other
        ({"point-3": 0.6, "point-2": 0.5}, BEATEN),  # most of the error is the other's, too
        ({"point-3": 0.4}, BEATEN),
    ],
)
def test_a_point_that_is_beaten_within_its_error_is_said_so(tmp_path, errors, word):
    """The error of the difference counts: what both have in common cancels."""
    found = front_of(tmp_path, ROWS, errors)
    assert found.standing("point-3") == word
    told = found.to_dict()["front"][2]
    assert told["beaten"]
    assert told["beaten_within_error"] == (word == WITHIN)
    assert told["errors"] == [pytest.approx(errors["point-3"]), 0.0]
    assert found.rows()[2][f"error of {PEAK}"] == pytest.approx(errors["point-3"])
    assert any(line.endswith(word) and "2.5 ± " in line for line in found.lines())
    assert f"2.5 ± {errors['point-3']:g}" in (text := page(found, "Front", []))
    assert ("within its error" in text) == (word == WITHIN)
    bars = [c for c in plot_front(found).axes[0].containers if c.has_xerr]
    ends = [bar.lines[2][0].get_segments()[0][:, 0] for bar in bars]
    assert any(np.ptp(end) == pytest.approx(2.0 * errors["point-3"]) for end in ends)


def test_a_front_whose_points_are_all_beaten_keeps_its_numbers(tmp_path):
    """No curve is drawn; it used to be the word "-", which turned the heights of the axis into categories."""
    axes = plot_front(front_of(tmp_path, ROWS | {"reference": (0.5, 0.5)}, {})).axes[0]
    assert not axes.yaxis.have_units()
    low, high = axes.get_ylim()
    assert low < 0.5 < 5.0 < high


CENTRES = {PEAK: np.array([0.3, 0.2]), PRESSURE: np.array([1.2, 1.5])}


@pytest.fixture
def bowls(monkeypatch):
    """Stand-ins for solutions: each objective is 1 plus the squared distance of the slopes from a centre.

    `scale` is a factor of both; `warm` takes what a search is to be told instead of the values.
    """
    seen = SimpleNamespace(scale=1.0, warm=lambda problem, values: values)

    def solved(scene):
        away = {m: np.asarray(scene.clamp.jaw.slopes) - centre for m, centre in CENTRES.items()}
        return SimpleNamespace(away=away, final={}, measure=lambda m: seen.scale * (1.0 + away[m] @ away[m]))

    def evaluated(problem, design, near):
        result = solved(problem.scene_at(design))
        values = np.array([result.measure(m) for m in problem.measures])
        gradients = np.array([2.0 * seen.scale * result.away[m] for m in problem.measures])
        return Evaluation(design, seen.warm(problem, values), gradients, 1), result

    monkeypatch.setattr("optimize.evaluator.evaluate", evaluated)
    monkeypatch.setattr("optimize.study.clamp", solved)
    return seen


def swept(folder: Path, most: int, resume: bool = False) -> tuple[Point, ...]:
    asked, budget = load_study(written(folder)).problem, Budget("slsqp", most, 1e-6)
    return Searches(asked, PRESSURE, budget, folder / "out", resume, lambda event: None).points(3)


def journal_of(folder: Path, point: int) -> dict[str, Any]:
    return json.loads((folder / "out" / f"point-{point}" / "study.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("scale", [1.0, 1.0 + 1e-9])
@pytest.mark.parametrize("most", [2, 12])
def test_a_front_goes_on_with_a_greater_budget_or_other_last_digits(tmp_path, bowls, most, scale):
    """Start and limit of every point stay; they used to follow from the points before, another study then."""
    before = swept(tmp_path, 2)
    rows = [journal_of(tmp_path, n)["iterations"] for n in (1, 2, 3)]
    bowls.scale = scale
    after = swept(tmp_path, most, resume=True)
    assert [p.limit for p in after] == [p.limit for p in before]
    assert [journal_of(tmp_path, n)["iterations"][:2] for n in (1, 2, 3)] == rows
    assert all((p.evaluations > 2) == (most > 2) for p in after)
    gained = before[0].result.measure(PEAK) - after[0].result.measure(PEAK)
    assert (gained > 1e-3) == (most > 2)


def test_a_point_begins_at_no_design_that_a_solution_from_scratch_does_not_find(tmp_path, bowls):
    """The second design of the first point is said to have next to no contact pressure."""
    told = []

    def flatter(problem, values):
        told.append(values)
        return np.array([values[0], 0.01]) if len(told) == 2 else values

    bowls.warm = flatter
    points = swept(tmp_path, 12)
    second = journal_of(tmp_path, 1)["iterations"][1]
    assert second["values"][1] == 0.01
    assert np.abs(np.subtract(journal_of(tmp_path, 3)["design"]["start"], second["design"])).max() > 1e-3
    assert points[2].result.measure(PRESSURE) == pytest.approx(1.0, abs=1e-3)


def test_how_far_a_point_violates_its_limit_is_said_of_the_solution_from_scratch(tmp_path, bowls):
    """While the middle is searched, contact pressures are told too low by a tenth."""
    is_middle = lambda problem: np.isfinite(problem.constraints[0].upper)
    bowls.warm = lambda problem, values: values * [1.0, 0.9] if is_middle(problem) else values
    begin, middle, end = swept(tmp_path, 12)
    assert (begin.violation, end.violation) == (0.0, 0.0)
    assert middle.violation == pytest.approx(middle.result.measure(PRESSURE) / middle.limit - 1.0)
    assert middle.violation > 0.05


@pytest.mark.slow
def test_a_front_is_swept_resumed_and_drawn(tmp_path, capsys):
    out, path = tmp_path / "out", written(tmp_path)
    command = ["optimise", str(path), "--out", str(out), "--quiet", "--json"]
    assert main(command) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads((out / "study.json").read_text())
    first, second = np.array([p["objectives"] for p in found["front"]]).T
    assert [p["folder"] for p in found["front"]] == ["point-1", "point-2", "point-3"]
    assert first[0] == pytest.approx(min(first), rel=1e-6)
    assert second[-1] == pytest.approx(min(second), rel=1e-6)
    middle = found["front"][1]
    assert middle["limit"] == pytest.approx(0.5 * (second[0] + second[-1]), rel=1e-5)
    start = found["start"]["objectives"]
    assert first[0] < start[0]
    assert second[-1] < start[1]
    assert set(found) >= {"start", "reference", "design", "versions"}
    for name in ("report.html", "front.png", "point-2/best/report.html"):
        assert (out / name).stat().st_size > 1000
    best = jc.clamp(jc.load_scene(out / "point-3" / "best" / "scene.toml"))
    assert best.measure(PRESSURE) == pytest.approx(second[-1], rel=1e-5)
    assert best.measure(PEAK) == pytest.approx(first[-1], rel=1e-5)
    near = jc.neighbours(best).estimates((PEAK, PRESSURE))
    assert found["front"][-1]["errors"] == pytest.approx([near[m].error for m in (PEAK, PRESSURE)], rel=1e-2)

    # a second study there needs --resume; one that was cut off goes on with what it has
    assert main(command) == 2
    assert "--resume" in capsys.readouterr().err
    rows = json.loads((out / "point-3" / "study.json").read_text())["iterations"]
    (out / "study.json").unlink()
    (out / "point-2" / "study.json").unlink()
    assert main([*command, "--resume"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert json.loads((out / "point-3" / "study.json").read_text())["iterations"] == rows
    assert again["front"][0]["objectives"] == pytest.approx(found["front"][0]["objectives"], rel=1e-9)
    assert again["front"][1]["objectives"] == pytest.approx(middle["objectives"], rel=1e-6)

    # with a greater budget, every point goes on from what it has
    written(tmp_path, STUDY.replace("max_evaluations = 6", "max_evaluations = 8"))
    assert main([*command, "--resume"]) == 0
    more = json.loads(capsys.readouterr().out)["front"]
    assert more[1]["limit"] == again["front"][1]["limit"]
    assert json.loads((out / "point-3" / "study.json").read_text())["iterations"][: len(rows)] == rows
    assert more[0]["objectives"][0] <= again["front"][0]["objectives"][0] * (1.0 + 1e-6)

    # a study of one objective is not taken for a front
    (out / "study.json").write_text('{"fingerprint": "a"}', encoding="utf-8")
    assert main([*command, "--resume"]) == 2
    assert "of one objective" in capsys.readouterr().err
