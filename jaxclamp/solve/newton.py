"""How equilibrium is found: Newton's method with a bordered condition.

One kernel, `newton`, solves for positions, cell pressures (condensed) and rigid coordinates together with
one closing condition (`solve.stops`): one right-hand side more for each rigid coordinate, on one
factorisation. `follow` walks it along a load path, `descent` takes over where it fails.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable

import jax
import numpy as np

from jaxclamp.core.failures import Exhausted, NotConverged, Singular
from jaxclamp.fem.pattern import Pattern
from jaxclamp.potential.energy import State
from jaxclamp.potential.tangent import Linearisation, advance, linearise
from jaxclamp.potential.terms import BLOOD, Potential
from jaxclamp.solve.linear_solvers import LinearSolver
from jaxclamp.solve.stops import Condition, Row

MAX_NEWTON = 14
MAX_CUTS = 2
DIVERGING = 4.0
MAX_IDLE = 4
"""whole steps without halving the imbalance: where a fold turns soft, Newton's method goes in circles"""
MAX_LINEARISATIONS = 3000
"""a clamping that needs more is given up, so that nothing runs for ever"""
LARGEST_MOVE = 0.25
"""a Newton correction moves no node further than this part of the lumen radius"""
LARGEST_GROWTH = 1e2
"""a Newton step may leave an imbalance of up to so many times the support reactions, or the one before"""
LARGEST_FORCE = 1e13
"""stiffness times position, mN, beyond which a wall has exploded: no rounding excuses its residual then"""
ROUND_OFF = 2.0**-52
"""a residual that this relative change of the positions would make is rounding: an unloaded, stress-free
artery has no reactions to measure its residual by, and a bulk modulus may be 1e6 times the stress"""
VOLUME_TOLERANCE = 1e-8
"""largest |mean J - 1 - p/bulk| of a converged cell"""
CLOSING_TOLERANCE = 1e-9
"""how far the jaw may be from where the closing condition holds, as part of the lumen radius"""


@dataclasses.dataclass(frozen=True)
class Step:
    """A point of a load path."""

    closing: Condition
    """what the jaw is to do"""
    pressure: float
    """kPa"""
    axial_stretch: float
    """length over load-free length"""


Path = Callable[[float], Step]
"""load parameter, 0 to 1 -> what to solve for"""


@dataclasses.dataclass(frozen=True)
class Equilibrium:
    """A converged state with its loads and what was seen on the way."""

    state: State
    """positions, pressures, rigid coordinates"""
    pressure: float
    """blood pressure, kPa"""
    axial_stretch: float
    """length over load-free length"""
    lin: Linearisation
    """forces and tangent there"""
    negative_pivots: int | None
    """of the tangent at a held jaw; more than 0: unstable without the stop; None: back end cannot tell"""
    force_slope: float
    """d jaw_force / d jaw_height at equilibrium, mN/mm"""
    responses: np.ndarray
    """change of the free unknowns to remove the residual, and per unit of each rigid coordinate,
    (n_free, 1 + n_q)"""
    iterations: int
    """that it took"""
    snapped: bool = False
    """reached by following the potential downhill past a loss of stability"""


@dataclasses.dataclass
class System:
    """A potential, its linear solver, and the counts of work done with them."""

    potential: Potential
    """the terms in use"""
    solver: LinearSolver
    """of its linear systems"""
    tolerance: float
    """largest residual over the norm of the support reactions"""
    length: float
    """lumen radius, mm: the scale of moves"""
    pattern: Pattern
    """of the tangent"""
    newton_iterations: int = 0
    """so far"""
    load_steps: int = 0
    """so far"""
    assembly_seconds: float = 0.0
    """so far"""
    first_seconds: float = 0.0
    """of the first assembly, with its compilation"""
    linearisations: int = 0
    """so far"""
    patience: int = MAX_LINEARISATIONS
    """linearisations after which it gives up"""

    def count_on(self, before: System) -> None:
        """Go on counting where another system stopped, and allow as many assemblies from here."""
        self.newton_iterations, self.load_steps = before.newton_iterations, before.load_steps
        self.assembly_seconds, self.first_seconds = before.assembly_seconds, before.first_seconds
        self.linearisations = before.linearisations
        self.patience = self.linearisations + MAX_LINEARISATIONS

    def linearise(self, state: State, pressure: float) -> Linearisation:
        """Forces and tangent, on the host (numpy arrays). Raises NotConverged when patience is out."""
        if self.linearisations >= self.patience:
            raise Exhausted(f"no way was found in {MAX_LINEARISATIONS} assemblies")
        start = time.perf_counter()
        lin = linearise(self.at(pressure), state, self.pattern)
        seconds = time.perf_counter() - start
        if self.linearisations == 0:
            self.first_seconds = seconds
        self.linearisations += 1
        self.assembly_seconds += seconds
        return lin

    def at(self, pressure: float) -> Potential:
        """The potential at a blood pressure, kPa; without blood where there is none."""
        if pressure == 0.0:
            return self.potential.keeping(lambda name: name != BLOOD)
        return self.potential.at_pressure(pressure)

    @property
    def compile_seconds(self) -> float:
        """What the first assembly took beyond a usual one: compilation, if it was needed, s."""
        usual = (self.assembly_seconds - self.first_seconds) / max(self.linearisations - 1, 1)
        return max(self.first_seconds - usual, 0.0)


