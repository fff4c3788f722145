"""Scene files (TOML) to scenes and back.

The records of `scenes.scene` are the schema (see `scenes.schema`); this module adds what they
cannot say alone: presets named in place of a table, overrides, a mesh chosen by fidelity, and
the checks that need more than one key. Whatever is wrong ends as a `SceneError`, one sentence.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

from jaxclamp.core.failures import BadKey, SceneError
from jaxclamp.physics.jaws import Jaw
from jaxclamp.scenes import schema
from jaxclamp.scenes.checks import check, check_signs
from jaxclamp.scenes.presets import did_you_mean, preset
from jaxclamp.scenes.scene import Artery, MeshSettings, Scene, Stop
from jaxclamp.scenes.schema import refuse

__all__ = [
    "EXPECTED_ERRORS",
    "FIDELITIES",
    "SceneError",
    "dump_scene",
    "load_scene",
    "loads_scene",
    "mesh_for",
    "own_mesh_keys",
    "require_computable",
    "require_possible",
]

# fidelity -> elements over the quarter circumference, over the half length, through the wall
FIDELITIES = {"draft": (7, 10, 5), "standard": (10, 15, 8), "reference": (20, 30, 16)}

EXPECTED_ERRORS = {
    "draft": {
        "smooth axial peak": 0.04,
        "jaw force": 0.06,
        "stress at P": 0.05,
        "lumen radius": 0.003,
    },
    "standard": {
        "smooth axial peak": 0.02,
        "jaw force": 0.04,
        "stress at P": 0.03,
        "lumen radius": 0.002,
    },
    "reference": {
        "smooth axial peak": 0.01,
        "jaw force": 0.02,
        "stress at P": 0.005,
        "lumen radius": 0.002,
    },
}
"""relative errors measured on human-lad, rounded: docs/accuracy-human-lad.md; the peak is the media's"""

LARGEST_FILE = 1_000_000
"""bytes"""


def load_scene(name_or_path: str | Path, overrides: Sequence[str] = (), fidelity: str = "standard") -> Scene:
    """The scene of a preset or a TOML file, changed by `overrides` such as "clamp.jaw.radius_mm=1.5".

    fidelity: the mesh where the file leaves it out: "draft", "standard" or "reference".
    Raises SceneError.
    """
    text, source = read_text(name_or_path)
    return loads_scene(text, source=source, overrides=overrides, fidelity=fidelity)


def loads_scene(
    text: str, source: str = "scene", overrides: Sequence[str] = (), fidelity: str = "standard"
) -> Scene:
    """The scene written in `text`; `source` names it in errors. See `load_scene`."""
    if fidelity not in FIDELITIES:
        raise SceneError(f"fidelity = {schema.shown(fidelity)}: expected one of {', '.join(FIDELITIES)}")
    table = _parsed(text, source)
    _expand(table, source)
    for override in overrides:
        _apply(table, override, source)
        _expand(table, source)
    with _refusals(f"{source}{' with overrides' if overrides else ''}"):
        return _scene(table, fidelity)


def dump_scene(scene: Scene) -> str:
    """The scene as TOML, every key written out; `loads_scene` gives the same scene again.

    Exact to the last bit for every scene that came from a file (an angle set in Python may move
    by one part in 1e16).
    """
    lines: list[str] = []
    _emit(schema.table(scene), "", lines)
    return "\n".join(lines).lstrip("\n") + "\n"


def require_possible(scene: Scene) -> None:
    """Refuse a scene made in Python for what a file with its values would be refused for.

    Raises SceneError.
    """
    with _refusals("scene"):
        check(schema.read(Scene, schema.table(scene)))


def require_computable(scene: Scene) -> None:
    """Refuse a scene made in Python with a number that is not finite, or not positive where it has to be.

    Raises SceneError.
    """
    with _refusals("scene"):
        check_signs(scene)


@contextmanager
def _refusals(source: str) -> Iterator[None]:
    try:
        yield
    except BadKey as error:
        raise SceneError(f"{source}: {error}") from None


def mesh_for(fidelity: str, artery: Artery) -> MeshSettings:
    """The mesh of a fidelity: the radial elements are shared out by the layers' thickness."""
    circumferential, axial, radial = FIDELITIES[fidelity]
    if fidelity == "reference":
        counts = tuple(2 * count for count in mesh_for("standard", artery).radial)
    else:
        counts = _shares(radial, [float(layer.thickness) for layer in artery.layers])
    counts_of_all = {"circumferential": circumferential, "axial": axial, "radial": list(counts)}
    return schema.read(MeshSettings, counts_of_all, "mesh")


