"""The whole path of the seed: stress-free sectors, load-free, physiological, clamped to the stop."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxclamp.core.failures import EquilibriumError, Exhausted, NotConverged
from jaxclamp.core.progress import Progress, teller
from jaxclamp.core.records import shape_of
from jaxclamp.fem.tube import closed_positions
from jaxclamp.observe.stresses import PARTS_OF_A_JAW, Report, observe
from jaxclamp.potential.model import Model, build_model, same_kind
from jaxclamp.potential.tangent import State, with_equilibrium_pressure
from jaxclamp.scenes.files import require_computable
from jaxclamp.scenes.scene import ForceStop, OcclusionStop, Scene, TravelStop
from jaxclamp.solve.inflation import inflated_positions, inflated_radius
from jaxclamp.solve.linear_solvers import LinearSolver
from jaxclamp.solve.newton import (
    Ease,
    Equilibrium,
    Held,
    JawForce,
    LumenHeight,
    Path,
    Step,
    System,
    descend_eased,
    follow,
    newton,
    predict,
    stretched,
)
from jaxclamp.solve.results import Kept, LinearSolvers, Result, work_balance
from jaxclamp.solve.transfer import transferred

FIRST_TOUCH = 0.02
"""the first closing step, as part of the outer radius: enough to bring points into contact"""
NEARLY_CLOSED = 0.99
"""a force stop is sought up to this occlusion"""
LARGEST_SINKING = 0.5
"""jaw and wall, or opposite inner walls, may overlap by this part of the wall's thickness"""
SMALLEST_SHARE = 1 / 16
"""a neighbour's solution is followed in steps of at least this share of the way, or given up"""
RESCUE_MOVE = 0.02
"""jaw move of a descent, as part of the outer radius"""
MAX_RESCUES = 60
EASY_BULK, EASY_CONTACT = 400.0, 100.0
"""bulk modulus, and contact stiffness times the wall's thickness, over its shear modulus, with which the
way downhill is easy"""
LOAD_STEP = 0.3
"""first step of pressure and stretch, as part of the whole"""