def residual_norm(lin: Linearisation) -> float:
    """Norm of the free forces, mN; inf where they are not finite or beyond reason."""
    largest = float(np.max(np.abs(lin.residual), initial=0.0))
    return float(np.linalg.norm(lin.residual)) if largest < 1e150 else math.inf


def converged(system: System, state: State, lin: Linearisation, off: float, held: bool = False) -> bool:
    """The forces balance to the tolerance or to rounding, cells have their volume, the closing holds.

    off: how far the jaw is from where the closing holds, mm; held: all rigid coordinates are
    """
    free = np.asarray(state.x).reshape(-1)[np.asarray(system.potential.layout.free)]
    forces = lin.values[system.pattern.diagonal] * free
    sane = float(np.max(np.abs(forces), initial=0.0)) < LARGEST_FORCE
    rounding = ROUND_OFF * float(np.linalg.norm(forces)) if sane else 0.0
    # rigid coordinates that nothing drives are in equilibrium, too
    left = residual_norm(lin)
    left = left if held else math.hypot(left, float(np.linalg.norm(lin.rigid_force[1:])))
    small = left <= max(system.tolerance * float(lin.reactions), rounding)
    closed = float(lin.volume_error) <= VOLUME_TOLERANCE and off <= CLOSING_TOLERANCE * system.length
    return small and closed


def sound(lin: Linearisation) -> bool:
    """True if no cell is inverted and everything is finite."""
    return (
        float(lin.J_min) > 0.0
        and math.isfinite(float(lin.energy))
        and math.isfinite(residual_norm(lin))
        and bool(np.all(np.isfinite(lin.values)))
    )


def bordered_step(
    responses: np.ndarray, lin: Linearisation, row: Row
) -> tuple[np.ndarray, np.ndarray, float]:
    """Newton step of equilibrium and closing condition: dx (n_free,), dq (n_q,), and |error / slope|, mm.

    The first rigid coordinate is driven by the condition; the others find their own equilibrium, or stay
    where nothing touches them. Raises NotConverged where the condition does not feel the jaw.
    """
    free, per_q = responses[:, 0], responses[:, 1:]
    by_x = np.vstack([row.by_x, lin.coupling.T[1:]])
    by_q = np.vstack([row.by_q, lin.rigid_stiffness[1:]])
    untouched = [i for i in range(1, len(by_q)) if not np.any(by_x[i]) and not np.any(by_q[i])]
    by_q[untouched, untouched] = 1.0
    error = np.concatenate([[row.error], -lin.rigid_force[1:]])
    slopes = by_q + by_x @ per_q
    if not np.all(np.isfinite(slopes)) or np.linalg.det(slopes) == 0.0:
        raise NotConverged("the jaw does not touch the artery")
    dq = -np.linalg.solve(slopes, error + by_x @ free)
    return free + per_q @ dq, dq, abs(row.error / slopes[0, 0]) if slopes[0, 0] else math.inf


def force_slope(lin: Linearisation, responses: np.ndarray) -> float:
    """d jaw_force / d jaw_height at equilibrium, mN/mm, the other rigid coordinates at their own."""
    stiffness = lin.rigid_stiffness + lin.coupling.T @ responses[:, 1:]
    others = stiffness[1:, 1:]
    if others.size == 0 or np.linalg.det(others) == 0.0:
        return -float(stiffness[0, 0])
    return -float(stiffness[0, 0] - stiffness[0, 1:] @ np.linalg.solve(others, stiffness[1:, 0]))


def inertia(lin: Linearisation, responses: np.ndarray, negative: int | None) -> int | None:
    """Negative eigenvalues of the tangent with the rigid coordinates that find their own equilibrium.

    negative: those without; None if they are not known. With their Schur complement the whole has as many
    more; of a Lagrange multiplier, which is linear, one belongs to its constraint (Gould, Math Program 32
    (1985) 90).
    """
    touched = [i for i in range(1, lin.coupling.shape[1]) if np.any(lin.coupling[:, i])]
    if negative is None or not touched:
        return negative
    schur = (lin.rigid_stiffness + lin.coupling.T @ responses[:, 1:])[np.ix_(touched, touched)]
    if not np.all(np.isfinite(schur)):
        return negative
    multipliers = sum(lin.rigid_stiffness[i, i] == 0.0 for i in touched)
    return negative + int(np.sum(np.linalg.eigvalsh(0.5 * (schur + schur.T)) < 0.0)) - int(multipliers)


