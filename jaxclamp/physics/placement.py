"""How a pair of jaws lies across the artery and closes: what takes a point of the artery into a jaw."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from jaxclamp.core.records import record
from jaxclamp.core.tensors import Vector, norm
from jaxclamp.physics.jaws import Jaw, ended

TIP = 0.25
"""radius of a jaw's free end over its reach, at most"""


@record
class Placement:
    """What of the closing is not square and parallel across the artery; None: nothing of that kind."""

    oblique: Array | None
    """angle of the jaws about the closing direction, rad"""
    hinge_distance: Array | None
    """from the artery's axis to the hinge about which the jaws turn, mm; it lies at negative x"""
    tip: Array | None
    """where the jaws' free ends are beside the artery's axis, mm; the jaws come from negative x"""
    reach: Array | None
    """from the artery's side to the free ends, mm"""

    def gap(self, jaw: Jaw, point: Vector, height: Array) -> Array:
        """Gap of a point (x, y, z) of the artery, y towards the jaw, mm.

        height: of the jaw's lowest line above the axis at x = 0, mm. About a hinge the jaw turns by the angle
        whose tangent is height over the distance of the hinge.
        """
        x, y, z = point
        if self.oblique is not None:
            cosine, sine = jnp.cos(self.oblique), jnp.sin(self.oblique)
            x, z = cosine * x + sine * z, cosine * z - sine * x
        if self.hinge_distance is None:
            y = y - height
        else:
            d, length = self.hinge_distance, norm((self.hinge_distance, height))
            cosine, sine = d / length, height / length
            x, y = cosine * (x + d) + sine * y - d, cosine * y - sine * (x + d)
        gap = jaw.gap((x, y, z))
        return gap if self.tip is None else self._ended(jaw, gap, x)

    def _ended(self, jaw: Jaw, gap: Array, x: Array) -> Array:
        """The gap of a jaw that ends at its tip with a rounded end."""
        assert self.tip is not None
        assert self.reach is not None
        radius = 1.0 / (1.0 / jaw.least_radius() + 1.0 / (TIP * self.reach))
        return ended(gap, x - self.tip, radius)


SQUARE = Placement(oblique=None, hinge_distance=None, tip=None, reach=None)
"""jaws that lie all across the artery and stay parallel"""
