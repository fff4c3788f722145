"""Parts of a user's own in a Python file: `import_parts` makes them known to scene and study files."""

from __future__ import annotations

import hashlib
import inspect
import re
import sys
import traceback
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cloudpickle

from jaxclamp.core.failures import Failure, SceneError
from jaxclamp.core.parts import Source, is_shipped, sources
from jaxclamp.core.records import concrete_subclasses, withdraw
from jaxclamp.observe.injury import MEASURES, ONSET_STRETCH
from jaxclamp.observe.measure import Measure
from jaxclamp.physics.jaws import Jaw
from jaxclamp.physics.materials import Material
from jaxclamp.scenes import schema
from jaxclamp.scenes.checks import lacking_moduli
from jaxclamp.scenes.scene import Stop
from jaxclamp.scenes.wording import shortened

BASES = {"jaw": Jaw, "law": Material, "stop": Stop}
"""what a file may have records of"""
ARGUMENTS: dict[str, Any] = {
    "layer": "media",
    "stress": 1.0,
    "onset_stretch": ONSET_STRETCH,
    "friction": 0.05,
}
"""what a study file can give to a measure, each with an example (stress: kPa)"""
LARGEST_FILE = 1_000_000
"""bytes"""
LONGEST_REASON = 300
"""characters of what an error in the file says"""

_imported: dict[str, types.ModuleType] = {}
"""the modules that files became, by name"""


def import_parts(path: str | Path) -> types.ModuleType:
    """Run a Python file of your own jaws, laws, stops and measures: TOML files may name them then.

    A record below `Jaw`, `Material` or `Stop` is known by its tag (a stop by its target's key). A function
    that is annotated `-> Measure` and takes `layer`, `stress` or nothing is known to study files by its name
    and the measure's unit, such as `edge_force_N`. All go by value to the processes that studies, `jit` and
    `accuracy` start: the file is run in this one only. It may import whatever is installed. A file that is
    imported again is run again if it has changed, and its parts take the place of the earlier ones.

    Returns the module that the file became. Raises SceneError, one sentence, for a file that cannot be read
    or that raises an error, and for parts that are not complete or have the name of another.
    """
    place = Path(path)
    said = str(path) if str(path).isprintable() else ascii(str(path))
    content = _content(place, said)
    source = Source(said, hashlib.sha256(content).hexdigest())
    key = hashlib.sha256(str(place.resolve()).encode()).hexdigest()[:8]
    name = re.sub(r"\W", "_", f"{place.stem}_{key}")
    earlier = _imported.get(name)
    if earlier is not None and sources[name].sha256 == source.sha256:
        sources[name] = source
        return earlier
    module = types.ModuleType(name)
    module.__file__ = str(place.resolve())
    before = _records()
    sys.modules[name] = module
    try:
        _run(content, module, said)
        _check(module, before, said)
    except BaseException:
        for cls in _records() - before:
            withdraw(cls)
        sys.modules.pop(name)
        if earlier is not None:
            sys.modules[name] = earlier
        raise
    for cls in before:
        if cls.__module__ == name:
            withdraw(cls)
    sources[name], _imported[name] = source, module
    cloudpickle.register_pickle_by_value(module)
    return module


def measures() -> dict[Callable[..., Measure], Measure]:
    """Every factory of a measure, shipped or of a file that was imported, with a measure that it makes.

    The example is of the layer "media" and of a stress of 1 kPa.
    """
    own = [factory for module in _imported.values() for factory in _factories(module)]
    return {factory: _example(factory) for factory in (*MEASURES, *own)}


def _example(factory: Callable[..., Measure]) -> Measure:
    return factory(**{name: ARGUMENTS[name] for name in inspect.signature(factory).parameters})


def _content(path: Path, said: str) -> bytes:
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE + 1)
    except FileNotFoundError:
        raise SceneError(f"{said}: there is no such file") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise SceneError(f"{said}: the file cannot be read: {reason}") from None
    if len(content) > LARGEST_FILE:
        raise SceneError(f"{said}: expected a Python file of at most {LARGEST_FILE // 1000} kB")
    return content


