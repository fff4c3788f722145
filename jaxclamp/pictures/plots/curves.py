"""What changes while the jaws close: stress at P, force and occlusion against travel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from jaxclamp.pictures.plots.states import Clamped, meshes_of, path_of, shown_states
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
    marked, path = shown_states(result), path_of(result).history
    figure = Picture(5.6, 3.7)
    axes = figure.add_subplot()
    axes.axhline(1.0, color=FAINT, linewidth=0.8)
    for key, label, colour, line, marker in (
        ("axial_stress_ratio_at_P", "axial, $s_z$", AXIAL, "-", "s"),
        ("circumferential_stress_ratio_at_P", r"circumferential, $s_\theta$", CIRCUMFERENTIAL, "--", "o"),
    ):
        axes.plot(
            _column(path, "jaw_travel_mm"),
            _column(path, key),
            color=colour,
            linestyle=line,
            marker=marker,
            markersize=3,
            linewidth=1.8,
            label=label,
        )
        _mark(axes, result, key, marked, colour, marker)
    dress(axes, "travel of each jaw (mm)", "stress at P / stress at P in the body")
    _letter_states(axes, _column(result.history, "jaw_travel_mm"), marked)
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    legend(axes, handles=[*axes.get_legend_handles_labels()[0], *_meshes(result, marked)], loc="best")
    return figure


def _mark(axes: Axes, result: Clamped, key: str, marked: dict[str, int], colour: str, marker: str) -> None:
    """Large marks of the shown states: filled on the result's own mesh where the path has another one."""
    walked_elsewhere = path_of(result) is not result
    for place in marked.values():
        own = walked_elsewhere and result.closing[place].model is result.model
        axes.plot(
            _column(result.history[place : place + 1], "jaw_travel_mm"),
            _column(result.history[place : place + 1], key),
            linestyle="none",
            marker=marker,
            markersize=7,
            markerfacecolor=colour if own else "white",
            markeredgecolor=colour,
            markeredgewidth=1.6,
        )


def _meshes(result: Clamped, marked: dict[str, int]) -> list[Line2D]:
    """What says in a legend that the states at both ends lie beside the curve because of their finer mesh."""
    if (meshes := meshes_of(result, marked)) is None:
        return []
    own, path = meshes
    filled = Line2D([], [], color=FAINT, linestyle="none", marker="o", markersize=8, label=own)
    return [Line2D([], [], color=FAINT, label=f"curve: {path}"), filled]


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
    marked, history = shown_states(result), path_of(result).history
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
    _mark(axes, result, "clamp_force_N", marked, THIRD, "o")
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
    _letter_states(axes, _column(result.history, "jaw_travel_mm"), marked)
    legend(second, handles=[*lines, *_meshes(result, marked)], loc="upper left")
    return figure
