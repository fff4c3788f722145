"""Shape functions at quadrature points: the same numbers for every cell or facet of a mesh.

A stencil S[q, c, a] takes the positions x_a of a cell's nodes to what an energy density looks at, at point
q: y_c = sum_a S[q, c, a] x_a, tangents of a cell, or the position and tangents of a facet.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.records import record, static
from jaxclamp.fem.elements import Element, lagrange, lobatto, tensor_rule


@record
class FacetRule:
    """Points on a facet, with their weights and shape functions."""

    weights: np.ndarray
    """(n_q,)"""
    surface: np.ndarray
    """stencil of the position and its tangents by the facet's circumferential and axial coordinates,
    (n_q, 3, n_fn)"""

    @property
    def position(self) -> np.ndarray:
        """Stencil of the position, (n_q, 1, n_fn)."""
        return self.surface[:, :1]

    @property
    def of_two(self) -> Array:
        """Stencil of places and tangents of a facet, then of another whose nodes follow, (n_q, 6, 2 n_fn)."""
        ours = jnp.asarray(self.surface)
        nothing = jnp.zeros_like(ours)
        return jnp.block([[ours, nothing], [nothing, ours]])

    @property
    def dN(self) -> np.ndarray:
        """Stencil of the tangents, (n_q, 2, n_fn)."""
        return self.surface[:, 1:]


@record
class Stencils:
    """Everything that terms evaluate: cells, and facets with three rules."""

    cells: np.ndarray
    """tangents dN/dxi, (n_q, 3, n_en)"""
    weights: np.ndarray
    """of the cells' points, (n_q,)"""
    positions: np.ndarray
    """shape functions at the cells' points, (n_q, n_en)"""
    modes: np.ndarray
    """pressure modes, (n_m, n_q)"""
    linear_modulus: float | None = static()
    """of the modes beyond the first, in shear moduli; None: the bulk modulus"""
    lumen: FacetRule
    """of an inner facet, for blood pressure"""
    contact: FacetRule
    """of an outer facet, for contact with a jaw"""
    meeting: FacetRule
    """of an inner facet, for contact between inner walls"""


def facet_rule(element: Element, rule: tuple[np.ndarray, np.ndarray]) -> FacetRule:
    """A quadrature rule (points (n_q, 2), weights (n_q,)) on the facets of an element."""
    points, weights = rule
    N, dN = lagrange(element.nodes_1d, points)
    return FacetRule(weights=weights, surface=np.concatenate([N[:, None], dN], axis=1))


def build_stencils(element: Element, contact_points: int) -> Stencils:
    """Stencils of an element; contact_points: per facet and direction, at the jaws.

    Where a wall crumples, single nodes go ahead of all points inside their facets: the inner walls
    meet at the nodes too (with quadratic elements an odd number of points has the middle ones).
    """
    points, weights = element.quadrature()
    N, dN = element.shape(points)
    meeting = max(contact_points, element.order + 1)
    meeting += element.order == 2 and meeting % 2 == 0
    return Stencils(
        cells=dN,
        weights=weights,
        positions=N,
        modes=element.pressure_modes(points),
        linear_modulus=element.linear_modulus,
        lumen=facet_rule(element, tensor_rule((element.points_per_axis,) * 2)),
        contact=facet_rule(element, tensor_rule((contact_points,) * 2)),
        meeting=facet_rule(element, tensor_rule((meeting,) * 2, lobatto)),
    )
