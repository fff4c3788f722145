"""Injury: damage against its formula in NumPy, strain gradients in closed form, thresholds against counts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxclamp as jc
from directions import dot, drawn, moved, tight
from jaxclamp.observe.injury import (
    LEAST_SHARE,
    ONSET_STRETCH,
    axial_strain_gradient,
    damage_of_constituent,
    damage_of_energies,
)
from jaxclamp.pictures.fields import layer_fields
from jaxclamp.scenes.files import loads_scene
from jaxclamp.scenes.schema import toml_value
from jaxclamp.show.console import summary
from jaxclamp.show.report import page
from jaxclamp.solve.clamping import inflate
from laws import every_law

THRESHOLDS = """
[[injury]]
measure = "axial_stress"
layer = "media"
threshold_kPa = 15.0
source = "made up, as every number of this test"

[[injury]]
measure = "circumferential_stress"
layer = "adventitia"
threshold_kPa = 30.0
source = "made up"

[[injury]]
measure = "contact_pressure_excess"
threshold_kPa = 5.0
source = "made up"
"""
SMALL = ["mesh.circumferential=4", "mesh.axial=6", "mesh.radial=[1,1]", "stop.occlusion=0.7"]


def scene_with(thresholds: str = THRESHOLDS, overrides=SMALL) -> jc.Scene:
    return loads_scene(jc.dump_scene(jc.load_scene("human-lad", SMALL)) + thresholds, overrides=overrides)


@pytest.fixture(scope="module")
def result():
    return jc.clamp(tight(scene_with()))


# --- damage -------------------------------------------------------------------------------------------------


def test_the_law_of_damage():
    """0 up to the energy in the body, 1 from s of its root on, 1/2 half way, smooth twice at both ends."""
    s = 1.3
    D = lambda root: damage_of_constituent(jnp.asarray(root**2), s)
    np.testing.assert_allclose(
        [D(r) for r in (0.0, 0.5, 1.0, 1.15, 1.3, 5.0)], [0, 0, 0, 0.5, 1, 1], atol=1e-15
    )
    slope, curvature = jax.grad(D), jax.grad(jax.grad(D))
    for end in (1.0, s):
        inside = end + np.array([-1e-6, 1e-6])
        np.testing.assert_allclose([slope(r) for r in inside], 0.0, atol=1e-7)
        np.testing.assert_allclose([curvature(r) for r in inside], 0.0, atol=1e-2)
    assert curvature(1.05) > 10.0  # what the bounds above are small beside
    assert np.isfinite(jax.grad(lambda r: damage_of_constituent(r, s))(0.0))


@every_law
def test_no_slope_is_undefined_where_nothing_is_strained(law):
    """At rest, squeezed until no fibre carries, and from rest to a stretch."""
    rest = jnp.eye(3)[:, :, None, None]
    squeezed = jnp.diag(jnp.asarray([1.21, 1 / 1.1, 1 / 1.1]))[:, :, None, None]
    stretched = jnp.diag(jnp.asarray([1 / 1.21, 1.1, 1.1]))[:, :, None, None]

    def damage(law, before, now):
        parts = (law.constituents(F) for F in (before, now))
        return jnp.sum(damage_of_energies(*parts, jnp.ones((1, 1)), 1e-6 * law.c, ONSET_STRETCH))

    for before in (rest, squeezed, stretched):
        for now in (rest, squeezed, stretched):
            value, slopes = jax.value_and_grad(damage, argnums=(0, 1, 2))(law, before, now)
            assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree_util.tree_leaves((value, slopes)))
    assert damage(law, stretched, stretched) == 0.0
    assert damage(law, rest, stretched) == pytest.approx(1.0)  # the body carries nothing there


def hgo_energies(material, F):
    """Eq. (4) of the paper of 2002 in NumPy, by constituent."""
    c, k1, k2, b = (float(getattr(material, name)) for name in ("c", "k1", "k2", "fibre_angle"))
    J = np.linalg.det(np.moveaxis(F, (0, 1), (-2, -1)))
    C_bar = np.einsum("ki...,kj...->ij...", F, F) * J ** (-2.0 / 3.0)
    found = [c / 2.0 * (np.trace(C_bar) - 3.0)]
    for sign in (1.0, -1.0):
        a = np.array([0.0, np.cos(b), sign * np.sin(b)])
        E = np.maximum(np.einsum("i,ij...,j->...", a, C_bar, a) - 1.0, 0.0)
        found.append(k1 / (2.0 * k2) * np.expm1(k2 * E**2))
    return found


@pytest.mark.parametrize("layer", ["media", "adventitia"])
def test_damage_is_the_share_of_energy_that_its_formula_says(result, layer):
    number = result.model.marks.layer(layer)
    material, e = result.scene.artery.layers[number].material, result.equilibria
    dV = np.asarray(jc.volumes(e, layer))
    before, now = (
        hgo_energies(material, np.asarray(jc.deformation_gradient(seen, layer))) for seen in (e.in_body, e)
    )
    lost = 0.0
    for psi_0, psi in zip(before, now, strict=True):
        base = np.maximum(psi_0, LEAST_SHARE * np.sum(dV * psi_0) / np.sum(dV))
        x = np.clip((np.sqrt(psi / base) - 1.0) / (ONSET_STRETCH - 1.0), 0.0, 1.0)
        lost = lost + x**3 * (10.0 - 15.0 * x + 6.0 * x**2) * psi
    expected = lost / sum(now)
    assert 0.3 < np.max(expected) < 1.0  # there is something to compare
    np.testing.assert_allclose(jc.damage_at_points(e, layer), expected, rtol=1e-9, atol=1e-12)
    mean = np.sum(dV * expected) / np.sum(dV)
    assert result.final["damage"][layer] == pytest.approx(mean, rel=1e-9)
    assert result.measure(jc.mean_damage(layer)) == pytest.approx(mean, rel=1e-9)
    norm = (np.sum(dV * expected**40) / np.sum(dV)) ** (1 / 40)
    assert result.measure(jc.smooth_peak_damage(layer)) == pytest.approx(norm, rel=1e-9)
    assert result.measure(jc.mean_damage(layer, 1.26)) > mean


def test_nothing_is_damaged_in_the_body(result):
    assert result.history[0]["damage"] == {"media": 0.0, "adventitia": 0.0}


@pytest.mark.parametrize("onset", [1.0, 0.5, float("nan"), float("inf")])
def test_an_onset_that_is_none_is_refused(onset):
    with pytest.raises(ValueError, match="expected a number above 1"):
        jc.mean_damage("media", onset)


# --- stress, contact, strain -----------------------------------------------------------------------------


def test_the_axial_stress_ratio(result):
    peak = jc.smooth_peak_axial_stress("media")
    before = float(peak(result.equilibria.in_body))
    expected = result.measure(peak) / before
    assert expected > 1.2
    assert result.measure(jc.smooth_peak_axial_stress_ratio("media")) == pytest.approx(expected, rel=1e-12)


def test_excess_is_over_blood_pressure(result):
    pressure, area = map(np.asarray, jc.contact_pressures(result.equilibria))
    excess = np.maximum(pressure - float(result.scene.artery.pressure), 0.0)
    expected = (np.sum(area * excess**40) / np.sum(area)) ** (1 / 40)
    assert result.measure(jc.smooth_peak_contact_pressure_excess()) == pytest.approx(expected, rel=1e-9)


def test_the_strain_gradient_of_a_known_stretch():
    """z' = z + b z^2 has d/dz log(dz'/dz) = 2 b / (1 + 2 b z): met to second order in the elements' size."""
    b, errors = 0.01, []
    for axial in (6, 12):
        counts = [*SMALL, f"mesh.axial={axial}", "mesh.axial_grading=0.0"]
        e = inflate(jc.load_scene("human-lad", counts)).equilibria
        z = e.body.x[:, 2]
        drawn_out = dataclasses.replace(e.body, x=e.body.x.at[:, 2].set(z + b * z**2))
        known = dataclasses.replace(e, states=(e.body, drawn_out))
        gradient, length = axial_strain_gradient(known)
        between = np.asarray(z[e.marks.P_line])[1:-1]
        expected = 2.0 * b / (1.0 + 2.0 * b * between)
        errors.append(np.max(np.abs(gradient / expected - 1.0)))
        norm = (np.sum(length * expected**40) / np.sum(length)) ** (1 / 40)
        assert float(jc.smooth_peak_axial_strain_gradient()(known)) == pytest.approx(norm, rel=errors[-1])
    assert errors[0] < 2e-2
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.25)


