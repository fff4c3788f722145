"""The round tube, closed, stretched and inflated, as one scalar problem: a start for Newton's method.

Without the clamp the artery stays a round tube. If its wall keeps its volume, one number says all,
the inner radius; the radius of least potential lies within the compressibility and the mesh error
of the finite-element answer, so that Newton needs three or four iterations instead of a walk.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.fem.elements import gauss
from jaxclamp.fem.grid import Mesh
from jaxclamp.fem.tube import closed_positions, sector_share
from jaxclamp.potential.energy import State, with_equilibrium_pressure
from jaxclamp.potential.terms import Potential
from jaxclamp.scenes.scene import Artery, MeshSettings

POINTS = 6
"""Gauss points through each layer"""
CANDIDATES = 600
"""radii tried"""
SMALLEST, LARGEST = 0.5, 4.0
"""range of radii, as parts of the load-free one"""


@jax.jit
def tube_potential(artery: Artery, inner_radius: Array) -> Array:
    """Potential per load-free length of an incompressible round tube, mN, for radii of any shape.

    Psi - pressure * V_lumen with r**2 = r_i**2 + (R**2 - R_i**2) / (k stretch), layer upon layer.
    """
    stretch = artery.axial_stretch
    points, weights = gauss(POINTS)
    inner_squared, energy = inner_radius[None] ** 2, jnp.zeros_like(inner_radius)
    for layer in artery.layers:
        share = sector_share(layer.opening_angle)
        column = lambda v: v.reshape(-1, *[1] * inner_radius.ndim)  # noqa: E731
        R = layer.inner_radius + layer.thickness * column(0.5 * (1.0 + jnp.asarray(points)))
        added = lambda S, ri=layer.inner_radius, k=share: (S**2 - ri**2) * k / stretch  # noqa: E731
        hoop = jnp.sqrt(inner_squared + added(R)) / (share * R)
        zero = jnp.zeros_like(hoop)
        F = {(i, j): zero for i in range(3) for j in range(3)}
        F |= {(0, 0): 1.0 / (hoop * stretch), (1, 1): hoop, (2, 2): zero + stretch}
        area = 2.0 * jnp.pi * share * R * column(0.5 * jnp.asarray(weights)) * layer.thickness
        energy = energy + jnp.sum(layer.material.psi_bar(F) * area, axis=0)
        inner_squared = inner_squared + added(layer.inner_radius + layer.thickness)
    return energy - artery.pressure * stretch * jnp.pi * inner_radius**2


def inflated_radius(artery: Artery, load_free_radius: float) -> float | None:
    """Inner radius at the artery's pressure and stretch, mm: the first minimum of the potential.

    None if the tube has none in reach. A minimum beside which the potential falls without end (a
    balloon) is found as well as any other: it is the one that inflation from no load comes to.
    """
    # constants that vary from point to point count with their mean: this is a start, not an answer
    artery = jax.tree_util.tree_map(lambda a: np.mean(a) if np.ndim(a) > 1 else np.asarray(a, float), artery)
    radii = load_free_radius * np.geomspace(SMALLEST, LARGEST, CANDIDATES)
    levels = np.asarray(tube_potential(artery, radii))
    inside = levels[1:-1]
    lowest = np.flatnonzero((inside < levels[:-2]) & (inside <= levels[2:])) + 1
    if lowest.size == 0:
        return None
    nearest = lowest[0]
    around = slice(nearest - 1, nearest + 2)
    a, b, _ = np.polyfit(radii[around] - radii[nearest], levels[around], 2)
    return float(radii[nearest] - b / (2.0 * a)) if a > 0.0 else float(radii[nearest])


def closed_tube(mesh: Mesh, settings: MeshSettings, artery: Artery) -> Array:
    """Load-free positions of the incompressible round tube that the sectors close to, mm, (n_nodes, 3)."""
    guess = closed_positions(mesh, settings, artery)
    radius = float(np.hypot(*np.asarray(guess)[0, :2]))
    alone = dataclasses.replace(artery, pressure=jnp.zeros(()), axial_stretch=jnp.ones(()))
    found = inflated_radius(alone, radius)
    return guess if found is None else inflated_positions(guess, 1.0, radius, found)


def inflated_tube(
    potential: Potential, artery: Artery, load_free: State, load_free_radius: float
) -> State | None:
    """The artery as an incompressible round tube at its stretch and pressure; None if there is none."""
    radius = inflated_radius(artery, load_free_radius)
    if radius is None:
        return None
    x = inflated_positions(load_free.x, float(artery.axial_stretch), load_free_radius, radius)
    return with_equilibrium_pressure(potential, x, load_free.q)


@jax.jit
def inflated_positions(x: Array, stretch: Array, load_free_radius: Array, radius: Array) -> Array:
    """Load-free positions x (n_nodes, 3) moved with an incompressible tube to a new inner radius, mm."""
    squared = x[:, 0] ** 2 + x[:, 1] ** 2
    moved = jnp.sqrt(radius**2 + (squared - load_free_radius**2) / stretch)
    share = (moved / jnp.sqrt(squared))[:, None]
    return x * jnp.concatenate([share, share, jnp.full_like(share, stretch)], axis=1)
