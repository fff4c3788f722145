"""Results back from their files (`solve.saving`).

Nothing that stands in a file is run, follows a link, or takes more memory than the file has bytes and its
scene needs. Whatever is wrong ends as a `SceneError`, one sentence.
"""

from __future__ import annotations

import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxclamp.core.failures import EquilibriumError, Failure, NotConverged, SceneError
from jaxclamp.core.parts import own_parts
from jaxclamp.observe.figures import FIGURES
from jaxclamp.potential.energy import State
from jaxclamp.potential.model import Model, build_model
from jaxclamp.potential.tangent import Linearisation
from jaxclamp.scenes.files import loads_scene, require_computable
from jaxclamp.scenes.scene import Scene
from jaxclamp.scenes.wording import shortened
from jaxclamp.solve.linear_solvers import Factors
from jaxclamp.solve.memory import require_memory, unknowns_of
from jaxclamp.solve.newton import Equilibrium
from jaxclamp.solve.results import Kept, Result, versions
from jaxclamp.solve.saving import HEADER, LAYOUT, Header, addresses, digest

DEEPEST = 4
"""groups within groups of a file"""
STAGES = ("load-free", "physiological", "clamping")
TYPES = {"float": (float, int), "int": (int,), "bool": (bool,), "int | None": (int, type(None))}
"""what stands in JSON for a field of a record, by its annotation"""


class _Unsound(Exception):
    """What is wrong inside a file."""


def load_result(path: str | Path) -> Result:
    """The result that `Result.save` wrote to a file: the same figures, gradients, errors and pictures.

    Laws, jaws and stops of one's own must be imported before, from files that have not changed since. The
    file of the result may come from a stranger.

    Raises SceneError for a file that is missing, damaged, no result, of another version of jaxclamp (its
    first two numbers count), or made with other parts of one's own; TooLittleMemory for one whose mesh does
    not fit.
    """
    import h5py

    source = str(path) if str(path).isprintable() else ascii(str(path))
    content = _sound_content(path, source)
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            _require_plain(file)
            return _read(file)
    except Failure as error:
        if isinstance(error, SceneError):
            raise SceneError(f"{source}: {error}") from None
        raise
    except _Unsound as error:
        raise SceneError(f"{source}: expected a saved result: {error}") from None
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        OSError,
        RuntimeError,
        TypeError,
        ValueError,
    ) as error:
        said = type(error).__name__
        raise SceneError(f"{source}: expected a saved result, found something else inside ({said})") from None


def _sound_content(path: str | Path, source: str) -> bytes:
    """The bytes of a file of this version that are as they were written. Raises SceneError."""
    try:
        content = Path(path).read_bytes()
    except FileNotFoundError:
        raise SceneError(f"{source}: there is no such file") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise SceneError(f"{source}: the file cannot be read: {reason}") from None
    header, this = Header.of(content), versions()["jaxclamp"]
    if header is None:
        raise SceneError(f"{source}: expected a result saved by jaxclamp, found another kind of file")
    if header.layout != LAYOUT or _release(header.version) != _release(this):
        by = f"{shortened(header.version)!a} (layout {header.layout})"
        here = f"{this} (layout {LAYOUT})"
        raise SceneError(f"{source}: saved by jaxclamp {by}, this is {here}: clamp its scene again")
    if digest(memoryview(content)[HEADER:]) != header.digest:
        raise SceneError(f"{source}: the file is damaged: it is not what jaxclamp wrote")
    return content


def _release(version: str) -> list[str]:
    """The first two numbers of a version: what comes behind them changes no state."""
    return version.partition("+")[0].split(".")[:2]


def _require_plain(group: Any, depth: int = 0) -> None:
    """Raise _Unsound for links, data elsewhere, and data larger than the file's own bytes."""
    import h5py

    for name in group:
        item = group[name] if isinstance(group.get(name, getlink=True), h5py.HardLink) else None
        if isinstance(item, h5py.Group) and depth < DEEPEST:
            _require_plain(item, depth + 1)
        elif isinstance(item, h5py.Dataset) and item.external is None and not item.is_virtual:
            text = h5py.check_string_dtype(item.dtype)
            of_text = text is not None and text.length is None and item.shape == ()
            of_numbers = item.dtype == np.float64 and item.id.get_storage_size() == item.nbytes
            if not (of_text or of_numbers) or item.chunks is not None:
                raise _Unsound(f"{shortened(item.name)!a} is neither numbers nor a text")
        else:
            raise _Unsound(f"{shortened(str(name))!a} leads elsewhere")


# --- pieces -----------------------------------------------------------------------------------------


def _read(file: Any) -> Result:
    models = [_model(file[f"scenes/{i}"]) for i in range(len(file["scenes"]))]
    states = [_kept(file[f"states/{i}"], models) for i in range(len(file["states"]))]
    result: Result | None = None
    for number in reversed(range(len(file["results"]))):
        result = _result(_plain(file[f"results/{number}"]), models, states, result)
    if result is None:
        raise _Unsound("there is none in it")
    return result


