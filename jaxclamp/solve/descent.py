"""The way downhill: where the tangent is no longer definite and Newton cycles, at a held jaw.

`descend` is a regularised Newton method on the potential that uses the inertia of the tangent, goes down in
energy, and ends in a stable equilibrium.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jaxclamp.core.failures import NotConverged, Singular
from jaxclamp.potential.energy import State
from jaxclamp.potential.tangent import Linearisation, advance
from jaxclamp.potential.terms import INTIMA, JAWS, Potential, Volume
from jaxclamp.scenes.scene import Scene
from jaxclamp.solve.newton import (
    LARGEST_MOVE,
    Equilibrium,
    Step,
    System,
    converged,
    moved,
    newton,
    residual_norm,
    sound,
)
from jaxclamp.solve.stops import Held

MAX_DESCENT = 150
MAX_SHIFTS = 30
LEAST_SHIFT = 1e-4
"""of the tangent, as part of the median of its diagonal"""
MAX_CORRECTIONS = 3
"""of the cells' volumes, after each step"""
VOLUMES_KEPT = 0.1
"""forces of wrong volumes that are left alone, as part of the others"""
SUFFICIENT_FALL = 1e-4
NOISE = 1e-12
"""of the potential, as part of itself"""
POOR_MODEL, GOOD_MODEL = 0.25, 0.6
"""fall of the potential over that of its quadratic model: below the one the shift rises, above the other it
shrinks"""
EASY_BULK, EASY_CONTACT = 400.0, 100.0
"""bulk modulus, and contact stiffness times the wall's thickness, over its shear modulus, with which the
way downhill is easy"""
SMALLEST_STIFFENING = 1 / 32
"""eased penalties are restored in steps of at least this share of the way, or given up"""


def descend(system: System, state: State, step: Step) -> Equilibrium:
    """Go down the potential at a held jaw to a stable equilibrium. Raises NotConverged.

    Steps solve (K + shift I) dx = -residual. The shift rises until the matrix is positive definite
    and the potential falls enough, and shrinks where the quadratic model predicts well (a trust
    region in all but name). With the shift at zero this is Newton's method.
    """
    assert isinstance(step.closing, Held)
    state = dataclasses.replace(state, q=moved(state.q, step.closing.height - float(state.jaw_height)))
    lin = system.linearise(state, step.pressure)
    if not sound(lin):
        raise NotConverged("the predicted state is inverted", residual_norm(lin), float(lin.J_min))
    unit = LEAST_SHIFT * float(np.median(lin.values[system.pattern.diagonal]))
    shift, unstable = 0.0, False
    for iteration in range(MAX_DESCENT):
        if converged(system, state, lin, 0.0, held=True):
            equilibrium = newton(system, state, step)
            return dataclasses.replace(equilibrium, iterations=iteration, snapped=unstable)
        refused = False
        for _ in range(MAX_SHIFTS):
            dx = _downhill_step(system, lin, shift)
            if dx is None:
                unstable = True
            else:
                trial, trial_lin, quality = _go_down(system, state, lin, step.pressure, dx, shift)
                if quality > 0.0:
                    break
            shift, refused = max(4.0 * shift, unit), True
        else:
            break
        if quality > GOOD_MODEL:
            less = 0.6 if refused else 0.25  # not so little as has just been refused
            shift = less * shift if shift > unit else unit if refused else 0.0
        elif quality < POOR_MODEL:
            shift = max(2.0 * shift, unit)
        state, lin = trial, trial_lin
    raise NotConverged("the way downhill did not end", residual_norm(lin), float(lin.J_min))


@dataclasses.dataclass(frozen=True)
class Ease:
    """How much softer the penalties are made to find a way: factors of at most 1."""

    bulk: float
    """of the bulk modulus"""
    contact: float
    """of the contact stiffness"""

    def potential(self, potential: Potential, share: float) -> Potential:
        """The potential with its penalties eased by a share (1 fully, 0 not at all) of the way, in powers."""

        def softer(here: Any) -> Any:
            contact = here.contact
            soft = dataclasses.replace(contact, stiffness=contact.stiffness * self.contact**share)
            return dataclasses.replace(here, contact=soft)

        def lighter(volume: Volume | None) -> Volume | None:
            if volume is None:
                return None
            return dataclasses.replace(volume, stiffness=volume.stiffness * self.bulk**share)

        changed = potential.changed(JAWS, softer).changed(INTIMA, softer)
        groups = tuple(dataclasses.replace(g, volume=lighter(g.volume)) for g in changed.groups)
        return dataclasses.replace(changed, groups=groups)


