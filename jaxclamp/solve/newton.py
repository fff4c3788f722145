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

from jaxclamp.core.failures import Exhausted, NotConverged, Singular
from jaxclamp.potential.tangent import Body, Linearisation, State, advance, linearise
from jaxclamp.solve.linear_solvers import LinearSolver

MAX_NEWTON = 14
MAX_CUTS = 2
DIVERGING = 4.0
MAX_DESCENT = 150
MAX_SHIFTS = 30
MAX_LINEARISATIONS = 3000
"""a clamping that needs more is given up, so that nothing runs for ever"""
SUFFICIENT_FALL = 1e-4
GOOD_MODEL = 0.3
EASY_ITERATIONS = 5
"""a step that converged in so many iterations lets the next one grow"""
SMALLEST_STIFFENING = 1 / 32
"""eased penalties are restored in steps of at least this share of the way, or given up"""
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
    responses: np.ndarray
    """change of the free unknowns to remove the residual, and per unit of jaw height, (n_free, 2)"""
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
    first_seconds: float = 0.0
    linearisations: int = 0
    patience: int = MAX_LINEARISATIONS

    def be_patient(self) -> None:
        """Allow as many assemblies from here as a clamping may need."""
        self.patience = self.linearisations + MAX_LINEARISATIONS

    def linearise(self, state: State, pressure: float) -> Linearisation:
        """Forces and tangent, on the host (numpy arrays). Raises NotConverged when patience is out."""
        if self.linearisations >= self.patience:
            raise Exhausted(f"no way was found in {MAX_LINEARISATIONS} assemblies")
        start = time.perf_counter()
        lin: Linearisation = jax.device_get(linearise(self.body, state, jnp.asarray(pressure)))
        seconds = time.perf_counter() - start
        if self.linearisations == 0:
            self.first_seconds = seconds
        self.linearisations += 1
        self.assembly_seconds += seconds
        return lin

    @property
    def compile_seconds(self) -> float:
        """What the first assembly took beyond a usual one: compilation, if it was needed, s."""
        usual = (self.assembly_seconds - self.first_seconds) / max(self.linearisations - 1, 1)
        return max(self.first_seconds - usual, 0.0)


def residual_norm(lin: Linearisation) -> float:
    """Norm of the free forces, mN; inf where they are not finite or beyond reason."""
    largest = float(np.max(np.abs(lin.residual), initial=0.0))
    return float(np.linalg.norm(lin.residual)) if largest < 1e150 else math.inf


def _converged(system: System, state: State, lin: Linearisation, closing_error: float) -> bool:
    """The forces balance to the tolerance or to rounding, cells have their volume, the closing holds."""
    free = np.asarray(state.x).reshape(-1)[np.asarray(system.body.topology.free)]
    forces = lin.values[system.diagonal] * free
    sane = float(np.max(np.abs(forces), initial=0.0)) < LARGEST_FORCE
    rounding = ROUND_OFF * float(np.linalg.norm(forces)) if sane else 0.0
    small = residual_norm(lin) <= max(system.tolerance * float(lin.reactions), rounding)
    closed = float(lin.volume_error) <= VOLUME_TOLERANCE and abs(closing_error) <= 1e-9 * system.length
    return small and closed


def _sound(lin: Linearisation) -> bool:
    return (
        float(lin.J_min) > 0.0
        and math.isfinite(float(lin.energy))
        and math.isfinite(residual_norm(lin))
        and bool(np.all(np.isfinite(lin.values)))
    )


