"""General blocks through public doors: a strip, an extruded block, and a ring, against closed forms."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import jaxclamp as jc
from jaxclamp.physics.contact import Contact
from jaxclamp.physics.jaws import Cylinder
from jaxclamp.physics.materials import NeoHookean
from jaxclamp.potential.densities import rigid
from jaxclamp.potential.energy import energy
from jaxclamp.solve.blocks import OPEN, brick, reactions, settle, stress
from jaxclamp.solve.clamping import inflate
from tube import Sector
from walks import mesh, tube_scene

C, BULK = 10.0, 1e6
RING = Sector(2.0, 0.74, 0.0, 27.0, k1=0.64, k2=3.54, fibre_angle=10.0)


def soft(**constants) -> NeoHookean:
    return NeoHookean(**{"c": np.float64(C), "bulk": np.float64(BULK)} | constants)


def on(X: np.ndarray, *planes: tuple[int, float]) -> np.ndarray:
    """Held normal to some planes (axis, place)."""
    held = np.zeros(X.shape, bool)
    for axis, place in planes:
        held[np.isclose(X[:, axis], place), axis] = True
    return held


@pytest.mark.parametrize("element", ["q1p0", pytest.param("q2p1", marks=pytest.mark.slow)])
def test_a_strip_between_smooth_grips(element):
    """Uniaxial stretch: sigma = c (l**2 - 1/l) for an incompressible neo-Hookean solid."""
    stretch, width, thickness = 1.5, 2.0, 0.5
    strip = brick(
        element,
        (1,),
        2,
        3,
        lambda u: u * [thickness, width, 4.0],
        (soft(),),
        lambda X: on(X, (0, 0.0), (1, 0.0), (2, 0.0), (2, 4.0)),
    )
    target = strip.positions * [1.0, 1.0, stretch]
    found = settle(strip, target, steps=2)
    expected = C * (stretch**2 - 1.0 / stretch)
    sigma = stress(strip, found.state)
    np.testing.assert_allclose(sigma[2, 2], expected, rtol=1e-4)  # volume changes by stress / 3 bulk
    np.testing.assert_allclose(sigma[0, 0], 0.0, atol=1e-7 * expected)
    pulled = np.isclose(strip.positions[:, 2], 4.0)
    force = reactions(strip, found.state)[pulled, 2].sum()
    assert force == pytest.approx(expected * width * thickness / stretch, rel=1e-4)


def test_a_strip_clamped_by_rough_grips_waists():
    """Ends held in all directions: the force lies between those of a slack strip and of one held aside."""
    stretch = 1.3

    def rough(X: np.ndarray) -> np.ndarray:
        ends = np.isclose(X[:, 2], 0.0) | np.isclose(X[:, 2], 4.0)
        return np.repeat(ends[:, None], 3, axis=1)

    strip = brick("q2p1", (1,), 3, 6, lambda u: u * [0.5, 2.0, 4.0], (soft(),), rough)
    found = settle(strip, strip.positions * [1.0, 1.0, stretch], steps=2)
    force = reactions(strip, found.state)
    pulled = np.isclose(strip.positions[:, 2], 4.0)
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-7)
    slack, planar = (C * (stretch - stretch**-n) for n in (2, 3))
    assert slack < force[pulled, 2].sum() < planar
    middle = np.isclose(strip.positions[:, 2], 2.0) & np.isclose(strip.positions[:, 1], 2.0)
    assert np.all(np.asarray(found.state.x)[middle, 1] < 1.98)


def test_an_extruded_block_squeezed_in_plane_strain():
    """One cell deep, held front and back: sigma_y = c (l**2 - l**-2) in plane strain."""
    share = 0.8
    block = brick(
        "q1p0",
        (3,),
        4,
        1,
        lambda u: np.stack([u[:, 1], u[:, 0], 0.2 * u[:, 2]], axis=1) * [-3.0, 2.0, 1.0],
        (soft(),),
        lambda X: on(X, (0, 0.0), (1, 0.0), (1, 2.0), (2, 0.0), (2, 0.2)),
    )
    found = settle(block, block.positions * [1.0, share, 1.0])
    np.testing.assert_allclose(stress(block, found.state)[1, 1], C * (share**2 - share**-2), rtol=1e-4)


@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_a_block_under_a_cylinder(spread):
    """The jaw's force is what the held face carries; constants may vary from point to point."""
    rng = np.random.default_rng(2)
    c = C * (1.0 + spread * rng.uniform(-1.0, 1.0, (8, 4 * 2 * 5)))
    block = brick(
        "q1p0",
        (4,),
        2,
        5,
        lambda u: np.stack([0.5 - u[:, 1], u[:, 0], 3.0 * (u[:, 2] - 0.5)], axis=1),
        (soft(c=c, bulk=np.float64(1e4)),),
        lambda X: np.repeat(np.isclose(X[:, 1], 0.0)[:, None], 3, axis=1),
        jaw=(
            Cylinder(radius=np.float64(1.0)),
            Contact(stiffness=np.float64(2e3), smoothing=np.float64(0.01)),
        ),
    )
    found = settle(block, block.positions, jaw_height=0.8, steps=3)
    force = float(found.lin.jaw_force)
    assert force > 5.0
    assert reactions(block, found.state)[block.held[:, 1], 1].sum() == pytest.approx(force, rel=1e-9)


