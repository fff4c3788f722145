"""What contact takes a jaw's gap for: the distance from its face. Looked at before anything is solved."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.failures import SceneError
from jaxclamp.physics.jaws import Face, Jaw
from jaxclamp.scenes.scene import Scene

ALONG = np.linspace(-0.95, 0.95, 20)
"""where the face is looked at, over the jaw's half extent: short of its sides, which may be upright, and not
in its middle, where a profile of |z| has no derivative and no contact point lies"""
ON_FACE = 1e-9
"""gap that counts as none, over the half extent"""
MOST_STEPS = 40
"""of Newton's method to the face"""
UNIT = 0.01
"""how far the gradient's length may be from 1: the blends of shipped faces are off by 0.003, and contact that
presses wrongly by a hundredth is below what a usual mesh adds"""


def require_a_gap(scene: Scene) -> None:
    """Refuse a jaw whose gap is none: not finite, of the wrong sign, or no distance from the face.

    Raises SceneError.
    """
    for name, jaw in scene.clamp.kinds.items():
        _require_a_lowest_point(scene, jaw, name)
        _require_a_distance(scene, jaw, name)


def _require_a_lowest_point(scene: Scene, jaw: Jaw, name: str) -> None:
    """Refuse a gap of the wrong sign below the middle or inside the jaw, or without a face there.

    The face may lie back there by the depth of its teeth.
    """
    far = 1e3 * float(scene.artery.layers[-1].inner_radius)
    depth = 0.1 * float(jaw.half_extent())
    back = sum(float(part.height(0.0, 0.0)) for part in jaw.relief) if isinstance(jaw, Face) else 0.0
    heights = np.array([-far, back - depth, back, back + depth])
    gap = _seen(jaw, np.zeros(4), heights, np.zeros(4))[0]
    wanted = "a gap that is positive below the jaw's lowest point, 0 there and negative inside the jaw"
    good = np.all(np.isfinite(gap)) and gap[0] > 0.0 and gap[1] > 0.0 and gap[3] < 0.0
    if not good or abs(gap[2]) > 1e-6 * depth:
        shown = ", ".join(f"{g:.3g} mm at y = {y:.3g} mm" for g, y in zip(gap, heights, strict=True))
        raise SceneError(f"clamp.{name} of shape '{jaw.shape}': expected {wanted}; it is {shown}")


def _require_a_distance(scene: Scene, jaw: Jaw, name: str) -> None:
    """Refuse a gap that is not finite near the face, or has no gradient of length 1 on it."""
    outer = scene.artery.layers[-1]
    extent, radius = float(jaw.half_extent()), float(outer.inner_radius + outer.thickness)
    x, z = (each.ravel() for each in np.meshgrid([0.0, radius], extent * ALONG))
    y, gap, length = face(jaw, x, z)
    finite = np.isfinite(gap) & np.isfinite(length)
    wrong = np.flatnonzero(~finite | (np.abs(gap) <= ON_FACE * extent) & (np.abs(length - 1.0) > UNIT))
    if wrong.size:
        i = wrong[0]
        raise SceneError(
            f"clamp.{name} of shape '{jaw.shape}': expected a gap that is the distance from the face, with a "
            f"gradient of length 1 there; it is {gap[i]:.3g} mm with one of {length[i]:.3g} "
            f"at x = {x[i]:.3g}, y = {y[i]:.3g}, z = {z[i]:.3g} mm"
        )


def face(jaw: Jaw, x: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heights of the face at x, z (n,), by Newton's method; gap and length of its gradient there, (n,).

    Where there is no face, as beyond a side, the height is of some point and the gap is not 0.
    """
    y = np.zeros_like(x)
    gap, gradient = _seen(jaw, x, y, z)
    for _ in range(MOST_STEPS):
        with np.errstate(all="ignore"):
            nearer = y - gap / gradient[1]
        nearer = np.where(np.isfinite(nearer), nearer, y)
        if np.array_equal(nearer, y):
            break
        y = nearer
        gap, gradient = _seen(jaw, x, y, z)
    return y, gap, np.sqrt(np.sum(gradient**2, axis=0))


def _seen(jaw: Jaw, *points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gap (n,) and its gradient (3, n) at x, y, z (n,); n is at most that of the points of a face."""
    n, most = len(points[0]), 2 * len(ALONG)
    gap, gradient = _program(jaw, tuple(np.resize(each, most) for each in points))
    return np.asarray(gap)[:n], np.asarray(gradient)[:, :n]


def _gap_and_gradient(jaw: Jaw, points: tuple[Array, ...]) -> tuple[Array, Array]:
    def summed(points: tuple[Array, ...]) -> tuple[Array, Array]:
        gap = jaw.gap(points)
        return jnp.sum(gap), gap

    gradient, gap = jax.grad(summed, has_aux=True)(points)
    return gap, jnp.stack(gradient)


# for a few points it is compiled for a short compilation rather than for speed
_program = jax.jit(_gap_and_gradient, compiler_options={"xla_backend_optimization_level": 0})
