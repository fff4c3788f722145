"""The command line: `jaxclamp show`, `run`, `optimise`, `compare`, `fit`, `sweep`, `accuracy` and `presets`.

Exit codes: 0 done; 2 the input is wrong; 3 no converged solution; 4 the machine refused; 130
interrupted; 143 terminated. What went wrong is one sentence on standard error. Results go to standard output,
progress and notes to standard error. Only what a command needs is imported, when it runs.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from jaxclamp.core.signals import INTERRUPTED, TERMINATED, Terminated, ending
from jaxclamp.scenes.presets import KINDS, preset
from jaxclamp.scenes.presets import presets as shipped
from jaxclamp.show import console, folders
from jaxclamp.show.refusals import refusal
from jaxclamp.show.steps import import_files, load, load_uncertain, propagate, solve, told, write

DONE, NOT_CONVERGED = 0, 3
"""exit codes; failures bring their own"""

app = typer.Typer(
    help="Clamping of arteries by finite elements: stress-free, load-free, physiological, clamped.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


SceneArgument = Annotated[str, typer.Argument(metavar="SCENE", help="A TOML file or the name of a preset.")]
FidelityOption = Annotated[
    str | None,
    typer.Option(
        "--fidelity",
        metavar="draft|standard|reference|seed",
        help="The mesh, where the scene has none of its own.",
        show_default="standard",
    ),
]
SET = "Override one key, e.g. clamp.jaw.radius_mm=1.5; repeatable."
SetOption = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help=SET)]
IMPORT = "Python file of your own jaws, laws, stops and measures, which files may then name; repeatable."
ImportOption = Annotated[list[str] | None, typer.Option("--import", metavar="FILE.py", help=IMPORT)]
OutOption = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="Folder for the results.", show_default="./SCENE-result"),
]
JSON = "Print one JSON object on standard output, nothing else."
JsonOption = Annotated[bool, typer.Option("--json", help=JSON)]
FREE = "Fit this number, such as media.k1, and those named alike; default: every constant but bulk."
UNCERTAIN = "What of the scene is uncertain: a TOML file of parameters, or fit.json."
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    given = None if arguments is None else list(arguments)
    try:
        with ending():
            code = app(args=given, prog_name="jaxclamp", standalone_mode=False)
        sys.stdout.flush()
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except Terminated:
        return _fail("terminated", TERMINATED)
    except (BrokenPipeError, SystemExit):  # the reader of our output has gone; typer exits for that
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except Exception as error:
        known = refusal(error)
        if known is None:
            raise
        return _fail(*known)
    if code == INTERRUPTED:
        return _fail("interrupted", INTERRUPTED)
    return code or DONE


def _fail(sentence: str, code: int) -> int:
    if sentence:
        typer.echo(f"jaxclamp: {' '.join(sentence.split())}", err=True)
    return code


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import PackageNotFoundError, version

        with suppress(PackageNotFoundError):  # run from a copy of the sources
            typer.echo(f"jaxclamp {version('jaxclamp')}")
        raise typer.Exit


@app.callback()
def top(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Clamping of arteries by finite elements."""


