"""Relief on a jaw's face: teeth and a crown, as smooth heights over the smooth face.

A height h(x, z) >= 0 takes the face back into the jaw; the tips of teeth, and the middle of a crown, stay
where the smooth face is. With the gap g of the smooth face, the face with relief is where g + h = 0, and its
gap is (g + h) / |grad (g + h)|: the distance to first order.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxclamp.core.records import quantity, record, static
from jaxclamp.core.tensors import Vector, total

USUAL_SHARPNESS = 4.0
"""tips of rounded wedges for which no radius is given are so many times as sharp as a sine's"""


@record
class Teeth:
    """A periodic height on a jaw's face, the tips on the smooth face, the grooves `depth` inside the jaw.

    Given a `phase`, the mirror planes that it may break are not made use of; leave it out for the smaller
    model.
    """

    profile: str = static(choices=("sine", "wedge", "rows"))
    """sine; wedge: straight flanks with rounded tips and grooves; rows: a few ridges in the middle of a face
    that lies back, such as one of one jaw that goes between two of the other"""
    pitch: Array = quantity("mm", 0.0, 1e2, open_lower=True)
    """distance from tip to tip"""
    depth: Array = quantity("mm", 0.0, 1e2)
    """of the grooves"""
    direction: str = static("along", choices=("along", "across", "both"))
    """in which the height changes: along the artery, across it, or both (cross-serration)"""
    middle: str = static("tip", choices=("tip", "groove"))
    """what there is in the middle of the face; grooves of one jaw face tips of the other"""
    phase: Array | None = quantity("", -1.0, 1.0, default=None)
    """how far the teeth are beside that, in pitches"""
    tip_radius: Array | None = quantity("mm", 0.0, 1e2, open_lower=True, default=None)
    """of a wedge's tips; a quarter of what a sine of that pitch and depth has, if not given"""
    rows: int = static(1)
    """number of ridges of the profile rows"""

    @property
    def planes(self) -> str:
        """The mirror planes x = 0 and z = 0 that hold whatever the floats."""
        moving = {"along": "z", "across": "x", "both": "xz"}[self.direction] if self.phase is not None else ""
        return "".join(axis for axis in "xz" if axis not in moving)

    def sine_radius(self) -> Array:
        """Radius of a sine's tips of that pitch and depth, mm: pitch^2 / (2 pi^2 depth)."""
        return jnp.asarray(self.pitch**2 / (2.0 * jnp.pi**2 * jnp.maximum(self.depth, 1e-12)))

    def height(self, x: Array | float, z: Array | float) -> Array:
        """Height of the face inside the jaw, mm, at places across and along the artery."""
        shift = (0.0 if self.phase is None else self.phase) + (0.5 if self.middle == "groove" else 0.0)
        share = {"sine": _sine, "wedge": self._wedge, "rows": self._rows}[self.profile]
        back = lambda s: share(jnp.asarray(s) / self.pitch - shift)  # noqa: E731
        if self.direction == "both":
            return self.depth * (1.0 - (1.0 - back(x)) * (1.0 - back(z)))
        return self.depth * back(z if self.direction == "along" else x)

    def _wedge(self, u: Array) -> Array:
        """A triangle wave, its corners rounded: (arccos(k cos 2 pi u) - arccos k) / (2 arcsin k)."""
        a = _rounding(self._sharpness())
        wave: Array = jnp.arccos(jnp.sin(a) * jnp.cos(2.0 * jnp.pi * u))
        return (wave - (0.5 * jnp.pi - a)) / (2.0 * a)

    def _sharpness(self) -> Array:
        """The sine's radius over the tips' own."""
        if self.tip_radius is None:
            return jnp.asarray(USUAL_SHARPNESS)
        return self.sine_radius() / self.tip_radius

    def _rows(self, u: Array) -> Array:
        ridge = lambda v: jnp.where(jnp.abs(v) < 0.5, jnp.cos(jnp.pi * jnp.clip(v, -0.5, 0.5)) ** 4, 0.0)  # noqa: E731
        return 1.0 - total(ridge(u - (i - 0.5 * (self.rows - 1))) for i in range(self.rows))

    def curvatures(self) -> Array:
        """Greatest curvature of the tips, 1/mm, (1,)."""
        factor = self._sharpness() if self.profile == "wedge" else {"sine": 1.0, "rows": 2.0}[self.profile]
        return jnp.reshape(factor / self.sine_radius(), 1)


def _sine(u: Array) -> Array:
    return 0.5 * (1.0 - jnp.cos(2.0 * jnp.pi * u))


def _rounding(sharpness: Array) -> Array:
    """a in (0, pi/2) with tan(a) / a = sharpness > 1; by bisection, differentiable through Newton steps."""
    known = lax.stop_gradient(sharpness)
    least, most = jnp.zeros_like(known), jnp.full_like(known, 0.5 * jnp.pi)
    for _ in range(55):
        a = 0.5 * (least + most)
        above = jnp.sin(a) > known * a * jnp.cos(a)
        least, most = jnp.where(above, least, a), jnp.where(above, a, most)
    a = 0.5 * (least + most)
    for _ in range(2):  # each makes the derivatives right to one more order
        F = jnp.sin(a) - sharpness * a * jnp.cos(a)
        a = a - F / (jnp.cos(a) - sharpness * (jnp.cos(a) - a * jnp.sin(a)))
    return a


@record
class Crown:
    """A face that is not straight across the artery: crowned (rise > 0) or grooved (rise < 0).

    Its height is rise x^2 / (x^2 + half_width^2): half of the rise at half_width beside the middle.
    """

    rise: Array = quantity("mm", -1e2, 1e2)
    """how far the face lies back in the end, beside the middle"""
    half_width: Array = quantity("mm", 0.0, 1e3, open_lower=True)
    """where half of the rise is reached"""

    def height(self, x: Array | float, z: Array | float) -> Array:
        """Height of the face inside the jaw, mm."""
        x = jnp.asarray(x)
        return self.rise * x**2 / (x**2 + self.half_width**2)

    def curvatures(self) -> Array:
        """Curvature in the middle, 1/mm, (1,)."""
        return jnp.reshape(2.0 * self.rise / self.half_width**2, 1)


Relief = Teeth | Crown


def with_relief(gap: Callable[[Vector], Array], relief: list[Relief], point: Vector) -> Array:
    """Gap of a face with relief from that of the smooth one, mm."""
    if not relief:
        return gap(point)
    x, y, z = map(jnp.asarray, point)
    one, none = jnp.ones_like(x), jnp.zeros_like(x)
    height = lambda x, z: sum(part.height(x, z) for part in relief)  # noqa: E731
    smooth, by_x = jax.jvp(lambda x: gap((x, y, z)), (x,), (one,))
    by_z = jax.jvp(lambda z: gap((x, y, z)), (z,), (one,))[1]
    h, h_x = jax.jvp(height, (x, z), (one, none))
    h_z = jax.jvp(height, (x, z), (none, one))[1]
    slope = 1.0 + 2.0 * (by_x * h_x + by_z * h_z) + h_x**2 + h_z**2
    return (smooth + h) / jnp.sqrt(slope)
