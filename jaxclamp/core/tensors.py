"""Small tensors with the batch axes last, smooth switches, and safe roots.

A tensor field is anything that gives the batch of a component by `A[i, j]`: an array of shape
(3, 3, *batch), or a dict of nine arrays. Pointwise laws are written in components and never slice
or reduce over the component axes: XLA then fuses them over the batch, which is ten times faster
on a CPU than the same law on stacked arrays, and much more so than `vmap` of tiny matrices.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence

import jax
import jax.numpy as jnp
from jax import Array, lax

Tensor = Array | Mapping[tuple[int, int], Array]
Vector = Array | Sequence[Array]

# exp() is followed exactly by its derivatives up to this exponent; e**680 = 1e295 leaves room for
# the factors of a second derivative below the largest float64 (1.8e308).
LARGEST_EXPONENT = 680.0


def components(A: Array) -> dict[tuple[int, int], Array]:
    """The components of A (n, m, *batch) as arrays of their own, each (*batch).

    Differentiated backwards, this joins nine arrays; indexing A would add up nine arrays that are
    zero in eight of nine places, each computed anew: ten times slower.
    """
    n, m = A.shape[:2]
    parts = lax.split(A.reshape(n * m, *A.shape[2:]), [1] * (n * m))
    return {(i, j): parts[m * i + j][0] for i in range(n) for j in range(m)}


def total(terms: Iterable[Array]) -> Array:
    """The sum of one or more arrays."""
    return functools.reduce(operator.add, terms)


def det(A: Tensor) -> Array:
    """Determinant of A."""
    return (
        A[0, 0] * (A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1])
        - A[0, 1] * (A[1, 0] * A[2, 2] - A[1, 2] * A[2, 0])
        + A[0, 2] * (A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0])
    )


def product(A: Tensor, B: Tensor) -> dict[tuple[int, int], Array]:
    """A B by components."""
    return {(i, j): total(A[i, k] * B[k, j] for k in range(3)) for i in range(3) for j in range(3)}


def transpose(A: Tensor) -> dict[tuple[int, int], Array]:
    """The transpose of A by components."""
    return {(i, j): A[j, i] for i in range(3) for j in range(3)}


def squared_norm(A: Tensor) -> Array:
    """A : A, the trace of A' A."""
    return total(A[i, j] * A[i, j] for i in range(3) for j in range(3))


def squared(a: Vector) -> Array:
    """a . a of a vector by components."""
    return total(component * component for component in a)


def stacked(A: Tensor) -> Array:
    """A as one array (3, 3, *batch)."""
    return jnp.stack([jnp.stack([A[i, j] for j in range(3)]) for i in range(3)])


