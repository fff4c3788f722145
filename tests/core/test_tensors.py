"""Small tensors, smooth switches and the stiffening exponential, against numpy and mpmath."""

from functools import partial

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxclamp.core import tensors

LARGEST_FLOAT = 1.7e308
matrices = np.random.default_rng(1).normal(size=(3, 3, 4, 25))
others = np.random.default_rng(2).normal(size=(3, 3, 4, 25))


def by_components(A):
    return {(i, j): jnp.asarray(A[i, j]) for i in range(3) for j in range(3)}


def as_numpy(A):
    """Batch axes first, as numpy's linear algebra wants it."""
    return np.moveaxis(np.asarray(A), (0, 1), (-2, -1))


# ------------------------------------------------------------------------------- small tensors


@pytest.mark.parametrize("form", [jnp.asarray, by_components])
def test_determinant_and_inverse(form):
    A = form(matrices)
    np.testing.assert_allclose(tensors.det(A), np.linalg.det(as_numpy(matrices)), rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(as_numpy(tensors.inverse(A)), np.linalg.inv(as_numpy(matrices)), rtol=1e-9)


@pytest.mark.parametrize("form", [jnp.asarray, by_components])
def test_products(form):
    A, B = form(matrices), form(others)
    a, b = as_numpy(matrices), as_numpy(others)
    np.testing.assert_allclose(
        as_numpy(tensors.stacked(tensors.product(A, B))), a @ b, rtol=1e-12, atol=1e-14
    )
    np.testing.assert_array_equal(as_numpy(tensors.stacked(tensors.transpose(A))), np.swapaxes(a, -1, -2))
    np.testing.assert_allclose(tensors.squared_norm(A), np.sum(a * a, axis=(-2, -1)), rtol=1e-13)


def test_cross_product_and_length():
    a, b = matrices[0], matrices[1]
    np.testing.assert_allclose(tensors.cross(a, b), np.cross(a, b, axis=0), rtol=1e-11, atol=1e-14)
    np.testing.assert_allclose(tensors.norm(jnp.asarray(a)), np.linalg.norm(a, axis=0), rtol=1e-14)


def test_slope_of_determinant_is_the_cofactor():
    """d det(A) / dA = det(A) A^-T."""
    slope = jax.grad(lambda A: jnp.sum(tensors.det(A)))(jnp.asarray(matrices))
    a = as_numpy(matrices)
    expected = np.linalg.det(a)[..., None, None] * np.swapaxes(np.linalg.inv(a), -1, -2)
    np.testing.assert_allclose(as_numpy(slope), expected, rtol=1e-9, atol=1e-11)


def test_length_of_nothing_has_no_slope():
    slope = jax.grad(lambda a: tensors.norm(a))(jnp.zeros(3))
    np.testing.assert_array_equal(slope, np.zeros(3))
    np.testing.assert_array_equal(jax.hessian(lambda a: tensors.norm(a))(jnp.zeros(3)), np.zeros((3, 3)))
    assert float(tensors.safe_sqrt(jnp.asarray(-1.0))) == 0.0


def test_pointwise_derivatives():
    """f = x**2 y + sin(z), its gradient and Hessian written out."""
    x, y, z = np.random.default_rng(3).normal(size=(3, 2, 5))
    value, first, second = tensors.pointwise_derivatives(
        lambda v: v[0] ** 2 * v[1] + jnp.sin(v[2]), [jnp.asarray(c) for c in (x, y, z)]
    )
    np.testing.assert_allclose(value, x**2 * y + np.sin(z), rtol=1e-13)
    np.testing.assert_allclose(first, [2 * x * y, x**2, np.cos(z)], rtol=1e-13)
    nothing = np.zeros_like(x)
    expected = [[2 * y, 2 * x, nothing], [2 * x, nothing, nothing], [nothing, nothing, -np.sin(z)]]
    np.testing.assert_allclose(second, expected, rtol=1e-13)


# ---------------------------------------------------------------------------- smooth switches

widths = st.floats(1e-4, 1e2)
switches = pytest.mark.parametrize("switch", [tensors.ramp, tensors.half_square])


@partial(jax.jit, static_argnums=0)
def _taylor(f, u, width):
    slope = jax.grad(f)
    return jnp.stack([f(u, width), slope(u, width), jax.grad(slope)(u, width)])


def taylor(switch, u, width):
    """Value, slope and curvature of a switch at u."""
    return np.asarray(_taylor(switch, jnp.asarray(u), jnp.asarray(width)))


@switches
@given(width=widths)
def test_switch_is_smooth_at_both_joints(switch, width):
    scale = np.array([1.0, 1.0, 1.0]) * (width if switch is tensors.ramp else width**2)
    scale = scale / width ** np.arange(3)
    nothing = np.zeros(3)
    beyond = (
        np.array([width, 1.0, 0.0]) if switch is tensors.ramp else np.array([2 / 3 * width**2, width, 1.0])
    )
    for joint, expected in ((-width, nothing), (width, beyond)):
        for side in (-1.0, 0.0, 1.0):
            here = taylor(switch, joint + side * 1e-9 * width, width)
            np.testing.assert_allclose(here / scale, expected / scale, atol=1e-8)


@switches
@given(width=widths, times=st.floats(1.0, 1e3))
def test_switch_is_exact_away_from_its_corner(switch, width, times):
    u = times * width
    exact = [u, 1.0, 0.0] if switch is tensors.ramp else [u**2 / 2 + width**2 / 6, u, 1.0]
    np.testing.assert_allclose(taylor(switch, u, width), exact, rtol=1e-13, atol=0)
    np.testing.assert_array_equal(taylor(switch, -u, width), np.zeros(3))


@switches
@given(width=widths, fraction=st.floats(-0.999, 0.999))
def test_switch_is_convex_and_above_the_corner(switch, width, fraction):
    u = fraction * width
    value, slope, curvature = taylor(switch, u, width)
    corner = max(u, 0.0) if switch is tensors.ramp else max(u, 0.0) ** 2 / 2
    assert value > corner * (1.0 - 1e-14)
    assert slope > 0.0
    assert curvature > 0.0


@given(width=widths, fraction=st.floats(-2.0, 2.0))
def test_ramp_splits_a_number(width, fraction):
    """ramp(u) - ramp(-u) = u, as max(u, 0) - max(-u, 0)."""
    u = jnp.asarray(fraction * width)
    difference = taylor(tensors.ramp, u, width)[0] - taylor(tensors.ramp, -u, width)[0]
    assert float(difference) == pytest.approx(float(u), rel=1e-12, abs=1e-14 * width)


@given(width=widths, fraction=st.floats(-1.5, 1.5))
def test_half_square_is_the_moving_average(width, fraction):
    """The mean of max(v, 0)**2 / 2 over u - w < v < u + w is [max(u+w,0)**3 - max(u-w,0)**3] / (12 w)."""
    u = fraction * width
    mean = (max(u + width, 0.0) ** 3 - max(u - width, 0.0) ** 3) / (12.0 * width)
    assert taylor(tensors.half_square, u, width)[0] == pytest.approx(mean, rel=1e-10, abs=0)


# ------------------------------------------------------------------- the stiffening exponential


def stiffening_exact(k2: float, E: float) -> tuple[mpmath.mpf, ...]:
    """(exp(k2 E**2) - 1) / (2 k2) and its derivatives E e**q, (1 + 2 q) e**q, with q = k2 E**2."""
    with mpmath.workdps(50):
        k2, E = mpmath.mpf(k2), mpmath.mpf(E)
        q = k2 * E * E
        value = mpmath.expm1(q) / (2 * k2) if k2 else E * E / 2
        return value, E * mpmath.exp(q), (1 + 2 * q) * mpmath.exp(q)


stiffening = jax.jit(tensors.exponential_stiffening)
stiffening_slope = jax.jit(jax.grad(tensors.exponential_stiffening, argnums=1))
stiffening_curvature = jax.jit(jax.grad(jax.grad(tensors.exponential_stiffening, argnums=1), argnums=1))
stiffening_by_k2 = jax.jit(jax.grad(tensors.exponential_stiffening, argnums=0))


@pytest.mark.parametrize("k2", [0.0, 1e-12, 1e-6, 1e-3, 0.1, 0.64, 3.54, 15.4, 60.0, 200.0, 500.0])
@pytest.mark.parametrize("E", [0.0, 1e-8, 1e-4, 3e-3, 0.025, 0.1, 0.1001, 0.5, 1.0, 2.0, 4.0, 6.6, 8.0])
def test_stiffening_and_its_derivatives(k2, E):
    exact = stiffening_exact(k2, E)
    k2_, E_ = jnp.asarray(k2), jnp.asarray(E)
    found = [f(k2_, E_) for f in (stiffening, stiffening_slope, stiffening_curvature)]
    assert not np.any(np.isnan(found))
    if k2 * E * E <= tensors.LARGEST_EXPONENT:
        for value, reference in zip(found, exact, strict=True):
            assert float(value) == pytest.approx(float(reference), rel=5e-12, abs=0)
    elif exact[0] < LARGEST_FLOAT:
        assert float(found[0]) == pytest.approx(float(exact[0]), rel=1e-11)
    else:
        assert float(found[0]) == np.inf
    if k2 * E * E > tensors.LARGEST_EXPONENT:
        assert found[1] > 0.0
        assert found[2] > 0.0


@given(st.floats(0.0, 500.0), st.floats(0.0, 8.0))
def test_stiffening_anywhere(k2, E):
    exact = stiffening_exact(k2, E)[0]
    found = float(stiffening(jnp.asarray(k2), jnp.asarray(E)))
    if exact > LARGEST_FLOAT:
        assert found > 1e307
    else:
        assert found == pytest.approx(float(exact), rel=1e-11, abs=1e-300)


@pytest.mark.parametrize("E", [0.0, 1e-3, 0.3, 1.0, 8.0])
def test_stiffening_by_k2_at_zero(E):
    """(exp(k2 E**2) - 1) / (2 k2) = E**2/2 + k2 E**4/4 + ..., so the slope at k2 = 0 is E**4/4."""
    assert float(stiffening_by_k2(jnp.asarray(0.0), jnp.asarray(E))) == pytest.approx(E**4 / 4, rel=1e-14)


@pytest.mark.parametrize(("k2", "E"), [(1e-5, 3.0), (0.01, 1.0), (3.54, 0.7), (15.4, 1.2), (500.0, 1.1)])
def test_stiffening_by_k2(k2, E):
    with mpmath.workdps(50):
        exact = mpmath.diff(lambda k: mpmath.expm1(k * mpmath.mpf(E) ** 2) / (2 * k), mpmath.mpf(k2))
    assert float(stiffening_by_k2(jnp.asarray(k2), jnp.asarray(E))) == pytest.approx(float(exact), rel=1e-11)


def test_stiffening_is_smooth_where_its_series_takes_over():
    """Both sides of q = 0.01 agree with the exact curvature to rounding."""
    for q in (0.01 * (1 - 1e-12), 0.01 * (1 + 1e-12)):
        exact = stiffening_exact(1.0, np.sqrt(q))[2]
        found = stiffening_curvature(jnp.asarray(1.0), jnp.asarray(np.sqrt(q)))
        assert float(found) == pytest.approx(float(exact), rel=1e-12)


# ------------------------------------------------------------------------------ smooth maximum

smooth_maximum = jax.jit(tensors.smooth_maximum)
positive_values = (
    st.sampled_from([1, 4, 12])
    .flatmap(lambda n: st.lists(st.floats(0.0, 1e3), min_size=n, max_size=n))
    .filter(lambda v: max(v) > 1e-3)
)


@given(positive_values)
def test_smooth_maximum_tends_to_the_maximum_from_below(values):
    v, w = jnp.asarray(values), jnp.ones(len(values))
    found = [float(smooth_maximum(v, w, s)) for s in (4.0, 16.0, 64.0, 256.0)]
    assert all(a <= b * (1 + 1e-12) for a, b in zip(found, [*found[1:], max(values)], strict=True))
    # at least one of n points holds the maximum m: m n**(-1/s) <= result
    assert found[-1] >= max(values) * len(values) ** (-1 / 256.0) * (1 - 1e-12)


@given(positive_values, st.sampled_from([2, 5]))
def test_smooth_maximum_does_not_see_how_the_volume_is_cut(values, pieces):
    v, w = np.asarray(values), np.linspace(1.0, 2.0, len(values))
    whole = float(smooth_maximum(jnp.asarray(v), jnp.asarray(w), 12.0))
    cut = smooth_maximum(jnp.asarray(np.repeat(v, pieces)), jnp.asarray(np.repeat(w / pieces, pieces)), 12.0)
    assert float(cut) == pytest.approx(whole, rel=1e-12)


def test_smooth_maximum_by_hand():
    """Weights 1 and 3, values 2 and 1, power 2: sqrt((4 + 3) / 4)."""
    found = smooth_maximum(jnp.array([2.0, 1.0]), jnp.array([1.0, 3.0]), 2.0)
    assert float(found) == pytest.approx(np.sqrt(7.0) / 2.0, rel=1e-14)


def test_smooth_maximum_has_a_gradient_that_adds_up():
    """It is homogeneous of degree one: sum v_i d/dv_i = value. Compression does not count."""
    v, w = jnp.array([3.0, 1.0, -5.0, 2.9]), jnp.ones(4)
    value, gradient = jax.value_and_grad(tensors.smooth_maximum)(v, w, 20.0)
    assert float(gradient @ v) == pytest.approx(float(value), rel=1e-13)
    assert float(gradient[2]) == 0.0


def test_smooth_maximum_of_nothing_is_zero():
    v, w = jnp.array([-1.0, 0.0, -3.0]), jnp.ones(3)
    value, gradient = jax.value_and_grad(tensors.smooth_maximum)(v, w, 20.0)
    assert float(value) == 0.0
    assert np.all(np.isfinite(gradient))


def test_largest_eigenvalue_agrees_with_lapack():
    rng = np.random.default_rng(5)
    A = rng.normal(size=(200, 3, 3))
    A = A + np.swapaxes(A, 1, 2)
    A[0], A[1] = 3.0 * np.eye(3), np.diag([2.0, 2.0, -1.0])  # a triple and a double eigenvalue
    found = tensors.largest_eigenvalue(jnp.asarray(np.moveaxis(A, 0, -1)))
    np.testing.assert_allclose(found, np.linalg.eigvalsh(A)[:, -1], atol=1e-12)