class _Walk:
    """One clamping under way: the system, what has converged so far, and whom to tell."""

    def __init__(
        self,
        model: Model,
        report: Callable[[Progress], Any],
        start: float,
        solvers: LinearSolvers | None = None,
    ) -> None:
        self.model, self.report, self.start = model, report, start
        self.states: list[Kept] = []
        settings = model.scene.solver
        if solvers is None:
            fresh = lambda: LinearSolver(model.pattern, settings.linear_solver)  # noqa: E731
            solvers = LinearSolvers(stop=fresh(), physiological=fresh())
        self.solvers = solvers
        solvers.stop.reset_counts()
        self.system = System(
            body=model.body,
            solver=solvers.stop,
            tolerance=settings.tolerance,
            length=1.0,
            diagonal=model.pattern.indptr[:-1],
        )

    def keep(self, stage: str, equilibrium: Equilibrium, fraction: float, message: str) -> None:
        """Read a converged state off, remember it, and report progress."""
        marks = self.model.marks
        seen = observe(self.model.body, equilibrium.state, jnp.asarray(equilibrium.pressure), marks)
        values = _to_floats(seen, marks.layer_names)
        if stage == "clamping":
            self.check(values)
        self.states.append(Kept(stage, equilibrium, values))
        self.report(Progress(stage, fraction, message))

    def check(self, values: dict[str, Any]) -> None:
        """Refuse a closing state that the model does not cover. Raises EquilibriumError."""
        reason, thickness = None, self.outer_radius - self.lumen_radius
        if values["outer_radius_mm"] - values["jaw_height_mm"] > LARGEST_SINKING * thickness:
            reason = "the jaw sinks in between the contact points of the wall: refine the mesh under it"
        if values["lumen_overlap_mm"] > LARGEST_SINKING * thickness:
            reason = "the inner walls sink into each other: raise contact.stiffness_kPa_per_mm"
        if values["max_penetration_mm"] > LARGEST_SINKING * thickness:
            reason = "the jaws sink into the wall: raise contact.stiffness_kPa_per_mm"
        if reason is not None:
            raise self.error("clamping", self.states[-1].equilibrium, NotConverged(reason))

    # --- the three stages -----------------------------------------------------------------------

    def load_free(self, guess: State | None) -> Equilibrium:
        """Close the open sectors: no pressure, no stretch, the jaw far away."""
        self.report(Progress("load-free", 0.0, "closing the open sectors"))
        scene, model = self.model.scene, self.model
        far = jnp.asarray(self.far)
        x = closed_positions(model.mesh, scene.mesh, scene.artery) if guess is None else guess.x
        self.system.length = float(jnp.max(x[:, 1]))
        start = with_equilibrium_pressure(model.body, x, far) if guess is None else guess
        step = Step(Held(self.far), 0.0, 1.0)
        equilibrium = self.solve_or_descend("load-free", start, step, "no load")
        self.system.length = float(equilibrium.state.x[model.marks.lumen_top, 1])
        radius = self.system.length
        self.keep("load-free", equilibrium, 1.0, f"lumen radius {radius:.3f} mm")
        return equilibrium

    def physiological(self, load_free: Equilibrium, guess: State | None) -> Equilibrium:
        """Stretch and inflate."""
        artery = self.model.scene.artery
        pressure, stretch = float(artery.pressure), float(artery.axial_stretch)
        path: Path = lambda s: Step(Held(self.far), s * pressure, 1.0 + s * (stretch - 1.0))  # noqa: E731
        tell = lambda s, e: self.report(  # noqa: E731
            Progress("physiological", s, f"{e.pressure:.2f} kPa, axial stretch {e.axial_stretch:.3f}")
        )
        equilibrium = None
        if guess is None:
            guess = self.inflated(load_free)
        else:
            guess = stretched(guess, stretch * self.model.half_length)
        if guess is not None:
            with contextlib.suppress(NotConverged):
                equilibrium = newton(self.system, guess, path(1.0))
        if equilibrium is None or equilibrium.negative_pivots:
            equilibrium = self.walk("physiological", load_free, path, tell, lambda e: False, LOAD_STEP)
            if equilibrium.negative_pivots:
                buckled = NotConverged("the artery loses stability: it buckles or bulges")
                raise self.error("physiological", equilibrium, buckled)
        self.system.length = float(equilibrium.state.x[self.model.marks.lumen_top, 1])
        self.keep("physiological", equilibrium, 1.0, f"lumen radius {self.system.length:.3f} mm")
        return equilibrium

    def inflated(self, load_free: Equilibrium) -> State | None:
        """The artery as an incompressible round tube at its stretch and pressure; None if there is none."""
        artery, far = self.model.scene.artery, load_free.state.jaw_height
        radius = inflated_radius(artery, self.system.length)
        if radius is None:
            return None
        x = inflated_positions(load_free.state.x, artery, self.system.length, radius)
        return with_equilibrium_pressure(self.model.body, x, far)

    def close(self, physiological: Equilibrium) -> Equilibrium:
        """Move the jaw on until the stop."""
        scene = self.model.scene
        self.refer_to(physiological)
        stop = scene.stop
        move = FIRST_TOUCH * self.outer_radius
        if isinstance(stop, TravelStop):
            move = min(move, float(stop.travel))
        elif isinstance(stop, OcclusionStop):
            move = min(move, 0.5 * float(stop.occlusion) * self.lumen_radius)
        touch = self.outer_radius - move
        start = dataclasses.replace(physiological.state, jaw_height=jnp.asarray(touch))
        equilibrium = self.solve_or_descend(
            "clamping", start, self.held(touch), f"first contact, jaw height {touch:.3f} mm"
        )
        self.keep("clamping", equilibrium, 0.0, "first contact")
        for _ in range(MAX_RESCUES):
            path, reached = self.next_path(equilibrium)
            if path is None:
                return equilibrium
            equilibrium = self.walk("clamping", equilibrium, path, self.tell_closing, reached)
        raise self.error(
            "clamping", equilibrium, NotConverged(f"{MAX_RESCUES} descents did not lead to the stop")
        )

    def next_path(self, now: Equilibrium) -> tuple[Path | None, Callable[[Equilibrium], bool]]:
        """The load path from here towards the stop, and where to leave it early; None at the stop."""
        scene = self.model.scene
        stop, by_travel = scene.stop, scene.solver.continuation == "travel"
        height, jaw = self.top(now), float(now.state.jaw_height)
        never = lambda e: False  # noqa: E731
        if isinstance(stop, TravelStop):
            target = self.outer_radius - float(stop.travel)
            if abs(jaw - target) <= 1e-12 * self.outer_radius:
                return None, never
            return (lambda s: self.held(jaw + s * (target - jaw))), never
        if isinstance(stop, OcclusionStop):
            target = (1.0 - float(stop.occlusion)) * self.lumen_radius
            if abs(height - target) <= 1e-8 * self.lumen_radius:
                return None, never
            if by_travel and height > target + 0.05 * self.lumen_radius:
                lowest = jaw - (height - target)
                return (
                    lambda s: self.held(jaw + s * (lowest - jaw)),
                    lambda e: self.top(e) < target + 0.05 * self.lumen_radius,
                )
            return (lambda s: self.lumen(height + s * (target - height))), never
        assert isinstance(stop, ForceStop)
        wanted, force = float(stop.force) / PARTS_OF_A_JAW, float(now.lin.jaw_force)
        if abs(force - wanted) <= 1e-6 * wanted:
            return None, never
        if force > 0.7 * wanted:
            scale = abs(now.force_slope) or 1.0
            condition = lambda s: JawForce(force + s * (wanted - force), scale)  # noqa: E731
            return (lambda s: self.step(condition(s))), never
        target = (1.0 - NEARLY_CLOSED) * self.lumen_radius
        if height <= target * (1.0 + 1e-6):
            reason = f"{force * PARTS_OF_A_JAW * 1e-3:.3g} N is all it takes to {NEARLY_CLOSED:.0%} occlusion"
            raise self.error("clamping", now, NotConverged(reason))
        return (
            lambda s: self.lumen(height + s * (target - height))
        ), lambda e: float(e.lin.jaw_force) > 0.7 * wanted

    # --- pieces ---------------------------------------------------------------------------------

    @property
    def far(self) -> float:
        """A jaw height well clear of any artery the scene can make, mm."""
        return 1e3 * float(self.model.scene.artery.layers[-1].inner_radius)

    def use(self, model: Model) -> None:
        """Compute with another scene of the same static choices."""
        self.model = model
        self.system.body = model.body

    def refer_to(self, physiological: Equilibrium) -> None:
        """Take the radii that stops and travels refer to, mm."""
        self.lumen_radius = float(physiological.state.x[self.model.marks.lumen_top, 1])
        self.outer_radius = float(physiological.state.x[self.model.marks.outer_top, 1])

    def step(self, closing: Held | LumenHeight | JawForce) -> Step:
        artery = self.model.scene.artery
        return Step(closing, float(artery.pressure), float(artery.axial_stretch))

    def held(self, height: float) -> Step:
        return self.step(Held(height))

    def lumen(self, height: float) -> Step:
        coordinate = 3 * self.model.marks.lumen_top + 1
        unknown = int(np.searchsorted(np.asarray(self.model.body.topology.free), coordinate))
        return self.step(LumenHeight(height, unknown, coordinate))

    def top(self, equilibrium: Equilibrium) -> float:
        """Half the lumen height, mm."""
        return float(equilibrium.state.x[self.model.marks.lumen_top, 1])

    def tell_closing(self, s: float, equilibrium: Equilibrium) -> None:
        """Keep a closing state and report it."""
        occlusion = 1.0 - self.top(equilibrium) / self.lumen_radius
        force = float(equilibrium.lin.jaw_force) * PARTS_OF_A_JAW * 1e-3
        note = ", snapped" if equilibrium.snapped else ""
        message = f"occlusion {occlusion:.1%}, jaw force {force:.3f} N{note}"
        self.keep("clamping", equilibrium, self.closed_fraction(equilibrium), message)

    def closed_fraction(self, equilibrium: Equilibrium) -> float:
        return min(max(self._share_of_stop(equilibrium), 0.0), 1.0)

    def _share_of_stop(self, equilibrium: Equilibrium) -> float:
        stop = self.model.scene.stop
        if isinstance(stop, OcclusionStop):
            return (1.0 - self.top(equilibrium) / self.lumen_radius) / float(stop.occlusion)
        if isinstance(stop, TravelStop):
            return (self.outer_radius - float(equilibrium.state.jaw_height)) / float(stop.travel)
        return float(equilibrium.lin.jaw_force) * PARTS_OF_A_JAW / float(stop.force)

    def walk(
        self,
        stage: str,
        start: Equilibrium,
        path: Path,
        tell: Callable[[float, Equilibrium], None],
        reached: Callable[[Equilibrium], bool],
        first_step: float | None = None,
    ) -> Equilibrium:
        """Follow a path; where Newton fails, take one step downhill at a held jaw and return."""
        options = {} if first_step is None else {"first_step": first_step}
        s, equilibrium, failure = follow(
            self.system, start, path, self.model.half_length, tell, reached, **options
        )
        if failure is None:
            return equilibrium
        if stage != "clamping":
            if self.inflated(start) is None:
                failure = NotConverged("the wall does not carry the pressure: it balloons")
            raise self.error(stage, equilibrium, failure)
        # from where the jaw was lowest: a path may come back up and would be walked for ever
        closed = [equilibrium, *(kept.equilibrium for kept in self.states if kept.stage == "clamping")]
        lowest = min(closed, key=lambda e: float(e.state.jaw_height))
        past = isinstance(self.model.scene.stop, OcclusionStop) and self._share_of_stop(lowest) > 1.0 + 1e-6
        move = RESCUE_MOVE * self.outer_radius
        while move > 1e-3 * RESCUE_MOVE * self.outer_radius:
            step = self.held(float(lowest.state.jaw_height) - move)
            try:
                found = self.settle(lowest.state, step)
            except Exhausted:  # what failed before is the cause
                break
            except NotConverged as error:
                failure, move = error, 0.5 * move
                continue
            tell(s, found)
            return found
        if past:
            failure = NotConverged("the lumen snaps shut past the stop, and no way back to it was found")
        raise self.error(stage, equilibrium, failure)

    def solve_or_descend(self, stage: str, start: State, step: Step, load: str) -> Equilibrium:
        """Newton, and if that fails the way downhill."""
        try:
            return self.settle(start, step)
        except NotConverged as error:
            raise EquilibriumError(stage, f"at {load}", error, _ADVICE[stage]) from error

    def settle(self, start: State, step: Step) -> Equilibrium:
        """A stable equilibrium at a held jaw: by Newton's method, or else downhill. Raises NotConverged."""
        with contextlib.suppress(NotConverged):
            found = newton(self.system, start, step)
            if not found.negative_pivots:
                return found
        return descend_eased(self.system, start, step, self.ease)

    @property
    def ease(self) -> Ease:
        """Penalties brought down to where they still do their work: well above the stiffness of the wall."""
        scene = self.model.scene
        materials = [layer.material for layer in scene.artery.layers]
        wall = sum(float(layer.thickness) for layer in scene.artery.layers)
        c = max(float(material.c) for material in materials)
        bulk = max(float(material.bulk) for material in materials)
        return Ease(
            bulk=min(1.0, EASY_BULK * c / bulk),
            contact=min(1.0, EASY_CONTACT * c / (float(scene.contact.stiffness) * wall)),
        )

    def error(self, stage: str, last: Equilibrium, failure: NotConverged) -> EquilibriumError:
        """The sentence for a user, with the last load that did converge."""
        if stage == "clamping" and float(last.state.jaw_height) == self.far:
            return EquilibriumError(stage, "at first contact", failure, _ADVICE[stage])
        if stage == "clamping":
            occlusion = 1.0 - self.top(last) / self.lumen_radius
            load = f"occlusion {occlusion:.1%}, jaw height {float(last.state.jaw_height):.4f} mm"
        else:
            load = f"pressure {last.pressure:.4g} kPa, axial stretch {last.axial_stretch:.4g}"
        return EquilibriumError(stage, f"beyond {load}", failure, _ADVICE[stage])


