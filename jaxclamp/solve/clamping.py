"""The doors: `clamp` an artery to its stop, or `inflate` it in the body."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable

import numpy as np

from jaxclamp.core.failures import EquilibriumError, NotConverged, TermMissing
from jaxclamp.core.progress import Progress, Tell, teller
from jaxclamp.potential.model import Model, build_model
from jaxclamp.scenes.files import require_computable
from jaxclamp.scenes.scene import Scene
from jaxclamp.solve.branch import CLOSING_PATH, branch_of
from jaxclamp.solve.easing import keep_hardened, with_softer_contact
from jaxclamp.solve.gaps import require_a_gap
from jaxclamp.solve.linear_solvers import Factors
from jaxclamp.solve.memory import coarser_unknowns, require_memory, unknowns_of
from jaxclamp.solve.nested import NEAR, to_walk_on
from jaxclamp.solve.results import Kept, Result, work_balance
from jaxclamp.solve.stages import Clamping
from jaxclamp.solve.warm import branch_from, on_mesh_of, solve_warm

BEYOND = 1e-6
"""share of the way to a stop by which the stop before it may be beyond"""


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
    Raises SceneError for what a scene file with the same values would be refused for, TooLittleMemory for a
    mesh that does not fit into memory, Unfit for a process that cannot compute: with JAX's 64-bit floats
    switched off, or forked from one that had used JAX (start processes by spawn).
    """
    return _solve(scene, guess, teller(progress), to_stop=True)


def inflate(scene: Scene, *, guess: Result | None = None) -> Result:
    """The artery of a scene in the body: load-free and physiological states, no clamp.

    Raises EquilibriumError, and what `clamp` raises.
    """
    return _solve(scene, guess, teller(None), to_stop=False)


def _solve(scene: Scene, guess: Result | None, tell: Tell, to_stop: bool) -> Result:
    start = time.perf_counter()
    require_computable(scene)
    if (unknowns := unknowns_of(scene)) > (0 if guess is None else guess.model.pattern.n):
        # a guess of as many is proof that they fit
        require_memory(unknowns, coarser_unknowns(scene) if to_stop and guess is None else 0)
    if to_stop:
        require_a_gap(scene)
    model = build_model(scene, None if guess is None else guess.model)
    if guess is None and to_stop and (first := scene.stop.after()) is not None:
        return _pressed_on(model, dataclasses.replace(scene, stop=first), tell, start)
    result, attempt, every_term = _from_elsewhere(model, guess, tell, to_stop, start)
    if result is not None:
        return result
    attempt = Clamping(model, tell, every_term=every_term, before=attempt)
    try:
        return _from_nothing(attempt, to_stop, start)
    except TermMissing:
        return _from_nothing(Clamping(model, tell, every_term=True, before=attempt), to_stop, start)


def _from_elsewhere(
    model: Model, guess: Result | None, tell: Tell, to_stop: bool, start: float
) -> tuple[Result | None, Clamping | None, bool]:
    """The result from a neighbour's, a coarser mesh's or softer contact's; None where none leads there.

    With it what was tried, and whether terms are needed that the stop seems not to need.
    """
    if guess is not None:
        return *_from_neighbour(model, guess, tell, to_stop, start), guess.every_term
    if to_stop and (coarser := to_walk_on(model.scene)) is not None:
        return *_from_coarser_mesh(model, coarser, tell, start), False
    if to_stop and (softer := with_softer_contact(model.scene)) is not None:
        return _from_softer_contact(model, softer, tell, start), None, False
    return None, None, False


def _from_neighbour(
    model: Model, guess: Result, tell: Tell, to_stop: bool, start: float
) -> tuple[Result | None, Clamping | None]:
    """The result from a neighbour's states; None where that leads nowhere, with what was tried."""
    warm = on_mesh_of(model, guess)
    if warm is None:
        return None, None
    carried_over = warm is not guess
    keep = not carried_over and warm.scene.solver == model.scene.solver
    # the guess gives its solver away: it keeps the analysis of the pattern, and the last factors
    solver = warm.factors.take(np.asarray(warm.states[-1].equilibrium.lin.values)) if keep else None
    clamping = Clamping(model, tell, solver, every_term=guess.every_term)
    try:
        if solve_warm(clamping, warm, to_stop, carried_over):
            last, closed = clamping.states[-1], guess.states[-1].stage == "clamping"
            followed = branch_from(guess, model.scene, last.equilibrium) if to_stop and closed else None
            return _result(clamping, None, start, followed), clamping
    except TermMissing:
        pass
    except EquilibriumError as error:
        error.result = _result(clamping, error, start)
        raise
    return None, clamping


def _from_coarser_mesh(
    model: Model, coarser: Scene, tell: Tell, start: float
) -> tuple[Result | None, Clamping | None]:
    """The result with its closing path walked on a coarser mesh; None where that leads to nothing sure.

    It is sure if closing jaws lead to the coarser mesh's answer without a snap, and the finer mesh's one is
    stable and near to it.
    """
    words, walked = coarser.mesh.words, "closing path"
    tell_of_path = lambda event: (  # noqa: E731
        tell(Progress(walked, event.fraction, f"{event.message}, on {words} elements"))
        if event.stage == "clamping"
        else tell(event)
        if event.stage == walked
        else None
    )
    try:
        path = _solve(coarser, None, tell_of_path, to_stop=True)
    except EquilibriumError:
        return None, None
    near = on_mesh_of(model, path) if path.solver["branch"] == CLOSING_PATH else None
    if near is None:
        return None, None
    clamping = Clamping(model, tell, every_term=path.every_term)
    try:
        found = solve_warm(clamping, near, to_stop=True, carried_over=True)
    except (EquilibriumError, TermMissing):
        found = False
    if not found:
        return None, clamping
    if not _sure(clamping.states[-1], near.states[-1]):
        return None, clamping
    clamping.states[-1:] = [*path.on_the_way, clamping.states[-1]]
    result = _result(clamping, None, start, CLOSING_PATH, path)
    return dataclasses.replace(result, coarser=path), clamping


