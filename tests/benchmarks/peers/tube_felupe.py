"""The tube with FElupe: mean dilatation built in, law differentiated by tensortrax, PARDISO."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import felupe as fem
import felupe.constitution.tensortrax as mat
import numpy as np
import tensortrax.math as tm
import tube_work as work
from pypardiso import PyPardisoSolver
from scipy import sparse


def energy(C: Any, fibres: np.ndarray, c: float, k1: float, k2: float) -> tuple[Any, np.ndarray]:
    """Energy of the change of shape, kPa, from C = F'F; the fibre directions pass as state variables.

    fibres: two unit vectors one after the other, (6, points, cells)
    """
    scale = tm.linalg.det(C) ** (-1 / 3)
    psi = c / 2 * (scale * tm.trace(C) - 3.0)
    for a in (fibres[:3], fibres[3:]):
        I4 = sum(C[i, j] * (a[i] * a[j]) for i in range(3) for j in range(3))
        E = tm.maximum(scale * I4 - 1.0, 0.0)
        psi = psi + k1 / (2 * k2) * (tm.exp(k2 * E**2) - 1.0)
    return psi, fibres


@dataclasses.dataclass
class Tube:
    """What FElupe needs, built once."""

    mesh: work.TubeMesh
    field: Any
    fibres: np.ndarray
    lumen: Any
    linear: PyPardisoSolver


def build(mesh: work.TubeMesh) -> Tube:
    """Regions of wall and lumen."""
    fe_mesh = fem.Mesh(mesh.points, mesh.cells, cell_type="hexahedron")
    field = fem.FieldContainer([fem.Field(fem.RegionHexahedron(fe_mesh), dim=3)])
    X = fem.Field(field.region, dim=3, values=mesh.points).interpolate()
    R, zero = np.hypot(X[0], X[1]), np.zeros_like(X[0])
    hoop = np.stack([-X[1] / R, X[0] / R, zero]) * np.cos(work.FIBRE_ANGLE)
    axial = np.stack([zero, zero, zero + 1.0]) * np.sin(work.FIBRE_ANGLE)
    mask = np.zeros(len(mesh.points), dtype=bool)
    mask[mesh.inner] = True
    surface = fem.RegionHexahedronBoundary(fe_mesh, only_surface=True, mask=mask)
    lumen = fem.FieldContainer([fem.Field(surface, dim=3)])
    return Tube(mesh, field, np.concatenate([hoop + axial, hoop - axial]), lumen, PyPardisoSolver(mtype=11))


def law(parallel: bool = True, **changed: float) -> Any:
    """The material with some constants changed."""
    constants = {"c": work.C, "k1": work.K1, "k2": work.K2} | changed
    return mat.Hyperelastic(energy, nstatevars=6, parallel=parallel, **constants)


def wall(tube: Tube, u: np.ndarray, **changed: float) -> Any:
    """The solid body at a displacement, its inner pressures fitting."""
    tube.field[0].values[:] = u
    return fem.SolidBodyNearlyIncompressible(
        law(**changed), tube.field, bulk=work.BULK, statevars=tube.fibres
    )


def stiffness(tube: Tube, solid: Any, blood: Any) -> sparse.csr_matrix:
    """Tangent of the unknowns, mN/mm."""
    K = solid.assemble.matrix()
    K = sparse.csr_matrix(K - blood.assemble.matrix(resize=K))
    K = K[tube.mesh.free][:, tube.mesh.free]
    K.sort_indices()
    return K


def solve(tube: Tube, u: np.ndarray, pressures: Sequence[float]) -> work.Answer:
    """Newton's method; the loop is ours because of the common stop, all else is FElupe's."""
    free = tube.mesh.free
    solid = wall(tube, u)
    blood = fem.SolidBodyPressure(tube.lumen)

    def linearise(u: np.ndarray, p: float) -> work.Linearised:
        tube.field[0].values[:] = u
        tube.lumen[0].values[:] = u
        force = solid.assemble.vector(tube.field)
        load = blood.assemble.vector(tube.lumen, pressure=p, resize=force)
        residual = (force - load).toarray().ravel()
        return residual[free], (solid, blood), float(sparse.linalg.norm(load))

    def correct(u: np.ndarray, tangent: Any, residual: np.ndarray) -> np.ndarray:
        change = np.zeros(u.size)
        change[free] = -tube.linear.solve(stiffness(tube, *tangent), residual)
        return u + change.reshape(u.shape)

    u, iterations, seconds = work.newton(linearise, correct, u.copy(), pressures)
    return work.Answer(tube.mesh.radius(u), iterations, seconds, (solid, blood))


def gradient(tube: Tube, answer: work.Answer) -> dict[str, float]:
    """Derivatives of the radius by an adjoint solve with the symmetric tangent."""
    solid, blood = answer.state
    free = tube.mesh.free
    adjoint = tube.linear.solve(stiffness(tube, solid, blood), tube.mesh.radius_weights().ravel()[free])
    umat, h = solid.umat, 1e-4

    def slope(name: str) -> np.ndarray:
        forces = []
        for sign in (1, -1):
            solid.umat = law(**{name: constants[name] * (1 + sign * h)})
            forces.append(solid.assemble.vector().toarray().ravel())
        solid.umat = umat
        return (forces[0] - forces[1]) / (2 * h * constants[name])

    constants = {"c": work.C, "k1": work.K1, "k2": work.K2}
    found = {name: -float(adjoint @ slope(name)[free]) for name in constants}
    load = blood.assemble.vector(resize=solid.results.force).toarray().ravel()
    return found | {"p": float(adjoint @ load[free]) / work.PRESSURE}


BY = "adjoint, force slopes and linear solve written by the user; slopes by central differences"

if __name__ == "__main__":
    work.main("FElupe", "felupe", build, solve, gradient, BY)
