"""What a study leaves when it is done: outputs of start and best, figures, and one page."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

from jaxclamp import Progress, dump_scene
from jaxclamp import shown_in as figures_in
from jaxclamp.pictures.plots import Plate, png, svg
from jaxclamp.show.export import write_outputs
from jaxclamp.show.report import document, figure_section, number, section, table
from optimize.figures import figures, labelled, shown
from optimize.front import Front
from optimize.front_report import write_front
from optimize.gains import with_error
from optimize.journal import write_bytes, write_whole
from optimize.named_measures import in_words
from optimize.record import FEASIBLE
from optimize.study import Study


def write_found(
    found: Study | Front, folder: Path, title: str, progress: Callable[[Progress], Any] | None = None
) -> list[Path]:
    """What a study of one objective or of two leaves; returns the files to open."""
    write: Any = write_front if isinstance(found, Front) else write_study
    files: list[Path] = write(found, folder, title, progress)
    return files


def write_study(
    study: Study, folder: Path, title: str, progress: Callable[[Progress], Any] | None = None
) -> list[Path]:
    """Outputs of the start and the best design, figures/ and report.html; returns the files to open."""
    tell = progress or (lambda event: None)
    for name, result in (("start", study.start), ("best", study.best)):
        tell(Progress("writing", 0.2 if name == "start" else 0.5, f"{name} design"))
        write_outputs(result, folder / name)
    plates: list[tuple[Plate, bytes]] = []
    (folder / "figures").mkdir(exist_ok=True)
    for plate in figures(study):
        plates.append((plate, png(plate.figure)))
        write_bytes(folder / "figures" / f"{plate.name}.png", plates[-1][1])
        write_bytes(folder / "figures" / f"{plate.name}.svg", svg(plate.figure))
    write_whole(folder / "report.html", page(study, title, plates))
    tell(Progress("writing", 1.0, f"report in {folder}"))
    return [folder / "report.html", folder / "best" / "report.html", folder / "study.json"]


def page(study: Study, title: str, plates: list[tuple[Plate, bytes]]) -> str:
    """The page of a study."""
    sections = [
        _opening(study, title),
        section("The price: everything else that injures", _price(study)),
        figure_section(plates),
        section("Start and best", _comparison(study)),
        section("On a finer mesh, with stiffer and sharper contact", _verification(study)),
        section("Design", _design(study)),
        section("Best scene", f"<pre>{escape(dump_scene(study.best.scene))}</pre>"),
    ]
    return document(title, sections)


def _opening(study: Study, title: str) -> str:
    objective, compared = study.problem.objective, study.compared
    names = {"start": "the start", "reference": "the reference"}
    gains = {said: compared.gain(name) for name, said in names.items()}
    boxes = [gain.card(said) for said, gain in gains.items() if gain is not None]
    boxes += [
        (compared.value("best"), f"{in_words(objective)}, best"),
        (str(len(study.evaluations)), "designs evaluated"),
    ]
    cards = "".join(f"<div><b>{escape(big)}</b>{escape(said)}</div>" for big, said in boxes)
    parts = [
        f"<h1>{escape(title)}</h1>",
        f"<p>{escape(opening_sentence(study))}</p>",
        f'<p class="faint">{escape(study.stopped_because)}</p>',
    ]
    if (said := warning(study)) is not None:
        parts.append(f'<div class="notice"><b>{escape(_capital(said))}.</b></div>')
    return "\n".join(parts) + f'\n<div class="headlines">{cards}</div>'


def opening_sentence(study: Study) -> str:
    """What was minimised, what came of it, and what it costs."""
    objective, compared = study.problem.objective, study.compared
    values = ", ".join(f"{name} {compared.value(name)}" for name in ("best", compared.other))
    gain = compared.gain(compared.other)
    return f"{labelled(objective)}: {values}; best is {gain}. {_capital(compared.sentence)}."


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _price(study: Study) -> str:
    """The table of every other injury measure, on the study's model and on the finer one."""
    models, other = [("study's model", study.compared)], study.compared.other
    finer = None if study.verification is None else study.verification.after
    if finer is not None and finer.price and finer.other == other:
        models.append(("finer model", finer))
    rows = [
        [
            f"{labelled(change.measure)}, {model}",
            number(change.best.value),
            number(change.other.value),
            with_error(change.difference.value, change.difference.error, ""),
            change.word,
        ]
        for changes in zip(*(compared.price for _, compared in models), strict=False)
        for (model, _), change in zip(models, changes, strict=True)
    ]
    said = (
        f"Best against {other}. The error of a difference is estimated on the difference: for each source "
        "(mesh by a coarser twin, bulk modulus, stiffness and smoothing of contact by derivatives of the "
        "solution) the signed estimate of the one less that of the other, and the sum of the sizes of what "
        "is left."
    )
    head = ["injury measure", "best", other, "difference", ""]
    return f'{table(head, rows)}<p class="faint">{escape(said)}</p>'


def warning(study: Study | Front) -> str | None:
    """What a reader has to know before building this jaw; None if nothing."""
    if isinstance(study, Front):
        return study.warning
    best = next(e for e in study.evaluations if e.design is study.best_design)
    if best.violation(study.problem) > FEASIBLE:
        return f"no design met the constraints; the best violates them by {best.violation(study.problem):.1%}"
    checked = study.verification
    if checked is not None and (checked.missed or not checked.survives):
        return checked.sentence
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
    return f"<p>{escape(_capital(found.sentence))}.</p>" + table(["", *results], rows)


def _design(study: Study) -> str:
    rows = []
    for entry, start, best in zip(study.problem.entries, study.problem.start, study.best_design, strict=True):
        values = (v / entry.factor for v in (entry.lower, start, best, entry.upper))
        rows.append([entry.name, *map(number, map(float, values))])
    return table(["variable", "lower", "start", "best", "upper"], rows)