_ADVICE = {
    "load-free": "check radii, thicknesses and opening angles of the layers",
    "physiological": "check pressure and axial stretch against the stiffness of the wall, or refine the mesh",
    "clamping": "stop earlier, round the jaw's edges, or refine the mesh under them",
}


def _to_floats(report: Report, layer_names: tuple[str, ...]) -> Report:
    """Host floats (lists for vectors), those of the layers from inside to outside."""
    floats: Report = jax.tree_util.tree_map(lambda leaf: np.asarray(leaf).tolist(), jax.device_get(report))
    in_order = lambda v: {name: v[name] for name in layer_names} if isinstance(v, dict) else v  # noqa: E731
    return {key: in_order(value) for key, value in floats.items()}


def clamp(
    scene: Scene,
    *,
    guess: Result | None = None,
    progress: bool | Callable[[Progress], None] | None = None,
) -> Result:
    """Clamp the artery of a scene to its stop; every converged state.

    guess: the result of a neighbouring scene to start from: the same layers, laws and kind of jaw, any mesh
    progress: True for lines on standard error, or a function of `Progress`

    Raises EquilibriumError if the stop is not reached; its `result` keeps what did converge.
    Raises SceneError for a number that is not finite, or not positive where it has to be.
    """
    return _clamp(scene, guess, progress, to_stop=True)


