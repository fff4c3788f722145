"""Gains of objectives of any sign, and what is said of them."""

from __future__ import annotations

import dataclasses
import re
import types

import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.show.report import STYLE
from optimize.gains import Gain
from optimize.problem import Constraint
from optimize.record import Evaluation, Record
from optimize.study import solved_cold
from optimize.study_file import load_study
from optimize.verification import Verification, miss, verify


def verification(coarse, fine, unit="kPa"):
    named = lambda pair: dict(zip(("start", "best"), pair, strict=True))
    return Verification(named(coarse), named(fine), {}, None, 600, unit)


@pytest.mark.parametrize(
    ("coarse", "fine", "survives", "share"),
    [
        ((-5.0, -8.0), (-5.1, -4.0), False, -1.1 / 5.1),  # worse on the finer model
        ((-5.0, -8.0), (-5.1, -7.0), True, 1.9 / 5.1),
        ((0.0, -2.0), (0.0, -1.5), True, None),
        ((0.0, -2.0), (0.0, 0.5), False, None),
        ((100.0, 80.0), (110.0, 99.0), True, 0.1),
        ((100.0, 80.0), (110.0, 101.0), False, 9.0 / 110.0),
        ((1.0, -1.0), (0.5, -0.5), True, 2.0),  # through zero
        ((100.0, 100.0), (110.0, 110.0), True, 0.0),
        ((100.0, 101.0), (110.0, 111.0), True, -1.0 / 110.0),  # feasible at a price: nothing to lose
    ],
)
def test_a_gain_survives_if_half_of_it_is_there(coarse, fine, survives, share):
    found = verification(coarse, fine)
    assert found.survives is survives
    said = found.to_dict()
    assert said["gain_difference"] == pytest.approx(fine[0] - fine[1])
    assert said["gain"] == (None if share is None else pytest.approx(share))


def test_the_sentence_reads_for_any_sign():
    worse = verification((-5.0, -8.0), (-5.1, -4.0)).sentence
    assert "DOES NOT SURVIVE" in worse
    assert "1.1 kPa higher (21.6%); before, it was 3 kPa lower (60.0%)" in worse
    zero = verification((0.0, -2.0), (0.0, -1.5), "").sentence
    assert zero.endswith("best against start is 1.5 lower; before, it was 2 lower")
    same = verification((4.0, 4.0), (4.2, 4.2)).sentence
    assert "no gain to lose" in same
    assert "the same" in same


def test_a_finer_model_without_equilibrium_has_no_gain():
    found = verification((4.0, 3.0), (None, 2.0))
    said = found.to_dict()
    assert (said["gain"], said["gain_difference"], said["survives"]) == (None, None, False)


FAILURES = [jc.TooLittleMemory("it needs 9 GB"), jc.SceneError("it is too stiff"), jc.Unfit("no device")]


@pytest.mark.parametrize("error", FAILURES)
def test_a_finer_model_that_cannot_be_solved_leaves_the_study(error, monkeypatch):
    """Stand-ins for results: each has a scene and a value."""

    def clamp(scene, *, guess=None):
        raise error

    monkeypatch.setattr("optimize.verification.clamp", clamp)
    result = types.SimpleNamespace(scene=jc.load_scene("human-lad"), measure=lambda measure: 3.0)
    problem = types.SimpleNamespace(objective=jc.clamp_force(), constraints=())
    found = verify(problem, {"start": result, "best": result})
    assert found.sentence == f"the finer model was not solved: best: {error}"


@pytest.mark.parametrize("error", FAILURES)
def test_a_reference_that_cannot_be_solved_leaves_the_study(error, monkeypatch):
    """Beside it, the best is the start here, whose solution is at hand."""

    def clamp(scene):
        raise error

    monkeypatch.setattr("optimize.study.clamp", clamp)
    record = Record(load_study("human-lad-jaw").problem, "slsqp", [])
    record.evaluations.append(
        Evaluation(record.problem.start, np.full(len(record.problem.measures), 3.0), np.ones((1, 1)), 9)
    )
    start, told = types.SimpleNamespace(), []
    best, result, reference = solved_cold(record, start, None, told.append)
    assert (best, result, reference) == (record.evaluations[0], start, None)
    assert [event.message for event in told] == [f"no reference: {error}"]


