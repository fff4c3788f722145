"""The wall's derivatives by invariants against those by all nine components of F, over every law."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxclamp.core.tensors import components, det
from jaxclamp.physics.materials import FibreLaw
from jaxclamp.potential.densities import Solid
from jaxclamp.potential.wall import wall_derivatives
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


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class OfAllOfF:
    """A law as the engine sees one that only has psi_bar(F)."""

    law: FibreLaw

    def psi_bar(self, F):
        return self.law.psi_bar(F)


derivatives = jax.jit(wall_derivatives)


def general(solid: Solid) -> Solid:
    """The solid on the road through all nine components of F."""
    return dataclasses.replace(solid, material=OfAllOfF(solid.material))


@every_law
@pytest.mark.parametrize("size", STATES.values(), ids=STATES.keys())
def test_both_roads_agree(law, size):
    """To rounding of the largest entry of each point, also where fibres are slack or exponents are large."""
    assert isinstance(law, FibreLaw)
    y, p, (L, dV) = points(size)
    solid = Solid(material=law, to_local=L, dV=dV)
    expected = derivatives(y, p, general(solid))
    found = derivatives(y, p, solid)
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-11, atol=1e-11 * np.max(np.abs(expected[0])))
    # first (9, points, cells) and second (9, points, pairs, cells), the entries of a point in front
    for one, other, points_at in zip(found[1:], expected[1:], (1, 2), strict=True):
        flat = [np.moveaxis(np.asarray(a).reshape(9, *a.shape[2:]), 1, points_at) for a in (one, other)]
        entries = tuple(range(points_at))
        largest = np.max(np.abs(flat[1]), axis=entries, keepdims=True)
        assert np.all(np.abs(flat[0] - flat[1]) <= 1e-11 * largest)


def test_a_crushed_point_is_no_number_but_infinite():
    """J <= 0 gives +inf by either road, so that a trial step is refused."""
    y, p, (L, dV) = points(0.3)
    y = {key: -value for key, value in y.items()}
    for law in LAWS:
        solid = Solid(material=law, to_local=L, dV=dV)
        for road in (solid, general(solid)):
            assert np.all(np.isposinf(derivatives(y, p, road)[0]))
