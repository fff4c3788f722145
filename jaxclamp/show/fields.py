"""Fields of one equilibrium as people look at them: per layer, at the nodes, over the whole artery.

Plain numpy, for pictures and files only. Layers are kept apart: a node on an interface has one
value in each layer, because stresses jump there. Lengths mm, stresses kPa.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxclamp.fem.elements import Element
from jaxclamp.fem.tube import Mesh
from jaxclamp.observe.stresses import contact_pressure, extrapolation, stresses, tensor_nodes
from jaxclamp.physics.jaws import Jaw
from jaxclamp.potential.model import Model
from jaxclamp.potential.tangent import State

STRESSES = {
    "axial_stress_kPa": "axial",
    "circumferential_stress_kPa": "circumferential",
    "radial_stress_kPa": "radial",
    "greatest_principal_stress_kPa": "greatest",
}
"""name of a nodal field -> attribute of `measures.Stresses`"""


@dataclasses.dataclass(frozen=True)
class LayerFields:
    """One layer of the wall: its own points and cells, and what is known there."""

    name: str
    element: Element
    points: np.ndarray
    """current position, mm, (n, 3)"""
    cells: np.ndarray
    """point of each cell corner in the element's numbering, (n_en, n_cells)"""
    point_data: dict[str, np.ndarray]
    """each (n,), or (n, 3) for vectors"""
    cell_data: dict[str, np.ndarray]
    """each (n_cells,)"""
    grid: tuple[int, int, int] | None
    """points along (axial, circumferential, radial) in the order of `points`; None for the whole artery"""

    def on_grid(self, values: np.ndarray) -> np.ndarray:
        """Values at the points, by grid position (axial, circumferential, radial, ...)."""
        assert self.grid is not None, "the whole artery is no single grid"
        return values.reshape(*self.grid, *values.shape[1:])


def layer_nodes(mesh: Mesh, layer: int) -> np.ndarray:
    """Nodes of a layer, ordered (axial, circumferential, radial), (n,)."""
    first, last = mesh.layer_cells[layer]
    return np.unique(mesh.cells[:, first:last])


def layer_fields(model: Model, state: State, start: State | None = None) -> tuple[LayerFields, ...]:
    """The modelled eighth, layer by layer.

    start: the state from which displacements count; none are given without it
    """
    mesh, element = model.mesh, model.mesh.element
    s = jax.device_get(stresses(model.body, state))
    dV = np.asarray(model.body.geometry.dV)
    at_nodes = {name: extrapolation(element) @ np.asarray(getattr(s, key)) for name, key in STRESSES.items()}
    modes = element.pressure_modes(tensor_nodes(element))
    at_nodes["pressure_kPa"] = -np.einsum("ma,mc->ac", modes, np.asarray(state.p))
    J = np.sum(np.asarray(s.J) * dV, axis=0) / np.sum(dV, axis=0)
    x = np.asarray(state.x)
    touch = nodal_contact_pressure(model, state)
    layers = []
    for number, (first, last) in enumerate(mesh.layer_cells):
        nodes = layer_nodes(mesh, number)
        cells = np.searchsorted(nodes, mesh.cells[:, first:last])
        data = {name: _averaged(cells, v[:, first:last], len(nodes)) for name, v in at_nodes.items()}
        data["contact_pressure_kPa"] = touch[nodes]
        if start is not None:
            data["displacement_mm"] = x[nodes] - np.asarray(start.x)[nodes]
        radial = len(nodes) // (mesh.grid[1] * mesh.grid[2])
        cell_data = {"layer": np.full(last - first, number + 1), "J": J[first:last]}
        layers.append(
            LayerFields(
                model.scene.artery.layers[number].name,
                element,
                x[nodes],
                cells,
                data,
                cell_data,
                (mesh.grid[2], mesh.grid[1], radial),
            )
        )
    return tuple(layers)


def _averaged(cells: np.ndarray, values: np.ndarray, n: int) -> np.ndarray:
    """Mean at each point of the values its cells have there; cells, values: (n_en, n_cells)."""
    total = np.bincount(cells.ravel(), values.ravel(), n)
    return total / np.bincount(cells.ravel(), minlength=n)


_contact_pressure = jax.jit(contact_pressure, static_argnums=2)