def own_mesh_keys(name_or_path: str | Path) -> list[str]:
    """The mesh counts that the file or preset itself fixes, so that no fidelity changes them."""
    text, source = read_text(name_or_path)
    mesh = _parsed(text, source).get("mesh", {})
    return [key for key in ("circumferential", "axial", "radial") if isinstance(mesh, dict) and key in mesh]


def _shares(total: int, sizes: list[float]) -> tuple[int, ...]:
    """`total` shared out in proportion to `sizes`, by largest remainder, at least one each."""
    quotas = [total * size / sum(sizes) for size in sizes]
    counts = [int(quota) for quota in quotas]
    by_remainder = sorted(range(len(sizes)), key=lambda i: counts[i] - quotas[i])
    for i in by_remainder[: total - sum(counts)]:
        counts[i] += 1
    return tuple(max(1, count) for count in counts)


# --------------------------------------------------------------------------------- text to table


def read_text(name_or_path: str | Path, kind: str = "scene") -> tuple[str, str]:
    """The TOML text of a file or of a preset of that kind, and the name it goes by in errors."""
    path = Path(name_or_path)
    looks_like_a_file = isinstance(name_or_path, Path) or path.suffix == ".toml" or path.name != name_or_path
    if not looks_like_a_file and not path.is_file():
        found = preset(str(name_or_path), kind)
        return found.text, found.name
    source = str(path) if str(path).isprintable() else ascii(str(path))
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE + 1)
        if len(content) > LARGEST_FILE:
            raise SceneError(f"{source}: expected a {kind} file of at most {LARGEST_FILE // 1000} kB")
        return content.decode("utf-8-sig"), source
    except FileNotFoundError:
        raise SceneError(f"{source}: there is no such file") from None
    except UnicodeDecodeError as error:
        raise SceneError(f"{source}: expected UTF-8 text, found another byte at {error.start}") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise SceneError(f"{source}: the file cannot be read: {reason}") from None


