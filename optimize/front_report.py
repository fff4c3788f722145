"""What a study with two objectives leaves: every design's scene and outputs, the front, and one page."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from jaxclamp import Progress
from jaxclamp.pictures.plots import Plate, png, svg
from jaxclamp.pictures.plots.style import AXIAL, FAINT, INK, NORMAL, Picture, dress, legend
from jaxclamp.show.export import write_outputs
from jaxclamp.show.report import document, figure_section, number, section, table
from optimize.figures import COLOURS, labelled, profile
from optimize.front import BEATEN, WITHIN, Front
from optimize.gains import with_error
from optimize.journal import write_bytes, write_whole


def write_front(
    found: Front, folder: Path, title: str, progress: Callable[[Progress], Any] | None = None
) -> list[Path]:
    """Outputs of every point in its folder, front.png and report.html; returns the files to open."""
    tell = progress or (lambda event: None)
    for number_, point in enumerate(found.points):
        tell(Progress("writing", number_ / len(found.points), point.folder))
        write_outputs(point.result, folder / point.folder / "best")
    plates = []
    for plate in plates_of(found):
        plates.append((plate, png(plate.figure)))
        write_bytes(folder / f"{plate.name}.png", plates[-1][1])
        write_bytes(folder / f"{plate.name}.svg", svg(plate.figure))
    write_whole(folder / "report.html", page(found, title, plates))
    tell(Progress("writing", 1.0, f"report in {folder}"))
    return [folder / "report.html", folder / "front.png", folder / "study.json"]


def plates_of(found: Front) -> list[Plate]:
    """The front, and the jaws on it."""
    front_said = (
        "Each point is the best design found in the first objective for its limit on the second, with bars "
        "for the numerical errors of both. Hollow points are beaten by another clamp in both; half-filled "
        "ones by no more than the error of the difference, which is mostly far smaller than the bars. The "
        "start and the reference need not meet the study's constraints."
    )
    jaws_said = "Faces of the jaws, to scale, from the least first objective to the least second one."
    return [
        Plate("front", "What they cost each other", front_said, plot_front(found)),
        Plate("profiles", "The jaws", jaws_said, plot_jaws(found)),
    ]


FILLS = {"": "full", BEATEN: "none", WITHIN: "left"}
"""of marks, by where a point stands"""


def plot_front(found: Front) -> Picture:
    """The second objective against the first, of every point, of the start and of the reference."""
    figure = Picture(6.4, 4.2)
    axes = figure.add_subplot()
    on = [[e.value for e in found.values(p.folder)] for p in found.points if not found.standing(p.folder)]
    if on:
        axes.plot(*np.transpose(on), "-", color=AXIAL, linewidth=1.4)
    for name in found.estimates:
        x, y = found.values(name)
        beside = name in found.others
        axes.errorbar(
            x.value,
            y.value,
            xerr=x.error,
            yerr=y.error,
            fmt="s" if beside else "o",
            color=COLOURS[name] if beside else AXIAL,
            fillstyle="full" if beside else FILLS[found.standing(name)],
            markersize=6,
            elinewidth=0.8,
            capsize=2.0,
            label=name if beside else None,
        )
        if not beside:
            axes.annotate(
                name, (x.value, y.value), (6, 4), textcoords="offset points", fontsize=8.0, color=FAINT
            )
    first, second = map(labelled, found.objectives)
    dress(axes, first, second)
    if found.others:
        legend(axes)
    return figure


def plot_jaws(found: Front) -> Picture:
    """The faces of all jaws on the front, one above the other, all to one scale."""
    figure = Picture(7.2, 1.3 * len(found.points) + 0.6)
    panels = figure.subplots(len(found.points), 1, squeeze=False, sharex=True, sharey=True)[:, 0]
    for axes, point in zip(panels, found.points, strict=True):
        axes.plot(*profile(point.result), color=AXIAL, linewidth=1.6)
        axes.set_aspect("equal")
        dress(axes, "", "height (mm)", point.folder)
    panels[-1].set_xlabel("position along the artery (mm)", fontsize=NORMAL, color=INK)
    return figure


def _values(found: Front, name: str) -> list[str]:
    """Both objectives of a clamp with their errors."""
    return [with_error(e.value, e.error, "") for e in found.values(name)]


def page(found: Front, title: str, plates: list[tuple[Plate, bytes]]) -> str:
    """The page of a front."""
    first, second = map(labelled, found.objectives)
    rows = [
        [
            p.folder,
            *_values(found, p.folder),
            number(p.limit),
            f"{p.violation:.1%}",
            found.standing(p.folder),
            str(p.evaluations),
        ]
        for p in found.points
    ]
    rows += [[name, *_values(found, name), "–", "–", found.standing(name), ""] for name in found.others]
    head = ["", first, second, "limit on the second", "constraints violated by", "", "designs"]
    searches = "; ".join(f"{p.folder}: {p.stopped_because}" for p in found.points)
    design = table(
        ["variable", *(p.folder for p in found.points)],
        [
            [entry.name, *(number(float(p.design[i] / entry.factor)) for p in found.points)]
            for i, entry in enumerate(found.problem.entries)
        ],
    )
    notice = "" if found.warning is None else f'<div class="notice"><b>{escape(found.warning)}.</b></div>'
    said = (
        f"<h1>{escape(title)}</h1><p>{escape(first)} against {escape(second[:1].lower() + second[1:])}.</p>"
    )
    return document(
        title,
        [
            said + notice,
            figure_section(plates),
            section("Points", f'{table(head, rows)}<p class="faint">Searches: {escape(searches)}.</p>'),
            section("Designs", design),
        ],
    )
