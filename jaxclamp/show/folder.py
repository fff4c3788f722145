"""A folder of results: the names of its files, and whose they are."""

from __future__ import annotations

import errno
import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from jaxclamp.show import readme
from jaxclamp.show.jaw import PROFILE, SOLID
from jaxclamp.show.paraview import FOLDER as STATES
from jaxclamp.show.paraview import INDEX

FIGURES = "figures"
SCENE, HISTORY, REPORT, RESULT = "scene.toml", "history.csv", "report.html", "result.json"


def of_earlier_states(folder: Path) -> Iterator[Path]:
    """The files in a folder that bear names given here and are not always there; a user's own are others."""
    from jaxclamp.pictures.plots import PLATES

    for part in ("artery", "jaws"):
        yield from (folder / STATES).glob(f"{part}_[0-9][0-9][0-9].vtu")
    drawn = [f"{FIGURES}/{name}.{suffix}" for name, *_ in PLATES for suffix in ("png", "svg")]
    yield from (path for name in (*drawn, SCENE, PROFILE, SOLID) if (path := folder / name).exists())


def require_ours(folder: Path) -> None:
    """Refuse a folder where a file of somebody else would be replaced or removed.

    Files count as ours where a result.json of ours is. Raises FileExistsError.
    """
    if _has_a_result(folder):
        return
    always = (folder / name for name in (REPORT, RESULT, HISTORY, INDEX, readme.NAME))
    there = next((path for path in (*always, *of_earlier_states(folder)) if path.exists()), None)
    if there is not None:
        name = there.relative_to(folder).as_posix()
        said = f"{name}, which is not of a run of jaxclamp as far as result.json tells, would be replaced"
        raise FileExistsError(errno.EEXIST, said, str(folder))


def _has_a_result(folder: Path) -> bool:
    """True if the folder has what `jaxclamp run` wrote there."""
    with suppress(OSError, ValueError, RecursionError):
        content = json.loads((folder / RESULT).read_text(encoding="utf-8"))
        return isinstance(content, dict) and "converged" in content and "versions" in content
    return False
