"""Fields of one equilibrium as people look at them: per layer, at the nodes, over the whole artery.

Plain numpy, for pictures and files only. Layers are kept apart: a node on an interface has one
value in each layer, because stresses jump there. Lengths mm, stresses kPa.

What is not modelled is made from what is by the mirror planes of the model's `Symmetry`: as cells for
files (`whole`), or as one regular grid for pictures (`whole_grid`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np

from jaxclamp.fem.elements import Element
from jaxclamp.fem.grid import Mesh
from jaxclamp.fem.landmarks import extrapolation, tensor_nodes
from jaxclamp.fem.symmetry import AXES, Symmetry
from jaxclamp.observe.injury import damage_of_group
from jaxclamp.observe.stresses import facet_contact, stresses
from jaxclamp.physics.jaws import Jaw
from jaxclamp.potential.energy import State
from jaxclamp.potential.model import Model
from jaxclamp.potential.terms import JAWS, Group

STRESSES = {
    "axial_stress_kPa": "axial",
    "circumferential_stress_kPa": "circumferential",
    "radial_stress_kPa": "radial",
    "greatest_principal_stress_kPa": "greatest",
}
"""name of a nodal field -> attribute of `observe.stresses.Stresses`"""
DAMAGE = "damage"
"""name of the nodal field, see `observe.injury.damage_at_points`"""


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
    """each (n,), (n, 3) for vectors, or (n, 3, 3) for tensors"""
    cell_data: dict[str, np.ndarray]
    """each (n_cells,)"""
    volumes: np.ndarray
    """share of each point in the volume of the stress-free wall, mm³, (n,)"""
    symmetry: Symmetry
    """the mirror planes that make the whole artery of these points; none if they are all of it"""
    grid: tuple[int, int, int] | None
    """points along (axial, circumferential, radial) in the order of `points`; None after `whole`"""
    fibres: tuple[np.ndarray, ...] = ()
    """stress-free direction of each fibre family along the material axes (radial, circumferential, axial) at
    the points, each (n, 3); see `tensors`"""

    def on_grid(self, values: np.ndarray) -> np.ndarray:
        """Values at the points, by grid position (axial, circumferential, radial, ...)."""
        assert self.grid is not None, "mirrored points are no single grid"
        return values.reshape(*self.grid, *values.shape[1:])


def layer_nodes(mesh: Mesh, layer: int) -> np.ndarray:
    """Nodes of a layer, ordered (axial, circumferential, radial), (n,)."""
    first, last = mesh.layer_cells[layer]
    return np.unique(mesh.cells[:, first:last])


def layer_fields(
    model: Model, state: State, start: State | None = None, body: State | None = None
) -> tuple[LayerFields, ...]:
    """The modelled part, layer by layer.

    start: the state from which displacements count; body: that in the body, which damage is against. Neither
    is given without it
    """
    mesh, element = model.mesh, model.mesh.element
    modes = element.pressure_modes(tensor_nodes(element))
    pressure = -np.einsum("ma,mc->ac", modes, np.asarray(state.p))
    x = np.asarray(state.x)
    touch = nodal_contact_pressure(model, state)
    layers = []
    for number, (group, s) in enumerate(
        zip(model.potential.layers, stresses(model.potential, state), strict=True)
    ):
        first, last = mesh.layer_cells[number]
        nodes = layer_nodes(mesh, number)
        cells = np.searchsorted(nodes, mesh.cells[:, first:last])
        corners = {
            name: extrapolation(element) @ np.asarray(getattr(s, key)) for name, key in STRESSES.items()
        }
        corners["pressure_kPa"] = pressure[:, first:last]
        if body is not None:
            corners[DAMAGE] = extrapolation(element) @ np.asarray(_damage(group, body, state))
        data = {name: averaged(cells, values, len(nodes)) for name, values in corners.items()}
        if body is not None:
            data[DAMAGE] = np.clip(data[DAMAGE], 0.0, 1.0)  # extrapolated beyond what it can be
        data["contact_pressure_kPa"] = touch[nodes]
        if start is not None:
            data["displacement_mm"] = x[nodes] - np.asarray(start.x)[nodes]
        dV = np.asarray(group.solid.dV)
        J = np.sum(np.asarray(s.J) * dV, axis=0) / np.sum(dV, axis=0)
        layers.append(
            LayerFields(
                name=model.scene.artery.layers[number].name,
                element=element,
                points=x[nodes],
                cells=cells,
                point_data=data,
                cell_data={"layer": np.full(last - first, number + 1), "J": J},
                volumes=_summed(cells, np.sum(dV, axis=0) / len(cells), len(nodes)),
                symmetry=model.symmetry,
                grid=_layer_grid(mesh, nodes),
            )
        )
    return tuple(layers)


def _layer_grid(mesh: Mesh, nodes: np.ndarray) -> tuple[int, int, int]:
    """Points of a layer along (axial, circumferential, radial); nodes: those of the layer, (n,)."""
    _, n_c, n_z = mesh.grid
    return n_z, n_c, len(nodes) // (n_z * n_c)


def averaged(cells: np.ndarray, values: np.ndarray, n: int) -> np.ndarray:
    """Mean at each point of the values its cells have there; cells, values: (n_en, n_cells)."""
    return _summed(cells, values, n) / np.bincount(cells.ravel(), minlength=n)


def _summed(cells: np.ndarray, values: np.ndarray, n: int) -> np.ndarray:
    """Sum at each point of what its cells give it; cells: (n_en, n_cells), values: that or (n_cells,)."""
    return np.bincount(cells.ravel(), np.broadcast_to(values, cells.shape).ravel(), n)


# for a few states they are compiled for a short compilation rather than for speed
_damage = jax.jit(damage_of_group, compiler_options={"xla_backend_optimization_level": 0})
_contact = jax.jit(facet_contact, compiler_options={"xla_backend_optimization_level": 0})


def contact_at_points(group: Group, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Contact pressure on the deformed outer wall, kPa, and area of its points, mm^2, (n_q, n_facets)."""
    pressure, area = jax.device_get(_contact(group, state))
    return pressure, area


