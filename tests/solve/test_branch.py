"""Which equilibrium an answer is: the one on the path of closing jaws, or another one that is named."""

from __future__ import annotations

import functools
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.core.failures import NotConverged
from jaxclamp.solve.branch import (
    AFTER_A_SNAP,
    ANOTHER,
    CLOSING_PATH,
    FOLLOWED,
    KINK,
    branch_of,
    gain,
    require_same_path,
    work,
)
from jaxclamp.solve.clamping import inflate
from jaxclamp.solve.newton import Step
from jaxclamp.solve.results import Kept, work_balance
from jaxclamp.solve.stops import Held

CASES = Path(__file__).parents[1] / "cases"


def state(height: float, energy: float, force: float, stiffness: float = 10.0, negative: int = 0) -> Any:
    """An equilibrium as far as paths are concerned; stiffness: of the wall under the jaw, mN/mm."""
    lin = SimpleNamespace(energy=energy, jaw_force=force)
    held = SimpleNamespace(jaw_height=height)
    return SimpleNamespace(state=held, lin=lin, force_slope=-stiffness, negative_pivots=negative)


def spring(*heights: float) -> list[Any]:
    """Of a linear spring of 10 mN/mm that begins to press at height 1."""
    return [state(h, 5.0 * (1.0 - h) ** 2, 10.0 * (1.0 - h)) for h in heights]


# --- the rule ---------------------------------------------------------------------------------------


def test_a_spring_gains_what_the_jaws_bring():
    """A cubic force is integrated exactly: F = u + u**3 from u = 0.2 to 0.7, W = u**2 / 2 + u**4 / 4."""
    a, b = (state(1.0 - u, u**2 / 2 + u**4 / 4, u + u**3, stiffness=1.0 + 3.0 * u**2) for u in (0.2, 0.7))
    assert work(a, b) == pytest.approx((0.7**2 - 0.2**2) / 2 + (0.7**4 - 0.2**4) / 4, rel=1e-14)
    assert abs(gain(a, b)) < 1e-12


@pytest.mark.parametrize("at", np.linspace(0.0, 1.0, 11))
@pytest.mark.parametrize("slopes", [(0.0, 1.0), (1.0, 0.0), (1.0, 3.0), (3.0, 1.0)])
def test_a_kink_is_no_jump(at, slopes):
    """The force rises with one slope up to a share of the step, and with another from there: at most 1/12."""
    first, then = slopes
    force = first * at + then * (1.0 - at)
    energy = first * at**2 / 2 + first * at * (1.0 - at) + then * (1.0 - at) ** 2 / 2
    gained = gain(state(1.0, 0.0, 0.0, first), state(0.0, energy, force, then))
    assert abs(gained) <= 1.0 / 12.0 + 1e-12 < KINK


@pytest.mark.parametrize("jump", [0.2, -0.2])
def test_a_step_that_jumps_is_refused(jump):
    a, b = spring(0.9, 0.7)
    step = Step(Held(0.7), 0.0, 1.0)
    require_same_path(step, a, b)
    b.lin.energy += jump * 10.0 * 0.2**2
    with pytest.raises(NotConverged, match="way of the closing jaw"):
        require_same_path(step, a, b)


def test_an_unstable_state_is_refused_under_held_jaws():
    a, b = spring(0.9, 0.7)
    b.negative_pivots = 1
    with pytest.raises(NotConverged, match="lost stability"):
        require_same_path(Step(Held(0.7), 0.0, 1.0), a, b)


def with_energies(path: list[Any], *more: float) -> list[Any]:
    for one, extra in zip(path, more, strict=True):
        one.lin.energy += extra
    return path


def unstable(path: list[Any], *which: int) -> list[Any]:
    for i in which:
        path[i].negative_pivots = 1
    return path


