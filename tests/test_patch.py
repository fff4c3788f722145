"""Patch test: distorted elements reproduce a homogeneous deformation and its uniform stress."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.core.tensors import stacked
from jaxclamp.fem.tube import build_mesh
from jaxclamp.observe.stresses import cauchy_stress
from jaxclamp.physics.materials import HGO
from jaxclamp.potential import densities as energies
from jaxclamp.potential import tangent as assembly
from jaxclamp.potential.densities import Parameters, build_geometry, build_stencils
from jaxclamp.potential.tangent import (
    Body,
    State,
    advance,
    build_topology,
    linearise,
    piece,
    with_equilibrium_pressure,
)
from jaxclamp.solve.linear_solvers import LinearSolver
from walks import mesh

MATERIAL = HGO(c=27.0, k1=5.1, k2=1.0, fibre_angle=0.5, bulk=1e4)
FAR = 1e3

# det A = 1.0164: the uniform pressure is 164 kPa, both fibre families are stretched
A = np.array([[0.93, 0.11, -0.06], [-0.05, 1.12, 0.09], [0.08, -0.04, 0.97]])


def exact_stress(F: np.ndarray) -> np.ndarray:
    """Cauchy stress of the HGO law, Eqs. (7) to (10) of the study with the stress of Eq. (4)."""
    m, J = MATERIAL, np.linalg.det(F)
    F_bar = J ** (-1.0 / 3.0) * F
    inner = m.c * F_bar @ F_bar.T
    for sign in (1.0, -1.0):
        a = F_bar @ np.array([0.0, np.cos(m.fibre_angle), sign * np.sin(m.fibre_angle)])
        E = a @ a - 1.0
        assert E > 0.0
        inner += 2.0 * m.k1 * E * np.exp(m.k2 * E**2) * np.outer(a, a)
    return m.bulk * (J - 1.0) * np.eye(3) + (inner - np.trace(inner) / 3.0 * np.eye(3)) / J


class Patch:
    """A brick of 3 x 3 x 3 (27-node: 2 x 2 x 2) distorted elements, held on all its six sides."""

    def __init__(self, element: str, monkeypatch: pytest.MonkeyPatch) -> None:
        n = 3 if element == "q1p0" else 2
        settings = mesh(element, n, n, (n,), contact_points=1)
        self.mesh = build_mesh(settings)
        grid = np.array(self.mesh.grid)
        place = np.stack(np.unravel_index(np.arange(self.mesh.n_nodes), grid[::-1])[::-1], axis=1)
        spacing = 1.0 / (grid - 1)
        rng = np.random.default_rng(1)
        self.X = place * spacing + 0.15 * spacing * rng.uniform(-1.0, 1.0, (self.mesh.n_nodes, 3))
        self.inner = np.all((place > 0) & (place < grid - 1), axis=1)
        self.spacing = spacing

        X = jnp.moveaxis(jnp.asarray(self.X)[self.mesh.cells], -1, 0)
        axes = jnp.broadcast_to(
            jnp.eye(3)[:, :, None, None], (3, 3, 8 if element == "q1p0" else 27, X.shape[2])
        )
        monkeypatch.setattr(energies, "stress_free_positions", lambda *_: X)
        monkeypatch.setattr(energies, "_cylindrical_axes", lambda _: axes)
        monkeypatch.setattr(assembly, "supported", lambda _: np.repeat(~self.inner[:, None], 3, axis=1))
        scene = jc.load_scene("human-lad")
        artery = jc.replace(
            scene.artery, "layers", (jc.replace(scene.artery.layers[0], "material", MATERIAL),)
        )
        topology, self.pattern = build_topology(self.mesh)
        parameters = Parameters(materials=(MATERIAL,), contact=scene.contact, jaw=scene.clamp.jaw)
        body = Body(
            topology=topology,
            stencils=build_stencils(self.mesh, settings),
            geometry=build_geometry.__wrapped__(self.mesh, settings, artery),
            parameters=parameters,
        )
        self.body = jax.tree_util.tree_map(jnp.asarray, body)

    def at(self, x: np.ndarray) -> State:
        return with_equilibrium_pressure(self.body, jnp.asarray(x), jnp.asarray(FAR))


@pytest.fixture(params=["q1p0", "q2p1"])
def patch(request, monkeypatch):
    return Patch(request.param, monkeypatch)


def test_patch(patch):
    """The exact field is in equilibrium, is found from a disturbed start, and its stress is uniform."""
    exact = patch.X @ A.T
    assert patch.inner.sum() == (8 if patch.mesh.element.order == 1 else 27)

    at_rest = jax.device_get(linearise(patch.body, patch.at(patch.X), jnp.asarray(0.0)))
    deformed = jax.device_get(linearise(patch.body, patch.at(exact), jnp.asarray(0.0)))
    assert np.linalg.norm(deformed.residual) < 1e-12 * deformed.reactions
    assert np.linalg.norm(at_rest.residual) < 1e-12 * deformed.reactions
    assert at_rest.J_min == pytest.approx(1.0, abs=1e-12)
    assert deformed.J_min == pytest.approx(np.linalg.det(A), rel=1e-12)
    assert deformed.J_max == pytest.approx(np.linalg.det(A), rel=1e-12)

    rng = np.random.default_rng(2)
    start = exact + 0.03 * patch.spacing * rng.uniform(-1.0, 1.0, exact.shape) * patch.inner[:, None]
    state, solver = patch.at(start), LinearSolver(patch.pattern, "splu")
    for _ in range(7):
        lin = jax.device_get(linearise(patch.body, state, jnp.asarray(0.0)))
        solver.factor(lin.values)
        dx = solver.solve(-lin.residual[:, None])[:, 0]
        state = advance(patch.body, state, dx, 0.0, 1.0)
    assert np.max(np.abs(start - exact)) > 0.005
    np.testing.assert_allclose(np.asarray(state.x), exact, rtol=0.0, atol=1e-12)

    cells = piece(patch.body, state, 0, patch.mesh.n_cells)
    stencils = patch.body.stencils
    sigma = np.asarray(stacked(cauchy_stress(cells, stencils.modes, stencils.wall, MATERIAL)[1]))
    expected = exact_stress(A)
    size = np.linalg.norm(expected)
    np.testing.assert_allclose(
        sigma, np.broadcast_to(expected[:, :, None, None], sigma.shape), rtol=0.0, atol=1e-11 * size
    )


def test_patch_volume_and_mass_of_pressure(patch):
    """Distortion does not change the volume, nor int N_m N_n / bulk dV of the constant mode."""
    dV = np.asarray(patch.body.geometry.dV)
    assert dV.sum() == pytest.approx(enclosed_volume(patch), rel=1e-12)
    compliance = np.linalg.inv(np.moveaxis(np.asarray(patch.body.geometry.pressure_stiffness), -1, 0))
    np.testing.assert_allclose(compliance[:, 0, 0], dV.sum(axis=0) / MATERIAL.bulk, rtol=1e-12)


def enclosed_volume(patch) -> float:
    """1/3 int X . n dA over the outer facets of the brick, with a rule of its own."""
    m = patch.mesh.element.order
    nodes = np.linspace(-1.0, 1.0, m + 1)
    points, weights = np.polynomial.legendre.leggauss(6)
    values = np.array(
        [[np.prod([(s - b) / (a - b) for b in nodes if b != a]) for a in nodes] for s in points]
    )
    slopes = np.array([np.polyval(np.polyder(np.polyfit(nodes, row, m)), points) for row in np.eye(m + 1)]).T
    grid = patch.mesh.grid
    X = patch.X.reshape(*grid[::-1], 3).transpose(2, 1, 0, 3)  # [r, c, z]
    volume = 0.0
    for axis in range(3):
        for side, sign in ((0, -1.0), (-1, 1.0)):
            sheet = np.take(X, side, axis=axis)  # remaining axes in order
            if axis == 1:
                sheet = sheet.transpose(1, 0, 2)  # (z, r): right-handed with c
            for i in range(0, sheet.shape[0] - 1, m):
                for j in range(0, sheet.shape[1] - 1, m):
                    part = sheet[i : i + m + 1, j : j + m + 1]
                    position = np.einsum("pa,qb,abk->pqk", values, values, part)
                    first = np.einsum("pa,qb,abk->pqk", slopes, values, part)
                    second = np.einsum("pa,qb,abk->pqk", values, slopes, part)
                    flux = np.einsum("pqk,pqk->pq", position, np.cross(first, second))
                    volume += sign / 3.0 * np.einsum("p,q,pq->", weights, weights, flux)
    return volume