def cross(a: Vector, b: Vector) -> tuple[Array, Array, Array]:
    """Vector product of a and b by components."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def inverse(A: Tensor) -> Array:
    """Inverse of A, (3, 3, *batch)."""
    rows = [tuple(A[i, j] for j in range(3)) for i in range(3)]
    cofactors = [cross(rows[1], rows[2]), cross(rows[2], rows[0]), cross(rows[0], rows[1])]
    return jnp.stack([jnp.stack([cofactors[j][i] for j in range(3)]) for i in range(3)]) / det(A)


def largest_eigenvalue(A: Tensor) -> Array:
    """Largest eigenvalue of a symmetric A, (*batch): m + 2 q cos(arccos(r) / 3).

    Smith, Commun ACM 4 (1961) 168.
    """
    m = (A[0, 0] + A[1, 1] + A[2, 2]) / 3.0
    B = {(i, j): A[i, j] - m if i == j else A[i, j] for i in range(3) for j in range(3)}
    q = safe_sqrt(squared_norm(B) / 6.0)
    scale = jnp.where(q > 0.0, q, 1.0)
    r = jnp.clip(det({key: value / scale for key, value in B.items()}) / 2.0, -1.0, 1.0)
    return m + 2.0 * q * jnp.cos(jnp.arccos(r) / 3.0)


def safe_sqrt(s: Array) -> Array:
    """sqrt(s), with value and derivative 0 where s = 0."""
    positive = s > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, s, 1.0)), 0.0)


def norm(a: Vector) -> Array:
    """Euclidean length of a (its components first), differentiable at 0 (derivative 0)."""
    return safe_sqrt(squared(a))


def ramp(u: Array, width: Array | float) -> Array:
    """max(u, 0), rounded over |u| < width to a polynomial with continuous second derivative."""
    v = jnp.clip(u, -width, width) + width
    return jnp.where(u < width, v**3 * (4.0 * width - v) / (16.0 * width**3), u)


def half_square(u: Array, width: Array | float) -> Array:
    """max(u, 0)**2 / 2 (+ width**2 / 6), its second derivative rising linearly over |u| < width.

    The convolution of max(u, 0)**2 / 2 with a box of half-width `width`: zero for u < -width,
    second derivative continuous everywhere.
    """
    v = jnp.clip(u, -width, width) + width
    return jnp.where(u < width, v**3 / (12.0 * width), u * u / 2.0 + width**2 / 6.0)


def exponential_stiffening(k2: Array, E: Array) -> Array:
    """(exp(k2 E**2) - 1) / (2 k2), for k2 >= 0; its limit E**2 / 2 at k2 = 0. See `exponential_growth`."""
    return exponential_growth(k2, E * E, k2 * E * E)


def exponential_growth(k2: Array, S: Array, q: Array) -> Array:
    """(exp(q) - 1) / (2 k2) with q = k2 S, for k2 >= 0 and S >= 0; its limit S / 2 at k2 = 0.

    Where the exponential leaves the range of float64 the value is +inf. Derivatives are exact for
    exponents up to `LARGEST_EXPONENT`; beyond, they are those of the straight continuation, so
    they stay finite and keep their sign: a trial state may be absurd, but never NaN.
    """
    small = q < 1e-2
    q_inside = jnp.where(small | (q > LARGEST_EXPONENT), 1.0, q)
    q_small = jnp.where(small, q, 0.0)
    # expm1(q) / q = 1 + q/2 + q**2/6 + ...: truncation below 2e-16 for q < 1e-2
    series = 1.0 + q_small / 2 * (
        1.0 + q_small / 3 * (1.0 + q_small / 4 * (1.0 + q_small / 5 * (1.0 + q_small / 6)))
    )
    inside = 0.5 * S * jnp.where(small, series, jnp.expm1(q_inside) / q_inside)
    k2_safe = jnp.where(small, 1.0, lax.stop_gradient(k2))
    slope = jnp.exp(LARGEST_EXPONENT) / (2.0 * k2_safe)
    beyond = lax.stop_gradient(jnp.expm1(q) / (2.0 * k2_safe)) + (q - lax.stop_gradient(q)) * slope
    return jnp.where(q <= LARGEST_EXPONENT, inside, beyond)


def smooth_maximum(values: Array, weights: Array, sharpness: float) -> Array:
    """The weighted power mean (sum w v**s / sum w)**(1/s) of the positive parts of `values`.

    It tends to the maximum from below as the sharpness s grows and, weighted by volume, does not
    depend on how finely the volume is cut. Zero where nothing is positive.

    values, weights: of the same shape, any; the maximum, a scalar, is in the unit of the values.
    """
    positive = jnp.maximum(values, 0.0)
    scale = lax.stop_gradient(jnp.max(positive))
    scale = jnp.where(scale > 0.0, scale, 1.0)
    mean = jnp.sum(weights * (positive / scale) ** sharpness) / jnp.sum(weights)
    return scale * jnp.where(mean > 0.0, jnp.where(mean > 0.0, mean, 1.0) ** (1.0 / sharpness), 0.0)


def pointwise_derivatives(f: Callable[[list[Array]], Array], y: list[Array]) -> tuple[Array, Array, Array]:
    """A pointwise scalar f of n components, each (*batch), with its first and second derivatives.

    Forward over reverse, the reverse pass linearised once. Returns arrays (*batch), (n, *batch)
    and (n, n, *batch).
    """

    def summed(v: list[Array]) -> tuple[Array, Array]:
        value = f(v)
        return jnp.sum(value), value

    first, directional, value = jax.linearize(jax.grad(summed, has_aux=True), y, has_aux=True)
    n, batch = len(y), y[0].shape
    along = lambda e: directional([jnp.broadcast_to(e[k], batch) for k in range(n)])  # noqa: E731
    second = jnp.stack(jax.vmap(along)(jnp.eye(n, dtype=y[0].dtype)))
    return lax.optimization_barrier((value, jnp.stack(first), second))
