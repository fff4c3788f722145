"""Contact that fits the wall, where a scene states none."""

from __future__ import annotations

import pytest

import jaxclamp as jc
from jaxclamp.scenes.files import loads_scene
from jaxclamp.scenes.fitting import fitting_contact
from jaxclamp.show.description import describe

SCENE = """artery = "human-lad-wall"
[clamp]
jaw = "cylinder-3mm"
[stop]
occlusion = 0.5
"""


def test_the_rule():
    """c = 27 kPa (the media's), p = 13.33 kPa, H = 0.493 + 0.247 mm: (27 + 13.33) / 0.0074 = 5450 kPa/mm."""
    contact = loads_scene(SCENE).contact
    assert contact.stiffness == pytest.approx(5450.0, rel=1e-12)
    assert contact.smoothing == pytest.approx(0.0074, rel=1e-12)


def test_stated_keys_stay():
    contact = loads_scene(SCENE + "[contact]\nsmoothing_mm = 0.02\n").contact
    assert contact.smoothing == 0.02
    assert contact.stiffness == pytest.approx(5450.0, rel=1e-12)


def test_presets_state_theirs():
    """Their published figures were measured with it."""
    for name in ("human-lad", "human-lad-eq10", "rabbit-carotid"):
        contact = jc.load_scene(name).contact
        assert (contact.stiffness, contact.smoothing) == (2000.0, 0.01), name
    assert jc.load_scene("mouse-aorta").contact.stiffness == 40000.0


def test_it_follows_overrides_of_the_artery_but_not_replacements():
    thick = loads_scene(SCENE, overrides=["artery.layers[0].thickness_mm=0.6"])
    assert thick.contact.smoothing == pytest.approx(0.00847, rel=1e-12)
    thin = jc.replace(thick, "artery.layers[0].thickness", 0.3)
    assert thin.contact == thick.contact


def test_it_stays_in_the_range_of_the_keys():
    """A wall of 1100 mm would be smoothed over 11 mm; a file may state 10 at most."""
    layers = (jc.replace(loads_scene(SCENE).artery.layers[0], "thickness", 1100.0),)
    assert fitting_contact(jc.replace(loads_scene(SCENE).artery, "layers", layers)).smoothing == 10.0


def test_show_says_which_and_why():
    assert describe(loads_scene(SCENE))["contact"].startswith(
        "5450 kPa/mm, smoothed over 0.0074 mm: fits the wall"
    )
    stated = describe(jc.load_scene("human-lad"))["contact"]
    assert stated == (
        "2000 kPa/mm, smoothed over 0.01 mm, as stated (by the wall: 5450 kPa/mm, smoothed over 0.0074 mm)"
    )
