"""Several measures at once: their values, their derivatives by chosen floats, and what is refused."""

from __future__ import annotations

import functools

import numpy as np
import pytest

import jaxclamp as jc

SMALL = ["mesh.circumferential=3", "mesh.axial=6", "mesh.radial=[1, 1]", "stop.occlusion=0.4"]
JAW = 'clamp.jaw={shape="spline", half_width_mm=2.0, slopes=[0.6, 0.8], edge_radius_mm=1.0}'
MEASURES = (jc.clamp_force(), jc.lumen_width(), jc.physiological_lumen_radius())
PATHS = ("artery.layers[1].material.c", "clamp.jaw.slopes", "stop.occlusion")


@functools.cache
def clamped() -> jc.Result:
    return jc.clamp(jc.load_scene("human-lad", [*SMALL, JAW]))


def test_floats_come_in_the_order_of_their_paths_and_lists_item_by_item():
    values, slopes = jc.gradients(clamped(), MEASURES, PATHS)
    assert (values.shape, slopes.shape) == ((3,), (3, 4))
    for measure, value, row in zip(MEASURES, values, slopes, strict=True):
        alone, gradient = jc.value_and_gradient(clamped(), measure)
        assert value == alone
        c, jaw, stop = gradient.artery.layers[1].material.c, gradient.clamp.jaw, gradient.stop
        np.testing.assert_array_equal(row, [c, *jaw.slopes, stop.occlusion])


@pytest.mark.parametrize(("path", "column"), [("artery.layers[1].material.c", 0), ("stop.occlusion", 3)])
def test_derivatives_agree_with_differences(path, column):
    """Central differences of whole solutions, with a step of 1e-4 of the float."""
    scene, slopes = clamped().scene, jc.gradients(clamped(), MEASURES, PATHS)[1]
    at = float(scene.stop.occlusion if path == "stop.occlusion" else scene.artery.layers[1].material.c)
    h = 1e-4 * at
    ahead, behind = (
        np.array([near.measure(measure) for measure in MEASURES])
        for near in (jc.clamp(jc.replace(scene, path, at + s * h), guess=clamped()) for s in (1.0, -1.0))
    )
    np.testing.assert_allclose(slopes[:, column], (ahead - behind) / (2.0 * h), rtol=1e-5, atol=1e-7)


def test_without_paths_there_is_a_scene_of_derivatives_for_each_measure():
    values, scenes = jc.gradients(clamped(), MEASURES[:2])
    assert values.shape == (2,)
    assert isinstance(scenes, tuple)
    _, expected = jc.value_and_gradient(clamped(), MEASURES[1])
    assert scenes[1].artery.pressure == expected.artery.pressure


def test_nothing_asked_is_nothing_found():
    values, slopes = jc.gradients(clamped(), [], PATHS)
    assert (values.shape, slopes.shape) == ((0,), (0, 4))
    assert jc.gradients(clamped(), MEASURES[:1], [])[1].shape == (1, 0)


@pytest.mark.parametrize(
    ("measures", "said"),
    [
        (
            jc.clamp_force(),
            r"^measures: expected a list of measures, found the measure clamp_force\(\) alone",
        ),
        (jc.clamp_force, r"^measures: expected a list .* the function clamp_force; call it"),
        ([jc.lumen_width(), jc.clamp_force], r"^measures\[1\]: expected a measure, .* call it"),
        (["clamp_force_N"], r"^measures\[0\]: expected a measure, found 'clamp_force_N'"),
        ("clamp_force_N", r"^measures: expected a list of measures, found 'clamp_force_N'"),
    ],
)
def test_what_is_no_list_of_measures_is_refused(measures, said):
    with pytest.raises(TypeError, match=said):
        jc.gradients(clamped(), measures, PATHS)


@pytest.mark.parametrize(
    "path",
    [
        "clamp.jaw.radius",
        "clamp.jaw",
        "mesh.axial",
        "solver.tolerance",
        "artery.layers[2].thickness",
        "artery.pressure[0]",
        "clamp.jaw.slopes]",
        "clamp..jaw.slopes",
        "",
    ],
)
def test_what_is_no_address_of_a_float_is_refused(path):
    said = r"expected a number of the scene|does not exist|is not an address"
    with pytest.raises(jc.SceneError, match=said):
        jc.gradients(clamped(), MEASURES, [path])


def test_a_single_address_is_refused():
    with pytest.raises(TypeError, match="expected a list of addresses"):
        jc.gradients(clamped(), MEASURES, "clamp.jaw.slopes")
