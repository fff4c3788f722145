"""Teeth, crowns and ends of jaws: heights, tips, and the distance that a gap has to be."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxclamp.physics.jaws import Cylinder, Flat, Measured, ended
from jaxclamp.physics.placement import SQUARE, Placement
from jaxclamp.physics.relief import Crown, Teeth, _rounding


def teeth(profile="sine", direction="along", pitch=1.0, depth=0.2, rows=2, middle="tip", **others):
    return Teeth(
        middle=middle, profile=profile, direction=direction, pitch=pitch, depth=depth, rows=rows, **others
    )


ALL = [
    teeth(*each, **others)
    for each in itertools.product(("sine", "wedge", "rows"), ("along", "across", "both"))
    for others in ({}, {"phase": jnp.asarray(0.3)})
]
every_kind = pytest.mark.parametrize("one", ALL, ids=lambda t: f"{t.profile} {t.direction} {t.phase}")


@every_kind
def test_tips_are_on_the_smooth_face_and_grooves_are_as_deep_as_said(one):
    x, z = np.meshgrid(np.linspace(-2.0, 2.0, 401), np.linspace(-2.0, 2.0, 401))
    height = np.asarray(one.height(x, z))
    assert height.min() == pytest.approx(0.0, abs=2e-4)
    assert height.max() == pytest.approx(0.2, abs=2e-4)


@pytest.mark.parametrize("profile", ["sine", "wedge", "rows"])
def test_tips_have_the_radius_that_is_said(profile):
    """Of the three curvatures only the wedge's is given; the others follow: pitch^2 over 2 (4) pi^2 depth."""
    radius = {"tip_radius": jnp.asarray(0.05)} if profile == "wedge" else {}
    one = teeth(profile, rows=1, **radius)
    bend = jax.grad(jax.grad(lambda z: one.height(0.0, z)))(0.0)
    wanted = {"wedge": 20.0, "sine": 2.0 * np.pi**2 * 0.2, "rows": 4.0 * np.pi**2 * 0.2}[profile]
    assert float(bend) == pytest.approx(wanted, rel=1e-9)
    assert float(one.curvatures()[0]) == pytest.approx(wanted, rel=1e-9)


def test_a_groove_in_the_middle_is_half_a_pitch_aside():
    groove, aside = teeth(middle="groove"), teeth(phase=jnp.asarray(0.5))
    z = np.linspace(-1.0, 1.0, 50)
    np.testing.assert_allclose(groove.height(0.0, z), aside.height(0.0, z), atol=1e-15)
    assert (groove.planes, aside.planes) == ("xz", "x")


@pytest.mark.parametrize("sharpness", [1.001, 1.5, 4.0, 100.0])
def test_the_rounding_solves_its_equation_with_derivatives_of_two_orders(sharpness):
    """a(C) from tan(a) = C a: a' = a / (sec^2 a - C), and its derivative by differences."""
    s = jnp.asarray(sharpness)
    a = float(_rounding(s))
    assert np.tan(a) == pytest.approx(sharpness * a, rel=1e-12)
    slope = lambda C: float(jax.grad(_rounding)(jnp.asarray(C)))
    assert slope(sharpness) == pytest.approx(a / (1.0 / np.cos(a) ** 2 - sharpness), rel=1e-9)
    h = 1e-6 * sharpness
    expected = (slope(sharpness + h) - slope(sharpness - h)) / (2.0 * h)
    assert float(jax.grad(jax.grad(_rounding))(s)) == pytest.approx(expected, rel=1e-5)


FLAT = {"half_width": jnp.asarray(2.0), "edge_radius": jnp.asarray(0.5)}
FACES = {
    **{f"flat, {t.profile} {t.direction}": Flat(**FLAT, teeth=t) for t in ALL[::2]},
    "bar, sine": Cylinder(radius=jnp.asarray(3.0), teeth=teeth()),
    "crowned": Flat(**FLAT, crown=Crown(rise=jnp.asarray(0.5), half_width=jnp.asarray(2.0))),
    "grooved, toothed": Flat(
        **FLAT, crown=Crown(rise=jnp.asarray(-0.5), half_width=jnp.asarray(2.0)), teeth=teeth("wedge")
    ),
}


