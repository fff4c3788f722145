"""Where closing ends: a measure of the equilibria and its target.

A stop is one record: its target as the only quantity, and `measure`. Newton's border, the adjoint, progress
and "reached" follow by differentiation (`solve.stops`).
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from jaxclamp.core.records import quantity, record, static
from jaxclamp.fem.landmarks import lumen_area, lumen_height
from jaxclamp.observe.equilibria import Equilibria
from jaxclamp.observe.measures import force_on_a_jaw, travel_of_a_jaw
from jaxclamp.scenes.scene import Stop

FAR_FROM_CLOSURE = 0.5
"""opposite inner walls do not meet up to this occlusion"""
CLOSED = 0.995
"""share of the lumen's area in the body that is gone where it counts as closed: blood does not pass through
what is left beside the fold"""


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
class ClosedStop(Stop):
    """Close until the inner walls meet all across: 1 - lumen area / that in the body, at mid-length.

    Area changes steadily all the way, and does not depend on how finely the fold is resolved, as the force
    between the walls does: coarse folds pinch early.
    """

    STEADY: ClassVar[bool] = True

    kind: str = static("closed")
    closed: bool = static()
    """true"""
    area_occlusion: Array = quantity("", 0.9, 0.9999, default=CLOSED)
    """the share of the area that is gone"""

    def measure(self, equilibria: Equilibria) -> Array:
        e = equilibria
        return 1.0 - lumen_area(e.last.x, e.marks) / lumen_area(e.body.x, e.marks)


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
        return ClosedStop(closed=True, area_occlusion=jnp.asarray(CLOSED))
