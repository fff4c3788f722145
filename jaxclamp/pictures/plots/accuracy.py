"""Error against time over the numerical choices of a scene."""

from __future__ import annotations

import dataclasses

from matplotlib.ticker import NullFormatter

from jaxclamp.pictures.plots.style import FAINT, INK, LAYER_EDGES, SMALL, Picture, dress

MARKERS = "osD^v<>P*Xph"
COLUMNS = 3
LEAST_ERROR = 1e-6
"""what is nearer than this to the reference is drawn here"""


@dataclasses.dataclass(frozen=True)
class Panel:
    """Errors of one figure: (time in s, relative error) of every variant, by what is varied."""

    label: str
    points: dict[str, list[tuple[float, float]]]
    front: list[tuple[float, float]]
    """the variants that no other beats in both"""


def plot_prices(panels: list[Panel]) -> Picture:
    """A panel per figure: relative error of every variant against its time, and the front of both."""
    height = -(-len(panels) // COLUMNS)
    figure = Picture(3.4 * COLUMNS, 2.9 * height + 0.5)
    for number, panel in enumerate(panels):
        axes = figure.add_subplot(height, COLUMNS, number + 1)
        axes.plot(*_drawable(panel.front), color=FAINT, linewidth=1.0, drawstyle="steps-post", zorder=1)
        for place, (group, points) in enumerate(panel.points.items()):
            colour = LAYER_EDGES[place % len(LAYER_EDGES)]
            axes.plot(
                *_drawable(points),
                linestyle="none",
                marker=MARKERS[place % len(MARKERS)],
                markersize=5,
                color=colour,
                markerfacecolor="white" if place >= len(LAYER_EDGES) else colour,
                label=group,
            )
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.xaxis.set_minor_formatter(NullFormatter())
        dress(axes, "time of one clamping (s)", "" if number % COLUMNS else "relative error", panel.label)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=6, fontsize=SMALL, frameon=False, labelcolor=INK
    )
    return figure


def _drawable(points: list[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [time for time, _ in points], [max(error, LEAST_ERROR) for _, error in points]
