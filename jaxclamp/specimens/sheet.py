"""The homogeneous test: a flat piece of one layer, pulled along and around, free through its thickness."""

from __future__ import annotations

from collections.abc import Callable
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


def flat_piece(
    material: Material, circumferential_stretch: Array | None = None, axial_stretch: Array | None = None
) -> Sheet:
    """A piece at stretches (n,), with no stress through its thickness; free in the direction that is not
    given.

    Raises TypeError if neither is given.
    """
    if circumferential_stretch is not None and axial_stretch is not None:
        stretches = circumferential_stretch, axial_stretch
    elif axial_stretch is not None:
        stretches = (
            _across(lambda s: over_radial(material, s, axial_stretch)[0], axial_stretch),
            axial_stretch,
        )
    elif circumferential_stretch is not None:
        across = _across(
            lambda s: over_radial(material, circumferential_stretch, s)[1], circumferential_stretch
        )
        stretches = circumferential_stretch, across
    else:
        raise TypeError("expected a circumferential stretch, an axial stretch, or both")
    return Sheet(*stretches, *over_radial(material, *stretches))


def _across(stress: Callable[[Array], Array], like: Array) -> Array:
    """The stretch of the free direction, at which it has no stress."""
    return root(stress, jnp.full_like(like, NARROWEST), jnp.full_like(like, WIDEST))
