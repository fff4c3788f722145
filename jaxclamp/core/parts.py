"""Parts of a user's own - jaws, laws, stops, measures - : where they come from, and how they travel.

They live in a file that was imported with `import_parts`, in a script or in a notebook. No other process can
import those, so what is sent to one goes by value, together with the names of the files.
"""

from __future__ import annotations

import dataclasses
import functools
import pickle
from collections.abc import Callable, Iterator
from typing import Any

import cloudpickle

SHIPPED = ("jaxclamp", "optimize")
"""packages whose parts everybody has"""
MAIN = ("__main__", "__mp_main__")
"""modules of a script or a notebook"""


@dataclasses.dataclass(frozen=True)
class Source:
    """A file of parts."""

    file: str
    """as it was named"""
    sha256: str
    """of its content"""


sources: dict[str, Source] = {}
"""what files were imported, by the name of the module that each became"""


def is_shipped(part: Any) -> bool:
    """True for a class or function of this project."""
    return str(getattr(part, "__module__", "")).split(".")[0] in SHIPPED


def own_parts(*things: Any) -> list[dict[str, str | None]]:
    """The parts of scenes and measures that are not shipped: each with what it is from, for JSON.

    `from` is the file as it was named, or the module; `sha256` is of the file, None for a module.
    """
    found: dict[tuple[str, str], dict[str, str | None]] = {}
    for part in _parts(things):
        if not is_shipped(part):
            source = sources.get(part.__module__)
            where = part.__module__ if source is None else source.file
            said = {"part": part.__qualname__, "from": where, "sha256": source and source.sha256}
            found.setdefault((part.__qualname__, where), said)
    return list(found.values())


def _parts(thing: Any) -> Iterator[Any]:
    """The classes of all records in a thing, and the functions of its measures."""
    if isinstance(thing, tuple):
        for item in thing:
            yield from _parts(item)
    elif dataclasses.is_dataclass(thing):
        yield type(thing)
        for field in dataclasses.fields(thing):
            yield from _parts(getattr(thing, field.name))
    elif isinstance(thing, functools.partial):
        yield from _parts(thing.func)
    elif callable(thing) and hasattr(thing, "__qualname__"):
        yield thing


# --- travelling -----------------------------------------------------------------------------------------


def by_value(function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    """A call, without arguments, for a pool of processes, such as `pool.submit(by_value(solve, scene))`.

    What is of a file of parts, of a script or of a notebook goes along by value, so that the process need not
    be able to import it. An error of a user's own class becomes a RuntimeError with its text.
    """
    return functools.partial(_call, cloudpickle.dumps((sources, function, arguments)))


def _call(request: bytes) -> Any:
    """The value of a call, in the process that it was sent to."""
    known, function, arguments = pickle.loads(request)
    sources.update(known)
    try:
        return function(*arguments)
    except Exception as error:
        kind = type(error)
        if kind.__module__ in MAIN or kind.__module__ in sources:
            raise RuntimeError(f"{kind.__name__}: {error}") from None
        raise
