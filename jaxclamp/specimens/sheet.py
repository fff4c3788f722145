"""The homogeneous test: a flat piece of one layer, pulled along and around, free through its thickness."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxclamp.physics.materials import Material
from jaxclamp.specimens.energy import over_radial
from jaxclamp.specimens.roots import root

NARROWEST, WIDEST = 0.1, 3.0
"""range of the stretch across that is looked at in a uniaxial test"""


class Sheet(NamedTuple):
    """Stretches and stresses of a sheet, all (n,)."""

    circumferential_stretch: Array
    """current over stress-free length"""
    axial_stretch: Array
    """current over stress-free length"""
    circumferential_stress: Array
    """Cauchy stress, kPa"""
    axial_stress: Array
    """Cauchy stress, kPa"""


def biaxial(material: Material, circumferential: Array, axial: Array) -> Sheet:
    """At both stretches (n,), with no stress through the thickness."""
    return Sheet(circumferential, axial, *over_radial(material, circumferential, axial))


def uniaxial_axial(material: Material, axial: Array) -> Sheet:
    """Pulled along the artery to stretches (n,), free around it."""
    across = root(
        lambda s: over_radial(material, s, axial)[0],
        jnp.full_like(axial, NARROWEST),
        jnp.full_like(axial, WIDEST),
    )
    return biaxial(material, across, axial)


def uniaxial_circumferential(material: Material, circumferential: Array) -> Sheet:
    """Pulled around the artery to stretches (n,), free along it."""
    across = root(
        lambda s: over_radial(material, circumferential, s)[1],
        jnp.full_like(circumferential, NARROWEST),
        jnp.full_like(circumferential, WIDEST),
    )
    return biaxial(material, circumferential, across)