def newton(
    system: System,
    state: State,
    step: Step,
    known: Equilibrium | None = None,
) -> Equilibrium:
    """Solve for equilibrium and the closing condition from a nearby state. Raises NotConverged.

    known: an equilibrium whose tangent is not formed again if `state` is its state
    """
    closing, pressure = step.closing, step.pressure
    n_free = system.solver.n
    row = closing.row(state, n_free)
    if row.error != 0.0 and not np.any(row.by_x):  # a condition on the jaw alone is met at once
        if row.by_q[0] == 0.0:
            raise NotConverged("the jaw does not touch the artery")
        state = dataclasses.replace(state, q=moved(state.q, -row.error / row.by_q[0]))
    reuse = known if known is not None and known.state is state and known.pressure == pressure else None
    lin = system.linearise(state, pressure) if reuse is None else reuse.lin
    if not sound(lin):
        raise NotConverged("the predicted state is inverted", residual_norm(lin), float(lin.J_min))
    cuts, first_imbalance, least, idle = 0, math.inf, math.inf, 0
    for iteration in range(MAX_NEWTON + 1):
        row = closing.row(state, n_free)
        negative, responses = (
            _factored(system, lin) if reuse is None else (reuse.negative_pivots, reuse.responses)
        )
        reuse = None
        dx, dq, off = bordered_step(responses, lin, row)
        if converged(system, state, lin, off):
            return Equilibrium(
                state,
                pressure,
                step.axial_stretch,
                lin,
                negative,
                force_slope(lin, responses),
                responses,
                iteration,
            )
        if idle > MAX_IDLE:
            raise NotConverged("Newton's method goes in circles", residual_norm(lin), float(lin.J_min))
        system.newton_iterations += 1
        state, lin, shortened = _admissible(system, state, lin, pressure, dx, dq, MAX_CUTS - cuts)
        cuts += shortened
        imbalance = float(lin.imbalance)
        first_imbalance = imbalance if iteration == 0 else first_imbalance
        whole = not shortened and _largest(dx, dq) <= LARGEST_MOVE * system.length
        least, idle = (imbalance, 0) if imbalance < 0.5 * least else (least, idle + whole)
        if iteration > 2 and imbalance > DIVERGING * first_imbalance:
            raise NotConverged("Newton's residual grows", residual_norm(lin), float(lin.J_min))
    raise NotConverged(
        f"Newton's method goes on beyond {MAX_NEWTON} iterations", residual_norm(lin), float(lin.J_min)
    )


def predict(system: System, near: Equilibrium, step: Step) -> State:
    """First-order prediction of a neighbouring equilibrium with the factors of a near one.

    One Newton correction of equilibrium and closing condition with the tangent of `near`, which the
    solver still holds: the change of the state with the scene times the change of the scene. Without
    those factors, or where the prediction is no sound state, it is the state of `near`.
    """
    if not system.solver.holds(np.asarray(near.lin.values)):
        return near.state
    lin = system.linearise(near.state, step.pressure)
    if not sound(lin):
        return near.state
    try:
        responses = system.solver.solve(_right_sides(lin))
        row = step.closing.row(near.state, system.solver.n)
        dx, dq, _ = bordered_step(responses, lin, row)
    except (Singular, NotConverged):
        return near.state
    fraction = min(1.0, LARGEST_MOVE * system.length / _largest(dx, dq))
    return advance(system.potential, near.state, dx, dq, fraction)


def moved(q: jax.Array, by: float) -> jax.Array:
    """Rigid coordinates with the driven one moved by a distance, mm."""
    return jax.device_put(np.asarray(q) + by * np.eye(1, len(q))[0])


def _largest(dx: np.ndarray, dq: np.ndarray) -> float:
    return max(float(np.max(np.abs(dx))), float(np.max(np.abs(dq))), 1e-300)


def _right_sides(lin: Linearisation) -> np.ndarray:
    """Of the residual and of each rigid coordinate, (n_free, 1 + n_q)."""
    return -np.column_stack([lin.residual, lin.coupling])


def _factored(system: System, lin: Linearisation) -> tuple[int | None, np.ndarray]:
    """Negative eigenvalues of the tangent, and its responses (n_free, 1 + n_q). Raises NotConverged."""
    try:
        negative = system.solver.factor(np.asarray(lin.values))
        responses = system.solver.solve(_right_sides(lin))
        return inertia(lin, responses, negative), responses
    except Singular as failure:
        raise NotConverged(str(failure), residual_norm(lin), float(lin.J_min)) from failure


def _admissible(
    system: System,
    state: State,
    lin: Linearisation,
    pressure: float,
    dx: np.ndarray,
    dq: np.ndarray,
    cuts_left: int,
) -> tuple[State, Linearisation, int]:
    """Go along a Newton step, shortened until no cell inverts and no force explodes.

    Returns the new state, its linearisation and how often the step was cut. Raises NotConverged
    after `cuts_left` cuts.
    """
    fraction = min(1.0, LARGEST_MOVE * system.length / _largest(dx, dq))
    bound = LARGEST_GROWTH * max(float(lin.reactions), float(lin.imbalance))
    for cut in range(cuts_left + 1):
        trial = advance(system.potential, state, dx, dq, fraction)
        trial_lin = system.linearise(trial, pressure)
        if sound(trial_lin) and float(trial_lin.imbalance) <= bound:
            return trial, trial_lin, cut
        fraction *= 0.4
    raise NotConverged(
        "a Newton step inverts cells or makes forces explode", residual_norm(lin), float(lin.J_min)
    )
