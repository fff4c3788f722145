"""States of one mesh carried over to another mesh of the same artery, to start Newton's method from."""

from __future__ import annotations

import jax
import numpy as np
from scipy.interpolate import Akima1DInterpolator

from jaxclamp.fem.tube import grid_lines
from jaxclamp.potential.energy import State
from jaxclamp.potential.model import Model


def transferred(state: State, old: Model, new: Model) -> State:
    """A state of the old model on the mesh of the new one; both have the same layers.

    Positions are interpolated with splines (Akima's, which do not ring where the wall leaves the
    jaw) along and around the artery, so that the wall stays as smooth under the jaw as it was, and
    linearly through each layer. Pressures are interpolated linearly between the middles of the cells;
    they must come from the old state: those that would fit the interpolated volumes are wrong by the
    bulk modulus times the error of the interpolation. Those beyond the mean are left to the next iteration.
    """
    if old.mesh.element is new.mesh.element and all(map(np.array_equal, _lines(old), _lines(new))):
        return state
    positions = np.asarray(state.x).reshape(*old.mesh.grid[::-1], 3)
    if old.mesh.wraps:  # the first line again where the last one ends
        positions = np.concatenate([positions, positions[:, :1]], axis=1)
    for axis, (known, wanted) in enumerate(zip(_lines(old), _lines(new), strict=True)):
        positions = (_linear if axis == RADIAL else _smooth)(positions, known, wanted, axis)
    positions = positions[:, : new.mesh.grid[1]]
    modes = np.zeros((len(new.discretisation.stencils.modes), new.mesh.n_cells))
    for layer, (first, last) in enumerate(new.mesh.layer_cells):
        start, end = old.mesh.layer_cells[layer]
        middles = _middles(old, layer)
        means = np.asarray(state.p)[0, start:end].reshape([len(line) for line in middles])
        for axis, (known, wanted) in enumerate(zip(middles, _middles(new, layer), strict=True)):
            means = _linear(means, known, wanted, axis)
        modes[0, first:last] = means.ravel()
    x, p = jax.device_put((positions.reshape(-1, 3), modes))
    return State(x=x, p=p, q=state.q)


RADIAL = 2


def _lines(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Place of each axial, circumferential and radial grid line in the artery: the same on every mesh."""
    axial, around, radial = jax.device_get(grid_lines(model.mesh, model.scene.mesh))
    return axial, around, radial


def _middles(model: Model, layer: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Place of the middles of a layer's cells along each axis."""
    axial, circumferential, radial = (line[:: model.mesh.element.order] for line in _lines(model))
    inside = sum(model.scene.mesh.radial[:layer])
    radial = radial[inside : inside + model.scene.mesh.radial[layer] + 1]
    between = lambda line: 0.5 * (line[1:] + line[:-1])  # noqa: E731
    return between(axial), between(circumferential), between(radial)


def _smooth(values: np.ndarray, known: np.ndarray, wanted: np.ndarray, axis: int) -> np.ndarray:
    # the last lines of two gradings may differ by rounding, and Akima's splines end with the known ones
    inside = np.clip(wanted, known[0], known[-1])
    return np.asarray(Akima1DInterpolator(known, values, axis=axis)(inside))


def _linear(values: np.ndarray, known: np.ndarray, wanted: np.ndarray, axis: int) -> np.ndarray:
    """Linear between the known places, constant beyond them."""
    return np.apply_along_axis(lambda line: np.interp(wanted, known, line), axis, values)
