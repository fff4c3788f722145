"""Several measures of one result, and their derivatives by chosen floats of its scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxclamp.observe.measure import Measure
from jaxclamp.scenes import address
from jaxclamp.scenes.scene import Scene
from jaxclamp.sensitivity.adjoint import value_and_clamp_gradient, value_and_gradient
from jaxclamp.solve.results import Result

OF_THE_CLAMP = ("clamp", "contact", "stop")
"""parts of a scene that the artery in the body does not depend on"""


def gradients(
    result: Result, measures: Sequence[Measure], paths: Sequence[str] | None = None
) -> tuple[np.ndarray, Any]:
    """Values of measures at a result, (n_measures,), and their derivatives by floats of its scene.

    measures: such as `[jaxclamp.clamp_force(), jaxclamp.lumen_width()]`; one adjoint solve each, with the
        factors that the clamping left behind, whatever the number of floats
    paths: addresses of floats or lists of floats, as for `jaxclamp.replace`: "clamp.jaw.radius",
        "clamp.jaw.slopes", "artery.layers[0].material.c". The derivatives are then an array
        (n_measures, n_floats), the floats in the order of the paths, lists item by item. None: the
        derivatives by every float, a tuple of scenes, one per measure.

    Values and derivatives are in internal units (mm, kPa, mN, radians).

    Raises TypeError for what is no list of measures or of addresses, SceneError for an address that is no
    float of the scene, EquilibriumError if the stop was not reached, ValueError if it was not asked for.
    """
    asked = _checked(measures)
    if isinstance(paths, str):
        raise TypeError(f"paths = {paths!r}: expected a list of addresses, such as [{paths!r}]")
    places = [address.describe(result.scene, path).path for path in paths or ()]
    of_the_clamp = bool(places) and all(place.split(".")[0] in OF_THE_CLAMP for place in places)
    pairs = [
        (value_and_clamp_gradient if of_the_clamp and measure.needs_stop else value_and_gradient)(
            result, measure
        )
        for measure in asked
    ]
    values = np.array([value for value, _ in pairs], float)
    if paths is None:
        return values, tuple(gradient for _, gradient in pairs)
    slopes = [_floats(gradient, places) for _, gradient in pairs]
    return values, np.array(slopes, float).reshape(len(asked), _floats(result.scene, places).size)


def _checked(measures: Any) -> tuple[Measure, ...]:
    """The measures. Raises TypeError for a single one, or for what is none."""
    if not isinstance(measures, Sequence) or isinstance(measures, str):
        raise TypeError(f"measures: expected a list of measures, found {_said(measures)}")
    for i, measure in enumerate(measures):
        if not isinstance(measure, Measure):
            raise TypeError(f"measures[{i}]: expected a measure, found {_said(measure)}")
    return tuple(measures)


def _said(found: Any) -> str:
    """What was given in place of a measure, and what to write instead where that is known."""
    if isinstance(found, Measure):
        return f"the measure {found} alone; put it into a list"
    if callable(found) and hasattr(found, "__name__"):
        return f"the function {found.__name__}; call it, such as {found.__name__}()"
    return repr(found)


def _floats(scene: Scene, paths: Sequence[str]) -> np.ndarray:
    """The floats of a scene at some canonical addresses, one after another, (n_floats,)."""
    parts = [np.ravel(np.asarray(address.get(scene, path), float)) for path in paths]
    return np.concatenate([np.zeros(0), *parts])
