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

    intima_stiffness_ratio: Array = quantity("", 1e-3, 1e6, default=250.0)
    """stiffness between opposite inner walls over that at the jaws: what they overlap by is lumen lost"""
    intima_smoothing_ratio: Array = quantity("", 1e-6, 1e3, default=0.05)
    """smoothing there over that at the jaws"""

    def energy(self, gap: Array) -> Array:
        """Energy per stress-free outer area, kPa mm, with continuous second derivative.

        gap: distance from the jaw, mm, positive where open, (*batch)
        """
        return self.stiffness * half_square(-gap, self.smoothing)

    def intima_energy(self, gap: Array) -> Array:
        """Energy per stress-free inner area, kPa mm, with continuous second derivative; 0 for open gaps.

        gap: distance of an inner wall from the plane where it meets the opposite one, mm, (*batch)
        """
        onset = self.intima_onset
        return self.intima_stiffness * half_square(-(gap + onset), onset)

    @property
    def intima_stiffness(self) -> Array:
        """Pressure between opposite inner walls per overlap of one with the plane between them, kPa/mm."""
        return self.intima_stiffness_ratio * self.stiffness

    @property
    def intima_onset(self) -> Array:
        """Their pressure sets in as they touch, and rises linearly from an overlap of twice this on, mm."""
        return self.intima_smoothing_ratio * self.smoothing