# --- thresholds ---------------------------------------------------------------------------------------------


def test_thresholds_are_counted_at_the_points(result):
    e = result.equilibria
    axial, hoop, excess = result.final["injury"]
    for found, layer, component in ((axial, "media", "axial"), (hoop, "adventitia", "circumferential")):
        stress, dV = np.asarray(getattr(jc.stresses(e, layer), component)), np.asarray(jc.volumes(e, layer))
        above = np.sum(dV[stress > found["threshold_kPa"]]) / np.sum(dV)
        assert 0.0 < above < 1.0
        assert found["share_above"] == pytest.approx(above, rel=1e-12)
        assert found["peak_over_threshold"] == pytest.approx(np.max(stress) / found["threshold_kPa"])
    assert (axial["measure"], axial["layer"]) == ("axial_stress", "media")
    assert axial["source"] == "made up, as every number of this test"
    assert (excess["layer"], excess["threshold_kPa"]) == (None, 5.0)
    highest = result.final["max_contact_pressure_kPa"] - 13.33
    assert excess["peak_over_threshold"] == pytest.approx(highest / 5.0, rel=1e-12)
    assert 0.0 < excess["share_above"] < 1.0
    in_body = result.history[0]["injury"][2]
    assert (in_body["share_above"], in_body["peak_over_threshold"]) == (0.0, 0.0)  # no contact


