"""Walking a load path: Newton's method at growing parameters, with steps that adapt."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import numpy as np

from jaxclamp.core.failures import NotConverged
from jaxclamp.potential.energy import State
from jaxclamp.solve.newton import Equilibrium, Path, Step, System, newton

EASY_ITERATIONS = 5
"""a step that converged in so many iterations lets the next one grow"""
FIRST_STEP, SMALLEST_STEP, LARGEST_STEP = 0.12, 0.12 / 32, 0.15


def stretched(state: State, end_height: float) -> State:
    """The state with all axial positions scaled so that the end plane is at `end_height`, mm."""
    x = np.array(state.x)
    top = float(np.max(x[:, 2]))
    if abs(top - end_height) <= 1e-14 * end_height:
        return state
    x[:, 2] *= end_height / top
    return dataclasses.replace(state, x=jax.device_put(x))


def follow(
    system: System,
    start: Equilibrium,
    path: Path,
    end_height: Callable[[float], float],
    on_step: Callable[[float, Equilibrium], None],
    reached: Callable[[Equilibrium], bool] = lambda equilibrium: False,
    first_step: float = FIRST_STEP,
    accept: Callable[[Step, Equilibrium, Equilibrium], None] = lambda step, before, found: None,
) -> tuple[float, Equilibrium, NotConverged | None]:
    """Walk a path from its parameter 0 towards 1, as far as Newton goes.

    Returns the parameter reached, its equilibrium, and None or the last failure.
    end_height: of the artery's ends at a stretch, mm; on_step is called at every converged state, and
    `reached` may end the walk there; `accept` may refuse what was found from the equilibrium before.
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
        guess = stretched(equilibrium.state, end_height(wanted.axial_stretch))
        try:
            found = newton(system, guess, wanted, equilibrium)
            accept(wanted, equilibrium, found)
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
