"""Roots of scalar equations, many at once, differentiable to first order."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array, lax

MOST_STEPS = 100
"""a bracket that is halved so often is narrower than rounding"""
TOLERANCE = 1e-13
"""of the root, relative to the bracket it was looked for in"""


def root(f: Callable[[Array], Array], low: Array, high: Array) -> Array:
    """x with f(x) = 0 between `low` and `high`, all of one shape (n,); f acts item by item and has f(low) <
    0.

    Newton's method inside a bracket that shrinks; a step that leaves it, or gains too little, halves it
    (Press et al., Numerical Recipes, `rtsafe`). Where f does not change sign the end of the bracket with the
    smaller |f| is nearly returned, without a root. Behind it stands the step of Newton's method at the root,
    of which only the first derivatives, by whatever f knows, are kept: those of the implicit function
    theorem.
    """
    pure, known = jax.closure_convert(
        f, low
    )  # what f knows is held fixed, or the search would be differentiated
    held = [lax.stop_gradient(value) for value in known]
    found = _bracketed(lambda x: pure(x, *held), lax.stop_gradient(low), lax.stop_gradient(high))
    value, slope = jax.jvp(f, (found,), (jnp.ones_like(found),))
    slope = lax.stop_gradient(slope)
    known = jnp.isfinite(value) & jnp.isfinite(slope) & (slope != 0.0)
    step = jnp.where(known, value, 0.0) / jnp.where(known, slope, 1.0)
    return found - (step - lax.stop_gradient(step))


_Search = tuple[Array, Array, Array, Array, Array, Array]
"""steps taken, x, the bracket's ends, the last step and the one before"""


def _bracketed(f: Callable[[Array], Array], low: Array, high: Array) -> Array:
    width = high - low
    value_and_slope = lambda x: jax.jvp(f, (x,), (jnp.ones_like(x),))  # noqa: E731

    def going(state: _Search) -> Array:
        count, _, low, high, last, _ = state
        return (count < MOST_STEPS) & jnp.any((jnp.abs(last) > TOLERANCE * width) & (high > low))

    def step(state: _Search) -> _Search:
        count, x, low, high, last, before = state
        value, slope = value_and_slope(x)
        below = value < 0.0
        low, high = jnp.where(below, x, low), jnp.where(below, high, x)
        newton = value / jnp.where(slope == 0.0, 1.0, slope)
        inside = (x - newton >= low) & (x - newton <= high) & jnp.isfinite(newton) & (slope != 0.0)
        fast = jnp.abs(newton) <= 0.5 * jnp.abs(before)
        target = jnp.where(inside & fast, x - newton, 0.5 * (low + high))
        target = jnp.where(value == 0.0, x, target)
        return count + 1, target, low, high, target - x, last

    start = 0.5 * (low + high)
    state = (jnp.asarray(0), start, low, high, width, width)
    return lax.while_loop(going, step, state)[1]
