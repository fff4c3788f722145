"""Patch test: distorted elements reproduce a homogeneous deformation and its uniform stress."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from jaxclamp.physics.materials import HGO
from jaxclamp.potential.tangent import advance, linearise
from jaxclamp.solve.blocks import Block, at_rest, brick, stress
from jaxclamp.solve.linear_solvers import LinearSolver

MATERIAL = HGO(c=27.0, k1=5.1, k2=1.0, fibre_angle=0.5, bulk=1e4)

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


@dataclasses.dataclass(frozen=True)
class Patch:
    """A brick of 3 x 3 x 3 (27-node: 2 x 2 x 2) distorted elements, held on all its six sides."""

    block: Block
    inner: np.ndarray
    spacing: np.ndarray

    @property
    def X(self) -> np.ndarray:
        return self.block.positions


@pytest.fixture(params=["q1p0", "q1pz", "q2p1"])
def patch(request):
    n = 2 if request.param == "q2p1" else 3
    spacing = np.full(3, 1.0 / 3.0 if n == 3 else 0.25)
    rng = np.random.default_rng(1)
    places: list[np.ndarray] = []

    def distorted(u: np.ndarray) -> np.ndarray:
        places.append(u)
        return u + 0.15 * spacing * rng.uniform(-1.0, 1.0, u.shape)

    def outside(_: np.ndarray) -> np.ndarray:
        (u,) = places
        return np.repeat(~np.all((u > 0.0) & (u < 1.0), axis=1)[:, None], 3, axis=1)

    block = brick(request.param, (n,), n, n, distorted, (MATERIAL,), outside)
    return Patch(block, ~block.held[:, 0], spacing)


def test_patch(patch):
    """The exact field is in equilibrium, is found from a disturbed start, and its stress is uniform."""
    exact = patch.X @ A.T
    assert patch.inner.sum() == (8 if patch.block.mesh.element.order == 1 else 27)

    undeformed = linearise(patch.block.potential, at_rest(patch.block, patch.X), patch.block.pattern)
    deformed = linearise(patch.block.potential, at_rest(patch.block, exact), patch.block.pattern)
    assert np.linalg.norm(deformed.residual) < 1e-12 * deformed.reactions
    assert np.linalg.norm(undeformed.residual) < 1e-12 * deformed.reactions
    assert undeformed.J_min == pytest.approx(1.0, abs=1e-12)
    assert deformed.J_min == pytest.approx(np.linalg.det(A), rel=1e-12)
    assert deformed.J_max == pytest.approx(np.linalg.det(A), rel=1e-12)

    rng = np.random.default_rng(2)
    start = exact + 0.03 * patch.spacing * rng.uniform(-1.0, 1.0, exact.shape) * patch.inner[:, None]
    state, solver = at_rest(patch.block, start), LinearSolver(patch.block.pattern, "splu")
    for _ in range(7):
        lin = linearise(patch.block.potential, state, patch.block.pattern)
        solver.factor(lin.values)
        dx = solver.solve(-lin.residual[:, None])[:, 0]
        state = advance(patch.block.potential, state, dx, np.zeros(1), 1.0)
    assert np.max(np.abs(start - exact)) > 0.005
    np.testing.assert_allclose(np.asarray(state.x), exact, rtol=0.0, atol=1e-12)

    sigma = stress(patch.block, state)
    expected = exact_stress(A)
    size = np.linalg.norm(expected)
    np.testing.assert_allclose(
        sigma, np.broadcast_to(expected[:, :, None, None], sigma.shape), rtol=0.0, atol=1e-11 * size
    )


def test_patch_volume_and_mass_of_pressure(patch):
    """Distortion does not change the volume, nor int N_m N_n / bulk dV of the constant mode."""
    (group,) = patch.block.potential.layers
    dV = np.asarray(group.solid.dV)
    assert dV.sum() == pytest.approx(enclosed_volume(patch), rel=1e-12)
    compliance = np.linalg.inv(np.moveaxis(np.asarray(group.volume.stiffness), -1, 0))
    np.testing.assert_allclose(compliance[:, 0, 0], dV.sum(axis=0) / MATERIAL.bulk, rtol=1e-12)


def enclosed_volume(patch) -> float:
    """1/3 int X . n dA over the outer facets of the brick, with a rule of its own."""
    m = patch.block.mesh.element.order
    nodes = np.linspace(-1.0, 1.0, m + 1)
    points, weights = np.polynomial.legendre.leggauss(6)
    values = np.array(
        [[np.prod([(s - b) / (a - b) for b in nodes if b != a]) for a in nodes] for s in points]
    )
    slopes = np.array([np.polyval(np.polyder(np.polyfit(nodes, row, m)), points) for row in np.eye(m + 1)]).T
    grid = patch.block.mesh.grid
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
