"""One look for all figures: colours for everybody's eyes, sizes for a printed page."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure

from jaxclamp.scenes.wording import shortened

INK, FAINT, RULE = "#1d2733", "#5b6673", "#d5dae0"
LAYERS = ("#e8a08c", "#8fb4d6", "#e5cf86", "#9cc7a4", "#bda6cf")
"""fills of the layers, from inside to outside (pale: lines and letters go on top)"""
LAYER_EDGES = ("#a8452c", "#2a5f8f", "#8f7413", "#2f7040", "#62458a")
JAW, JAW_EDGE = "#c3c9d0", "#5b6673"
AXIAL, CIRCUMFERENTIAL, THIRD = "#d55e00", "#0072b2", "#009e73"
"""vermilion, blue and green of Okabe and Ito: told apart with any kind of colour vision"""

SMALL, NORMAL, LARGE = 8.0, 9.0, 10.5
LONGEST_NAME = 28
"""characters of a layer's name in a figure"""
DOTS_PER_INCH = 200


class Picture(Figure):
    """A figure that shows itself in notebooks and belongs to no global list."""

    def __init__(self, width: float, height: float) -> None:
        super().__init__(figsize=(width, height), layout="constrained", facecolor="white")
        FigureCanvasAgg(self)

    def _repr_png_(self) -> bytes:
        return png(self, 110)


def png(figure: Figure, dots_per_inch: int = DOTS_PER_INCH) -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dots_per_inch, metadata={"Software": None})
    return buffer.getvalue()


def svg(figure: Figure) -> bytes:
    """The figure as an SVG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Creator": None, "Date": None})
    return buffer.getvalue()


def dress(axes: Axes, x: str = "", y: str = "", title: str = "", grid: bool = True) -> None:
    """Labels, ticks and frame of a graph."""
    axes.set_xlabel(x, fontsize=NORMAL, color=INK)
    axes.set_ylabel(y, fontsize=NORMAL, color=INK)
    axes.set_title(title, fontsize=LARGE, color=INK, loc="left")
    axes.tick_params(labelsize=SMALL, colors=FAINT, labelcolor=INK, width=0.7, length=3.0)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set(color=FAINT, linewidth=0.7)
    if grid:
        axes.grid(color=RULE, linewidth=0.5)
        axes.set_axisbelow(True)


def legend(axes: Axes, **options: Any) -> None:
    """A legend on a white patch without a border."""
    axes.legend(
        fontsize=SMALL,
        facecolor="white",
        edgecolor="none",
        framealpha=0.9,
        labelcolor=INK,
        handlelength=2.2,
        **options,
    )


def colour_bar(figure: Figure, colours: Any, label: str) -> None:
    """One bar of colours (a ScalarMappable) for all maps of a figure."""
    bar = figure.colorbar(colours, ax=figure.axes, shrink=0.75, pad=0.02, aspect=28)
    bar.set_label(label, fontsize=NORMAL, color=INK)
    bar.ax.tick_params(labelsize=SMALL, labelcolor=INK)
    bar.outline.set_visible(False)


def layer_colour(number: int) -> tuple[str, str]:
    """Fill and edge of a layer, counted from 0 inside."""
    return LAYERS[number % len(LAYERS)], LAYER_EDGES[number % len(LAYER_EDGES)]


def stress_colours() -> Colormap:
    """From pale (low) to dark (high), even in lightness, legible in grey and with any colour vision."""
    from matplotlib import colormaps

    return LinearSegmentedColormap.from_list("stress", colormaps["magma_r"](np.linspace(0.03, 0.9, 256)))


def nice_limits(values: Sequence[np.ndarray], step: float) -> tuple[float, float]:
    """Range of all values, widened to multiples of `step`."""
    low = min(float(np.min(v)) for v in values)
    high = max(float(np.max(v)) for v in values)
    return step * np.floor(low / step), step * max(np.ceil(high / step), np.floor(low / step) + 1.0)


def letters(count: int) -> list[str]:
    """A, B, C, ..."""
    return [chr(ord("A") + i) for i in range(count)]


def plain(name: str) -> str:
    """A user's name as text: not too long, no mathematics between dollar signs, not hidden from legends."""
    return shortened(name, LONGEST_NAME).replace("$", r"\$").lstrip("_") or "layer"
