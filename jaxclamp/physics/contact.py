"""Frictionless contact as an energy of the gap."""

from __future__ import annotations

from jax import Array

from jaxclamp.core.records import quantity, record
from jaxclamp.core.tensors import half_square


@record
class Contact:
    """Smoothed penalty between the outer wall and a rigid jaw."""

    stiffness: Array = quantity("kPa_per_mm", 1e-3, 1e12)
    """contact pressure per penetration"""
    smoothing: Array = quantity("mm", 1e-9, 10.0)
    """the pressure sets in at this gap, and is exactly stiffness * penetration below minus it"""

    def energy(self, gap: Array) -> Array:
        """Energy per stress-free outer area, kPa mm, with continuous second derivative.

        gap: distance from the jaw, mm, positive where open, (*batch)
        """
        return self.stiffness * half_square(-gap, self.smoothing)
