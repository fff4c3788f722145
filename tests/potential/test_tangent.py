"""Residual, tangent and jaw terms against the potential that they come from."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.fem.tube import closed_positions, supports
from jaxclamp.physics.jaws import Cylinder
from jaxclamp.physics.materials import GOH, HGO, NeoHookean
from jaxclamp.potential.energy import State, stored_energy, with_equilibrium_pressure
from jaxclamp.potential.energy import energy as whole_energy
from jaxclamp.potential.model import build_model
from jaxclamp.potential.tangent import advance, linearise
from jaxclamp.scenes.scene import Layer
from jaxclamp.solve.linear_solvers import LinearSolver, full_matrix
from walks import mesh

PRESSURE = 13.33
FAR = 1e3


@jax.jit
def derivatives(potential, x, jaw_height, pressure, v):
    """The potential, its gradient in x, and the derivative of the gradient along v."""
    loaded, q = potential.at_pressure(pressure), jnp.reshape(jaw_height, 1)
    of_x = lambda y: jax.value_and_grad(whole_energy, argnums=1)(loaded, y, q)
    (value, gradient), (_, along) = jax.jvp(of_x, (x,), (v,))
    return value, gradient, along


def forces(body, x, jaw_height, pressure):
    """The potential and its gradient in x."""
    return derivatives(body, x, jaw_height, pressure, jnp.zeros_like(x))[:2]


def change_of_forces(body, x, jaw_height, pressure, v):
    """Derivative of the gradient along v."""
    return derivatives(body, x, jaw_height, pressure, v)[2]


def wall(laws: int) -> tuple[Layer, ...]:
    """Three layers with different opening angles: of HGO, GOH and neo-Hookean, or all of HGO."""
    materials = (
        HGO(c=27.0, k1=2.0, k2=3.5, fibre_angle=math.radians(10.0), bulk=1e4),
        GOH(c=15.0, k1=4.0, k2=6.0, dispersion=0.1, fibre_angle=math.radians(35.0), bulk=8e3),
        NeoHookean(c=6.0, bulk=6e3),
    )
    if laws == 1:
        materials = tuple(dataclasses.replace(materials[0], c=m.c, bulk=m.bulk) for m in materials)
    sectors = ((3.30, 0.25, 160.0), (3.46, 0.25, 150.0), (3.48, 0.25, 120.0))
    return tuple(
        Layer(
            name=f"layer {i}",
            inner_radius=radius,
            thickness=thickness,
            opening_angle=math.radians(angle),
            material=material,
        )
        for i, (material, (radius, thickness, angle)) in enumerate(zip(materials, sectors, strict=True))
    )


class Setup:
    """A coarse three-layer artery in a random admissible state, jaw pressed in, blood inside."""

    def __init__(self, element: str, laws: int) -> None:
        scene = jc.load_scene("human-lad")
        artery = dataclasses.replace(scene.artery, length=6.0, layers=wall(laws))
        self.scene = dataclasses.replace(
            scene,
            artery=artery,
            clamp=dataclasses.replace(scene.clamp, jaw=Cylinder(radius=2.0)),
            mesh=mesh(element, 2, 2, (1, 1, 1), contact_points=3),
        )
        self.model = build_model(self.scene)
        self.potential, self.mesh, self.pattern = self.model.potential, self.model.mesh, self.model.pattern
        self.held = supports(self.mesh, self.scene.mesh)
        self.free = np.flatnonzero(~self.held.ravel())
        closed = np.asarray(closed_positions(self.mesh, self.scene.mesh, artery))
        rng = np.random.default_rng(3)
        size = 0.015 if element == "q2p1" else 0.04
        moved = (
            closed * np.array([1.05, 0.98, 1.0]) + size * rng.uniform(-1.0, 1.0, closed.shape) * ~self.held
        )
        self.x = jnp.asarray(moved)
        self.jaw_height = jnp.asarray(float(moved[:, 1].max()) - 0.3)
        self.state = with_equilibrium_pressure(self.potential, self.x, self.jaw_height[None])
        self.pressure = jnp.asarray(PRESSURE)
        self.loaded = self.potential.at_pressure(self.pressure)
        self.lin = linearise(self.loaded, self.state, self.pattern)

    def residual(self, x, jaw_height=None) -> np.ndarray:
        """d Pi/dx on the unknowns."""
        height = self.jaw_height if jaw_height is None else jaw_height
        return np.asarray(forces(self.potential, x, height, self.pressure)[1]).ravel()[self.free]

    def on_nodes(self, v: np.ndarray) -> jax.Array:
        """Unknowns (n_free,) as a field (n_nodes, 3), zero at the supports."""
        field = np.zeros(self.x.size)
        field[self.free] = v
        return jnp.asarray(field.reshape(self.x.shape))


@pytest.fixture(
    scope="module",
    params=[("q1p0", 3), ("q1pz", 3), ("q2p1", 1)],
    ids=["q1p0 three laws", "q1pz three laws", "q2p1 one law"],
)
def setup(request):
    return Setup(*request.param)


def test_the_state_is_a_hard_one(setup):
    """All terms are at work: pressure, contact, volume change, and the cells are distorted but sound."""
    lin = setup.lin
    assert 0.5 < lin.J_min < 0.98
    assert lin.jaw_force > 100.0
    assert np.max(np.abs(setup.state.p)) > 100.0
    assert lin.volume_error < 1e-12


def test_energy_and_residual_are_those_of_the_potential(setup):
    energy, gradient = forces(setup.potential, setup.x, setup.jaw_height, setup.pressure)
    gradient = np.asarray(gradient).ravel()
    assert setup.lin.energy == pytest.approx(float(energy), rel=1e-12)
    size = np.linalg.norm(gradient)
    np.testing.assert_allclose(setup.lin.residual, gradient[setup.free], rtol=0.0, atol=1e-12 * size)
    assert setup.lin.reactions == pytest.approx(np.linalg.norm(gradient[setup.held.ravel()]), rel=1e-11)


def test_residual_of_the_condensed_system_ignores_the_stored_pressure(setup):
    """With other pressures stored the condensed residual and energy are still those of the potential."""
    other = dataclasses.replace(setup.state, p=setup.state.p + 50.0)
    lin = linearise(setup.loaded, other, setup.pattern)
    size = np.linalg.norm(setup.lin.residual)
    np.testing.assert_allclose(lin.residual, setup.lin.residual, rtol=0.0, atol=1e-11 * size)
    assert lin.energy == pytest.approx(float(setup.lin.energy), rel=1e-9)
    assert lin.volume_error > 1e-3


def test_tangent_is_the_derivative_of_the_residual(setup):
    """Along random directions by automatic differentiation, and by central differences."""
    K = full_matrix(setup.pattern, setup.lin.values)
    rng = np.random.default_rng(5)
    for _ in range(4):
        v = rng.normal(size=setup.free.size)
        field = setup.on_nodes(v)
        along = np.asarray(
            change_of_forces(setup.potential, setup.x, setup.jaw_height, setup.pressure, field)
        ).ravel()[setup.free]
        np.testing.assert_allclose(K @ v, along, rtol=0.0, atol=1e-12 * np.linalg.norm(along))
        h = 1e-6
        difference = (setup.residual(setup.x + h * field) - setup.residual(setup.x - h * field)) / (2.0 * h)
        np.testing.assert_allclose(K @ v, difference, rtol=0.0, atol=1e-6 * np.linalg.norm(along))


def test_sparse_tangent_is_the_dense_hessian(setup):
    """Every entry, also those that must be zero; the pattern holds each pair once, sorted, with diagonal."""
    pattern, n = setup.pattern, setup.free.size
    rows = np.repeat(np.arange(n), np.diff(pattern.indptr))
    assert pattern.n == n
    assert np.all(pattern.indices >= rows)
    assert np.all(pattern.indices[pattern.indptr[:-1]] == np.arange(n))
    assert len(np.unique(rows * n + pattern.indices)) == len(pattern.indices) == len(setup.lin.values)
    K = full_matrix(pattern, setup.lin.values).toarray()
    np.testing.assert_array_equal(K, K.T)
    columns = range(n) if n < 200 else range(0, n, 9)
    for column in columns:
        unit = setup.on_nodes(np.eye(1, n, column)[0])
        exact = np.asarray(
            change_of_forces(setup.potential, setup.x, setup.jaw_height, setup.pressure, unit)
        ).ravel()[setup.free]
        np.testing.assert_allclose(K[:, column], exact, rtol=0.0, atol=1e-12 * np.max(np.abs(K)))


def test_step_is_newtons_on_positions_and_pressures(setup):
    """From pressures out of equilibrium: the linearised mixed equations hold after one step of (x, p).

    Pi(x, p) = potential(x) - 1/2 (p - p*(x))' M (p - p*(x)), as Pi is quadratic in p with Hessian -M
    and its maximum over p, at p*(x), is the potential.
    """
    stiffness = jnp.concatenate([group.volume.stiffness for group in setup.potential.layers], axis=-1)
    M = jnp.linalg.inv(jnp.moveaxis(stiffness, -1, 0))

    def below(x, p):
        away = p - with_equilibrium_pressure(setup.potential, x, setup.state.q).p
        return -0.5 * jnp.einsum("mc,cmn,nc->", away, M, away)

    @jax.jit
    def linearised(x, p, dx, dp):
        return jax.jvp(jax.grad(below, argnums=(0, 1)), (x, p), (dx, dp))

    rng = np.random.default_rng(6)
    start = dataclasses.replace(
        setup.state, p=setup.state.p + jnp.asarray(rng.normal(scale=30.0, size=setup.state.p.shape))
    )
    lin = linearise(setup.loaded, start, setup.pattern)
    solver = LinearSolver(setup.pattern, "splu")
    solver.factor(lin.values)
    dx = solver.solve(-lin.residual[:, None])[:, 0]
    full = advance(setup.potential, start, dx, np.zeros(1), 1.0)
    step = setup.on_nodes(dx)
    (fx, fp), (dfx, dfp) = linearised(start.x, start.p, step, full.p - start.p)
    _, gradient, along = derivatives(setup.potential, start.x, setup.jaw_height, setup.pressure, step)
    fx, dfx = fx + gradient, dfx + along
    fx, dfx = np.asarray(fx).ravel()[setup.free], np.asarray(dfx).ravel()[setup.free]
    assert np.linalg.norm(fx + dfx) < 1e-9 * np.linalg.norm(fx)
    assert np.linalg.norm(fp + dfp) < 1e-10 * np.linalg.norm(fp)
    half = advance(setup.potential, start, dx, np.array([-0.3]), 0.5)
    np.testing.assert_allclose(half.x, 0.5 * (start.x + full.x), rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(half.p, 0.5 * (start.p + full.p), rtol=1e-12)
    assert float(half.jaw_height) == pytest.approx(float(start.jaw_height) - 0.15, abs=1e-14)


def test_jaw_terms_are_derivatives_with_respect_to_its_height(setup):
    """Central differences of energy, residual and force."""
    h = 1e-5
    up, down = setup.jaw_height + h, setup.jaw_height - h
    energy = [float(forces(setup.potential, setup.x, d, setup.pressure)[0]) for d in (up, down)]
    assert setup.lin.jaw_force == pytest.approx(-(energy[0] - energy[1]) / (2.0 * h), rel=1e-6)
    coupling = (setup.residual(setup.x, up) - setup.residual(setup.x, down)) / (2.0 * h)
    size = np.linalg.norm(setup.lin.coupling[:, 0])
    assert size > 0.0
    np.testing.assert_allclose(setup.lin.coupling[:, 0], coupling, rtol=0.0, atol=1e-6 * size)
    force = [
        linearise(setup.loaded, State(x=setup.x, p=setup.state.p, q=d[None]), setup.pattern).jaw_force
        for d in (up, down)
    ]
    assert setup.lin.rigid_stiffness[0, 0] == pytest.approx(-(force[0] - force[1]) / (2.0 * h), rel=1e-6)


def test_wall_is_frame_indifferent(setup):
    """A rigid rotation changes no energy of the wall and turns its forces."""
    rng = np.random.default_rng(8)
    Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    Q *= np.sign(np.linalg.det(Q))
    shift = np.array([0.3, -0.2, 0.5])
    of_the_wall = jax.jit(jax.value_and_grad(stored_energy, argnums=1))
    energy, gradient = of_the_wall(setup.potential, setup.x)
    turned, turned_gradient = of_the_wall(setup.potential, setup.x @ Q.T + shift)
    assert float(turned) == pytest.approx(float(energy), rel=1e-12)
    size = np.max(np.abs(gradient))
    assert size > 1.0
    np.testing.assert_allclose(turned_gradient, np.asarray(gradient) @ Q.T, rtol=0.0, atol=1e-11 * size)


def test_rigid_motions_need_no_force(setup):
    """The forces of the wall on a free artery have no resultant and no moment."""
    gradient = np.asarray(forces(setup.potential, setup.x, jnp.asarray(FAR), jnp.asarray(0.0))[1])
    size = np.abs(gradient).sum()
    np.testing.assert_allclose(gradient.sum(axis=0), 0.0, atol=1e-12 * size)
    np.testing.assert_allclose(np.cross(setup.x, gradient).sum(axis=0), 0.0, atol=1e-11 * size)


def lumen_volume(setup, x) -> float:
    """Volume under pressure: the potential is linear in it."""
    without, with_unit = (
        float(forces(setup.potential, x, jnp.asarray(FAR), jnp.asarray(p))[0]) for p in (0.0, 1.0)
    )
    return without - with_unit


def test_lumen_volume_of_a_polygonal_cylinder(setup):
    """Straight edges enclose triangles; a parabola adds 2/3 of chord times sagitta (Archimedes)."""
    closed = np.asarray(closed_positions(setup.mesh, setup.scene.mesh, setup.scene.artery))
    radius = np.hypot(closed[0, 0], closed[0, 1])
    n, half_length = setup.scene.mesh.circumferential, 3.0
    angle = 0.5 * math.pi / n
    area = n * 0.5 * radius**2 * math.sin(angle)
    if setup.mesh.element.order == 2:
        chord, sagitta = 2.0 * radius * math.sin(angle / 2.0), radius * (1.0 - math.cos(angle / 2.0))
        area += n * 2.0 / 3.0 * chord * sagitta
    assert lumen_volume(setup, jnp.asarray(closed)) == pytest.approx(area * half_length, rel=1e-11)


def test_pressure_force_is_pressure_times_deformed_area_normal(setup):
    """At every unknown of the lumen: -p int N_a n da over the deformed surface, by a rule of its own."""
    gradients = [
        np.asarray(forces(setup.potential, setup.x, jnp.asarray(FAR), jnp.asarray(p))[1])
        for p in (0.0, PRESSURE)
    ]
    found = gradients[1] - gradients[0]
    m = setup.mesh.element.order
    nodes = np.linspace(-1.0, 1.0, m + 1)
    points, weights = np.polynomial.legendre.leggauss(6)
    values = np.array(
        [[np.prod([(s - b) / (a - b) for b in nodes if b != a]) for a in nodes] for s in points]
    )
    slopes = np.array([np.polyval(np.polyder(np.polyfit(nodes, row, m)), points) for row in np.eye(m + 1)]).T
    grid = setup.mesh.grid
    lumen = np.array([[setup.mesh.node(0, c, z) for z in range(grid[2])] for c in range(grid[1])])
    x, expected = np.asarray(setup.x), np.zeros_like(found)
    for c in range(0, grid[1] - 1, m):
        for z in range(0, grid[2] - 1, m):
            facet = lumen[c : c + m + 1, z : z + m + 1]
            along = np.einsum("pa,qb,abk->pqk", slopes, values, x[facet])
            up = np.einsum("pa,qb,abk->pqk", values, slopes, x[facet])
            part = np.einsum("p,q,pa,qb,pqk->abk", weights, weights, values, values, np.cross(along, up))
            np.add.at(expected, facet, -PRESSURE * part)
    pushed = np.zeros_like(setup.held)
    pushed[lumen.ravel()] = ~setup.held[lumen.ravel()]
    assert np.linalg.norm(expected[pushed]) > 10.0
    # towards larger radius lowers the potential
    middle = setup.mesh.node(0, grid[1] // 2, grid[2] // 2)
    assert found[middle, :2] @ x[middle, :2] < 0.0
    np.testing.assert_allclose(
        found[pushed], expected[pushed], rtol=0.0, atol=1e-10 * np.linalg.norm(expected[pushed])
    )
    others = np.ones(len(x), bool)
    others[lumen.ravel()] = False
    np.testing.assert_allclose(found[others], 0.0, atol=1e-9)