@pytest.mark.parametrize(
    ("path", "said"),
    [
        (spring(0.9, 0.7, 0.4), CLOSING_PATH),
        (spring(0.9, 0.4, 0.6), CLOSING_PATH),  # too far and back, the same way
        (with_energies(spring(0.9, 0.7, 0.4), 0.0, -1.0, -1.0), AFTER_A_SNAP),
        (with_energies(spring(0.9, 0.7, 0.4), 0.0, 1.0, 1.0), f"{ANOTHER}: on the way here the wall gained"),
        (with_energies(spring(0.9, 0.4, 0.6), 0.0, -2.0, -2.0), f"{ANOTHER}: closing jaws snap past it"),
        (unstable(spring(0.9, 0.7, 0.4), 2), f"{ANOTHER}: unstable"),
        (unstable(spring(0.9, 0.4, 0.6), 1), f"{ANOTHER}: closing jaws snap past it"),
        (unstable(spring(0.9, 0.7, 0.4), 1), f"{ANOTHER}: closing jaws lose stability"),
    ],
)
def test_what_an_answer_is(path, said):
    assert branch_of(path).startswith(said)


def test_work_that_comes_to_nothing_is_balanced_by_what_was_done():
    """There and back, with rounding: nothing is left to compare the energies' difference with."""
    path = with_energies(spring(0.9, 0.7, 0.9), 0.0, 0.0, 1e-10)
    kept = [Kept("clamping", one, {}, None) for one in path]
    assert work_balance(kept) < 1e-9


# --- a narrow flat jaw, of which Newton's method finds several equilibria ---------------------------------


SMALLER = {"mesh.circumferential": 4, "mesh.axial": 6, "mesh.radial": [1, 1]}


def sharp(edge: float = 0.02, half_width: float = 1.0, **changes: Any) -> jc.Scene:
    """The seed's artery on 5 x 8 x 3 elements under a narrow flat jaw, closed to 95 %."""
    mesh = ["mesh.circumferential=5", "mesh.axial=8", "mesh.radial=[2, 1]", "stop.occlusion=0.95"]
    jaw = f"clamp.jaw={{shape='flat', half_width_mm={half_width}, edge_radius_mm={edge}}}"
    return jc.load_scene("human-lad", [*mesh, jaw, *(f"{key}={value}" for key, value in changes.items())])


@functools.cache
def closed(edge: float = 0.02, half_width: float = 1.0) -> jc.Result:
    return jc.clamp(sharp(edge, half_width))


def distance(a: jc.Result, b: jc.Result) -> float:
    """Of the last states, mm."""
    return float(np.max(np.abs(np.asarray(a.states[-1].state.x - b.states[-1].state.x))))


def test_the_continuation_does_not_decide_the_answer_on_a_small_mesh():
    ways = [jc.clamp(sharp(**SMALLER, **{"solver.continuation": way})) for way in ("'lumen'", "'travel'")]
    assert [way.solver["branch"] for way in ways] == [CLOSING_PATH] * 2
    assert distance(*ways) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("edge", [0.02, 0.1])
def test_the_continuation_does_not_decide_the_answer(edge):
    """By travel, Newton's method used to jump to a wall off the jaw's middle: 40.3 kPa instead of 26.2."""
    by_travel = jc.clamp(sharp(edge, **{"solver.continuation": "'travel'"}))
    assert by_travel.solver["branch"] == closed(edge).solver["branch"] == CLOSING_PATH
    assert distance(by_travel, closed(edge)) < 1e-6
    assert by_travel.solver["work_balance_error"] < 1e-3


@pytest.mark.slow
def test_the_same_on_the_mesh_of_the_study():
    """It used to be 39.4 kPa by occlusion and 42.6 by travel."""
    names = ["stop.occlusion=0.95", "clamp.jaw={shape='flat', half_width_mm=1.0, edge_radius_mm=0.1}"]
    ways = [
        jc.clamp(jc.load_scene("human-lad", [*names, f"solver.continuation='{way}'"]))
        for way in ("lumen", "travel")
    ]
    assert distance(*ways) < 1e-6
    assert {way.solver["branch"] for way in ways} == {CLOSING_PATH}


