"""Where axial stress or damage is high at the end: every layer unrolled, and as it lies under the jaw."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.patheffects import AbstractPathEffect, withStroke

from jaxclamp.pictures.fields import (
    DAMAGE,
    LayerFields,
    WholeGrid,
    layer_fields,
    whole_grid,
    whole_positions,
)
from jaxclamp.pictures.plots.states import Clamped, final_state
from jaxclamp.pictures.plots.style import (
    INK,
    NORMAL,
    Colours,
    Picture,
    colour_bar,
    colours,
    dress,
    plain,
    stress_colours,
)


@dataclasses.dataclass(frozen=True)
class Mapped:
    """What a map shows."""

    field: str
    """of the points"""
    label: str
    """beside the bar of colours"""
    step: float
    """colours end at multiples of it"""
    peaks: bool
    """a cross marks the highest place: not where a plateau has it"""


AXIAL_STRESS = Mapped("axial_stress_kPa", "axial Cauchy stress (kPa)", 5.0, peaks=True)
OF_DAMAGE = Mapped(DAMAGE, "damage", 0.1, peaks=False)
FROM_INSIDE, FROM_OUTSIDE = (0.50, -0.75, 0.32), (0.50, 0.75, 0.32)
"""where the observer stands: across the artery, above the jaws' mid-plane, along the artery"""
FINER = 4
"""drawn facets per facet of the mesh and direction"""
EQUALLY_HIGH = 1e-6
"""stresses of mirror images differ by no more than this part, computed or mirrored"""


def plot_axial_stress_maps(result: Clamped) -> Picture:
    """Axial Cauchy stress of every layer in the last state, on one colour scale."""
    return _maps(result, AXIAL_STRESS)


def plot_damage_maps(result: Clamped) -> Picture:
    """Damage of every layer in the last state, on one colour scale."""
    return _maps(result, OF_DAMAGE)


def _final_fields(result: Clamped, mapped: Mapped) -> tuple[LayerFields, ...]:
    """The layers in the last state, with what is mapped."""
    kept = final_state(result)
    body = result.in_body_like(kept) if mapped is OF_DAMAGE else None
    return layer_fields(kept.model, kept.state, body=None if body is None else body.state)


def _maps(result: Clamped, mapped: Mapped) -> Picture:
    layers = _final_fields(result, mapped)
    zoom = half_length_shown(result, layers)
    shades = stress_range(layers, zoom, mapped)
    scale = ScalarMappable(Normalize(*shades.limits), stress_colours())
    figure = Picture(9.6, 2.75 * len(layers) + 0.35)
    grid = figure.add_gridspec(len(layers), 2, width_ratios=[1.0, 1.25])
    for number, layer in enumerate(layers):
        P = number == result.model.marks.P_layer
        map_axes, view_axes = (figure.add_subplot(grid[number, column]) for column in (0, 1))
        unrolled(map_axes, layer, load_free_angles(result, number), zoom, scale, P, mapped)
        last = number == len(layers) - 1
        dress(
            map_axes,
            "position along the artery (mm)" if last else "",
            "angle from the fold (deg)",
            f"{plain(layer.name)}, highest through the layer",
            grid=False,
        )
        _view(view_axes, whole_grid(layer), zoom, scale, inside=number == 0, mark_P=P, mapped=mapped)
    colour_bar(figure, scale, f"{mapped.label}{shades.said('volume')}", shades.beyond)
    return figure


def plot_axial_stress_side_by_side(results: Mapping[str, Clamped]) -> Picture:
    """Axial Cauchy stress of the innermost layer in the last state of each result, on one colour scale."""
    return _side_by_side(results, AXIAL_STRESS)


def plot_damage_side_by_side(results: Mapping[str, Clamped]) -> Picture:
    """Damage of the innermost layer in the last state of each result, on one colour scale."""
    return _side_by_side(results, OF_DAMAGE)


