"""Scene files (TOML) to scenes and back.

The records of `scenes.scene` are the schema (see `scenes.schema`); this module reads and writes the
files, and puts together what the records cannot say alone: presets named in place of a table,
overrides, a mesh chosen by fidelity, contact that fits the wall, and the checks that need more than
one key. Whatever is wrong ends as a `SceneError`, one sentence.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxclamp.core.failures import BadKey, SceneError
from jaxclamp.core.parts import own_parts
from jaxclamp.core.surroundings import require_fit
from jaxclamp.physics.jaws import Jaw
from jaxclamp.scenes import profile, schema
from jaxclamp.scenes.checks import check, check_laws
from jaxclamp.scenes.fidelity import COUNTS, FIDELITIES, mesh_for
from jaxclamp.scenes.fitting import fitting_contact
from jaxclamp.scenes.overrides import apply_override
from jaxclamp.scenes.presets import preset
from jaxclamp.scenes.scene import Artery, Scene
from jaxclamp.scenes.schema import refuse
from jaxclamp.scenes.toml import parsed
from jaxclamp.scenes.values import check_values
from jaxclamp.scenes.wording import shortened

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
        apply_override(table, override, source)
        _expand(table, source)
    with _refusals(f"{source}{' with overrides' if overrides else ''}"):
        return _scene(table, fidelity)


def dump_scene(scene: Scene) -> str:
    """The scene as TOML, every key written out; `loads_scene` gives the same scene again.

    Exact to the last bit for every scene that came from a file (an angle set in Python may move
    by one part in 1e16). Above it stands which parts of a user's own it needs. Raises SceneError for a scene
    that no file can hold, with arrays of constants.
    """
    lines = _needs(scene)
    with _refusals("scene"):
        _emit(schema.table(scene), "", lines)
    return "\n".join(lines).lstrip("\n") + "\n"


def scene_table(scene: Scene) -> dict[str, Any] | None:
    """The scene as the table that its file holds; None for one that no file can hold."""
    try:
        return schema.table(scene)
    except BadKey:
        return None


def _needs(scene: Scene) -> list[str]:
    """A comment for each part that is not shipped."""
    said = []
    for part in own_parts(scene):
        where = schema.quoted(Path(str(part["from"])).name)
        said.append(f"# needs {part['part']} of {where}" + (" (--import)" if part["sha256"] else ""))
    return said


def require_possible(scene: Scene) -> None:
    """Refuse a scene made in Python for what a file with its values would be refused for.

    Raises SceneError.
    """
    with _refusals("scene"):
        check(schema.read(Scene, schema.table(scene)))


def require_scene(found: Any) -> None:
    """Raise TypeError for what is no scene, Unfit if this process cannot compute."""
    require_fit()
    if not isinstance(found, Scene):
        said = shortened(repr(found))
        raise TypeError(f"expected a scene, such as jaxclamp.load_scene('human-lad'), found {said}")


def require_computable(scene: Scene) -> None:
    """Refuse what a file with the same values would be refused for, and what is no scene.

    Unlike `require_possible`, a material's constants may be arrays over points. Raises TypeError for what is
    no scene, SceneError for the rest.
    """
    require_scene(scene)
    with _refusals("scene"):
        check_values(scene)
        check(scene)


@contextmanager
def _refusals(source: str) -> Iterator[None]:
    try:
        yield
    except BadKey as error:
        raise SceneError(f"{source}: {error}") from None


def own_mesh_keys(name_or_path: str | Path) -> list[str]:
    """The mesh counts that the file or preset itself fixes, so that no fidelity changes them."""
    text, source = read_text(name_or_path)
    mesh = _parsed(text, source).get("mesh", {})
    return [key for key in COUNTS if isinstance(mesh, dict) and key in mesh]


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
    with _refusals(source):
        return parsed(text)


def _expand(table: dict[str, Any], source: str) -> None:
    """Put presets and files in place of their names (of an artery, of a clamp, of a jaw)."""
    for key in ("artery", "clamp"):
        _put_in(table, key, key, key, source)
    clamp = table.get("clamp")
    if isinstance(clamp, dict):
        for key in ("jaw", "upper", "lower"):
            _put_in(clamp, key, "jaw", f"clamp.{key}", source)
            if isinstance(jaw := clamp.get(key), dict):
                with _refusals(source):
                    clamp[key] = profile.fitted(jaw, f"clamp.{key}")


def _put_in(owner: dict[str, Any], key: str, kind: str, where: str, source: str) -> None:
    """Put a preset or a file of a kind in place of its name, if a key has one."""
    name = owner.get(key)
    if isinstance(name, str):
        try:
            owner[key] = parsed(read_text(name, kind)[0])
        except SceneError as error:
            raise SceneError(f"{source}: {where} = {schema.shown(name)}: {error}") from None


# --------------------------------------------------------------------------------- table to scene


def _scene(table: dict[str, Any], fidelity: str) -> Scene:
    table = dict(table)
    if "artery" in table and "clamp" not in table:  # every key of it may be left out, not all of them
        raise BadKey("clamp is missing: expected a table with jaw, or with upper and lower")
    if isinstance(table.get("clamp"), dict):
        table["clamp"] = _one_jaw(table["clamp"])
    mesh, contact = table.get("mesh", {}), table.get("contact", {})
    if "artery" in table:
        artery = schema.read(Artery, table["artery"], "artery")
        check_laws(artery)
        if isinstance(mesh, dict):
            table["mesh"] = mesh_for(fidelity, artery, mesh)
        if isinstance(contact, dict):
            table["contact"] = schema.table(fitting_contact(artery)) | contact
    scene = schema.read(Scene, table)
    check(scene)
    return scene


def _one_jaw(clamp: dict[str, Any]) -> dict[str, Any]:
    """`upper` and `lower` alike are one jaw."""
    if "jaw" in clamp and "upper" not in clamp and "lower" not in clamp:
        return clamp
    others = {key: value for key, value in clamp.items() if key not in ("upper", "lower")}
    if "jaw" in clamp or "upper" not in clamp or "lower" not in clamp:
        raise refuse("clamp", clamp, "either jaw, or both upper and lower")
    upper, lower = (schema.table(schema.read(Jaw, clamp[key], f"clamp.{key}")) for key in ("upper", "lower"))
    return others | {"jaw": clamp["upper"]} if upper == lower else clamp


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
