"""Uncertainty of a run's figures: a table for the terminal, uncertainty.json, and a tornado figure."""

from __future__ import annotations

import tempfile
from pathlib import Path

from jaxclamp.pictures.plots.style import png, svg
from jaxclamp.pictures.plots.tornado import plot_tornado
from jaxclamp.show.console import as_json
from jaxclamp.show.export import STAGING, into_place
from jaxclamp.solve.results import Result
from jaxclamp.trust.uncertainty import Uncertainty

FILE, FIGURE = "uncertainty.json", "tornado"
DRAWN = ("smooth_peak_axial_stress_kPa", "clamp_force_N", "axial_stress_at_P_kPa")
"""figures of the tornado, as far as they are there; of a layer's, the innermost's"""


def write_uncertainty(found: Uncertainty, result: Result, folder: Path) -> list[Path]:
    """Write the table and the figure, whole or not at all; returns their files. Raises OSError."""
    picture = plot_tornado({key: found.parts[key] for key in drawn(found)})
    with tempfile.TemporaryDirectory(prefix=STAGING, dir=folder) as staging:
        place = Path(staging)
        (place / "figures").mkdir()
        (place / FILE).write_text(as_json(found.to_dict(result.errors)) + "\n", encoding="utf-8")
        (place / "figures" / f"{FIGURE}.png").write_bytes(png(picture))
        (place / "figures" / f"{FIGURE}.svg").write_bytes(svg(picture))
        return into_place(place, folder, [place / FILE, *sorted((place / "figures").iterdir())])


def drawn(found: Uncertainty) -> list[str]:
    """The figures that are drawn."""
    first = [[key for key in found.values if key == name or key.startswith(f"{name}.")] for name in DRAWN]
    return [keys[0] for keys in first if keys]


def lines(found: Uncertainty, result: Result) -> list[str]:
    """Figures with their error by the mesh and their standard deviation by the numbers of the scene."""
    errors = result.errors or {}
    extra = f", of {found.samples} solved samples" if found.sampled is not None else ""
    names = ", ".join(found.covariance.keys)
    said = ["", f"uncertain because of {names}: ± numerical error; standard deviation{extra}"]
    for key, value in found.values.items():
        error = errors.get(key, {}).get("error")
        numerical = "?" if error is None else f"{error:.2g}"
        drawn_too = "" if found.sampled is None else f"; {found.sampled[key]:.2g}"
        said.append(f"  {key:<52}{value:<10.4g} ± {numerical:<9} {found.sd[key]:.2g}{drawn_too}")
    if found.covariance.wide:
        wide = ", ".join(found.covariance.wide)
        said.append(f"  {wide}: uncertain by more than half; first order does not hold so far, use --samples")
    return said
