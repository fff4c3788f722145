"""Contact that fits the wall: the stiffness and smoothing of a scene that states none."""

from __future__ import annotations

import numpy as np

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
    ranges = {key: field.metadata["range"] for key, field in schema.fields_by_key(Contact).items()}
    values = zip(ranges.items(), (stiffness, SMOOTHING * wall), strict=False)  # the others have defaults
    table = {key: min(max(value, span.lower), span.upper) for (key, span), value in values}
    contact: Contact = schema.read(Contact, table, "contact")
    return contact