def _bordered_step(
    responses: np.ndarray, lin: Linearisation, closing: Closing, error: float
) -> tuple[np.ndarray, float]:
    """Newton step (dx, d_height) of equilibrium and closing condition."""
    free, per_height = responses[:, 0], responses[:, 1]
    slope = closing.jaw_slope(lin) + closing.change(lin, per_height)
    if slope == 0.0 or not math.isfinite(slope):
        raise NotConverged("the jaw does not touch the artery")
    d_height = -(error + closing.change(lin, free)) / slope
    return free + d_height * per_height, d_height


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
    if isinstance(closing, Held) and float(state.jaw_height) != closing.height:
        state = dataclasses.replace(state, jaw_height=jnp.asarray(closing.height))
    reuse = known if known is not None and known.state is state and known.pressure == pressure else None
    lin = system.linearise(state, pressure) if reuse is None else reuse.lin
    if not _sound(lin):
        raise NotConverged("the predicted state is inverted", residual_norm(lin), float(lin.J_min))
    cuts, first_imbalance = 0, math.inf
    for iteration in range(MAX_NEWTON + 1):
        error = closing.error(state, lin)
        negative, responses = (
            _factored(system, lin) if reuse is None else (reuse.negative_pivots, reuse.responses)
        )
        reuse = None
        dx, d_height = _bordered_step(responses, lin, closing, error)
        if _converged(system, state, lin, error):
            slope = -float(lin.jaw_stiffness) - float(np.dot(lin.jaw_coupling, responses[:, 1]))
            return Equilibrium(
                state, pressure, step.axial_stretch, lin, negative, slope, responses, iteration
            )
        system.newton_iterations += 1
        state, lin, shortened = _admissible(system, state, lin, pressure, dx, d_height, MAX_CUTS - cuts)
        cuts += shortened
        imbalance = float(lin.imbalance)
        first_imbalance = imbalance if iteration == 0 else first_imbalance
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
    if not _sound(lin):
        return near.state
    both = np.stack([-np.asarray(lin.residual), -np.asarray(lin.jaw_coupling)], axis=1)
    try:
        responses = system.solver.solve(both)
        dx, d_height = _bordered_step(responses, lin, step.closing, step.closing.error(near.state, lin))
    except (Singular, NotConverged):
        return near.state
    largest = max(float(np.max(np.abs(dx))), abs(d_height), 1e-300)
    return advance(system.body, near.state, dx, d_height, min(1.0, LARGEST_MOVE * system.length / largest))


def _factored(system: System, lin: Linearisation) -> tuple[int | None, np.ndarray]:
    """Negative eigenvalues of the tangent, and both responses (n_free, 2). Raises NotConverged."""
    try:
        negative = system.solver.factor(np.asarray(lin.values))
        both = np.stack([-np.asarray(lin.residual), -np.asarray(lin.jaw_coupling)], axis=1)
        return negative, system.solver.solve(both)
    except Singular as failure:
        raise NotConverged(str(failure), residual_norm(lin), float(lin.J_min)) from failure


def _admissible(
    system: System,
    state: State,
    lin: Linearisation,
    pressure: float,
    dx: np.ndarray,
    d_height: float,
    cuts_left: int,
) -> tuple[State, Linearisation, int]:
    """Go along a Newton step, shortened until no cell inverts and no force explodes.

    Returns the new state, its linearisation and how often the step was cut. Raises NotConverged
    after `cuts_left` cuts.
    """
    largest = max(float(np.max(np.abs(dx))), abs(d_height), 1e-300)
    fraction = min(1.0, LARGEST_MOVE * system.length / largest)
    bound = LARGEST_GROWTH * max(float(lin.reactions), float(lin.imbalance))
    for cut in range(cuts_left + 1):
        trial = advance(system.body, state, dx, d_height, fraction)
        trial_lin = system.linearise(trial, pressure)
        if _sound(trial_lin) and float(trial_lin.imbalance) <= bound:
            return trial, trial_lin, cut
        fraction *= 0.4
    raise NotConverged(
        "a Newton step inverts cells or makes forces explode", residual_norm(lin), float(lin.J_min)
    )


def descend(system: System, state: State, step: Step) -> Equilibrium:
    """Go down the potential at a held jaw to a stable equilibrium. Raises NotConverged.

    Steps solve (K + shift I) dx = -residual. The shift rises until the matrix is positive definite
    and the potential falls enough, and shrinks where the quadratic model predicts well (a trust
    region in all but name). With the shift at zero this is Newton's method.
    """
    assert isinstance(step.closing, Held)
    state = dataclasses.replace(state, jaw_height=jnp.asarray(step.closing.height))
    lin = system.linearise(state, step.pressure)
    if not _sound(lin):
        raise NotConverged("the predicted state is inverted", residual_norm(lin), float(lin.J_min))
    unit = 1e-3 * float(np.median(lin.values[system.diagonal]))
    shift, unstable = 0.0, False
    for iteration in range(MAX_DESCENT):
        if _converged(system, state, lin, 0.0):
            equilibrium = newton(system, state, step)
            return dataclasses.replace(equilibrium, iterations=iteration, snapped=unstable)
        for _ in range(MAX_SHIFTS):
            dx = _downhill_step(system, lin, shift)
            if dx is None:
                unstable = True
            else:
                trial, trial_lin, quality = _go_down(system, state, lin, step.pressure, dx)
                if quality > 0.0:
                    break
            shift = max(4.0 * shift, unit)
        else:
            break
        if quality > GOOD_MODEL:
            shift = 0.25 * shift if shift > unit else 0.0
        state, lin = trial, trial_lin
    raise NotConverged("the way downhill did not end", residual_norm(lin), float(lin.J_min))


