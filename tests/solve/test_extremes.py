"""The stability study: no scene of the box ends in a wrong answer, nearly all sensible ones are solved.

A few scenes by default; the whole box, and random draws, as `slow`. The map of the whole study is
docs/extremes.md, written by benchmarks/extremes_map.py.
"""

from __future__ import annotations

import functools

import jax
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import jaxclamp as jc
from directions import dot, drawn, moved, tight
from extremes import (
    AXES,
    Outcome,
    described,
    draw,
    is_sensible,
    judge,
    random_corners,
    random_points,
    scene_of,
)

LEAST_SOLVED = 0.97
"""of the sensible box"""

SAMPLE: dict[str, dict[str, float]] = {
    "nearly incompressible": {"bulk": 1e8},
    "fibres that stiffen at once": {"k2": 500.0},
    "fibres across": {"fibre_angle": 60.0, "pressure": 8.0},
    "closed the wrong way round": {"opening_angle": -120.0},
    "a thin wall": {"wall": 0.08, "pressure": 5.0},
    "no blood, no stretch": {"pressure": 0.0, "stretch": 1.0},
    "compressed": {"stretch": 0.85},
    "a blunt jaw": {"jaw_radius": 100.0},
    "hard, sharp contact": {"contact_stiffness": 1e6, "smoothing": 1e-6},
    "nearly closed": {"occlusion": 0.99, "grading": 6.0},
    "everything at once": {
        "bulk": 1e6,
        "k2": 100.0,
        "fibre_angle": 45.0,
        "opening_angle": 200.0,
        "wall": 0.3,
        "stiffness_ratio": 3.0,
        "stretch": 1.3,
        "pressure": 25.0,
        "jaw_radius": 2.0,
        "contact_stiffness": 3e4,
        "smoothing": 1e-3,
        "grading": 4.0,
        "occlusion": 0.95,
    },
}
REFUSED: dict[str, tuple[dict[str, float], str]] = {
    "an adventitia that a soft contact cannot press": ({"stiffness_ratio": 1e3}, "the jaws sink into"),
    "contact that gives way": ({"contact_stiffness": 10.0}, "the jaws sink into"),
    "a jaw smaller than a facet": ({"jaw_radius": 0.1}, "between the contact points"),
    "no fibres round the lumen": ({"fibre_angle": 90.0}, "balloons"),
    "fibres that do not stiffen": ({"k2": 0.0}, "loses stability"),
}


def assert_no_wrong_answer(outcomes: list[tuple[dict[str, float], Outcome]]) -> None:
    wrong = [
        f"{described(point)}: {outcome.reason}" for point, outcome in outcomes if outcome.kind == "wrong"
    ]
    assert not wrong, "\n".join(wrong)


@functools.cache
def solved(name: str) -> jc.Result:
    outcome = judge(SAMPLE[name])
    assert outcome.kind == "solved", outcome.reason
    assert outcome.result is not None
    return outcome.result


@pytest.mark.parametrize("name", SAMPLE)
def test_a_sample_is_solved(name):
    solved(name)


@pytest.mark.parametrize("name", REFUSED)
def test_nonsense_is_refused_with_its_cause(name):
    point, cause = REFUSED[name]
    outcome = judge(point)
    assert outcome.kind == "refused", outcome
    assert cause in outcome.reason


# ------------------------------------------------------------------ the whole box


@pytest.mark.slow
@pytest.mark.parametrize("axis", AXES)
def test_single_axes(axis):
    points = [draw({axis: k / 6}) for k in range(7)]
    assert_no_wrong_answer([(point, judge(point)) for point in points])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_the_sensible_box_is_solved(seed):
    outcomes = [(point, judge(point)) for point in random_points(50, 100 + seed, sensible=True)]
    assert_no_wrong_answer(outcomes)
    share = sum(outcome.kind == "solved" for _, outcome in outcomes) / len(outcomes)
    refusals = [f"{described(point)}: {o.reason}" for point, o in outcomes if o.kind == "refused"]
    assert share >= LEAST_SOLVED, "\n".join(refusals)


@pytest.mark.slow
@pytest.mark.parametrize("sensible", [True, False])
@pytest.mark.parametrize("seed", range(2))
def test_corners(seed, sensible):
    points = random_corners(30, 100 + seed, sensible)
    assert_no_wrong_answer([(point, judge(point)) for point in points])


