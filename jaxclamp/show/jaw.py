"""The jaw's face for other programs: its profile as CSV, and a solid with that face as STL. All in mm.

In the jaw's own coordinates: the origin is its lowest point above mid-length, x runs across the artery, y up
into the jaw, z along the artery. The lower jaw is seen in its mirror image in y.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxclamp.physics.jaws import Jaw
from jaxclamp.pictures.fields import jaw_outline
from jaxclamp.pictures.jaws import same_across
from jaxclamp.scenes.scene import Clamp

PROFILE, SOLID = "jaw.csv", "jaw.stl"
SLIVER = 1e-3
"""points nearer to each other than this part of their mean distance are one"""
ACROSS, ALONG = 161, 241
"""points of a face that changes across the artery"""
SHORT_OF_SIDES = 0.999
"""share of a face's quarter circles that is sampled: its sides may be upright"""
STRAIGHT = 1e-7
"""sine of an angle that counts as none"""


_gap = jax.jit(lambda jaw, point: jaw.gap(point))


@partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})  # it runs four times
def _onto_face(jaw: Jaw, z: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """One Newton step towards gap = 0, along the gap's gradient."""
    gap = lambda y, z: jaw.gap((jnp.zeros_like(z), y, z))  # noqa: E731
    value, pull = jax.vjp(gap, y, z)
    by_y, by_z = pull(jnp.ones_like(value))
    step = value / jnp.maximum(by_y**2 + by_z**2, 1e-12)
    return z - step * by_z, y - step * by_y


def profile(jaw: Jaw, height: float) -> tuple[np.ndarray, np.ndarray]:
    """The jaw's face and its whole section at x = 0 as curves (z, y), mm, (n, 2) each.

    The face goes from the side at negative z over the lowest point to the other side, up to `height` (or the
    jaw's full width, if that is more); each point is on the surface gap = 0 to rounding. A bar's goes all the
    way round. The section is the face and, where it ends, two corners that close it above; anticlockwise, its
    last point is not the first again.
    """
    curve = jaw_outline(jaw, height)[:-1]
    z, y = curve.T
    if np.sum(z * np.roll(y, -1) - y * np.roll(z, -1)) < 0.0:  # clockwise
        z, y = z[::-1], y[::-1]
    top = int(np.argmax(y))
    z, y = np.roll(z, -top), np.roll(y, -top)
    cut = y > np.max(y) - 1e-9 * np.ptp(y)
    closed = np.sum(cut) < 3  # round above, such as a bar
    z, y = (z, y) if closed else (z[~cut], y[~cut])
    for _ in range(4):
        z, y = (np.asarray(v) for v in _onto_face(jaw, z, y))
    face = _apart(np.stack([z, y], axis=1))
    ends = np.array([[face[-1, 0], curve[top, 1]], [face[0, 0], curve[top, 1]]])
    return face, face if closed else np.concatenate([face, ends])


def _apart(curve: np.ndarray) -> np.ndarray:
    """The curve without points that lie on top of the one before."""
    steps = np.linalg.norm(np.diff(curve, axis=0, append=curve[:1]), axis=1)
    return curve[steps > SLIVER * np.mean(steps)]


def _without_straights(polygon: np.ndarray) -> np.ndarray:
    """The polygon without corners at which it goes straight on: they would make triangles of no area."""
    before, after = np.roll(polygon, 1, axis=0), np.roll(polygon, -1, axis=0)
    lengths = np.linalg.norm(polygon - before, axis=1) * np.linalg.norm(after - polygon, axis=1)
    return polygon[np.abs(_turn(before, polygon, after)) > STRAIGHT * lengths]


def solid(section: np.ndarray, half_width: float) -> tuple[np.ndarray, np.ndarray]:
    """A closed surface: the section drawn out over |x| <= half_width, mm; points (2 n, 3), triangles (m, 3).

    Seen from outside, the corners of a triangle go anticlockwise: normals point outwards.
    section: corners (z, y), anticlockwise, (n, 2)
    """
    section = _without_straights(section)
    n = len(section)
    z, y = section.T
    points = np.concatenate([np.stack([np.full(n, x), y, z], axis=1) for x in (-half_width, half_width)])
    here = np.arange(n)
    after = (here + 1) % n
    sides = np.concatenate(
        [np.stack([here, n + after, after], axis=1), np.stack([here, n + here, n + after], axis=1)]
    )
    cap = np.array(list(_ears(section)))
    return points, np.concatenate([sides, cap, n + cap[:, ::-1]])


def _ears(polygon: np.ndarray) -> Iterator[tuple[int, int, int]]:
    """Triangles of a polygon, by cutting off ears; corners anticlockwise, (n, 2)."""
    left, at = list(range(len(polygon))), 0
    while len(left) > 3:
        around = [i % len(left) for i in range(at - 1, at - 1 + len(left))]
        at = next((i for i in around if _is_ear(polygon[left], i)), 0)
        yield left[at - 1], left[at], left[(at + 1) % len(left)]
        left.pop(at)
    yield left[0], left[1], left[2]


def _is_ear(polygon: np.ndarray, i: int) -> bool:
    """True if corner i sticks out and no other corner lies in the triangle that it makes."""
    n = len(polygon)
    a, b, c = polygon[i - 1], polygon[i], polygon[(i + 1) % n]
    if _turn(a, b, c) <= 0.0:
        return False
    others = np.delete(polygon, [(i - 1) % n, i, (i + 1) % n], axis=0)
    inside = (_turn(a, b, others) >= 0.0) & (_turn(b, c, others) >= 0.0) & (_turn(c, a, others) >= 0.0)
    return not np.any(inside)


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Positive where a, b and c (..., 2) go anticlockwise."""
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (
        c[..., 0] - a[..., 0]
    )


def block(jaw: Jaw, height: float, half_width: float) -> tuple[np.ndarray, np.ndarray]:
    """A closed surface whose lower side is a face that changes across the artery, too: points, triangles.

    Its back is flat, at `height`, its sides straight, where the face ends along the artery.
    """
    extent = float(jaw.half_extent())
    x = np.linspace(-half_width, half_width, ACROSS)
    z = extent * np.sin(np.linspace(-0.5, 0.5, ALONG) * np.pi * SHORT_OF_SIDES)
    places = np.stack([g.ravel() for g in np.meshgrid(x, z, indexing="ij")])
    least, most = np.full(places.shape[1], -extent), np.full(places.shape[1], max(height, extent))
    for _ in range(60):
        middle = 0.5 * (least + most)
        inside = np.asarray(_gap(jaw, (places[0], middle, places[1]))) < 0.0
        least, most = np.where(inside, least, middle), np.where(inside, middle, most)
    face = np.stack([places[0], most, places[1]], axis=1)
    back = face * [1.0, 0.0, 1.0] + [0.0, max(height, float(np.max(most)) + extent), 0.0]
    number = np.arange(x.size * z.size).reshape(x.size, z.size)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    lower = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    rim = np.concatenate([number[:-1, 0], number[-1, :-1], number[:0:-1, -1], number[0, :0:-1]])
    following, n = np.roll(rim, -1), number.size
    sides = [np.stack(t, axis=-1) for t in ((rim, rim + n, following), (following, rim + n, following + n))]
    return np.concatenate([face, back]), np.concatenate([lower, lower[:, ::-1] + n, *sides])


def write_jaws(clamp: Clamp, height: float, half_width: float, folder: Path) -> list[Path]:
    """Write profile and solid of each kind of jaw; solids reach to `height`, over |x| <= half_width, mm."""
    return [
        path
        for name, jaw in clamp.kinds.items()
        for path in write_jaw(jaw, height, half_width, folder, "" if name == "jaw" else f"_{name}")
    ]


def write_jaw(jaw: Jaw, height: float, half_width: float, folder: Path, which: str = "") -> list[Path]:
    """Write the profile and the solid of one jaw; which: at the end of the files' names."""
    import meshio

    face, section = profile(jaw, height)
    rows = "".join(f"{z:.6f},{y:.6f}\n" for z, y in face + 0.0)
    profile_path, solid_path = (
        folder / f"{Path(name).stem}{which}{Path(name).suffix}" for name in (PROFILE, SOLID)
    )
    profile_path.write_text(f"z_mm,y_mm\n{rows}", encoding="utf-8", newline="")
    points, triangles = solid(section, half_width) if same_across(jaw) else block(jaw, height, half_width)
    meshio.write(solid_path, meshio.Mesh(points, [("triangle", triangles)]), binary=True)
    return [profile_path, solid_path]
