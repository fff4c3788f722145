"""A jaw's profile from a file of points, fitted by a spline whose residual is shown."""

from __future__ import annotations

import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.cli import main
from jaxclamp.scenes.files import dump_scene, loads_scene
from jaxclamp.scenes.notes import notes

JAW = 'clamp.jaw={{ shape = "spline", profile_csv = "{}", edge_radius_mm = 0.8 }}'


def written(tmp_path, text):
    path = tmp_path / "face.csv"
    path.write_text(text, encoding="utf-8")
    return JAW.format(path)


def rows(z, y, header="z_mm,y_mm"):
    return "\n".join(["# a comment", header, *(f"{a:.6f},{b:.6f}" for a, b in zip(z, y, strict=True))])


def test_a_spline_is_found_again(tmp_path):
    slopes = [0.1, 0.3, 0.35, 0.5]
    jaw = jc.load_scene(
        "human-lad", [f"clamp.jaw={{shape='spline', half_width_mm=2, slopes={slopes}, edge_radius_mm=1}}"]
    ).clamp.jaw
    z = np.linspace(-2.0, 2.0, 41)
    height = np.asarray(jaw.height(np.abs(z))[0])
    # heights from another level, in micrometres
    text = rows(z, 1e3 * (height + 5.0), "z_mm,y_um")
    found = jc.load_scene("human-lad", [written(tmp_path, text)]).clamp.jaw
    assert float(found.half_width) == 2.0
    assert np.size(found.slopes) <= 4
    assert float(found.profile_residual) <= 0.002
    again = np.asarray(found.height(np.abs(z))[0])
    np.testing.assert_allclose(again - again[20], height, atol=0.004)


def test_the_residual_is_the_farthest_point(tmp_path):
    """A round bar with one point that is 0.05 mm off: at least half of that is left, whatever the spline."""
    z = np.linspace(0.0, 2.2, 45)
    y = 3.0 - np.sqrt(9.0 - z**2)
    y[20] += 0.05
    scene = jc.load_scene("human-lad", [written(tmp_path, rows(z, y))])
    jaw = scene.clamp.jaw
    assert 0.025 < float(jaw.profile_residual) <= 0.05
    off = np.asarray(jaw.height(z)[0]) - y
    # the fit is free in height
    assert np.ptp(off) / 2.0 <= float(jaw.profile_residual) + 1e-12 <= np.ptp(off) + 1e-12
    assert any("farthest is" in note and "um off" in note for note in notes(scene))
    text = dump_scene(scene)
    assert "profile_csv" not in text
    assert dump_scene(loads_scene(text)) == text


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "it is empty; expected columns z_mm and y_mm"),
        ("z_mm,y_inch\n0,1\n", "line 1: no column y_mm"),
        ("z_mm,y_mm\n0,0\n1,x\n", "line 3, column y_mm: expected a number, found x"),
        ("z_mm,y_mm\n0,0\n1\n", "line 3, column y_mm: expected a number, found nothing"),
        ("z_mm,y_mm\n0,0\n1,1\n2,2\n", "3 distances from the middle; expected 5 or more"),
    ],
)
def test_a_file_that_is_no_profile_is_one_sentence(tmp_path, capsys, text, said):
    assert main(["show", "human-lad", "--set", written(tmp_path, text)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "face.csv" in line
    assert said in line


@pytest.mark.parametrize(
    ("jaw", "said"),
    [
        ('{ shape = "flat", profile_csv = "x.csv" }', 'expected shape = "spline" with it'),
        (
            '{ shape = "spline", profile_csv = "x.csv", slopes = [1.0] }',
            "it stands for slopes, which is there",
        ),
        ('{ shape = "spline", profile_csv = "none.csv", edge_radius_mm = 1 }', "none.csv: No such file"),
        ('{ shape = "spline", profile_csv = 3, edge_radius_mm = 1 }', "expected the path of a CSV file"),
    ],
)
def test_a_profile_that_makes_no_sense_is_one_sentence(capsys, jaw, said):
    assert main(["show", "human-lad", "--set", f"clamp.jaw={jaw}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "clamp.jaw.profile_csv" in line
    assert said in line
