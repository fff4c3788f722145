"""Rigid jaws as gap functions. A jaw sees one point; it has no mesh.

Jaw coordinates: the origin is the lowest point of the jaw's smooth face above mid-length, x runs across the
artery, y up into the jaw, z along the artery. `gap(point)` is the signed distance, positive outside: zero
on the face and exact to first order around it (within 0.3 % in the short blends between the parts
of a face), with continuous second derivative. Faces that ship can have relief: teeth and a crown.
"""

from __future__ import annotations

import abc

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.records import quantity, record, static
from jaxclamp.core.tensors import Vector, half_square, norm, ramp
from jaxclamp.physics.relief import Crown, Relief, Teeth, with_relief


class Jaw(abc.ABC):
    """A rigid jaw. A shape is one record with its floats, and `gap`."""

    shape: str
    """name in scene files"""

    @abc.abstractmethod
    def gap(self, point: Vector) -> Array:
        """Signed distance of `point` (x, y, z, each (*batch)) from the face, mm; positive outside."""

    @abc.abstractmethod
    def half_extent(self) -> Array:
        """Distance along the artery from the jaw's middle to its side, mm."""

    @abc.abstractmethod
    def curvatures(self) -> Array:
        """Greatest curvatures of the parts of the face, 1/mm, convex ones positive, (n_parts,)."""

    def least_radius(self) -> Array:
        """Least radius of curvature of the convex parts of the face, mm (an estimate for meshing)."""
        return 1.0 / jnp.maximum(jnp.max(self.curvatures()), 1e-12)


class Face(Jaw):
    """A jaw with a smooth face, and perhaps relief on it: `teeth`, a `crown`."""

    @abc.abstractmethod
    def smooth_gap(self, point: Vector) -> Array:
        """Gap of the face without relief, mm."""

    @abc.abstractmethod
    def smooth_curvatures(self) -> Array:
        """Greatest curvatures of the face without relief, 1/mm, (n_parts,)."""

    @property
    def relief(self) -> list[Relief]:
        """What there is on the face."""
        known = (getattr(self, "teeth", None), getattr(self, "crown", None))
        return [part for part in known if part is not None]

    def gap(self, point: Vector) -> Array:
        return with_relief(self.smooth_gap, self.relief, point)

    def curvatures(self) -> Array:
        return jnp.concatenate([self.smooth_curvatures(), *(part.curvatures() for part in self.relief)])


@record
class Cylinder(Face):
    """A round bar across the artery."""

    shape: str = static("cylinder")
    radius: Array = quantity("mm", 0.0, 1e4, open_lower=True)
    """radius of the bar"""
    teeth: Teeth | None = None
    crown: Crown | None = None

    def smooth_gap(self, point: Vector) -> Array:
        return norm((point[1] - self.radius, point[2])) - self.radius

    def half_extent(self) -> Array:
        return jnp.asarray(self.radius)

    def smooth_curvatures(self) -> Array:
        return jnp.reshape(1.0 / self.radius, 1)


@record
class Flat(Face):
    """A flat face with rounded edges."""

    shape: str = static("flat")
    half_width: Array = quantity("mm", 0.0, 1e3, open_lower=True)
    """half the width of the flat part, along the artery; the edges come on top"""
    edge_radius: Array = quantity("mm", 0.0, 1e3, open_lower=True)
    """radius of the rounding from the flat part to the side"""
    teeth: Teeth | None = None
    crown: Crown | None = None

    def smooth_gap(self, point: Vector) -> Array:
        return _rounded(jnp.abs(point[2]) - self.half_width, point[1], self.half_width, self.edge_radius)

    def half_extent(self) -> Array:
        return jnp.asarray(self.half_width + self.edge_radius)

    def smooth_curvatures(self) -> Array:
        return jnp.reshape(1.0 / self.edge_radius, 1)


