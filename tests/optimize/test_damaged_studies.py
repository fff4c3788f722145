"""Damaged study files and damaged study.json files: a study, or one sentence, whatever they hold."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxclamp as jc
from damage import JUNK, REPEATABLE, bounded, edit, scratch
from jaxclamp.scenes.presets import presets
from jaxclamp.scenes.schema import bare, toml_value
from optimize.journal import STUDY, Journal
from optimize.record import Evaluation, Record
from optimize.resuming import take_over
from optimize.study_file import load_study

STUDIES = {p.name: p.text for p in presets() if p.kind == "study"}
COUNTS = [25, pytest.param(150, marks=pytest.mark.slow)]


def in_toml(table: dict) -> bytes:
    lines = (f"{bare(key)} = {toml_value(value)}\n" for key, value in table.items())
    return "".join(lines).encode("utf-8", "surrogatepass")


@st.composite
def damaged_studies(draw):
    """Bytes of a study file that was edited or scratched."""
    text = STUDIES[draw(st.sampled_from(sorted(STUDIES)))]
    if draw(st.booleans()):
        return in_toml(edit(draw, tomllib.loads(text)))
    return scratch(draw, text.encode())


@pytest.mark.parametrize("count", COUNTS)
def test_no_study_file_leads_to_a_traceback(count, tmp_path):
    refused = []

    @settings(max_examples=count, **REPEATABLE)
    @given(damaged_studies())
    def load(content):
        (tmp_path / "study.toml").write_bytes(content)
        with bounded():
            try:
                load_study(tmp_path / "study.toml")
            except jc.SceneError as error:
                refused.append(str(error))

    load()
    assert len(refused) > 0.5 * count, "damage was done"
    assert all(len(said) < 2000 and "\n" not in said for said in refused)


def sound(asked) -> dict:
    """A study.json of three rows, the last without equilibrium."""
    problem = asked.problem
    n, m = problem.start.size, len(problem.measures)
    nothing = np.full(m, np.nan), np.full((m, n), np.nan)
    rows = [
        Evaluation(problem.start, np.full(m, 90.0), np.ones((m, n)), 11),
        Evaluation(problem.start * 0.99, np.full(m, 80.0), np.ones((m, n)), 12),
        Evaluation(problem.start * 0.9, *nothing, 0, failure="it buckles"),
    ]
    return Record(problem, asked.method, rows).to_dict()


@st.composite
def damaged_journals(draw, content: dict):
    """Bytes of a study.json that was edited, scratched or replaced."""
    kind = draw(st.sampled_from(["edit", "rows", "scratch", "other"]))
    if kind == "edit":
        return json.dumps(edit(draw, content)).encode("utf-8", "surrogatepass")
    if kind == "rows":
        rows = edit(draw, {"iterations": content["iterations"]})
        return json.dumps({**content, **rows}).encode("utf-8", "surrogatepass")
    if kind == "scratch":
        return scratch(draw, json.dumps(content).encode())
    return json.dumps(draw(JUNK)).encode("utf-8", "surrogatepass")


def resumed(folder: Path, record: Record) -> list[str]:
    """Take a journal over; what is told of it."""
    journal, heard = Journal(folder, resume=True), []
    try:
        take_over(record, journal, lambda event: heard.append(event.message))
        return heard
    finally:
        journal.close()


@pytest.mark.parametrize("count", COUNTS)
def test_no_journal_leads_to_a_traceback(count, tmp_path):
    """What is taken over is as good as new: the record it becomes can be written again."""
    asked = load_study("human-lad-jaw")
    content = json.loads(json.dumps(sound(asked), default=float).replace("NaN", "null"))
    (tmp_path / STUDY).write_text(json.dumps(content))
    whole = Record(asked.problem, asked.method, [])
    resumed(tmp_path, whole)
    assert len(whole.evaluations) == 3
    refused, heard = [], []

    @settings(max_examples=count, **REPEATABLE)
    @given(damaged_journals(content))
    def resume(found):
        (tmp_path / STUDY).write_bytes(found)
        record = Record(asked.problem, asked.method, [])
        with bounded():
            try:
                heard.extend(resumed(tmp_path, record))
                record.to_dict()
            except jc.SceneError as error:
                refused.append(str(error))

    resume()
    assert len(refused) + len(heard) > 0.3 * count, "damage was done"
    assert all(len(said) < 2000 and "\n" not in said for said in refused + heard)
