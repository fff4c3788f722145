"""The tube with JAX-FEM: kernels of a cell and a facet written as energies, MUMPS, its own adjoint.

The package has neither mean dilatation nor follower pressure; both go through its universal kernels.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from typing import Any

import dolfinx_solver  # noqa: F401  (brings petsc4py, which JAX-FEM imports)
import jax
import jax.numpy as jnp
import numpy as np
import tube_law_jax as law
import tube_work as work
from jax_fem import logger
from jax_fem.generate_mesh import Mesh
from jax_fem.problem import Problem
from jax_fem.solver import apply_bc_vec, get_A, implicit_vjp, linear_solver
from petsc4py import PETSc

logger.setLevel(logging.WARNING)

INNER_CORNERS = (0, 4, 7, 3)
"""corners of a cell on its inner side, tangents along and round"""


class Tube(Problem):
    """The weak form, as gradients of energies."""

    def custom_init(self) -> None:
        X = self.fes[0].points[self.fes[0].cells[self.boundary_inds_list[0][:, 0]]]
        self.facet_corners = X[:, INNER_CORNERS, :]
        self.fibres = jnp.asarray(law.fibre_directions(self.physical_quad_points))
        self.tangent_solver = PETSc.KSP().create()
        self.set_params(law.CONSTANTS | {"p": work.PRESSURE})

    def set_params(self, params: dict[str, Any]) -> None:
        """Constants and pressure, one value a cell or facet."""
        everywhere = lambda value: jnp.full(self.num_cells, value)
        constants = {name: everywhere(params[name]) for name in law.CONSTANTS}
        self.internal_vars = [self.fibres, constants]
        self.internal_vars_surfaces = [[self.facet_corners, jnp.full(len(self.facet_corners), params["p"])]]

    def get_universal_kernel(self) -> Callable[..., Any]:
        def energy(u: Any, gradients: Any, dV: Any, fibres: Any, constants: Any) -> Any:
            F = jnp.einsum("ai,qaj->qij", u.reshape(8, 3), gradients) + jnp.eye(3)
            density = jax.vmap(law.shape_energy, (0, 0, None))(F, fibres, constants)
            change = jnp.sum((jax.vmap(law.det)(F) - 1.0) * dV)
            return jnp.sum(density * dV) + 0.5 * work.BULK * change**2 / jnp.sum(dV)

        def kernel(u: Any, x: Any, gradients: Any, dV: Any, _: Any, fibres: Any, constants: Any) -> Any:
            return jax.grad(energy)(u, gradients, dV[0], fibres, constants)

        return kernel

    def get_universal_kernels_surface(self) -> list[Callable[..., Any]]:
        g = np.array([-1.0, 1.0]) / np.sqrt(3.0)
        points = [(a, b) for a in g for b in g]

        def swept(u: Any, corners: Any) -> Any:
            x = corners + u.reshape(8, 3)[jnp.array(INNER_CORNERS)]
            total = 0.0
            for a, b in points:
                N = np.array([(1 - a) * (1 - b), (1 + a) * (1 - b), (1 + a) * (1 + b), (1 - a) * (1 + b)])
                along = np.array([b - 1, 1 - b, 1 + b, -1 - b])
                round_ = np.array([a - 1, -1 - a, 1 + a, 1 - a])
                total += law.swept_density(N / 4 @ x, along / 4 @ x, round_ / 4 @ x)
            return total

        def kernel(u: Any, x: Any, N: Any, dN: Any, dA: Any, corners: Any, p: Any) -> Any:
            return -p * jax.grad(swept)(u, corners)

        return [kernel]


@dataclasses.dataclass
class Built:
    """A mesh and its problem."""

    mesh: work.TubeMesh
    problem: Tube


def build(mesh: work.TubeMesh) -> Built:
    """Problem with its supports."""
    near = lambda value, axis: lambda point: jnp.isclose(point[axis], value, atol=1e-9)
    nothing = lambda point: 0.0
    end = (work.STRETCH - 1.0) * work.LENGTH
    places = [near(0.0, 0), near(0.0, 1), near(0.0, 2), near(work.LENGTH, 2)]
    supports = [places, [0, 1, 2, 2], [nothing, nothing, nothing, lambda point: end]]
    lumen = lambda point: jnp.isclose(jnp.hypot(point[0], point[1]), work.INNER_RADIUS, atol=1e-9)
    problem = Tube(
        Mesh(mesh.points, mesh.cells), vec=3, dim=3, dirichlet_bc_info=supports, location_fns=[lumen]
    )
    return Built(mesh, problem)


def mumps(A: Any, b: Any, x0: Any, options: dict[str, Any]) -> np.ndarray:
    """LU of PETSc with MUMPS; the analysis is kept as long as it is the same matrix object."""
    ksp = options["ksp"]
    ksp.setType("preonly")
    ksp.pc.setType("lu")
    ksp.pc.setFactorSolverType("mumps")
    ksp.setOperators(A)
    rhs = PETSc.Vec().createWithArray(np.array(b))
    x = rhs.duplicate()
    ksp.solve(rhs, x)
    return x.getArray().copy()


def solve(built: Built, u: np.ndarray, pressures: Sequence[float]) -> work.Answer:
    """Newton's method from JAX-FEM's parts; its own loop has another stop."""
    problem, free = built.problem, built.mesh.free
    options = {"custom_solver": mumps, "ksp": problem.tangent_solver}

    def linearise(u: Any, p: float) -> work.Linearised:
        problem.set_params(law.CONSTANTS | {"p": p})
        residual = apply_bc_vec(problem.newton_update([u])[0].ravel(), u.ravel(), problem)
        return np.asarray(residual)[free], residual, p * unit_load(problem, u)

    def correct(u: Any, residual: Any, _: np.ndarray) -> Any:
        change = linear_solver(get_A(problem), -residual, None, options)
        return u + change.reshape(u.shape)

    u, iterations, seconds = work.newton(linearise, correct, jnp.asarray(u), pressures)
    return work.Answer(built.mesh.radius(np.asarray(u)), iterations, seconds, u)


def unit_load(problem: Tube, u: Any) -> float:
    """|f_pressure| at 1 kPa, mN."""
    cells = problem.fes[0].cells
    forces = problem.compute_face(
        u[cells].reshape(len(cells), -1),
        jnp,
        False,
        [[problem.facet_corners, jnp.ones(len(problem.facet_corners))]],
    )[0]
    nodes = problem.cells_list_face_list[0][0]
    return float(jnp.linalg.norm(jnp.zeros(u.shape).at[nodes].add(forces.reshape(*nodes.shape, 3))))


def gradient(built: Built, answer: work.Answer) -> dict[str, float]:
    """Derivatives of the radius by JAX-FEM's adjoint."""
    params = {name: jnp.asarray(v) for name, v in (law.CONSTANTS | {"p": work.PRESSURE}).items()}
    weights = [jnp.asarray(built.mesh.radius_weights())]
    options = {"custom_solver": mumps, "ksp": PETSc.KSP().create()}
    found = implicit_vjp(built.problem, [answer.state], params, weights, options)
    return {name: float(value) for name, value in found.items()}


BY = "its own adjoint"

if __name__ == "__main__":
    work.main("JAX-FEM", "jax-fem", build, solve, gradient, BY)
