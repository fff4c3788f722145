"""Everything a clamping leaves on disk, written whole or not at all.

README.md in the folder says what they are (`show.readme`). All files are made in a temporary folder inside
the target and then renamed into place, so that a full disk or an interruption leaves the target as it was.
"""

from __future__ import annotations

import csv
import io
import math
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxclamp.core.failures import SceneError
from jaxclamp.core.progress import Progress
from jaxclamp.scenes.files import dump_scene
from jaxclamp.show import readme
from jaxclamp.show.console import as_json
from jaxclamp.show.folder import FIGURES, HISTORY, REPORT, RESULT, SCENE, of_earlier_states, require_ours
from jaxclamp.show.paraview import write_states
from jaxclamp.solve.results import flat

if TYPE_CHECKING:
    from jaxclamp.pictures.plots import Plate
    from jaxclamp.solve.results import Result

STAGING = ".jaxclamp-writing-"


def write_outputs(
    result: Result, folder: str | Path, progress: Callable[[Progress], None] | None = None
) -> list[Path]:
    """Write all outputs of a result into `folder` (made if missing); returns the files.

    Works for whatever states converged. Files of an earlier result in the same folder are
    replaced, and its further states removed. Raises OSError, with nothing half written; FileExistsError
    where files of the same names are there and no earlier result.
    """

    folder = Path(folder)
    require_ours(folder)
    tell = lambda fraction, message: progress and progress(Progress("writing", fraction, message))  # noqa: E731
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=STAGING, dir=folder) as staging:
            written = list(_write_all(result, Path(staging), tell))
            files = into_place(Path(staging), folder, written)
            _remove_old(folder, files)
    except BaseException:
        for path in missing:
            with suppress(OSError):
                path.rmdir()
        raise
    tell(1.0, f"{len(files)} files in {folder}")
    return files


def _write_all(result: Result, folder: Path, tell: Callable[[float, str], Any]) -> Iterator[Path]:
    """Write every output into an empty folder."""
    if result.load_free is not None:
        yield from write_states(result, folder, lambda s, said: tell(0.5 * s, said))
    plates: list[tuple[Plate, bytes]] = []
    (folder / FIGURES).mkdir()
    from jaxclamp.pictures.plots import figures, png, svg

    for plate in figures(result):
        tell(0.5 + 0.1 * len(plates), plate.title.lower())
        plates.append((plate, png(plate.figure)))
        plate.figure.set_layout_engine("none")  # it is laid out; once is enough
        for suffix, content in (("png", plates[-1][1]), ("svg", svg(plate.figure))):
            path = folder / FIGURES / f"{plate.name}.{suffix}"
            path.write_bytes(content)
            yield path
    history = folder / HISTORY
    history.write_text(history_csv(result.history), encoding="utf-8", newline="")
    yield history
    from jaxclamp.show.report import write_report

    yield write_report(result, folder / REPORT, plates)
    scene = folder / SCENE
    with suppress(SceneError):  # constants of each point have no place in a file
        scene.write_text(dump_scene(result.scene), encoding="utf-8")
        yield scene
    text = folder / readme.NAME
    text.write_text(readme.readme(result), encoding="utf-8")
    yield text
    final = folder / RESULT
    final.write_text(as_json(plain(result.to_dict())) + "\n", encoding="utf-8")
    yield final


def into_place(staging: Path, folder: Path, written: list[Path]) -> list[Path]:
    """Rename finished files from a temporary folder into their own; returns them there."""
    for path in written:
        with path.open("r+b") as file:  # a disk that fills up late says so here
            os.fsync(file.fileno())
    names = [path.relative_to(staging) for path in written]
    for parent in {(folder / name).parent for name in names}:
        parent.mkdir(exist_ok=True)
    for name in names:
        os.replace(staging / name, folder / name)
    return [folder / name for name in names]


def _remove_old(folder: Path, files: list[Path]) -> None:
    """Remove what an earlier result with more states left over."""
    for old in of_earlier_states(folder):
        if old not in files:
            old.unlink()


# --------------------------------------------------------------------------------- plain content


def plain(content: Any) -> Any:
    """The same with Python's own numbers, lists and dicts only."""
    if isinstance(content, dict):
        return {str(key): plain(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [plain(value) for value in content]
    if hasattr(content, "tolist"):  # numpy and JAX arrays and scalars
        return np.asarray(content).tolist()
    return content


def history_csv(history: list[dict[str, Any]]) -> str:
    """One row per state; columns of layers are called KEY.LAYER, of places KEY.LAYER.x and so on."""
    rows = [dict(flat(plain(record))) for record in history]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, ["state", *columns], restval="", lineterminator="\n")
    writer.writeheader()
    for number, row in enumerate(rows):
        writer.writerow({"state": number, **{name: _cell(value) for name, value in row.items()}})
    return buffer.getvalue()


def _cell(value: Any) -> Any:
    """Nothing for what is not a number; full precision for what is."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    return value
