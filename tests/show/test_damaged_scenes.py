"""`jaxclamp show` with damaged scene files: an exit code and one sentence, whatever they hold."""

from __future__ import annotations

import tomllib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from damage import REPEATABLE, bounded, edit, scratch
from jaxclamp.cli import main
from jaxclamp.scenes.presets import presets
from jaxclamp.scenes.schema import bare, toml_value

TEXTS = {p.name: p.text for p in presets() if p.kind == "scene"} | {
    "inline": """
title = "all in one"
clamp.jaw = { shape = "spline", half_width_mm = 2.0, edge_radius_mm = 0.3, slopes = [0.0, 0.1, 0.4] }
stop = { force_N = 0.5 }
mesh = { circumferential = 5, axial = 8, radial = [3] }
contact = { stiffness_kPa_per_mm = 2000.0, smoothing_mm = 0.01 }
solver = { tolerance = 1e-9 }
artery.length_mm = 40.0
artery.axial_stretch = 1.3
artery.pressure_kPa = 13.3
[[artery.layers]]
name = "media"
inner_radius_mm = 3.0
thickness_mm = 0.5
opening_angle_deg = 120.0
material = { law = "neo-hookean", c_kPa = 27.0, bulk_kPa = 1e4 }
"""
}


@st.composite
def damaged_scenes(draw):
    """Bytes of a scene file that was edited or scratched."""
    text = TEXTS[draw(st.sampled_from(sorted(TEXTS)))]
    if draw(st.booleans()):
        table = edit(draw, tomllib.loads(text))
        text = "".join(f"{bare(key)} = {toml_value(value)}\n" for key, value in table.items())
        return text.encode("utf-8", "surrogatepass")
    return scratch(draw, text.encode())


@pytest.mark.parametrize("count", [40, pytest.param(400, marks=pytest.mark.slow)])
def test_no_scene_file_leads_to_a_traceback(count, tmp_path, capsys):
    codes = []

    @settings(max_examples=count, **REPEATABLE)
    @given(damaged_scenes())
    def show(content):
        (tmp_path / "scene.toml").write_bytes(content)
        with bounded():
            codes.append(main(["show", str(tmp_path / "scene.toml")]))
        said = capsys.readouterr()
        assert codes[-1] in (0, 2)
        assert (len(said.err.splitlines()), bool(said.out)) == ((0, True) if codes[-1] == 0 else (1, False))
        assert len(said.err) < 2000

    show()
    assert codes.count(2) > 0.5 * count, "damage was done"


def test_the_texts_are_sound(tmp_path):
    """So that refusals are for the damage."""
    for text in TEXTS.values():
        (tmp_path / "scene.toml").write_text(text)
        assert main(["show", str(tmp_path / "scene.toml")]) == 0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (".".join("a" * 20_000) + " = 1", "line 1 has a key of more than 32 parts"),
        ("\n[" + " . ".join(["'a'"] * 20_000) + "]", "line 2 has a key of more than 32 parts"),
        ("a = {" + '."\\"".'.join("b" * 20_000) + " = 1}", "line 1 has a key of more than 32 parts"),
        ("a = " + "[" * 200_000, "not valid TOML"),
        ("a = " + "{a=" * 200_000, "not valid TOML"),
        ("#" * 1_000_001, "at most 1000 kB"),
    ],
)
def test_what_costs_a_parser_much_is_refused_at_once(text, said, tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(text)
    with bounded():
        assert main(["show", str(tmp_path / "scene.toml")]) == 2
    assert said in capsys.readouterr().err


def test_an_override_that_costs_much_is_refused_at_once(capsys):
    with bounded():
        assert main(["show", "human-lad", "--set", "artery={" + ".".join("a" * 20_000) + "=1}"]) == 2
    assert "override" in capsys.readouterr().err
