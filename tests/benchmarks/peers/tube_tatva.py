"""The tube with tatva: one energy, its gradient by JAX, sparse tangent by colouring, PARDISO.

Mean dilatation is written through tatva's own integral per element, the lumen through its map over
facets, both differentiated with the rest.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import tube_law_jax as law  # noqa: E402
import tube_work as work  # noqa: E402
from pypardiso import PyPardisoSolver  # noqa: E402
from scipy import sparse  # noqa: E402
from tatva import Mesh, Operator  # noqa: E402
from tatva.element import Hexahedron8, Quad4  # noqa: E402
from tatva.sparse import ColoredMatrix, linearized_jacfwd, pattern_from_mesh  # noqa: E402

COLOURS_AT_ONCE = 1
"""more at once took longer (81 colours; 10 x 15 x 8 elements) and far more memory"""


@dataclasses.dataclass
class Tube:
    """What is compiled and coloured once."""

    mesh: work.TubeMesh
    linearise: Callable[..., Any]
    load: Callable[..., Any]
    slopes: Callable[..., Any]
    linear: PyPardisoSolver


def build(mesh: work.TubeMesh) -> Tube:
    """Energy, force and tangent of the free displacements."""
    points, free = jnp.asarray(mesh.points), mesh.free
    wall = Operator(Mesh(points, jnp.asarray(mesh.cells)), Hexahedron8(), cache_weights=True)
    lumen = Operator(Mesh(points, jnp.asarray(mesh.inner_facets)), Quad4())
    volumes = wall.integrate_per_element(jnp.ones((len(mesh.cells), 8)))
    fibres = jnp.asarray(law.fibre_directions(wall.eval(points)))
    density = jax.vmap(jax.vmap(law.shape_energy, (0, 0, None)), (0, 0, None))
    dilatation = jax.vmap(jax.vmap(lambda F: law.det(F) - 1.0))

    def on_facet(xi: Any, x: Any) -> Any:
        position = Quad4().shape_function(xi) @ x
        tangents = Quad4().shape_function_derivative(xi) @ x
        return law.swept_density(position, tangents[0], tangents[1])

    def volume(u: Any) -> Any:
        return jnp.sum(lumen.map(on_facet)(points + u) * Quad4().quad_weights)

    def full(v: Any, u: Any) -> Any:
        return u.ravel().at[free].set(v).reshape(u.shape)

    def energy(v: Any, u: Any, p: Any, constants: Any) -> Any:
        F = wall.grad(full(v, u)) + jnp.eye(3)
        change = wall.integrate_per_element(dilatation(F))
        stored = wall.integrate(density(F, fibres, constants))
        return stored + 0.5 * work.BULK * jnp.sum(change**2 / volumes) - p * volume(full(v, u))

    force = jax.grad(energy)
    pattern = pattern_from_mesh(wall.mesh, 3).tocsr()[free][:, free].tocsr()
    pattern.sort_indices()
    tangent = linearized_jacfwd(force, ColoredMatrix.from_csr(pattern), color_batch_size=COLOURS_AT_ONCE)
    along = lambda adjoint, v, u, p, constants: adjoint @ force(v, u, p, constants)
    return Tube(
        mesh,
        linearise=jax.jit(tangent),
        load=jax.jit(lambda u: jnp.linalg.norm(jax.grad(volume)(u))),
        slopes=jax.jit(jax.grad(along, argnums=(3, 4))),
        linear=PyPardisoSolver(mtype=11),
    )


def solve(tube: Tube, u: np.ndarray, pressures: Sequence[float]) -> work.Answer:
    """Newton's method; tatva leaves the loop to its user."""
    free, start = tube.mesh.free, jnp.asarray(u)

    def linearise(v: Any, p: float) -> work.Linearised:
        residual, tangent = tube.linearise(v, start, p, law.CONSTANTS)
        load = p * float(tube.load(start.ravel().at[free].set(v).reshape(u.shape)))
        return np.asarray(residual), tangent, load

    def correct(v: Any, tangent: Any, residual: np.ndarray) -> Any:
        return v - tube.linear.solve(sparse.csr_matrix(tangent.to_csr()), residual)

    v, iterations, seconds = work.newton(linearise, correct, jnp.asarray(u.ravel()[free]), pressures)
    u = u.copy()
    u.ravel()[free] = v
    return work.Answer(tube.mesh.radius(u), iterations, seconds, (v, start))


def gradient(tube: Tube, answer: work.Answer) -> dict[str, float]:
    """Derivatives of the radius by an adjoint solve with the symmetric tangent."""
    v, u = answer.state
    _, tangent = tube.linearise(v, u, work.PRESSURE, law.CONSTANTS)
    wanted = tube.mesh.radius_weights().ravel()[tube.mesh.free]
    adjoint = tube.linear.solve(sparse.csr_matrix(tangent.to_csr()), wanted)
    by_p, by_constants = tube.slopes(adjoint, v, u, work.PRESSURE, law.CONSTANTS)
    return {"p": -float(by_p)} | {name: -float(value) for name, value in by_constants.items()}


BY = "adjoint and linear solve written by the user; force slopes by JAX"

if __name__ == "__main__":
    work.main("tatva", "tatva", build, solve, gradient, BY)
