"""Steps that commands share: parts imported, a scene loaded, solved and written, with what users are told on
the way.

Only what a step needs is imported, when it is taken.
"""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxclamp.core.failures import Failure
from jaxclamp.show import console

if TYPE_CHECKING:
    from jaxclamp.scenes.scene import Scene


def import_files(files: list[str] | None) -> None:
    """Run a user's files of parts; what they print is no result."""
    from jaxclamp.observe.parts import import_parts

    with redirect_stdout(sys.stderr):
        for file in files or ():
            import_parts(file)


def load(scene: str, fidelity: str | None, overrides: list[str] | None, quiet: bool) -> Scene:
    """The scene of a file or preset; a note on standard error says what the fidelity asked for means."""
    from jaxclamp.scenes.fidelity import ERRORS_ON_HUMAN_LAD
    from jaxclamp.scenes.files import load_scene, own_mesh_keys

    loaded = load_scene(scene, overrides or (), fidelity or "standard")
    if fidelity is None or quiet:
        return loaded
    if own := own_mesh_keys(scene):
        keys = ", ".join(f"mesh.{key}" for key in own)
        note = f"{scene} sets {keys} itself; --fidelity {fidelity} leaves that as it is"
    else:
        errors = ", ".join(
            f"{error:.1%} in the {name}" for name, error in ERRORS_ON_HUMAN_LAD[fidelity].items()
        )
        said = f"on human-lad, errors of {errors}; those of this scene are estimated at the end"
        note = f"--fidelity {fidelity}: {said}"
    sys.stderr.write(f"note: {note}\n")
    return loaded


def solve(scene: Scene, quiet: bool) -> tuple[Any, Failure | None]:
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


def write(result: Any, folder: Path, quiet: bool) -> list[Path]:
    """Write all outputs of a result; returns the files."""
    from jaxclamp.show.export import write_outputs

    with console.progress(quiet) as progress:
        return list(write_outputs(result, folder, progress if callable(progress) else None))


def load_uncertain(file: Path | None, samples: int, scene: Scene) -> Any:
    """What is uncertain of a scene, by a file; None without one. Raises SceneError."""
    from jaxclamp.core.failures import SceneError
    from jaxclamp.trust.uncertainty import load_covariance

    if file is None:
        if samples:
            raise SceneError("--samples: there is nothing to draw them from without --uncertainty FILE")
        return None
    return load_covariance(file, scene)


def propagate(result: Any, covariance: Any, samples: int, folder: Path | None, quiet: bool) -> Any:
    """Standard deviations of a result's figures, written beside its other outputs."""
    from jaxclamp.core.progress import Progress
    from jaxclamp.show.uncertainty_report import write_uncertainty
    from jaxclamp.trust.uncertainty import sampled, uncertainty

    found = uncertainty(result, covariance)
    if samples:
        with console.progress(quiet) as progress:
            hears = progress if callable(progress) else lambda event: None
            found = sampled(found, result, samples, tell=lambda f, said: hears(Progress("sampling", f, said)))
    if folder is not None:
        write_uncertainty(found, result, folder)
    return found


def told(found: Any, result: Any) -> list[str]:
    """Lines of a terminal on what is uncertain."""
    from jaxclamp.show.uncertainty_report import lines

    return [] if found is None else lines(found, result)
