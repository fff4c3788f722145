"""Starting from a neighbour: another scene's states, on this mesh or another, followed to this scene."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np

from jaxclamp.core.failures import EquilibriumError, NotConverged
from jaxclamp.core.records import shape_of
from jaxclamp.fem.symmetry import symmetry_of
from jaxclamp.potential.energy import State
from jaxclamp.potential.model import Model, build_model, same_kind
from jaxclamp.scenes.scene import Scene
from jaxclamp.solve.branch import ANOTHER, CLOSING_PATH, FOLLOWED, require_same_path
from jaxclamp.solve.descent import descend_eased, ease_of
from jaxclamp.solve.follow import stretched
from jaxclamp.solve.newton import Equilibrium, Step, newton, predict
from jaxclamp.solve.results import Kept, Result
from jaxclamp.solve.stages import Clamping
from jaxclamp.solve.stops import Held
from jaxclamp.solve.transfer import transferred

SMALLEST_SHARE = 1 / 16
"""a neighbour's solution is followed in steps of at least this share of the way, or given up"""


def on_mesh_of(model: Model, guess: Result) -> Result | None:
    """The guess, its states carried over if it has another mesh; None if it is no neighbour."""
    scene = dataclasses.replace(guess.scene, mesh=model.scene.mesh)
    kinds = [symmetry_of(s.mesh, s.clamp) for s in (guess.scene, model.scene)]
    if not guess.converged or not same_kind(model.scene, scene) or kinds[0] != kinds[1]:
        return None
    if equal(model.scene.mesh, guess.scene.mesh):
        return guess
    like = build_model(scene, model)

    def carried_over(kept: Kept) -> Kept:
        state = transferred(kept.state, kept.model, like)
        moved = dataclasses.replace(kept.equilibrium, state=state)
        return dataclasses.replace(kept, equilibrium=moved, model=like)

    # load-free, in the body, and the last one if that is another
    ends = [*guess.states[:2], *guess.states[2:][-1:]]
    return dataclasses.replace(guess, model=like, states=tuple(map(carried_over, ends)))


def solve_warm(clamping: Clamping, guess: Result, to_stop: bool, carried_over: bool) -> bool:
    """Solve from a neighbour's states, over scenes in between if the way is long.

    carried_over: the states are of another mesh and no equilibria of this one

    False if that does not work and a cold start is needed.
    """
    target, in_body, last = clamping.model, guess.physiological, guess.states[-1]
    assert guess.load_free is not None
    assert in_body is not None
    if not carried_over and same_artery(target.scene, guess.scene):
        clamping.take_over(guess.load_free, in_body)
    else:
        try:
            clamping.in_body(clamping.load_free(guess.load_free.state), in_body.state)
        except EquilibriumError:
            return False
    if not to_stop:
        return True
    if last.stage != "clamping":
        clamping.close(clamping.states[-1].equilibrium)
        return True
    found = _follow_to_stop(clamping, guess, last.equilibrium, carried_over)
    try:
        if found is not None:
            clamping.keep("clamping", found, 1.0, "from a neighbouring solution")
    except EquilibriumError:
        return False
    return found is not None


def same_artery(a: Scene, b: Scene) -> bool:
    """True if the states without the clamp are the same, to no less accuracy than b's."""
    same = equal(a.artery, b.artery) and equal(a.mesh, b.mesh)
    return same and b.solver.tolerance <= a.solver.tolerance


def same_but_for_the_stop(a: Scene, b: Scene) -> bool:
    """True if the same clamp closes the same artery, to the same or another stop."""
    return same_artery(a, b) and equal(a.clamp, b.clamp) and equal(a.contact, b.contact)


def branch_from(guess: Result, target: Scene, found: Equilibrium) -> str:
    """What an equilibrium followed from a neighbour's is; see `solve.branch`.

    Only with the same clamp on the same artery is it known to be on the same closing path.
    """
    before, last = str(guess.solver["branch"]), guess.states[-1].equilibrium
    if before.startswith(ANOTHER):
        return f"{ANOTHER}: followed from a neighbour that is one"
    if before == FOLLOWED or not same_but_for_the_stop(target, guess.scene) or found.negative_pivots:
        return FOLLOWED
    on = float(found.state.jaw_height) <= float(last.state.jaw_height)
    return before if on or before == CLOSING_PATH else FOLLOWED