def _sure(last: Kept, near: Kept) -> bool:
    """True if a state at the stop is stable, and near to the one that it was found from."""
    apart = float(np.max(np.abs(np.asarray(last.state.x) - np.asarray(near.state.x))))
    return not last.equilibrium.negative_pivots and apart <= NEAR * float(last.values["lumen_width_mm"])


def _from_softer_contact(model: Model, softer: Scene, tell: Tell, start: float) -> Result | None:
    """The result with its closing path walked with softer contact; None where that leads to nothing sure."""
    try:
        path = _solve(softer, None, tell, to_stop=True)
    except EquilibriumError:
        return None
    if path.solver["branch"] != CLOSING_PATH:
        return None
    solver = path.factors.take(np.asarray(path.states[-1].equilibrium.lin.values))
    clamping = Clamping(model, tell, solver, every_term=path.every_term)
    try:
        found = solve_warm(clamping, path, to_stop=True, carried_over=False)
        if not found or not _sure(clamping.states[-1], path.states[-1]):
            return None
        keep_hardened(clamping, path)
    except (EquilibriumError, TermMissing):
        return None
    return _result(clamping, None, start, CLOSING_PATH, path)


def _pressed_on(model: Model, before: Scene, tell: Tell, start: float) -> Result:
    """The result from that of a stop which is to be reached first, with the jaws moved on from there."""
    path = _solve(before, None, tell, to_stop=True)
    last = path.states[-1].equilibrium
    clamping = Clamping(model, tell, path.factors.take(np.asarray(last.lin.values)), path.every_term)
    assert path.load_free is not None
    assert path.physiological is not None
    clamping.take_over(path.load_free, path.physiological)
    clamping.states += [
        dataclasses.replace(kept, model=model) if kept.model is path.model else kept
        for kept in path.states[2:]
    ]
    clamping.use_terms(closing=True)
    walked = str(path.solver["branch"])
    failure = None
    try:
        if clamping.share(last.state) > 1.0 + BEYOND:
            stop, there = model.scene.stop, clamping.measure(last.state)
            reason = (
                f"'{before.stop.kind}' takes {stop.said(there)} already, more than {stop.said(stop.target())}"
            )
            raise clamping.error("clamping", last, NotConverged(reason))
        clamping.go_on(last)
    except EquilibriumError as error:
        failure = error
    pressed = [kept.equilibrium for kept in clamping.states[len(path.states) - 1 :]]
    branch = walked if walked != CLOSING_PATH else branch_of(pressed)
    result = dataclasses.replace(_result(clamping, failure, start, branch, path), coarser=path.coarser)
    if failure is not None:
        failure.result = result
        raise failure
    return result


def _from_nothing(clamping: Clamping, to_stop: bool, start: float) -> Result:
    """The result of the whole path."""
    try:
        in_body = clamping.in_body(clamping.load_free())
        if to_stop:
            clamping.close(in_body)
    except EquilibriumError as error:
        error.result = _result(clamping, error, start)
        raise
    return _result(clamping, None, start)


def peak_memory_MB() -> float | None:
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


def _result(
    clamping: Clamping,
    failure: EquilibriumError | None,
    start: float,
    branch: str | None = None,
    path: Result | None = None,
) -> Result:
    """What a clamping came to.

    branch: of an answer that was followed from a neighbour's; path: of a coarser mesh or softer contact, with
    the closing path that led here
    """
    system, states = clamping.system, tuple(clamping.states)
    closing = [kept for kept in states if kept.stage == "clamping"]
    branch = branch or (branch_of([kept.equilibrium for kept in closing]) if closing else None)
    last = states[-1].values if states else {}
    counts = {
        "load_steps": system.load_steps,
        "newton_iterations": system.newton_iterations,
        "factorisations": system.solver.factorisations,
    }
    seconds = {
        "compile_s": system.compile_seconds,
        "assembly_s": system.assembly_seconds - system.compile_seconds,
        "factor_s": system.solver.factor_seconds,
    }
    balance = work_balance(closing) if path is None else path.solver["work_balance_error"]
    if path is not None:
        counts = {key: count + path.solver[key] for key, count in counts.items()}
        seconds = {key: part + path.cost[key] for key, part in seconds.items()}
    solver = {
        "linear_solver": system.solver.name,
        **counts,
        "residual_mN": last.get("residual_mN"),
        "force_balance_error": last.get("force_balance_error"),
        "work_balance_error": balance,
        "snapped": any(kept.equilibrium.snapped for kept in states),
        "negative_pivots": states[-1].equilibrium.negative_pivots if states else None,
        "branch": branch,
    }
    cost = {"wall_s": time.perf_counter() - start, **seconds, "peak_memory_MB": peak_memory_MB()}
    settings = clamping.model.scene.solver
    factors = Factors(clamping.model.pattern, settings.linear_solver, system.solver)
    return Result(clamping.model, states, failure, solver, cost, factors, clamping.every_term)
