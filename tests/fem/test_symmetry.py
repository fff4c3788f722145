"""One scene as 1/8, 1/4, 1/2 and whole: the same answer, and what the value itself says."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.fem.symmetry import Symmetry
from jaxclamp.fem.tube import build_tube, closed_positions, supports
from jaxclamp.potential.model import build_model

CHOICES = ("xyz", "yz", "xz", "xy", "z", "y", "x", "none")
COUNTS = ["mesh.circumferential=3", "mesh.axial=5", "mesh.radial=[1, 1]", "mesh.circumferential_grading=0.4"]


def scene(choice: str, *others: str) -> jc.Scene:
    return jc.load_scene("human-lad", [*COUNTS, f"mesh.symmetry={choice}", "stop.occlusion=0.6", *others])


def symmetry(choice: str) -> Symmetry:
    return Symmetry("" if choice == "none" else choice)


@pytest.fixture(scope="module")
def eighth():
    return jc.clamp(scene("auto"))


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "choice",
    [
        pytest.param("yz", marks=SLOW),
        pytest.param("xz", marks=SLOW),
        pytest.param("z", marks=SLOW),
        pytest.param("none", marks=SLOW),
    ],
)
def test_the_same_scene_in_lower_symmetry(eighth, choice):
    """Every figure and the derivatives, to solver tolerance; the supports across carry nothing."""
    result = jc.clamp(scene(choice))
    assert result.to_dict()["model"]["symmetry"] == {2: "1/4", 1: "1/2", 0: "1"}[len(choice) % 4]
    assert result.solver["negative_pivots"] == 0
    for key in ("load_free", "physiological"):
        for name, value in eighth.to_dict()[key].items():
            assert result.to_dict()[key][name] == pytest.approx(value, rel=1e-9), name
    skipped = ("residual_mN", "force_balance_error", "lumen_overlap_mm", "peak_axial_stress_location_mm")
    for key, value in eighth.final.items():
        if key not in skipped and not isinstance(value, str):
            assert result.final[key] == pytest.approx(value, rel=1e-8), key
    place, there = (r.final["peak_axial_stress_location_mm"] for r in (eighth, result))
    for layer, expected in place.items():
        np.testing.assert_allclose(np.abs(there[layer]), np.abs(expected), atol=1e-7)
    for measure in (jc.smooth_peak_axial_stress("media"), jc.clamp_force(), jc.stored_energy()):
        pair = [jc.value_and_gradient(r, measure) for r in (eighth, result)]
        leaves = [np.concatenate([np.ravel(a) for a in jax.tree_util.tree_leaves(g)]) for _, g in pair]
        assert pair[1][0] == pytest.approx(pair[0][0], rel=1e-9)
        np.testing.assert_allclose(leaves[1], leaves[0], rtol=1e-6, atol=1e-9 * np.max(np.abs(leaves[0])))


@pytest.mark.slow
def test_a_whole_model_starts_from_a_whole_one_only(eighth):
    """Guesses of another symmetry are no neighbours; the answer is the same without."""
    warm = jc.clamp(scene("yz"), guess=eighth)
    assert warm.final["clamp_force_N"] == pytest.approx(eighth.final["clamp_force_N"], rel=1e-8)
    again = jc.clamp(dataclasses.replace(scene("z"), title="again"), guess=jc.clamp(scene("z")))
    assert again.solver["newton_iterations"] <= 1


def test_rounding_at_the_fold_is_no_contact():
    """Without the plane y = 0 nodes of the fold lie at +-1e-15: one walk, and errors are estimated."""
    few = jc.with_errors(jc.clamp(jc.replace(scene("xz"), "stop.occlusion", 0.3)))
    assert not few.every_term
    like = jc.clamp(jc.replace(scene("auto"), "stop.occlusion", 0.3))
    assert few.solver["newton_iterations"] < 1.5 * like.solver["newton_iterations"]
    assert few.errors["clamp_force_N"]["error"] > 0.0


@pytest.mark.parametrize("choice", CHOICES)
def test_a_whole_mesh_is_the_mirrored_eighth(choice):
    """Nodes of the model with all its mirror images are those of the eighth with its own."""

    def points(name: str) -> np.ndarray:
        s = scene(name)
        x = np.asarray(closed_positions(build_tube(s.mesh, s.clamp), s.mesh, s.artery))
        images = np.concatenate([x * signs for signs in symmetry(name).mirrors])
        rounded = np.round(images, 9) + 0.0
        return np.unique(rounded, axis=0)

    np.testing.assert_array_equal(points(choice), points("xyz"))


@pytest.mark.parametrize("choice", CHOICES)
def test_the_supports_leave_no_rigid_motion(choice):
    """Rigid translations and rotations all move a held degree of freedom; and none is held twice over."""
    s = scene(choice)
    mesh = build_tube(s.mesh, s.clamp)
    held = supports(mesh, s.mesh)
    x = np.asarray(closed_positions(mesh, s.mesh, s.artery))
    motions = [np.tile(e, (len(x), 1)) for e in np.eye(3)] + [np.cross(e, x) for e in np.eye(3)]
    on_supports = np.stack([m[held] for m in motions], axis=1)
    assert np.linalg.matrix_rank(on_supports, tol=1e-6) == 6
    if choice == "none":  # the ends' axial direction, and four lines across at each end
        assert held[:, 0].sum() == held[:, 1].sum() == 2 * 2 * mesh.grid[0]


@pytest.mark.parametrize("choice", CHOICES)
def test_stress_free_volumes_add_up(choice):
    """Also where the ring wraps: the last cells end where the first begin."""
    volume = lambda s: sum(float(g.solid.dV.sum()) for g in build_model(s).potential.layers)
    parts = symmetry(choice).parts
    assert parts * volume(scene(choice)) == pytest.approx(8.0 * volume(scene("xyz")), rel=1e-12)


def test_what_the_value_says():
    eighth, whole = Symmetry("xyz"), Symmetry("")
    assert (eighth.share, eighth.parts, eighth.parts_of_a_jaw, eighth.parts_of_a_section) == ("1/8", 8, 4, 4)
    assert (whole.share, whole.parts, whole.parts_of_a_jaw, whole.parts_of_a_section) == ("1", 1, 0.5, 1)
    assert Symmetry("yz").quarters == (0, 2)
    assert Symmetry("xz").quarters == (-1, 1)
    assert whole.wraps
    assert not eighth.wraps
    for choice in CHOICES:
        of = symmetry(choice)
        assert len(of.mirrors) == of.parts
        assert len(of.words) > 20
