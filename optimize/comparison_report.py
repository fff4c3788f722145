"""What a comparison of clamps leaves: compare.json, every clamp's outputs, the figures, and one page."""

from __future__ import annotations

import re
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from jaxclamp import BadFolder, Progress
from jaxclamp.pictures.plots import Plate, png, svg
from jaxclamp.pictures.plots.maps import plot_axial_stress_side_by_side, plot_damage_side_by_side
from jaxclamp.pictures.plots.style import (
    AXIAL,
    FAINT,
    INK,
    SMALL,
    Picture,
    dress,
    legend,
)
from jaxclamp.show.console import as_json, thresholds
from jaxclamp.show.export import write_outputs
from jaxclamp.show.report import document, figure_section, number, section, table
from optimize.comparison import Clamped, Comparison, path, row
from optimize.figures import profile
from optimize.journal import write_bytes, write_whole
from optimize.named_measures import in_words

TABLE, PAGE, FIGURES, CLAMPS = "compare.json", "report.html", "figures", "clamps"
LINES = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#1d2733", "#8f7413")
"""of Okabe and Ito, and two more: a curve for each clamp"""


def write_comparison(
    found: Comparison, folder: Path, progress: Callable[[Progress], Any] | None = None
) -> list[Path]:
    """Write everything; returns the files to open."""
    tell = progress or (lambda event: None)
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / TABLE, as_json(found.to_dict()) + "\n")  # first, whatever happens to pictures
    reached = [each for each in found.clamps if each.at_stop is not None]
    for place, each in enumerate(reached):
        tell(Progress("writing", place / (len(reached) + 1), each.asked.name))
        assert each.at_stop is not None
        write_outputs(each.at_stop, folder / CLAMPS / file_name(each))
    (folder / FIGURES).mkdir(parents=True, exist_ok=True)
    plates = []
    for plate in plates_of(found):
        plates.append((plate, png(plate.figure)))
        write_bytes(folder / FIGURES / f"{plate.name}.png", plates[-1][1])
        write_bytes(folder / FIGURES / f"{plate.name}.svg", svg(plate.figure))
    write_whole(folder / PAGE, page(found, plates))
    tell(Progress("writing", 1.0, f"report in {folder}"))
    return [folder / PAGE, folder / TABLE]


def require_ours(folder: Path) -> None:
    """Refuse a folder where a page or figures of something else would be replaced. Raises BadFolder."""
    if (folder / TABLE).exists():
        return
    if there := next((name for name in (PAGE, FIGURES, CLAMPS) if (folder / name).exists()), None):
        raise BadFolder(f"--out: {there} in {str(folder)!r} is not of a comparison: take another folder")


def file_name(each: Clamped) -> str:
    """A folder's name for a clamp."""
    return re.sub(r"[^\w.-]+", "-", each.asked.name).strip("-.") or "clamp"


def plates_of(found: Comparison) -> list[Plate]:
    """The figures that the clamps which converged allow."""
    ranked = [each for each in found.clamps if each.ranked is not None]
    plates = []
    if ranked:
        said = (
            f"{in_words(found.measure).capitalize()} at the scene's stop, with its numerical error, and the "
            "faces of the jaws, to one scale."
        )
        results = {each.asked.name: each.at_stop for each in ranked if each.at_stop is not None}
        plates.append(Plate("ranking", "Which clamp", said, plot_ranking(found, ranked)))
        said = (
            "Axial Cauchy stress of the innermost layer at the scene's stop, unrolled, the highest through "
            "its thickness, on one scale. A cross marks the highest of all."
        )
        plates.append(Plate("axial_stress", "Where it pulls", said, plot_axial_stress_side_by_side(results)))
        said = (
            "Damage of the innermost layer at the scene's stop in the same view, on one scale: the share of "
            "its strain energy that a point would lose by a law that begins at the energy in the body. "
            "Post-processed; a scale to compare clamps on."
        )
        plates.append(Plate("damage", "Where it damages", said, plot_damage_side_by_side(results)))
    if any(each.closed is not None for each in found.clamps):
        said = (
            "Force on one jaw against its travel from first contact, to closure (mark) and on to the same "
            "force for all. The steeper the rise past the mark, the more clearly closure is felt. Where the "
            "way was walked on a coarser mesh, curves are of that mesh up to the mark."
        )
        plates.append(Plate("force_travel", "What the hand feels", said, plot_forces(found)))
    return plates


