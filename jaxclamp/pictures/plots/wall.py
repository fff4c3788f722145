"""Stress through the wall, load-free and in the body."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib.axes import Axes

from jaxclamp.pictures.fields import WholeGrid, layer_fields, whole_grid
from jaxclamp.pictures.plots.style import (
    AXIAL,
    CIRCUMFERENTIAL,
    FAINT,
    INK,
    SMALL,
    Picture,
    dress,
    layer_colour,
    legend,
    plain,
)

if TYPE_CHECKING:
    from jaxclamp.pictures.plots.states import Clamped

CURVES = (
    ("circumferential_stress_kPa", "circumferential", CIRCUMFERENTIAL, "-", "o"),
    ("axial_stress_kPa", "axial", AXIAL, "--", "s"),
)


def plot_wall_stress(result: Clamped) -> Picture:
    """Circumferential and axial Cauchy stress along the compression axis at mid-length."""
    if result.load_free is None:
        raise ValueError("no state of the artery converged: there is nothing to draw")
    artery = result.scene.artery
    panels = [("Load-free", result.load_free)]
    if result.physiological is not None:
        loads = f"In the body: {float(artery.pressure):g} kPa, axial stretch {float(artery.axial_stretch):g}"
        panels.append((loads, result.physiological))
    figure = Picture(4.6 * len(panels), 3.6)
    for place, (title, kept) in enumerate(panels):
        axes = figure.add_subplot(1, len(panels), place + 1)
        layers = layer_fields(kept.model, kept.state)
        _through_wall(axes, {layer.name: whole_grid(layer) for layer in layers})
        dress(axes, "radius (mm)", "Cauchy stress (kPa)" if place == 0 else "", title)
    legend(figure.axes[0], loc="best")
    return figure


def _through_wall(axes: Axes, layers: dict[str, WholeGrid]) -> None:
    """Nodal stress against current radius, the layers shaded and named."""
    ends = []
    for number, (layer_name, grid) in enumerate(layers.items()):
        place = grid.middle, grid.line(1)
        radius = grid.points[place][:, 1]
        fill, edge = layer_colour(number)
        axes.axvspan(radius[0], radius[-1], color=fill, alpha=0.28, linewidth=0.0)
        ends += [radius[0], radius[-1]]
        for name, label, colour, line, marker in CURVES:
            axes.plot(
                radius,
                grid.point_data[name][place],
                color=colour,
                linestyle=line,
                marker=marker,
                markersize=3.4,
                linewidth=1.6,
                label=label if number == 0 else None,
            )
        axes.text(
            0.5 * (radius[0] + radius[-1]),
            0.985,
            plain(layer_name),
            transform=axes.get_xaxis_transform(),
            ha="center",
            va="top",
            fontsize=SMALL,
            color=edge,
        )
    axes.axhline(0.0, color=FAINT, linewidth=0.8)
    for boundary in ends[1:-1:2]:
        axes.axvline(boundary, color=INK, linewidth=0.8)
    margin = 0.02 * (ends[-1] - ends[0])
    axes.set_xlim(ends[0] - margin, ends[-1] + margin)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.08 * (high - low))
    axes.locator_params(axis="x", nbins=6)
