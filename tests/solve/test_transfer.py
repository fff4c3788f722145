"""A state carried over to another mesh is a start that leads to that mesh's own solution."""

import dataclasses

import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.core.failures import NotConverged
from jaxclamp.fem.tube import closed_positions
from jaxclamp.potential.energy import State
from jaxclamp.potential.model import build_model
from jaxclamp.solve import warm as warm_start
from jaxclamp.solve.clamping import inflate
from jaxclamp.solve.stops import Until
from jaxclamp.solve.transfer import transferred


def on_mesh(scene, **counts):
    return dataclasses.replace(scene, mesh=dataclasses.replace(scene.mesh, **counts))


@pytest.fixture(scope="module")
def coarse():
    counts = {"circumferential": 6, "axial": 9, "radial": (2, 2)}
    scene = on_mesh(jc.load_scene("human-lad", fidelity="seed"), **counts)
    return jc.clamp(scene)


def test_onto_the_same_mesh_nothing_changes(coarse):
    state = coarse.states[-1].state
    again = transferred(state, coarse.model, coarse.model)
    np.testing.assert_allclose(again.x, state.x, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(again.p, state.p, rtol=1e-14)


@pytest.mark.parametrize(
    "mesh",
    [
        {"circumferential": 12, "axial": 17, "radial": (3, 4)},
        {"circumferential": 4, "axial": 5, "radial": (1, 1)},
        {"axial_grading": 0.5, "circumferential_grading": 1.0},
        {"axial_grading": 0.4, "circumferential_grading": 0.25},
        {"radial": (2, 4), "radial_grading": 3.0},
        {"element": "q2p1"},
    ],
    ids=["finer", "coarser", "graded", "graded, ending by rounding", "graded through", "quadratic"],
)
@pytest.mark.parametrize("back", [False, True])
def test_a_round_tube_stays_round(coarse, mesh, back):
    """Akima's splines are of third order: 6 elements to a quarter circle leave 2e-3 of its radius.

    Of 4 elements, on the way back from the coarser mesh, they leave some 1e-2.
    """
    old = coarse.model
    new = build_model(on_mesh(coarse.scene, **mesh))
    if back:
        old, new = new, old
    artery = coarse.scene.artery
    tube = State(
        x=closed_positions(old.mesh, old.scene.mesh, artery),
        p=np.ones((len(old.discretisation.stencils.modes), old.mesh.n_cells)),
        q=coarse.states[0].state.q,
    )
    wanted = closed_positions(new.mesh, new.scene.mesh, artery)
    moved = transferred(tube, old, new)
    tolerance = 2e-3 if old.mesh.grid[1] > 5 else 1e-2
    np.testing.assert_allclose(moved.x, wanted, atol=tolerance * float(np.max(np.abs(wanted[:, 0]))))
    np.testing.assert_allclose(moved.p[0], 1.0, rtol=1e-14)
    planes = new.mesh.plane(1, 0), new.mesh.plane(1, -1), new.mesh.plane(2, 0)
    for axis, plane in zip((1, 0, 2), planes, strict=True):
        np.testing.assert_allclose(moved.x[plane, axis], 0.0, atol=1e-15 + 1e-12 * artery.length)


def test_pressures_keep_to_their_layer(coarse):
    old, new = coarse.model, build_model(on_mesh(coarse.scene, radial=(3, 1), axial=14))
    state = coarse.states[0].state
    (_, last), _ = old.mesh.layer_cells
    p = np.where(np.arange(old.mesh.n_cells) < last, 1.0, 2.0)[None]
    moved = np.asarray(transferred(dataclasses.replace(state, p=p), old, new).p)[0]
    (_, last), _ = new.mesh.layer_cells
    assert set(moved[:last]) == {1.0}
    assert set(moved[last:]) == {2.0}


@pytest.mark.parametrize(
    "mesh",
    [
        {"circumferential": 9, "axial": 16, "radial": (3, 2)},
        {"circumferential": 5, "axial": 7, "radial": (2, 1)},
        {"axial_grading": 1.5},
    ],
    ids=["finer", "coarser", "graded"],
)
def test_leads_to_the_solution_that_a_cold_start_finds(coarse, mesh):
    scene = on_mesh(coarse.scene, **mesh)
    cold, warm = jc.clamp(scene), jc.clamp(scene, guess=coarse)
    assert len(warm.states) == 3, "the guess was dropped"
    assert warm.solver["newton_iterations"] < 0.5 * cold.solver["newton_iterations"]
    for a, b in zip((*cold.states[:2], cold.states[-1]), warm.states, strict=True):
        np.testing.assert_allclose(a.state.x, b.state.x, rtol=0.0, atol=1e-7)
    assert warm.final["force_balance_error"] < 1e-8


@pytest.mark.slow
def test_with_harder_contact_on_the_way(coarse):
    """Another mesh and other floats at once."""
    scene = jc.replace(on_mesh(coarse.scene, axial=14), "contact.stiffness", 6000.0)
    cold, warm = jc.clamp(scene), jc.clamp(scene, guess=coarse)
    assert len(warm.states) == 3, "the guess was dropped"
    np.testing.assert_allclose(warm.states[-1].state.x, cold.states[-1].state.x, rtol=0.0, atol=1e-7)


def test_between_elements():
    """From the linear element to the quadratic one, and back."""
    scene = on_mesh(jc.load_scene("human-lad"), circumferential=4, axial=6, radial=(1, 1))
    linear = jc.clamp(scene)
    quadratic = jc.clamp(on_mesh(scene, element="q2p1"), guess=linear)
    again = jc.clamp(scene, guess=quadratic)
    assert len(quadratic.states) == len(again.states) == 3, "the guess was dropped"
    np.testing.assert_allclose(again.states[-1].state.x, linear.states[-1].state.x, rtol=0.0, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("stop", ["travel_mm=1.9", "force_N=0.2"])
def test_at_other_stops(coarse, stop):
    def scene(axial):
        counts = ("mesh.circumferential=6", f"mesh.axial={axial}", "mesh.radial=[2, 2]")
        return jc.load_scene("human-lad", [*counts, f"stop={{{stop}}}"])

    guess = jc.clamp(scene(9))
    cold, warm = jc.clamp(scene(13)), jc.clamp(scene(13), guess=guess)
    assert len(warm.states) == 3, "the guess was dropped"
    np.testing.assert_allclose(warm.states[-1].state.x, cold.states[-1].state.x, rtol=0.0, atol=1e-6)


def test_a_state_that_is_too_far_off_is_settled_first(coarse, monkeypatch):
    """Where Newton's method fails at the stop, it goes on from rest under the guess's own jaw."""
    scene, failed = on_mesh(coarse.scene, axial=14), []

    def first_fails(system, state, step, *known):
        if isinstance(step.closing, Until) and not failed:
            failed.append(step)
            raise NotConverged("for the test")
        return newton(system, state, step, *known)

    cold, newton = jc.clamp(scene), warm_start.newton
    monkeypatch.setattr(warm_start, "newton", first_fails)
    warm = jc.clamp(scene, guess=coarse)
    assert failed
    assert len(warm.states) == 3, "the guess was dropped"
    np.testing.assert_allclose(warm.states[-1].state.x, cold.states[-1].state.x, rtol=0.0, atol=1e-7)


def test_a_distant_guess_of_another_title_and_solver(coarse):
    """Scenes in between have the target's static choices."""
    scene = jc.replace(coarse.scene, "clamp.jaw.radius", 1.5)
    solver = dataclasses.replace(scene.solver, tolerance=1e-10, linear_solver="splu")
    scene = dataclasses.replace(scene, title="another", solver=solver)
    halfway = warm_start.between(coarse.scene, scene, 0.5)
    assert (halfway.title, float(halfway.clamp.jaw.radius)) == ("another", 2.25)
    warm = jc.clamp(scene, guess=coarse)
    np.testing.assert_allclose(warm.states[-1].state.x, jc.clamp(scene).states[-1].state.x, atol=1e-6)


def test_from_a_guess_without_its_clamp(coarse):
    body = inflate(coarse.scene)
    scene = on_mesh(coarse.scene, axial=12)
    cold, warm = jc.clamp(scene), jc.clamp(scene, guess=body)
    assert len(warm.states) > 5, "the closing is walked"
    np.testing.assert_allclose(warm.states[-1].state.x, cold.states[-1].state.x, rtol=0.0, atol=1e-7)


def test_without_its_clamp(coarse):
    scene = on_mesh(coarse.scene, axial=12)
    cold, warm = inflate(scene), inflate(scene, guess=coarse)
    np.testing.assert_allclose(warm.states[-1].state.x, cold.states[-1].state.x, rtol=0.0, atol=1e-8)
