"""The one place where materials, jaw and contact law meet the mesh: densities at points.

The potential of the modelled eighth is

    Pi(x, p; d) = sum_cells int [psi_bar(F) + p (J - 1)] dV - 1/2 p' M p     (wall)
                  - pressure * V_lumen(x) + int phi(gap(x; d)) dA            (blood, jaws)
                  + int phi(y + smoothing) dA                 (opposite inner walls)

with one or four pressures p per cell and M = int N_m N_n / bulk dV, so that at equilibrium
p = bulk (J - 1) averaged over the cell (mean dilatation, Q1/P0) or projected on the linear
functions (Q2/P1); d is the height of the jaw's lowest point above the artery's axis.

Everything is written over points with the batch axes (n_q points per cell, n_cells) last.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.records import record
from jaxclamp.core.tensors import (
    Tensor,
    Vector,
    components,
    cross,
    det,
    inverse,
    norm,
    product,
    stacked,
    transpose,
)
from jaxclamp.fem.elements import Element, lagrange, lobatto, tensor_rule
from jaxclamp.fem.tube import Mesh, stress_free_positions
from jaxclamp.physics.contact import Contact
from jaxclamp.physics.jaws import Jaw
from jaxclamp.physics.materials import Material
from jaxclamp.scenes.scene import Artery, MeshSettings


@record
class Parameters:
    """What the densities need to know of the scene, beside the geometry."""

    materials: tuple[Material, ...]
    contact: Contact
    jaw: Jaw


@record
class Stencils:
    """Shape functions at the quadrature points: the same numbers for every cell."""

    wall: np.ndarray
    """dN/dxi, (n_q, 3, n_en)"""
    modes: np.ndarray
    """pressure modes, (n_m, n_q)"""
    lumen: np.ndarray
    """N, dN/deta, dN/dzeta at the points of a facet, (n_fq, 3, n_fn)"""
    contact: np.ndarray
    """N at the contact points of an outer facet, (n_cq, 1, n_fn)"""
    meeting: np.ndarray
    """N at the contact points of an inner facet, (n_mq, 1, n_fn)"""


@record
class Geometry:
    """The stress-free artery, seen from the quadrature points."""

    to_local: Array
    """d xi / d X in material axes: F = dx/dxi @ to_local, (3, 3, n_q, n_cells)"""
    dV: Array
    """stress-free volume of a point, mm^3, (n_q, n_cells)"""
    dA: Array
    """stress-free outer area of a contact point, mm^2, (n_cq, n_facets)"""
    dA_inner: Array
    """stress-free area of a contact point of the lumen's surface, mm^2, (n_mq, n_facets)"""
    pressure_stiffness: Array
    """inverse of M, kPa/mm^3, (n_m, n_m, n_cells)"""


def build_stencils(mesh: Mesh, settings: MeshSettings) -> Stencils:
    """Shape functions at the points of the cells and of the inner and outer facets."""
    element = mesh.element
    points, _ = element.quadrature()
    facet_points, _ = tensor_rule((element.points_per_axis,) * 2)
    (jaw_points, _), (meeting_points, _) = _contact_rules(element, settings)
    N, dN = lagrange(element.nodes_1d, facet_points)
    return Stencils(
        wall=element.shape(points)[1],
        modes=element.pressure_modes(points),
        lumen=np.concatenate([N[:, None], dN], axis=1),
        contact=lagrange(element.nodes_1d, jaw_points)[0][:, None],
        meeting=lagrange(element.nodes_1d, meeting_points)[0][:, None],
    )


