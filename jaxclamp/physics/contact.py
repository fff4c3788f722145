"""Frictionless contact as an energy of the gap."""

from __future__ import annotations

from jax import Array

from jaxclamp.core.records import quantity, record
from jaxclamp.core.tensors import half_square


@record
class Contact:
    """Smoothed penalties: the outer wall against a rigid jaw, and the inner wall against the opposite one."""

    stiffness: Array = quantity("kPa_per_mm", 1e-3, 1e12)
    """contact pressure per penetration"""
    smoothing: Array = quantity("mm", 1e-9, 10.0)
    """the pressure sets in at this gap, and is exactly stiffness * penetration below minus it"""

    intima_stiffness: Array = quantity("kPa_per_mm", 1e-3, 1e12)
    """pressure between opposite inner walls per overlap of one of them with the plane between them"""
    intima_smoothing: Array = quantity("mm", 1e-9, 10.0)
    """that pressure sets in as the walls touch, and rises linearly from an overlap of twice this on"""

    def energy(self, gap: Array) -> Array:
        """Energy per stress-free outer area, kPa mm, with continuous second derivative.

        gap: distance from the jaw, mm, positive where open, (*batch)
        """
        return self.stiffness * half_square(-gap, self.smoothing)

    def intima_energy(self, gap: Array) -> Array:
        """Energy per stress-free inner area, kPa mm, with continuous second derivative; 0 for open gaps.

        gap: distance of an inner wall from the plane where it meets the opposite one, mm, (*batch)
        """
        return self.intima_stiffness * half_square(-(gap + self.intima_smoothing), self.intima_smoothing)