@pytest.mark.parametrize(
    ("gain", "card"),
    [
        (Gain(-5.0, -8.0, "kPa"), ("3 kPa", "lower than the start (60.0%)")),
        (Gain(-8.0, -5.0, "kPa"), ("3 kPa", "higher than the start (37.5%)")),
        (Gain(0.0, -5.0, "kPa"), ("5 kPa", "lower than the start")),
        (Gain(1e-300, -5.0, ""), ("5", "lower than the start (5e+300 times its size)")),
        (Gain(0.0, 0.0, "mm"), ("unchanged", "against the start")),
    ],
)
def test_the_opening_boxes_of_a_report(gain, card):
    assert gain.card("the start") == card


def test_a_long_number_stays_inside_its_box():
    """A box may be narrower than its words and breaks them anywhere; the number does not forbid that."""
    rules = {
        selector.strip(): dict(pair.split(":") for pair in re.sub(r"\s", "", body).split(";") if ":" in pair)
        for selector, body in re.findall(r"([^{}]+){([^{}]*)}", STYLE)
    }
    box, big = rules[".headlines div"], rules[".headlines b"]
    assert (box["min-width"], box["overflow-wrap"]) == ("0", "anywhere")
    assert not {"white-space", "overflow-wrap", "word-break", "width", "min-width"} & set(big)


# --- bounds on the finer model ----------------------------------------------------------------------

FORCE = jc.clamp_force()


def known(value, off):
    return {FORCE: jc.Estimate(value, {"mesh": off})}


@pytest.mark.parametrize(
    ("constraint", "best", "reference", "said"),
    [
        # a bound of one's own: 110 is 10 beyond 100; that is more than its error of 4, no more than one of 12
        (Constraint(FORCE, upper=100.0), (110.0, 4.0), None, "beyond its bound of 100 by 10 ± 4 mN"),
        (Constraint(FORCE, upper=100.0), (110.0, 12.0), None, None),
        (Constraint(FORCE, lower=100.0), (90.0, 4.0), None, "beyond its bound of 100 by 10 ± 4 mN"),
        (Constraint(FORCE, 80.0, 100.0), (90.0, 0.0), None, None),
        # the reference's, which was 100 on the study's model: errors in common cancel
        (Constraint(FORCE, upper=100.0, reference=100.0), (110.0, 4.0), (108.0, 3.0), "of 108 by 2 ± 1 mN"),
        (Constraint(FORCE, upper=100.0, reference=100.0), (110.0, 4.0), (111.0, 3.0), None),
        # half of the reference's
        (Constraint(FORCE, upper=50.0, reference=100.0), (60.0, 2.0), (110.0, 2.0), "of 55 by 5 ± 1 mN"),
        (
            Constraint(FORCE, upper=50.0, reference=100.0),
            (60.0, 2.0),
            None,
            "is not known: the reference was not",
        ),
        (Constraint(FORCE, upper=0.0, reference=0.0), (3.0, 2.0), None, "beyond its bound of 0 by 3 ± 2 mN"),
    ],
)
def test_a_bound_that_the_finer_model_does_not_keep_is_told(constraint, best, reference, said):
    found = miss(constraint, known(*best), None if reference is None else known(*reference))
    assert found is None if said is None else said in found
    checked = verification((2.0, 1.0), (2.0, 1.0))
    checked = dataclasses.replace(checked, missed=() if found is None else (found,))
    assert (found or "the gain survives") in checked.sentence
    assert checked.to_dict()["missed"] == ([] if found is None else [found])
