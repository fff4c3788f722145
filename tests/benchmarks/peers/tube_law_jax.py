"""The law of the tube in JAX, for the peers that have no fibres of their own."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import tube_work as work

CONSTANTS = {"c": work.C, "k1": work.K1, "k2": work.K2}


def fibre_directions(X: Any) -> np.ndarray:
    """Both fibre families at reference positions X (..., 3): unit vectors, (..., 2, 3)."""
    X = np.asarray(X)
    R, zero = np.hypot(X[..., 0], X[..., 1]), np.zeros(X.shape[:-1])
    hoop = np.stack([-X[..., 1] / R, X[..., 0] / R, zero], axis=-1) * np.cos(work.FIBRE_ANGLE)
    axial = np.stack([zero, zero, zero + np.sin(work.FIBRE_ANGLE)], axis=-1)
    return np.stack([hoop + axial, hoop - axial], axis=-2)


def det(F: Any) -> Any:
    """Determinant of (3, 3), in closed form: LAPACK's is many times slower on batches."""
    return (
        F[0, 0] * (F[1, 1] * F[2, 2] - F[1, 2] * F[2, 1])
        - F[0, 1] * (F[1, 0] * F[2, 2] - F[1, 2] * F[2, 0])
        + F[0, 2] * (F[1, 0] * F[2, 1] - F[1, 1] * F[2, 0])
    )


def shape_energy(F: Any, fibres: Any, constants: Any) -> Any:
    """Energy of the change of shape per reference volume at one point, kPa."""
    c, k1, k2 = constants["c"], constants["k1"], constants["k2"]
    scale = det(F) ** (-2.0 / 3.0)
    E = jnp.maximum(scale * jnp.sum((fibres @ F.T) ** 2, axis=1) - 1.0, 0.0)
    fibre = jnp.sum(k1 / (2.0 * k2) * (jnp.exp(k2 * E**2) - 1.0))
    return c / 2.0 * (scale * jnp.sum(F**2) - 3.0) + fibre


def swept_density(x: Any, along: Any, round_: Any) -> Any:
    """-(x n_x + y n_y)/2 da of a facet: summed over the facets, the volume of the lumen.

    x: position; along, round_: tangents, whose cross product points into the lumen
    """
    n = jnp.cross(along, round_)
    return -0.5 * (x[0] * n[0] + x[1] * n[1])