def _contact_rules(element: Element, settings: MeshSettings) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Points and weights of contact with the jaw, and between inner walls.

    Where a wall crumples, single nodes go ahead of all points inside their facets: the inner walls
    meet at the nodes too (with quadratic elements an odd number of points has the middle ones).
    """
    n = settings.contact_points
    m = max(n, element.order + 1)
    m += element.order == 2 and m % 2 == 0
    return tensor_rule((n, n)), tensor_rule((m, m), lobatto)


@jax.jit
def build_geometry(mesh: Mesh, settings: MeshSettings, artery: Artery) -> Geometry:
    """Jacobians, volumes and areas of the stress-free artery; differentiable in every float."""
    element = mesh.element
    points, weights = element.quadrature()
    N, dN = element.shape(points)
    X = stress_free_positions(mesh, settings, artery)
    axes = transpose(_cylindrical_axes(jnp.einsum("qa,iac->iqc", N, X)))
    jacobian = components(jnp.einsum("qka,iac->ikqc", dN, X))
    dV = det(jacobian) * weights[:, None]
    bulk = jnp.concatenate(
        [
            jnp.full(last - first, layer.material.bulk)
            for layer, (first, last) in zip(artery.layers, mesh.layer_cells, strict=True)
        ]
    )
    modes = element.pressure_modes(points)
    M = jnp.einsum("mq,nq,qc->cmn", modes, modes, dV) / bulk[:, None, None]

    jaw_rule, meeting_rule = _contact_rules(element, settings)
    outer_face, inner_face = (element.node_grid[:, 0] == side for side in (element.order, 0))
    last = mesh.layer_cells[-1][0] + settings.radial[-1] - 1
    first_layer_end = mesh.layer_cells[0][1]

    def area(X_facet: Array, rule: tuple[np.ndarray, np.ndarray]) -> Array:
        points, weights = rule
        tangents = jnp.einsum("qka,iac->kiqc", lagrange(element.nodes_1d, points)[1], X_facet)
        return norm(cross(tangents[0], tangents[1])) * weights[:, None]

    return Geometry(
        to_local=stacked(product(inverse(jacobian), axes)),
        dV=dV,
        dA=area(X[:, outer_face, last :: settings.radial[-1]], jaw_rule),
        dA_inner=area(X[:, inner_face, : first_layer_end : settings.radial[0]], meeting_rule),
        pressure_stiffness=jnp.moveaxis(jnp.linalg.inv(M), 0, -1),
    )


def _cylindrical_axes(X: Array) -> Tensor:
    """Unit vectors (radial, circumferential, axial) at X (3, *batch), as rows."""
    length, zero = norm((X[0], X[1])), jnp.zeros_like(X[0])
    cosine, sine = X[0] / length, X[1] / length
    rows = [(cosine, sine, zero), (-sine, cosine, zero), (zero, zero, zero + 1.0)]
    return {(i, j): component for i, row in enumerate(rows) for j, component in enumerate(row)}


def wall_density(dx_dxi: Tensor, to_local: Tensor, dV: Array, material: Material, p: Array) -> Array:
    """[psi_bar(F) + p (J - 1)] dV at the points of some cells, uJ.

    dx_dxi: current tangents, [local direction, component], each (n_q, n_cells)
    p: pressure interpolated at the points, kPa, (n_q, n_cells)
    """
    F = product(transpose(dx_dxi), to_local)
    return (material.psi_bar(F) + p * (det(F) - 1.0)) * dV


def dilatation_density(dx_dxi: Tensor, to_local: Tensor, dV: Array) -> Array:
    """(J - 1) dV at the points, mm^3."""
    return (det(dx_dxi) * det(to_local) - 1.0) * dV


def lumen_density(y: Tensor, weights: Array) -> Array:
    """Part of the lumen's volume, 1/2 (x n_x + y n_y) da, mm^3; the ends are planar, so no end term.

    y: position and its circumferential and axial derivatives, [which, component], each (n_q, n_facets)
    """
    normal = cross([y[1, i] for i in range(3)], [y[2, i] for i in range(3)])
    return 0.5 * (y[0, 0] * normal[0] + y[0, 1] * normal[1]) * weights


def contact_density(y: Tensor, jaw_height: Array, jaw: Jaw, contact: Contact, dA: Array) -> Array:
    """Contact energy of the outer wall, uJ.

    y: current position, [0, component], each (n_q, n_facets); jaw_height: mm
    """
    return contact.energy(jaw_gap([y[0, i] for i in range(3)], jaw_height, jaw)) * dA


def intima_density(y: Tensor, plane: Array | float, contact: Contact, dA: Array) -> Array:
    """Contact energy of the lumen's surface against its mirror image, uJ.

    By symmetry the opposite walls meet in a plane (y = 0). The law of the jaws' contact, shifted so
    that it sets in where the wall crosses the plane: beside the fold the open wall comes arbitrarily
    close to it.
    """
    return contact.energy(y[0, 1] - plane + contact.smoothing) * dA


def jaw_gap(x: Vector, jaw_height: Array, jaw: Jaw) -> Array:
    """Distance of points x (components first) from a jaw whose lowest point is at `jaw_height`."""
    return jaw.gap((x[0], x[1] - jaw_height, x[2]))