shares = st.floats(0.0, 1.0)
whole_points = st.fixed_dictionaries({}, optional=dict.fromkeys(AXES, shares)).map(draw)
"""any axes at any place: the tester looks for few axes and for round values, as people do"""


@pytest.mark.slow
@settings(max_examples=60, suppress_health_check=list(HealthCheck))
@given(whole_points)
def test_no_scene_at_all_is_answered_wrongly(point):
    assert_no_wrong_answer([(point, judge(point))])


# ------------------------------------------------------------------ gradients

JAW_AND_CONTACT = ("clamp.jaw.radius", "contact.stiffness", "contact.smoothing", "stop.occlusion")
STEPS = (1e-2, 1e-3, 1e-4, 1e-5)


def clamp_force(result: jc.Result, changes: dict[str, float]) -> float:
    scene = result.scene
    for path, value in changes.items():
        scene = jc.replace(scene, path, value)
    return jc.clamp(scene, guess=result).measure(jc.clamp_force())


def errors_of_differences(result: jc.Result) -> dict[str, float]:
    """Least error over the steps of the central difference of the jaw force, relative to the force."""
    values = {
        path: float(functools.reduce(getattr, path.split("."), result.scene)) for path in JAW_AND_CONTACT
    }

    def force(numbers: dict[str, float]) -> jax.Array:
        scene = result.scene
        for path, value in numbers.items():
            scene = jc.replace(scene, path, value)
        return jc.evaluate(scene, jc.clamp_force(), guess=result)

    value, gradient = jax.value_and_grad(force)(values)
    errors = {}
    for path, number in values.items():
        slope = number * float(gradient[path]) / float(value)
        found = []
        for step in STEPS:
            ends = [clamp_force(result, {path: number * (1.0 + sign * step)}) for sign in (1.0, -1.0)]
            quotient = (ends[0] - ends[1]) / (2.0 * step * float(value))
            found.append(abs(quotient - slope) / max(abs(slope), 1e-3))
        errors[path] = min(found)
    return errors


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("nearly incompressible", marks=pytest.mark.slow),
        pytest.param("hard, sharp contact", marks=pytest.mark.slow),
        "no blood, no stretch",
    ],
)
def test_gradients_of_jaw_and_contact(name):
    scene = tight(solved(name).scene)
    # contact as sharp as is accepted leaves no room for a difference
    inside = 1.0 + 2.0 * max(STEPS)
    result = jc.clamp(jc.replace(scene, "contact.smoothing", inside * float(scene.contact.smoothing)))
    errors = errors_of_differences(result)
    assert all(error < 1e-3 for error in errors.values()), errors


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_gradients_of_jaw_and_contact_anywhere(seed):
    """Wherever the box is solved; a result that is refused has no gradient."""
    point = random_points(1, 200 + seed, sensible=seed % 2 == 0)[0]
    try:
        result = jc.clamp(tight(scene_of(point)))
    except (jc.EquilibriumError, jc.SceneError):
        return
    errors = errors_of_differences(result)
    assert all(error < 1e-3 for error in errors.values()), f"{described(point)}: {errors}"


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["nearly incompressible", "everything at once", "compressed", "nearly closed"]
)
def test_gradients_of_the_whole_scene(name):
    """The smooth peak's derivative in a random direction of all floats, against central differences."""
    measure = jc.smooth_peak_axial_stress("media")
    result = jc.clamp(tight(solved(name).scene))
    value, gradient = jc.value_and_gradient(result, measure)
    direction = drawn(result.scene, ("artery", "clamp.jaw", "contact", "stop"), seed=1)
    slope, found = dot(gradient, direction), []
    for step in (1e-3, 1e-4, 1e-5, 1e-6):
        ends = [
            jc.clamp(moved(result.scene, direction, sign * step), guess=result).measure(measure)
            for sign in (1.0, -1.0)
        ]
        found.append(abs((ends[0] - ends[1]) / (2.0 * step) - slope) / max(abs(slope), 1e-3 * abs(value)))
    assert min(found) < 1e-3, found


def test_the_judge_sees_sense():
    assert is_sensible({})
    assert not is_sensible({"contact_stiffness": 10.0})
    assert not is_sensible({"k2": 0.0, "pressure": 30.0})
