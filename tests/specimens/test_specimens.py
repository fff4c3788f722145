"""The layered tube against an independent one, flat pieces against closed forms, slopes by differences."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxclamp as jc
import tube
from jaxclamp.physics.materials import HGO, NeoHookean
from jaxclamp.specimens.roots import root
from jaxclamp.specimens.tube import at_pressure, inner_from_outer
from laws import every_law, example

SEED = jc.load_scene("human-lad").artery.layers


def layers_of(sectors):
    """The oracle's sectors as layers of a scene."""
    number = jnp.asarray
    return tuple(
        dataclasses.replace(
            SEED[0],
            inner_radius=number(s.inner_radius),
            thickness=number(s.thickness),
            opening_angle=number(math.radians(s.opening_angle)),
            material=HGO(
                c=number(s.c),
                k1=number(s.k1),
                k2=number(s.k2),
                fibre_angle=number(math.radians(s.fibre_angle)),
                bulk=number(1e4),
            ),
        )
        for s in sectors
    )


inflated = jax.jit(at_pressure)


def test_lumen_radii_of_the_human_lad():
    """Radii at an axial stretch of 1.1, as the oracle finds them with 1600 points a layer."""
    pressure = jnp.asarray([0.0, 2.0, 6.0, tube.SEED_PRESSURE, 20.0])
    found = inflated(SEED, pressure, jnp.full(5, 1.1))
    expected = [tube.Incompressible(tube.SEED, float(p), 1.1).inner_radius for p in pressure]
    np.testing.assert_allclose(found.inner_radius, expected, rtol=2e-7)


@pytest.mark.parametrize("seed", range(4))
def test_any_two_layers(seed):
    sectors, pressure, stretch = tube.random_sectors(seed)
    expected = tube.Incompressible(sectors, pressure, stretch)
    found = inflated(layers_of(sectors), jnp.asarray([pressure]), jnp.asarray([stretch]))
    assert float(found.inner_radius[0]) == pytest.approx(expected.inner_radius, rel=1e-6)
    # the wall's axial force by the oracle's stresses: 2 pi times the integral of sigma_z r dr
    force = 0.0
    for number, layer in enumerate(sectors):
        R = np.linspace(layer.inner_radius, layer.outer_radius, 401)
        profile = expected.profile(number, R)
        force += 2.0 * math.pi * float(np.trapezoid(profile.axial * profile.r, profile.r))
    assert float(found.wall_force[0]) == pytest.approx(force, rel=1e-4, abs=1e-3)


def test_reduced_and_wall_force_differ_by_the_pressure_on_the_lumen():
    found = inflated(SEED, jnp.asarray([10.0]), jnp.asarray([1.1]))
    lumen = math.pi * float(found.inner_radius[0]) ** 2 * 10.0
    assert float(found.wall_force[0] - found.reduced_force[0]) == pytest.approx(lumen, rel=1e-12)


def test_outer_and_inner_radius_give_the_same_tube():
    at = inflated(SEED, jnp.asarray([3.0, 12.0]), jnp.asarray([1.0, 1.2]))
    again = jc.inflated_tube(SEED, jnp.asarray([1.0, 1.2]), outer_radius=at.outer_radius)
    np.testing.assert_allclose(again.pressure, [3.0, 12.0], rtol=1e-10)
    np.testing.assert_allclose(again.inner_radius, at.inner_radius, rtol=1e-12)


def test_an_outer_radius_without_room_for_the_wall_is_no_nan():
    assert 0.0 < float(inner_from_outer(SEED, jnp.asarray([0.5]), jnp.asarray([1.0]))[0]) < 0.01


@pytest.mark.parametrize(
    "address",
    [
        "material.k2",
        "opening_angle",
        *(pytest.param(f"material.{name}", marks=pytest.mark.slow) for name in ("c", "k1", "fibre_angle")),
        pytest.param("thickness", marks=pytest.mark.slow),
    ],
)
def test_slopes_of_radius_and_force(address):
    """The root's derivatives against central differences."""
    scene = jc.load_scene("human-lad")
    path = f"artery.layers[1].{address}"
    pressure, stretch = jnp.asarray([1.0, 8.0, 16.0]), jnp.full(3, 1.1)

    def state(value):
        found = inflated(jc.replace(scene, path, value).artery.layers, pressure, stretch)
        return jnp.stack([found.inner_radius, found.reduced_force])

    value = jnp.asarray(float(eval(f"scene.{path}", {"scene": scene})))
    step = 1e-5 * value
    difference = (state(value + step) - state(value - step)) / (2.0 * step)
    found = jax.jacfwd(state)(value)
    np.testing.assert_allclose(found, difference, rtol=1e-5, atol=1e-6 * np.abs(difference).max())


@every_law
def test_every_law_carries_more_pressure_the_wider_it_is(law):
    layers = (dataclasses.replace(SEED[0], material=law),)
    radii = jnp.linspace(2.0, 3.0, 9)
    found = jc.inflated_tube(layers, jnp.full(9, 1.1), inner_radius=radii)
    assert np.all(np.diff(np.asarray(found.pressure)) > 0.0)
    again = jc.inflated_tube(layers, jnp.full(9, 1.1), pressure=found.pressure)
    np.testing.assert_allclose(again.inner_radius, radii, rtol=1e-9)


def test_uniaxial_and_equibiaxial_neo_hookean():
    """sigma = c (l**2 - 1/l) when pulled one way, c (l**2 - 1/l**4) when pulled both ways."""
    law, pulled = example(NeoHookean), jnp.asarray([0.8, 1.0, 1.3])
    one = jc.flat_piece(law, axial_stretch=pulled)
    np.testing.assert_allclose(one.axial_stress, law.c * (pulled**2 - 1.0 / pulled), rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(one.circumferential_stretch, pulled**-0.5, rtol=1e-10)
    both = jc.flat_piece(law, pulled, pulled).circumferential_stress
    np.testing.assert_allclose(both, law.c * (pulled**2 - pulled**-4.0), rtol=1e-10, atol=1e-10)


@every_law
def test_a_piece_pulled_one_way_has_no_stress_across(law):
    for pulled, free in (("axial", "circumferential"), ("circumferential", "axial")):
        piece = jc.flat_piece(law, **{f"{pulled}_stretch": jnp.asarray([1.05, 1.2])})
        across, along = (np.asarray(getattr(piece, f"{name}_stress")) for name in (free, pulled))
        assert np.max(np.abs(across)) < 1e-9 * np.max(along)


def test_a_root_near_an_end_and_through_an_overflow():
    ends = jnp.zeros(3), jnp.full(3, 50.0)
    target = jnp.asarray([1e-8, 1.0, 1e10])
    found = root(lambda x: jnp.expm1(x**2) - target, *ends)
    np.testing.assert_allclose(found, np.sqrt(np.log1p(target)), rtol=1e-6)


@pytest.mark.parametrize(
    "seen", [{}, {"pressure": jnp.ones(1), "inner_radius": jnp.ones(1)}, {"volume": jnp.ones(1)}]
)
def test_a_tube_is_seen_at_one_quantity(seen):
    with pytest.raises(TypeError, match="expected one of"):
        jc.inflated_tube(SEED, jnp.ones(1), **seen)
