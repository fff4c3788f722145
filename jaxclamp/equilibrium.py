"""How equilibrium is found: Newton, continuation, the bordered stop, and the way out of a snap.

One kernel, `newton`, solves for positions, cell pressures (condensed) and jaw height together
with one closing condition (`Held`, `LumenHeight` or `JawForce`): two right-hand sides on one
factorisation. `Continuation` walks it along a load path with a secant predictor and steps that
adapt. Where the tangent is no longer definite and Newton cycles, `descend` takes over at a held
jaw: a regularised Newton method on the potential that uses the inertia of the tangent, always
goes down in energy, and therefore ends in a stable equilibrium.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxclamp.assembly import Body, Linearisation, State, advance, linearise
from jaxclamp.linear_solvers import LinearSolver, Singular

MAX_NEWTON = 14
MAX_CUTS = 2
DIVERGING = 4.0
MAX_DESCENT = 150
EASY_ITERATIONS = 6
"""a step that converged in so many iterations lets the next one grow"""
LARGEST_MOVE = 0.25
"""a Newton correction moves no node further than this part of the lumen radius"""
LARGEST_GROWTH = 1e2
"""a Newton step may leave a residual up to so many times the support reactions"""
VOLUME_TOLERANCE = 1e-8
"""largest |mean J - 1 - p/bulk| of a converged cell"""


class EquilibriumError(Exception):
    """No converged equilibrium. One sentence; `result` keeps the states that did converge."""

    def __init__(self, stage: str, load: str, residual: float, J_min: float, advice: str) -> None:
        self.stage, self.load, self.residual, self.J_min, self.advice = stage, load, residual, J_min, advice
        self.result: object | None = None
        super().__init__(
            f"no equilibrium was found in stage '{stage}' at {load} "
            f"(residual {residual:.2g} mN, smallest J {J_min:.3g}): {advice}"
        )


class NotConverged(Exception):
    """One attempt failed; the caller cuts its step or changes its method."""

    def __init__(self, reason: str, residual: float = math.nan, J_min: float = math.nan) -> None:
        super().__init__(reason)
        self.residual, self.J_min = residual, J_min


@dataclasses.dataclass(frozen=True)
class Held:
    """The jaw stays at a height, mm."""

    height: float

    def error(self, state: State, lin: Linearisation) -> float:
        return float(state.jaw_height) - self.height

    def change(self, lin: Linearisation, dx: np.ndarray) -> float:
        return 0.0

    def jaw_slope(self, lin: Linearisation) -> float:
        return 1.0


@dataclasses.dataclass(frozen=True)
class LumenHeight:
    """The jaw moves until a node on the compression axis is at a height, mm."""

    height: float
    unknown: int
    """number of that node's y among the unknowns"""
    coordinate: int
    """3 node + 1"""

    def error(self, state: State, lin: Linearisation) -> float:
        return float(state.x.reshape(-1)[self.coordinate]) - self.height

    def change(self, lin: Linearisation, dx: np.ndarray) -> float:
        return float(dx[self.unknown])

    def jaw_slope(self, lin: Linearisation) -> float:
        return 0.0


@dataclasses.dataclass(frozen=True)
class JawForce:
    """The jaw moves until the force on its modelled part is reached, mN."""

    force: float
    stiffness_scale: float
    """turns a missing force into a length, mN/mm"""

    def error(self, state: State, lin: Linearisation) -> float:
        return (float(lin.jaw_force) - self.force) / self.stiffness_scale

    def change(self, lin: Linearisation, dx: np.ndarray) -> float:
        return -float(np.dot(lin.jaw_coupling, dx)) / self.stiffness_scale

    def jaw_slope(self, lin: Linearisation) -> float:
        return -float(lin.jaw_stiffness) / self.stiffness_scale


Closing = Held | LumenHeight | JawForce


@dataclasses.dataclass(frozen=True)
class Step:
    """A point of a load path."""

    closing: Closing
    pressure: float
    axial_stretch: float


Path = Callable[[float], Step]
"""load parameter, 0 to 1 -> what to solve for"""

@dataclasses.dataclass(frozen=True)
class Equilibrium:
    """A converged state with its loads and what was seen on the way."""

    state: State
    pressure: float
    """blood pressure, kPa"""
    axial_stretch: float
    lin: Linearisation
    negative_pivots: int | None
    """of the tangent at a held jaw; more than 0: unstable without the stop; None: back end cannot tell"""
    force_slope: float
    """d jaw_force / d jaw_height at equilibrium, mN/mm"""
    iterations: int
    snapped: bool = False
    """reached by following the potential downhill past a loss of stability"""