@app.command()
def show(
    scene: SceneArgument,
    fidelity: FidelityOption = None,
    overrides: SetOption = None,
    parts: ImportOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Check a scene and say what would be modelled; solves nothing."""
    from jaxclamp.core.surroundings import use_cpu

    use_cpu()
    import_files(parts)
    loaded = load(scene, fidelity, overrides, quiet)
    from jaxclamp.show.description import describe

    described = describe(loaded)
    if as_json:
        typer.echo(console.as_json(described))
    else:
        typer.echo(loaded.title or scene)
        typer.echo("\n".join(console.lines(described)))


@app.command()
def run(
    scene: SceneArgument,
    out: OutOption = None,
    fidelity: FidelityOption = None,
    overrides: SetOption = None,
    uncertain: Annotated[Path | None, typer.Option("--uncertainty", metavar="FILE", help=UNCERTAIN)] = None,
    samples: Annotated[int, typer.Option("--samples", metavar="N", min=0, help="Solve N drawn scenes.")] = 0,
    parts: ImportOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Clamp an artery: stress-free, load-free, physiological, clamped to the stop."""
    import_files(parts)
    loaded = load(scene, fidelity, overrides, quiet)
    covariance = load_uncertain(uncertain, samples, loaded)
    folder = out if out is not None or as_json else Path(f"{Path(scene).stem}-result")
    if folder is not None:
        folders.check_results(folder, scene)
    from jaxclamp.scenes.notes import notes

    unlikely = notes(loaded)
    _tell(unlikely, quiet)
    result, failure = solve(loaded, quiet)
    files = write(result, folder, quiet) if result is not None and folder is not None else []
    spread = None if covariance is None or failure else propagate(result, covariance, samples, folder, quiet)
    if result is not None and as_json:
        more = {} if spread is None else {"uncertainty": spread.to_dict(result.errors)}
        typer.echo(console.as_json(result.to_dict() | more))
    elif result is not None and not quiet:
        typer.echo("\n".join([*console.summary(result.to_dict(), files), *told(spread, result)]))
    if result is not None:
        _tell([note for note in result.to_dict().get("notes", ()) if note not in unlikely], quiet)
    if failure is not None:
        kept = f" (the states that converged are in {folder})" if files else ""
        return _fail(f"{failure}{kept}", failure.exit_code)
    if (branch := console.branch_of(result.to_dict())).startswith("another"):
        typer.echo(f"jaxclamp: warning: {branch}", err=True)
    return DONE


@app.command()
def optimise(
    study: Annotated[str, typer.Argument(metavar="STUDY", help="A TOML file or the name of a preset.")],
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Default: ./STUDY-study.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the study in that folder.")] = False,
    parts: ImportOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Change the jaw's shape (or any floats of a scene) to lower an objective at the stop."""
    from optimize.report import warning, write_found
    from optimize.study_file import load_study

    import_files(parts)
    asked = load_study(study)
    folder = out or Path(f"{Path(study).stem}-study")
    folders.check(folder)
    with console.progress(quiet) as progress:
        tell = progress if callable(progress) else None
        found = asked.run(folder, resume, tell)
        files = write_found(found, folder, asked.title, tell)
    if as_json:
        typer.echo(console.as_json(found.to_dict()))
    elif not quiet:
        typer.echo("\n".join([asked.title, *found.lines(), "", *(f"  open {path}" for path in files)]))
    if (said := warning(found)) is not None:
        typer.echo(f"jaxclamp: warning: {said}", err=True)
    return DONE


@app.command()
def compare(
    scene: SceneArgument,
    clamps: Annotated[
        str,
        typer.Option("--clamps", metavar="A,B,…", help="Jaws: names of presets, or TOML files of one jaw."),
    ],
    rank: Annotated[
        str | None,
        typer.Option(
            "--rank",
            metavar="MEASURE",
            help="What ranks them, e.g. clamp_force_N or smooth_peak_axial_stress_kPa.adventitia.",
            show_default="smooth_peak_axial_stress_kPa of the media",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Default: ./SCENE-compared.")
    ] = None,
    fidelity: FidelityOption = None,
    overrides: SetOption = None,
    parts: ImportOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Put one artery into several clamps: at the scene's stop, just closed, and at equal force."""
    from optimize.comparison import asked_clamps, lines, ranking
    from optimize.comparison import compare as compare_clamps
    from optimize.comparison_report import require_ours, write_comparison

    import_files(parts)
    asked = asked_clamps(scene, clamps, overrides or (), fidelity or "standard")
    rank_by, measure = ranking(rank, tuple(layer.name for layer in asked[0].scene.artery.layers))
    folder = out if out is not None or as_json else Path(f"{Path(scene).stem}-compared")
    if folder is not None:
        folders.check(folder)
        require_ours(folder)
    with console.progress(quiet) as progress:
        tell = progress if callable(progress) else None
        found = compare_clamps(asked, rank_by, measure, progress=tell)
        files = [] if folder is None else write_comparison(found, folder, tell)
    if as_json:
        typer.echo(console.as_json(found.to_dict()))
    elif not quiet:
        typer.echo("\n".join([found.title, *lines(found), "", *(f"  open {path}" for path in files)]))
    if all(each.at_stop is None for each in found.clamps):
        return _fail("no clamp has an equilibrium at the scene's stop: see the reasons above", NOT_CONVERGED)
    return DONE


@app.command()
def fit(
    data: Annotated[list[str], typer.Argument(metavar="DATA.csv…", help="Test data, units in the headers.")],
    scene: Annotated[str, typer.Option("--scene", metavar="SCENE", help="What is fitted, and its start.")],
    free: Annotated[list[str] | None, typer.Option("--free", metavar="PATH", help=FREE)] = None,
    fixed: Annotated[
        list[str] | None, typer.Option("--fix", metavar="PATH", help="Leave this number; repeatable.")
    ] = None,
    ties: Annotated[
        list[str] | None,
        typer.Option("--tie", metavar="TIE", help="Such as 'adventitia.c = media.c / 10'; repeatable."),
    ] = None,
    columns: Annotated[
        list[str] | None,
        typer.Option("--column", metavar="HEADER=NAME", help="Read a column by this name; repeatable."),
    ] = None,
    given: Annotated[
        str, typer.Option("--given", metavar="radius|pressure", help="Compare a tube at this.")
    ] = "radius",
    starts: Annotated[int, typer.Option("--starts", metavar="N", help="From how many starts.")] = 20,
    seed: Annotated[int, typer.Option("--seed", metavar="N", help="Of random starts.")] = 0,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Default: ./SCENE-fit.")] = None,
    overrides: SetOption = None,
    parts: ImportOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Find the constants of a wall from test data, with their confidence."""
    from optimize.fit import Asked, fit_files
    from optimize.fit_report import lines, require_ours, write_fit

    import_files(parts)
    loaded = load(scene, None, overrides, quiet)
    folder = out if out is not None or as_json else Path(f"{Path(scene).stem}-fit")
    if folder is not None:
        folders.check(folder)
        require_ours(folder)
    asked = Asked(free or (), fixed or (), ties or (), columns or (), given, starts, seed)
    with console.progress(quiet) as progress:
        tell = progress if callable(progress) else None
        found = fit_files(data, loaded, asked, tell)
        files = [] if folder is None else write_fit(found, folder, tell)
    if as_json:
        typer.echo(console.as_json(found.to_dict()))
    elif not quiet:
        typer.echo("\n".join([found.scene.title, *lines(found), "", *(f"  open {path}" for path in files)]))
    for warning in found.warnings:
        typer.echo(f"jaxclamp: warning: {warning}", err=True)
    return DONE if found.follows else NOT_CONVERGED


@app.command()
def sweep(
    file: Annotated[str, typer.Argument(metavar="SWEEP.toml", help="A scene, and what is varied.")],
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Default: ./SWEEP-sweep.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Solve what is missing in that folder.")] = False,
    workers: Annotated[int | None, typer.Option("--workers", min=1, help="Default: one a core.")] = None,
    scheduler: Annotated[str | None, typer.Option("--scheduler", metavar="ADDRESS", help="Of dask.")] = None,
    parts: ImportOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Solve many scenes, as independent jobs on dask; a second start solves what is missing."""
    from optimize.sweep import Cluster, run_sweep
    from optimize.sweep_file import load_sweep
    from optimize.sweep_report import lines, write_sweep

    import_files(parts)
    asked = load_sweep(file)
    folder = out or Path(f"{Path(file).stem}-sweep")
    folders.check(folder)
    with console.progress(quiet) as progress:
        tell = progress if callable(progress) else None
        rows = run_sweep(asked, folder, Cluster(workers, scheduler), resume, tell)
    files = write_sweep(asked, rows, folder)
    if as_json:
        typer.echo(console.as_json(rows))
    elif not quiet:
        typer.echo("\n".join([asked.title, *lines(asked, rows), "", *(f"  open {path}" for path in files)]))
    return DONE


@app.command()
def accuracy(
    scene: SceneArgument,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Default: ./SCENE-accuracy.")
    ] = None,
    fidelity: FidelityOption = None,
    overrides: SetOption = None,
    parts: ImportOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """What accuracy costs: error against time and memory over mesh, element, penalties and solver."""
    import_files(parts)
    loaded = load(scene, fidelity, overrides, quiet)
    folder = out or Path(f"{Path(scene).stem}-accuracy")
    folders.check(folder)
    from jaxclamp.show.price_report import lines, write_prices
    from jaxclamp.trust.price_list import price_list

    with console.progress(quiet) as progress:
        prices = price_list(loaded, progress if callable(progress) else None)
    files = write_prices(prices, folder)
    if as_json:
        typer.echo(console.as_json(prices.to_dict()))
    elif not quiet:
        typer.echo("\n".join([*lines(prices), "", *(f"  open {path}" for path in files)]))
    return DONE


@app.command()
def presets(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Print the TOML of this one.")] = None,
    as_json: JsonOption = False,
) -> None:
    """List what ships: scenes, arteries, jaws and studies; or print one of them."""
    if name is not None:
        typer.echo(preset(name).text, nl=False)
        return
    known = shipped()
    if as_json:
        typer.echo(console.as_json([{"kind": p.kind, "name": p.name, "title": p.title} for p in known]))
        return
    width = max(len(each.name) for each in known)
    for each in known:
        typer.echo(f"{each.kind:<{max(map(len, KINDS))}}  {each.name:<{width}}  {each.title}")


def _tell(notes: list[str], quiet: bool) -> None:
    for note in () if quiet else notes:
        typer.echo(f"note: {note}", err=True)
