"""Jaws as gap functions. What every jaw promises runs over all of them; then each shape's own."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from jaxclamp.core.records import concrete_subclasses
from jaxclamp.physics.jaws import Cylinder, Flat, Jaw, Measured, Spline

SPAN = {"mm": (0.4, 4.0), "": (-0.6, 0.9), "deg": (0.2, 1.0)}
"""values to draw from for a quantity of each unit, inside its own range"""


def example(kind: type[Jaw], seed: int) -> Jaw:
    """A jaw with random dimensions, read off its fields."""
    random = np.random.default_rng(seed)
    values = {}
    for field in dataclasses.fields(kind):
        if "range" in field.metadata:
            low, high = SPAN[field.metadata["range"].unit]
            low, high = max(low, field.metadata["range"].lower), min(high, field.metadata["range"].upper)
            values[field.name] = jnp.asarray(random.uniform(low, high, 5 if field.metadata["many"] else ()))
    return kind(**values)


N_FACE = 8000
"""points per face in all tests, so that one compiled function serves them"""

SHAPES = [kind for kind in concrete_subclasses(Jaw) if kind is not Measured]
"""without the one that is another with ends and teeth: test_relief.py"""
every_jaw = pytest.mark.parametrize(
    "jaw",
    [pytest.param(example(kind, seed), id=f"{kind.__name__}-{seed}") for kind in SHAPES for seed in range(3)],
)


@jax.jit
def gap(jaw, y, z):
    return jaw.gap((jnp.zeros_like(y), y, z))


@jax.jit
def derivatives(jaw, y, z):
    """Gap, gradient (2, n) and Hessian (2, 2, n) in the plane (y, z) at points y, z (n,)."""
    f = lambda v: jaw.gap((jnp.zeros(()), v[0], v[1]))
    points = jnp.stack([y, z], axis=1)
    over = lambda g: jnp.moveaxis(jax.vmap(g)(points), 0, -1)
    return over(f), over(jax.grad(f)), over(jax.hessian(f))


@jax.jit
def weighted_gap(jaw, weights, y, z):
    return jnp.sum(weights * gap(jaw, y, z))


gradient_by_dimensions = jax.jit(jax.grad(weighted_gap))


def face(jaw, n=N_FACE):
    """Points (y, z) of the lower face from the middle to near the side, by bisection."""
    z = np.linspace(0.0, 0.999 * float(jaw.half_extent()), n)
    heights = np.linspace(-5.0, 8.0, 261)
    outside = np.asarray(gap(jaw, jnp.asarray(heights)[:, None], jnp.asarray(z)[None])) > 0.0
    first = np.argmax(~outside, axis=0)
    met = first > 0
    z, first = z[met], first[met]
    low, high = heights[first - 1], heights[first]
    for _ in range(60):
        middle = 0.5 * (low + high)
        above = np.asarray(gap(jaw, jnp.asarray(middle), jnp.asarray(z))) <= 0.0
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    assert len(z) > 0.4 * n
    return jnp.asarray(np.resize(low, n)), jnp.asarray(np.resize(z, n))


# -------------------------------------------------------------------------------- every jaw


@every_jaw
def test_lowest_point_is_the_origin(jaw):
    assert float(gap(jaw, jnp.asarray(0.0), jnp.asarray(0.0))) == pytest.approx(0.0, abs=1e-14)
    for depth in (0.01, 1.0, 30.0):
        assert float(gap(jaw, jnp.asarray(-depth), jnp.asarray(0.0))) == pytest.approx(depth, rel=1e-12)


@every_jaw
def test_unit_gradient_on_the_face(jaw):
    y, z = face(jaw)
    value, gradient, _ = derivatives(jaw, y, z)
    length = np.linalg.norm(gradient, axis=0)
    np.testing.assert_allclose(value, 0.0, atol=1e-11)
    np.testing.assert_allclose(length, 1.0, atol=3e-3)  # of the blends between the parts of a face
    assert np.mean(np.abs(length - 1.0) < 1e-6) > 0.6
    assert np.all(gradient[0] < 0.0)  # the jaw is above


@every_jaw
def test_gap_is_the_distance_along_the_normal(jaw):
    y, z = face(jaw)
    _, gradient, _ = derivatives(jaw, y, z)
    for distance in 1e-3 * float(jaw.least_radius()) * np.array([-1.0, 1.0]):
        away = gap(jaw, y + distance * gradient[0], z + distance * gradient[1])
        np.testing.assert_allclose(away, distance, rtol=7e-3)


@every_jaw
def test_second_derivative_is_continuous_on_the_face(jaw):
    """Between points far closer than any blend is wide, the Hessian hardly changes.

    A blend without continuous curvature jumps by about 1 / radius.
    """
    y, z = face(jaw)
    _, _, hessian = derivatives(jaw, y, z)
    change = np.max(np.abs(np.diff(hessian, axis=-1)), axis=(0, 1))
    near = np.hypot(np.diff(y), np.diff(z)) < 3.0 * float(jaw.half_extent()) / N_FACE
    assert np.sum(near) > 0.4 * N_FACE
    assert np.max(change[near]) < 0.02 / float(jaw.least_radius())


@every_jaw
def test_symmetric_along_the_artery_and_the_same_across_it(jaw):
    x, y, z = jnp.asarray(np.random.default_rng(5).uniform(-6.0, 6.0, (3, 200)))
    np.testing.assert_array_equal(jaw.gap((x, y, z)), jaw.gap((x, y, -z)))
    np.testing.assert_array_equal(jaw.gap((x, y, z)), jaw.gap((0.0 * x, y, z)))


@every_jaw
def test_never_nan(jaw):
    """Also at the singular points: the axis, the face, the middle of the rounding."""
    special = [0.0, *(float(v) for v in jax.tree_util.tree_leaves(jaw) if jnp.ndim(v) == 0)]
    steps = np.concatenate([np.linspace(-50.0, 50.0, 77), special, -np.array(special)])
    assert len(steps) ** 2 <= N_FACE
    y, z = (jnp.asarray(np.resize(v, N_FACE)) for v in np.meshgrid(steps, steps))
    for quantity in derivatives(jaw, y, z):
        assert np.all(np.isfinite(quantity))
    slope = gradient_by_dimensions(jaw, jnp.ones_like(y), y, z)
    for leaf in jax.tree_util.tree_leaves(slope):
        assert np.all(np.isfinite(leaf))


@every_jaw
def test_gradient_by_every_dimension(jaw):
    """Against central differences at points beside the face, where contact happens."""
    y, z = face(jaw)
    y = y + jnp.asarray(np.random.default_rng(6).uniform(-0.1, 0.1, y.shape)) * jaw.least_radius()
    weights = jnp.asarray(np.random.default_rng(7).normal(size=y.shape))
    total = lambda j: weighted_gap(j, weights, y, z)
    leaves, structure = jax.tree_util.tree_flatten(jaw)
    found = jax.tree_util.tree_leaves(gradient_by_dimensions(jaw, weights, y, z))
    for i, leaf in enumerate(leaves):
        for k in np.ndindex(leaf.shape):
            step = jnp.zeros(leaf.shape).at[k].set(1e-5)
            moved = lambda s: structure.unflatten([*leaves[:i], leaf + s * step, *leaves[i + 1 :]])  # noqa: B023
            difference = float(total(moved(1.0)) - total(moved(-1.0))) / 2e-5
            assert float(found[i][k]) == pytest.approx(difference, rel=1e-6, abs=1e-6)


@every_jaw
def test_least_radius_is_about_that_of_the_face(jaw):
    """The blend between two parts of a face may curve up to a fifth more than either."""
    y, z = face(jaw)
    _, gradient, hessian = derivatives(jaw, y, z)
    tangent = jnp.stack([-gradient[1], gradient[0]])
    curvature = np.einsum("in,ijn,jn->n", tangent, hessian, tangent)
    assert np.max(curvature) < 1.25 / float(jaw.least_radius())


# --------------------------------------------------------------------------------- cylinder


@given(st.floats(0.1, 10.0), st.floats(-20.0, 20.0), st.floats(-20.0, 20.0))
def test_cylinder_is_the_exact_distance(radius, y, z):
    found = gap(Cylinder(radius=jnp.asarray(radius)), jnp.asarray(y), jnp.asarray(z))
    assert float(found) == pytest.approx(math.hypot(y - radius, z) - radius, rel=1e-12, abs=1e-12)


# ------------------------------------------------------------------------------------- flat

flats = st.tuples(st.floats(0.3, 5.0), st.floats(0.05, 2.0))
"""half width and edge radius"""


def flat_jaw(width, radius):
    return Flat(half_width=jnp.asarray(width), edge_radius=jnp.asarray(radius))


def blend(width, radius):
    """Half-width over which the flat part and the rounding are joined."""
    return 1.0 / (4.0 / radius + 1.0 / width)


def gap_at(jaw, y, z):
    return float(gap(jaw, jnp.asarray(y), jnp.asarray(z)))


@given(flats, st.floats(0.0, 1.0), st.floats(-30.0, 1.0))
def test_flat_is_the_distance_to_the_plane_below_the_flat_part(flat, across, height):
    width, radius = flat
    z = across * (width - blend(*flat))
    y = height if height < 0.0 else 0.999 * height * (radius - blend(*flat))
    assert gap_at(flat_jaw(*flat), y, z) == pytest.approx(-y, rel=1e-11, abs=1e-12)


@given(flats, st.floats(0.0, 1.0), st.floats(0.5, 5.0))
def test_flat_is_the_distance_to_the_rounding_beside_it(flat, along, times):
    """Seen from the middle of the quarter circle, past the blends."""
    width, radius = flat
    distance = times * radius
    joint = math.asin(blend(*flat) / distance)
    angle = joint + along * (math.pi / 2 - 2 * joint)
    y, z = radius - distance * math.cos(angle), width + distance * math.sin(angle)
    assert gap_at(flat_jaw(*flat), y, z) == pytest.approx(distance - radius, rel=1e-10, abs=1e-10)


@given(flats, st.floats(-0.7, 3.0), st.floats(0.0, 5.0))
def test_flat_is_the_distance_to_its_side(flat, beyond, above):
    width, radius = flat
    z = width + radius + beyond * radius
    y = radius + blend(*flat) + above
    if beyond < 0.0:  # inside: only where the side is nearer than the face and the other side
        y += 2.0 * radius
    assert gap_at(flat_jaw(*flat), y, z) == pytest.approx(beyond * radius, rel=1e-10, abs=1e-10)
    assert float(flat_jaw(*flat).half_extent()) == pytest.approx(width + radius)


@given(flats, st.floats(-1.0, 0.2))
def test_second_derivative_from_both_sides_of_each_joint_of_the_flat(flat, depth):
    """The joints are |z| = half_width -+ blend below, and y = radius -+ blend beside the jaw."""
    (width, radius), jaw = flat, flat_jaw(*flat)
    for joint in (-blend(*flat), blend(*flat)):
        y, z = jnp.full(2, depth * radius), width + joint + 1e-8 * radius * jnp.array([-1.0, 1.0])
        below = derivatives(jaw, y, z)[2]
        y, z = radius - width + z, jnp.full(2, width + radius * (1.0 - depth))
        beside = derivatives(jaw, y, z)[2]
        for hessian in (below, beside):
            np.testing.assert_allclose(hessian[..., 0] * radius, hessian[..., 1] * radius, atol=1e-5)


def test_flat_is_inside_deep_down():
    jaw = Flat(half_width=2.0, edge_radius=0.5)
    for y, z in ((0.6, 0.0), (1.0, 1.0), (5.0, 2.0), (0.5, 2.4)):
        assert gap_at(jaw, y, z) < 0.0
    # nearest the side: the plane z = 2.5
    assert float(gap(jaw, jnp.asarray(10.0), jnp.asarray(2.2))) == pytest.approx(-0.3, abs=1e-12)
    assert float(gap(jaw, jnp.asarray(10.0), jnp.asarray(0.5))) == pytest.approx(-2.0, abs=1e-12)


# ----------------------------------------------------------------------------------- spline


@given(flats, st.sampled_from([1, 5]))
def test_spline_without_slopes_is_flat(size, n):
    flat = flat_jaw(*size)
    spline = Spline(half_width=flat.half_width, slopes=jnp.zeros(n), edge_radius=flat.edge_radius)
    y, z = jnp.asarray(np.random.default_rng(8).uniform(-6.0, 6.0, (2, 100)))
    np.testing.assert_allclose(gap(spline, y, z), gap(flat, y, z), rtol=1e-12, atol=1e-13)


slope_lists = st.sampled_from([1, 3, 6]).flatmap(
    lambda n: st.lists(st.floats(-3.0, 3.0), min_size=n, max_size=n)
)
profile = jax.jit(Spline.height)
curvatures = jax.jit(lambda jaw, z: jax.vmap(jax.grad(lambda s: jaw.height(s)[1]))(z))


def as_bspline(slopes, half_width):
    """h' as SciPy's quadratic B-spline: odd about the middle, constant beyond the last station."""
    n, d = len(slopes), half_width / (len(slopes) + 0.5)
    control = [-c for c in slopes[::-1]] + [0.0, *slopes] + [slopes[-1]] * 6
    stations = np.arange(-n, n + 7)
    knots = d * np.append(stations - 1.5, stations[-1] + np.array([-0.5, 0.5, 1.5]))
    return BSpline(knots, np.array(control), 2)


@given(slope_lists, st.floats(0.5, 8.0))
def test_spline_height_and_slope_against_scipy(slopes, half_width):
    jaw = Spline(half_width=jnp.asarray(half_width), slopes=jnp.asarray(slopes), edge_radius=0.5)
    slope = as_bspline(slopes, half_width)
    z = np.linspace(0.0, half_width * (1.0 + 2.0 / len(slopes) ** 2), 57)
    found_height, found_slope = profile(jaw, jnp.asarray(z))
    whole = slope.antiderivative()
    np.testing.assert_allclose(found_slope, slope(z), rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(found_height, whole(z) - whole(0.0), rtol=1e-10, atol=1e-11)


@given(slope_lists, st.floats(0.5, 8.0))
def test_spline_keeps_its_promises(slopes, half_width):
    """Slope inside the control values, curvature below the steepest rise, straight past the end."""
    jaw = Spline(half_width=jnp.asarray(half_width), slopes=jnp.asarray(slopes), edge_radius=0.5)
    z = jnp.linspace(0.0, half_width, 400)
    slope, curvature = np.asarray(profile(jaw, z)[1]), np.asarray(curvatures(jaw, z))
    control = np.array([0.0, *slopes])
    assert np.all(slope >= control.min() - 1e-12)
    assert np.all(slope <= control.max() + 1e-12)
    bound = np.max(np.abs(np.diff(control))) * (len(slopes) + 0.5) / half_width
    assert np.all(np.abs(curvature) <= bound * (1 + 1e-9) + 1e-12)
    if np.all(np.diff(control) >= 0.0):
        assert np.all(curvature >= -1e-10)
    beyond = half_width * jnp.array([1.0, 1.5, 2.0])
    np.testing.assert_allclose(profile(jaw, beyond)[1], slopes[-1], rtol=1e-9, atol=1e-11)


def test_spline_is_convex_where_slopes_rise():
    jaw = Spline(half_width=3.0, slopes=jnp.array([0.1, 0.3, 0.6, 1.0]), edge_radius=0.5)
    curvature = curvatures(jaw, jnp.linspace(0.0, 2.9, 300))
    assert np.all(np.asarray(curvature) > 0.0)


def test_spline_is_the_distance_to_a_line_where_it_is_straight():
    """Slopes that rise evenly to a plateau of 0.75: on it h' is 3/4, and normals are (4, -3)/5."""
    jaw = Spline(half_width=4.5, slopes=jnp.array([0.375, 0.75, 0.75, 0.75]), edge_radius=0.4)
    z = jnp.asarray(3.2)
    height = float(jaw.height(z)[0])
    for distance in (-0.05, 0.5, 3.0):
        found = gap(jaw, jnp.asarray(height - distance * 5.0 / 4.0), z)
        assert float(found) == pytest.approx(distance, rel=1e-10)
