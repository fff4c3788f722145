"""The inflated, stretched, layered tube of residually stressed layers in closed form, but for quadrature.

Long, incompressible, each layer stress-free as an open sector of its own: the finite-element model of the
artery without a clamp, its bulk modulus gone to infinity and its ends far away. Everything is a JAX function
of the layers of a scene, whose constants and sectors can be differentiated. mm, kPa, mN, radians.

Kinematics and equilibrium: Holzapfel, Gasser & Ogden, J Elasticity 61 (2000) 1, secs. 5 and 6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.scenes.scene import Layer
from jaxclamp.specimens.energy import over_radial
from jaxclamp.specimens.roots import root

PANELS, POINTS = 4, 6
"""quadrature through a layer: panels (fibres that slacken inside one leave a kink), Gauss points in each"""
NARROWEST, WIDEST = 1e-3, 8.0
"""range of lumen radii that are looked at, over the mid-wall radius of the closed innermost layer"""


class State(NamedTuple):
    """The tube at given lumen radii and axial stretches, all (n,)."""

    inner_radius: Array
    """of the lumen, mm"""
    outer_radius: Array
    """mm"""
    pressure: Array
    """in the lumen, kPa"""
    reduced_force: Array
    """what a transducer at a closed end feels: the wall's axial force less that of the pressure on the lumen,
    mN"""

    @property
    def wall_force(self) -> Array:
        """Axial stress over the area of the wall, mN."""
        return self.reduced_force + math.pi * self.inner_radius**2 * self.pressure


def closed_share(layer: Layer) -> Array:
    """The sector's angle over 360 degrees, 1/k."""
    return 1.0 - layer.opening_angle / (2.0 * math.pi)


def section(layers: Sequence[Layer]) -> Array:
    """Cross-section of the wall at axial stretch 1 over pi, mm2: what incompressibility keeps."""
    parts = [((x.inner_radius + x.thickness) ** 2 - x.inner_radius**2) * closed_share(x) for x in layers]
    return sum(parts[1:], parts[0])


def inner_from_outer(layers: Sequence[Layer], outer_radius: Array, axial_stretch: Array) -> Array:
    """The lumen radius, mm, that goes with an outer radius; nearly 0 where the wall has no room."""
    squared = outer_radius**2 - section(layers) / axial_stretch
    least = (NARROWEST * _size(layers)) ** 2
    return jnp.sqrt(jnp.maximum(squared, least))


def _size(layers: Sequence[Layer]) -> Array:
    """Mid-wall radius of the innermost layer, closed, mm."""
    return (layers[0].inner_radius + 0.5 * layers[0].thickness) * closed_share(layers[0])


def at_radius(layers: Sequence[Layer], inner_radius: Array, axial_stretch: Array) -> State:
    """The tube at lumen radii and axial stretches (n,); the pressures may be negative.

    p = sum over layers of int (sigma_t - sigma_r) dr / r and F - pi r_i**2 p = pi sum of int (2 (sigma_z -
    sigma_r) - (sigma_t - sigma_r)) r dr, r**2 = r_i**2 + (R**2 - R_i**2) / (k l_z).
    """
    x, w = np.polynomial.legendre.leggauss(POINTS)
    at = jnp.asarray(((np.arange(PANELS)[:, None] + 0.5 * (x + 1.0)) / PANELS).ravel())[:, None]
    weights = jnp.asarray(np.tile(0.5 * w / PANELS, PANELS))[:, None]
    squared = inner_radius**2
    pressure, force = jnp.zeros_like(inner_radius), jnp.zeros_like(inner_radius)
    for layer in layers:
        share = closed_share(layer)
        R = layer.inner_radius + layer.thickness * at
        r = jnp.sqrt(squared + (R**2 - layer.inner_radius**2) * share / axial_stretch)
        stretches = r / (R * share), jnp.broadcast_to(axial_stretch, r.shape)
        hoop, axial = over_radial(layer.material, *stretches)
        r_dr = weights * layer.thickness * R * share / axial_stretch
        pressure = pressure + jnp.sum(hoop * r_dr / r**2, axis=0)
        force = force + math.pi * jnp.sum((2.0 * axial - hoop) * r_dr, axis=0)
        outer = layer.inner_radius + layer.thickness
        squared = squared + (outer**2 - layer.inner_radius**2) * share / axial_stretch
    return State(inner_radius, jnp.sqrt(squared), pressure, force)


def at_pressure(layers: Sequence[Layer], pressure: Array, axial_stretch: Array) -> State:
    """The tube at lumen pressures and axial stretches (n,).

    Where the pressure does not rise with the radius one of the radii is found; where none carries the
    pressure, a radius at the end of the range.
    """
    size = jnp.broadcast_to(_size(layers) / jnp.sqrt(axial_stretch), pressure.shape)
    excess = lambda r: at_radius(layers, r, axial_stretch).pressure - pressure  # noqa: E731
    state = at_radius(layers, root(excess, NARROWEST * size, WIDEST * size), axial_stretch)
    return state._replace(pressure=jnp.broadcast_to(pressure, size.shape))


def inflated_tube(layers: Sequence[Layer], axial_stretch: Array, **seen: Array) -> State:
    """The tube at axial stretches and one of `pressure`, `inner_radius` and `outer_radius`, all (n,); mm,
    kPa.

    Raises TypeError for another quantity, or none or several of them.
    """
    if len(seen) != 1 or not seen.keys() <= {"pressure", "inner_radius", "outer_radius"}:
        raise TypeError(
            f"expected one of pressure, inner_radius and outer_radius, found {', '.join(seen) or 'none'}"
        )
    ((quantity, value),) = seen.items()
    if quantity == "pressure":
        return at_pressure(layers, value, axial_stretch)
    if quantity == "outer_radius":
        value = inner_from_outer(layers, value, axial_stretch)
    return at_radius(layers, value, axial_stretch)