def _side_by_side(results: Mapping[str, Clamped], mapped: Mapped) -> Picture:
    layers = {name: _final_fields(result, mapped) for name, result in results.items()}
    zoom = max(half_length_shown(results[name], known) for name, known in layers.items())
    shades = stress_range([known[0] for known in layers.values()], zoom, mapped)
    scale = ScalarMappable(Normalize(*shades.limits), stress_colours())
    columns = min(3, len(results))
    rows = -(-len(results) // columns)
    figure = Picture(3.1 * columns + 0.8, 2.5 * rows + 0.4)
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for number, (axes, (name, known)) in enumerate(zip(panels, layers.items(), strict=False)):
        unrolled(axes, known[0], load_free_angles(results[name], 0), zoom, scale, False, mapped)
        dress(axes, "position along the artery (mm)", "angle from the fold (deg)", plain(name), grid=False)
        axes.label_outer()
        if number + columns >= len(results):  # nothing is below
            axes.xaxis.set_tick_params(labelbottom=True)
            axes.set_xlabel("position along the artery (mm)", fontsize=NORMAL, color=INK)
    for axes in panels[len(results) :]:
        axes.axis("off")
    colour_bar(figure, scale, f"{mapped.label}{shades.said('volume')}", shades.beyond)
    return figure


def stress_range(layers: Sequence[LayerFields], zoom: float, mapped: Mapped = AXIAL_STRESS) -> Colours:
    """The range of colours for what is mapped of some layers; zoom: half the length shown, mm."""
    shown = [np.abs(layer.points[:, 2]) <= zoom for layer in layers]
    return colours(
        [layer.point_data[mapped.field][at] for layer, at in zip(layers, shown, strict=True)],
        [layer.volumes[at] for layer, at in zip(layers, shown, strict=True)],
        mapped.step,
    )


def half_length_shown(result: Clamped, layers: tuple[LayerFields, ...]) -> float:
    """Half the length of artery shown, mm."""
    size = float(np.max(np.abs(layers[-1].points[:, 0])))
    end = float(np.max(layers[-1].points[:, 2]))
    return min(result.scene.clamp.half_extent() + size, 2.5 * size, end)


# --------------------------------------------------------------------------------- unrolled


def load_free_angles(result: Clamped, layer: int) -> np.ndarray:
    """Angle of the circumferential grid lines of the upper half in the load-free tube, deg, (n,)."""
    assert result.load_free is not None
    grid = whole_positions(result.model, result.load_free.state, layer)
    x, y, _ = grid.points[grid.middle, grid.upper, 0].T
    return np.degrees(np.unwrap(np.arctan2(y, x)))


def unrolled(
    axes: Axes,
    layer: LayerFields,
    angles: np.ndarray,
    zoom: float,
    scale: ScalarMappable,
    mark_P: bool,
    mapped: Mapped = AXIAL_STRESS,
) -> None:
    """Angle in the load-free tube (fold, jaw, fold) against current position along the artery.

    angles: from `load_free_angles`, deg, (n,); zoom: half the length shown, mm
    """
    z, value = highest_through(layer, mapped)
    angle = np.broadcast_to(angles, value.shape)
    inside = np.where(np.abs(z) <= zoom, value, -np.inf)
    peaks = mapped.peaks & (inside >= np.max(inside) - EQUALLY_HIGH * np.max(np.abs(value)))
    axes.pcolormesh(
        z,
        angle,
        value,
        cmap=scale.cmap,
        norm=Normalize(*scale.get_clim()),
        shading="gouraud",
        rasterized=True,
    )
    frame_of_map(axes, zoom)
    axes.plot(
        z[peaks],
        angle[peaks],
        "x",
        color="white",
        markersize=6,
        markeredgewidth=1.6,
        path_effects=_outlined(),
    )
    if mark_P:
        _P(axes, 0.0, 90.0)


def highest_through(layer: LayerFields, mapped: Mapped = AXIAL_STRESS) -> tuple[np.ndarray, np.ndarray]:
    """Position along the artery (mm), and the highest through a layer, of the upper half, (n_z, n_c)."""
    grid = whole_grid(layer)
    stress = grid.point_data[mapped.field][:, grid.upper]
    highest = np.argmax(stress, axis=2)[..., None]
    value = np.take_along_axis(stress, highest, axis=2)[..., 0]
    return np.take_along_axis(grid.points[:, grid.upper, :, 2], highest, axis=2)[..., 0], value


def frame_of_map(axes: Axes, zoom: float) -> None:
    """Limits and angles of an unrolled upper half; zoom: half the length shown, mm."""
    axes.set_xlim(-zoom, zoom)
    axes.set_ylim(0.0, 180.0)
    axes.set_yticks([0, 45, 90, 135, 180], ["0, fold", "45", "90, jaw", "135", "180, fold"])


def _outlined() -> list[AbstractPathEffect]:
    """White marks with a dark rim, seen on any colour."""
    return [withStroke(linewidth=3.0, foreground=INK)]


def _P(axes: Axes, x: float, y: float) -> None:
    axes.plot(x, y, "o", markersize=5, markerfacecolor="white", markeredgecolor=INK, markeredgewidth=1.0)
    axes.annotate(
        "P",
        (x, y),
        (5, 5),
        textcoords="offset points",
        fontsize=NORMAL,
        color="white",
        weight="bold",
        path_effects=_outlined(),
    )


# --------------------------------------------------------------------------------- seen in space


def _view(
    axes: Axes,
    layer: WholeGrid,
    zoom: float,
    scale: ScalarMappable,
    inside: bool,
    mark_P: bool,
    mapped: Mapped,
) -> None:
    """The upper half of a layer, shaded, from the lumen or from outside."""
    camera = _camera(FROM_INSIDE if inside else FROM_OUTSIDE)
    quads, values = _shell(layer, zoom, mapped)
    normal = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    toward = normal @ camera[2]
    light = camera.T @ np.array([-0.35, 0.45, 0.82])
    seen = toward > 0.0
    depth = np.mean(quads, axis=1) @ camera[2]
    order = np.flatnonzero(seen)[np.argsort(depth[seen])]
    shade = 0.75 + 0.25 * np.clip(normal @ light, 0.0, 1.0)
    colours = scale.to_rgba(values)[order]
    colours[:, :3] *= shade[order, None]
    flat = quads[order] @ camera[:2].T
    axes.add_collection(
        PolyCollection(flat, facecolors=colours, edgecolors=colours, linewidths=0.3, rasterized=True)
    )
    low, high = flat.min(axis=(0, 1)), flat.max(axis=(0, 1))
    margin = 0.03 * (high - low)
    axes.set_xlim(low[0] - margin[0], high[0] + margin[0])
    axes.set_ylim(low[1] - margin[1], high[1] + margin[1])
    axes.set_aspect("equal")
    axes.set_anchor("NW")
    axes.set_axis_off()
    axes.set_title(
        "upper half, seen from the lumen" if inside else "upper half, seen from outside",
        fontsize=NORMAL,
        color=INK,
        loc="left",
    )
    if mark_P and inside:
        P = layer.points[layer.middle, layer.line(1), 0]
        _P(axes, *(camera[:2] @ P))


def _camera(toward: tuple[float, float, float]) -> np.ndarray:
    """Rows: right, up, towards the observer; the artery runs from left to right."""
    back = np.array(toward) / np.linalg.norm(toward)
    right = np.array([0.0, 0.0, -1.0]) if toward[0] > 0.0 else np.array([0.0, 0.0, 1.0])
    right -= (right @ back) * back
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back])