def _shape_functions(group: Group) -> np.ndarray:
    """Of the contact points of a group of jaw contact, (n_q, n_fn)."""
    return np.asarray(group.here(JAWS).rule.surface)[:, 0]


def nodal_contact_pressure(model: Model, state: State) -> np.ndarray:
    """Contact pressure spread to the nodes of the outer wall by area, kPa, 0 elsewhere, (n_nodes,)."""
    n = model.mesh.n_nodes
    force, around = np.zeros(n), np.zeros(n)
    for group in model.potential.of(JAWS):
        pressure, area = contact_at_points(group, state)
        nodes = np.asarray(group.nodes).ravel()
        share = np.abs(_shape_functions(group)).T
        force += np.bincount(nodes, (share @ (pressure * area)).ravel(), n)
        around += np.bincount(nodes, (share @ area).ravel(), n)
    return np.divide(force, around, out=np.zeros(n), where=around > 0.0)


def contact_along(model: Model, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Where along the artery each ring of facets is pressed most (mm), and how much (kPa), (n_rings,) each.

    At the points where contact is integrated, over all jaws, mirror images included, in order.
    """
    n_r, n_c, _ = model.mesh.grid
    rings, heights, places = [], [], []
    for group in model.potential.of(JAWS):
        nodes = np.asarray(group.nodes)
        pressure, _ = contact_at_points(group, state)
        z = _shape_functions(group) @ np.asarray(state.x)[nodes, 2]
        rings.append(np.min(nodes, axis=0) // (n_c * n_r))
        highest = np.argmax(pressure, axis=0)[None]
        heights.append(np.take_along_axis(pressure, highest, 0)[0])
        places.append(np.take_along_axis(z, highest, 0)[0])
    ring, height, place = map(np.concatenate, (rings, heights, places))
    order = np.lexsort((height, ring))
    last = order[np.flatnonzero(np.diff(np.append(ring[order], -1)))]  # the highest of each ring
    z, p = place[last], height[last]
    if "z" in model.symmetry:
        z, p = np.append(z, -z), np.append(p, p)
    along = np.argsort(z)
    return z[along], p[along]


# --------------------------------------------------------------------------------- the whole artery


def whole(layer: LayerFields) -> LayerFields:
    """The whole artery from the modelled part, by its mirror planes.

    Points on a plane are shared by both sides, and reflected cells are renumbered so that their
    volume stays positive.
    """
    n, signs = len(layer.points), layer.symmetry.mirrors.astype(int)
    # a point's image in an octant is that in the octant on the positive side of its own planes
    bits = 2 ** np.arange(len(AXES))
    octant = ((signs[:, None] < 0) & ~_on_planes(layer)) @ bits  # (parts, n)
    keys, numbers = np.unique(octant * n + np.arange(n), return_inverse=True)
    numbers = numbers.reshape(len(signs), n)
    source = keys % n
    sign = np.where(keys[:, None] // n & bits, -1, 1)

    turned = _turned(layer.element)
    cells = [
        image[layer.cells if np.prod(s) > 0 else layer.cells[turned]]
        for s, image in zip(signs, numbers, strict=True)
    ]
    return dataclasses.replace(
        layer,
        points=layer.points[source] * sign,
        cells=np.concatenate(cells, axis=1),
        point_data={name: _image(name, v[source], sign) for name, v in layer.point_data.items()},
        cell_data={name: np.tile(v, len(signs)) for name, v in layer.cell_data.items()},
        volumes=np.bincount(numbers.ravel(), np.tile(layer.volumes, len(signs))),
        symmetry=Symmetry(""),
        grid=None,
        fibres=tuple(v[source] for v in layer.fibres),
    )


DEFORMATION = "deformation_gradient"
"""the tensor whose second index is that of the material axes"""


def _image(name: str, values: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """Point data mirrored in the planes where the sign is -1; sign: (n, 3).

    The material axes of a mirror image are (radial, circumferential, axial) again: reflected in x or y, the
    circumferential one runs the other way round, reflected in z the axial one.
    """
    if values.ndim == 1:
        return values
    if values.ndim == 2:
        return values * sign
    material = np.stack([np.ones(len(sign)), sign[:, 0] * sign[:, 1], sign[:, 2]], axis=1)
    return values * sign[:, :, None] * (material if name == DEFORMATION else sign)[:, None]


def on_both_sides(layer: LayerFields, name: str, values: np.ndarray) -> np.ndarray:
    """Tensors (n, 3, 3) at the points with the mean of both sides on mirror planes."""
    for axis, there in enumerate(_on_planes(layer).T):
        sign = np.where(np.arange(3) == axis, -1, 1)[None].repeat(np.sum(there), 0)
        values[there] = 0.5 * (values[there] + _image(name, values[there], sign))
    return values


def _on_planes(layer: LayerFields) -> np.ndarray:
    """True for the points on the mirror planes with normals x, y and z, (n, 3)."""
    assert layer.grid is not None, "already the whole artery"
    found = np.zeros((len(layer.points), len(AXES)), dtype=bool)
    flags = layer.on_grid(found)  # a view
    if "z" in layer.symmetry:
        flags[0, :, :, 2] = True
    if not layer.symmetry.wraps:  # then the circumference begins and ends on a plane
        for quarter, line in zip(layer.symmetry.quarters, (0, -1), strict=True):
            flags[:, line, :, 0 if quarter % 2 else 1] = True  # x = 0 is a right angle from the fold
    return found


def _turned(element: Element) -> np.ndarray:
    """Nodes of a cell with its axial direction reversed, (n_en,)."""
    m = element.order + 1
    i, j, k = element.node_grid.T
    return (i * m + j) * m + (m - 1 - k)


@dataclasses.dataclass(frozen=True)
class WholeGrid:
    """One layer of the whole artery as a regular grid: axial, circumferential, radial.

    Axial from end to end, radial from inside to outside; circumferential from the fold over the
    compression axis (90 deg) all the way round, so that the last line is the first one again.
    """

    points: np.ndarray
    """current position, mm, (n_z, n_c, n_r, 3)"""
    point_data: dict[str, np.ndarray]
    """each (n_z, n_c, n_r), or (n_z, n_c, n_r, 3) for vectors"""

    @property
    def middle(self) -> int:
        """Axial grid line at mid-length."""
        return self.points.shape[0] // 2

    def line(self, quarter: int) -> int:
        """Circumferential grid line at so many right angles from the fold, 0 to 4."""
        return quarter * (self.points.shape[1] - 1) // 4

    @property
    def upper(self) -> slice:
        """Circumferential grid lines of the upper half, from fold to fold."""
        return slice(self.line(2) + 1)


def whole_grid(layer: LayerFields) -> WholeGrid:
    """The whole artery from the modelled part, by its mirror planes, points and their data as one grid."""
    unfold = lambda values: _unfolded(layer.symmetry, layer.on_grid(values))  # noqa: E731
    return WholeGrid(unfold(layer.points), {name: unfold(v) for name, v in layer.point_data.items()})


def whole_positions(model: Model, state: State, layer: int) -> WholeGrid:
    """The positions of one layer alone, without data: cheap, for a state of which no stress is shown."""
    nodes = layer_nodes(model.mesh, layer)
    x = np.asarray(state.x)[nodes].reshape(*_layer_grid(model.mesh, nodes), 3)
    return WholeGrid(_unfolded(model.symmetry, x), {})


def _unfolded(symmetry: Symmetry, values: np.ndarray) -> np.ndarray:
    """Values (n_z, n_c, n_r) or vectors (..., 3) on the grid of the modelled part, on the whole artery's."""
    for axis in "xy":  # from a quarter to the upper half, from a half to the whole
        if axis in symmetry:
            values = np.concatenate([values, _mirrored(values, axis)[:, -2::-1]], axis=1)
    ring = values if symmetry.wraps else values[:, :-1]
    from_fold = np.roll(ring, symmetry.quarters[0] * (ring.shape[1] // 4), axis=1)
    closed = np.concatenate([from_fold, from_fold[:, :1]], axis=1)
    return np.concatenate([_mirrored(closed, "z")[:0:-1], closed]) if "z" in symmetry else closed


def _mirrored(values: np.ndarray, axis: str) -> np.ndarray:
    """Values (n_z, n_c, n_r) or vectors (n_z, n_c, n_r, 3) as a mirror plane with that normal shows them."""
    return values * np.where(np.array(list(AXES)) == axis, -1, 1) if values.ndim == 4 else values


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
    gap = np.asarray(_gap(jaw, (np.zeros_like(zz), yy, zz)))
    curves = [np.asarray(c) for c in contour_generator(z, y, np.maximum(gap, yy - top)).lines(0.0)]
    return max(curves, key=len)


def clamp_height(model: Model, state: State) -> float:
    """How high the middle of the clamp is above the artery's axis, mm."""
    place = model.symmetry.rigid_place("clamp_height")
    return 0.0 if place is None else float(np.asarray(state.q)[place])


def jaw_height_shown(model: Model, state: State, open_height: float | None) -> float:
    """Where to draw the jaws of a state, mm from the clamp's middle: an open clamp just touches the artery.

    open_height: the outer radius in the body, where known
    """
    outer = float(np.asarray(state.x)[model.marks.outer_top, 1]) - clamp_height(model, state)
    return min(float(np.asarray(state.q)[0]), max(outer, open_height or outer))
