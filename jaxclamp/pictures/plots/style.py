"""One look for all figures: colours for everybody's eyes, sizes for a printed page."""

from __future__ import annotations

import dataclasses
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
    quick = {"compress_level": 3}  # a quarter of a second less for all figures of a run, a tenth larger
    figure.savefig(buffer, format="png", dpi=dots_per_inch, metadata={"Software": None}, pil_kwargs=quick)
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


def colour_bar(figure: Figure, colours: Any, label: str, beyond: str) -> None:
    """One bar of colours (a ScalarMappable) for all maps of a figure, with arrows where values go beyond."""
    bar = figure.colorbar(colours, ax=figure.axes, shrink=0.75, pad=0.02, aspect=28, extend=beyond)
    bar.set_label(label, fontsize=SMALL, color=INK)
    bar.ax.tick_params(labelsize=SMALL, labelcolor=INK)
    bar.outline.set_visible(False)


def layer_colour(number: int) -> tuple[str, str]:
    """Fill and edge of a layer, counted from 0 inside."""
    return LAYERS[number % len(LAYERS)], LAYER_EDGES[number % len(LAYER_EDGES)]


def stress_colours() -> Colormap:
    """From pale (low) to dark (high), even in lightness, legible in grey and with any colour vision."""
    from matplotlib import colormaps

    return LinearSegmentedColormap.from_list("stress", colormaps["magma_r"](np.linspace(0.03, 0.9, 256)))


OUTSIDE = 0.005
"""share of what is drawn that may lie beyond either end of a range of colours"""


@dataclasses.dataclass(frozen=True)
class Colours:
    """A range of colours for all maps of a figure that single points do not stretch."""

    limits: tuple[float, float]
    """where the colours end"""
    extremes: tuple[float, float]
    """least and greatest of all values"""

    @property
    def beyond(self) -> str:
        """At which ends there are values beyond the colours, as matplotlib calls it."""
        low, high = self.extremes[0] < self.limits[0], self.extremes[1] > self.limits[1]
        return {(True, True): "both", (True, False): "min", (False, True): "max"}.get((low, high), "neither")

    def said(self, by: str) -> str:
        """How far the values go where the colours do not; by: what percentiles are by, such as "volume"."""
        if self.beyond == "neither":
            return ""
        low, high = self.extremes
        ends = f"{100 * OUTSIDE:g}th to {100 * (1 - OUTSIDE):g}th percentile by {by}"
        return f", in all {low:.3g} to {high:.3g};\ncolours: {ends}".replace("-", "\N{MINUS SIGN}")


def colours(values: Sequence[np.ndarray], weights: Sequence[np.ndarray], step: float) -> Colours:
    """The range that leaves out at most `OUTSIDE` of any of the arrays, widened to multiples of `step`.

    values, weights: of each array and its points, (n,)
    """
    ends = np.array([_middle(v, w) for v, w in zip(values, weights, strict=True)])
    low, high = float(np.min(ends[:, 0])), float(np.max(ends[:, 1]))
    low, high = step * np.floor(low / step), step * max(np.ceil(high / step), np.floor(low / step) + 1.0)
    every = np.concatenate(values)
    return Colours((low, high), (float(np.min(every)), float(np.max(every))))


def _middle(values: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """The values below and above which lies a share `OUTSIDE` of the weight."""
    order = np.argsort(values)
    share = np.cumsum(weights[order]) / np.sum(weights)
    places = np.searchsorted(share, [OUTSIDE, 1.0 - OUTSIDE])
    low, high = values[order][np.minimum(places, len(values) - 1)]
    return float(low), float(high)


def letters(count: int) -> list[str]:
    """A, B, C, ..."""
    return [chr(ord("A") + i) for i in range(count)]


def plain(name: str) -> str:
    """A user's name as text: not too long, no mathematics between dollar signs, not hidden from legends."""
    return shortened(name, LONGEST_NAME).replace("$", r"\$").lstrip("_") or "layer"