def _shell(layer: WholeGrid, zoom: float, mapped: Mapped) -> tuple[np.ndarray, np.ndarray]:
    """Facets of the upper half's surface: corners anticlockwise from outside (n, 4, 3), values (n,)."""
    block = np.concatenate([layer.points, layer.point_data[mapped.field][..., None]], axis=-1)[:, layer.upper]
    block = _refined(_refined(block, 0), 1)
    keep = np.flatnonzero(np.max(np.abs(block[..., 2]), axis=(1, 2)) <= zoom)
    block = block[keep[0] : keep[-1] + 1]
    sheets = [
        block[:, ::-1, 0],
        block[:, :, -1],
        block[:, 0],
        block[:, -1, ::-1],
        block[0, ::-1],
        block[-1],
    ]
    quads = np.concatenate([_quads(sheet) for sheet in sheets])
    return quads[..., :3], np.mean(quads[..., 3], axis=1)


def _refined(block: np.ndarray, axis: int) -> np.ndarray:
    """Values at FINER times as many places along an axis, straight in between."""
    a = np.moveaxis(block, axis, 0)
    s = (np.arange(FINER) / FINER).reshape(1, -1, *[1] * (a.ndim - 1))
    fine = ((1.0 - s) * a[:-1, None] + s * a[1:, None]).reshape(-1, *a.shape[1:])
    return np.moveaxis(np.concatenate([fine, a[-1:]]), 0, axis)


def _quads(sheet: np.ndarray) -> np.ndarray:
    """Quadrilaterals of a structured sheet (n, m, 4): (n_quads, 4, 4)."""
    corners = [sheet[:-1, :-1], sheet[:-1, 1:], sheet[1:, 1:], sheet[1:, :-1]]
    return np.stack(corners, axis=2).reshape(-1, 4, sheet.shape[-1])
