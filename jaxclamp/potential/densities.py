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
from jaxclamp.core.tensors import Tensor, Vector, cross, det, norm, product, total, transpose
from jaxclamp.fem.stencils import FacetRule
from jaxclamp.physics.contact import Contact
from jaxclamp.physics.jaws import Jaw
from jaxclamp.physics.materials import Material
from jaxclamp.physics.placement import Placement

Rigid = Sequence[Array] | Array
Density = Callable[[Tensor, Rigid, Any], Array]

RIGID = ("jaw_height", "clamp_height", "side_force")
"""rigid coordinates q: how high the upper jaw's lowest line is above the clamp's middle, and the lower one's
below it, mm; where both jaws are modelled, how high that middle is above the artery's axis, mm: no force but
the jaws' acts on the clamp, so that both press alike; and, where jaws may push the artery aside, the force on
the modelled part that holds its section at mid-length where it is on average, mN (see `side_energy`)"""


def rigid(height: float, n_rigid: int = 1) -> Array:
    """Rigid coordinates, (n_q,), mm, of jaws at a height in a clamp whose middle is on the axis."""
    return jax.device_put(height * np.eye(1, n_rigid)[0])


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
    placement: Placement
    """how it lies across the artery and closes"""
    contact: Contact
    """its law"""
    dA: Array
    """stress-free outer area of a point, mm^2, (n_q, n_facets)"""
    rule: FacetRule
    """where the points of a facet are"""
    side: int = static(default=1)
    """1: the upper jaw, -1: the lower one, seen in its mirror image in the clamp's middle"""
    floats: bool = static(default=False)
    """the clamp's middle is a rigid coordinate, the second one"""


def jaw_gap(x: Vector, q: Rigid, here: Touch) -> Array:
    """Distance of points x (components first) from the jaw, mm, positive where open."""
    above = here.side * (x[1] - q[1]) if here.floats else here.side * x[1]
    return here.placement.gap(here.jaw, (x[0], above, x[2]), q[0])


def jaw_energy(y: Tensor, q: Rigid, here: Touch) -> Array:
    """Contact energy of the outer wall; y: position."""
    return here.contact.energy(jaw_gap([y[0, i] for i in range(3)], q, here)) * here.dA


def contact_pressure(gap: Array, here: Touch) -> Array:
    """Contact force per stress-free area, kPa, of gaps (n_q, n_facets)."""
    return -jax.grad(lambda g: jnp.sum(here.contact.energy(g)))(gap)


@record
class Meeting:
    """Contact of the upper inner wall with the opposite one."""

    contact: Contact
    """its law"""
    dA: Array
    """stress-free area of a point of one wall, mm^2, (n_q, n_facets)"""
    rule: FacetRule
    """where the points of a facet are"""
    plane: Array
    """how far towards each wall the middle is moved, mm: 0, or for a derivative"""
    both: bool = static(default=False)
    """both walls are modelled; else the lower one is the mirror image of the upper one in y = 0"""


def half_gap(y: Tensor, here: Meeting) -> Array:
    """Half the gap between opposite inner walls, mm; y: position, or place and tangents of both walls.

    A point of the upper wall faces that of the lower one which was its mirror image in the open artery, and
    the gap is their distance along the mean normal of both walls there: where both are mirror images still,
    twice the height above the plane y = 0. A point that has slipped along the wall by s is judged by s^2
    times the wall's curvature too far or too near.
    """
    if not here.both:
        return y[0, 1] - here.plane
    upper, lower = (cross([y[c, i] for i in range(3)], [y[c + 1, i] for i in range(3)]) for c in (1, 4))
    up = [a + b for a, b in zip(upper, lower, strict=True)]
    apart = total((y[0, i] - y[3, i]) * up[i] for i in range(3)) / norm(up)
    return 0.5 * apart - here.plane


def intima_energy(y: Tensor, q: Rigid, here: Meeting) -> Array:
    """Contact energy of opposite inner walls.

    Contact sets in where they cross: beside the fold the open wall comes arbitrarily close.
    """
    walls = 2.0 if here.both else 1.0
    return walls * here.contact.intima_energy(half_gap(y, here)) * here.dA


@record
class Hold:
    """What holds the artery sideways between the jaws."""

    share: Array
    """of each node of the section at mid-length, (1, 1)"""
    place: int = static()
    """of the force among the rigid coordinates"""


def side_energy(y: Tensor, q: Rigid, here: Hold) -> Array:
    """Force times mean sideways displacement of the section at mid-length; y: position.

    A Lagrange multiplier for a mean of 0: friction under the jaws, which is not modelled, would hold the
    artery where it was clamped; the force, shared out evenly over the section, is what it would have to hold.
    """
    return q[here.place] * here.share * y[0, 0]
