"""Where closing ends: a measure of the equilibria and its target.

A stop is one record: its target as the only quantity, and `measure`. Newton's border, the adjoint, progress
and "reached" follow by differentiation (`solve.stops`).
"""

from __future__ import annotations

from typing import ClassVar

from jax import Array

from jaxclamp.core.records import quantity, record, static
from jaxclamp.fem.landmarks import lumen_height
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
