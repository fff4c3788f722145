"""Contact that fits the wall: the stiffness and smoothing of a scene that states none."""

from __future__ import annotations

import numpy as np

from jaxclamp.core.records import Range
from jaxclamp.physics.contact import Contact
from jaxclamp.scenes import schema
from jaxclamp.scenes.scene import Artery

PENETRATION = 0.01
"""share of the wall by which a jaw sinks in where it presses with the wall's own c + pressure"""
SMOOTHING = 0.01
"""smoothing over the thickness of the wall"""


def fitting_contact(artery: Artery) -> Contact:
    """Contact of stiffness (c + p) / (1 % of H), smoothed over 1 % of H; see docs/contact.md.

    H is the thickness of the stress-free layers together, c the largest shear modulus of them, p the blood
    pressure: a wall presses back with its stiffness and with the blood behind it. They are numbers from then
    on: gradients by c, p or a thickness do not see the rule.
    """
    wall = sum(float(layer.thickness) for layer in artery.layers)
    c = max(float(np.max(np.asarray(layer.material.c))) for layer in artery.layers)
    stiffness = (c + float(artery.pressure)) / (PENETRATION * wall)
    keys = {field.name: field.metadata["range"] for field in schema.fields_by_key(Contact).values()}
    return Contact(
        stiffness=_within(stiffness, keys["stiffness"]),
        smoothing=_within(SMOOTHING * wall, keys["smoothing"]),
    )


def _within(value: float, interval: Range) -> float:
    """The nearest number of a range."""
    return min(max(value, interval.lower), interval.upper)
