"""Keys of a TOML file of a study or a sweep, and reading one so that whatever is wrong names it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from jaxclamp import Failure, SceneError
from jaxclamp.scenes.files import read_text
from jaxclamp.scenes.schema import shown
from jaxclamp.scenes.toml import parsed
from jaxclamp.scenes.wording import did_you_mean, shortened

Found = TypeVar("Found")


def read_file(name_or_path: str | Path, kind: str, read: Callable[[dict[str, Any], Path], Found]) -> Found:
    """What `read` makes of the table of a file or preset and of its folder. Raises SceneError, naming it."""
    text, source = read_text(name_or_path, kind)
    try:
        table = parsed(text)
    except Failure as error:
        raise SceneError(f"{source}: {error}") from None
    try:
        return read(table, Path(name_or_path).parent)
    except SceneError as error:
        said = str(error)
        raise SceneError(said if said.startswith(source) else f"{source}: {said}") from None


def require_known(table: dict[str, Any], keys: tuple[str, ...]) -> None:
    """Raise SceneError for a key that is none of `keys`."""
    for key in table:
        if key not in keys:
            raise SceneError(f"unknown key {shortened(key)}; {did_you_mean(key, list(keys))}")


def whole(table: dict[str, Any], key: str, default: int | None, least: int, most: int) -> int:
    """A whole number; default: None if the key has to be there. Raises SceneError."""
    if default is None and key not in table:
        raise SceneError(f"{key} is missing: expected a whole number from {least} to {most}")
    value = table.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise SceneError(f"{key} = {shown(value)}: expected a whole number from {least} to {most}")
    return value


def one_line(table: dict[str, Any], key: str, default: str) -> str:
    """A text on one line. Raises SceneError."""
    value = table.get(key, default)
    if not isinstance(value, str) or not value.isprintable():
        raise SceneError(f"{key} = {shown(value)}: expected a text on one line")
    return value


def overrides(table: dict[str, Any]) -> list[str]:
    """What `set` changes of the scene. Raises SceneError."""
    changes = table.get("set", [])
    if not isinstance(changes, list) or not all(isinstance(item, str) for item in changes):
        raise SceneError('set: expected a list of overrides, such as ["mesh.axial=30"]')
    return changes