def _run(content: bytes, module: types.ModuleType, said: str) -> None:
    """Run a file. Raises SceneError with the line at which it fails."""
    file = str(module.__file__)
    try:
        exec(compile(content, file, "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        lines = [
            frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file
        ]
        line = error.lineno if isinstance(error, SyntaxError) else next(iter(reversed(lines)), None)
        text = error.msg if isinstance(error, SyntaxError) else str(error)
        reason = text if isinstance(error, Failure) else f"{type(error).__name__}: {text}".rstrip(": ")
        where = said if line is None else f"{said}, line {line}"
        raise SceneError(f"{where}: {shortened(' '.join(reason.split()), LONGEST_REASON)}") from None


def _records() -> set[type]:
    """All jaws, laws and stops."""
    return {cls for base in BASES.values() for cls in concrete_subclasses(base)}


def _factories(module: types.ModuleType) -> list[Callable[..., Measure]]:
    """The functions of a file that say that they make a measure."""
    functions = [f for n, f in vars(module).items() if inspect.isfunction(f) and not n.startswith("_")]
    return [f for f in functions if f.__module__ == module.__name__ and _makes_a_measure(f)]


def _makes_a_measure(function: Callable[..., Any]) -> bool:
    made = inspect.get_annotations(function).get("return")
    return made is Measure or (isinstance(made, str) and made.split(".")[-1] == "Measure")


# --- what is refused ------------------------------------------------------------------------------------


def _check(module: types.ModuleType, before: set[type], said: str) -> None:
    """Raise SceneError unless every part of a file is complete and has a name of its own."""
    others = {cls for cls in before if cls.__module__ != module.__name__}
    for what, base in BASES.items():
        mine = [cls for cls in concrete_subclasses(base) if cls not in before]
        for part in vars(module).values():
            own = isinstance(part, type) and part.__module__ == module.__name__ and issubclass(part, base)
            if own and part not in mine and not inspect.isabstract(part):
                raise SceneError(f"{said}: {what} {part.__name__} is no record: put @record above its class")
        known = {name: cls for cls in others if issubclass(cls, base) for name in _names(cls, base)}
        for cls in mine:
            _check_record(cls, what, base, said)
            for name in _names(cls, base):
                if name in known:
                    raise SceneError(_clash(said, f"{what} {cls.__name__}", name, known[name]))
                known[name] = cls
    taken: dict[str, Any] = {f.__name__: f for f in measures() if f.__module__ != module.__name__}
    for factory in _factories(module):
        _check_factory(factory, said)
        if factory.__name__ in taken:
            what = f"measure {factory.__name__}"
            raise SceneError(_clash(said, what, factory.__name__, taken[factory.__name__]))


def _names(cls: type, base: type) -> list[str]:
    """What files call a record: its tag, or a stop's key."""
    return list(schema.fields_by_key(cls)) if schema.is_chosen_by_key(base) else [schema.tag_of(cls)[1]]


def _check_record(cls: type, what: str, base: type, said: str) -> None:
    """Raise SceneError for a record that lacks something."""
    lacking = sorted(getattr(cls, "__abstractmethods__", ()))
    if lacking:
        raise SceneError(f"{said}: {what} {cls.__name__} has no {' and no '.join(lacking)}")
    tag = schema.tag_of(concrete_subclasses(base)[0])[0]
    if schema.tag_of(cls)[0] != tag:
        raise SceneError(
            f'{said}: {what} {cls.__name__} has no name: expected a field {tag}: str = static("...")'
        )
    if base is Material and (lacking := lacking_moduli(cls)):
        raise SceneError(
            f"{said}: law {cls.__name__} has no {' and no '.join(lacking)}: expected quantities c and bulk, "
            'its shear and bulk modulus, such as c: Array = quantity("kPa", 0.0, 1e6)'
        )
    targets = [key for key, field in schema.fields_by_key(cls).items() if "range" in field.metadata]
    if base is Stop and len(targets) != 1:
        raise SceneError(
            f"{said}: stop {cls.__name__} has {len(targets)} quantities: expected one, its target"
        )


def _check_factory(factory: Callable[..., Measure], said: str) -> None:
    """Raise SceneError for a measure that study files cannot ask for."""
    what = f"{said}: measure {factory.__name__}"
    for name in inspect.signature(factory).parameters:
        if name not in ARGUMENTS:
            raise SceneError(f"{what} takes {name}: a study file can give {', '.join(ARGUMENTS)} only")
    try:
        made = _example(factory)
    except Exception as error:
        reason = shortened(" ".join(str(error).split()), LONGEST_REASON)
        raise SceneError(f"{what} cannot be made: {type(error).__name__}: {reason}") from None
    if not isinstance(made, Measure):
        raise SceneError(f"{what} gives {shortened(repr(made))}: expected a Measure")


def _clash(said: str, what: str, name: str, other: Any) -> str:
    source = sources.get(other.__module__)
    where = other.__module__ if source is None else source.file
    whose = "that ships" if is_shipped(other) else f"of {where}"
    return f'{said}: {what} is called "{name}", as is {other.__qualname__} {whose}: expected another name'