def inflate(scene: Scene, *, guess: Result | None = None) -> Result:
    """The artery of a scene in the body: load-free and physiological states, no clamp.

    Raises EquilibriumError, and SceneError as `clamp` does.
    """
    return _clamp(scene, guess, None, to_stop=False)


def _clamp(
    scene: Scene,
    guess: Result | None,
    progress: bool | Callable[[Progress], None] | None,
    to_stop: bool,
) -> Result:
    start = time.perf_counter()
    require_computable(scene)
    model = build_model(scene, None if guess is None else guess.model)
    warm = None if guess is None else _on_mesh_of(model, guess)
    carried_over = warm is not None and warm is not guess
    keep_solver = warm is not None and not carried_over and warm.scene.solver == scene.solver
    walk = _Walk(model, teller(progress), start, warm.linear_solvers if warm and keep_solver else None)
    try:
        if warm is not None and _warm(walk, warm, to_stop, carried_over):
            return _result(walk, None)
        walk.states.clear()
        walk.system.be_patient()  # a guess that leads nowhere costs time, nothing else
        physiological = walk.physiological(walk.load_free(None), None)
        if to_stop:
            walk.close(physiological)
    except EquilibriumError as error:
        error.result = _result(walk, error)
        raise
    return _result(walk, None)


def _on_mesh_of(model: Model, guess: Result) -> Result | None:
    """The guess, its states carried over if it has another mesh; None if it is no neighbour."""
    scene = dataclasses.replace(guess.scene, mesh=model.scene.mesh)
    if not guess.converged or not same_kind(model.scene, scene):
        return None
    if _equal(model.scene.mesh, guess.scene.mesh):
        return guess
    like = build_model(scene, model)

    def carried_over(kept: Kept) -> Kept:
        state = transferred(kept.state, guess.model, like)
        return dataclasses.replace(kept, equilibrium=dataclasses.replace(kept.equilibrium, state=state))

    # load-free, physiological, and the last one if that is another
    ends = [*guess.states[:2], *guess.states[2:][-1:]]
    return dataclasses.replace(guess, model=like, states=tuple(map(carried_over, ends)))


