"""The whole path of the seed: stress-free sectors, load-free, in the body, clamped to the stop."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.failures import EquilibriumError, Exhausted, NotConverged, TermMissing
from jaxclamp.core.progress import Progress, Tell
from jaxclamp.fem.landmarks import half_height
from jaxclamp.observe.equilibria import Equilibria
from jaxclamp.observe.figures import Record, read_figures
from jaxclamp.observe.measures import sunk
from jaxclamp.observe.stops import OcclusionStop
from jaxclamp.observe.stresses import Stresses, stresses
from jaxclamp.potential.densities import rigid
from jaxclamp.potential.energy import State, with_equilibrium_pressure
from jaxclamp.potential.model import Model
from jaxclamp.potential.terms import INTIMA
from jaxclamp.scenes.scene import Stop
from jaxclamp.solve.branch import KINK, gain, require_same_path
from jaxclamp.solve.descent import descend_eased, ease_of
from jaxclamp.solve.follow import follow, stretched
from jaxclamp.solve.inflation import closed_tube, inflated_radius, inflated_tube
from jaxclamp.solve.limits import crumpled, sinking, walls_meet
from jaxclamp.solve.linear_solvers import LinearSolver
from jaxclamp.solve.newton import Equilibrium, Path, Step, System, bordered_step, newton
from jaxclamp.solve.results import Kept
from jaxclamp.solve.stops import Condition, Held, Row, Until

FIRST_TOUCH = 0.02
"""the first closing step, as part of the outer radius: enough to bring points into contact"""
NEARLY_CLOSED = 0.99
"""a stop that does not change steadily is sought in steps of occlusion up to here, then of its measure"""
SEEN_COMING = 0.7
"""share of the way to such a stop from which on closing goes in steps of its measure"""
NEARLY_THERE = 0.95
"""share of the way to the stop up to which closing goes in steps of travel, if it is to"""
AT_THE_STOP = 1e-8
"""distance of the jaw from where the stop's condition holds, as part of the lumen radius"""
RESCUE_MOVE = 0.02
"""jaw move of a descent, as part of the outer radius"""
MAX_RESCUES = 60
TOO_MANY_RESCUES = f"{MAX_RESCUES} descents did not lead to the stop"
LOAD_STEP = 0.3
"""first step of pressure and stretch, as part of the whole"""

ADVICE = {
    "load-free": "check radii, thicknesses and opening angles of the layers",
    "physiological": "check pressure and axial stretch against the stiffness of the wall, or refine the mesh",
    "clamping": "stop earlier, round the jaw's edges, or refine the mesh under them",
}


