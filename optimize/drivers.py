"""Optimisers of well-known libraries behind one small interface.

A driver is a function of a `Target` (objective and constraints over the unit box, scaled) that
asks it for values and gradients until it is content, and returns why it stopped. It sees neither
scene nor engine. Whoever counts evaluations ends it with `Enough`.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import scipy.optimize


class Enough(Exception):
    """The budget is spent; the driver has to end."""


@dataclasses.dataclass(frozen=True)
class Target:
    """What a driver sees: a function over the unit box."""

    start: np.ndarray
    """(n,), each from 0 to 1"""
    objective: Callable[[np.ndarray], tuple[float, np.ndarray]]
    """value and gradient, (n,)"""
    margins: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    """what has to be at least 0, (n_margins,), and its derivatives, (n_margins, n)"""
    n_margins: int
    """0: no constraints"""
    tolerance: float
    """change of the objective that no longer matters"""


Driver = Callable[[Target], str]
"""works on a target until it is content; returns why it stopped"""


def slsqp(target: Target) -> str:
    """Sequential quadratic programming (SciPy's SLSQP): bounds and constraints."""
    constraints: Any = ()
    if target.n_margins:
        constraints = {
            "type": "ineq",
            "fun": lambda t: target.margins(t)[0],
            "jac": lambda t: target.margins(t)[1],
        }
    found = scipy.optimize.minimize(
        target.objective,
        target.start,
        jac=True,
        method="SLSQP",
        bounds=[(0.0, 1.0)] * target.start.size,
        constraints=constraints,
        options={"ftol": target.tolerance, "maxiter": 1000},
    )
    return f"SLSQP: {found.message}"


def l_bfgs_b(target: Target) -> str:
    """Bounded quasi-Newton (L-BFGS-B, SciPy's through jaxopt): bounds only."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*jaxopt.*", category=DeprecationWarning)
        import jaxopt

    solver = jaxopt.ScipyBoundedMinimize(
        fun=target.objective,
        value_and_grad=True,
        method="L-BFGS-B",
        jit=False,
        tol=target.tolerance,
        options={"ftol": target.tolerance, "gtol": 1e-6},
    )
    box = np.zeros(target.start.size), np.ones(target.start.size)
    _, state = solver.run(target.start, bounds=box)
    return f"L-BFGS-B: {'converged' if state.success else 'no further descent'}"


def mma(target: Target) -> str:
    """Method of moving asymptotes (nlopt's LD_MMA, conservative): bounds and constraints."""
    import nlopt

    def objective(t: np.ndarray, gradient: np.ndarray) -> float:
        value, slope = target.objective(t.copy())
        if gradient.size:
            gradient[:] = slope
        return float(value)

    def excess(result: np.ndarray, t: np.ndarray, gradient: np.ndarray) -> None:
        margins, slopes = target.margins(t.copy())
        result[:] = -margins
        if gradient.size:
            gradient[:] = -slopes

    optimiser = nlopt.opt(nlopt.LD_MMA, target.start.size)
    optimiser.set_min_objective(objective)
    if target.n_margins:
        optimiser.add_inequality_mconstraint(excess, np.full(target.n_margins, 1e-6))
    optimiser.set_lower_bounds(np.zeros(target.start.size))
    optimiser.set_upper_bounds(np.ones(target.start.size))
    optimiser.set_ftol_abs(target.tolerance)
    optimiser.set_xtol_rel(1e-5)
    optimiser.optimize(target.start)
    return f"MMA: {nlopt_reasons(nlopt)[optimiser.last_optimize_result()]}"


def nlopt_reasons(nlopt: Any) -> dict[int, str]:
    """Why nlopt stops, in words."""
    return {
        nlopt.SUCCESS: "converged",
        nlopt.FTOL_REACHED: "the objective no longer changes",
        nlopt.XTOL_REACHED: "the design no longer changes",
    }


ADAM_STEP, ADAM_STEPS = 0.05, 200
"""share of each variable's range that the first step moves; most steps"""


def adam(target: Target) -> str:
    """Adam of optax, projected on the bounds, its steps shrinking over time: bounds only."""
    import optax

    schedule = optax.cosine_decay_schedule(ADAM_STEP, ADAM_STEPS)
    rule = optax.chain(optax.scale_by_adam(b1=0.7), optax.scale_by_learning_rate(schedule))
    t, state = target.start.copy(), rule.init(target.start)
    last = np.inf
    for _ in range(ADAM_STEPS):
        value, slope = target.objective(t)
        with jax.numpy_dtype_promotion("standard"):  # optax counts its steps in integers
            step, state = rule.update(slope, state)
        moved = np.clip(t + np.asarray(step), 0.0, 1.0)
        still = float(np.max(np.abs(moved - t))) < 1e-4
        if still and abs(last - value) <= target.tolerance:
            return "Adam: the design no longer changes"
        t, last = moved, value
    return f"Adam: {ADAM_STEPS} steps"


@dataclasses.dataclass(frozen=True)
class Method:
    """A driver, and whether it takes constraints."""

    drive: Driver
    """works on a target, and says why it stopped"""
    constrained: bool
    """True if it takes constraints"""


METHODS: dict[str, Method] = {
    "slsqp": Method(slsqp, constrained=True),
    "l-bfgs-b": Method(l_bfgs_b, constrained=False),
    "mma": Method(mma, constrained=True),
    "adam": Method(adam, constrained=False),
}
"""what a study may name as its method"""


MOST_STEPS_OF_A_FIT, LARGEST_RESIDUAL = 200, 1e8
"""residuals that one least squares asks for; residuals, over their standard deviations, are cut there"""


def levenberg_marquardt(
    values: Callable[[np.ndarray], Any], slopes: Callable[[np.ndarray], Any], start: np.ndarray
) -> tuple[np.ndarray, float]:
    """Least squares by Levenberg's and Marquardt's method (SciPy's MINPACK): x, and the sum of squares there.

    values, slopes: residuals (m,) at x (n,), and their derivatives (m, n); where they are not finite large
    ones and 0 stand for them, so that steps go back. jaxopt's method was measured and left: on the host its
    own arithmetic took 16 ms a step, several times the residuals'; in one program it compiled them and their
    derivatives several times over, and it multiplies rejected states by 0 instead of choosing, so that one
    infinite residual spoils all.
    """

    def finite(x: np.ndarray) -> np.ndarray:
        found = np.nan_to_num(np.asarray(values(x)), nan=LARGEST_RESIDUAL)
        return np.clip(found, -LARGEST_RESIDUAL, LARGEST_RESIDUAL)

    def finite_slopes(x: np.ndarray) -> np.ndarray:
        found = np.nan_to_num(np.asarray(slopes(x)), nan=0.0, posinf=0.0, neginf=0.0)
        return np.clip(found, -(LARGEST_RESIDUAL**2), LARGEST_RESIDUAL**2)

    found = scipy.optimize.least_squares(
        finite,
        start,
        jac=finite_slopes,
        method="lm",
        x_scale=1.0,
        ftol=1e-9,
        xtol=1e-7,
        gtol=1e-10,
        max_nfev=MOST_STEPS_OF_A_FIT,
    )
    return found.x, 2.0 * float(found.cost)