def _warm(walk: _Walk, guess: Result, to_stop: bool, carried_over: bool) -> bool:
    """Solve from a neighbour's states, over scenes in between if the way is long.

    carried_over: the states are of another mesh and no equilibria of this one

    False if that does not work and a cold start is needed.
    """
    target, first, last = walk.model, guess.physiological, guess.states[-1]
    assert guess.load_free is not None
    assert first is not None
    if not carried_over and _same_artery(target.scene, guess.scene):
        walk.states[:] = [guess.load_free, first]
        walk.refer_to(first.equilibrium)
        walk.system.length = walk.lumen_radius
    else:
        try:
            load_free = walk.load_free(guess.load_free.state)
            walk.refer_to(walk.physiological(load_free, first.state))
        except EquilibriumError:
            return False
    if not to_stop:
        return True
    if last.stage != "clamping":
        walk.close(walk.states[-1].equilibrium)
        return True
    found = _warm_stop(walk, guess, last.equilibrium, carried_over)
    try:
        if found is not None:
            walk.keep("clamping", found, 1.0, "from a neighbouring solution")
    except EquilibriumError:
        return False
    return found is not None


def _same_artery(a: Scene, b: Scene) -> bool:
    """True if the states without the clamp are the same, to no less accuracy than b's."""
    equal = _equal(a.artery, b.artery) and _equal(a.mesh, b.mesh)
    return equal and b.solver.tolerance <= a.solver.tolerance


