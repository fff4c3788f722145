"""What a study leaves on disk while it runs: study.json, whole or not at all, and iterations.csv."""

from __future__ import annotations

import csv
import io
import itertools
import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from jaxclamp import SceneError
from jaxclamp.show.console import as_json

STUDY, ITERATIONS, LOCK = "study.json", "iterations.csv", ".study.lock"
"""names of the files in a study's folder"""
REPORTED = ("report.html", "front.png", "profiles.png", "figures", "start", "best")
"""what a study leaves beside them in the end"""


def write_whole(path: Path, text: str) -> None:
    """Write a text file; it is there whole, or as it was before. Raises OSError."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file under a temporary name and rename it. Raises OSError."""
    temporary = path.with_name(f".{path.name}.writing")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise


class Journal:
    """The folder of one study, held by one process at a time."""

    def __init__(self, folder: Path, resume: bool) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        known = (folder / LOCK).exists()
        self._lock = FileLock(folder / LOCK)
        try:
            self._lock.acquire(timeout=0)
        except Timeout:
            raise SceneError(f"{folder}: another study is writing there") from None
        try:
            self.found = self._read()
            """the study that is there; None if there is none"""
            if self.found is not None and not resume:
                raise SceneError(
                    f"{folder} holds a study already: continue it with --resume, or take another folder"
                )
            foreign = next((name for name in (ITERATIONS, *REPORTED) if (folder / name).exists()), None)
            if self.found is None and foreign is not None and not known:
                self.close()
                (folder / LOCK).unlink(missing_ok=True)  # it would be taken for that of a study
                raise SceneError(
                    f"{folder} holds {foreign} but no study, whose files would replace it: "
                    "take another folder"
                )
        except BaseException:
            self.close()
            raise

    @property
    def path(self) -> Path:
        """The file study.json."""
        return self.folder / STUDY

    def _read(self) -> dict[str, Any] | None:
        """The table that study.json holds; None if there is no such file."""
        if not self.path.exists():
            return None
        try:
            found = json.loads(self.path.read_text(encoding="utf-8"))
        except (ValueError, RecursionError):  # no JSON, digits in thousands, a list of lists of lists
            found = None
        if not isinstance(found, dict):
            raise SceneError(
                f"{self.path}: expected a study that this program has written; "
                "move the file away or take another folder"
            )
        return found

    def keep_copy(self) -> Path:
        """Copy study.json to study.json.damaged, or with a number if there is one already. Raises OSError."""
        numbers = itertools.chain([""], (f"-{number}" for number in itertools.count(2)))
        names = (f"{STUDY}.damaged{number}" for number in numbers)
        copy = next(path for name in names if not (path := self.folder / name).exists())
        write_bytes(copy, self.path.read_bytes())
        return copy

    def write(self, content: dict[str, Any], rows: list[dict[str, Any]]) -> None:
        """Rewrite study.json and bring iterations.csv up to its rows. Raises OSError."""
        write_whole(self.folder / STUDY, as_json(content) + "\n")
        path = self.folder / ITERATIONS
        if self._rows_written == len(rows) - 1 and path.exists():
            with path.open("a", encoding="utf-8", newline="") as file:
                file.write(_csv(rows[-1:], header=False))
        else:
            write_whole(path, _csv(rows, header=True))
        self._rows_written = len(rows)

    _rows_written = -1

    def close(self) -> None:
        """Let others write here."""
        self._lock.release()


def _csv(rows: list[dict[str, Any]], header: bool) -> str:
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(rows[0]) if rows else [], lineterminator="\n")
    if header:
        writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()
