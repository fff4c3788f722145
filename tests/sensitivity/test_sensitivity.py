"""Derivatives through equilibrium: against finite differences, against each other, against theory."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxclamp as jc
from directions import dot, drawn, moved, tight
from jaxclamp.scenes.files import loads_scene
from jaxclamp.sensitivity.implicit import implicit, register, see, solution
from jaxclamp.solve.clamping import inflate
from tube import RING, Compressible
from walks import mesh, tube_scene

MEASURES = (
    jc.smooth_peak_axial_stress("media"),
    jc.smooth_peak_circumferential_stress("media"),
    jc.smooth_peak_principal_stress("adventitia"),
    jc.axial_stress_at_P(),
    jc.circumferential_stress_at_P(),
    jc.clamp_force(),
    jc.jaw_travel(),
    jc.lumen_height(),
    jc.lumen_width(),
    jc.lumen_area(),
    jc.mean_contact_pressure(),
    jc.smooth_peak_contact_pressure(),
    jc.volume_above("media", 20.0),
    jc.stored_energy(),
    jc.physiological_lumen_radius(),
    jc.smooth_peak_axial_stress_ratio("media"),
    jc.smooth_peak_contact_pressure_excess(),
    jc.smooth_peak_axial_strain_gradient(),
    jc.mean_damage("media"),
    jc.mean_damage("adventitia", 1.26),
    jc.smooth_peak_damage("adventitia"),
)

FAMILIES = {
    "material": tuple(f"artery.layers[{i}].material" for i in (0, 1)),
    "layers": tuple(
        f"artery.layers[{i}].{name}"
        for i in (0, 1)
        for name in ("inner_radius", "thickness", "opening_angle")
    ),
    "load": ("artery.axial_stretch", "artery.pressure", "artery.length"),
    "jaw": ("clamp.jaw",),
    "contact": ("contact",),
    "stop": ("stop",),
    "mesh": ("mesh",),
}

JAW = '{shape="spline", half_width_mm=2.4, slopes=[0.15, 0.35, 0.6], edge_radius_mm=0.6}'
STOPS = {
    "occlusion": "stop={occlusion=0.925}",
    "half closed": "stop={occlusion=0.5}",
    "travel": "stop={travel_mm=1.8}",
    "force": "stop={force_N=0.3}",
}
BODIES = {
    "load-free": ("artery.pressure_kPa=0.0", "artery.axial_stretch=1.0"),
    "physiological": (),
}
"""without the clamp"""

GRADING = "mesh.circumferential_grading=0.5", "mesh.radial_grading=1.5"
"""inside its range: differences go both ways"""


@functools.cache
def clamped(stop: str) -> jc.Result:
    if stop == "one layer":
        return one_layer()
    overrides = [
        f"clamp.jaw={JAW}",
        *((STOPS[stop],) if stop in STOPS else BODIES[stop]),
        "mesh.circumferential=4",
        "mesh.axial=6",
        "mesh.radial=[2, 2]",
        *GRADING,
    ]
    return solver(stop)(tight(jc.load_scene("human-lad", overrides)))


def solver(stop: str):
    return inflate if stop in BODIES else jc.clamp


@functools.cache
def one_layer() -> jc.Result:
    """The media alone: one block of cells, so that programs which hold everything compile soon."""
    counts = ["mesh.circumferential=4", "mesh.axial=6", "mesh.radial=[2]", "contact.smoothing_mm=0.05"]
    scene = jc.load_scene("human-lad", [f"clamp.jaw={JAW}"])
    artery = dataclasses.replace(scene.artery, layers=scene.artery.layers[:1])
    text = jc.dump_scene(dataclasses.replace(scene, artery=artery, mesh=mesh("q1p0", 4, 6, (2,))))
    return jc.clamp(tight(loads_scene(text, overrides=[*counts, STOPS["half closed"], *GRADING])))


@functools.cache
def gradient_of(stop: str, measure: jc.Measure) -> tuple[float, jc.Scene]:
    return jc.value_and_gradient(clamped(stop), measure)


@pytest.mark.parametrize("family", FAMILIES)
def test_gradient_of_the_peak(family):
    """One layer, one measure; the full set is slow because of what it compiles."""
    check_differences("one layer", family, MEASURES[:1])


@pytest.mark.slow
@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize("family", FAMILIES)
def test_gradient_of_every_measure_at_every_stop(stop, family):
    check_differences(stop, family, MEASURES)


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("family", ["material", "layers", "load", "mesh"])
def test_gradient_in_the_body(body, family):
    check_differences(body, family, (jc.physiological_lumen_radius(),))


def check_differences(stop: str, family: str, measures: tuple[jc.Measure, ...]) -> None:
    """The V-shaped curve: the error falls with h**2, then rises with rounding; its least is tiny.

    Relative to the change that the direction makes, or, where that nearly vanishes, to a part of the value.
    """
    result = clamped(stop)
    layers = len(result.scene.artery.layers)
    paths = tuple(path for path in FAMILIES[family] if layers > 1 or "layers[1]" not in path)
    direction = drawn(result.scene, paths, seed=len(family))
    exact = np.array([dot(gradient_of(stop, m)[1], direction) for m in measures])
    values = np.array([gradient_of(stop, m)[0] for m in measures])
    errors = []
    for h in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        both = [solver(stop)(moved(result.scene, direction, s * h), guess=result) for s in (1.0, -1.0)]
        ahead, behind = ([r.measure(m) for m in measures] for r in both)
        difference = (np.array(ahead) - np.array(behind)) / (2.0 * h)
        errors.append(np.abs(difference - exact) / np.maximum(np.abs(exact), 1e-3 * np.abs(values)))
    best = np.min(errors, axis=0)
    for measure, error in zip(measures, best, strict=True):
        assert error < 1e-6, f"{measure}: {error:.1e}"
    moving = np.abs(exact) > 1e-3 * np.abs(values)
    if family == "load" and stop in STOPS:  # the truncation error is seen: h has done something
        assert np.max(np.array(errors)[0, moving]) > 10.0 * np.max(best[moving])


@pytest.mark.slow
def test_forward_and_reverse_agree():
    result = one_layer()
    direction = drawn(result.scene, ("artery", "clamp", "contact", "stop", "mesh"), 3)
    measure = MEASURES[0]
    f = lambda s: jc.evaluate(s, measure, guess=result)
    value, slope = jax.jvp(f, (moved(result.scene, direction, 0.0),), (direction,))
    again, gradient = jax.value_and_grad(f)(result.scene)
    assert float(value) == pytest.approx(float(again), rel=1e-12)
    assert float(slope) == pytest.approx(dot(gradient, direction), rel=1e-9)
    assert dot(gradient, direction) == pytest.approx(
        dot(jc.value_and_gradient(result, MEASURES[0])[1], direction), rel=1e-9
    )


@pytest.mark.slow
def test_hessian_vector_product_and_jacobians():
    """Derivatives of derivatives with respect to jaw and stop, against differences of gradients."""
    result = one_layer()
    measure, slopes = MEASURES[0], np.asarray(result.scene.clamp.jaw.slopes)

    def f(v):
        return jc.evaluate(jc.replace(result.scene, "clamp.jaw.slopes", v), measure, guess=result)

    rng = np.random.default_rng(5)
    d = rng.uniform(-1.0, 1.0, slopes.shape)
    _, product = jax.jvp(jax.grad(f), (jnp.asarray(slopes),), (jnp.asarray(d),))
    h = 1e-4
    difference = (np.asarray(jax.grad(f)(slopes + h * d)) - np.asarray(jax.grad(f)(slopes - h * d))) / (2 * h)
    np.testing.assert_allclose(product, difference, rtol=1e-4, atol=1e-4 * np.max(np.abs(difference)))
    forward, reverse = jax.jacfwd(f)(jnp.asarray(slopes)), jax.jacrev(f)(jnp.asarray(slopes))
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    np.testing.assert_allclose(
        forward, jc.value_and_gradient(result, MEASURES[0])[1].clamp.jaw.slopes, rtol=1e-9
    )


@pytest.mark.slow
def test_inside_a_compiled_program():
    """Under jit the scene is solved by another process; values and derivatives are the same."""
    result = one_layer()
    measure, slopes = MEASURES[0], np.asarray(result.scene.clamp.jaw.slopes)

    @jax.jit
    def compiled(v):
        return jax.value_and_grad(
            lambda w: jc.evaluate(jc.replace(result.scene, "clamp.jaw.slopes", w), measure)
        )(v)

    value, gradient = compiled(jnp.asarray(slopes))
    assert float(value) == pytest.approx(jc.value_and_gradient(result, MEASURES[0])[0], rel=1e-8)
    np.testing.assert_allclose(
        gradient, jc.value_and_gradient(result, MEASURES[0])[1].clamp.jaw.slopes, rtol=1e-6
    )
    with pytest.raises(jax.errors.JaxRuntimeError, match="no equilibrium"):
        jax.block_until_ready(
            jax.jit(lambda q: jc.evaluate(jc.replace(result.scene, "artery.pressure", q), measure))(1e4)
        )


def test_no_equilibrium_no_derivative():
    scene = jc.replace(one_layer().scene, "artery.pressure", 1e4)
    with pytest.raises(jc.EquilibriumError):
        jax.value_and_grad(jc.evaluate)(scene, MEASURES[0])


@pytest.mark.slow
def test_a_measure_of_the_body_does_not_clamp(monkeypatch):
    result = clamped("occlusion")
    monkeypatch.setattr("jaxclamp.sensitivity.implicit.clamp", lambda *_, **__: pytest.fail("it clamps"))
    far = jc.replace(result.scene, "stop.occlusion", 0.999)
    radius, gradient = jax.value_and_grad(jc.evaluate)(far, jc.physiological_lumen_radius())
    assert float(radius) == pytest.approx(clamped("occlusion").measure(jc.physiological_lumen_radius()))
    assert float(gradient.stop.occlusion) == 0.0
    assert np.all(np.asarray(gradient.clamp.jaw.slopes) == 0.0)


@pytest.mark.slow
def test_an_old_equilibrium_is_not_mistaken_for_another():
    """Tickets are not reused: derivatives of a solution that is no longer kept are refused."""
    result = clamped("occlusion")
    known = solution(result, to_stop=True)
    ticket = register(known)
    for _ in range(10):
        register(known)
    scene = jax.tree_util.tree_map(lambda a: jnp.asarray(a, float), result.scene)
    d = result.model.discretisation
    f = lambda s: jc.clamp_force()(see(s, d, implicit(s, d, known.u, ticket)))
    with pytest.raises(Exception, match="no longer kept"):
        jax.block_until_ready(jax.grad(f)(scene))


@pytest.mark.slow
def test_tube_radius_against_the_differentiated_theory():
    """The gradient of the inflated tube's radius, and differences of the semi-analytic radius."""
    scene = tube_scene(RING, 13.33, 1.1, mesh("q2p1", 6, 2, (4,)))
    _, gradient = jax.value_and_grad(jc.evaluate)(tight(scene), jc.physiological_lumen_radius())
    material, layer = gradient.artery.layers[0].material, gradient.artery.layers[0]
    found = {
        "pressure": gradient.artery.pressure,
        "stretch": gradient.artery.axial_stretch,
        "c": material.c,
        "k1": material.k1,
        "k2": material.k2,
        "thickness": layer.thickness,
        "inner_radius": layer.inner_radius,
    }
    for name, value in found.items():

        def radius(change: float, name: str = name) -> float:
            ring, loads = RING[0], {"pressure": 13.33, "stretch": 1.1}
            if name in loads:
                loads[name] += change
            else:
                ring = dataclasses.replace(ring, **{name: getattr(ring, name) + change})
            return Compressible((ring,), loads["pressure"], loads["stretch"], 1e4).inner_radius

        h = 1e-4
        expected = (radius(h) - radius(-h)) / (2.0 * h)
        assert float(value) == pytest.approx(expected, rel=1e-3), name


@pytest.mark.slow
def test_smooth_quantities_are_smooth_where_the_true_peak_jumps():
    """Over a range of occlusions the place of the true peak jumps; the smooth peak and its slope do not."""
    result = clamped("occlusion")
    measure = MEASURES[0]
    levels = np.linspace(0.90, 0.93, 7)
    smooth, slopes, last = [], [], result
    for level in levels:
        last = jc.clamp(jc.replace(result.scene, "stop.occlusion", level), guess=last)
        value, gradient = jc.value_and_gradient(last, measure)
        smooth.append(value)
        slopes.append(float(gradient.stop.occlusion))
    h = levels[1] - levels[0]
    # Hermite: the mean of the slopes at both ends of an interval is its difference quotient to O(h**2)
    quotients = np.diff(smooth) / h
    means = 0.5 * (np.array(slopes[1:]) + np.array(slopes[:-1]))
    np.testing.assert_allclose(quotients, means, rtol=2e-2)
