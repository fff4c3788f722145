"""Where the grid lines of a graded tube lie."""

import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.fem.tube import build_tube, closed_radii, radial_places
from walks import mesh

CLAMP = jc.load_scene("human-lad").clamp


@pytest.mark.parametrize("element", ["q1pz", "q2p1"])
def test_layers_outside_the_innermost_are_drawn_together_towards_it(element):
    """s of n elements reach to expm1(g s / n) / expm1(g): they grow by exp(g) over the layer."""
    settings = mesh(element, 3, 4, (2, 3), radial_grading=3.0)
    places = np.asarray(radial_places(build_tube(settings, CLAMP), settings))
    order = 2 if element == "q2p1" else 1
    outer = 1.0 + np.expm1(3.0 * np.linspace(0.0, 1.0, 4)) / np.expm1(3.0)
    np.testing.assert_allclose(places[::order], [0.0, 0.5, *outer], rtol=1e-14)
    if order == 2:
        np.testing.assert_allclose(places[1::2], 0.5 * (places[:-2:2] + places[2::2]), rtol=1e-14)


def test_grading_moves_no_interface():
    artery = jc.load_scene("human-lad").artery
    even, graded = (mesh("q1pz", 3, 4, (2, 3), radial_grading=g) for g in (0.0, 4.0))
    radii = [np.asarray(closed_radii(build_tube(m, CLAMP), m, artery)) for m in (even, graded)]
    np.testing.assert_allclose(radii[1][[0, 1, 2, 5]], radii[0][[0, 1, 2, 5]], rtol=1e-14)
    assert radii[1][3] - radii[1][2] < 0.2 * (radii[0][3] - radii[0][2])
