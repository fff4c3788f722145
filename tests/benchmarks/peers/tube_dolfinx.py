"""The tube with DOLFINx (FEniCSx): mixed Q1 x DG0 form, generated C kernels, MUMPS.

The pressure of an element is an unknown of its own here. The energy is quadratic in it, so that the
solution is that of mean dilatation.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import dolfinx_solver  # noqa: F401  (orders the imports of MPI and PETSc)
import numpy as np
import tube_work as work
import ufl
from basix.ufl import element, mixed_element
from dolfinx import fem
from dolfinx.fem import petsc
from dolfinx.mesh import create_mesh, exterior_facet_indices, locate_entities_boundary, meshtags
from mpi4py import MPI
from petsc4py import PETSc
from scipy.spatial import cKDTree

TENSOR_ORDER = (0, 1, 3, 2, 4, 5, 7, 6)
OPTIONS = {"cffi_extra_compile_args": ["-O3", "-march=native"]}


@dataclasses.dataclass
class Tube:
    """Forms, compiled once, and the linear algebra."""

    mesh: work.TubeMesh
    w: Any
    p: Any
    residual: Any
    tangent: Any
    slopes: dict[str, Any]
    load: Any
    bcs: list[Any]
    held: np.ndarray
    order: np.ndarray
    """number in the tube's mesh of each node of the displacement space"""
    places: np.ndarray
    """degrees of freedom of the displacement in the mixed space"""
    A: Any
    ksp: Any


def energies(u: Any, q: Any, X: Any, c: Any, k1: Any, k2: Any) -> Any:
    """Energy per reference volume with the pressure q as unknown, kPa."""
    F = ufl.Identity(3) + ufl.grad(u)
    J = ufl.det(F)
    scale = J ** (-2.0 / 3.0)
    R = ufl.sqrt(X[0] ** 2 + X[1] ** 2)
    cosine, sine = np.cos(work.FIBRE_ANGLE), np.sin(work.FIBRE_ANGLE)
    psi = c / 2 * (scale * ufl.inner(F, F) - 3.0)
    for side in (1.0, -1.0):
        Fa = F * ufl.as_vector([-X[1] / R * cosine, X[0] / R * cosine, side * sine])
        stretch = scale * ufl.inner(Fa, Fa) - 1.0
        E = ufl.conditional(ufl.gt(stretch, 0.0), stretch, 0.0)
        psi += k1 / (2 * k2) * (ufl.exp(k2 * E**2) - 1.0)
    return psi + q * (J - 1.0) - q**2 / (2 * work.BULK)