def test_thresholds_are_columns_of_the_history(result):
    table = result.history_table()
    shares = table["injury[0].share_above"]
    np.testing.assert_array_equal(shares, [record["injury"][0]["share_above"] for record in result.history])
    assert not any("source" in name for name in table)


def test_the_slope_by_a_threshold(result):
    """A peak over it falls with it; the adjoint takes the thresholds from the scene."""
    measure = jc.peak_over_threshold(2)
    value, slopes = jc.value_and_gradient(result, measure)
    assert value == pytest.approx(result.measure(measure), rel=1e-12)
    assert [float(slope.threshold) for slope in slopes.injury] == pytest.approx([0.0, 0.0, -value / 5.0])
    assert [slope.source for slope in slopes.injury] == [given.source for given in result.scene.injury]


@pytest.mark.slow
def test_slopes_of_what_has_a_threshold(result):
    """Of share and peak, by the threshold itself and through the equilibrium, against differences."""
    measures = (jc.share_above_threshold(0), jc.peak_over_threshold(2), jc.peak_over_threshold(0))
    scene = result.scene
    direction = drawn(scene, ("injury[0].threshold", "injury[2].threshold", "clamp.jaw"), seed=1)
    exact = np.array([dot(jc.value_and_gradient(result, m)[1], direction) for m in measures])
    errors = []
    for h in (1e-3, 1e-4, 1e-5):
        ends = [jc.clamp(moved(scene, direction, s * h), guess=result) for s in (1.0, -1.0)]
        ahead, behind = (np.array([r.measure(m) for m in measures]) for r in ends)
        errors.append(np.abs((ahead - behind) / (2 * h) - exact) / np.abs(exact))
    assert np.all(np.min(errors, axis=0) < 1e-6)
    again = jax.grad(lambda t: jc.evaluate(jc.replace(scene, "injury[0].threshold", t), measures[2]))(15.0)
    assert float(again) == pytest.approx(-result.measure(measures[2]) / 15.0, rel=1e-9)


def test_a_threshold_that_is_not_there(result):
    with pytest.raises(IndexError, match=r"the scene has 3 \[\[injury\]\]: there is no number 3"):
        result.measure(jc.peak_over_threshold(3))


def test_thresholds_change_nothing_else(result):
    bare = dataclasses.replace(result.scene, injury=())
    without = jc.clamp(bare)
    assert without.final["injury"] == []
    for key, value in without.final.items():
        if key != "injury":
            assert value == result.final[key], key
    assert (
        jc.clamp(result.scene, guess=without).solver["newton_iterations"] < 10
    )  # a neighbour, not a stranger


def test_a_saved_result_has_its_thresholds(result, tmp_path):
    again = jc.load_result(result.save(tmp_path / "run.h5"))
    assert again.final == result.final
    assert again.scene == result.scene


# --- scene files --------------------------------------------------------------------------------------------


def test_a_scene_with_thresholds_survives_its_file():
    scene = scene_with()
    assert [given.threshold for given in scene.injury] == [15.0, 30.0, 5.0]
    assert loads_scene(jc.dump_scene(scene)) == scene
    assert scene_with(overrides=["injury[1].threshold_kPa=12.5"]).injury[1].threshold == 12.5
    assert jc.replace(scene, "injury[0].threshold_kPa", 20.0).injury[0].threshold == 20.0
    assert "injury" not in jc.dump_scene(jc.load_scene("human-lad"))


