"""A result as one HDF5 file, exact to the last bit, and safe to open whoever wrote it.

The file begins with a block of text (`Header`) that HDF5 passes over: what the file is, and the digest of the
rest, so that damage is seen before anything is parsed. Behind it (`solve.loading` reads it back):

    scenes/K     `toml`, and under `floats` every number of the scene by its address, in internal units;
                 `own_parts` is what it has of a user's own, with the digests of their files
    states/K     one converged state: positions, pressures, rigid coordinates, forces and tangent there;
                 `plain` has its figures and the scene it is a state of
    results/K    `plain`: which states in which order, counts, cost, errors, failure; 0 is the result, the
                 others are those on coarser meshes that its closing path was walked on

`plain` is JSON. What a scene alone decides, such as the mesh, is not in the file: it is made again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxclamp.core.failures import SceneError
from jaxclamp.core.parts import own_parts
from jaxclamp.scenes.files import dump_scene, loads_scene
from jaxclamp.scenes.scene import Scene

KIND = "jaxclamp result"
LAYOUT = 4
"""raised with every change of what is in a file, or of what a scene makes (mesh, order of unknowns)"""
HEADER = 512
"""bytes before the HDF5 part"""


@dataclasses.dataclass(frozen=True)
class Header:
    """The text at the beginning of a file, a line each."""

    kind: str
    """`KIND`"""
    layout: int
    """see `LAYOUT`"""
    version: str
    """of the jaxclamp that wrote it"""
    digest: str
    """SHA-256 of everything behind the header"""

    def to_bytes(self) -> bytes:
        """As it stands in a file."""
        lines = f"{self.kind}\nlayout {self.layout}\njaxclamp {self.version}\nsha256 {self.digest}\n"
        return lines.encode().ljust(HEADER, b" ")

    @staticmethod
    def of(start: bytes) -> Header | None:
        """The header of a file that begins with these bytes; None if it has none."""
        lines = start[:HEADER].decode("ascii", "replace").split("\n")
        if len(lines) != 5 or lines[0] != KIND:
            return None
        found = [line.partition(" ")[2] for line in lines[1:4]]
        return Header(KIND, int(found[0]) if found[0].isdecimal() else 0, found[1], found[2])


def digest(content: bytes | memoryview) -> str:
    """Of what stands behind a header."""
    return hashlib.sha256(content).hexdigest()


def save(result: Any, path: str | Path) -> Path:
    """Write a `Result` to a file, whole or not at all; returns where it is. Raises OSError, SceneError."""
    import h5py

    path, buffer = Path(path), io.BytesIO()
    with h5py.File(buffer, "w", userblock_size=HEADER) as file:
        _write(result, file)
    view = buffer.getbuffer()
    view[:HEADER] = Header(KIND, LAYOUT, result.versions["jaxclamp"], digest(view[HEADER:])).to_bytes()
    handle, name = tempfile.mkstemp(prefix=f".{path.name[:50]}-", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as target:
            target.write(view)
        os.replace(name, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(name)
        raise
    return path


def _write(result: Any, file: Any) -> None:
    results = list(_with_coarser(result))
    models = _distinct(kept.model for r in results for kept in (r, *r.states))
    states = _distinct(kept for r in results for kept in r.states)
    for number, model in enumerate(models):
        _write_scene(file.create_group(f"scenes/{number}"), model.scene)
    for number, kept in enumerate(states):
        arrays, plain = split(kept.equilibrium)
        plain = {"stage": kept.stage, "scene": _place(models, kept.model), "equilibrium": plain}
        _put(file.create_group(f"states/{number}"), arrays, plain | {"values": kept.values})
    for number, r in enumerate(results):
        plain = {
            "scene": _place(models, r.model),
            "states": [_place(states, kept) for kept in r.states],
            "solver": r.solver,
            "cost": r.cost,
            "every_term": r.every_term,
            "errors": r.errors,
            "versions": r.versions,
            "failure": None if r.failure is None else r.failure.parts,
        }
        _put(file.create_group(f"results/{number}"), {}, plain)


def _with_coarser(result: Any) -> Iterator[Any]:
    while result is not None:
        yield result
        result = result.coarser


def _distinct(found: Iterator[Any]) -> list[Any]:
    return list({id(each): each for each in found}.values())


def _place(known: list[Any], wanted: Any) -> int:
    return next(i for i, each in enumerate(known) if each is wanted)


def split(record: Any) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays of a record by their addresses, such as "lin/values", and everything else, nested."""
    arrays: dict[str, np.ndarray] = {}
    plain: dict[str, Any] = {}
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if dataclasses.is_dataclass(value):
            inside, plain[field.name] = split(value)
            arrays |= {f"{field.name}/{name}": array for name, array in inside.items()}
        elif isinstance(value, np.ndarray | jax.Array):
            arrays[field.name] = np.asarray(value)
        else:
            plain[field.name] = value
    return arrays, plain


def _put(group: Any, arrays: dict[str, np.ndarray], plain: dict[str, Any]) -> None:
    for name, array in arrays.items():
        group.create_dataset(name, data=np.asarray(array, np.float64))
    group.create_dataset("plain", data=json.dumps(plain, default=lambda value: value.item()))


def _write_scene(group: Any, scene: Scene) -> None:
    """The scene as a file holds it, and its numbers to the last bit, arrays of constants included."""
    try:
        text = dump_scene(scene)
    except SceneError:  # constants of each point: in the text, those of the first one
        first = jax.tree_util.tree_map(lambda leaf: float(np.ravel(leaf)[0]), scene.artery)
        text = dump_scene(dataclasses.replace(scene, artery=first))
    loads_scene(text)  # else nobody could read the result back
    group.create_dataset("toml", data=text)
    group.create_dataset("own_parts", data=json.dumps(own_parts(scene)))
    for name, leaf in addresses(scene).items():
        group.create_dataset(f"floats/{name}", data=np.asarray(leaf, np.float64))


def addresses(scene: Scene) -> dict[str, Any]:
    """The numbers of a scene by address ("artery.layers[0].material.c"), in the order of its leaves."""
    leaves = jax.tree_util.tree_flatten_with_path(scene)[0]
    return {jax.tree_util.keystr(path).lstrip("."): leaf for path, leaf in leaves}