@pytest.mark.slow
def test_a_warm_start_that_leads_elsewhere_is_named():
    """Followed from a wider jaw, without a jump: 17.6 kPa instead of 26.2."""
    warm = jc.clamp(sharp(), guess=closed(half_width=1.3))
    assert distance(warm, closed()) > 1e-2
    assert warm.solver["branch"] == FOLLOWED
    known = jc.with_errors(warm)
    assert known.solver["branch"].startswith(f"{ANOTHER}: on a coarser mesh, closing anew leads to")
    again = jc.clamp(sharp(half_width=1.01), guess=known)
    assert again.solver["branch"].startswith(f"{ANOTHER}: followed from a neighbour")


@pytest.mark.slow
def test_a_warm_start_that_leads_to_the_same_raises_no_alarm():
    warm = jc.clamp(sharp(), guess=closed(half_width=1.1))
    assert distance(warm, closed()) < 1e-6
    assert jc.with_errors(warm).solver["branch"] == FOLLOWED


@pytest.mark.slow
def test_the_same_clamp_closed_further_is_on_the_same_path():
    before = jc.clamp(jc.replace(sharp(), "stop.occlusion", 0.6))
    further = jc.clamp(sharp(), guess=before)
    assert further.solver["branch"] == CLOSING_PATH
    assert distance(further, closed()) < 1e-6


# --- tubes and arteries that were refused -----------------------------------------------------------------


def test_three_layers_close_although_they_would_wrinkle():
    """Semi-analytic inner radius in the body, incompressible: 0.45 mm; load-free, the tube is not stable."""
    result = inflate(jc.load_scene(CASES / "tube-hard.toml"))
    assert 0.5 * result.final["lumen_height_mm"] == pytest.approx(0.45, abs=5e-3)
    assert result.load_free.equilibrium.negative_pivots == 1
    assert result.physiological.equilibrium.negative_pivots == 0


@pytest.mark.parametrize("mesh", [SMALLER, pytest.param({}, marks=pytest.mark.slow)], ids=["small", "own"])
def test_the_default_contact_carries_a_stiff_artery_under_pressure(mesh):
    """Refused with 2000 kPa/mm and 0.01 mm: the jaws sank in."""
    sets = [f"{key}={value}" for key, value in mesh.items()]
    result = jc.clamp(jc.load_scene(CASES / "artery-21.toml", sets))
    assert result.final["max_penetration_mm"] < 0.05 * (0.7668 + 0.68855)
    assert result.solver["branch"] in (CLOSING_PATH, AFTER_A_SNAP)


@pytest.mark.slow
def test_a_soft_artery_is_solved_or_refused_in_one_sentence():
    """Whether it has an equilibrium is open; it is refused beyond an occlusion of 51 %."""
    begun = time.perf_counter()
    try:
        result = jc.clamp(jc.load_scene(CASES / "artery-24.toml"))
    except jc.EquilibriumError as refused:
        said = str(refused)
    else:
        said = ""
        assert result.final["occlusion"] == pytest.approx(0.5381, abs=1e-6)
        assert result.final["max_penetration_mm"] < 0.1 * (0.75635 + 0.6015)
    assert "\n" not in said
    assert time.perf_counter() - begun < 300.0


def test_nothing_is_none_in_a_stress_free_tube():
    """Forces that are rounding balance to no less than the noise of stress."""
    counts = ["mesh.circumferential=4", "mesh.axial=4", "mesh.radial=[1, 1]"]
    unloaded = ["artery.pressure_kPa=0", "artery.axial_stretch=1.0", "artery.layers[1].inner_radius_mm=3.795"]
    open_angles = [f"artery.layers[{i}].opening_angle_deg=0" for i in (0, 1)]
    result = inflate(jc.load_scene("human-lad", [*counts, *unloaded, *open_angles]))
    assert [kept.values["force_balance_error"] < 1e-6 for kept in result.states] == [True, True]