def nodal_contact_pressure(model: Model, state: State) -> np.ndarray:
    """Contact pressure spread to the nodes of the outer wall by area, kPa, 0 elsewhere, (n_nodes,)."""
    mesh, stencil = model.mesh, np.asarray(model.body.stencils.contact)[:, 0]
    pressure, area = (np.asarray(v) for v in _contact_pressure(model.body, state, mesh.element))
    share = np.abs(stencil).T
    force = np.bincount(mesh.outer_facets.ravel(), (share @ (pressure * area)).ravel(), mesh.n_nodes)
    around = np.bincount(mesh.outer_facets.ravel(), (share @ area).ravel(), mesh.n_nodes)
    return np.divide(force, around, out=np.zeros_like(force), where=around > 0.0)


def whole(layer: LayerFields) -> LayerFields:
    """The whole artery from the modelled eighth: reflected in the planes x = 0, y = 0 and z = 0.

    Points on a plane are shared by both sides, and reflected cells are renumbered so that their
    volume stays positive.
    """
    assert layer.grid is not None, "already the whole artery"
    n = len(layer.points)
    on_plane = np.zeros((n, 3), dtype=bool)
    flags = layer.on_grid(on_plane)  # a view
    flags[:, -1, :, 0] = flags[:, 0, :, 1] = flags[0, :, :, 2] = True
    signs = np.array([[-1 if octant >> axis & 1 else 1 for axis in range(3)] for octant in range(8)])
    # a point's image in an octant is that in the octant on the positive side of its own planes
    bits = np.array([1, 2, 4])
    octant = ((signs[:, None] < 0) & ~on_plane) @ bits  # (8, n)
    keys, numbers = np.unique(octant * n + np.arange(n), return_inverse=True)
    numbers = numbers.reshape(8, n)
    source, sign = keys % n, signs[keys // n]

    turned = _turned(layer.element)
    cells = np.concatenate(
        [numbers[o][layer.cells if np.prod(signs[o]) > 0 else layer.cells[turned]] for o in range(8)],
        axis=1,
    )
    data = {name: v[source] * (sign if v.ndim == 2 else 1) for name, v in layer.point_data.items()}
    cell_data = {name: np.tile(v, 8) for name, v in layer.cell_data.items()}
    return LayerFields(layer.name, layer.element, layer.points[source] * sign, cells, data, cell_data, None)


def _turned(element: Element) -> np.ndarray:
    """Nodes of a cell with its axial direction reversed, (n_en,)."""
    m = element.order + 1
    i, j, k = element.node_grid.T
    return (i * m + j) * m + (m - 1 - k)


def spread(positions: Sequence[float], count: int) -> list[int]:
    """Up to `count` increasing places of `positions`, the first and the last among them, evenly spread."""
    values = np.asarray(positions, dtype=float)
    between = np.linspace(values[0], values[-1], min(count, len(values)))[1:-1]
    return sorted({int(np.argmin(np.abs(values - w))) for w in between} | {0, len(values) - 1})


# --------------------------------------------------------------------------------- the jaw as drawn

_gap = jax.jit(lambda jaw, point: jaw.gap(point))


def jaw_outline(jaw: Jaw, height: float, n: int = 301) -> np.ndarray:
    """Closed curve (z, y) where the gap is zero, mm, (n_points, 2), first point repeated at the end.

    The origin is the jaw's lowest point in the middle. A jaw that has no end above is cut off at
    `height` or at its full width, whichever is higher. n: grid lines per direction of the search
    """
    from contourpy import contour_generator

    extent = float(jaw.half_extent())
    top = max(height, 2.0 * extent)
    z = np.linspace(-1.1 * extent, 1.1 * extent, n)
    y = np.linspace(-extent, top + 0.1 * extent, n)
    zz, yy = np.meshgrid(z, y)
    gap = _gap(jaw, (jnp.zeros_like(zz), jnp.asarray(yy), jnp.asarray(zz)))
    curves = [np.asarray(c) for c in contour_generator(z, y, np.maximum(gap, yy - top)).lines(0.0)]
    return max(curves, key=len)


def jaw_height_shown(model: Model, state: State, open_height: float | None) -> float:
    """Where to draw the jaw of a state, mm above the axis: an open clamp just touches the artery.

    open_height: the outer radius in the body, where known
    """
    outer = float(state.x[model.marks.outer_top, 1])
    return min(float(state.jaw_height), max(outer, open_height or outer))