def equal(a: Any, b: Any) -> bool:
    """True if two records have the same static choices and the same floats."""
    floats = zip(*map(jax.tree_util.tree_leaves, (a, b)), strict=True)
    return bool(shape_of(a, np.shape) == shape_of(b, np.shape)) and all(
        np.array_equal(u, v) for u, v in floats
    )


def _follow_to_stop(
    clamping: Clamping, guess: Result, last: Equilibrium, carried_over: bool
) -> Equilibrium | None:
    """The state at the stop, followed from a neighbour's with as few scenes in between as it takes.

    A state carried over from another mesh that is too far off first goes downhill under its own jaw.
    """
    target, body = clamping.model, clamping.body
    assert guess.physiological is not None
    before, reached, step = guess.physiological.state, 0.0, 1.0
    further = not carried_over and same_but_for_the_stop(target.scene, guess.scene)
    while reached < 1.0:
        t = min(1.0, reached + step)
        clamping.use(target if t == 1.0 else build_model(between(guess.scene, target.scene, t), target))
        clamping.refer_to(body if t == 1.0 else _part_way(before, body, t))
        stretch = float(clamping.model.scene.artery.axial_stretch)
        near = dataclasses.replace(last, state=stretched(last.state, clamping.model.end_height(stretch)))
        at_stop = clamping.at_stop(near.state)
        try:
            found = newton(clamping.system, predict(clamping.system, near, at_stop), at_stop)
            if further:
                require_same_path(at_stop, last, found)
            last, reached = found, t
        except NotConverged:
            if carried_over:
                clamping.use(build_model(guess.scene, target))
                try:
                    held = clamping.step(Held(float(last.state.jaw_height)))
                    last = descend_eased(clamping.system, last.state, held, ease_of(guess.scene))
                except NotConverged:
                    break
                carried_over = False
                continue
            step = 0.5 * step
            if step < SMALLEST_SHARE:
                break
    clamping.use(target)
    clamping.refer_to(body)
    less_stable = (last.negative_pivots or 0) > (guess.states[-1].equilibrium.negative_pivots or 0)
    return last if reached == 1.0 and not less_stable else None


def _part_way(a: State, b: State, t: float) -> State:
    """A state at the share t of the way from a to b."""
    return jax.tree_util.tree_map(lambda u, v: u + t * (v - u), a, b)


def between(a: Scene, b: Scene, t: float) -> Scene:
    """The scene b with floats at the share t of the way from a to b."""
    alike = dataclasses.replace(a, title=b.title, solver=b.solver)
    return jax.tree_util.tree_map(lambda u, v: u + t * (v - u), alike, b)


def predicted(result: Result, scene: Scene) -> Result:
    """What a neighbouring scene would give, to first order: a linear solve per state, no iteration.

    The scene has the same mesh and loads. The states are predictions, not equilibria.
    """
    assert result.physiological is not None
    base, last = result.physiological.equilibrium, result.states[-1]
    model = build_model(scene, result.model)
    clamping = Clamping(model, lambda event: None, every_term=result.every_term)
    clamping.use_terms(closing=False)
    clamping.refer_to(base.state)
    near = _predicted(clamping, result, base, clamping.step(Held(float(base.state.jaw_height))))
    clamping.keep("physiological", near, 1.0, "")
    if last.stage == "clamping":
        clamping.use_terms(closing=True)
        step = clamping.at_stop(last.equilibrium.state)
        clamping.keep("clamping", _predicted(clamping, result, last.equilibrium, step), 1.0, "")
    return dataclasses.replace(result, model=model, states=tuple(clamping.states))


def _predicted(clamping: Clamping, result: Result, near: Equilibrium, step: Step) -> Equilibrium:
    """The state of a step to first order, with the factors that the result has of a near one."""
    with result.factors.lease(np.asarray(near.lin.values)) as solver:
        state = predict(dataclasses.replace(clamping.system, solver=solver), near, step)
    return dataclasses.replace(near, state=state, lin=clamping.system.linearise(state, step.pressure))
