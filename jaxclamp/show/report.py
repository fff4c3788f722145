"""One self-contained HTML page about a clamping: figures, numbers, checks, model, scene and cost."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Iterable, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxclamp.core.failures import SceneError
from jaxclamp.fem.symmetry import AXES, Symmetry
from jaxclamp.observe.figures import shown_in
from jaxclamp.pictures.fields import layer_fields
from jaxclamp.show.console import name_and_unit, thresholds
from jaxclamp.trust.estimates import SOURCES

if TYPE_CHECKING:
    from jaxclamp.pictures.plots import Plate
    from jaxclamp.solve.results import Result

UNITS = {"mm": "mm", "mm2": "mm²", "kPa": "kPa", "N": "N", "mN": "mN", "uJ": "µJ", "s": "s", "MB": "MB"}

PIXELS_PER_INCH = 100
"""of figures on the page"""

STYLE = """
:root { color-scheme: light dark; --ink: #1d2733; --faint: #5b6673; --rule: #d5dae0; --page: #ffffff;
  --card: #f4f6f8; --good: #1c7a4a; --look: #b25000; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6eaee; --faint: #a3adb8; --rule: #38414c;
  --page: #14181d; --card: #1e242b; --good: #5fc28c; --look: #f0a05a; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2.2rem 1.2rem 4rem; max-width: 62rem; background: var(--page);
  color: var(--ink); font: 15px/1.5 system-ui, -apple-system, "Segoe UI", sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 { font-size: 1.15rem; margin: 2.4rem 0 .7rem; padding-bottom: .25rem;
  border-bottom: 1px solid var(--rule); }
p { margin: .4rem 0; } .faint { color: var(--faint); }
.notice { border-left: 4px solid var(--look); background: var(--card); padding: .7rem 1rem; margin: 1rem 0; }
.headlines { display: grid; grid-template-columns: repeat(auto-fit, minmax(12rem, 1fr)); gap: .8rem;
  margin: 1.3rem 0; }
.headlines div { background: var(--card); border-radius: 6px; padding: .8rem 1rem; min-width: 0;
  overflow-wrap: anywhere; }
.headlines b { display: block; font-size: 1.6rem; font-weight: 600; font-variant-numeric: tabular-nums; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .3rem .8rem .3rem 0; border-bottom: 1px solid var(--rule);
  vertical-align: top; }
th { font-weight: 600; color: var(--faint); }
td.number, th.number { text-align: right; padding-right: 1.4rem; } td.number { white-space: nowrap; }
.scroll + .scroll { margin-top: 1.4rem; }
.good, .look { color: var(--good); font-weight: 600; white-space: nowrap; } .look { color: var(--look); }
figure { margin: 1.4rem 0; break-inside: avoid; }
figure img { display: block; margin: 0 auto; max-width: 100%; height: auto; background: #fff;
  border: 1px solid var(--rule); border-radius: 6px; padding: .6rem; }
figcaption { color: var(--faint); margin-top: .5rem; }
figcaption b { color: var(--ink); }
pre { background: var(--card); border-radius: 6px; padding: 1rem; white-space: pre-wrap;
  overflow-wrap: anywhere; font-size: .82rem; line-height: 1.45; }
@media print { body { max-width: none; padding: .5rem 0; font-size: 10pt; } h2 { break-after: avoid; }
  tr { break-inside: avoid; } figure img { width: auto; max-height: 9.6cm; }
  .headlines { grid-template-columns: repeat(4, 1fr); } }
"""


def write_report(result: Result, path: Path, plates: Iterable[tuple[Plate, bytes]] | None = None) -> Path:
    """Write the page; `plates` are figures with their PNG files, drawn here if not given."""
    if plates is None:
        from jaxclamp.pictures.plots import figures, png

        plates = [(plate, png(plate.figure)) for plate in figures(result)]
    path.write_text(page(result, plates), encoding="utf-8")
    return path


def page(result: Result, plates: Iterable[tuple[Plate, bytes]]) -> str:
    """The whole page."""
    content = result.to_dict()
    title = content["title"] or "Clamping of an artery"
    sections = [
        _opening(title, content, result),
        figure_section(plates),
        section("Numbers", _numbers(content, result)),
        section("Above your thresholds", thresholds_table(content["final"])),
        section("Numerical errors", _errors(content["errors"])),
        section("Checks", _checks(checks(result))),
        section("Notes", _notes(content["notes"])),
        section("Model", _model(content["model"])),
        section("Scene", _scene(result)),
        section("Cost and versions", _cost(content)),
    ]
    return document(title, sections)


def _scene(result: Result) -> str:
    """The scene as TOML."""
    from jaxclamp.scenes.files import dump_scene

    try:
        return f"<pre>{escape(dump_scene(result.scene))}</pre>"
    except SceneError as error:  # constants of each point
        return f"<p>{escape(str(error))}</p>"


def document(title: str, sections: Iterable[str]) -> str:
    """A self-contained page of sections."""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(part for part in sections if part)
        + "\n</body>\n</html>\n"
    )


# --------------------------------------------------------------------------------- pieces of text


def number(value: Any, key: str = "") -> str:
    """A value of result.json with the unit in its key, to four digits; a dash for none."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if key.endswith("occlusion"):
        return f"{value:.1%}"
    unit = UNITS.get(key.rpartition("_")[2], "")
    size = abs(value)
    text = f"{value:.4g}" if size == 0.0 or 1e-3 <= size < 1e5 else f"{value:.1e}"
    return f"{text} {unit}".rstrip()


def section(title: str, body: str) -> str:
    """A headed part of the page; nothing without a body."""
    return f"<section><h2>{escape(title)}</h2>\n{body}</section>" if body else ""


def table(head: Sequence[str], rows: Iterable[Sequence[str]], numbers_from: int = 1) -> str:
    """A table; texts are escaped here, cells from column `numbers_from` on are set flush right."""

    def row(cells: Sequence[str], tag: str) -> str:
        right = lambda i: ' class="number"' if i >= numbers_from else ""  # noqa: E731
        return "".join(f"<{tag}{right(i)}>{escape(cell)}</{tag}>" for i, cell in enumerate(cells))

    first = f"<thead><tr>{row(head, 'th')}</tr></thead>" if any(head) else ""
    body = "".join(f"<tr>{row(cells, 'td')}</tr>\n" for cells in rows)
    return f'<div class="scroll"><table>{first}<tbody>{body}</tbody></table></div>'


def _opening(title: str, content: dict[str, Any], result: Result) -> str:
    final = content["final"]
    model = content["model"]
    lines = [f"<h1>{escape(title)}</h1>"]
    counts = f"{model['elements']:,} elements ({model['element']}), {model['unknowns']:,} unknowns"
    counts += f", {len(result.states)} converged states"
    own = result.scene.mesh.words
    if coarser := sorted({record["mesh"] for record in content["history"]} - {own}):
        counts += (
            f"; the closing path was walked on {' and '.join(coarser)} elements, "
            f"the states in the body and at the stop are of {own}"
        )
    lines.append(f'<p class="faint">{escape(counts)}</p>')
    if not content["converged"]:
        reason = content["failure"] or "the stop was not reached"
        lines.append(
            '<div class="notice"><b>The stop was not reached.</b> All numbers and figures are of the '
            f"states that did converge. {escape(reason[:1].upper() + reason[1:])}</div>"
        )
    boxes = [
        f"<div><b>{escape(number(final[figure.key], figure.key))}</b>{escape(figure.label)}</div>"
        for figure in shown_in("headlines")
        if final.get(figure.key) is not None
    ]
    return "\n".join(lines) + (f'\n<div class="headlines">{"".join(boxes)}</div>' if boxes else "")


def figure_section(plates: Iterable[tuple[Plate, bytes]]) -> str:
    """The figures, embedded, with their captions."""
    parts = []
    for plate, image in plates:
        data = base64.b64encode(image).decode("ascii")
        width = round(PIXELS_PER_INCH * plate.figure.get_figwidth())
        parts.append(
            f'<figure id="{escape(plate.name)}"><img alt="{escape(plate.title)}" width="{width}" '
            f'src="data:image/png;base64,{data}"><figcaption><b>{escape(plate.title)}.</b> '
            f"{escape(plate.caption)}</figcaption></figure>"
        )
    return section("Figures", "\n".join(parts))


def _numbers(content: dict[str, Any], result: Result) -> str:
    layers, symmetry = result.model.marks.layer_names, result.model.symmetry
    final, body = content["final"], (content["history"] or [{}])[0]
    rows = [
        ["lumen radius, load-free", number(content["load_free"]["lumen_radius_mm"], "_mm"), "–"],
        ["lumen radius, in the body", number(content["physiological"]["lumen_radius_mm"], "_mm"), "–"],
    ]
    parts = [table(["before clamping", "value"], [row[:2] for row in rows])]
    if final:
        shown = [(figure.key, figure.label) for figure in shown_in("numbers")]
        rows = [[label, number(body.get(key), key), number(final.get(key), key)] for key, label in shown]
        parts.append(table(["", "in the body", "last state"], rows))
        rows = [
            [f"{figure.label} ({figure.unit})", *(number(final[figure.key].get(name)) for name in layers)]
            for figure in shown_in("peaks")
            if final.get(figure.key)
        ]
        places = final.get("peak_axial_stress_location_mm") or {}
        at = ["place of the axial peak: x, y, z (mm)"]
        at += [_place(places.get(name) or (), symmetry) for name in layers]
        parts.append(table(["highest stress in the last state", *layers], [*rows, at]))
        rows = [
            [figure.label, *(number(final[figure.key].get(name), figure.key) for name in layers)]
            for figure in shown_in("means")
            if final.get(figure.key)
        ]
        parts.append(table(["mean over the layer in the last state", *layers], rows))
        parts.append(
            '<p class="faint">Lumen sizes are those of the whole artery at mid-length. Peaks are over the '
            "quadrature points; x runs along the fold axis, y along the compression axis, z along the "
            "artery, and each place stands for its mirror images in the planes of the model too.</p>"
        )
    return "\n".join(parts)


def thresholds_table(final: dict[str, Any]) -> str:
    """Table of the scene's `[[injury]]`; nothing if there are none."""
    rows = thresholds(final)
    if not rows:
        return ""
    said = (
        "Shares are of a layer's volume, or of the area under the jaws where they press, in the last state. "
        "They say how far values lie above the thresholds of the scene file, and no more: whether an artery "
        "is injured there is for the source of the threshold to say."
    )
    table_ = table(["", "threshold", "share above", "peak over threshold", "source"], rows, 5)
    return f'{table_}<p class="faint">{escape(said)}</p>'


def _place(place: Sequence[float], symmetry: Symmetry) -> str:
    """Coordinates x, y, z, mm; of mirror images the one on the positive side."""
    known = zip(place, AXES, strict=False)
    return ", ".join(f"{abs(c) if axis in symmetry else c:z.2f}" for c, axis in known)


def _errors(errors: dict[str, dict[str, float | None]] | None) -> str:
    """Table of the estimated errors by figure and source; nothing if there are none."""
    if not errors:
        return ""

    def cells(key: str, e: dict[str, float | None]) -> list[str]:
        label, unit = name_and_unit(key)
        signed = lambda v: "–" if v is None else f"{v:+.2g}"  # noqa: E731
        error = "–" if e["error"] is None else f"± {e['error']:.2g}"
        sources = [signed(e[source]) for source in SOURCES]
        return [label, number(e["value"], f"_{unit}"), error, *sources]

    head = ["figure", "value", "error", "mesh", "bulk modulus", "contact stiffness", "contact smoothing"]
    said = (
        "Estimates of what the discretisation adds to each figure, in its unit: the mesh by a coarser twin, "
        "the penalties by the solution's derivatives. The error is the sum of their sizes. It does not "
        "cover the model: material constants, symmetry, friction."
    )
    rows = [cells(key, e) for key, e in errors.items()]
    return f'{table(head, rows)}<p class="faint">{escape(said)}</p>'


# --------------------------------------------------------------------------------- checks


def checks(result: Result) -> list[tuple[str, str, str, bool]]:
    """(what, value, what is expected, as expected) of the independent checks on the last state."""
    content = result.to_dict()
    final, solver = content["final"], content["solver"]
    wall = sum(float(layer.thickness) for layer in result.scene.artery.layers)
    deepest, smallest, largest = 0.05 * wall, *_volume_ratios(result)
    rows: list[tuple[str, str, Any, str, Callable[[Any], bool]]] = [
        (
            "balance of vertical forces, relative",
            "",
            solver["force_balance_error"],
            "below 1e-6",
            lambda v: v < 1e-6,
        ),
        ("forces left on free nodes", "_mN", solver["residual_mN"], "below 1e-4 mN", lambda v: v < 1e-4),
        (
            "work of the jaws against the change of energy, relative",
            "",
            solver["work_balance_error"],
            "below 0.01",
            lambda v: v < 0.01,
        ),
        (
            "deepest point of the wall inside a jaw",
            "_mm",
            final.get("max_penetration_mm"),
            f"below {deepest:.2g} mm, 5% of the wall",
            lambda v: v < deepest,
        ),
        ("smallest volume ratio of a cell", "", smallest, "above 0.95", lambda v: v > 0.95),
        ("largest volume ratio of a cell", "", largest, "below 1.05", lambda v: v < 1.05),
        ("smallest volume ratio at a point", "", final.get("J_min"), "above 0.5", lambda v: v > 0.5),
        ("largest volume ratio at a point", "", final.get("J_max"), "below 2", lambda v: v < 2.0),
        ("negative pivots of the tangent", "", solver["negative_pivots"], "0: stable", lambda v: v == 0),
        ("stability lost and regained on the way", "", solver["snapped"], "no", lambda v: not v),
        (
            "which equilibrium it is",
            "",
            solver["branch"],
            "on the path of closing jaws",
            lambda v: not v.startswith("another"),
        ),
    ]
    return [
        (what, value if isinstance(value, str) else number(value, key), expected, bool(fine(value)))
        for what, key, value, expected, fine in rows
        if value is not None
    ]


def _volume_ratios(result: Result) -> tuple[float | None, float | None]:
    """Smallest and largest mean volume ratio of a cell in the last state."""
    if not result.states:
        return None, None
    J = [layer.cell_data["J"] for layer in layer_fields(result.states[-1].model, result.states[-1].state)]
    return min(float(v.min()) for v in J), max(float(v.max()) for v in J)


def _checks(found: list[tuple[str, str, str, bool]]) -> str:
    rows = "".join(
        f'<tr><td>{escape(what)}</td><td class="number">{escape(value)}</td><td>{escape(expected)}</td>'
        f'<td class="{"good" if fine else "look"}">{"as expected" if fine else "look here"}</td></tr>\n'
        for what, value, expected, fine in found
    )
    head = '<tr><th>check of the last state</th><th class="number">value</th><th>expected</th><th></th></tr>'
    return (
        f'<div class="scroll"><table><thead>{head}</thead><tbody>{rows}</tbody></table></div>' if rows else ""
    )


def _notes(notes: list[str]) -> str:
    """The notes on what is unlikely; nothing if there are none."""
    items = "".join(f"<li>{escape(note)}</li>\n" for note in notes)
    return f"<ul>{items}</ul>" if items else ""


def _model(model: dict[str, Any]) -> str:
    said = {
        "modelled": "modelled part",
        "elements": "elements",
        "element": "element",
        "unknowns": "unknowns",
        "peak_sharpness": "exponent of the smooth peak",
    }
    rows = [(said[key], value if isinstance(value, str) else number(value)) for key, value in model.items()
            if key in said]  # fmt: skip
    terms = model["terms"]
    rows += list(terms.items()) if isinstance(terms, dict) else [("term", str(term)) for term in terms]
    return table(["", ""], rows, numbers_from=2)


def _cost(content: dict[str, Any]) -> str:
    labels = {"s": "seconds", "MB": "MB"}
    rows = []
    for key, value in {**content["solver"], **content["cost"]}.items():
        name, _, unit = key.rpartition("_")
        label = name.replace("_", " ") if unit in labels else key.replace("_", " ")
        if key not in (
            "residual_mN",
            "force_balance_error",
            "work_balance_error",
            "snapped",
            "negative_pivots",
        ):
            rows.append((label, value if isinstance(value, str) else number(value, key)))
    rows += [(name, str(version)) for name, version in content["versions"].items()]
    return table(["", ""], rows)
