"""Hard contact: the closing path is walked with softer contact, its states found with the scene's own.

Where contact is much harder than the wall, each point that comes to touch is a kink on the way, and Newton's
method needs many small steps. The equilibrium at the end hardly depends on it and is found from the softer
one's in a few iterations.
"""

from __future__ import annotations

import contextlib
import dataclasses

import jax.numpy as jnp

from jaxclamp.core.failures import EquilibriumError, NotConverged
from jaxclamp.observe.stops import OcclusionStop
from jaxclamp.scenes.fitting import fitting_contact
from jaxclamp.scenes.scene import Scene
from jaxclamp.solve.newton import newton
from jaxclamp.solve.results import Result
from jaxclamp.solve.stages import Clamping
from jaxclamp.solve.stops import Until

HARD = 3.0
"""contact is hard if it is so many times as stiff, or smoothed over so many times less, as fits the wall"""
SOFTER, SMOOTHER = 8.0, 2.5
"""how much softer than what fits the wall, and smoothed over how much more, contact on the way then is"""
EVERY = 3
"""of so many states on the way, one is found with the scene's own contact, and kept: the first, and so on"""


def with_softer_contact(scene: Scene) -> Scene | None:
    """The scene to walk the closing path of; None where its contact is not hard."""
    own, fit = scene.contact, fitting_contact(scene.artery)
    if own.stiffness <= HARD * fit.stiffness and HARD * own.smoothing >= fit.smoothing:
        return None
    soft = dataclasses.replace(
        own,
        stiffness=jnp.minimum(own.stiffness, fit.stiffness / SOFTER),
        smoothing=jnp.maximum(own.smoothing, fit.smoothing * SMOOTHER),
    )
    return dataclasses.replace(scene, contact=soft)


def keep_hardened(clamping: Clamping, soft: Result) -> None:
    """Find states on the way to the last one with the scene's own contact, at the same occlusion.

    From first contact on; one that is not found so, or not stable, is not kept. Raises TermMissing.
    """
    closed_so_far = OcclusionStop(kind="occlusion", occlusion=jnp.asarray(1.0))
    last = clamping.states.pop()
    for kept in soft.on_the_way[::EVERY]:
        known = clamping.known(clamping.body, kept.state)
        step = clamping.step(Until(closed_so_far, clamping.occlusion(kept.state), known))
        with contextlib.suppress(NotConverged, EquilibriumError):
            found = newton(clamping.system, kept.state, step)
            if not found.negative_pivots:
                clamping.tell_closing(0.0, found)
    clamping.states.append(last)
