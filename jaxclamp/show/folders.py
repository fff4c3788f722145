"""Folders that the command line is told to write into: refused before anything is solved."""

from __future__ import annotations

import errno
import tempfile
from contextlib import suppress
from pathlib import Path

from jaxclamp.core.failures import BadFolder


def check_results(folder: Path, scene: str) -> None:
    """Refuse a folder for the results of a scene where they would replace that scene, or files of others."""
    from jaxclamp.show.folder import SCENE, require_ours

    check(folder)
    try:
        if (folder / SCENE).exists() and Path(scene).exists() and (folder / SCENE).samefile(scene):
            raise FileExistsError(errno.EEXIST, f"{scene}, the scene itself, would be replaced")
        require_ours(folder)
    except OSError as error:
        raise BadFolder(f"--out: {error.strerror} in {str(folder)!r}: take another folder") from None


def check(folder: Path) -> None:
    """Refuse a folder in which no file can be written; leaves nothing behind."""
    missing: list[Path] = []
    try:
        missing += [path for path in (folder, *folder.parents) if not path.exists()]
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
        finally:
            for path in missing:
                with suppress(OSError):
                    path.rmdir()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise BadFolder(f"--out: no files can be written in {str(folder)!r}: {reason}") from None