def _text(dataset: Any) -> str:
    return str(dataset.asstr()[()])


def _plain(group: Any) -> dict[str, Any]:
    found = json.loads(_text(group["plain"]))
    if not isinstance(found, dict):
        raise _Unsound(f"{group.name} has no table")
    return found


def _model(group: Any) -> Model:
    """The model of a scene, made again."""
    made_with = json.loads(_text(group["own_parts"]))
    try:
        outline = loads_scene(_text(group["toml"]), "its scene")
    except SceneError as error:
        if not made_with:
            raise
        raise SceneError(
            f"{error} (made with {_in_words(made_with)}, which is known once imported)"
        ) from None
    if _essence(has := own_parts(outline)) != _essence(made_with):
        raise SceneError(
            f"expected its scene to be of the parts that it was made with, {_in_words(made_with)}; found "
            f"{_in_words(has)}: import their file as it was then, or clamp the scene again"
        )
    known = {name: group[f"floats/{name}"][()] for name in addresses(outline)}
    leaves = [float(leaf) if np.ndim(leaf) == 0 else leaf for leaf in known.values()]
    scene: Scene = jax.tree_util.tree_unflatten(jax.tree_util.tree_structure(outline), leaves)
    require_computable(scene)
    require_memory(unknowns_of(scene))
    return build_model(scene)


def _essence(parts: list[dict[str, Any]]) -> set[tuple[str, str | None]]:
    """What has to be the same of parts of a user's own; their file may have moved."""
    return {(part["part"], part["sha256"]) for part in parts}


def _in_words(parts: list[dict[str, Any]]) -> str:
    """Parts of a user's own, with the beginning of their digests."""
    said = []
    for part in parts:
        sha256 = "" if part["sha256"] is None else f", sha256 {shortened(str(part['sha256']), 11)!a}"
        said.append(f"{shortened(part['part'])!a} of {shortened(part['from'])!a}{sha256}")
    return shortened(", ".join(said), 300) or "none of one's own"


def _kept(group: Any, models: list[Model]) -> Kept:
    """One converged state."""
    plain = _plain(group)
    model, e = models[plain["scene"]], plain["equilibrium"]
    n_q, n_x, n_free = model.discretisation.layout.n_rigid, model.mesh.n_nodes, model.pattern.n
    modes = (len(model.discretisation.stencils.modes), model.mesh.n_cells)
    state = {"x": (n_x, 3), "p": modes, "q": (n_q,)}
    lin = {
        "wall_force": (n_x, 3),
        "residual": (n_free,),
        "missing": (n_free,),
        "values": (len(model.pattern.indices),),
        "rigid_force": (n_q,),
        "coupling": (n_free, n_q),
        "rigid_stiffness": (n_q, n_q),
    }

    def arrays(within: str, shapes: dict[str, tuple[int, ...]]) -> dict[str, Any]:
        return {name: _array(group[f"{within}{name}"], shape) for name, shape in shapes.items()}

    own = {key: value for key, value in e.items() if key not in ("state", "lin")}
    equilibrium = _checked(
        Equilibrium(
            state=jax.device_put(State(**arrays("state/", state))),
            lin=_checked(Linearisation(**arrays("lin/", lin), **e["lin"])),
            **arrays("", {"responses": (n_free, 1 + n_q)}),
            **own,
        )
    )
    if plain["stage"] not in STAGES or list(plain["values"]) != [figure.key for figure in FIGURES]:
        raise _Unsound(f"{group.name} has other figures")
    return Kept(plain["stage"], equilibrium, plain["values"], model)


def _array(dataset: Any, shape: tuple[int, ...]) -> np.ndarray:
    if dataset.shape != shape:
        raise _Unsound(f"{dataset.name} has shape {dataset.shape}, not {shape}")
    return np.asarray(dataset[()])


def _checked(record: Any) -> Any:
    """The record, if its numbers are some."""
    for field in dataclasses.fields(record):
        kinds = TYPES.get(str(field.type))
        if kinds is not None and type(getattr(record, field.name)) not in kinds:
            raise _Unsound(f"{field.name} is no {field.type}")
    return record


def _result(plain: dict[str, Any], models: list[Model], states: list[Kept], coarser: Result | None) -> Result:
    """One result, with the one on the coarser mesh."""
    model, parts = models[plain["scene"]], plain["failure"]
    failure = None
    if parts is not None:
        stage, load, reason, residual, J_min, advice = parts
        failure = EquilibriumError(stage, load, NotConverged(reason, residual, J_min), advice)
    result = Result(
        model=model,
        states=tuple(states[i] for i in plain["states"]),
        failure=failure,
        solver=plain["solver"],
        cost=plain["cost"],
        factors=Factors(model.pattern, model.scene.solver.linear_solver),
        every_term=plain["every_term"],
        coarser=coarser,
        errors=plain["errors"],
        versions=plain["versions"],
    )
    if failure is not None:
        failure.result = result
    return result