@dataclasses.dataclass
class System:
    """One body, its linear solver, and the counts of work done with them."""

    body: Body
    solver: LinearSolver
    tolerance: float
    length: float
    """lumen radius, mm: the scale of moves"""
    diagonal: np.ndarray
    """place of each diagonal entry in the values of the tangent, (n_free,)"""
    newton_iterations: int = 0
    load_steps: int = 0
    assembly_seconds: float = 0.0
    compile_seconds: float = 0.0

    def linearise(self, state: State, pressure: float) -> Linearisation:
        """Forces and tangent, on the host."""
        start, compiled = time.perf_counter(), linearise._cache_size()
        lin = jax.device_get(linearise(self.body, state, jnp.asarray(pressure)))
        seconds = time.perf_counter() - start
        if linearise._cache_size() > compiled:
            self.compile_seconds += seconds
        else:
            self.assembly_seconds += seconds
        return lin


def residual_norm(lin: Linearisation) -> float:
    """Largest-meaningful measure of imbalance: the norm of the free forces, mN."""
    return float(np.linalg.norm(lin.residual))


def _converged(system: System, lin: Linearisation, closing_error: float) -> bool:
    scale = max(float(lin.reactions), 1e-12)
    return (
        residual_norm(lin) <= system.tolerance * scale
        and float(lin.volume_error) <= VOLUME_TOLERANCE
        and abs(closing_error) <= 1e-9 * system.length
    )


def _sound(lin: Linearisation) -> bool:
    return (
        float(lin.J_min) > 0.0
        and math.isfinite(float(lin.energy))
        and math.isfinite(residual_norm(lin))
        and bool(np.all(np.isfinite(lin.values)))
    )


def _bordered_step(
    system: System, lin: Linearisation, closing: Closing, error: float
) -> tuple[np.ndarray, float, np.ndarray]:
    """Newton step (dx, d_height) of equilibrium and closing condition; also dx per unit of height."""
    both = system.solver.solve(np.stack([-lin.residual, -lin.jaw_coupling], axis=1))
    free, per_height = both[:, 0], both[:, 1]
    slope = closing.jaw_slope(lin) + closing.change(lin, per_height)
    if slope == 0.0 or not math.isfinite(slope):
        raise NotConverged("the jaw does not touch the artery")
    d_height = -(error + closing.change(lin, free)) / slope
    return free + d_height * per_height, d_height, per_height


def newton(
    system: System, state: State, pressure: float, axial_stretch: float, closing: Closing
) -> Equilibrium:
    """Solve for equilibrium and the closing condition from a nearby state. Raises NotConverged."""
    if isinstance(closing, Held):
        state = dataclasses.replace(state, jaw_height=jnp.asarray(closing.height))
    lin = system.linearise(state, pressure)
    if not _sound(lin):
        raise NotConverged("the predicted state is inverted", residual_norm(lin), float(lin.J_min))
    cuts, first_norm = 0, math.inf
    for iteration in range(MAX_NEWTON + 1):
        error = closing.error(state, lin)
        norm = residual_norm(lin)
        try:
            negative = system.solver.factor(lin.values)
            done = _converged(system, lin, error)
            dx, d_height, per_height = _bordered_step(system, lin, closing, error)
        except Singular as failure:
            raise NotConverged(str(failure), norm, float(lin.J_min)) from failure
        if done:
            slope = -float(lin.jaw_stiffness) - float(np.dot(lin.jaw_coupling, per_height))
            return Equilibrium(
                state, pressure, axial_stretch, lin, negative, slope, iterations=iteration
            )
        if iteration == MAX_NEWTON:
            break
        system.newton_iterations += 1
        largest = float(np.max(np.abs(dx)))
        fraction = min(1.0, LARGEST_MOVE * system.length / max(largest, abs(d_height), 1e-300))
        while True:
            trial = advance(system.body, state, dx, d_height, fraction)
            trial_lin = system.linearise(trial, pressure)
            if _sound(trial_lin) and residual_norm(trial_lin) <= LARGEST_GROWTH * float(lin.reactions):
                break
            fraction *= 0.4
            cuts += 1
            if cuts > MAX_CUTS:
                raise NotConverged("no admissible step", norm, float(lin.J_min))
        state, lin = trial, trial_lin
        if iteration == 0:
            first_norm = residual_norm(lin)
        if iteration > 1 and residual_norm(lin) > DIVERGING * first_norm:
            raise NotConverged("Newton's residual grows", residual_norm(lin), float(lin.J_min))
    raise NotConverged(f"{MAX_NEWTON} Newton iterations", residual_norm(lin), float(lin.J_min))