def _parsed(text: str, source: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise SceneError(f"{source}: not valid TOML: {' '.join(str(error).split())}") from None


def _expand(table: dict[str, Any], source: str) -> None:
    """Put presets in place of their names (of an artery, of a jaw)."""
    clamp = table.get("clamp")
    places = [(table, "artery", "artery")]
    if isinstance(clamp, dict):
        places += [(clamp, key, "jaw") for key in ("jaw", "upper", "lower")]
    for owner, key, kind in places:
        name = owner.get(key)
        if isinstance(name, str):
            where = key if kind == "artery" else f"clamp.{key}"
            try:
                owner[key] = tomllib.loads(preset(name, kind).text)
            except SceneError as error:
                raise SceneError(f"{source}: {where} = {schema.shown(name)}: {error}") from None


# --------------------------------------------------------------------------------- overrides

_STEP = re.compile(r"([A-Za-z0-9_-]+)((?:\[\d{1,6}\])*)")

# of these sets of keys a table holds one: an override that brings in a key pushes out the other sets
_ONE_OF = {
    "stop": [{"closed"}, *({key} for stop in get_args(Stop) for key in schema.fields_by_key(stop))],
    "clamp": [{"jaw"}, {"upper", "lower"}],
}


def _apply(table: dict[str, Any], override: str, source: str) -> None:
    """Change one value of `table`."""
    path, equals, text = override.partition("=")
    path = path.strip()
    said = f"{source}: override {schema.shown(override)}"
    steps = _steps(path)
    if not equals or not steps:
        raise SceneError(f"{said}: expected KEY=VALUE such as artery.layers[0].material.c_kPa=30")
    value = _value(text.strip(), said)
    node: Any = table
    for step, following in pairwise(steps):
        if isinstance(step, str) and isinstance(node, dict) and isinstance(following, str):
            node.setdefault(step, {})
        node = _inside(node, step, path, said)
    last = steps[-1]
    if isinstance(node, dict) and isinstance(last, str):
        if len(steps) == 2:
            _push_out(node, _ONE_OF.get(str(steps[0]), []), last)
        node[last] = value
    else:
        _inside(node, last, path, said)
        node[last] = value


def _push_out(node: dict[str, Any], one_of: list[set[str]], key: str) -> None:
    if any(key in keys for keys in one_of):
        for other in (other for keys in one_of if key not in keys for other in keys):
            node.pop(other, None)


def _steps(path: str) -> list[str | int]:
    """Keys and list positions of "artery.layers[0].name"; empty if it is no such path."""
    steps: list[str | int] = []
    for part in path.split("."):
        match = _STEP.fullmatch(part)
        if match is None:
            return []
        steps += [match[1], *(int(i) for i in re.findall(r"\d+", match[2]))]
    return steps


def _inside(node: Any, step: str | int, path: str, said: str) -> Any:
    """The value of `node` at `step`; SceneError if it has none."""
    if isinstance(step, int) and isinstance(node, list) and step < len(node):
        return node[step]
    if isinstance(step, str) and isinstance(node, dict) and step in node:
        return node[step]
    where = f"[{step}]" if isinstance(step, int) else repr(step)
    if isinstance(node, dict):
        raise SceneError(f"{said}: {path} does not exist; {did_you_mean(str(step), list(node))}")
    if isinstance(node, list):
        raise SceneError(f"{said}: {path} does not exist: expected a position from [0] to [{len(node) - 1}]")
    raise SceneError(f"{said}: {path} does not exist: {where} is asked of {schema.shown(node)}")


def _value(text: str, said: str) -> Any:
    """A TOML value; a bare word is a string."""
    try:
        parsed = tomllib.loads(f"value = {text}")
        if parsed.keys() == {"value"}:
            return parsed["value"]
    except (tomllib.TOMLDecodeError, RecursionError, ValueError):
        if re.fullmatch(r"\w[\w.+-]*", text):
            return text
    raise SceneError(f'{said}: expected a number, a word, a "text", a [list] or a {{ table }} after the =')


# --------------------------------------------------------------------------------- table to scene


def _scene(table: dict[str, Any], fidelity: str) -> Scene:
    table = dict(table)
    if isinstance(table.get("clamp"), dict):
        table["clamp"] = _one_jaw(table["clamp"])
    if isinstance(table.get("stop"), dict) and "closed" in table["stop"]:
        raise refuse(
            "stop.closed",
            table["stop"]["closed"],
            "another stop: complete closure is not available yet; use an occlusion, such as 0.925",
        )
    mesh = table.get("mesh", {})
    if "artery" in table and isinstance(mesh, dict):
        artery = schema.read(Artery, table["artery"], "artery")
        table["mesh"] = schema.table(mesh_for(fidelity, artery)) | mesh
    scene = schema.read(Scene, table)
    check(scene)
    return scene


def _one_jaw(clamp: dict[str, Any]) -> dict[str, Any]:
    """`upper` and `lower` alike are one jaw."""
    if "upper" not in clamp and "lower" not in clamp:
        return clamp
    others = {key: value for key, value in clamp.items() if key not in ("upper", "lower")}
    if "jaw" in clamp or "upper" not in clamp or "lower" not in clamp:
        raise refuse("clamp", clamp, "either jaw, or both upper and lower")
    upper, lower = (schema.table(schema.read(Jaw, clamp[key], f"clamp.{key}")) for key in ("upper", "lower"))
    if upper != lower:
        raise refuse(
            "clamp.lower",
            clamp["lower"],
            "the same jaw as clamp.upper: two different jaws are not available yet",
        )
    return others | {"jaw": clamp["upper"]}


# --------------------------------------------------------------------------------- table to text


def _emit(table: dict[str, Any], path: str, lines: list[str]) -> None:
    """Append `table` as TOML: its values, then its tables; tables two levels down stay on a line."""
    apart = {
        key
        for key, value in table.items()
        if _is_list_of_tables(value) or (path == "" and isinstance(value, dict))
    }
    lines += [
        f"{schema.bare(key)} = {schema.toml_value(value)}" for key, value in table.items() if key not in apart
    ]
    for key in (key for key in table if key in apart):
        name = schema.join(path, key)
        several = _is_list_of_tables(table[key])
        for item in table[key] if several else [table[key]]:
            lines += ["", f"[[{name}]]" if several else f"[{name}]"]
            _emit(item, name, lines)


def _is_list_of_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)