@record
class Spline(Face):
    """A smooth profile y = h(z), symmetric about the middle, with rounded edges.

    The slope h' is the quadratic B-spline over equally spaced stations z_i = i d, i = 0..n, with
    d = half_width / (n + 1/2), whose control values are 0 in the middle and `slopes` beyond. It
    reaches the last slope at the profile's end, without curvature, so that the rounding starts
    from a straight line. It stays inside the control polygon's range, h is convex where the
    slopes rise, and the steepest rise between two stations bounds the curvature:
    |h''| <= max |s_(i+1) - s_i| / d. Off the face the second derivative of the gap jumps at
    (i + 1/2) d by the order of the gap itself: nothing on the face, next to nothing beside it.
    """

    shape: str = static("spline")
    half_width: Array = quantity("mm", 0.0, 1e3, open_lower=True)
    """half the width of the profile, along the artery; the edges come on top"""
    slopes: Array = quantity("", -20.0, 20.0, many=True)
    """control values of h' at the stations beside the middle; the last is the slope at the end, (n,)"""
    edge_radius: Array = quantity("mm", 0.0, 1e3, open_lower=True)
    """radius of the rounding from the profile's end to the side"""
    profile_residual: Array | None = quantity("mm", 0.0, 1e3, default=None)
    """how far the farthest point of the file is off that the profile was fitted to; moves nothing"""
    teeth: Teeth | None = None
    crown: Crown | None = None

    def _control(self) -> Array:
        """Control values of h' at all stations, (n + 1,)."""
        return jnp.concatenate([jnp.zeros(1), jnp.asarray(self.slopes)])

    def _spacing(self) -> Array:
        """Distance between stations, mm."""
        return self.half_width / (jnp.shape(self.slopes)[0] + 0.5)

    def height(self, z: Array | np.ndarray) -> tuple[Array, Array]:
        """h (mm) and h' at distances z (*batch) from the middle, z >= 0; straight past the end."""
        spacing = self._spacing()
        control = self._control()
        n = control.shape[0] - 1
        kinks = jnp.diff(jnp.append(jnp.diff(control), 0.0))  # of the polygon, at stations 1..n
        t = jnp.asarray(z) / spacing
        u = t[None] - jnp.arange(1.0, n + 1.0).reshape(n, *[1] * t.ndim)
        kinks = kinks.reshape(u.shape[:1] + (1,) * t.ndim)
        # half_square(u, 1/2) is max(u, 0)**2 / 2 averaged over a station's width: a cubic B-spline
        height = control[1] * t * t / 2.0 + jnp.sum(kinks * half_square(u, 0.5), axis=0)
        v = jnp.clip(u, -0.5, 0.5) + 0.5
        slope = control[1] * t + jnp.sum(kinks * jnp.where(u < 0.5, v * v / 2.0, u), axis=0)
        return spacing * height, slope

    def smooth_gap(self, point: Vector) -> Array:
        y, z = point[1], jnp.abs(point[2])
        h, slope = self.height(z)
        end_h, end_slope = self.height(jnp.asarray(self.half_width))
        above = (y - h) / jnp.sqrt(1.0 + slope**2)
        past_end = (z - self.half_width + end_slope * (y - end_h)) / jnp.sqrt(1.0 + end_slope**2)
        return _rounded(past_end, above, self.half_width, self.edge_radius)

    def half_extent(self) -> Array:
        return jnp.asarray(self.half_width + self.edge_radius)

    def smooth_curvatures(self) -> Array:
        bends = jnp.diff(self._control()) / self._spacing()
        return jnp.append(bends, 1.0 / self.edge_radius)


@record
class Measured(Face):
    """A face by five numbers that callipers give: flat, edges and ends rounded, teeth along the artery."""

    shape: str = static("measured")
    length: Array = quantity("mm", 0.0, 1e3, open_lower=True)
    """of the jaw across the artery, which lies in its middle"""
    width: Array = quantity("mm", 0.0, 1e3, open_lower=True)
    """along the artery, from side to side, more than twice the edge's radius"""
    edge_radius: Array = quantity("mm", 0.0, 1e3, open_lower=True)
    """of edges and ends"""
    tooth_pitch: Array = quantity("mm", 0.0, 1e2, open_lower=True)
    """from tip to tip, along the artery"""
    tooth_depth: Array = quantity("mm", 0.0, 1e2)
    """of the grooves; 0: smooth"""

    @property
    def teeth(self) -> Teeth:
        """A sine along the artery, a tip in the middle."""
        return Teeth(
            profile="sine",
            direction="along",
            middle="tip",
            rows=1,
            pitch=self.tooth_pitch,
            depth=self.tooth_depth,
        )

    @property
    def crown(self) -> None:
        """None."""
        return

    def smooth_gap(self, point: Vector) -> Array:
        flat = self.width / 2.0 - self.edge_radius
        face = _rounded(jnp.abs(point[2]) - flat, point[1], flat, self.edge_radius)
        return ended(face, jnp.abs(point[0]) - self.length / 2.0, self.edge_radius)

    def half_extent(self) -> Array:
        return jnp.asarray(self.width / 2.0)

    def smooth_curvatures(self) -> Array:
        return jnp.reshape(1.0 / self.edge_radius, 1)


def ended(gap: Array, past_end: Array, radius: Array) -> Array:
    """Gap of a jaw that ends across the artery, its end rounded, from that of one that goes on.

    past_end: distance of the point beyond the end's foremost place, mm
    """
    width = radius / 5.0
    a, b = past_end + radius, gap + radius
    nearest_side = b + ramp(a - b, width)
    return norm((ramp(a, width), ramp(b, width))) - radius - ramp(-nearest_side, width)


def _rounded(past_end: Array, above: Array, half_width: Array, radius: Array) -> Array:
    """Signed distance from the corner region {past_end < 0, above > 0}, rounded by `radius` outside.

    past_end, above: orthogonal coordinates along and into the face, mm. The face meets the
    quarter circle with continuous curvature, spread over a quarter of the radius or less.
    """
    width = 1.0 / (4.0 / radius + 1.0 / half_width)
    a, b = past_end, radius - above
    nearest_side = b + ramp(a - b, width)
    outside = norm((ramp(a, width), ramp(b, width)))
    return outside - radius - ramp(-nearest_side, width)