def descend(system: System, state: State, step: Step) -> Equilibrium:
    """Go down the potential at a held jaw to a stable equilibrium. Raises NotConverged.

    Steps solve (K + shift * C) dx = -residual, with C the diagonal of the tangent without its
    volumetric stiffness' scale (a uniform stiffness); the shift rises until the matrix is positive
    definite and the potential falls, and shrinks where the model predicts well (a trust region in
    all but name). With the shift at zero this is Newton's method.
    """
    assert isinstance(step.closing, Held)
    pressure = step.pressure
    state = dataclasses.replace(state, jaw_height=jnp.asarray(step.closing.height))
    lin = system.linearise(state, pressure)
    if not _sound(lin):
        raise NotConverged("the predicted state is inverted", residual_norm(lin), float(lin.J_min))
    unit = float(np.median(lin.values[system.diagonal])) * 1e-3
    shift, snapped = 0.0, False
    for iteration in range(MAX_DESCENT):
        if _converged(system, lin, 0.0):
            equilibrium = newton(system, state, pressure, step.axial_stretch, step.closing)
            return dataclasses.replace(equilibrium, iterations=iteration, snapped=snapped)
        accepted = False
        for _ in range(30):
            values = lin.values.copy()
            values[system.diagonal] += shift
            try:
                negative = system.solver.factor(values)
                dx = system.solver.solve(-lin.residual[:, None])[:, 0]
            except Singular:
                negative, dx = 1, np.zeros_like(lin.residual)
            downhill = float(np.dot(lin.residual, dx))
            if negative or downhill >= 0.0:
                snapped = True
                shift = max(4.0 * shift, unit)
                continue
            system.newton_iterations += 1
            fraction = min(1.0, LARGEST_MOVE * system.length / float(np.max(np.abs(dx))))
            trial = advance(system.body, state, dx, 0.0, fraction)
            trial_lin = system.linearise(trial, pressure)
            gain = float(lin.energy) - float(trial_lin.energy)
            noise = 1e-13 * abs(float(lin.energy))
            if _sound(trial_lin) and (
                gain >= -1e-4 * downhill * fraction - noise
                or residual_norm(trial_lin) < 0.3 * residual_norm(lin)
            ):
                accepted = True
                break
            shift = max(4.0 * shift, unit)
        if not accepted:
            break
        if gain >= -0.3 * downhill * fraction or residual_norm(trial_lin) < 0.3 * residual_norm(lin):
            shift = 0.25 * shift if shift > unit else 0.0
        state, lin = trial, trial_lin
    raise NotConverged("the descent did not end", residual_norm(lin), float(lin.J_min))


FIRST_STEP, SMALLEST_STEP, LARGEST_STEP = 0.1, 0.1 / 32, 0.18


def stretched(state: State, end_height: float) -> State:
    """The state with all axial positions scaled so that the end plane is at `end_height`, mm."""
    z = state.x[:, 2]
    return dataclasses.replace(state, x=state.x.at[:, 2].set(z * (end_height / jnp.max(z))))


def follow(
    system: System,
    start: Equilibrium,
    path: Path,
    half_length: float,
    on_step: Callable[[float, Equilibrium], None],
    reached: Callable[[Equilibrium], bool] = lambda equilibrium: False,
    first_step: float = FIRST_STEP,
) -> tuple[float, Equilibrium, NotConverged | None]:
    """Walk a path from its parameter 0 towards 1, as far as Newton goes.

    Returns the parameter reached, its equilibrium, and None or the last failure.
    half_length: of the load-free artery, mm; on_step is called at every converged state, and
    `reached` may end the walk there.
    """
    s, equilibrium, step = 0.0, start, first_step
    failure: NotConverged | None = None
    while s < 1.0:
        if step < SMALLEST_STEP:
            return s, equilibrium, failure
        target = min(1.0, s + step)
        if 1.0 - target < 0.3 * step:
            target = 1.0
        wanted = path(target)
        guess = stretched(equilibrium.state, wanted.axial_stretch * half_length)
        try:
            found = newton(system, guess, wanted.pressure, wanted.axial_stretch, wanted.closing)
        except NotConverged as error:
            failure, step = error, 0.4 * (target - s)
            continue
        system.load_steps += 1
        s, equilibrium = target, found
        on_step(s, equilibrium)
        if reached(equilibrium):
            break
        if found.iterations <= EASY_ITERATIONS:
            step = min(1.3 * step, max(LARGEST_STEP, first_step))
        elif found.iterations > 1.5 * EASY_ITERATIONS:
            step = 0.7 * step
    return s, equilibrium, None
