"""The semi-analytic tube itself: published and independently computed figures."""

import dataclasses

import numpy as np
import pytest

from tube import ADVENTITIA, MEDIA, RING, SEED, SEED_EQ10, Compressible, Incompressible, Sector

# Human LAD of 2002, incompressible, by an independent quadrature; printed digits are exact
# (pressure kPa, stretch): r_i mm, then kPa: media sigma_theta and sigma_z at the inner, "middle" and outer
# radius, adventitia sigma_theta and sigma_z at the inner and outer radius. The reference sampled the
# sector on 4000 equally spaced radii, whose point 2000 (from 0) stands for the middle.
MIDDLE = 2000 / 3999
STATES = {
    (0.0, 1.0): (
        1.7318,
        (-6.235, 0.370, 6.082),
        (-3.297, -0.015, 2.754),
        (-0.440, -0.044),
        (-0.217, -0.022),
    ),
    (13.33, 1.1): (
        2.5071,
        (75.293, 69.187, 66.080),
        (8.403, 13.262, 17.381),
        (58.973, 54.186),
        (32.372, 31.569),
    ),
}


@pytest.mark.parametrize("load", STATES, ids=["load-free", "physiological"])
def test_radius_and_stresses_of_the_seed(load):
    radius, media_hoop, media_axial, adventitia_hoop, adventitia_axial = STATES[load]
    tube = Incompressible(SEED, *load)
    assert tube.inner_radius == pytest.approx(radius, abs=5.1e-5)
    media = tube.profile(0, MEDIA.inner_radius + MEDIA.thickness * np.array([0.0, MIDDLE, 1.0]))
    adventitia = tube.profile(1, ADVENTITIA.inner_radius + ADVENTITIA.thickness * np.array([0.0, 1.0]))
    np.testing.assert_allclose(media.hoop, media_hoop, atol=5.1e-4)
    np.testing.assert_allclose(media.axial, media_axial, atol=5.1e-4)
    np.testing.assert_allclose(adventitia.hoop, adventitia_hoop, atol=5.1e-4)
    np.testing.assert_allclose(adventitia.axial, adventitia_axial, atol=5.1e-4)


def test_radius_over_pressure():
    pressures = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0)
    radii = (1.6515, 1.8396, 2.0871, 2.2870, 2.3891, 2.4478, 2.4870, 2.5386, 2.5727)
    found = [Incompressible(SEED, p, 1.1).inner_radius for p in pressures]
    np.testing.assert_allclose(found, radii, atol=5.1e-5)


def test_printed_equation_10_gives_the_published_radius():
    assert Incompressible(SEED_EQ10, 13.33, 1.1).inner_radius == pytest.approx(2.5188, abs=5.1e-5)


@pytest.mark.parametrize(("bulk", "radius"), [(1e3, 2.5358), (1e4, 2.5101), (1e6, 2.5071)])
def test_effect_of_compressibility(bulk, radius):
    assert Compressible(SEED, 13.33, 1.1, bulk).inner_radius == pytest.approx(radius, abs=5.1e-5)


def test_closed_ring():
    # quadrature and radial equation by another code; six finite-element codes tend to the second
    assert Incompressible(RING, 13.33, 1.1).inner_radius == pytest.approx(2.883318, abs=5.1e-7)
    assert Compressible(RING, 13.33, 1.1, 1e4).inner_radius == pytest.approx(2.889099, abs=5.1e-7)


def test_neo_hookean_ring_in_closed_form():
    """p = int c (a**2 - 1/(a l)**2) dr/r with a = r/R, u = r**2 and R**2 = b + l u, b = R_i**2 - l r_i**2:

    int a**2 dr/r = int du / (2 (b + l u)) = ln(R_o/R_i) / l,
    int dr / (r (a l)**2) = int (b + l u) / (2 l**2 u**2) du = [l ln u - b/u] / (2 l**2).
    """
    c, stretch, R_i, R_o, r_i = 30.0, 1.2, 2.0, 2.6, 2.3
    ring = (Sector(R_i, R_o - R_i, 0.0, c, law="neo"),)
    b = R_i**2 - stretch * r_i**2
    u_i, u_o = r_i**2, (R_o**2 - b) / stretch
    first = np.log(R_o / R_i) / stretch
    second = (stretch * np.log(u_o / u_i) - b / u_o + b / u_i) / (2.0 * stretch**2)
    pressure = c * (first - second)
    assert Incompressible(ring, pressure, stretch).inner_radius == pytest.approx(r_i, abs=1e-12)


def test_layers_of_one_material_are_one_layer():
    cut = 0.3
    inner = dataclasses.replace(MEDIA, thickness=cut)
    outer = dataclasses.replace(MEDIA, inner_radius=MEDIA.inner_radius + cut, thickness=MEDIA.thickness - cut)
    for tube in (Incompressible, lambda *a: Compressible(*a, 1e4)):
        whole, parts = tube((MEDIA,), 10.0, 1.1), tube((inner, outer), 10.0, 1.1)
        assert parts.inner_radius == pytest.approx(whole.inner_radius, abs=1e-9)


def test_compressible_tends_to_incompressible():
    limit = Incompressible(SEED, 13.33, 1.1)
    errors = [
        Compressible(SEED, 13.33, 1.1, bulk).inner_radius - limit.inner_radius for bulk in (1e4, 1e5, 1e6)
    ]
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    np.testing.assert_allclose(ratios, 10.0, rtol=0.05)  # first order in 1/bulk
    R = np.array([MEDIA.inner_radius, MEDIA.outer_radius])
    stiff = Compressible(SEED, 13.33, 1.1, 1e7).profile(0, R)
    np.testing.assert_allclose(stiff.hoop, limit.profile(0, R).hoop, rtol=1e-3)
    np.testing.assert_allclose(stiff.axial, limit.profile(0, R).axial, rtol=1e-3)