def ease_of(scene: Scene) -> Ease:
    """Penalties brought down to where they still do their work: well above the stiffness of the wall."""
    materials = [layer.material for layer in scene.artery.layers]
    wall = sum(float(layer.thickness) for layer in scene.artery.layers)
    c = max(float(np.max(np.asarray(material.c))) for material in materials)
    bulk = max(float(np.max(np.asarray(material.bulk))) for material in materials)
    return Ease(
        bulk=min(1.0, EASY_BULK * c / bulk),
        contact=min(1.0, EASY_CONTACT * c / (float(scene.contact.stiffness) * wall)),
    )


def descend_eased(system: System, state: State, step: Step, ease: Ease) -> Equilibrium:
    """Go downhill with softer penalties, then stiffen them to their own values. Raises NotConverged.

    Along a stiff penalty the potential is a narrow, curved valley that no descent gets far in; Newton's
    method, with the pressures of the cells as unknowns of their own, follows the stiffening easily.
    """
    whole = system.potential
    try:
        system.potential = ease.potential(whole, 1.0)
        found = descend(system, state, step)
        snapped, share, stride = found.snapped, 1.0, 0.5
        while share > 0.0:
            target = max(share - stride, 0.0)
            system.potential = ease.potential(whole, target) if target else whole
            try:
                found, share = newton(system, found.state, step), target
            except NotConverged:
                stride *= 0.5
                if stride < SMALLEST_STIFFENING:
                    system.potential = whole
                    found, share = descend(system, found.state, step), 0.0
                    snapped = snapped or found.snapped
    finally:
        system.potential = whole
    if found.negative_pivots:
        raise NotConverged("lost stability", residual_norm(found.lin), float(found.lin.J_min))
    return dataclasses.replace(found, snapped=snapped)


def _downhill_step(system: System, lin: Linearisation, shift: float) -> np.ndarray | None:
    """-(K + shift I)^-1 residual, (n_free,); None if that matrix is not positive definite."""
    values = np.array(lin.values)
    values[system.pattern.diagonal] += shift
    try:
        negative = system.solver.factor(values)
        dx = system.solver.solve(-np.asarray(lin.residual)[:, None])[:, 0]
    except Singular:
        return None
    return None if negative or np.dot(lin.residual, dx) >= 0.0 else dx


def _go_down(
    system: System, state: State, lin: Linearisation, pressure: float, dx: np.ndarray, shift: float
) -> tuple[State, Linearisation, float]:
    """Go along a downhill step; how well the fall agrees with the prediction, 0 or less if refused.

    A residual of less than a third counts whatever the potential does: near equilibrium its fall drowns in
    rounding, and before, the volumes of a good step may hide it.
    """
    system.newton_iterations += 1
    fraction = min(1.0, LARGEST_MOVE * system.length / float(np.max(np.abs(dx))))
    trial = advance(system.potential, state, dx, np.zeros(len(state.q)), fraction)
    trial_lin = system.linearise(trial, pressure)
    if not sound(trial_lin):
        return state, lin, -1.0
    trial, trial_lin = _with_their_volumes(system, trial, trial_lin, pressure)
    along = -float(np.dot(lin.residual, dx))
    curved = along - shift * float(np.dot(dx, dx))  # dx' K dx
    predicted = fraction * along - 0.5 * fraction**2 * curved
    better = residual_norm(trial_lin) < 0.3 * residual_norm(lin)
    if better and predicted < NOISE * abs(float(lin.energy)):
        return trial, trial_lin, 1.0
    quality = (float(lin.energy) - float(trial_lin.energy)) / predicted - SUFFICIENT_FALL
    return trial, trial_lin, max(quality, POOR_MODEL) if better else quality


def _with_their_volumes(
    system: System, state: State, lin: Linearisation, pressure: float
) -> tuple[State, Linearisation]:
    """A trial state moved so that its cells have the volumes that their stored pressures ask for.

    A step changes them to second order. Times the bulk modulus, that hides how far the potential falls along
    a soft direction, and only tiny steps would be taken there. Corrections with the factors at hand: the
    second-order correction of sequential quadratic programming (Nocedal and Wright, Numerical Optimization,
    2nd ed., 15.6 and 18.3).
    """
    for _ in range(MAX_CORRECTIONS):
        off = float(np.linalg.norm(lin.missing))
        if off <= VOLUMES_KEPT * lin.imbalance:
            break
        try:
            back = system.solver.solve(-lin.missing[:, None])[:, 0]
        except Singular:
            break
        if float(np.max(np.abs(back))) > LARGEST_MOVE * system.length:
            break
        moved_back = advance(system.potential, state, back, np.zeros(len(state.q)), 1.0)
        there = system.linearise(moved_back, pressure)
        if not sound(there) or float(np.linalg.norm(there.missing)) > 0.5 * off:
            break
        state, lin = moved_back, there
    return state, lin
