"""Strain-energy functions of the arterial wall. A material sees one deformation gradient.

F gives its components by `F[i, j]`, batch axes last; its *columns* belong to the material axes
(radial, circumferential, axial) of the stress-free layer, so that a fibre family is the constant
vector of Eq. (6) and no law needs to know where in the artery it sits. Energies are per unit
stress-free volume, in kPa. Stresses and moduli follow by differentiation and are written nowhere.

Equation numbers are those of Gasser, Schulze-Bauer & Holzapfel, J Biomech Eng 124 (2002) 355.
"""

from __future__ import annotations

import abc

import jax.numpy as jnp
from jax import Array

from jaxclamp.core.records import quantity, record, static
from jaxclamp.core.tensors import Tensor, det, exponential_stiffening, squared_norm, total


class Material(abc.ABC):
    """psi(F) = U(J) + psi_bar(F), the penalty form of Eq. (1).

    A law is one record with `c` (its shear modulus), `bulk`, its other constants, and `psi_bar`.
    Elements evaluate psi_bar at the points and U with the dilatation averaged over the cell.
    """

    law: str
    """name in scene files"""
    c: Array
    """shear modulus, kPa"""
    bulk: Array
    """bulk modulus, kPa"""

    @abc.abstractmethod
    def psi_bar(self, F: Tensor) -> Array:
        """Energy of the change of shape (and of fibres), kPa; +inf where det F <= 0."""

    def U(self, J: Array) -> Array:
        """Energy of the change of volume, kPa: Eq. (3), bulk/2 (J - 1)**2."""
        return self.bulk / 2.0 * (J - 1.0) ** 2

    def psi(self, F: Tensor) -> Array:
        """Strain energy per stress-free volume, kPa."""
        return self.U(det(F)) + self.psi_bar(F)


def _isochoric_scale(F: Tensor) -> tuple[Array, Array]:
    """det F > 0, and (det F)**(-2/3) (1 where the determinant is not positive)."""
    J = det(F)
    inside = J > 0.0
    return inside, jnp.where(inside, J, 1.0) ** (-2.0 / 3.0)


def _matrix(c: Array, F: Tensor, scale: Array) -> Array:
    """c/2 (I1_bar - 3), the ground substance; c is the shear modulus."""
    return c / 2.0 * (scale * squared_norm(F) - 3.0)


def _stretch_squared(F: Tensor, angle: Array) -> tuple[Array, Array]:
    """I4 = |F a0|**2 of the two families a0 = (0, cos b, +-sin b), Eq. (6)."""
    hoop = [jnp.cos(angle) * F[i, 1] for i in range(3)]
    axial = [jnp.sin(angle) * F[i, 2] for i in range(3)]
    plus = total((h + a) ** 2 for h, a in zip(hoop, axial, strict=True))
    minus = total((h - a) ** 2 for h, a in zip(hoop, axial, strict=True))
    return plus, minus


@record
class NeoHookean(Material):
    """Isotropic ground substance only: c/2 (I1_bar - 3)."""

    law: str = static("neo-hookean")
    c: Array = quantity("kPa", 1e-6, 1e9)
    """shear modulus"""
    bulk: Array = quantity("kPa", 1e-3, 1e12)
    """bulk modulus, the penalty on the change of volume"""

    def psi_bar(self, F: Tensor) -> Array:
        inside, scale = _isochoric_scale(F)
        return jnp.where(inside, _matrix(self.c, F, scale), jnp.inf)


@record
class HGO(Material):
    """Two families of collagen fibres in a neo-Hookean matrix, Eq. (4).

    `fibre_energy = "eq4"` is the energy as printed; its fibre stress is k1 E exp(k2 E**2).
    `fibre_energy = "eq10"` has the stress printed in Eq. (10), k1 E (exp(k2 E**2) - 1), which is
    the derivative of k1/(2 k2) (exp(k2 E**2) - 1 - k2 E**2) and not of Eq. (4).
    `fibre_invariant = "isochoric"` stretches fibres by F_bar (the seed); `"full"` by F, so that
    fibres feel a change of volume ("modified anisotropic", Nolan et al. 2014).
    """

    law: str = static("hgo")
    c: Array = quantity("kPa", 1e-6, 1e9)
    """shear modulus of the ground substance"""
    k1: Array = quantity("kPa", 0.0, 1e9)
    """fibre stiffness"""
    k2: Array = quantity("", 0.0, 1e4)
    """fibre stiffening, no unit"""
    fibre_angle: Array = quantity("deg", 0.0, 90.0)
    """angle of both families from the circumferential direction"""
    bulk: Array = quantity("kPa", 1e-3, 1e12)
    """bulk modulus, the penalty on the change of volume"""
    fibre_energy: str = static("eq4", choices=("eq4", "eq10"))
    fibre_invariant: str = static("isochoric", choices=("isochoric", "full"))

    def psi_bar(self, F: Tensor) -> Array:
        inside, scale = _isochoric_scale(F)
        fibre_scale = scale if self.fibre_invariant == "isochoric" else 1.0
        energy = _matrix(self.c, F, scale)
        for I4 in _stretch_squared(F, self.fibre_angle):
            E = jnp.maximum(fibre_scale * I4 - 1.0, 0.0)  # fibres carry tension only
            fibre = exponential_stiffening(self.k2, E)
            if self.fibre_energy == "eq10":
                fibre = fibre - E * E / 2.0
            energy = energy + self.k1 * fibre
        return jnp.where(inside, energy, jnp.inf)


@record
class GOH(Material):
    """Dispersed fibres: E = d (I1_bar - 3) + (1 - 3 d) (I4_bar - 1), tension only (E > 0).

    Gasser, Ogden & Holzapfel, J R Soc Interface 3 (2006) 15. Dispersion 0 gives the HGO law
    of Eq. (4), dispersion 1/3 an isotropic one.
    """

    law: str = static("goh")
    c: Array = quantity("kPa", 1e-6, 1e9)
    """shear modulus of the ground substance"""
    k1: Array = quantity("kPa", 0.0, 1e9)
    """fibre stiffness"""
    k2: Array = quantity("", 0.0, 1e4)
    """fibre stiffening, no unit"""
    dispersion: Array = quantity("", 0.0, 1.0 / 3.0)
    """0: all fibres along the mean direction; 1/3: equally in all directions"""
    fibre_angle: Array = quantity("deg", 0.0, 90.0)
    """mean angle of both families from the circumferential direction"""
    bulk: Array = quantity("kPa", 1e-3, 1e12)
    """bulk modulus, the penalty on the change of volume"""

    def psi_bar(self, F: Tensor) -> Array:
        inside, scale = _isochoric_scale(F)
        energy = _matrix(self.c, F, scale)
        I1_part = self.dispersion * (scale * squared_norm(F) - 3.0)
        for I4 in _stretch_squared(F, self.fibre_angle):
            E = I1_part + (1.0 - 3.0 * self.dispersion) * (scale * I4 - 1.0)
            energy = energy + self.k1 * exponential_stiffening(self.k2, jnp.maximum(E, 0.0))
        return jnp.where(inside, energy, jnp.inf)
