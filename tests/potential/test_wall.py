"""The wall's derivatives by invariants against those by all nine components of F, over every law."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxclamp.core.tensors import components, det, pointwise_derivatives
from jaxclamp.physics.materials import FibreLaw
from jaxclamp.potential.densities import Solid, mixed_energy
from jaxclamp.potential.wall import by_pairs, wall_derivatives
from laws import LAWS, every_law

STATES = {
    "at rest": 0.0,
    "as in an artery": 0.3,
    "crushed and stretched": 0.9,
}
"""size of random parts of the tangents, the identity being 1"""


def points(size: float) -> tuple[dict, jax.Array, Solid]:
    """Tangents, pressures and a solid with distorted cells at 4 x 5 points of positive volume."""
    rng = np.random.default_rng(int(10 * size))
    one = np.eye(3)[:, :, None, None]
    y = one + size * rng.uniform(-1.0, 1.0, (3, 3, 4, 5))
    L = one + 0.3 * rng.uniform(-1.0, 1.0, (3, 3, 4, 5))
    y = y * np.sign(np.asarray(det(y) * det(L)))
    p, dV = rng.uniform(-30.0, 60.0, (4, 5)), rng.uniform(0.1, 1.0, (4, 5))
    return components(jnp.asarray(y)), jnp.asarray(p), (jnp.asarray(L), jnp.asarray(dV))


by_invariants = jax.jit(wall_derivatives)


@jax.jit
def by_components(y, p, solid):
    """The general road."""
    names = list(y)
    of = lambda v: mixed_energy(dict(zip(names, v, strict=True)), p, solid)
    return pointwise_derivatives(of, list(y.values()))


@every_law
@pytest.mark.parametrize("size", STATES.values(), ids=STATES.keys())
def test_both_roads_agree(law, size):
    """To rounding of the largest entry of each point, also where fibres are slack or exponents are large."""
    assert isinstance(law, FibreLaw)
    y, p, (L, dV) = points(size)
    solid = Solid(material=law, to_local=L, dV=dV)
    expected = by_components(y, p, solid)
    energy, first, second = by_invariants(y, p, solid)
    np.testing.assert_allclose(energy, expected[0], rtol=1e-11, atol=1e-11 * np.max(np.abs(expected[0])))
    for found, other in (
        (first.reshape(9, 4, 5), expected[1]),
        (
            second.reshape(9, 4, 6, 5).swapaxes(1, 2),
            by_pairs(expected[2].reshape(3, 3, 3, 3, 4, 5)).reshape(9, 4, 6, 5).swapaxes(1, 2),
        ),
    ):
        axes = tuple(range(found.ndim - 2))
        largest = np.max(np.abs(np.asarray(other)), axis=axes, keepdims=True)
        assert np.all(np.abs(np.asarray(found - other)) <= 1e-11 * largest)


def test_a_crushed_point_is_no_number_but_infinite():
    """J <= 0 gives +inf by either road, so that a trial step is refused."""
    y, p, (L, dV) = points(0.3)
    y = {key: -value for key, value in y.items()}
    for law in LAWS:
        energy, _, _ = wall_derivatives(y, p, Solid(material=law, to_local=L, dV=dV))
        assert np.all(np.isposinf(energy))