def _equal(a: Any, b: Any) -> bool:
    """True if two records have the same static choices and the same floats."""
    floats = zip(*map(jax.tree_util.tree_leaves, (a, b)), strict=True)
    return bool(shape_of(a, np.shape) == shape_of(b, np.shape)) and all(
        np.array_equal(u, v) for u, v in floats
    )


def _warm_stop(walk: _Walk, guess: Result, last: Equilibrium, carried_over: bool) -> Equilibrium | None:
    """The state at the stop, followed from a neighbour's with as few scenes in between as it takes.

    A state carried over from another mesh that is too far off is first settled under its own jaw.
    """
    target, base = walk.model, walk.states[-1].equilibrium
    radii = walk.lumen_radius, walk.outer_radius
    old = guess.physiological
    assert old is not None
    old_radii = [float(old.state.x[n, 1]) for n in (target.marks.lumen_top, target.marks.outer_top)]
    reached, step = 0.0, 1.0
    while reached < 1.0:
        t = min(1.0, reached + step)
        walk.use(target if t == 1.0 else build_model(between(guess.scene, target.scene, t), target))
        walk.lumen_radius, walk.outer_radius = (
            u + t * (v - u) for u, v in zip(old_radii, radii, strict=True)
        )
        closing = _closing_at_stop(walk, last)
        scene = walk.model.scene
        half_length = walk.model.half_length * float(scene.artery.axial_stretch)
        near = dataclasses.replace(last, state=stretched(last.state, half_length))
        try:
            start = predict(walk.system, near, walk.step(closing))
            last = newton(walk.system, start, walk.step(closing))
            reached = t
        except NotConverged:
            if carried_over:
                walk.use(build_model(guess.scene, target))
                try:
                    last = walk.settle(last.state, walk.held(float(last.state.jaw_height)))
                except NotConverged:
                    break
                carried_over = False
                continue
            step = 0.5 * step
            if step < SMALLEST_SHARE:
                break
    walk.use(target)
    walk.refer_to(base)
    less_stable = (last.negative_pivots or 0) > (guess.states[-1].equilibrium.negative_pivots or 0)
    return last if reached == 1.0 and not less_stable else None


