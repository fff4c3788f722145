"""What a fit leaves: fit.json, the fitted scene, figures of data and residuals, one page, lines for the
console."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from jaxclamp import BadFolder, Progress, dump_scene
from jaxclamp.pictures.plots import Plate, png, svg
from jaxclamp.pictures.plots.style import AXIAL, CIRCUMFERENTIAL, FAINT, THIRD, Picture, dress, legend
from jaxclamp.show.console import as_json
from jaxclamp.show.report import document, figure_section, section, table
from optimize.fit import Fit
from optimize.journal import write_bytes, write_whole

TABLE, SCENE, PAGE, FIGURES = "fit.json", "scene.toml", "report.html", "figures"
COLOURS = (CIRCUMFERENTIAL, AXIAL, THIRD, "#cc79a7", "#e69f00", "#56b4e9")
"""of files"""


def write_fit(found: Fit, folder: Path, progress: Callable[[Progress], Any] | None = None) -> list[Path]:
    """Write everything; returns the files to open."""
    tell = progress or (lambda event: None)
    (folder / FIGURES).mkdir(parents=True, exist_ok=True)
    write_whole(folder / TABLE, as_json(found.to_dict()) + "\n")  # first, whatever happens to pictures
    write_whole(folder / SCENE, dump_scene(found.scene))
    plates = []
    for plate in plates_of(found):
        plates.append((plate, png(plate.figure)))
        write_bytes(folder / FIGURES / f"{plate.name}.png", plates[-1][1])
        write_bytes(folder / FIGURES / f"{plate.name}.svg", svg(plate.figure))
    write_whole(folder / PAGE, page(found, plates))
    tell(Progress("writing", 1.0, f"report in {folder}"))
    return [folder / PAGE, folder / SCENE, folder / TABLE]


def require_ours(folder: Path) -> None:
    """Refuse a folder where files of something else would be replaced. Raises BadFolder."""
    if (folder / TABLE).exists():
        return
    if there := next((name for name in (SCENE, PAGE, FIGURES) if (folder / name).exists()), None):
        raise BadFolder(f"--out: {there} in {str(folder)!r} is not of a fit: take another folder")


def plates_of(found: Fit) -> list[Plate]:
    """Data with the fitted law, and what is left."""
    said = "What was measured (marks) and the fitted law at the same places (lines), a colour for each file."
    left = "Fitted law less measurement, in the order of what it is drawn against. Scatter has no shape."
    return [
        Plate("fit", "Data and fitted law", said, plot_fit(found)),
        Plate("residuals", "Residuals", left, plot_residuals(found)),
    ]


def plot_fit(found: Fit) -> Picture:
    """Every column that was compared, measured and predicted."""
    return _panels(found, residuals=False)


def plot_residuals(found: Fit) -> Picture:
    """Every column's residuals."""
    return _panels(found, residuals=True)


def _panels(found: Fit, residuals: bool) -> Picture:
    names = found.problem.names
    figure = Picture(6.4, (2.2 if residuals else 2.8) * len(names) + 0.4)
    panels = figure.subplots(len(names), 1, squeeze=False)[:, 0]
    for number, (which, begin, end) in enumerate(found.problem.runs):
        each, column = found.problem.experiments[which], found.problem.column(number)
        axes = panels[names.index(column.name)]
        kept = ~np.isnan(column.values)
        along = each.along.values[kept] / each.along.factor
        order = np.argsort(along, kind="stable")
        predicted, measured = (
            values[begin:end] / column.factor for values in (found.predicted, found.problem.measured)
        )
        colour = COLOURS[which % len(COLOURS)]
        if residuals:
            axes.axhline(0.0, color=FAINT, linewidth=0.7)
            axes.plot(
                along[order], (predicted - measured)[order], ".-", color=colour, markersize=3, linewidth=0.6
            )
        else:
            label = Path(each.data.source).stem
            axes.plot(along, measured, "o", color=colour, markersize=2.5, alpha=0.5, label=label)
            axes.plot(along[order], predicted[order], color=colour, linewidth=1.6)
        dress(axes, _labelled(each.along.name), _labelled(column.name))
    if not residuals and len(found.problem.experiments) > 1:
        legend(panels[0])
    return figure


def _labelled(name: str) -> str:
    return name.replace("_", " ")[:60]


def lines(found: Fit) -> list[str]:
    """The fit on the console."""
    said = [f"  {'':<44}{'fitted':>10}  {'95 % confidence':<24}"]
    said += [f"  {row[0]:<44}{row[1]:>10}  {row[2]:<24}{row[4]}".rstrip() for row in _rows(found)]
    said += ["", "  left of the data (root mean square)"]
    said += [f"  {name:<44}{each.rms:>10.3g} {each.unit}" for name, each in found.residuals.items()]
    return said


def _rows(found: Fit) -> list[list[str]]:
    rows = []
    for parameter, value, sure in zip(
        found.freedom.parameters, found.values, found.confidence.intervals, strict=True
    ):
        low = f"{sure.lower:.4g}" if sure.bounded[0] else "–"
        high = f"{sure.upper:.4g}" if sure.bounded[1] else "–"
        error = f"{sure.standard_error:.2g}" if np.isfinite(sure.standard_error) else "–"
        told = "" if sure.identified else "not identified"
        rows.append([parameter.key, f"{value:.4g}", f"{low} to {high}", error, told])
    return rows


def page(found: Fit, plates: list[tuple[Plate, bytes]]) -> str:
    """The page of a fit."""
    title = found.scene.title or "Constants from test data"
    head = ["number of the scene", "fitted", "95 % confidence", "standard error", ""]
    columns = [
        [name, f"{each.rms:.3g} {each.unit}".strip(), str(each.n)] for name, each in found.residuals.items()
    ]
    state = "" if found.follows else '<p class="notice">The law cannot follow these data: see below.</p>'
    how = (
        f"<p>Columns are weighed by {escape(found.best.weighed_by)}. {found.best.agreeing} of "
        f"{found.best.starts} starts ended at this optimum. A dash: the data set no bound.</p>"
    )
    sections = [
        f"<h1>{escape(title)}</h1>{state}",
        section("Fitted numbers", table(head, _rows(found), 1) + how),
        section("What the data tell only together, or not at all", _items(found.confidence.weak)),
        section("What they tell together", _items(found.confidence.strong)),
        section("What is left of the data", table(["column", "root mean square", "values"], columns, 1)),
        section("What to know", _items(found.warnings)),
        figure_section(plates),
        section("Scene", f"<pre>{escape(dump_scene(found.scene))}</pre>"),
    ]
    return document(title, sections)


def _items(said: tuple[str, ...]) -> str:
    items = "".join(f"<li>{escape(text)}</li>\n" for text in said)
    return f"<ul>{items}</ul>" if items else ""