QUICK = ("flat, sine along", "flat, wedge both", "bar, sine", "grooved, toothed")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow) for name in FACES]
)
def test_a_gap_with_relief_is_the_distance_from_its_face(name):
    """Zero where the smooth face is displaced by the height; gradient of length 1 there; second derivatives
    that agree with differences of the first across the face."""
    jaw = FACES[name]
    x, z = (g.ravel() for g in np.meshgrid(np.linspace(-3.0, 3.0, 41), np.linspace(-1.5, 1.5, 41)))
    smooth = np.zeros_like(x) if isinstance(jaw, Flat) else 3.0 - np.sqrt(9.0 - z**2)
    height = sum(np.asarray(part.height(x, z)) for part in jaw.relief)
    at = lambda p: jaw.gap((p[0], p[1], p[2]))
    gap, slope, bend = (jax.jit(jax.vmap(f(at))) for f in (lambda f: f, jax.grad, jax.hessian))
    low, high = smooth - 1.0, smooth + 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        inside = np.asarray(gap(jnp.stack([x, middle, z], axis=1))) < 0.0
        low, high = np.where(inside, low, middle), np.where(inside, middle, high)
    on_face = jnp.stack([x, low, z], axis=1)
    if isinstance(jaw, Flat):
        np.testing.assert_allclose(low, height, atol=1e-12)
    gradient = np.asarray(slope(on_face))
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-9)
    away = np.asarray(gap(on_face - 1e-4 * gradient))
    np.testing.assert_allclose(away, -1e-4, rtol=2e-2)
    hessian = np.asarray(bend(on_face))
    step = 1e-5 * np.array([0.3, 0.2, 0.5])
    change = np.asarray(slope(on_face + step) - slope(on_face - step))
    np.testing.assert_allclose(change, 2.0 * hessian @ step, atol=1e-6)  # of changes up to 4e-4


def test_no_relief_costs_nothing():
    """The compiled gap of a face without relief is that of the smooth face."""
    point = tuple(jnp.zeros(3) for _ in range(3))
    lines = lambda f: len(str(jax.make_jaxpr(f)(point)).splitlines())
    flat = Flat(**FLAT)
    assert lines(flat.gap) == lines(flat.smooth_gap)


def test_five_numbers_make_a_flat_face_with_teeth():
    five = Measured(length=20.0, width=5.0, edge_radius=0.5, tooth_pitch=1.0, tooth_depth=0.2)
    same = Flat(half_width=2.0, edge_radius=0.5, teeth=teeth())
    points = [jnp.asarray(p) for p in np.random.default_rng(1).uniform(-2.0, 2.0, (3, 200))]
    np.testing.assert_allclose(five.gap(points), same.gap(points), rtol=1e-12)
    beside = five.gap((jnp.asarray(10.5), jnp.asarray(0.0), jnp.asarray(0.0)))
    assert float(beside) == pytest.approx(np.hypot(1.0, 0.5) - 0.5)  # from the centre of the end's arc


def test_an_end_is_round():
    """Points at one distance from the centre of the end's arc have one gap: the distance from the arc."""
    radius = 0.4
    angle = np.linspace(0.2, 0.5 * np.pi - 0.2, 20)
    past, gap = 0.7 * np.cos(angle) - radius, 0.7 * np.sin(angle) - radius
    np.testing.assert_allclose(ended(gap, past, radius), 0.3, rtol=1e-12)
    np.testing.assert_allclose(ended(np.array([0.2]), np.array([-5.0]), radius), 0.2, rtol=1e-12)


BAR = Cylinder(radius=jnp.asarray(3.0))
POINTS = [np.asarray(p) for p in np.random.default_rng(2).uniform(-2.0, 2.0, (3, 100))]


def placed(**others):
    return Placement(**{"oblique": None, "hinge_distance": None, "tip": None, "reach": None} | others)


def test_an_oblique_bar_is_a_bar_along_another_axis():
    """Turned by a right angle the bar lies along the artery: the gap does not depend on z."""
    gap = placed(oblique=jnp.asarray(0.5 * np.pi)).gap(BAR, POINTS, 0.5)
    x, y, _ = POINTS
    np.testing.assert_allclose(gap, np.hypot(y - 3.5, x) - 3.0, rtol=1e-12, atol=1e-12)


def test_a_hinged_face_passes_the_hinge_and_the_height_at_the_axis():
    """The lowest line of a turned bar goes through the hinge (-d, 0) and (0, height)."""
    hinged = placed(hinge_distance=jnp.asarray(8.0))
    for x, y in ((-8.0, 0.0), (0.0, 1.5), (4.0, 2.25)):
        assert float(hinged.gap(BAR, (x, y, 0.0), 1.5)) == pytest.approx(0.0, abs=1e-12)
    far = placed(hinge_distance=jnp.asarray(1e7)).gap(BAR, POINTS, 0.5)
    np.testing.assert_allclose(far, SQUARE.gap(BAR, POINTS, 0.5), atol=1e-5)


def test_a_jaw_ends_where_it_reaches():
    part = placed(tip=jnp.asarray(1.0), reach=jnp.asarray(4.0))
    x = np.array([-3.0, -1.0])
    np.testing.assert_allclose(
        part.gap(BAR, (x, 0.0 * x, 0.0 * x), 0.5), SQUARE.gap(BAR, (x, 0.0 * x, 0.0 * x), 0.5), rtol=1e-12
    )
    assert float(part.gap(BAR, (2.0, 2.0, 0.0), 0.5)) == pytest.approx(1.0, rel=1e-9)  # beside its end
