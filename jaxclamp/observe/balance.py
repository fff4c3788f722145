"""Energy, forces and independent checks of one equilibrium, from the gradient of the potential."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from jaxclamp.core.records import record
from jaxclamp.core.tensors import total
from jaxclamp.observe.equilibria import Equilibria
from jaxclamp.observe.measures import jaw_forces
from jaxclamp.observe.stresses import noise
from jaxclamp.potential.densities import swept_volume
from jaxclamp.potential.energy import energy, group_energy, group_points, lumen_volume
from jaxclamp.potential.terms import BLOOD, INTIMA, JAWS, Group, Potential


def between_walls(potential: Potential, x: Array) -> Array:
    """Force between the inner walls of the modelled part, summed over those walls, mN."""

    def at(plane: Array) -> Array:
        moved = potential.changed(INTIMA, lambda here: dataclasses.replace(here, plane=plane))
        return total(_energy_of(INTIMA, group, x, jnp.zeros(0)) for group in moved.of(INTIMA))

    return jax.grad(at)(jnp.zeros(()))


def _energy_of(name: str, group: Group, x: Array, q: Array) -> Array:
    """The part of one term of a group, uJ."""
    alone = tuple(term for term in group.terms if term.name == name)
    return group_energy(dataclasses.replace(group, terms=alone), x, q)


def _lifting_forces(e: Equilibria, name: str) -> Array:
    """Vertical force of the wall on what a term presses it against, by group, mN, (n_groups,)."""
    up = jnp.zeros_like(e.last.x).at[:, 1].set(1.0)
    along = lambda group, x: _energy_of(name, group, x, e.last.q)  # noqa: E731
    of = lambda group: jax.jvp(lambda x: along(group, x), (e.last.x,), (up,))[1]  # noqa: E731
    return jnp.stack([of(group) for group in e.potential.of(name)])


@record
class Balance:
    """Energy, forces on the jaws, and the checks of equilibrium.

    They come from the gradient of the potential, term by term, not from the condensed system that was solved.
    """

    energy: Array
    """of wall, blood and contact of the whole artery, uJ"""
    residual: Array
    """norm of the forces on free nodes, mN"""
    jaw_force: Array
    """on one jaw of the whole artery, mN"""
    inner_force: Array
    """between opposite inner walls of the whole artery, mN"""
    error: Array
    """of the vertical balance, see `balance`"""


def balance(e: Equilibria) -> Balance:
    """Vertical balance of the modelled part: supports, pressure and inner walls against the jaws; and, where
    both are modelled, of the jaws against each other.

    Relative to the largest of them, or, where all vanish, to a thousandth of the wall's other forces, or to
    what rounding leaves of none.
    """
    x, q, free = e.last.x, e.last.q, e.potential.layout.free
    pressure = e.potential.of(BLOOD)[0].here(BLOOD).pressure
    stored, elastic = e.wall()
    outside = e.potential.at_pressure(0.0).surfaces
    of_surfaces, on_surfaces = jax.value_and_grad(energy, argnums=1)(outside, x, q)
    stored, elastic = stored + of_surfaces, elastic + on_surfaces
    volume, swelling = jax.value_and_grad(lumen_volume, argnums=1)(e.potential, x)
    jaws, inner = jaw_forces(e.potential, x, q), between_walls(e.potential, x)
    lifted = [_lifting_forces(e, name) for name in (JAWS, INTIMA)]
    held = jnp.ones(x.size).at[free].set(0.0).reshape(x.shape)[:, 1]
    pushed = pressure * _lifting(e)
    supports = (elastic[:, 1] - pushed) * held
    imbalance = jnp.abs(jnp.sum(supports) + jnp.sum(pushed) - total(map(jnp.sum, lifted)))
    if len(jaws) > 1:
        imbalance = jnp.maximum(imbalance, jnp.abs(jnp.sum(lifted[0])))
    sizes = [jnp.max(jnp.abs(jaws)), jnp.sum(pushed), jnp.sum(jnp.abs(supports))]
    largest = jnp.max(jnp.stack(sizes))
    return Balance(
        energy=e.marks.symmetry.parts * (stored - pressure * volume),
        residual=jnp.linalg.norm((elastic - pressure * swelling).ravel()[free]),
        jaw_force=e.marks.symmetry.parts_of_a_jaw * jnp.sum(jaws),
        inner_force=e.marks.symmetry.parts_of_a_jaw * inner,
        error=imbalance / (jnp.maximum(largest, 1e-3 * jnp.linalg.norm(elastic)) + _noise(e)),
    )


def _noise(e: Equilibria) -> Array:
    """Force that counts as none: the noise of the stiffest layer's stress over the outer wall, mN."""
    area = total(jnp.sum(group.here(JAWS).dA) for group in e.potential.of(JAWS))
    levels = [noise(layer.solid.material) for layer in e.potential.layers]
    return area * jnp.max(jnp.stack(levels))


def _lifting(e: Equilibria) -> Array:
    """Vertical force of a unit pressure on each node, mm^2: int N n_y da, (n_nodes,)."""
    (group,) = e.potential.of(BLOOD)
    x, weights = e.last.x, group.here(BLOOD).weights

    def lifted(shift: Array) -> Array:
        y = group_points(group, x)
        raised = {**y, (0, 1): y[0, 1] + shift}
        return 2.0 * jnp.sum(swept_volume(raised, weights))

    # int N n_y da: the volume 1/2 (x n_x + y n_y) da changes by half of n_y da as a point is raised
    slope = jax.grad(lifted)(jnp.zeros((len(weights), group.nodes.shape[1])))
    at_corners = group.stencil[:, 0].T @ slope
    return jnp.zeros(x.shape[0]).at[group.nodes].add(at_corners)
