"""The contact law: a penalty whose pressure sets in smoothly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxclamp.physics.contact import Contact

stiffnesses = st.floats(1e-1, 1e6)
smoothings = st.floats(1e-4, 1.0)


@jax.jit
def taylor(law: Contact, gap: jax.Array) -> tuple[jax.Array, ...]:
    """Energy, its slope and its curvature at one gap."""
    slope = jax.grad(law.energy)
    return law.energy(gap), slope(gap), jax.grad(slope)(gap)


def derivative(law: Contact, gap: float, order: int) -> float:
    return float(taylor(law, jnp.asarray(gap))[order])


@given(stiffnesses, smoothings, st.floats(1.0, 1e3))
def test_nothing_beyond_the_smoothing(stiffness, smoothing, times):
    law = Contact(stiffness=stiffness, smoothing=smoothing)
    gap = times * smoothing
    assert [derivative(law, gap, k) for k in range(3)] == [0.0, 0.0, 0.0]


@given(stiffnesses, smoothings, st.floats(1.0, 1e3))
def test_pressure_is_stiffness_times_penetration_when_deep(stiffness, smoothing, times):
    law = Contact(stiffness=stiffness, smoothing=smoothing)
    penetration = times * smoothing
    assert -derivative(law, -penetration, 1) == pytest.approx(stiffness * penetration, rel=1e-12)
    assert derivative(law, -penetration, 2) == pytest.approx(stiffness, rel=1e-12)


tangents = jax.jit(lambda law, gaps: jax.vmap(lambda g: taylor(law, g)[2])(gaps))


@given(stiffnesses, smoothings)
def test_second_derivative_is_continuous_and_monotone(stiffness, smoothing):
    law = Contact(stiffness=stiffness, smoothing=smoothing)
    gaps = smoothing * np.linspace(-1.2, 1.2, 2001)
    tangent = np.asarray(tangents(law, jnp.asarray(gaps)))
    # it falls from 1 to 0 over two smoothing lengths: 1/2000 per sample of 0.0012, and no jump
    assert np.all(np.diff(tangent) <= 1e-12 * stiffness)
    assert np.max(np.abs(np.diff(tangent))) < 1e-3 * stiffness
    assert (tangent[0], tangent[-1]) == (pytest.approx(stiffness), 0.0)


@given(stiffnesses, smoothings, st.floats(-3.0, 3.0))
def test_pressure_is_the_slope_of_the_energy(stiffness, smoothing, times):
    law = Contact(stiffness=stiffness, smoothing=smoothing)
    gap, step = times * smoothing, 1e-5 * smoothing
    difference = (derivative(law, gap + step, 0) - derivative(law, gap - step, 0)) / (2 * step)
    assert derivative(law, gap, 1) == pytest.approx(difference, rel=1e-5, abs=1e-6 * stiffness * smoothing)


def test_energy_is_per_point():
    law = Contact(stiffness=2000.0, smoothing=0.01)
    gaps = jnp.linspace(-0.05, 0.05, 12).reshape(3, 4)
    one_by_one = np.array([[law.energy(g) for g in row] for row in gaps])
    np.testing.assert_array_equal(law.energy(gaps), one_by_one)


def test_half_way_value():
    """At gap 0 the energy of stiffness 1, smoothing 1 is 1**3 / 12 and the pressure 1/4."""
    law = Contact(stiffness=1.0, smoothing=1.0)
    assert derivative(law, 0.0, 0) == pytest.approx(1.0 / 12.0, rel=1e-14)
    assert derivative(law, 0.0, 1) == pytest.approx(-0.25, rel=1e-14)