@dataclasses.dataclass(frozen=True)
class Ease:
    """How much softer the penalties are made to find a way: factors of at most 1."""

    bulk: float
    contact: float

    def body(self, body: Body, share: float) -> Body:
        """The body with its penalties eased by a share (1 fully, 0 not at all) of the way, in powers."""
        contact = body.parameters.contact
        softer = dataclasses.replace(contact, stiffness=contact.stiffness * self.contact**share)
        stiffness = body.geometry.pressure_stiffness * self.bulk**share
        return dataclasses.replace(
            body,
            geometry=dataclasses.replace(body.geometry, pressure_stiffness=stiffness),
            parameters=dataclasses.replace(body.parameters, contact=softer),
        )


def descend_eased(system: System, state: State, step: Step, ease: Ease) -> Equilibrium:
    """Go downhill with softer penalties, then stiffen them to their own values. Raises NotConverged.

    Along a stiff penalty the potential is a narrow, curved valley that no descent gets far in; Newton's
    method, with the pressures of the cells as unknowns of their own, follows the stiffening easily.
    """
    whole = system.body
    try:
        system.body = ease.body(whole, 1.0)
        found = descend(system, state, step)
        snapped, share, stride = found.snapped, 1.0, 0.5
        while share > 0.0:
            target = max(share - stride, 0.0)
            system.body = ease.body(whole, target) if target else whole
            try:
                found, share = newton(system, found.state, step), target
            except NotConverged:
                stride *= 0.5
                if stride < SMALLEST_STIFFENING:
                    system.body = whole
                    found, share = descend(system, found.state, step), 0.0
                    snapped = snapped or found.snapped
    finally:
        system.body = whole
    if found.negative_pivots:
        raise NotConverged("lost stability", residual_norm(found.lin), float(found.lin.J_min))
    return dataclasses.replace(found, snapped=snapped)


def _downhill_step(system: System, lin: Linearisation, shift: float) -> np.ndarray | None:
    """-(K + shift I)^-1 residual, (n_free,); None if that matrix is not positive definite."""
    values = np.array(lin.values)
    values[system.diagonal] += shift
    try:
        negative = system.solver.factor(values)
        dx = system.solver.solve(-np.asarray(lin.residual)[:, None])[:, 0]
    except Singular:
        return None
    return None if negative or np.dot(lin.residual, dx) >= 0.0 else dx


def _go_down(
    system: System, state: State, lin: Linearisation, pressure: float, dx: np.ndarray
) -> tuple[State, Linearisation, float]:
    """Go along a downhill step; how well the fall agrees with the prediction, 0 or less if refused.

    Close to equilibrium, where the fall drowns in rounding, a smaller residual is accepted instead.
    """
    system.newton_iterations += 1
    fraction = min(1.0, LARGEST_MOVE * system.length / float(np.max(np.abs(dx))))
    trial = advance(system.body, state, dx, 0.0, fraction)
    trial_lin = system.linearise(trial, pressure)
    if not _sound(trial_lin):
        return state, lin, -1.0
    if residual_norm(trial_lin) < 0.3 * residual_norm(lin):
        return trial, trial_lin, 1.0
    predicted = -float(np.dot(lin.residual, dx)) * fraction
    fall = float(lin.energy) - float(trial_lin.energy)
    return trial, trial_lin, fall / predicted - SUFFICIENT_FALL


FIRST_STEP, SMALLEST_STEP, LARGEST_STEP = 0.12, 0.12 / 32, 0.15


def stretched(state: State, end_height: float) -> State:
    """The state with all axial positions scaled so that the end plane is at `end_height`, mm."""
    z = state.x[:, 2]
    if abs(float(jnp.max(z)) - end_height) <= 1e-14 * end_height:
        return state
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
            found = newton(system, guess, wanted, equilibrium)
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
        elif found.iterations > EASY_ITERATIONS + 2:
            step = 0.7 * step
    return s, equilibrium, None
