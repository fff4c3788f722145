"""A price list as lines, as a Markdown table, and as files."""

from __future__ import annotations

import csv
import io
import tempfile
from collections.abc import Iterator
from pathlib import Path

from jaxclamp.pictures.plots.accuracy import Panel, plot_prices
from jaxclamp.pictures.plots.style import png, svg
from jaxclamp.show.console import as_json, name_and_unit
from jaxclamp.show.export import STAGING, into_place
from jaxclamp.solve.results import versions
from jaxclamp.trust.estimates import SOURCES
from jaxclamp.trust.price_list import GRADIENT, Price, PriceList, machine

LABELS = {
    "physiological.lumen_radius_mm": "lumen radius",
    "clamp_force_N": "jaw force",
    "axial_stress_at_P_kPa": "axial stress at P",
    GRADIENT: "slope by jaw size",
}
HEAD = ("varied", "setting", "elements", "seconds", "MB")


def shown_figures(prices: PriceList) -> dict[str, str]:
    """Key and short name of the figures in tables: radius, force, stresses of P's layer, a slope."""
    peaks = {
        key: "smooth peak" if key.startswith("smooth") else "true peak"
        for key in prices.exact
        if "peak_axial_stress_kPa." in key and key.endswith(f".{prices.layer}")
    }
    return {key: label for key, label in (LABELS | peaks).items() if key in prices.exact}


def rows(prices: PriceList) -> Iterator[list[str]]:
    """A row of texts for each variant; an asterisk marks errors on the front of time and error."""
    keys = shown_figures(prices)
    fronts = {key: prices.front(key) for key in keys}
    for price in prices.prices:
        if price.figures is None:
            yield [price.group, price.setting, *["-"] * (len(HEAD) - 2), *["-"] * len(keys)]
            continue
        errors = []
        for key in keys:
            error = prices.error(price, key)
            errors.append("-" if error is None else f"{error:.2%}{'*' if price in fronts[key] else ''}")
        memory = "-" if price.memory_MB is None else f"{price.memory_MB:.0f}"
        yield [price.group, price.setting, str(price.elements), f"{price.seconds:.2f}", memory, *errors]


def lines(prices: PriceList) -> list[str]:
    """The table for a terminal."""
    table = [[*HEAD, *shown_figures(prices).values()], *rows(prices)]
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    texts = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in table]
    return [f"{prices.title}: relative errors and what they cost", "", *texts, "", *notes(prices)]


def notes(prices: PriceList) -> list[str]:
    """What the table rests on."""
    refused = [f"{p.group} {p.setting}: {p.failure}" for p in prices.prices if p.figures is None]
    orders = [
        f"{label} {prices.limits[key].order:.1f}{'' if prices.limits[key].believed else ' (assumed)'}"
        for key, label in shown_figures(prices).items()
    ]
    return [
        "* on the front: no other variant is both faster and nearer",
        "reference: extrapolated over three meshes, less what the penalties add; orders of convergence: "
        + ", ".join(orders),
        *refused,
    ]


def markdown(prices: PriceList) -> str:
    """The price list as a document."""
    bar = lambda cells: "| " + " | ".join(cells) + " |"  # noqa: E731
    head = [*HEAD, *shown_figures(prices).values()]
    table = [bar(head), bar(["---"] * 2 + ["---:"] * (len(head) - 2)), *map(bar, rows(prices))]
    sources = [bar(["figure", "exact", *(name.replace("_", " ") for name in SOURCES)])]
    sources.append(bar(["---", *["---:"] * (len(SOURCES) + 1)]))
    for key, found in prices.sources.items():
        name, unit = name_and_unit(key)
        parts = [found[source] for source in SOURCES]
        cells = ["-" if part is None else f"{part:+.2g}" for part in parts]
        sources.append(bar([f"{name} ({unit})" if unit else name, f"{prices.exact[key]:.5g}", *cells]))
    code = ", ".join(f"{name} {number}" for name, number in versions().items() if name in ("jaxclamp", "jax"))
    return "\n".join(
        [
            f"# What accuracy costs: {prices.title}",
            "",
            f"Machine: {machine()}; {code}. Seconds are of one clamping with everything compiled.",
            "",
            *table,
            "",
            *(f"- {note.replace('*', chr(92) + '*')}" for note in notes(prices)),
            "",
            "## Where the error of the scene itself comes from",
            "",
            "Signed estimates, in the unit of the figure.",
            "",
            *sources,
            "",
        ]
    )


def panels(prices: PriceList) -> list[Panel]:
    """What the figure shows."""
    groups = list(dict.fromkeys(price.group for price in prices.prices if price.figures is not None))

    def points(key: str, chosen: list[Price]) -> list[tuple[float, float]]:
        return [(p.seconds, e) for p in chosen if (e := prices.error(p, key)) is not None]

    return [
        Panel(
            label=label,
            points={g: points(key, [p for p in prices.prices if p.group == g]) for g in groups},
            front=points(key, prices.front(key)),
        )
        for key, label in shown_figures(prices).items()
    ]


def csv_text(prices: PriceList) -> str:
    """One row per variant: figures and relative errors."""
    buffer = io.StringIO()
    names = [*prices.exact, *(f"error of {key}" for key in prices.exact)]
    fixed = ["group", "setting", "elements", "unknowns", "newton_iterations", "seconds", "memory_MB"]
    writer = csv.DictWriter(buffer, [*fixed, *names], restval="", lineterminator="\n")
    writer.writeheader()
    for price in prices.prices:
        writer.writerow({name: getattr(price, name) for name in fixed} | _numbers(prices, price))
    return buffer.getvalue()


def _numbers(prices: PriceList, price: Price) -> dict[str, float]:
    if price.figures is None:
        return {}
    errors = {f"error of {key}": e for key in prices.exact if (e := prices.error(price, key)) is not None}
    return price.figures | errors


def write_prices(prices: PriceList, folder: Path) -> list[Path]:
    """accuracy.md, .csv, .json, .png and .svg in a folder, whole or not at all. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=STAGING, dir=folder) as staging:
        place = Path(staging)
        (place / "accuracy.md").write_text(markdown(prices), encoding="utf-8")
        (place / "accuracy.csv").write_text(csv_text(prices), encoding="utf-8", newline="")
        (place / "accuracy.json").write_text(as_json(prices.to_dict()) + "\n", encoding="utf-8")
        figure = plot_prices(panels(prices))
        (place / "accuracy.png").write_bytes(png(figure))
        (place / "accuracy.svg").write_bytes(svg(figure))
        return into_place(place, folder, sorted(place.iterdir()))
