"""What a study leaves when it is done: outputs of start and best, figures, and one page."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

from jaxclamp import Progress, dump_scene
from jaxclamp import shown_in as figures_in
from jaxclamp.pictures.plots import Plate, png
from jaxclamp.show.export import write_outputs
from jaxclamp.show.report import document, figure_section, number, section, table
from optimize.figures import figures, shown
from optimize.gains import Gain
from optimize.journal import write_bytes, write_whole
from optimize.record import FEASIBLE
from optimize.study import Study


def write_study(
    study: Study, folder: Path, title: str, progress: Callable[[Progress], Any] | None = None
) -> list[Path]:
    """Outputs of the start and the best design, figures/ and report.html; returns the files to open."""
    tell = progress or (lambda event: None)
    for name, result in (("start", study.start), ("best", study.best)):
        tell(Progress("writing", 0.2 if name == "start" else 0.5, f"{name} design"))
        write_outputs(result, folder / name)
        write_whole(folder / name / "scene.toml", dump_scene(result.scene))
    plates: list[tuple[Plate, bytes]] = []
    (folder / "figures").mkdir(exist_ok=True)
    for plate in figures(study):
        plates.append((plate, png(plate.figure)))
        write_bytes(folder / "figures" / f"{plate.name}.png", plates[-1][1])
    write_whole(folder / "report.html", page(study, title, plates))
    tell(Progress("writing", 1.0, f"report in {folder}"))
    return [folder / "report.html", folder / "best" / "report.html", folder / "study.json"]


def page(study: Study, title: str, plates: list[tuple[Plate, bytes]]) -> str:
    """The page of a study."""
    sections = [
        _opening(study, title),
        figure_section(plates),
        section("Start and best", _comparison(study)),
        section("On a finer mesh, with stiffer and sharper contact", _verification(study)),
        section("Design", _design(study)),
        section("Best scene", f"<pre>{escape(dump_scene(study.best.scene))}</pre>"),
    ]
    return document(title, sections)


def _opening(study: Study, title: str) -> str:
    value = lambda result: result.measure(study.problem.objective)  # noqa: E731
    unit, start, best = study.problem.objective.unit, value(study.start), value(study.best)
    boxes = [Gain(start, best, unit).card("the start")]
    if study.reference is not None:
        boxes.append(Gain(value(study.reference), best, unit).card("the reference"))
    boxes += [
        (f"{best:.4g} {unit}".rstrip(), str(study.problem.objective)),
        (str(len(study.evaluations)), "designs evaluated"),
    ]
    cards = "".join(f"<div><b>{escape(big)}</b>{escape(said)}</div>" for big, said in boxes)
    parts = [f"<h1>{escape(title)}</h1>", f'<p class="faint">{escape(study.stopped_because)}</p>']
    if (said := warning(study)) is not None:
        parts.append(f'<div class="notice"><b>{escape(said[:1].upper() + said[1:])}.</b></div>')
    return "\n".join(parts) + f'\n<div class="headlines">{cards}</div>'


def warning(study: Study) -> str | None:
    """What a reader has to know before building this jaw; None if nothing."""
    best = next(e for e in study.evaluations if e.design is study.best_design)
    if best.violation(study.problem) > FEASIBLE:
        return f"no design met the constraints; the best violates them by {best.violation(study.problem):.1%}"
    if study.verification is not None and not study.verification.survives:
        return study.verification.sentence
    return None


def _comparison(study: Study) -> str:
    results = shown(study)
    layers = [layer.name for layer in study.best.scene.artery.layers]
    rows = [
        [f"peak stress, {f.label}, {layer} (kPa)", *(number(r.final[f.key][layer]) for r in results.values())]
        for f in figures_in("study peaks")
        for layer in layers
    ]
    rows += [
        [f.label, *(number(r.final[f.key], f.key) for r in results.values())] for f in figures_in("study")
    ]
    return table(["at the stop", *results], rows)


def _verification(study: Study) -> str:
    found = study.verification
    if found is None:
        return "<p>Not done.</p>"
    layers = [layer.name for layer in study.best.scene.artery.layers]
    peak = "peak_axial_stress_kPa"
    results = {name: result for name, result in shown(study).items() if name in found.final}
    models = (("study's model", {n: r.final for n, r in results.items()}), ("finer", found.final))
    rows = [
        [
            f"true peak axial stress, {layer}, {model} (kPa)",
            *(number((finals[name] or {peak: {layer: None}})[peak][layer]) for name in results),
        ]
        for layer in layers
        for model, finals in models
    ]
    unit = study.problem.objective.unit
    unit = f" ({unit})" if unit else ""
    rows.append([f"objective, study's model{unit}", *(number(found.coarse[name]) for name in results)])
    rows.append([f"objective, finer{unit}", *(number(found.fine[name]) for name in results)])
    sentence = found.sentence
    return f"<p>{escape(sentence[:1].upper() + sentence[1:])}.</p>" + table(["", *results], rows)


def _design(study: Study) -> str:
    rows = []
    for entry, start, best in zip(study.problem.entries, study.problem.start, study.best_design, strict=True):
        values = (v / entry.factor for v in (entry.lower, start, best, entry.upper))
        rows.append([entry.name, *map(number, map(float, values))])
    return table(["variable", "lower", "start", "best", "upper"], rows)
