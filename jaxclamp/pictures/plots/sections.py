"""Deformed sections of artery and jaws at the states A to F."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import PathPatch, Polygon
from matplotlib.path import Path as Outline

from jaxclamp.pictures.fields import WholeGrid, jaw_height_shown, whole_positions
from jaxclamp.pictures.jaws import jaw_gaps, jaw_sections
from jaxclamp.pictures.plots.states import Clamped, meshes_of, shown_states
from jaxclamp.pictures.plots.style import INK, JAW, JAW_EDGE, LARGE, SMALL, Picture, layer_colour, plain

COLUMNS = 2
WIDTH = 10.5
"""inches"""


def plot_sections(result: Clamped) -> Picture:
    """Cross-section at mid-length and longitudinal section, whole artery with jaws, states A to F."""
    states = shown_states(result)
    wide, high = _largest(result)
    jaw_half = result.scene.clamp.half_extent()
    across, along = 1.12 * wide, max(1.15 * jaw_half + high, 1.8 * high)
    along = min(along, 1.02 * float(np.max(np.asarray(result.closing[0].state.x)[:, 2])))
    up = 1.25 * high
    rows = -(-len(states) // COLUMNS)
    columns = min(COLUMNS, len(states))
    scale = 0.97 * WIDTH / (COLUMNS * 2.0 * (across + along))
    figure = Picture(WIDTH * columns / COLUMNS + 0.2, rows * (2.0 * up * scale + 0.33) + 0.45)
    gap = 0.12 * across  # between one state and the next
    widths = [across, along, gap] * columns
    grid = figure.add_gridspec(rows, len(widths) - 1, width_ratios=widths[:-1])
    open_height = result.closing[0].values["outer_radius_mm"]
    for place, (letter, index) in enumerate(states.items()):
        kept, record = result.closing[index], result.history[index]
        row, column = divmod(place, COLUMNS)
        height = jaw_height_shown(kept.model, kept.state, open_height)
        left = figure.add_subplot(grid[row, 3 * column])
        right = figure.add_subplot(grid[row, 3 * column + 1])
        for jaw in jaw_gaps(kept.model, kept.state, height).values():
            for axes, half_width in ((left, 1.1 * across), (right, 1.1 * along)):
                for curve in jaw_sections(jaw, axes is left, half_width, 1.1 * up):
                    axes.add_artist(Polygon(curve, facecolor=JAW, edgecolor=JAW_EDGE, linewidth=0.9))
        for number in range(len(result.scene.artery.layers)):
            layer = whole_positions(kept.model, kept.state, number)
            _cross_section(left, layer, number)
            _longitudinal_section(right, layer, number)
        _frame(left, across, up)
        _frame(right, along, up)
        left.set_title(letter, fontsize=LARGE, color=INK, loc="left", fontweight="bold")
        said = f"travel {record['jaw_travel_mm']:.2f} mm, occlusion {record['occlusion']:.1%}"
        right.set_title(said if place else "in the body", fontsize=SMALL, color=INK, loc="right")
    _key(figure, result, meshes_of(result, states), figure.axes[1], up, along)
    return figure


def _largest(result: Clamped) -> tuple[float, float]:
    """Largest half width and half height of the artery at mid-length over the closing, mm."""
    outermost = len(result.scene.artery.layers) - 1
    grids = [whole_positions(kept.model, kept.state, outermost) for kept in result.closing]
    rings = np.abs(np.concatenate([grid.points[grid.middle, :, -1] for grid in grids]))
    return float(np.max(rings[:, 0])), float(np.max(rings[:, 1]))


def _cross_section(axes: Axes, layer: WholeGrid, number: int) -> None:
    points = layer.points[layer.middle, :, :, :2]
    inner, outer = points[:, 0], points[:, -1]
    codes = [Outline.MOVETO, *[Outline.LINETO] * (len(inner) - 2), Outline.CLOSEPOLY]
    path = Outline(np.concatenate([outer, inner[::-1]]), codes * 2)
    fill, edge = layer_colour(number)
    axes.add_artist(PathPatch(path, facecolor=fill, edgecolor=edge, linewidth=0.8))
    _element_lines(axes, points, edge)


def _longitudinal_section(axes: Axes, layer: WholeGrid, number: int) -> None:
    fill, edge = layer_colour(number)
    for quarter in (1, 3):  # under the upper jaw and over the lower one
        points = layer.points[:, layer.line(quarter)][..., [2, 1]]
        band = np.concatenate([points[:, 0], points[::-1, -1]])
        axes.add_artist(Polygon(band, facecolor=fill, edgecolor=edge, linewidth=0.8))
        _element_lines(axes, points, edge)


def _element_lines(axes: Axes, points: np.ndarray, colour: str) -> None:
    """Lines between elements, faint; points: (along, through, 2)."""
    lines = [*points, *np.swapaxes(points, 0, 1)]
    axes.add_collection(LineCollection(lines, colors=colour, linewidths=0.25, alpha=0.7), autolim=False)


def _frame(axes: Axes, half_width: float, half_height: float) -> None:
    axes.set_xlim(-half_width, half_width)
    axes.set_ylim(-half_height, half_height)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def _key(
    figure: Picture,
    result: Clamped,
    meshes: tuple[str, str] | None,
    along: Axes,
    up: float,
    half_width: float,
) -> None:
    """Names of layers and jaws, a scale, and of which mesh the states are if there are two (`meshes_of`)."""
    names = [plain(layer.name) for layer in result.scene.artery.layers]
    handles = [
        Polygon([(0, 0)], facecolor=layer_colour(i)[0], edgecolor=layer_colour(i)[1], label=name)
        for i, name in enumerate(names)
    ]
    handles.append(Polygon([(0, 0)], facecolor=JAW, edgecolor=JAW_EDGE, label="jaws"))
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=len(handles),
        fontsize=SMALL,
        frameon=False,
        labelcolor=INK,
        title=None if meshes is None else f"{meshes[0]}; the path between them: {meshes[1]}",
        title_fontsize=SMALL,
    )
    end, bar = 0.97 * half_width, _round_length(0.5 * half_width)
    along.plot([end - bar, end], [0.0, 0.0], color=INK, linewidth=2.0, solid_capstyle="butt")
    along.text(end - 0.5 * bar, 0.04 * up, f"{bar:g} mm", ha="center", va="bottom", fontsize=SMALL, color=INK)


def _round_length(length: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not above a length, mm."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1, 2, 5) if step * power <= length))
