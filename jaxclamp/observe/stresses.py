"""Stress and contact pressure at quadrature points.

Everything is a JAX function of potential and state, so that it can be differentiated.

Axial stress is the Cauchy stress along the artery's axis, sigma_zz, as in the seed's maps.
Circumferential and radial stress are those along the deformed image of the stress-free
circumferential and radial lines: the wall carries these directions with it when it flattens.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from jaxclamp.core.records import record
from jaxclamp.core.tensors import Tensor, components, cross, det, largest_eigenvalue, norm, total
from jaxclamp.physics.materials import Material
from jaxclamp.potential.densities import contact_pressure, jaw_gap
from jaxclamp.potential.energy import (
    State,
    at_points,
    condensed_pressures,
    gather,
    group_points,
    stacked_at_points,
)
from jaxclamp.potential.tangent import Piece, cut, joined, whole
from jaxclamp.potential.terms import JAWS, Group, Potential
from jaxclamp.potential.wall import kirchhoff_stress, wall_energy

NOISE, NOISE_OF_BULK = 1e-6, 1e-12
"""a stress below this part of the shear modulus, or of the bulk modulus, is what tolerance and rounding
leave of none"""


def noise(material: Material) -> Array:
    """Stress of a layer that counts as none, kPa."""
    return NOISE * jnp.max(material.c) + NOISE_OF_BULK * jnp.max(material.bulk)


def cauchy_stress(cells: Piece) -> tuple[Tensor, Tensor]:
    """Deformation gradient and Cauchy stress (kPa) by components, each (n_q, n_cells), Eqs. (7) to (9).

    sigma = p I + (1/J) d psi_bar/dF F', with the pressure of the cell; F has its columns along the
    material axes. cells: a piece of the wall
    """
    solid = cells.heres[0]
    assert cells.pressures is not None
    F, J, tau = kirchhoff_stress(stacked_at_points(cells.stencil, cells.x), solid)
    p = jnp.einsum("mq,mc->qc", cells.pressures.modes, cells.pressures.p)
    sigma = tau / J + jnp.eye(3)[:, :, None, None] * p
    return components(F), components(sigma)


def strain_energy(cells: Piece) -> Array:
    """Strain energy of each cell over its stress-free volume, kPa, (n_cells,), pressures at their best."""
    solid, known = cells.heres[0], cells.pressures
    assert known is not None
    shape, dilated = wall_energy(stacked_at_points(cells.stencil, cells.x), solid)
    D = jnp.einsum("mq,qc->mc", known.modes, dilated)
    volume = 0.5 * jnp.sum(D * condensed_pressures(known.stiffness, D), axis=0)
    return (jnp.sum(shape, axis=0) + volume) / jnp.sum(solid.dV, axis=0)


def along(F: Tensor, sigma: Tensor, axis: int) -> Array:
    """Normal stress along the deformed image of a material axis (0 radial, 1 circumferential), kPa."""
    t = [F[i, axis] for i in range(3)]
    squared_length = total(component * component for component in t)
    return total(t[i] * sigma[i, j] * t[j] for i in range(3) for j in range(3)) / squared_length


@record
class Stresses:
    """Stress at the quadrature points, kPa, each (n_q, n_cells)."""

    circumferential: Array
    """along the deformed image of the circumferential line"""
    axial: Array
    """along the artery's axis"""
    radial: Array
    """along the deformed image of the radial line"""
    greatest: Array
    """greatest principal stress"""
    J: Array
    """volume ratio"""


def piece_stresses(cells: Piece) -> Stresses:
    """Stress components of interest at the quadrature points of some cells of one layer."""
    F, sigma = cauchy_stress(cells)
    return Stresses(
        circumferential=along(F, sigma, 1),
        axial=sigma[2, 2],
        radial=along(F, sigma, 0),
        greatest=largest_eigenvalue(sigma),
        J=det(F),
    )


_piece_stresses = jax.jit(piece_stresses)


def stresses(potential: Potential, state: State) -> tuple[Stresses, ...]:
    """Stress components of interest at every quadrature point, by layer."""
    return tuple(
        joined(group, jax.device_get([_piece_stresses(cells) for cells in cut(group, state)]))
        for group in potential.layers
    )


def layer_stresses(potential: Potential, state: State, layer: int) -> Stresses:
    """The same for one layer, in one program that can be differentiated."""
    group = potential.layers[layer]
    return piece_stresses(whole(group, state))


def gaps(group: Group, state: State) -> Array:
    """Gap at the contact points of a group of jaw contact, mm, (n_q, n_facets)."""
    y = group_points(group, state.x)
    return jaw_gap([y[0, i] for i in range(3)], state.q, group.here(JAWS))


def node_gaps(group: Group, state: State) -> Array:
    """Gap of the nodes of a group of jaw contact, mm, (n_fn, n_facets)."""
    y = gather(state.x, group.nodes)
    return jaw_gap([y[:, i] for i in range(3)], state.q, group.here(JAWS))


def facet_contact(group: Group, state: State) -> tuple[Array, Array]:
    """Contact pressure on the deformed outer wall, kPa, and current area of the points, mm^2."""
    here = group.here(JAWS)
    y = at_points(here.rule.dN, gather(state.x, group.nodes))
    first, second = ([y[c, i] for i in range(3)] for c in range(2))
    da = norm(cross(first, second)) * jnp.asarray(here.rule.weights)[:, None]
    return contact_pressure(gaps(group, state), here) * here.dA / da, da


def touching(group: Group, state: State) -> tuple[Array, Array, Array]:
    """Contact pressure (kPa), area of the points (mm^2), and the share of each point in contact.

    A point counts as in contact where it presses with more than stiffness times smoothing, in part
    where it presses less, smoothly.
    """
    pressure, da = facet_contact(group, state)
    here = group.here(JAWS)
    onset = here.contact.stiffness * here.contact.smoothing
    share = jnp.clip(pressure * da / here.dA / onset, 0.0, 1.0)
    return pressure, da, share**2 * (3.0 - 2.0 * share)
