"""Uncertain numbers of a scene: how far figures owe to them, to first order, by hand and by samples."""

from __future__ import annotations

import json

import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.cli import main
from jaxclamp.scenes.address import get
from jaxclamp.show.uncertainty_report import drawn, lines, write_uncertainty
from jaxclamp.trust.estimates import figures
from jaxclamp.trust.uncertainty import load_covariance, sampled, uncertainty

SMALL = ["mesh.circumferential=5", "mesh.axial=8", "mesh.radial=[2, 1]", "stop.occlusion=0.6"]
C, P, R = "artery.layers[0].material.c_kPa", "artery.pressure_kPa", "clamp.jaw.radius_mm"
FORCE, PEAK = "clamp_force_N", "smooth_peak_axial_stress_kPa.media"
TABLES = "".join(
    f'[[parameters]]\nkey = "{k}"\n{sd}\n' for k, sd in ((C, "relative_sd = 0.05"), (P, "sd = 0.3"))
)


@pytest.fixture(scope="module")
def result():
    return jc.clamp(jc.load_scene("human-lad", SMALL))


def written(tmp_path, text, name="cov.toml"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def by_hand(result, path, step):
    """Slopes of all figures by a number, from clampings on both sides."""
    value = get(result.scene, path)
    sides = [figures(jc.clamp(jc.replace(result.scene, path, value + s * step))) for s in (1.0, -1.0)]
    return {key: (sides[0][key] - sides[1][key]) / (2.0 * step) for key in sides[0]}


def test_first_order_is_what_clampings_beside_it_give(result, tmp_path):
    """sd^2 = sum of (slope times sd)^2; with a correlation of 0.5, plus the product of both parts."""
    covariance = load_covariance(written(tmp_path, TABLES), result.scene)
    np.testing.assert_allclose(covariance.sd, [1.35, 0.3])
    found = uncertainty(result, covariance)
    slopes = [
        by_hand(result, path, 1e-3 * sd) for path, sd in zip(covariance.paths, covariance.sd, strict=True)
    ]
    for key in (FORCE, PEAK, "physiological.lumen_radius_mm", "damage.media"):
        parts = [slope[key] * sd for slope, sd in zip(slopes, covariance.sd, strict=True)]
        np.testing.assert_allclose(list(found.parts[key].values()), parts, rtol=2e-4)
        assert found.sd[key] == pytest.approx(np.hypot(*parts), rel=2e-4)
    both = written(tmp_path, "correlation = [[1, 0.5], [0.5, 1]]\n" + TABLES)
    a, b = found.parts[FORCE].values()
    together = uncertainty(result, load_covariance(both, result.scene)).sd[FORCE]
    assert together == pytest.approx(np.sqrt(a * a + b * b + a * b), rel=1e-9)


@pytest.mark.slow
def test_samples_agree_with_first_order(result, tmp_path):
    """100 samples know a standard deviation to 7 %; the numbers vary little enough for first order."""
    found = uncertainty(result, load_covariance(written(tmp_path, TABLES), result.scene))
    found = sampled(found, result, 100)
    assert found.samples == 100
    for key in (FORCE, PEAK):
        assert found.sampled[key] == pytest.approx(found.sd[key], rel=0.1)


def test_what_is_written(result, tmp_path):
    covariance = load_covariance(written(tmp_path, 'source = "a cuff"\n' + TABLES), result.scene)
    found = sampled(uncertainty(result, covariance), result, 2)
    files = write_uncertainty(found, result, tmp_path)
    assert [file.name for file in files] == ["uncertainty.json", "tornado.png", "tornado.svg"]
    content = json.loads(files[0].read_text())
    assert content["figures"][FORCE]["sd"] == found.sd[FORCE]
    assert content["samples"] == 2
    assert content["source"] == "a cuff"
    assert drawn(found) == [PEAK, FORCE, "axial_stress_at_P_kPa"]
    assert any(line.split()[0] == FORCE for line in lines(found, result)[2:])


def test_a_fit_is_taken(result, tmp_path):
    content = {"parameters": {C: {"value": 27.0}, P: {}}, "covariance": [[4.0, 0.1], [0.1, 0.09]]}
    covariance = load_covariance(written(tmp_path, json.dumps(content), "fit.json"), result.scene)
    np.testing.assert_allclose(covariance.matrix, [[4.0, 0.1], [0.1, 0.09]])
    content["ties"] = ["adventitia.c = 0.1 * media.c"]
    with pytest.raises(jc.SceneError, match="the fit has ties"):
        load_covariance(written(tmp_path, json.dumps(content), "fit.json"), result.scene)


def test_angles_are_in_degrees(result, tmp_path):
    text = '[[parameters]]\nkey = "artery.layers[0].opening_angle_deg"\nsd = 18.0\n'
    assert load_covariance(written(tmp_path, text), result.scene).sd[0] == pytest.approx(np.pi / 10)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "expected [[parameters]] tables"),
        ("[[parameters]]\nkey = 'a'\n", "parameters[0]: expected key, and either sd or relative_sd"),
        (TABLES.replace("c_kPa", "cc_kPa"), "cc_kPa"),
        (TABLES.replace("sd = 0.3", "sd = -1"), "parameters[1].sd = -1: expected a positive number"),
        ("correlation = [[1, 2], [2, 1]]\n" + TABLES, "the covariance is not positive"),
        ("correlation = [[1]]\n" + TABLES, "correlation: expected 2 rows of 2"),
        (TABLES.replace(P, C), "a parameter is named twice"),
        ("sds = 1\n" + TABLES, "unknown key"),
        ("source = 1\n" + TABLES, "source = 1: expected a text"),
    ],
)
def test_a_wrong_file_is_one_sentence_and_exit_code_2(tmp_path, capsys, text, said):
    path = written(tmp_path, text)
    assert main(["run", "human-lad", "--uncertainty", str(path), "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"jaxclamp: {path}: ")
    assert said in line
    assert not (tmp_path / "out").exists()


def test_samples_of_nothing_are_refused(capsys):
    assert main(["run", "human-lad", "--samples", "3", "--json"]) == 2
    assert "without --uncertainty" in capsys.readouterr().err
