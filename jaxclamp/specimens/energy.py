"""An incompressible wall in the axes of its layer: one energy of two stretches, and its stresses.

Where the radial, circumferential and axial axes stay principal, incompressibility leaves two stretches: F =
diag(1 / (l_t l_z), l_t, l_z). The energy is then W(l_t, l_z) = psi_bar(F), of any law, and the stresses that
no pressure changes are its slopes (Holzapfel, Gasser & Ogden, J Elasticity 61 (2000) 1, sec. 3.3): sigma_t -
sigma_r = l_t dW/dl_t and sigma_z - sigma_r = l_z dW/dl_z.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from jaxclamp.physics.materials import Material


def energy(material: Material, hoop: Array, axial: Array) -> Array:
    """W, kPa, at circumferential and axial stretches of one shape."""
    radial, nothing = 1.0 / (hoop * axial), jnp.zeros_like(hoop)
    diagonal = (radial, hoop, axial)
    return material.psi_bar({(i, j): diagonal[i] if i == j else nothing for i in range(3) for j in range(3)})


def over_radial(material: Material, hoop: Array, axial: Array) -> tuple[Array, Array]:
    """Circumferential and axial Cauchy stress, kPa, each less the radial one; shapes as the stretches'."""
    slopes = jax.grad(lambda t, z: jnp.sum(energy(material, t, z)), argnums=(0, 1))(hoop, axial)
    return hoop * slopes[0], axial * slopes[1]
