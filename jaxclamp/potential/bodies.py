"""Bodies: a meshed solid whose cells are stress-free each for itself, seen from its quadrature points."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.records import record
from jaxclamp.core.tensors import Tensor, components, cross, det, inverse, norm, product, stacked, transpose
from jaxclamp.fem.grid import Mesh
from jaxclamp.fem.stencils import FacetRule, Stencils
from jaxclamp.fem.tube import stress_free_positions
from jaxclamp.physics.materials import Material
from jaxclamp.potential.densities import Solid
from jaxclamp.scenes.scene import Artery, MeshSettings


@record
class Body:
    """A block of cells with a law for each of its layers."""

    mesh: Mesh
    """its cells and facets"""
    X: Array
    """stress-free position of each cell's nodes, mm, (3, n_en, n_cells)"""
    axes: Array
    """material axes (radial, circumferential, axial) at the points, unit vectors in rows,
    (3, 3, n_q, n_cells)"""
    materials: tuple[Material, ...]
    """by layer"""


def tube_body(mesh: Mesh, stencils: Stencils, settings: MeshSettings, artery: Artery) -> Body:
    """The wall of an artery; a JAX function of its floats."""
    X = stress_free_positions(mesh, settings, artery)
    at_points = jnp.einsum("qa,iac->iqc", stencils.positions, X)
    return Body(
        mesh=mesh,
        X=X,
        axes=stacked(_cylindrical_axes(at_points)),
        materials=tuple(layer.material for layer in artery.layers),
    )


def brick_body(
    mesh: Mesh, stencils: Stencils, positions: Array | np.ndarray, materials: tuple[Material, ...]
) -> Body:
    """A body that is stress-free where its nodes are, with material axes along x, y and z.

    positions: stress-free position of the nodes, mm, (n_nodes, 3)
    """
    X = jnp.moveaxis(jnp.asarray(positions)[mesh.cells], -1, 0)
    shape = (3, 3, len(stencils.weights), mesh.n_cells)
    axes = jnp.broadcast_to(jnp.eye(3)[:, :, None, None], shape)
    return Body(mesh=mesh, X=X, axes=axes, materials=materials)


def _cylindrical_axes(X: Array) -> Tensor:
    """Unit vectors (radial, circumferential, axial) at X (3, *batch), as rows."""
    length, zero = norm((X[0], X[1])), jnp.zeros_like(X[0])
    cosine, sine = X[0] / length, X[1] / length
    rows = [(cosine, sine, zero), (-sine, cosine, zero), (zero, zero, zero + 1.0)]
    return {(i, j): component for i, row in enumerate(rows) for j, component in enumerate(row)}


def solids(body: Body, stencils: Stencils) -> list[Solid]:
    """What is known at the points of each layer."""
    jacobian = components(jnp.einsum("qka,iac->ikqc", stencils.cells, body.X))
    dV = det(jacobian) * jnp.asarray(stencils.weights)[:, None]
    to_local = stacked(product(inverse(jacobian), transpose(components(body.axes))))
    return [
        Solid(material=material, to_local=to_local[..., first:last], dV=dV[:, first:last])
        for material, (first, last) in zip(body.materials, body.mesh.layer_cells, strict=True)
    ]


def pressure_stiffness(solid: Solid, stencils: Stencils) -> Array:
    """Inverse of M = int N_m N_n / bulk dV of each cell, kPa/mm^3, (n_m, n_m, n_cells).

    Where linear pressures have a modulus of their own, k (`Element.linear_modulus` shear moduli times how
    long the cell is along the artery over across it, h_z (h_r^-2 + h_theta^-2)^1/2), it is
    k (int N_m N_n dV)^-1 and what is missing to the bulk modulus in the mean pressure: a uniform change of
    volume has a uniform pressure, whatever the cell's form.
    """
    products = lambda weights: jnp.einsum("mq,nq,qc->cmn", stencils.modes, stencils.modes, weights)  # noqa: E731
    material, linear = solid.material, stencils.linear_modulus
    if linear is None:
        return jnp.moveaxis(jnp.linalg.inv(products(solid.dV / material.bulk)), 0, -1)
    V = jnp.sum(solid.dV, axis=0)
    per_length = jnp.sqrt(jnp.sum(solid.to_local**2, axis=1))  # 2 / h along each local axis
    elongation = jnp.hypot(per_length[0], per_length[1]) / per_length[2]
    k = linear * jnp.sum(material.c * elongation * solid.dV, axis=0) / V
    mean = 1.0 / jnp.sum(solid.dV / material.bulk, axis=0)
    return (k * jnp.moveaxis(jnp.linalg.inv(products(solid.dV)), 0, -1)).at[0, 0].add(mean - k / V)


def facet_areas(body: Body, rule: FacetRule, outer: bool) -> Array:
    """Stress-free area of the points of the outer (or inner) facets, mm^2, (n_q, n_facets)."""
    mesh, element = body.mesh, body.mesh.element
    face = element.node_grid[:, 0] == (element.order if outer else 0)
    X = body.X[:, face][..., mesh.outer_cells if outer else mesh.inner_cells]
    tangents = jnp.einsum("qka,iac->kiqc", rule.dN, X)
    return norm(cross(tangents[0], tangents[1])) * jnp.asarray(rule.weights)[:, None]