def test_constants_of_each_point_in_an_artery():
    """A wall whose points all have the layer's constants, one by one, is the layer's wall."""
    ring = tube_scene((RING,), 4.0, 1.1, mesh("q1p0", 4, 2, (3,)))
    same = inflate(ring)
    n_q, n_cells = 8, 4 * 2 * 3
    everywhere = jc.replace(ring, "artery.layers[0].material.c", np.full((n_q, n_cells), RING.c))
    assert inflate(everywhere).final["axial_stress_at_P_kPa"] == pytest.approx(
        same.final["axial_stress_at_P_kPa"], rel=1e-10
    )
    stiffer = jc.replace(ring, "artery.layers[0].material.c", np.full((n_q, n_cells), 1.5 * RING.c))
    radius = inflate(stiffer).to_dict()["physiological"]["lumen_radius_mm"]
    alike = inflate(tube_scene((dataclasses.replace(RING, c=1.5 * RING.c),), 4.0, 1.1, ring.mesh))
    assert radius == pytest.approx(alike.to_dict()["physiological"]["lumen_radius_mm"], rel=1e-10)
    assert radius < 0.99 * same.to_dict()["physiological"]["lumen_radius_mm"]


def test_a_ring_under_a_wide_flat_jaw():
    """A short artery under a very wide jaw is a ring in generalised plane strain: nothing varies along it."""
    wide = 'clamp.jaw={shape="flat", half_width_mm=30.0, edge_radius_mm=1.0}'
    counts = ["mesh.circumferential=6", "mesh.axial=2", "mesh.radial=[2, 1]", "mesh.axial_grading=0.0"]
    result = jc.clamp(
        jc.load_scene("human-lad", [*counts, wide, "artery.length_mm=2.0", "stop.occlusion=0.7"])
    )
    x = np.asarray(result.states[-1].state.x).reshape(*result.model.mesh.grid[::-1], 3)
    np.testing.assert_allclose(
        x[1:, ..., :2], np.broadcast_to(x[:1, ..., :2], x[1:, ..., :2].shape), atol=1e-8
    )
    np.testing.assert_allclose(x[-1, ..., 2], 1.1, rtol=1e-12)


def negative_modes(element: str, elongation: float, ratio: float) -> int:
    """Of a block compressed in plane strain to a stretch ratio (along its free surface over normal to it)."""
    cells = np.array([6, 6, 2])
    compressible = soft(bulk=np.float64(1e4 * C))
    block = brick(
        element,
        (cells[0],),
        cells[1],
        cells[2],
        lambda u: u * cells * [1.0, 1.0, elongation],
        (compressible,),
        lambda X: on(X, (0, 0.0), (1, 0.0), (1, 6.0), (2, 0.0), (2, 2.0 * elongation)),
    )

    def pull(normal: float) -> float:
        """On the free surface, over c: from psi = c/2 (J**(-2/3) I1 - 3) + bulk/2 (J - 1)**2."""
        along = ratio * normal
        J, I1 = along * normal, along**2 + normal**2 + 1.0
        return float(J ** (-2 / 3) * (normal - I1 / (3.0 * normal)) + 1e4 * (J - 1.0) * along)

    normal = scipy.optimize.brentq(pull, 0.9 / np.sqrt(ratio), 1.1 / np.sqrt(ratio))
    x = block.positions * [normal, ratio * normal, 1.0]
    free = jnp.asarray(np.flatnonzero(~block.held))
    q = rigid(OPEN)

    def stored(u):
        return energy(block.potential, jnp.asarray(x).ravel().at[free].add(u).reshape(x.shape), q)

    u = jnp.zeros(len(free))
    np.testing.assert_allclose(jax.grad(stored)(u), 0.0, atol=1e-7 * C)
    return int(np.sum(np.linalg.eigvalsh(jax.hessian(stored)(u)) < -1e-9 * C))


@pytest.mark.parametrize("elongation", [1.0, 4.0, 10.0])
def test_a_compressed_surface_is_stable_up_to_its_limit(elongation):
    """A free neo-Hookean surface in plane strain has waves below a stretch ratio of 0.2956 (Biot 1963)."""
    assert negative_modes("q1pz", elongation, 0.2956) == 0
    assert negative_modes("q1pz", elongation, 0.2) > 0


def test_cells_with_a_mean_volume_alone_buckle_into_waves_along_the_artery():
    """Why q1pz is there: long cells of q1p0 have waves of no mean dilatation far above the limit."""
    assert negative_modes("q1p0", 1.0, 0.2956) == 0
    assert negative_modes("q1p0", 4.0, 0.5) > 0
    assert negative_modes("q1p0", 10.0, 0.6) > 0
