"""Studies resumed from a study.json that is damaged, or that other versions have made."""

from __future__ import annotations

import json
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.cli import main
from optimize.journal import Journal, write_whole
from optimize.record import Evaluation, Record
from optimize.resuming import take_over
from optimize.starts import Budget, answer, from_another_start
from optimize.study_file import StudyFile, load_study

CODE = jc.versions()["jaxclamp"].partition("+")[0]
STUDY = """
scene = "human-lad"
set = ["mesh.circumferential=6", "mesh.axial=16", "mesh.radial=[2, 1]"]

[start]
jaw = { shape = "spline", half_width_mm = 2.0, slopes = [1.2, 1.0], edge_radius_mm = 1.0 }

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


@pytest.fixture
def asked(tmp_path) -> StudyFile:
    (tmp_path / "study.toml").write_text(STUDY, encoding="utf-8")
    return load_study(tmp_path / "study.toml")


def journalled(asked: StudyFile, folder: Path) -> dict:
    """A sound study.json of three rows, the last without equilibrium, as an earlier run leaves it."""
    problem = asked.problem
    nothing = np.full(2, np.nan), np.full((2, 2), np.nan)
    rows = [
        Evaluation(problem.start, np.array([90.0, 3e3]), np.ones((2, 2)), 11),
        Evaluation(problem.start - 0.1, np.array([80.0, 3e3]), np.ones((2, 2)), 12),
        Evaluation(problem.start - 0.9, *nothing, 0, failure="it buckles"),
    ]
    content = Record(problem, asked.method, rows).to_dict()
    folder.mkdir(exist_ok=True)
    journal = Journal(folder, resume=True)
    journal.write(content, Record(problem, asked.method, rows).rows())
    journal.close()
    return json.loads((folder / "study.json").read_text(encoding="utf-8"))


def resumed(asked: StudyFile, folder: Path) -> tuple[Record, list[jc.Progress]]:
    record, heard = Record(asked.problem, asked.method, []), []
    journal = Journal(folder, resume=True)
    try:
        take_over(record, journal, heard.append)
    finally:
        journal.close()
    return record, heard


def test_a_sound_journal_is_taken_over_silently(asked, tmp_path):
    journalled(asked, tmp_path / "out")
    record, heard = resumed(asked, tmp_path / "out")
    assert [e.failure for e in record.evaluations] == [None, None, "it buckles"]
    np.testing.assert_array_equal(record.evaluations[0].values, [90.0, 3e3])
    assert record.evaluations[2].gradients.shape == (2, 2)
    assert np.all(np.isnan(record.evaluations[2].gradients))
    assert heard == []


def second(key, value):
    """Damage of the second row."""

    def damage(content):
        content["iterations"][1][key] = value

    return damage


def without(*path):
    def damage(content):
        for step in path[:-1]:
            content = content[step]
        del content[path[-1]]

    return damage


HOPELESS = {
    "no iterations": (without("iterations"), "iterations are missing"),
    "no fingerprint": (without("fingerprint"), "fingerprint is missing"),
    "iterations no list": (lambda c: c.update(iterations={"a": 1}), "are no list"),
    "rows no tables": (
        lambda c: c.update(iterations=[1, "two", None]),
        "row 1 of its iterations is no table, so that nothing is left to go on with",
    ),
    "another start": (lambda c: c["iterations"].pop(0), "row 1 of its iterations is not the start design"),
    "another start, and damage": (
        lambda c: (c["iterations"].pop(0), c["iterations"].append(1)),
        "row 1 of its iterations is not the start design",
    ),
    "rows of another start": (
        lambda c: (c["iterations"][0].update(start=2), c["iterations"].insert(1, None)),
        "row 2 of its iterations is no table, so that nothing is left to go on with",
    ),
}


@pytest.mark.parametrize("name", HOPELESS)
def test_a_journal_without_a_sound_row_is_one_sentence(asked, tmp_path, name):
    damage, said = HOPELESS[name]
    content = journalled(asked, tmp_path / "out")
    damage(content)
    path = tmp_path / "out" / "study.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(jc.SceneError) as refused:
        asked.run(tmp_path / "out", resume=True)
    sentence = str(refused.value)
    assert sentence.startswith(f"{path}: ")
    assert said in sentence
    assert sentence.endswith("move the file away or take another folder")
    assert "\n" not in sentence
    assert json.loads(path.read_text(encoding="utf-8")) == content, "what was there is kept"
    Journal(tmp_path / "out", resume=True).close()  # nobody holds it


DAMAGES = {
    "no table": (lambda c: c["iterations"].insert(1, None), "is no table"),
    "no design": (without("iterations", 1, "design"), "has no design"),
    "no values": (without("iterations", 1, "values"), "has no values"),
    "no gradients": (without("iterations", 1, "gradients"), "has no gradients"),
    "no start": (without("iterations", 1, "start"), "has no start"),
    "no failure": (without("iterations", 1, "failure"), "has no failure"),
    "no newton": (without("iterations", 1, "newton_iterations"), "has no newton_iterations"),
    "empty values": (second("values", []), "has values that are not 2 numbers"),
    "short design": (second("design", [1.0]), "has design that are not 2 numbers"),
    "long design": (second("design", [1.0, 1.0, 1.0]), "has design that are not 2 numbers"),
    "short gradients": (second("gradients", [[1.0, 1.0]]), "has gradients that are not 2 lists"),
    "ragged gradients": (second("gradients", [[1.0, 1.0], [1.0]]), "has gradients that are not 2 numbers"),
    "flat gradients": (second("gradients", [1.0, 1.0]), "has gradients that are not 2 numbers"),
    "strings": (second("values", ["90.0", "3"]), "has values that are not 2 numbers"),
    "a string": (second("design", "ab"), "has design that are not 2 numbers"),
    "booleans": (second("design", [True, False]), "has design that are not 2 numbers"),
    "null": (second("values", [None, 1.0]), "has values that are not 2 numbers"),
    "huge": (second("values", [10**400, 1.0]), "has values that are not 2 numbers"),
    "newton text": (second("newton_iterations", "12"), "has a newton_iterations that is no whole number"),
    "start text": (second("start", "1"), "has a start that is no whole number"),
    "failure number": (second("failure", 3), "has a failure that is no text"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_study_goes_on_with_the_rows_before_the_damage(asked, tmp_path, name):
    """Said in one sentence; the damaged file is kept, and an earlier one beside it."""
    damage, said = DAMAGES[name]
    content = journalled(asked, tmp_path / "out")
    damage(content)
    path = tmp_path / "out" / "study.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    (tmp_path / "out" / "study.json.damaged").write_text("of another day", encoding="utf-8")
    record, heard = resumed(asked, tmp_path / "out")
    assert [list(e.values) for e in record.evaluations] == [[90.0, 3e3]]
    (sentence,) = (event.message for event in heard)
    assert sentence.startswith(f"{path}: row 2 of its iterations {said}")
    assert sentence.endswith(
        "going on with the rows before it, the damaged file is kept as study.json.damaged-2"
    )
    assert "\n" not in sentence
    assert json.loads((tmp_path / "out" / "study.json.damaged-2").read_text(encoding="utf-8")) == content
    assert (tmp_path / "out" / "study.json.damaged").read_text(encoding="utf-8") == "of another day"
    again, heard = resumed(asked, tmp_path / "out")
    assert (len(again.evaluations), heard) == (1, [])


@pytest.mark.parametrize(
    "text",
    [
        "[" * 200_000,
        '{"iterations": ' + "[" * 200_000,
        "{",
        "[]",
        "null",
        "",
        "{}",
        '{"a": 1' + "0" * 9000 + "}",
    ],
    ids=["brackets", "brackets within", "open", "list", "null", "empty", "no keys", "digits"],
)
def test_a_journal_that_is_no_study_is_exit_code_2(asked, tmp_path, capsys, text):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "study.json").write_text(text, encoding="utf-8")
    command = [
        "optimise",
        str(tmp_path / "study.toml"),
        "--out",
        str(tmp_path / "out"),
        "--resume",
        "--quiet",
    ]
    assert main(command) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "study.json" in said
    assert "move the file away" in said
    assert len(said) < 500


def test_damage_of_another_start_is_no_silence(asked, tmp_path):
    """Its process goes on with what is sound and hands over the sentence, or raises it."""
    folder, budget = tmp_path / "start-2", Budget(asked.method, 1, 1e-4)
    content = journalled(asked, folder)
    content["iterations"][1]["values"] = []
    write_whole(folder / "study.json", json.dumps(content))
    found, told = from_another_start(asked.problem, budget, folder, resume=True)
    assert [list(e.values) for e in found] == [[90.0, 3e3]]
    assert ["start-2" in event.message for event in told] == [True]
    content["iterations"][0] = None
    write_whole(folder / "study.json", json.dumps(content))
    with pytest.raises(jc.SceneError, match="start-2"):
        from_another_start(asked.problem, budget, folder, resume=True)


def test_a_lost_process_of_another_start_is_one_sentence():
    lost: Future = Future()
    lost.set_exception(BrokenProcessPool("terminated abruptly"))
    with pytest.raises(jc.WorkerLost, match="what it found is kept, continue with --resume"):
        answer(lost)


@pytest.mark.parametrize(
    ("versions", "said"),
    [
        ({"jaxclamp": "0.0.9"}, "made by jaxclamp 0.0.9; this is jaxclamp "),
        ({"jaxclamp": f"{CODE}+0123abcd"}, f"made by jaxclamp {CODE}+0123abcd; this is jaxclamp {CODE}+"),
        ({"jax": "0.1", "numpy": "1.0"}, "made by jax 0.1, numpy 1.0; this is jax "),
        ({"numpy": 3}, "made by numpy of an unknown version; this is numpy "),
        ({"jax": "x" * 100_000}, "made by jax xxx"),
        ({"python": "2.7", "scipy": "0.1"}, None),
        (None, "of an unknown version"),
    ],
)
def test_other_versions_are_told_once_and_not_refused(asked, tmp_path, versions, said):
    content = journalled(asked, tmp_path / "out")
    content["versions"] = None if versions is None else content["versions"] | versions
    write_whole(tmp_path / "out" / "study.json", json.dumps(content))
    record, heard = resumed(asked, tmp_path / "out")
    assert len(record.evaluations) == 3
    assert [(event.stage, event.fraction) for event in heard] == (
        [] if said is None else [("optimising", 0.0)]
    )
    assert said is None or said in heard[0].message
    assert all(len(event.message) < 500 for event in heard)


@pytest.mark.parametrize("name", ["iterations.csv", "report.html", "figures", "best"])
def test_what_is_of_no_study_is_not_replaced(tmp_path, name):
    (tmp_path / name).mkdir() if "." not in name else (tmp_path / name).write_text("mine", encoding="utf-8")
    for _ in range(2):  # nor is it the second time
        with pytest.raises(jc.SceneError, match=f"holds {name} but no study, .*: take another folder$"):
            Journal(tmp_path, resume=True)
        assert [path.name for path in tmp_path.iterdir()] == [name]


def test_where_a_study_was_another_may_begin(asked, tmp_path):
    """As is said of a damaged study.json: move that file away; its table and its reports stay behind."""
    journalled(asked, tmp_path)
    (tmp_path / "study.json").rename(tmp_path / "moved.json")
    (tmp_path / "report.html").write_text("of the study before", encoding="utf-8")
    Journal(tmp_path, resume=True).close()
