"""The page of a sweep: how its jobs ended, what was varied against what came of it, and why jobs failed."""

from __future__ import annotations

from collections import Counter
from html import escape
from pathlib import Path
from typing import Any

from jaxclamp.pictures.plots import Plate, png
from jaxclamp.pictures.plots.style import AXIAL, Picture, dress
from jaxclamp.show.report import document, figure_section, number, section, table
from optimize.journal import write_bytes, write_whole
from optimize.sweep_file import Sweep
from optimize.sweep_folder import DONE, RESULTS

PAGE, FIGURE = "report.html", "scatter.png"
MOST_ROWS, MOST_VARIED = 200, 6
PEAK = "smooth_peak_axial_stress_kPa."
SHOWN = ("clamp_force_N", "jaw_travel_mm")


def write_sweep(sweep: Sweep, rows: list[dict[str, Any]], folder: Path) -> list[Path]:
    """Write the page; returns the files to open."""
    plates = []
    if (picture := plot_scatter(rows, varied(sweep))) is not None:
        said = "What was varied, against the innermost layer's smooth peak axial stress and the jaw's force."
        plates.append((Plate("scatter", "What depends on what", said, picture), png(picture)))
        write_bytes(folder / FIGURE, plates[0][1])
    write_whole(folder / PAGE, page(sweep, rows, plates))
    return [folder / PAGE, folder / RESULTS]


def varied(sweep: Sweep) -> list[str]:
    """Every key that some job has a value of its own of."""
    return list(dict.fromkeys(key for job in sweep.jobs for key in job.varied))


def figures_of(rows: list[dict[str, Any]]) -> list[str]:
    """The figures that are drawn and tabled."""
    known = list(dict.fromkeys(name for row in rows for name in row))
    return [
        *[name for name in known if name.startswith(PEAK)][:1],
        *[name for name in SHOWN if name in known],
    ]


def plot_scatter(rows: list[dict[str, Any]], keys: list[str]) -> Picture | None:
    """Each number that was varied against the main figures; None if there is nothing to draw."""
    solved = [row for row in rows if row["status"] == DONE]
    numbers = [k for k in keys if solved and all(isinstance(row.get(k), float | int) for row in solved)]
    numbers, figures = numbers[:MOST_VARIED], figures_of(solved)[:2]
    if not numbers or not figures:
        return None
    picture = Picture(2.6 * len(numbers) + 0.8, 2.4 * len(figures) + 0.3)
    grid = picture.subplots(len(figures), len(numbers), squeeze=False, sharex="col", sharey="row")
    for i, figure in enumerate(figures):
        for j, key in enumerate(numbers):
            grid[i, j].plot(
                [row[key] for row in solved],
                [row[figure] for row in solved],
                "o",
                color=AXIAL,
                markersize=3.5,
            )
            last = i == len(figures) - 1
            dress(grid[i, j], key.rpartition(".")[2] if last else "", "" if j else label(figure))
    return picture


def label(figure: str) -> str:
    """A figure as the label of an axis."""
    return f"peak axial stress, {figure.removeprefix(PEAK)} (kPa)" if figure.startswith(PEAK) else figure


def counts(rows: list[dict[str, Any]]) -> str:
    """How many jobs ended how."""
    found = Counter(row["status"] for row in rows)
    return ", ".join(f"{count} {status}" for status, count in found.most_common())


def page(sweep: Sweep, rows: list[dict[str, Any]], plates: list[tuple[Plate, bytes]]) -> str:
    """The page of a sweep."""
    keys, figures = varied(sweep), figures_of(rows)
    cells = lambda row, names: [_cell(row.get(name)) for name in names]  # noqa: E731
    body = [
        [str(row["job"]), row["name"] or "–", *cells(row, keys), row["status"], *cells(row, figures)]
        for row in rows[:MOST_ROWS]
    ]
    failed = [[str(row["job"]), row["status"], str(row["failure"])] for row in rows if row["failure"]]
    more = (
        f"<p>The first {MOST_ROWS} of {len(rows)}; all are in {RESULTS}.</p>" if len(rows) > MOST_ROWS else ""
    )
    ended = f"{len(rows)} of {len(sweep.jobs)} jobs: {counts(rows)}."
    sections = [
        f"<h1>{escape(sweep.title)}</h1><p>{escape(ended)}</p>",
        figure_section(plates) if plates else "",
        section("Why jobs failed", table(["job", "status", "why"], failed[:MOST_ROWS], 3) if failed else ""),
        section("Jobs", more + table(["job", "name", *keys, "status", *figures], body, 2 + len(keys) + 1)),
    ]
    return document(sweep.title, sections)


def _cell(value: Any) -> str:
    return "–" if value is None else value if isinstance(value, str) else number(value)


def lines(sweep: Sweep, rows: list[dict[str, Any]]) -> list[str]:
    """What came of it, for a terminal."""
    failed = [f"  job {row['job']}: {row['failure']}" for row in rows if row["failure"]]
    return [f"{len(rows)} of {len(sweep.jobs)} jobs: {counts(rows)}", *failed[:20]]