class Clamping:
    """One clamping under way: the system, what has converged so far, and whom to tell."""

    def __init__(
        self,
        model: Model,
        tell: Tell,
        solver: LinearSolver | None = None,
        every_term: bool = False,
        before: Clamping | None = None,
    ) -> None:
        """solver: to factor with; every_term: leave nothing out because the stop seems not to need it;
        before: an attempt at the same that came to nothing, whose work counts"""
        self.model, self.tell, self.every_term = model, tell, every_term
        self.states: list[Kept] = []
        settings = model.scene.solver
        if before is None:
            solver = solver or LinearSolver(model.pattern, settings.linear_solver)
            solver.reset_counts()
        else:
            solver = before.solver
        self.solver: LinearSolver = solver
        self.system = System(model.potential, solver, settings.tolerance, 1.0, model.pattern)
        if before is not None:
            self.system.count_on(before.system)

    # --- what is kept -------------------------------------------------------------------------------

    def keep(self, stage: str, equilibrium: Equilibrium, fraction: float, message: str) -> None:
        """Read a converged state off, remember it, and report progress."""
        state, closing = equilibrium.state, stage == "clamping"
        seen = stresses(self.model.potential, state)
        base, base_stresses = (self.body, self.body_stresses) if closing else (state, seen)
        values = read_figures(
            Equilibria(
                potential=self.model.potential.at_pressure(equilibrium.pressure),
                marks=self.model.marks,
                states=(base, state),
                known_stresses=(base_stresses, seen),
                known_wall=(equilibrium.lin.wall_energy, equilibrium.lin.wall_force),
                injury=self.model.scene.injury,
            )
        )
        if closing:
            self.check(values)
        self.states.append(Kept(stage, equilibrium, values, self.model))
        if stage == "physiological":
            self.refer_to(state, seen)
        self.tell(Progress(stage, fraction, message))

    def refer_to(self, body: State, body_stresses: tuple[Stresses, ...] | None = None) -> None:
        """Take the state in the body that stops, travels and ratios refer to."""
        marks, potential = self.model.marks, self.model.potential
        self.body = body
        self.body_stresses = stresses(potential, body) if body_stresses is None else body_stresses
        self.lumen_radius = self.system.length = half_height(body.x, marks)
        self.outer_radius = float(np.asarray(body.x)[marks.outer_top, 1])
        clear = self.outer_radius + 2.0 * float(self.model.scene.contact.smoothing)  # it presses before
        self.first_measure = self.measure(dataclasses.replace(body, q=self.rigid(clear)))

    def take_over(self, *kept: Kept) -> None:
        """Go on from states that are known already, the last of them in the body."""
        self.states[:] = [dataclasses.replace(each, model=self.model) for each in kept]
        self.refer_to(kept[-1].state)

    def use(self, model: Model) -> None:
        """Compute with another scene of the same static choices."""
        self.model = model
        self.use_terms(closing=True)

    def use_terms(self, closing: bool) -> None:
        """Have those terms that the stage needs."""
        self.system.potential = self.model.solved(closing, self.every_term)

    def check(self, values: Record) -> None:
        """Refuse a closing state that the model does not cover. Raises EquilibriumError, TermMissing."""
        if walls_meet(values, self.lumen_radius) and not self.system.potential.of(INTIMA):
            raise TermMissing(f"opposite inner walls meet before the stop: the term '{INTIMA}' is needed")
        reason = sinking(values, self.outer_radius - self.lumen_radius) or crumpled(values)
        if reason is not None:
            raise self.error("clamping", self.states[-1].equilibrium, NotConverged(reason))

    # --- the three stages -----------------------------------------------------------------------------

    def load_free(self, guess: State | None = None) -> Equilibrium:
        """Close the open sectors: no pressure, no stretch, the jaw far away.

        The round tube counts even if it is not stable: a wall may wrinkle unloaded, and be smooth in use.
        """
        self.tell(Progress("load-free", 0.0, "closing the open sectors"))
        scene, model = self.model.scene, self.model
        self.use_terms(closing=False)
        x = closed_tube(model.mesh, scene.mesh, scene.artery) if guess is None else guess.x
        self.system.length = float(np.max(np.asarray(x)[:, 1]))
        far = self.rigid(self.far)
        start = with_equilibrium_pressure(model.potential, x, far) if guess is None else guess
        step = Step(Held(self.far), 0.0, 1.0)
        try:
            equilibrium = newton(self.system, start, step)
        except NotConverged:
            equilibrium = self.solve_or_descend("load-free", start, step, "no load")
        self.system.length = half_height(equilibrium.state.x, self.model.marks)
        self.keep("load-free", equilibrium, 1.0, f"lumen radius {self.system.length:.3f} mm")
        return equilibrium

    def in_body(self, load_free: Equilibrium, guess: State | None = None) -> Equilibrium:
        """Stretch and inflate."""
        artery = self.model.scene.artery
        pressure, stretch = float(artery.pressure), float(artery.axial_stretch)
        path: Path = lambda s: Step(Held(self.far), s * pressure, 1.0 + s * (stretch - 1.0))  # noqa: E731
        say = lambda s, e: self.tell(  # noqa: E731
            Progress("physiological", s, f"{e.pressure:.2f} kPa, axial stretch {e.axial_stretch:.3f}")
        )
        equilibrium = None
        if guess is None:
            guess = inflated_tube(self.model.potential, artery, load_free.state, self.system.length)
        else:
            guess = stretched(guess, self.model.end_height(stretch))
        if guess is not None:
            with contextlib.suppress(NotConverged):
                equilibrium = newton(self.system, guess, path(1.0))
        if equilibrium is None or equilibrium.negative_pivots:
            equilibrium = self.walk("physiological", load_free, path, say, lambda e: False, LOAD_STEP)
            if equilibrium.negative_pivots:
                buckled = NotConverged("the artery loses stability: it buckles or bulges")
                raise self.error("physiological", equilibrium, buckled)
        radius = half_height(equilibrium.state.x, self.model.marks)
        self.keep("physiological", equilibrium, 1.0, f"lumen radius {radius:.3f} mm")
        return equilibrium

    def close(self, in_body: Equilibrium) -> Equilibrium:
        """Move the jaw on until the stop."""
        self.use_terms(closing=True)
        equilibrium = self.first_contact(in_body)
        self.keep("clamping", equilibrium, 0.0, "first contact")
        return self.go_on(equilibrium)

    def go_on(self, equilibrium: Equilibrium) -> Equilibrium:
        """Move the jaw on from a state under it until the stop."""
        for _ in range(MAX_RESCUES):
            path, reached = self.next_path(equilibrium)
            if path is None:
                return equilibrium
            equilibrium = self.walk("clamping", equilibrium, path, self.tell_closing, reached)
        raise self.error("clamping", equilibrium, NotConverged(TOO_MANY_RESCUES))

    def first_contact(self, in_body: Equilibrium) -> Equilibrium:
        """The jaw just on the artery, not beyond the stop."""
        stride = move = FIRST_TOUCH * self.outer_radius  # teeth and a short reach touch later than others
        while True:
            touch = self.outer_radius - move
            start = dataclasses.replace(in_body.state, q=self.rigid(touch))
            load = f"first contact, jaw height {touch:.3f} mm"
            equilibrium = self.solve_or_descend("clamping", start, self.step(Held(touch)), load)
            beyond = self.distance(equilibrium) if self.share(equilibrium.state) > 1.0 else 0.0
            late = stride and not beyond and not np.any(equilibrium.lin.coupling[:, 0])
            if late and sunk(self.known(self.body, equilibrium.state)) <= 0.0:
                move, stride = move + stride, stride if move < self.outer_radius else 0.0
                continue
            if beyond == 0.0 or move == 0.0:
                return equilibrium
            move, stride = max(0.5 * (move - beyond), 0.0), 0.0

    def next_path(self, now: Equilibrium) -> tuple[Path | None, Callable[[Equilibrium], bool]]:
        """The load path from here towards the stop, and where to leave it early; None at the stop."""
        scene, share = self.model.scene, self.share(now.state)
        never = lambda e: False  # noqa: E731
        if self.distance(now) <= AT_THE_STOP * self.lumen_radius:
            return None, never
        if scene.solver.continuation == "travel" and share < NEARLY_THERE:
            jaw, way = float(now.state.jaw_height), min(self.distance(now), self.lumen_radius)
            there = lambda e: self.share(e.state) > NEARLY_THERE  # noqa: E731
            return (lambda s: self.step(Held(jaw - s * way))), there
        nearly_closed = self.occlusion(now.state) >= NEARLY_CLOSED - 1e-8
        felt = lambda e: bool(np.any(self.row(e.state).by_x))  # noqa: E731
        if nearly_closed and not felt(now):  # what is to press does not touch yet
            jaw, way = float(now.state.jaw_height), 2.0 * half_height(now.state.x, self.model.marks)
            return (lambda s: self.step(Held(jaw - s * way))), felt
        if scene.stop.STEADY or share > SEEN_COMING or nearly_closed:
            return self.towards(scene.stop, now, float(scene.stop.target())), never
        coming = lambda e: self.share(e.state) > SEEN_COMING  # noqa: E731
        closed = OcclusionStop(kind="occlusion", occlusion=jnp.asarray(NEARLY_CLOSED))
        return self.towards(closed, now, NEARLY_CLOSED), coming

    # --- the stop -------------------------------------------------------------------------------------

    def known(self, *states: State) -> Equilibria:
        """The scene with some states."""
        return Equilibria(potential=self.model.potential, marks=self.model.marks, states=states)

    def measure(self, state: State) -> float:
        """The measure of the stop at a state, internal units."""
        return self.row(state).error

    def row(self, state: State, target: float = 0.0) -> Row:
        """The stop's condition at a state."""
        until = Until(self.model.scene.stop, target, self.known(self.body, state))
        return until.row(state, self.system.solver.n)

    def share(self, state: State) -> float:
        """Share of the way from first contact to the stop; inf for a stop that is there from the start."""
        target, value = float(self.model.scene.stop.target()), self.measure(state)
        way = target - self.first_measure
        return (value - self.first_measure) / way if way else (math.inf if value != target else 1.0)

    def distance(self, now: Equilibrium) -> float:
        """How far the jaw is from where the stop's condition holds, to first order, mm."""
        row = self.row(now.state, float(self.model.scene.stop.target()))
        if row.error == 0.0:
            return 0.0
        try:
            return bordered_step(now.responses, now.lin, row)[2]
        except NotConverged:
            return math.inf

    def towards(self, stop: Stop, now: Equilibrium, target: float) -> Path:
        """The path on which a stop's measure goes straight from where it is to a target."""
        known = self.known(self.body, now.state)
        here = Until(stop, 0.0, known).row(now.state, self.system.solver.n).error
        return lambda s: self.step(Until(stop, here + s * (target - here), known))

    def at_stop(self, near: State) -> Step:
        """What the stop asks of the final state."""
        stop, known = self.model.scene.stop, self.known(self.body, near)
        return self.step(Until(stop, float(stop.target()), known))

    # --- pieces ---------------------------------------------------------------------------------------

    @property
    def far(self) -> float:
        """A jaw height well clear of any artery the scene can make, mm."""
        return 1e3 * float(self.model.scene.artery.layers[-1].inner_radius)

    def rigid(self, height: float) -> Array:
        """Rigid coordinates with the jaws at a height, mm."""
        return rigid(height, self.model.discretisation.layout.n_rigid)

    def step(self, closing: Condition) -> Step:
        """A condition under the scene's pressure and stretch."""
        artery = self.model.scene.artery
        return Step(closing, float(artery.pressure), float(artery.axial_stretch))

    def occlusion(self, state: State) -> float:
        """1 - lumen height over that in the body."""
        return 1.0 - half_height(state.x, self.model.marks) / self.lumen_radius

    def tell_closing(self, s: float, equilibrium: Equilibrium) -> None:
        """Keep a closing state and report it."""
        force = float(equilibrium.lin.jaw_force) * self.model.symmetry.parts_of_a_jaw * 1e-3
        note = ", snapped" if equilibrium.snapped else ""
        message = f"occlusion {self.occlusion(equilibrium.state):.1%}, jaw force {force:.3f} N{note}"
        fraction = min(max(self.share(equilibrium.state), 0.0), 1.0)
        self.keep("clamping", equilibrium, fraction, message)

    def walk(
        self,
        stage: str,
        start: Equilibrium,
        path: Path,
        say: Callable[[float, Equilibrium], None],
        reached: Callable[[Equilibrium], bool],
        first_step: float | None = None,
    ) -> Equilibrium:
        """Follow a path; where Newton fails, take one step downhill at a held jaw and return."""
        options: dict[str, Any] = {} if first_step is None else {"first_step": first_step}
        if stage == "clamping":
            options["accept"] = require_same_path
        _, equilibrium, failure = follow(
            self.system, start, path, self.model.end_height, say, reached, **options
        )
        if failure is None:
            return equilibrium
        if stage != "clamping":
            if inflated_radius(self.model.scene.artery, self.system.length) is None:
                failure = NotConverged("the wall does not carry the pressure: it balloons")
            raise self.error(stage, equilibrium, failure)
        return self.rescue(equilibrium, failure, say)

    def rescue(
        self, last: Equilibrium, failure: NotConverged, say: Callable[[float, Equilibrium], None]
    ) -> Equilibrium:
        """One step downhill from where the jaw was lowest: a path may come back up and be walked for ever."""
        closed = [last, *(kept.equilibrium for kept in self.states if kept.stage == "clamping")]
        lowest = min(closed, key=lambda e: float(e.state.jaw_height))
        move, elsewhere = RESCUE_MOVE * self.outer_radius, None
        while move > 1e-3 * RESCUE_MOVE * self.outer_radius:
            step = self.step(Held(float(lowest.state.jaw_height) - move))
            try:
                found = self.settle(lowest.state, step, lowest)
            except Exhausted:  # what failed before is the cause
                break
            except NotConverged as error:
                failure, move = error, 0.5 * move
                continue
            gained = gain(lowest, found)
            if gained <= KINK:
                found = dataclasses.replace(found, snapped=gained < -KINK)
                say(math.nan, found)
                return found
            elsewhere, move = elsewhere or found, 0.5 * move
        if elsewhere is not None:
            say(math.nan, elsewhere)
            return elsewhere
        if self.share(lowest.state) > 1.0 + 1e-6:
            failure = NotConverged("the lumen snaps shut past the stop, and no way back to it was found")
        raise self.error("clamping", last, failure)

    def solve_or_descend(self, stage: str, start: State, step: Step, load: str) -> Equilibrium:
        """Newton, and if that fails the way downhill."""
        try:
            return self.settle(start, step)
        except NotConverged as error:
            raise EquilibriumError(stage, f"at {load}", error, ADVICE[stage]) from error

    def settle(self, start: State, step: Step, before: Equilibrium | None = None) -> Equilibrium:
        """A stable equilibrium at a held jaw, by Newton's method or downhill. Raises NotConverged.

        before: the equilibrium that Newton's method is to stay on the path of
        """
        with contextlib.suppress(NotConverged):
            found = newton(self.system, start, step)
            if before is not None:
                require_same_path(step, before, found)
            if not found.negative_pivots:
                return found
        return descend_eased(self.system, start, step, ease_of(self.model.scene))

    def error(self, stage: str, last: Equilibrium, failure: NotConverged) -> EquilibriumError:
        """The sentence for a user, with the last load that did converge."""
        if stage == "clamping" and float(last.state.jaw_height) == self.far:
            return EquilibriumError(stage, "at first contact", failure, ADVICE[stage])
        if stage == "clamping":
            height = float(last.state.jaw_height)
            load = f"occlusion {self.occlusion(last.state):.1%}, jaw height {height:.4f} mm"
            if not (stop := self.model.scene.stop).STEADY:
                load += f", {stop.kind} {stop.said(self.measure(last.state))}"
        else:
            load = f"pressure {last.pressure:.4g} kPa, axial stretch {last.axial_stretch:.4g}"
        return EquilibriumError(stage, f"beyond {load}", failure, ADVICE[stage])
