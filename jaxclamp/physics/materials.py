"""Strain-energy functions of the arterial wall. A material sees one deformation gradient.

F gives its components by `F[i, j]`, batch axes last; its *columns* belong to the material axes
(radial, circumferential, axial) of the stress-free layer, so that a fibre family is the constant
vector of Eq. (6) and no law needs to know where in the artery it sits. Energies are per unit
stress-free volume, in kPa. Stresses and moduli follow by differentiation and are written nowhere.

Equation numbers are those of Gasser, Schulze-Bauer & Holzapfel, J Biomech Eng 124 (2002) 355.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence

import jax.numpy as jnp
from jax import Array

from jaxclamp.core.records import quantity, record, static
from jaxclamp.core.tensors import (
    Tensor,
    Vector,
    det,
    exponential_growth,
    exponential_stiffening,
    safe_sqrt,
    squared,
    squared_norm,
    total,
)


class Material(abc.ABC):
    """psi(F) = U(J) + psi_bar(F), the penalty form of Eq. (1).

    A law is one record with `c` (its shear modulus), `bulk`, its other constants, and `psi_bar` - or, below
    `FibreLaw`, `psi_of` of its invariants, which is faster.
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

    def constituents(self, F: Tensor) -> list[Array]:
        """psi_bar by constituent, kPa; a law that does not tell them apart is one."""
        return [self.psi_bar(F)]


class FibreLaw(Material):
    """A law of I1, J and the I4 of fibre families: psi_bar is a function of these few numbers.

    Its tangent costs a fraction of what a law of all nine components of F does: the engine knows the
    derivatives of the invariants in closed form (`potential.wall`), and asks the law for those by these few.
    """

    @abc.abstractmethod
    def directions(self) -> tuple[Vector, ...]:
        """Unit vector of each fibre family along the material axes (radial, circumferential, axial)."""

    @abc.abstractmethod
    def psi_of(self, I1: Array, J: Array, I4: Sequence[Array]) -> Array:
        """psi_bar, kPa, of I1 = F : F, J = det F > 0, and I4 = |F a|**2 of each family."""

    def parts_of(self, I1: Array, J: Array, I4: Sequence[Array]) -> list[Array]:
        """psi_of by constituent, kPa, the matrix first; a law that does not tell them apart is one."""
        return [self.psi_of(I1, J, I4)]

    def constituents(self, F: Tensor) -> list[Array]:
        """parts_of the invariants of F; +inf where det F <= 0."""
        J = det(F)
        inside = J > 0.0
        I4 = [squared(v) for v in self.fibres(F)]
        parts = self.parts_of(squared_norm(F), jnp.where(inside, J, 1.0), I4)
        return [jnp.where(inside, part, jnp.inf) for part in parts]

    def psi_bar(self, F: Tensor) -> Array:
        """psi_of the invariants of F; +inf where det F <= 0."""
        return self.psi_of_invariants(squared_norm(F), det(F), [squared(v) for v in self.fibres(F)])

    def fibres(self, F: Tensor) -> list[Vector]:
        """F a of each family."""
        return [[total(a[k] * F[i, k] for k in range(3)) for i in range(3)] for a in self.directions()]

    def psi_of_invariants(self, I1: Array, J: Array, I4: Sequence[Array]) -> Array:
        """psi_of, and +inf where J <= 0."""
        inside = J > 0.0
        return jnp.where(inside, self.psi_of(I1, jnp.where(inside, J, 1.0), I4), jnp.inf)


def _matrix(c: Array, I1_bar: Array) -> Array:
    """c/2 (I1_bar - 3), the ground substance; c is the shear modulus."""
    return c / 2.0 * (I1_bar - 3.0)


def _two_families(angle: Array) -> tuple[Vector, Vector]:
    """a0 = (0, cos b, +-sin b), Eq. (6)."""
    nothing, hoop, axial = jnp.zeros_like(angle), jnp.cos(angle), jnp.sin(angle)
    return (nothing, hoop, axial), (nothing, hoop, -axial)


@record
class NeoHookean(FibreLaw):
    """Isotropic ground substance only: c/2 (I1_bar - 3)."""

    law: str = static("neo-hookean")
    c: Array = quantity("kPa", 1e-6, 1e9)
    """shear modulus"""
    bulk: Array = quantity("kPa", 1e-3, 1e12)
    """bulk modulus, the penalty on the change of volume"""

    def directions(self) -> tuple[Vector, ...]:
        return ()

    def psi_of(self, I1: Array, J: Array, I4: Sequence[Array]) -> Array:
        return _matrix(self.c, J ** (-2.0 / 3.0) * I1)


@record
class HGO(FibreLaw):
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

    def directions(self) -> tuple[Vector, ...]:
        return _two_families(self.fibre_angle)

    def psi_of(self, I1: Array, J: Array, I4: Sequence[Array]) -> Array:
        return total(self.parts_of(I1, J, I4))

    def parts_of(self, I1: Array, J: Array, I4: Sequence[Array]) -> list[Array]:
        scale = J ** (-2.0 / 3.0)
        fibre_scale = scale if self.fibre_invariant == "isochoric" else 1.0
        parts = [_matrix(self.c, scale * I1)]
        for stretch_squared in I4:
            E = jnp.maximum(fibre_scale * stretch_squared - 1.0, 0.0)  # fibres carry tension only
            fibre = exponential_stiffening(self.k2, E)
            if self.fibre_energy == "eq10":
                fibre = fibre - E * E / 2.0
            parts.append(self.k1 * fibre)
        return parts