def predicted(result: Result, scene: Scene) -> Result:
    """What a neighbouring scene would give, to first order: a linear solve per state, no iteration.

    The scene has the same mesh and loads. The states are predictions, not equilibria.
    """
    assert result.physiological is not None
    walk = _Walk(
        build_model(scene, result.model), lambda event: None, time.perf_counter(), result.linear_solvers
    )
    base, last = result.physiological.equilibrium, result.states[-1]
    walk.refer_to(base)
    walk.system.length = walk.lumen_radius
    values = np.asarray(base.lin.values)
    in_body = dataclasses.replace(walk.system, solver=result.linear_solvers.holding(values))
    near = predict(in_body, base, walk.held(float(base.state.jaw_height)))
    walk.keep("physiological", dataclasses.replace(base, state=near), 1.0, "")
    if last.stage == "clamping":
        walk.refer_to(walk.states[0].equilibrium)
        if not walk.system.solver.holds(np.asarray(last.equilibrium.lin.values)):
            walk.system.solver.factor(np.asarray(last.equilibrium.lin.values))
        step = walk.step(_closing_at_stop(walk, last.equilibrium))
        near = predict(walk.system, last.equilibrium, step)
        walk.keep("clamping", dataclasses.replace(last.equilibrium, state=near), 1.0, "")
    return dataclasses.replace(result, model=walk.model, states=tuple(walk.states))


def between(a: Scene, b: Scene, t: float) -> Scene:
    """The scene b with floats at the share t of the way from a to b."""
    alike = dataclasses.replace(a, title=b.title, solver=b.solver)
    return jax.tree_util.tree_map(lambda u, v: u + t * (v - u), alike, b)


def _closing_at_stop(walk: _Walk, near: Equilibrium) -> Held | LumenHeight | JawForce:
    """The condition that the stop puts on the final state."""
    stop = walk.model.scene.stop
    if isinstance(stop, OcclusionStop):
        return walk.lumen((1.0 - float(stop.occlusion)) * walk.lumen_radius).closing
    if isinstance(stop, TravelStop):
        return Held(walk.outer_radius - float(stop.travel))
    return JawForce(float(stop.force) / PARTS_OF_A_JAW, abs(near.force_slope) or 1.0)


def _peak_memory_MB() -> float | None:
    """Largest memory of this process so far, MB; None where the system does not tell."""
    try:
        # Linux: getrusage would count what the process that started this one held
        with open("/proc/self/status") as file:
            return float(file.read().split("VmHWM:")[1].split()[0]) / 1024.0
    except (OSError, IndexError):
        pass
    try:
        import resource
    except ImportError:  # Windows
        return None
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def _result(walk: _Walk, failure: EquilibriumError | None) -> Result:
    system, states = walk.system, tuple(walk.states)
    last = states[-1].values if states else {}
    solver = {
        "linear_solver": system.solver.name,
        "load_steps": system.load_steps,
        "newton_iterations": system.newton_iterations,
        "factorisations": system.solver.factorisations,
        "residual_mN": last.get("residual_mN"),
        "force_balance_error": last.get("force_balance_error"),
        "work_balance_error": work_balance([kept for kept in states if kept.stage == "clamping"]),
        "snapped": any(kept.equilibrium.snapped for kept in states),
        "negative_pivots": states[-1].equilibrium.negative_pivots if states else None,
    }
    cost = {
        "wall_s": time.perf_counter() - walk.start,
        "compile_s": system.compile_seconds,
        "assembly_s": system.assembly_seconds - system.compile_seconds,
        "factor_s": system.solver.factor_seconds,
        "peak_memory_MB": _peak_memory_MB(),
    }
    return Result(walk.model, states, failure, solver, cost, walk.solvers)
