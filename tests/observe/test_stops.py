"""Stops of a user's own: one record with a target and a measure works in clamp, gradients and TOML."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.core.records import quantity, record, static
from jaxclamp.scenes.files import loads_scene
from jaxclamp.scenes.scene import Stop
from jaxclamp.solve.newton import bordered_step
from jaxclamp.solve.stops import Row, stop_row

SMALL = ["mesh.circumferential=5", "mesh.axial=7", "mesh.radial=[2, 1]"]


@record
class LumenAreaStop(Stop):
    """Close until the lumen's area at mid-length is so small."""

    STEADY = True

    kind: str = static("lumen area")
    lumen_area: jax.Array = quantity("mm2", 0.0, 1e4)

    def measure(self, equilibria):
        return jc.lumen_area()(equilibria)


@record
class PressureStop(Stop):
    """Close until the jaws press with a mean pressure."""

    kind: str = static("mean contact pressure")
    mean_pressure: jax.Array = quantity("kPa", 0.0, 1e5)

    def measure(self, equilibria):
        return jc.mean_contact_pressure()(equilibria)


OWN = {"lumen_area_mm2": (8.0, jc.lumen_area()), "mean_pressure_kPa": (29.0, jc.mean_contact_pressure())}


@pytest.fixture(scope="module", params=OWN)
def clamped(request):
    target, measure = OWN[request.param]
    scene = jc.load_scene("human-lad", [*SMALL, f"stop={{{request.param}={target}}}"])
    return jc.clamp(scene), target, measure


def test_it_is_reached(clamped):
    result, target, measure = clamped
    assert result.converged
    assert result.measure(measure) == pytest.approx(target, rel=1e-9)
    assert result.final["force_balance_error"] < 1e-8
    assert len(result.history) > 3


def test_it_is_written_and_read_as_any_other(clamped):
    result, target, _ = clamped
    text = jc.dump_scene(result.scene)
    again = loads_scene(text)
    assert type(again.stop) is type(result.scene.stop)
    assert float(again.stop.target()) == target


@pytest.mark.parametrize(
    "path",
    [
        pytest.param("stop", marks=pytest.mark.slow),
        "clamp.jaw.radius",
        pytest.param("artery.pressure", marks=pytest.mark.slow),
    ],
)
def test_its_gradient_agrees_with_differences(clamped, path):
    """Of the force, by the target itself, by the jaw and by a load: over a range of steps."""
    result, _, _ = clamped
    if path == "stop":
        path = f"stop.{result.scene.stop._quantity().name}"
    scene = dataclasses.replace(
        result.scene, solver=dataclasses.replace(result.scene.solver, tolerance=1e-12)
    )
    base = jc.clamp(scene, guess=result)
    value = float(jc.scenes.address.get(scene, path))
    _, gradients = jc.gradients(base, (jc.clamp_force(),), paths=(path,))
    errors = []
    for h in (1e-3, 1e-4, 1e-5, 1e-6):
        force = [
            jc.clamp(jc.replace(scene, path, value * (1.0 + s * h)), guess=base).measure(jc.clamp_force())
            for s in (1.0, -1.0)
        ]
        errors.append(abs((force[0] - force[1]) / (2.0 * h * value) / gradients[0, 0] - 1.0))
    assert min(errors) < 1e-6


def test_the_least_force_is_reached():
    """Less than what smoothed contact makes of a jaw that just touches."""
    result = jc.clamp(jc.load_scene("human-lad", [*SMALL, "stop={force_N=1e-6}"]))
    assert result.final["clamp_force_N"] == pytest.approx(1e-6, rel=1e-6)


@pytest.mark.parametrize("continuation", ["lumen", "travel"])
def test_a_force_beyond_reach_is_named_whatever_the_continuation(continuation):
    counts = [*SMALL, f"solver.continuation={continuation}", "stop={force_N=1000}"]
    with pytest.raises(
        jc.EquilibriumError, match=r"beyond occlusion 100\.\d%, jaw height .* mm, force \d.* N"
    ):
        jc.clamp(jc.load_scene("human-lad", counts))


def test_an_unknown_stop_is_refused_before_anything_is_solved():
    with pytest.raises(jc.SceneError, match=r"unknown key stop\.bone_mm"):
        jc.load_scene("human-lad", ["stop={bone_mm=3}"])


def test_a_stop_out_of_reach_says_how_far_it_came():
    with pytest.raises(jc.EquilibriumError, match=r"jaw height .* mm, mean contact pressure .* kPa"):
        jc.clamp(jc.load_scene("human-lad", [*SMALL, "stop={mean_pressure_kPa=5000}"]))


@pytest.mark.parametrize("stop", ["occlusion=0.6", "travel_mm=1.5", "force_N=0.2"])
def test_rows_of_the_shipped_stops(stop):
    """By jax.grad, against what they are by hand: the top node's height, the jaw, and minus the coupling."""
    result = jc.clamp(jc.load_scene("human-lad", [*SMALL, f"stop={{{stop}}}"]))
    e, lin, marks = result.equilibria, result.states[-1].equilibrium.lin, result.model.marks
    _, by_x, by_q = (np.asarray(a) for a in stop_row(result.scene.stop, e))
    free = np.asarray(result.model.discretisation.layout.free)
    if stop.startswith("occlusion"):
        unit = (free == 3 * marks.lumen_top + 1) / -float(e.body.x[marks.lumen_top, 1])
        expected = unit, 0.0
    elif stop.startswith("travel"):
        expected = np.zeros(len(free)), -1.0
    else:
        expected = -4.0 * lin.coupling[:, 0], -4.0 * lin.rigid_stiffness[0, 0]
    np.testing.assert_allclose(by_x, expected[0], rtol=0.0, atol=1e-12 * max(np.max(np.abs(by_x)), 1.0))
    assert float(by_q[0]) == pytest.approx(expected[1], rel=1e-12, abs=1e-15)


def test_a_bordered_step_with_several_rigid_coordinates():
    """One is driven by the condition, the others find their own equilibrium: against the whole system."""
    rng = np.random.default_rng(4)
    n, n_q = 12, 3
    K, C = (lambda a: a @ a.T + np.eye(n))(rng.normal(size=(n, n))), rng.normal(size=(n, n_q))
    S = (lambda a: a @ a.T + 20.0 * np.eye(n_q))(rng.normal(size=(n_q, n_q)))
    residual, force = rng.normal(size=n), rng.normal(size=n_q)
    row = Row(0.7, rng.normal(size=n), rng.normal(size=n_q))

    @dataclasses.dataclass
    class Lin:
        coupling = C
        rigid_stiffness = S
        rigid_force = force

    responses = -np.linalg.solve(K, np.column_stack([residual, C]))
    dx, dq, _ = bordered_step(responses, Lin(), row)
    whole = np.block([[K, C], [np.vstack([row.by_x, C.T[1:]]), np.vstack([row.by_q, S[1:]])]])
    expected = np.linalg.solve(whole, -np.concatenate([residual, [row.error], -force[1:]]))
    np.testing.assert_allclose(np.concatenate([dx, dq]), expected, rtol=1e-9)
