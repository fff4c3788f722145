"""Energy densities at points: the one place where materials, jaws and contact law meet the mesh.

A density is a pointwise scalar `density(y, q, here)`, in uJ: y holds what the term's stencil gives at the
points, by components [which, component], each (n_q points, n_cells); q the rigid coordinates (`RIGID`), each
a number or (n_q, n_cells); `here` what is known there, batch axes last. Nothing here knows of nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.records import record, static
from jaxclamp.core.tensors import Tensor, Vector, cross, det, product, transpose
from jaxclamp.fem.stencils import FacetRule
from jaxclamp.physics.contact import Contact
from jaxclamp.physics.jaws import Jaw
from jaxclamp.physics.materials import Material

Rigid = Sequence[Array] | Array
Density = Callable[[Tensor, Rigid, Any], Array]

RIGID = ("jaw_height",)
"""rigid coordinates q: the height of the upper jaw's lowest point above the artery's axis, mm; where both
jaws are modelled, the lower one is its mirror image"""


def rigid(height: float) -> Array:
    """Rigid coordinates, (n_q,), mm, all at one height."""
    return jax.device_put(np.full(len(RIGID), float(height)))


@record
class Solid:
    """What is known at the quadrature points of cells."""

    material: Material
    """constants are numbers, or arrays (n_q, n_cells) with a value for each point"""
    to_local: Array
    """d xi / d X in material axes: F = dx/dxi @ to_local, (3, 3, n_q, n_cells)"""
    dV: Array
    """stress-free volume of a point, mm^3, (n_q, n_cells)"""


def deformation(y: Tensor, solid: Solid) -> dict[tuple[int, int], Array]:
    """Deformation gradient, its columns along the material axes; y: tangents dx/dxi."""
    return product(transpose(y), solid.to_local)


def shape_energy(y: Tensor, q: Rigid, here: Solid) -> Array:
    """psi_bar(F) dV, the wall's energy but for its change of volume."""
    return here.material.psi_bar(deformation(y, here)) * here.dV


def dilatation(y: Tensor, here: Solid) -> Array:
    """(J - 1) dV, mm^3: the change of volume at the points."""
    return (det(y) * det(here.to_local) - 1.0) * here.dV


def mixed_energy(y: Tensor, p: Array, here: Solid) -> Array:
    """[psi_bar(F) + p (J - 1)] dV: the wall with the pressure p of its cells, kPa, (n_q, n_cells)."""
    F = deformation(y, here)
    return (here.material.psi_bar(F) + p * (det(F) - 1.0)) * here.dV


@record
class Blood:
    """Blood in the lumen."""

    pressure: Array
    """kPa"""
    weights: Array
    """of the points of a facet, (n_q, 1)"""


def swept_volume(y: Tensor, weights: Array) -> Array:
    """Part of the lumen's volume, 1/2 (x n_x + y n_y) da, mm^3; the ends are planar, so no end term.

    y: position and its circumferential and axial derivatives
    """
    normal = cross([y[1, i] for i in range(3)], [y[2, i] for i in range(3)])
    return 0.5 * (y[0, 0] * normal[0] + y[0, 1] * normal[1]) * weights


def blood_energy(y: Tensor, q: Rigid, here: Blood) -> Array:
    """Minus pressure times volume: a follower load on the lumen."""
    return -here.pressure * swept_volume(y, here.weights)


@record
class Touch:
    """Contact of the outer wall with one jaw."""

    jaw: Jaw
    """its shape"""
    contact: Contact
    """its law"""
    dA: Array
    """stress-free outer area of a point, mm^2, (n_q, n_facets)"""
    rule: FacetRule
    """where the points of a facet are"""
    side: int = static(default=1)
    """1: the upper jaw, -1: the lower one, its mirror image in y = 0"""


def jaw_gap(x: Vector, q: Rigid, here: Touch) -> Array:
    """Distance of points x (components first) from the jaw, mm, positive where open."""
    return here.jaw.gap((x[0], here.side * x[1] - q[0], x[2]))


def jaw_energy(y: Tensor, q: Rigid, here: Touch) -> Array:
    """Contact energy of the outer wall; y: position."""
    return here.contact.energy(jaw_gap([y[0, i] for i in range(3)], q, here)) * here.dA


def contact_pressure(gap: Array, here: Touch) -> Array:
    """Contact force per stress-free area, kPa, of gaps (n_q, n_facets)."""
    return -jax.grad(lambda g: jnp.sum(here.contact.energy(g)))(gap)


@record
class Meeting:
    """Contact of the inner wall with the opposite one, in the plane between them."""

    contact: Contact
    """its law"""
    dA: Array
    """stress-free area of a point of the lumen's surface, mm^2, (n_q, n_facets)"""
    rule: FacetRule
    """where the points of a facet are"""
    plane: Array
    """height of the plane, mm"""
    side: int = static(default=1)
    """1: the upper wall, which stays above the plane, -1: the lower one"""


def intima_energy(y: Tensor, q: Rigid, here: Meeting) -> Array:
    """Contact energy of the lumen's surface against its mirror image; y: position.

    By symmetry the opposite walls meet in a plane (y = 0). Contact sets in where the wall crosses it: beside
    the fold the open wall comes arbitrarily close.
    """
    return here.contact.intima_energy(here.side * (y[0, 1] - here.plane)) * here.dA