def plot_ranking(found: Comparison, ranked: list[Clamped]) -> Picture:
    """The measure of every clamp, best on top, beside its face."""
    unit, factor = found.unit
    figure = Picture(8.6, 0.62 * len(ranked) + 1.0)
    grid = figure.add_gridspec(len(ranked), 2, width_ratios=[1.5, 1.0])
    axes = figure.add_subplot(grid[:, 0])
    values = [each.ranked.value / factor for each in ranked if each.ranked is not None]
    known = [each.ranked.error for each in ranked if each.ranked is not None]
    errors = [np.nan if error is None else error / factor for error in known]  # no bar where none is known
    places = np.arange(len(ranked))
    axes.barh(places, values, 0.55, xerr=errors, color=AXIAL, ecolor=INK, capsize=2.5)
    axes.set_yticks(places, [each.asked.name for each in ranked], fontsize=SMALL)
    axes.invert_yaxis()
    dress(axes, f"{in_words(found.measure)} ({unit})" if unit else in_words(found.measure))
    faces = [profile(each.at_stop) for each in ranked if each.at_stop is not None]
    wide = max(float(np.nanmax(np.abs(face[0]))) for face in faces)
    high = max(float(np.nanmax(face[1]) - np.nanmin(face[1])) for face in faces)
    for place, face in enumerate(faces):
        panel = figure.add_subplot(grid[place, 1])
        panel.plot(*face, color=FAINT, linewidth=1.5)
        low = float(np.nanmin(face[1]))
        panel.set(xlim=(-wide, wide), ylim=(low - 0.1 * high, low + 1.1 * high), aspect="equal")
        panel.axis("off")
    return figure


def plot_forces(found: Comparison) -> Picture:
    """Force against travel of every clamp that closed."""
    figure = Picture(6.4, 4.0)
    axes = figure.add_subplot()
    for place, each in enumerate(found.clamps):
        result = each.pressed or each.closed
        if result is None:
            continue
        colour = LINES[place % len(LINES)]
        axes.plot(*path(result), color=colour, linewidth=1.6, label=each.asked.name)
        if each.closed is not None:
            final = each.closed.final
            axes.plot(final["jaw_travel_mm"], final["clamp_force_N"], "o", color=colour, markersize=5)
    dress(axes, "travel of each jaw (mm)", "force on one jaw (N)")
    axes.set_ylim(bottom=0.0)
    legend(axes)
    return figure


def page(found: Comparison, plates: list[tuple[Plate, bytes]]) -> str:
    """The page of a comparison."""
    unit, factor = found.unit
    measure = f"{in_words(found.measure)}, {unit}".rstrip(", ")
    head = ["rank", "clamp", measure, "force, N", "closes at, N", "rise at closure"]
    rows = [row(found, place, factor) for place in range(len(found.clamps))]
    said = (
        "<p>The least comes first. Clamps of one rank (=) differ by no more than the error of their "
        "difference, which is estimated on the difference. The rise at closure is a jaw's travel over "
        "the last quarter of its closing force, over that for a quarter more.</p>"
    )
    failed = [
        f"<li>{escape(f'{each.asked.name}: {why}')}</li>" for each in found.clamps for why in each.failures
    ]
    sections = [
        f"<h1>{escape(found.title or 'Comparison of clamps')}</h1>",
        section("Ranking", said + table(head, rows, 2)),
        figure_section(plates),
        section("At the scene's stop, closed, and at equal force", _figures(found)),
        section("Above your thresholds", _thresholds(found)),
        section("What failed, or is in doubt", f"<ul>{''.join(failed)}</ul>" if failed else ""),
        section("Clamps", table(["clamp", "what it is", "source of its numbers"], _sources(found), 3)),
    ]
    return document(found.title or "Comparison of clamps", sections)


def _sources(found: Comparison) -> list[list[str]]:
    return [[each.asked.name, each.asked.title, each.asked.source or "–"] for each in found.clamps]


SHOWN = (
    ("clamp_force_N", "force on one jaw"),
    ("jaw_travel_mm", "travel of each jaw"),
    ("smooth_peak_axial_stress_kPa", "smooth peak axial stress"),
    ("axial_stress_at_P_kPa", "axial stress at P"),
    ("damage", "damage, mean"),
    ("max_contact_pressure_kPa", "greatest contact pressure"),
    ("closed_length_mm", "closed length"),
)


def _thresholds(found: Comparison) -> str:
    """Table of the scene's thresholds at its stop, clamp by clamp; nothing if there are none."""
    rows = [
        [each.asked.name, *row]
        for each in found.clamps
        if each.at_stop is not None
        for row in thresholds(each.at_stop.final)
    ]
    head = ["clamp", "at the scene's stop", "threshold", "share above", "peak over threshold", "source"]
    return table(head, rows, 6) if rows else ""


def _figures(found: Comparison) -> str:
    """Main figures of every clamp at the three states."""
    states = ["at the stop", "closed"] + ([f"at {found.force_N:.4g} N"] if found.force_N is not None else [])
    rows = []
    for each in found.clamps:
        results = (each.at_stop, each.closed, each.pressed)[: len(states)]
        for state, result in zip(states, results, strict=True):
            if result is None:
                continue
            cells: list[str] = []
            for key, _ in SHOWN:
                value = result.final[key]
                parts = value.values() if isinstance(value, dict) else [value]
                cells.append("; ".join(number(part, key) for part in parts))
            rows.append([each.asked.name, state, *cells])
    return table(["clamp", "state", *(label for _, label in SHOWN)], rows, 2) if rows else ""
