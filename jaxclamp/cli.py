"""The command line: `jaxclamp show`, `run`, `optimise`, `compare`, `accuracy` and `presets`.

Exit codes: 0 done; 2 the input is wrong; 3 no converged solution; 4 the machine refused; 130
interrupted; 143 terminated. What went wrong is one sentence on standard error. Results go to standard output,
progress and notes to standard error. Only what a command needs is imported, when it runs.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jaxclamp.core.failures import Failure
from jaxclamp.core.signals import INTERRUPTED, TERMINATED, Terminated, ending
from jaxclamp.scenes.presets import KINDS, preset
from jaxclamp.scenes.presets import presets as shipped
from jaxclamp.show import console, folders

if TYPE_CHECKING:
    from jaxclamp.scenes.scene import Scene

DONE, WRONG_INPUT, NOT_CONVERGED, MACHINE_REFUSED = 0, 2, 3, 4
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
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Override one key, e.g. clamp.jaw.radius_mm=1.5; repeatable."
    ),
]
ImportOption = Annotated[
    list[str] | None,
    typer.Option(
        "--import",
        metavar="FILE.py",
        help="Python file of your own jaws, laws, stops and measures, which files may then name; repeatable.",
    ),
]
OutOption = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="Folder for the results.", show_default="./SCENE-result"),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON object on standard output, nothing else.")
]
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
        known = _refusal(error)
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


def _refusal(error: Exception) -> tuple[str, int] | None:
    """Sentence and exit code of an error that is not a mistake of this program."""
    if isinstance(error, Failure):
        return str(error), error.exit_code
    if (usage := getattr(error, "format_message", None)) is not None:  # of the command itself
        return usage(), WRONG_INPUT
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return (
            "not enough memory: take a coarser mesh (--fidelity draft, or fewer mesh elements)",
            MACHINE_REFUSED,
        )
    if isinstance(error, OSError):
        where = f" {error.filename}" if error.filename else ""
        return f"the machine refused{where}: {error.strerror or error}", MACHINE_REFUSED
    return None


# ---------------------------------------------------------------------------------- commands


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
    _import(parts)
    loaded = _load(scene, fidelity, overrides, quiet)
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
    parts: ImportOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Clamp an artery: stress-free, load-free, physiological, clamped to the stop."""
    _import(parts)
    loaded = _load(scene, fidelity, overrides, quiet)
    folder = out if out is not None or as_json else Path(f"{Path(scene).stem}-result")
    if folder is not None:
        folders.check_results(folder, scene)
    from jaxclamp.scenes.notes import notes

    unlikely = notes(loaded)
    _tell(unlikely, quiet)
    result, failure = _solve(loaded, quiet)
    files = _write(result, folder, quiet) if result is not None and folder is not None else []
    if result is not None and as_json:
        typer.echo(console.as_json(result.to_dict()))
    elif result is not None and not quiet:
        typer.echo("\n".join(console.summary(result.to_dict(), files)))
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
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder for the study.", show_default="./STUDY-study"),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the study in that folder.")] = False,
    parts: ImportOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Change the jaw's shape (or any floats of a scene) to lower an objective at the stop."""
    from optimize.report import warning, write_found
    from optimize.study_file import load_study

    _import(parts)
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
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder for the results.", show_default="./SCENE-compared"),
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

    _import(parts)
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
def accuracy(
    scene: SceneArgument,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder for the tables.", show_default="./SCENE-accuracy"),
    ] = None,
    fidelity: FidelityOption = None,
    overrides: SetOption = None,
    parts: ImportOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """What accuracy costs: error against time and memory over mesh, element, penalties and solver."""
    _import(parts)
    loaded = _load(scene, fidelity, overrides, quiet)
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


# ---------------------------------------------------------------------------------- steps of run


def _import(files: list[str] | None) -> None:
    """Run a user's files of parts; what they print is no result."""
    from jaxclamp.observe.parts import import_parts

    with redirect_stdout(sys.stderr):
        for file in files or ():
            import_parts(file)


def _tell(notes: list[str], quiet: bool) -> None:
    for note in () if quiet else notes:
        typer.echo(f"note: {note}", err=True)


def _load(scene: str, fidelity: str | None, overrides: list[str] | None, quiet: bool) -> Scene:
    from jaxclamp.scenes.fidelity import ERRORS_ON_HUMAN_LAD
    from jaxclamp.scenes.files import load_scene, own_mesh_keys

    loaded = load_scene(scene, overrides or (), fidelity or "standard")
    if fidelity is None or quiet:
        return loaded
    if own := own_mesh_keys(scene):
        keys = ", ".join(f"mesh.{key}" for key in own)
        typer.echo(f"note: {scene} sets {keys} itself; --fidelity {fidelity} leaves that as it is", err=True)
    else:
        errors = ", ".join(
            f"{error:.1%} in the {name}" for name, error in ERRORS_ON_HUMAN_LAD[fidelity].items()
        )
        said = f"on human-lad, errors of {errors}; those of this scene are estimated at the end"
        typer.echo(f"note: --fidelity {fidelity}: {said}", err=True)
    return loaded


def _solve(scene: Scene, quiet: bool) -> tuple[Any, Failure | None]:
    """The result (None if there is nothing to keep), and why it does not reach the stop."""
    from jaxclamp.core.failures import EquilibriumError
    from jaxclamp.solve.clamping import clamp
    from jaxclamp.trust.estimates import with_errors

    try:
        with console.progress(quiet) as progress:
            result = with_errors(clamp(scene, progress=progress))
    except EquilibriumError as error:
        return error.result, error
    return result, None if result.converged else result.failure


def _write(result: Any, folder: Path, quiet: bool) -> list[Path]:
    from jaxclamp.show.export import write_outputs

    with console.progress(quiet) as progress:
        return list(write_outputs(result, folder, progress if callable(progress) else None))
