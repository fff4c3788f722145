"""Nested meshes: the path on a coarser mesh, body and stop on the scene's own."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.core.failures import NotConverged
from jaxclamp.pictures import plots
from jaxclamp.potential.tangent import linearise
from jaxclamp.show.report import page
from jaxclamp.solve import clamping, nested
from jaxclamp.solve.branch import CLOSING_PATH

MESH = ("mesh.circumferential=6", "mesh.axial=9", "mesh.radial=[3, 2]")


@functools.cache
def solved(path_mesh: str) -> jc.Result:
    return jc.clamp(jc.load_scene("human-lad", (*MESH, f"solver.path_mesh={path_mesh}")))


@pytest.fixture(autouse=True)
def small_meshes_nest(monkeypatch):
    """Of 270 elements, on one of 80."""
    monkeypatch.setattr(nested, "LEAST_CELLS", 60)


def test_the_answer_is_that_of_a_path_on_its_own_mesh():
    walked, own = solved("coarser"), solved("own")
    assert own.coarser is None
    assert walked.coarser is not None
    assert (walked.solver["branch"], own.solver["branch"]) == (CLOSING_PATH, CLOSING_PATH)
    for a, b in zip((*walked.states[:2], walked.states[-1]), (*own.states[:2], own.states[-1]), strict=True):
        np.testing.assert_allclose(a.state.x, b.state.x, rtol=0.0, atol=1e-7)
    for key in ("clamp_force_N", "lumen_area_mm2", "axial_stress_at_P_kPa", "axial_stress_ratio_at_P"):
        assert walked.final[key] == pytest.approx(own.final[key], rel=1e-8)


def test_each_state_is_an_equilibrium_of_the_mesh_that_it_names():
    result = solved("coarser")
    meshes = [record["mesh"] for record in result.history]
    assert meshes[0] == meshes[-1] == result.scene.mesh.words == "6 x 9 x (3 + 2)"
    assert set(meshes[1:-1]) == {result.coarser.scene.mesh.words} != {meshes[0]}
    stages = [record["stage"] for record in result.history]
    assert stages == ["physiological"] + ["clamping"] * (len(stages) - 1)
    assert [kept.stage for kept in result.states] == ["load-free", *stages]
    occlusions = [record["occlusion"] for record in result.history]
    assert occlusions == sorted(occlusions)
    for kept in result.states[1:]:
        lin = linearise(kept.model.potential, kept.state, kept.model.pattern)
        assert np.linalg.norm(lin.residual) < 1e-8 * lin.reactions
        load_free = result.load_free_like(kept)
        assert load_free.state.x.shape == kept.state.x.shape


def test_counts_are_of_both_meshes():
    result = solved("coarser")
    own = sum(kept.equilibrium.iterations for kept in (*result.states[:2], result.states[-1]))
    assert result.solver["newton_iterations"] >= result.coarser.solver["newton_iterations"] + own
    assert result.cost["wall_s"] > result.coarser.cost["wall_s"]


def test_gradients_are_those_of_its_own_mesh():
    peak = jc.smooth_peak_axial_stress("media")
    found = [
        float(jc.value_and_gradient(solved(way), peak)[1].clamp.jaw.radius) for way in ("coarser", "own")
    ]
    assert found[0] == pytest.approx(found[1], rel=1e-6)


def test_the_twin_of_the_error_estimate_is_the_mesh_of_the_path():
    near = jc.neighbours(solved("coarser"))
    assert near.twin is solved("coarser").coarser
    own = jc.neighbours(solved("own"))
    assert own.twin.scene.mesh.words == near.twin.scene.mesh.words
    assert own.twin.final["clamp_force_N"] == pytest.approx(near.twin.final["clamp_force_N"], rel=1e-8)


@pytest.mark.parametrize("why", ["the path fails", "another branch", "far away"])
def test_what_is_not_sure_is_walked_on_its_own_mesh(why, monkeypatch):
    real = clamping._from_nothing

    def spoilt(attempt, to_stop, start):
        coarse = attempt.model.scene.mesh.words != "6 x 9 x (3 + 2)"
        if coarse and why == "the path fails":
            raise jc.EquilibriumError("clamping", "somewhere", NotConverged("no"), "nothing")
        result = real(attempt, to_stop, start)
        if coarse and why == "another branch":
            return dataclasses.replace(result, solver=result.solver | {"branch": "another equilibrium: x"})
        return result

    monkeypatch.setattr(clamping, "_from_nothing", spoilt)
    if why == "far away":
        monkeypatch.setattr(clamping, "NEAR", 1e-4)
    result = jc.clamp(solved("coarser").scene)
    assert result.coarser is None
    assert {record["mesh"] for record in result.history} == {"6 x 9 x (3 + 2)"}
    assert result.final["clamp_force_N"] == pytest.approx(solved("own").final["clamp_force_N"], rel=1e-8)


def test_small_meshes_and_constants_of_each_point_are_walked_themselves(monkeypatch):
    scene = solved("own").scene
    walked = dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, path_mesh="coarser"))
    assert nested.to_walk_on(scene) is None
    assert nested.to_walk_on(walked) is not None
    points = jc.replace(walked, "artery.layers[0].material.c", np.full((8, 162), 27.0))
    assert nested.to_walk_on(points) is None
    monkeypatch.setattr(nested, "LEAST_CELLS", 100)
    assert nested.to_walk_on(walked) is None


def test_curves_are_of_one_mesh_and_the_step_to_the_scenes_own_is_explained():
    """The last state lies beside the curve, under a mark that the legend names."""
    for way in ("coarser", "own"):
        result = solved(way)
        path = result.coarser or result
        for draw in (plots.plot_force_travel, plots.plot_stress_at_P):
            figure = draw(result)
            key = "clamp_force_N" if draw is plots.plot_force_travel else "axial_stress_ratio_at_P"
            drawn = [line.get_xydata().tolist() for line in figure.axes[0].lines]
            curve = [[record["jaw_travel_mm"], record[key]] for record in path.history]
            assert curve in drawn
            assert [[result.final["jaw_travel_mm"], result.final[key]]] in drawn
            said = [t.get_text() for t in figure.axes[-1].get_legend().get_texts()]
            known = [f"curve: {path.scene.mesh.words} elements", f"A, F: {result.scene.mesh.words} elements"]
            assert (said[-2:] == known) == (way == "coarser")
        (key,) = plots.plot_sections(result).legends
        assert (path.scene.mesh.words in key.get_title().get_text()) == (way == "coarser")
        assert (f"walked on {path.scene.mesh.words}" in page(result, [])) == (way == "coarser")
