"""Where closing ends: a measure of the equilibria and its target.

A stop is one record: its target as the only quantity, and `measure`. Newton's border, the adjoint, progress
and "reached" follow by differentiation (`solve.stops`).
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from jaxclamp.core.records import quantity, record, static
from jaxclamp.fem.landmarks import lumen_height
from jaxclamp.observe import closure
from jaxclamp.observe.equilibria import Equilibria
from jaxclamp.observe.measures import force_on_a_jaw, travel_of_a_jaw
from jaxclamp.scenes.scene import Stop

FAR_FROM_CLOSURE = 0.5
"""opposite inner walls do not meet up to this occlusion"""


@record
class OcclusionStop(Stop):
    """Close until 1 - lumen height / physiological lumen diameter, at mid-length, is reached."""

    STEADY: ClassVar[bool] = True

    kind: str = static("occlusion")
    occlusion: Array = quantity("", 1e-4, 0.999)
    """0: as in the body, 1: closed"""

    def measure(self, equilibria: Equilibria) -> Array:
        e = equilibria
        return 1.0 - lumen_height(e.last.x, e.marks) / lumen_height(e.body.x, e.marks)

    def far_from_closure(self) -> bool:
        return bool(self.occlusion <= FAR_FROM_CLOSURE)


@record
class TravelStop(Stop):
    """Move each jaw by a given distance from its first contact."""

    STEADY: ClassVar[bool] = True

    kind: str = static("travel")
    travel: Array = quantity("mm", 0.0, 1e3)
    """of one jaw"""

    def measure(self, equilibria: Equilibria) -> Array:
        return travel_of_a_jaw(equilibria)


@record
class ForceStop(Stop):
    """Close until the force on one jaw (whole artery) is reached."""

    kind: str = static("force")
    force: Array = quantity("N", 1e-6, 1e4)
    """on one jaw; mN inside"""

    def measure(self, equilibria: Equilibria) -> Array:
        return force_on_a_jaw(equilibria)


@record
class AreaStop(Stop):
    """Close until a share of the lumen's area at mid-length is gone."""

    STEADY: ClassVar[bool] = True

    kind: str = static("area occlusion")
    area_occlusion: Array = quantity("", 1e-4, 0.9999)
    """0: as in the body, 1: nothing is left"""

    def measure(self, equilibria: Equilibria) -> Array:
        return 1.0 - closure.area_share(equilibria)


@record
class ClosedStop(Stop):
    """Close until no way for blood is left at mid-length: see `closure.closure`."""

    kind: str = static("closed")
    closed: bool = static()
    """true"""
    closure: Array = quantity("", 0.9, 1.0, default=1.0)
    """how far"""

    def measure(self, equilibria: Equilibria) -> Array:
        return closure.closure(equilibria)

    def after(self) -> Stop:
        return AreaStop(kind="area occlusion", area_occlusion=closure.CLOSED * self.closure)


@record
class PressedStop(Stop):
    """Close the lumen, and press on to a given force on one jaw (whole artery)."""

    kind: str = static("pressed")
    closed: bool = static()
    """true"""
    force: Array = quantity("N", 1e-6, 1e4)
    """on one jaw, more than what closes the lumen; mN inside"""

    def measure(self, equilibria: Equilibria) -> Array:
        return force_on_a_jaw(equilibria)

    def after(self) -> Stop:
        return ClosedStop(kind="closed", closed=True, closure=jnp.asarray(1.0))
