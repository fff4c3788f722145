"""What changes while the jaws close: stress at P, force and occlusion against travel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes

from jaxclamp.pictures.plots.states import Clamped, shown_states
from jaxclamp.pictures.plots.style import (
    AXIAL,
    CIRCUMFERENTIAL,
    FAINT,
    INK,
    NORMAL,
    THIRD,
    Picture,
    dress,
    legend,
)


def _column(history: Sequence[dict[str, Any]], key: str) -> list[float]:
    return [float("nan") if record[key] is None else float(record[key]) for record in history]


def plot_stress_at_P(result: Clamped) -> Picture:
    """Axial and circumferential stress at P over their values in the body, against jaw travel."""
    marked, history = shown_states(result), result.history
    travel = _column(history, "jaw_travel_mm")
    figure = Picture(5.6, 3.7)
    axes = figure.add_subplot()
    axes.axhline(1.0, color=FAINT, linewidth=0.8)
    for key, label, colour, line, marker in (
        ("axial_stress_ratio_at_P", "axial, $s_z$", AXIAL, "-", "s"),
        ("circumferential_stress_ratio_at_P", r"circumferential, $s_\theta$", CIRCUMFERENTIAL, "--", "o"),
    ):
        values = _column(history, key)
        axes.plot(
            travel,
            values,
            color=colour,
            linestyle=line,
            marker=marker,
            markersize=3,
            linewidth=1.8,
            label=label,
        )
        places = list(marked.values())
        axes.plot(
            [travel[i] for i in places],
            [values[i] for i in places],
            linestyle="none",
            marker=marker,
            markersize=7,
            markerfacecolor="white",
            markeredgecolor=colour,
            markeredgewidth=1.6,
        )
    dress(axes, "travel of each jaw (mm)", "stress at P / stress at P in the body")
    _letter_states(axes, travel, marked)
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    legend(axes, loc="best")
    return figure


def _letter_states(axes: Axes, travel: Sequence[float], marked: dict[str, int]) -> None:
    """Letters of the shown states along the top of a graph, with a light line down to the curves."""
    for letter, place in marked.items():
        axes.axvline(travel[place], color=FAINT, linewidth=0.5, linestyle=(0, (2, 3)))
        axes.text(
            travel[place],
            1.01,
            letter,
            transform=axes.get_xaxis_transform(),
            ha="center",
            va="bottom",
            fontsize=NORMAL,
            color=INK,
            fontweight="bold",
        )


def plot_force_travel(result: Clamped) -> Picture:
    """Force on one jaw, and occlusion of the lumen, against travel."""
    marked, history = shown_states(result), result.history
    travel = _column(history, "jaw_travel_mm")
    figure = Picture(5.6, 3.7)
    axes = figure.add_subplot()
    (force,) = axes.plot(
        travel,
        _column(history, "clamp_force_N"),
        color=THIRD,
        marker="o",
        markersize=4,
        linewidth=1.8,
        label="jaw force",
    )
    dress(axes, "travel of each jaw (mm)", "force on one jaw (N)")
    axes.set_ylim(bottom=0.0)
    second = axes.twinx()
    lines = [force]
    for key, label, style in (
        ("occlusion", "occlusion (height)", "--"),
        ("area_occlusion", "occlusion (area)", ":"),
    ):
        percent = [100.0 * value for value in _column(history, key)]
        lines += second.plot(
            travel, percent, color=CIRCUMFERENTIAL, linestyle=style, linewidth=1.5, label=label
        )
    dress(second, y="occlusion (%)", grid=False)
    second.spines["right"].set(visible=True, color=FAINT, linewidth=0.7)
    second.spines["left"].set_visible(False)
    second.set_ylim(0.0, 100.0)
    axes.yaxis.label.set_color(THIRD)
    second.yaxis.label.set_color(CIRCUMFERENTIAL)
    _letter_states(axes, travel, marked)
    legend(second, handles=lines, loc="upper left")
    return figure