@record
class GOH(FibreLaw):
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

    def directions(self) -> tuple[Vector, ...]:
        return _two_families(self.fibre_angle)

    def psi_of(self, I1: Array, J: Array, I4: Sequence[Array]) -> Array:
        return total(self.parts_of(I1, J, I4))

    def parts_of(self, I1: Array, J: Array, I4: Sequence[Array]) -> list[Array]:
        scale = J ** (-2.0 / 3.0)
        parts = [_matrix(self.c, scale * I1)]
        I1_part = self.dispersion * (scale * I1 - 3.0)
        for stretch_squared in I4:
            E = I1_part + (1.0 - 3.0 * self.dispersion) * (scale * stretch_squared - 1.0)
            parts.append(self.k1 * exponential_stiffening(self.k2, jnp.maximum(E, 0.0)))
        return parts


@record
class HSGR(FibreLaw):
    """Fibres that the ground's strain recruits, too: S = (1 - rho) (I1_bar - 3)**2 + rho <I4_bar - 1>**2.

    k1/(2 k2) (exp(k2 S) - 1) per family: Holzapfel, Sommer, Gasser & Regitnig, Am J Physiol 289 (2005)
    H2048. They write mu (I1 - 3) for c/2 (I1 - 3), so c = 2 mu, and let a family whose I4 <= 1 carry nothing:
    its energy then jumps there, by its share of I1. Here only the part of I4 ends (<x> is max(x, 0)), which
    is the same while fibres are stretched and continuous where they slacken. rho 1 gives the HGO law of Eq.
    (4), rho 0 an isotropic one.
    """

    law: str = static("hsgr2005")
    c: Array = quantity("kPa", 1e-6, 1e9)
    """shear modulus of the ground substance"""
    k1: Array = quantity("kPa", 0.0, 1e9)
    """fibre stiffness"""
    k2: Array = quantity("", 0.0, 1e4)
    """fibre stiffening, no unit"""
    rho: Array = quantity("", 0.0, 1.0)
    """0: isotropic; 1: fibres answer to their own stretch alone"""
    fibre_angle: Array = quantity("deg", 0.0, 90.0)
    """angle of both families from the circumferential direction"""
    bulk: Array = quantity("kPa", 1e-3, 1e12)
    """bulk modulus, the penalty on the change of volume"""

    def directions(self) -> tuple[Vector, ...]:
        return _two_families(self.fibre_angle)

    def psi_of(self, I1: Array, J: Array, I4: Sequence[Array]) -> Array:
        return total(self.parts_of(I1, J, I4))

    def parts_of(self, I1: Array, J: Array, I4: Sequence[Array]) -> list[Array]:
        scale = J ** (-2.0 / 3.0)
        parts = [_matrix(self.c, scale * I1)]
        ground = (1.0 - self.rho) * (scale * I1 - 3.0) ** 2
        for stretch_squared in I4:
            S = ground + self.rho * jnp.maximum(scale * stretch_squared - 1.0, 0.0) ** 2
            parts.append(self.k1 * exponential_growth(self.k2, S, self.k2 * S))
        return parts


@record
class Fung(FibreLaw):
    """An orthotropic exponential of the strains in the layer's surface, in a neo-Hookean matrix.

    c/2 (I1_bar - 3) + k1/2 (exp(Q) - 1), Q = b_t E_t**2 + b_z E_z**2 + 2 a sqrt(b_t b_z) E_t E_z with the
    Green strains E = (C_bar - 1)/2 around and along the artery: the form of Fung, Fronek & Patitucci, Am J
    Physiol 237 (1979) H620, their a_1, a_2, a_4 and c being b_t, b_z, a sqrt(b_t b_z) and k1. Written so, Q
    is never negative for couplings a from 0 to 1, which a free coefficient a_4 does not ensure (Holzapfel,
    Gasser & Ogden, J Elasticity 61 (2000) 1, sec. 3.2). The matrix is what a law of membrane strains lacks:
    it carries shear and what is radial.
    """

    law: str = static("fung")
    c: Array = quantity("kPa", 1e-6, 1e9)
    """shear modulus of the ground substance"""
    k1: Array = quantity("kPa", 0.0, 1e9)
    """stiffness of the exponential part"""
    b_circumferential: Array = quantity("", 0.0, 1e4)
    """stiffening around the artery, no unit"""
    b_axial: Array = quantity("", 0.0, 1e4)
    """stiffening along the artery, no unit"""
    coupling: Array = quantity("", 0.0, 1.0)
    """of both: the mixed coefficient over its largest possible, sqrt(b_t b_z)"""
    bulk: Array = quantity("kPa", 1e-3, 1e12)
    """bulk modulus, the penalty on the change of volume"""

    def directions(self) -> tuple[Vector, ...]:
        nothing, one = jnp.zeros_like(self.c), jnp.ones_like(self.c)
        return (nothing, one, nothing), (nothing, nothing, one)

    def psi_of(self, I1: Array, J: Array, I4: Sequence[Array]) -> Array:
        return total(self.parts_of(I1, J, I4))

    def parts_of(self, I1: Array, J: Array, I4: Sequence[Array]) -> list[Array]:
        scale = J ** (-2.0 / 3.0)
        E_t, E_z = (0.5 * (scale * stretch_squared - 1.0) for stretch_squared in I4)
        t, z = safe_sqrt(self.b_circumferential) * E_t, safe_sqrt(self.b_axial) * E_z
        Q = t * t + z * z + 2.0 * self.coupling * t * z
        return [_matrix(self.c, scale * I1), self.k1 * exponential_growth(jnp.ones_like(Q), Q, Q)]
