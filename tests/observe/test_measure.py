"""Arithmetic with measures: values and slopes as of the parts, units checked, names that say what it is."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxclamp as jc

SMALL = ["mesh.circumferential=4", "mesh.axial=6", "mesh.radial=[1,1]", "stop.occlusion=0.6"]

peak, force, share = jc.smooth_peak_axial_stress("media"), jc.clamp_force(), jc.volume_above("media", 20.0)
height, energy = jc.lumen_height(), jc.stored_energy()


@pytest.fixture(scope="module")
def result():
    return jc.clamp(jc.load_scene("human-lad", SMALL))


@pytest.mark.parametrize(
    ("made", "name", "unit"),
    [
        (
            peak + 0.1 * force / jc.N,
            "smooth_peak_axial_stress(axial, media) + 0.1 * clamp_force() / N",
            "kPa",
        ),
        (
            peak / jc.kPa + 0.1 * force / jc.N,
            "smooth_peak_axial_stress(axial, media) / kPa + 0.1 * clamp_force() / N",
            "",
        ),
        (
            (peak + 3 * jc.kPa) * height,
            "(smooth_peak_axial_stress(axial, media) + 3 * kPa) * lumen_height()",
            "mN/mm",
        ),
        (peak - (peak - peak), f"{peak} - ({peak} - {peak})", "kPa"),
        (-force / (height * height), "-1 * clamp_force() / (lumen_height() * lumen_height())", "kPa"),
        (energy / height - force, "stored_energy() / lumen_height() - clamp_force()", "mN"),
        (height**2, "lumen_height() ** 2", "mm2"),
        (force**2 / height, "clamp_force() ** 2 / lumen_height()", "mm^-1 mN^2"),
        ((force**2 / height) / force, "clamp_force() ** 2 / lumen_height() / clamp_force()", "mN/mm"),
        (1.0 / height, "1 / lumen_height()", "1/mm"),
        (np.float64(2.0) * share, "2 * volume_above(media, 20.0)", ""),
        (jnp.asarray(2.0) * share - 1, "2 * volume_above(media, 20.0) - 1", ""),
        (share**0.5, "volume_above(media, 20.0) ** 0.5", ""),
    ],
)
def test_a_combination_says_what_it_is_and_in_what_unit(made, name, unit):
    assert (str(made), made.unit) == (name, unit)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: peak + force, "kPa and mN do not add; divide each by a unit first"),
        (lambda: height - peak, "mm and kPa do not add"),
        (lambda: peak - 30, "the number 30 has no unit, expected one in kPa, such as 30 * jaxclamp.kPa"),
        (lambda: 1.0 + force, "the number 1 has no unit, expected one in mN"),
        (lambda: peak + jc.clamp_force, "the function clamp_force; call it"),
        (lambda: peak * "2", "expected a measure, found '2'"),
        (lambda: height**0.5, "expected a whole number as the power of a measure in mm"),
        (lambda: height**height, "expected a whole number as the power"),
        (lambda: peak * np.ones(2), "expected a measure, found array"),
    ],
)
def test_what_does_not_fit_is_one_sentence(make, said):
    with pytest.raises(TypeError) as caught:
        make()
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_number_that_is_none_is_refused():
    with pytest.raises(ValueError, match="expected a finite number"):
        float("nan") * peak


def test_a_traced_weight_is_one_sentence():
    with pytest.raises(TypeError, match="weigh its value"):
        jax.grad(lambda w: w * peak)(1.0)


def test_a_measure_in_a_unit_of_ones_own_is_left_alone_until_it_is_combined():
    own = jc.Measure("own", "furlong", lambda e: e.last.q[0])
    with pytest.raises(ValueError, match="unit 'furlong': expected an internal unit"):
        own + height


def test_combinations_are_values():
    again = jc.smooth_peak_axial_stress("media") + 0.1 * jc.clamp_force() / jc.N
    made = peak + 0.1 * force / jc.N
    assert made == again
    assert hash(made) == hash(again)
    assert made != peak + 0.2 * force / jc.N
    assert pickle.loads(pickle.dumps(made)) == made
    assert not (jc.physiological_lumen_radius() / jc.mm).needs_stop
    assert made.needs_stop


@pytest.mark.slow
def test_values_and_slopes_are_those_of_the_parts(result):
    price = peak / jc.kPa + 0.1 * force / jc.N
    product = (force / height) ** 2
    path = ["clamp.jaw.radius"]
    values, slopes = jc.gradients(result, [peak, force, height, price, product], path)
    p, f, h = values[:3]
    dp, df, dh = slopes[:3, 0]
    np.testing.assert_allclose(values[3:], [p + 0.1 * f / 1e3, (f / h) ** 2], rtol=1e-12)
    quotient = 2.0 * (f / h) * (df / h - f * dh / h**2)
    np.testing.assert_allclose(slopes[3:, 0], [dp + 0.1 * df / 1e3, quotient], rtol=1e-8)
    assert result.measure(price) == pytest.approx(values[3], rel=1e-12)


def test_values_are_those_of_the_parts(result):
    p, f, h = (result.measure(m) for m in (peak, force, height))
    made = (peak + 0.1 * force / jc.N, peak / jc.kPa - 2, (force / height) ** 2, -height, 1 / height)
    expected = [p + 0.1 * f / 1e3, p - 2.0, (f / h) ** 2, -h, 1.0 / h]
    np.testing.assert_allclose([result.measure(m) for m in made], expected, rtol=1e-12)


def test_a_measure_of_ones_own_reads_the_points(result):
    """Against the shipped ones, and the mean of sigma's trace over the volume against its components."""

    def highest(e):
        return jc.smooth_maximum(jc.cauchy_stress(e, "media")[2, 2], jc.volumes(e, "media"))

    def mean_J(e):
        dV = jc.volumes(e, "media")
        return (
            jnp.sum(jnp.linalg.det(jnp.moveaxis(jc.deformation_gradient(e, "media"), (0, 1), (2, 3))) * dV)
            / dV.sum()
        )

    def pressed(e):
        pressure, area = jc.contact_pressures(e)
        return jnp.sum(pressure * area)

    own = jc.Measure("own_peak", "kPa", highest)
    (value, shipped), slopes = jc.gradients(result, [own, peak], ["clamp.jaw.radius"])
    assert value == pytest.approx(shipped, rel=1e-12)
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-9)
    assert result.measure(jc.Measure("mean_J", "", mean_J)) == pytest.approx(1.0, abs=5e-3)
    # on an eighth of the artery lies a quarter of a jaw; the pressed wall is not quite level
    assert 4.0 * result.measure(jc.Measure("pressed", "mN", pressed)) == pytest.approx(
        result.measure(force), rel=0.05
    )
    stresses = jc.stresses(result.equilibria, "media")
    np.testing.assert_allclose(jc.cauchy_stress(result.equilibria, "media")[2, 2], stresses.axial, rtol=1e-12)
    with pytest.raises(KeyError, match="expected one of media, adventitia"):
        jc.stresses(result.equilibria, "medya")