def build(mesh: work.TubeMesh) -> Tube:
    """Mesh, spaces, forms and supports."""
    shape = element("Lagrange", "hexahedron", 1, shape=(3,))
    domain = create_mesh(MPI.COMM_WORLD, mesh.cells[:, TENSOR_ORDER], shape, mesh.points)
    W = fem.functionspace(domain, mixed_element([shape, element("DG", "hexahedron", 0)]))
    V, places = W.sub(0).collapse()
    _, order = cKDTree(mesh.points).query(V.tabulate_dof_coordinates())

    domain.topology.create_connectivity(2, 3)
    lumen = lambda x: np.isclose(np.hypot(x[0], x[1]), work.INNER_RADIUS, atol=1e-9)
    facets = np.sort(locate_entities_boundary(domain, 2, lumen))
    assert len(facets) == len(mesh.inner_facets) < len(exterior_facet_indices(domain.topology))
    tags = meshtags(domain, 2, facets, np.ones(len(facets), dtype=np.int32))
    options = {"quadrature_degree": 2}
    dx = ufl.Measure("dx", domain, metadata=options)
    ds = ufl.Measure("ds", domain, subdomain_data=tags, metadata=options)(1)

    w, p = fem.Function(W), fem.Constant(domain, 0.0)
    u, q = ufl.split(w)
    test, trial = ufl.TestFunction(W), ufl.TrialFunction(W)
    X, N = ufl.SpatialCoordinate(domain), ufl.FacetNormal(domain)
    constants = {
        name: ufl.variable(fem.Constant(domain, value))
        for name, value in (("c", work.C), ("k1", work.K1), ("k2", work.K2))
    }
    psi = energies(u, q, X, **constants)
    F = ufl.Identity(3) + ufl.grad(u)
    push = ufl.inner(ufl.det(F) * ufl.inv(F).T * N, ufl.split(test)[0]) * ds
    residual = ufl.derivative(psi * dx, w, test) + p * push
    form = lambda expression: fem.form(expression, jit_options=OPTIONS)
    slopes = {
        name: form(ufl.derivative(ufl.diff(psi, variable) * dx, w, test))
        for name, variable in constants.items()
    }
    tangent = form(ufl.derivative(residual, w, trial))

    end = (work.STRETCH - 1.0) * work.LENGTH
    planes = [(0, 0.0, 0, 0.0), (1, 0.0, 1, 0.0), (2, 0.0, 2, 0.0), (2, work.LENGTH, 2, end)]
    bcs = []
    for axis, at, component, value in planes:
        on_plane = lambda x, a=axis, v=at: np.isclose(x[a], v, atol=1e-9)
        space = W.sub(0).sub(component)
        dofs = fem.locate_dofs_topological(space, 2, locate_entities_boundary(domain, 2, on_plane))
        bcs.append(fem.dirichletbc(value, dofs, space))
    A = petsc.create_matrix(tangent)
    ksp = PETSc.KSP().create(domain.comm)
    ksp.setType("preonly")
    ksp.pc.setType("lu")
    ksp.pc.setFactorSolverType("mumps")
    ksp.setOperators(A)
    return Tube(
        mesh=mesh,
        w=w,
        p=p,
        residual=form(residual),
        tangent=tangent,
        slopes=slopes,
        load=form(push),
        bcs=bcs,
        held=np.unique(np.concatenate([bc.dof_indices()[0] for bc in bcs])),
        order=order,
        places=np.asarray(places),
        A=A,
        ksp=ksp,
    )


def assembled(form: Any) -> np.ndarray:
    """Vector of a linear form."""
    return fem.assemble_vector(form).array


def linear_solve(tube: Tube, b: np.ndarray) -> np.ndarray:
    """Assemble the tangent and solve once."""
    tube.A.zeroEntries()
    petsc.assemble_matrix(tube.A, tube.tangent, bcs=tube.bcs)
    tube.A.assemble()
    x = np.zeros_like(b)
    tube.ksp.solve(PETSc.Vec().createWithArray(b), PETSc.Vec().createWithArray(x))
    return x


def solve(tube: Tube, u: np.ndarray, pressures: Sequence[float]) -> work.Answer:
    """Newton's method; the loop is ours because of the common stop."""
    start = np.zeros(len(tube.w.x.array))
    start[tube.places] = u[tube.order].ravel()

    def linearise(w: np.ndarray, p: float) -> work.Linearised:
        tube.w.x.array[:] = w
        tube.p.value = p
        residual = assembled(tube.residual)
        residual[tube.held] = 0.0
        return residual, None, p * float(np.linalg.norm(assembled(tube.load)))

    def correct(w: np.ndarray, _: Any, residual: np.ndarray) -> np.ndarray:
        return w - linear_solve(tube, residual)

    w, iterations, seconds = work.newton(linearise, correct, start, pressures)
    found = np.zeros_like(u)
    found[tube.order] = w[tube.places].reshape(-1, 3)
    return work.Answer(tube.mesh.radius(found), iterations, seconds, w)


def gradient(tube: Tube, answer: work.Answer) -> dict[str, float]:
    """Derivatives of the radius by an adjoint solve with the symmetric tangent."""
    tube.w.x.array[:] = answer.state
    weights = np.zeros(len(answer.state))
    weights[tube.places] = tube.mesh.radius_weights()[tube.order].ravel()
    adjoint = linear_solve(tube, weights)
    found = {name: -float(adjoint @ assembled(form)) for name, form in tube.slopes.items()}
    return found | {"p": -float(adjoint @ assembled(tube.load))}


BY = "adjoint and linear solve written by the user; force slopes by UFL"

if __name__ == "__main__":
    work.main("DOLFINx", "dolfinx-solver-real", build, solve, gradient, BY)
