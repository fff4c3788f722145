"""How far the lumen is closed: what is left of it, and where opposite inner walls press on each other."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from jaxclamp.core.tensors import cross, norm, total
from jaxclamp.fem.landmarks import closed_length, lumen_area, lumen_height, lumen_opening
from jaxclamp.fem.stencils import FacetRule
from jaxclamp.observe.balance import between_walls
from jaxclamp.observe.equilibria import Equilibria
from jaxclamp.observe.measures import force_on_a_jaw
from jaxclamp.potential.densities import deformation, half_gap
from jaxclamp.potential.energy import State, at_points, gather, group_points
from jaxclamp.potential.terms import INTIMA, Group

NEAR_ENOUGH = 0.02
"""opposite inner walls count as met where they are within this part of the lumen radius in the body"""
CLOSED = 0.995
"""share of the lumen's area in the body that is gone where it counts as closed: blood does not pass through
what is left beside the fold"""
CARRIED = 0.005
"""least share of the jaw's force that inner walls carry, beyond blood pressure, where the lumen is closed"""
ROUNDING = 1e-6
"""of `closure` where it is 1"""
INSIDE = 2.0 / 3.0
"""away from the fold is within this part of the artery's width: the gap beside the fold begins beyond"""


def area_share(e: Equilibria) -> Array:
    """Area of the lumen at mid-length over that in the body."""
    return lumen_area(e.last.x, e.marks) / lumen_area(e.body.x, e.marks)


def opening(e: Equilibria) -> Array:
    """Greatest height of what is left of the lumen at mid-length, mm: once closed, beside the fold."""
    return lumen_opening(e.last.x, e.marks)


def length(e: Equilibria) -> Array:
    """Length along the artery over which the inner walls are near enough to be closed, mm."""
    return closed_length(e.last.x, e.marks, 0.5 * NEAR_ENOUGH * lumen_height(e.body.x, e.marks))


def overlap(e: Equilibria) -> Array:
    """How far opposite inner walls are past the plane between them, both together, mm."""
    (group,) = e.potential.of(INTIMA)
    return 2.0 * jnp.max(-half_gap(group_points(group, e.last.x), group.here(INTIMA)))


def carried(e: Equilibria) -> Array:
    """Share of the jaw's force that the inner walls press on each other with, beyond blood pressure."""
    inner = e.marks.symmetry.parts_of_a_jaw * between_walls(e.potential, e.last.x)
    force = force_on_a_jaw(e)
    pressed = force > 0.0
    return jnp.where(pressed, inner / jnp.where(pressed, force, 1.0), 0.0)


def closure(e: Equilibria) -> Array:
    """1 where the lumen is closed: the lesser of area gone over `CLOSED` and `carried` over `CARRIED`.

    By area alone a thin wall may be as good as closed before it touches the opposite one; by force alone a
    coarse fold pinches while the middle is open.
    """
    return jnp.minimum((1.0 - area_share(e)) / CLOSED, carried(e) / CARRIED)


def closed(e: Equilibria) -> Array:
    """True where no way for blood is left."""
    return closure(e) >= 1.0 - ROUNDING


def contact_area(e: Equilibria) -> Array:
    """Area over which the inner wall presses on the opposite one, mm^2, smoothly counted."""
    (group,) = e.potential.of(INTIMA)
    return e.marks.symmetry.parts_of_a_jaw * jnp.sum(_pressing(group, e.last))


def _pressing(group: Group, state: State) -> Array:
    """Current area of the points of the inner walls in contact, mm^2, (n_q, n_facets).

    In part where they press less than at the end of the law's smooth onset.
    """
    here, nodes = group.here(INTIMA), gather(state.x, group.nodes)
    da = total(_areas(here.rule, wall) for wall in jnp.split(nodes, 2 if here.both else 1))
    height = half_gap(group_points(group, state.x), here)
    pressure = -jax.grad(lambda gap: jnp.sum(here.contact.intima_energy(gap)))(height)
    onset = here.contact.intima_stiffness * here.contact.intima_onset
    share = jnp.clip(pressure / onset, 0.0, 1.0)
    return da * share**2 * (3.0 - 2.0 * share)


def _areas(rule: FacetRule, nodes: Array) -> Array:
    """Current area of the points of facets, mm^2, (n_q, n_facets); nodes: (n_fn, 3, n_facets)."""
    y = at_points(rule.dN, nodes)
    first, second = ([y[c, i] for i in range(3)] for c in range(2))
    return norm(cross(first, second)) * jnp.asarray(rule.weights)[:, None]


def fold_stretch_ratio(e: Equilibria) -> Array:
    """Least ratio of the stretches round the lumen and through the wall inside, see `notes.CREASE`.

    At the innermost points of the cells, along the deformed circumferential line and normal to the surface
    with it.
    """
    group = e.potential.layers[0]
    F = deformation(group_points(group, e.last.x), group.solid)
    round_, along = ([F[i, k] for i in range(3)] for k in (1, 2))
    J_over_normal = norm(cross(round_, along))  # area of the surface element; normal stretch = J / it
    J = total(F[i, 0] * c for i, c in enumerate(cross(round_, along)))
    return jnp.min(norm(round_) * J_over_normal / J)


def volumes_away_from_fold(e: Equilibria) -> tuple[Array, Array]:
    """Least and greatest J of points over the volume ratio of their cells, away from the fold.

    Where cells bend more than their nodes can say, points are squeezed beside others that are blown up: at
    the fold on every mesh that is not very fine; elsewhere it is the sign of a crumpled wall.
    """
    element = e.marks.element
    N = jnp.asarray(element.shape(element.quadrature()[0])[0])
    inside = INSIDE * jnp.max(jnp.abs(e.last.x[:, 0]))
    least, most = [], []
    for number, group in enumerate(e.potential.layers):
        assert group.volume is not None
        assert group.modes is not None
        p = jnp.einsum("mq,mc->qc", jnp.asarray(group.modes), e.last.p[:, slice(*group.volume.cells)])
        ratio = e.stresses(number).J / (1.0 + p / group.solid.material.bulk)
        away = jnp.abs(jnp.einsum("qa,ac->qc", N, e.last.x[group.nodes, 0])) < inside
        least.append(jnp.min(jnp.where(away, ratio, 1.0)))
        most.append(jnp.max(jnp.where(away, ratio, 1.0)))
    return jnp.min(jnp.stack(least)), jnp.max(jnp.stack(most))
