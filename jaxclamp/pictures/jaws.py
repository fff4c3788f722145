"""Jaws as drawn: contours and surfaces of their gap, wherever the clamp holds them."""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np
from contourpy import contour_generator

from jaxclamp.physics.jaws import Face, Jaw, Measured
from jaxclamp.physics.relief import Teeth
from jaxclamp.potential.densities import Touch, jaw_gap
from jaxclamp.potential.energy import State
from jaxclamp.potential.model import Model
from jaxclamp.potential.terms import JAWS

LINES = 301
"""grid lines of a section, and of a surface, in each direction"""
HALVINGS = 50
"""of the search for a face"""

Gap = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""of places x, y, z of the artery, mm"""

_gap = jax.jit(lambda touch, point, q: jaw_gap(point, q, touch))


def touches(model: Model) -> list[Touch]:
    """What contact knows of the jaws that are modelled, the upper one first."""
    return [group.here(JAWS) for group in model.potential.of(JAWS)]


def jaw_gaps(model: Model, state: State, height: float) -> dict[int, Gap]:
    """The gaps of both jaws of a state by their side (1 above, -1 below), drawn at a height, mm."""
    q = np.concatenate([[height], np.asarray(state.q)[1:]])
    of = lambda touch: lambda x, y, z: np.asarray(_gap(touch, (x, y, z), q))  # noqa: E731
    found: dict[int, Gap] = {touch.side: of(touch) for touch in touches(model)}
    if -1 not in found:
        upper = found[1]
        found[-1] = lambda x, y, z: upper(x, -y, z)
    return found


def jaw_sections(gap: Gap, across: bool, half_width: float, half_height: float) -> list[np.ndarray]:
    """Closed curves of a jaw's section, in mid-length (x, y) or in the middle along it (z, y), (n, 2) each.

    half_width, half_height: of the window, whose edge ends a jaw
    """
    along, y = np.linspace(-half_width, half_width, LINES), np.linspace(-half_height, half_height, LINES)
    here, up = np.meshgrid(along, y)
    nothing = np.zeros_like(here)
    inside = gap(here, up, nothing) if across else gap(nothing, up, here)
    edge = np.maximum(np.abs(here) - half_width, np.abs(up) - half_height) + 1e-3 * half_height
    closed = np.maximum(inside, edge)
    return [np.asarray(curve) for curve in contour_generator(along, y, closed).lines(0.0)]


def same_across(jaw: Jaw) -> bool:
    """True if a jaw's face does not change across the artery."""
    if not isinstance(jaw, Face):
        return True
    along = all(isinstance(part, Teeth) and part.direction == "along" for part in jaw.relief)
    return along and not isinstance(jaw, Measured)


def is_drawn_out(touch: Touch) -> bool:
    """True for a jaw whose section is the same all across the artery."""
    return not jax.tree_util.tree_leaves(touch.placement) and same_across(touch.jaw)


def face_surface(
    gap: Gap, side: int, half_width: float, half_length: float, top: float
) -> tuple[np.ndarray, np.ndarray]:
    """The face of a jaw over |x| <= half_width and |z| <= half_length: points (n, 3), quadrilaterals (m, 4).

    Where there is no face up to `top`, mm from the axis, there is no surface.
    """
    x, z = np.meshgrid(
        np.linspace(-half_width, half_width, LINES // 2), np.linspace(-half_length, half_length, LINES // 2)
    )
    outside, inside = np.full_like(x, -top), np.full_like(x, top)
    there = gap(x, side * inside, z) < 0.0
    for _ in range(HALVINGS):
        middle = 0.5 * (outside + inside)
        beyond = gap(x, side * middle, z) < 0.0
        outside, inside = np.where(beyond, outside, middle), np.where(beyond, middle, inside)
    points = np.stack([x, side * inside, z], axis=-1).reshape(-1, 3)
    number = np.arange(x.size).reshape(x.shape)
    corners = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    quads = np.stack([corner.ravel() for corner in corners], axis=1)
    quads = quads[np.all(there.ravel()[quads], axis=1)]
    used, compact = np.unique(quads, return_inverse=True)
    return points[used], compact.reshape(quads.shape)