GOOD = {"measure": "axial_stress", "layer": "media", "threshold_kPa": 196.0, "source": "Anttila 2019"}


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"layer": "medai"}, "injury[0].layer = \"medai\": expected a layer for axial_stress: one of media, "
         "adventitia; did you mean media?"),
        ({"layer": None}, "injury[0].layer = \"\": expected a layer for axial_stress"),
        ({"measure": "contact_pressure"}, "injury[0].layer = \"media\": expected no layer"),
        ({"measure": "axial"}, "injury[0].measure = \"axial\": expected one of \"axial_stress\""),
        ({"measure": None}, "injury[0].measure is missing"),
        ({"threshold_kPa": 0.0}, "injury[0].threshold_kPa = 0.0: expected a number greater than 0 kPa"),
        ({"threshold_kPa": float("nan")}, "injury[0].threshold_kPa = nan: expected a number"),
        ({"threshold_kPa": "high"}, "injury[0].threshold_kPa = \"high\": expected a number"),
        ({"threshold_kPa": None}, "injury[0].threshold_kPa is missing"),
        ({"source": None}, "injury[0].source is missing: expected a text"),
        ({"source": "  "}, "injury[0].source = \"  \": expected where the threshold comes from"),
        ({"source": 2019}, "injury[0].source = 2019: expected a text"),
        ({"treshold_kPa": 1.0}, "unknown key injury[0].treshold_kPa; did you mean threshold_kPa?"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_one_sentence(changed, said):
    table = {key: value for key, value in (GOOD | changed).items() if value is not None}
    text = "[[injury]]\n" + "".join(f"{key} = {toml_value(value)}\n" for key, value in table.items())
    with pytest.raises(jc.SceneError) as caught:
        scene_with(text)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("given", ["injury = 3", "injury = []", "injury = [3]", "[injury]\nlayer = 'media'"])
def test_a_list_of_thresholds_is_a_list_of_tables(given):
    text = jc.dump_scene(jc.load_scene("human-lad", SMALL))
    with pytest.raises(jc.SceneError, match="injury"):
        loads_scene(f"{given}\n{text}" if "=" in given.split("\n")[0] else f"{text}\n{given}")


def test_a_scene_made_in_python_is_held_to_the_same():
    given = jc.InjuryThreshold(measure="axial_stress", layer="intima", threshold=5.0, source="made up")
    scene = dataclasses.replace(jc.load_scene("human-lad", SMALL), injury=(given,))
    with pytest.raises(jc.SceneError, match="one of media, adventitia"):
        jc.clamp(scene)


# --- what a reader sees -------------------------------------------------------------------------------------


def test_console_and_page_say_above_your_threshold_and_give_no_verdict(result):
    content = result.to_dict()
    text = "\n".join(summary(content, []))
    share, peak = (content["final"]["injury"][0][key] for key in ("share_above", "peak_over_threshold"))
    line = f"axial stress, media: {share:.2%} of the volume above 15 kPa, peak {peak:.3g} of it"
    assert f"{line} (made up, as every number of this test)" in text
    assert "contact pressure excess, under the jaws" in text
    assert f"{'damage, media':<36}{content['final']['damage']['media']:>10.4g}" in text
    web = page(result, [])
    for said in ("Above your thresholds", "as every number of this test", f"{share:.2%} of the volume"):
        assert said in web
    for verdict in ("safe", "unsafe", "injured tissue", "acceptable", "dangerous"):
        assert verdict not in text + web
    bare = summary({"final": content["final"] | {"injury": []}}, [])
    assert not any("threshold" in line for line in bare)


def test_nodes_show_the_damage_of_the_points_around(result):
    """Fields of files and maps: 0 in the body, within 0 and 1, and in the mean what the figure says."""
    kept, body = result.states[-1], result.physiological
    assert result.in_body_like(kept) is body
    for layer in layer_fields(kept.model, kept.state, body=body.state):
        values = layer.point_data["damage"]
        assert np.min(values) >= 0.0
        assert 0.2 < np.max(values) <= 1.0
        mean = np.sum(values * layer.volumes) / np.sum(layer.volumes)
        assert mean == pytest.approx(result.final["damage"][layer.name], rel=0.3)  # the mesh is coarse
    for layer in layer_fields(body.model, body.state, body=body.state):
        assert np.max(layer.point_data["damage"]) == 0.0
    coarse = result.on_the_way[0]
    assert result.in_body_like(coarse).model is coarse.model
