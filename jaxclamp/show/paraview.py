"""Every kept state as ParaView files: the artery and the jaws, and one index that opens them all.

The index `clamping.pvd` is a series over the states with two parts, the artery and the jaws; its time is the
occlusion. All lengths mm, all stresses kPa. `show.readme` says what the fields are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import quoteattr

import numpy as np

from jaxclamp.pictures.fields import clamp_height, jaw_height_shown, jaw_outline, layer_fields, whole
from jaxclamp.pictures.jaws import face_surface, is_drawn_out, jaw_gaps, touches
from jaxclamp.pictures.tensors import with_fibres, with_tensors
from jaxclamp.potential.model import Model
from jaxclamp.show.jaw import write_jaws

if TYPE_CHECKING:
    from jaxclamp.solve.results import Kept, Result

INDEX = "clamping.pvd"
FOLDER = "paraview"
BEFORE = -1.0
"""time of the load-free state, which has no occlusion: before all others"""
LARGEST_WHOLE = 200_000
"""cells; a finer artery is written as the modelled part"""
SIDE_MARGIN = 1.15
"""half the width of the drawn jaws over that of the widest artery"""


def write_states(
    result: Result, folder: Path, tell: Callable[[float, str], None] = lambda fraction, message: None
) -> list[Path]:
    """Write all states, and the jaw's face, into `folder`; returns the files."""
    import meshio

    (folder / FOLDER).mkdir(exist_ok=True)
    full = is_whole(result.model)
    widest = _widest(result)
    index: list[tuple[float, str, str]] = []
    for number, (kept, time) in enumerate(zip(result.states, times(result), strict=True)):
        tell(number / len(result.states), f"state {number + 1} of {len(result.states)}")
        for part, made in (
            ("artery", artery_mesh(result, kept, full)),
            ("jaws", jaw_mesh(result, kept, widest, full)),
        ):
            name = f"{FOLDER}/{part}_{number:03d}.vtu"
            meshio.write(folder / name, made, compression="zlib")
            index.append((time, part, name))
    (folder / INDEX).write_text(pvd(index), encoding="utf-8")
    of_jaw = write_jaws(result.scene.clamp, 2.0 * widest, SIDE_MARGIN * widest, folder)
    return [*(folder / name for _, _, name in index), folder / INDEX, *of_jaw]


def is_whole(model: Model) -> bool:
    """True if files show the whole artery, False if only the modelled part of it."""
    return model.symmetry.parts * model.mesh.n_cells <= LARGEST_WHOLE


def times(result: Result) -> list[float]:
    """Time of each state in the series: its occlusion; of two alike, the later one has a last digit more."""
    found: list[float] = []
    for kept in result.states:
        time = BEFORE if kept.stage == "load-free" else float(kept.values["occlusion"])
        while time in found:
            time = math.nextafter(time, math.inf)
        found.append(time)
    return found


def pvd(index: list[tuple[float, str, str]]) -> str:
    """The text of a ParaView collection; index: (time, part, file)."""
    parts = sorted({part for _, part, _ in index})
    rows = [
        f'    <DataSet timestep="{time!r}" group="" part="{parts.index(part)}" name={quoteattr(part)} '
        f"file={quoteattr(name)}/>"
        for time, part, name in index
    ]
    return "\n".join(
        [
            '<?xml version="1.0" encoding="utf-8"?>',
            '<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">',
            "  <Collection>",
            *rows,
            "  </Collection>",
            "</VTKFile>",
            "",
        ]
    )


def artery_mesh(result: Result, kept: Kept, full: bool = True) -> Any:
    """A state of the wall as a meshio mesh: one block of hexahedra, points doubled at interfaces."""
    import meshio

    load_free = result.load_free_like(kept)
    assert load_free is not None
    body = result.in_body_like(kept)
    in_body = None if body is None else body.state
    fields = layer_fields(kept.model, kept.state, load_free.state, in_body)
    layers = with_tensors(kept.model, kept.state, fields)
    layers = with_fibres(tuple(whole(layer) for layer in layers) if full else layers)
    element = kept.model.mesh.element
    starts = np.cumsum([0, *(len(layer.points) for layer in layers)])
    cells = [layer.cells + start for layer, start in zip(layers, starts, strict=False)]
    corners = np.concatenate(cells, axis=1)[list(element.meshio_nodes)].T
    cell_data = _joined([layer.cell_data for layer in layers])
    belongs = {f"layer_{layer.name}": cell_data["layer"] == i for i, layer in enumerate(layers, 1)}
    cell_data |= {name: each.astype(np.uint8) for name, each in belongs.items()}
    return meshio.Mesh(
        np.concatenate([layer.points for layer in layers]),
        [(element.meshio_name, corners)],
        point_data=_joined([layer.point_data for layer in layers]),
        cell_data={name: [v] for name, v in cell_data.items()},
    )


def _joined(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Data of all layers; tensors by rows, (n, 9), as mesh files have them."""
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return {name: v.reshape(len(v), 9) if v.ndim == 3 else v for name, v in joined.items()}


def jaw_mesh(result: Result, kept: Kept, widest: float, full: bool = True) -> Any:
    """The jaws of a state as a meshio mesh of quadrilaterals: both, or only the upper one where just that is
    modelled and shown. A jaw that is not the same all across the artery is its face alone.

    widest: half the width of the artery, mm
    """
    import meshio

    physiological = result.physiological
    open_height = None if physiological is None else physiological.values["outer_radius_mm"]
    height = jaw_height_shown(kept.model, kept.state, open_height)
    half_width, top = SIDE_MARGIN * widest, 2.0 * widest
    of = touches(kept.model)
    points, cells, jaws, count = [], [], [], 0
    for side, gap in jaw_gaps(kept.model, kept.state, height).items():
        if side < 0 and not (full or "y" not in result.model.symmetry):
            continue
        touch = of[-1] if side < 0 else of[0]
        if is_drawn_out(touch):
            found, quads = _drawn_out(jaw_outline(touch.jaw, top), height, side, half_width)
            found = found + [0.0, clamp_height(kept.model, kept.state), 0.0]
        else:
            found, quads = face_surface(gap, side, half_width, 1.2 * result.scene.clamp.half_extent(), top)
        points.append(found)
        cells.append(quads + count)
        jaws.append(np.full(len(quads), int(side < 0)))
        count += len(found)
    return meshio.Mesh(
        np.concatenate(points),
        [("quad", np.concatenate(cells))],
        cell_data={"jaw": [np.concatenate(jaws)]},
    )


def _drawn_out(
    outline: np.ndarray, height: float, side: int, half_width: float
) -> tuple[np.ndarray, np.ndarray]:
    """A section (z, y) of a jaw drawn out across the artery: points (n, 3), quadrilaterals (m, 4)."""
    z, y = outline[:-1].T
    n = len(z)
    points = np.concatenate(
        [np.stack([np.full(n, x), side * (height + y), z], axis=1) for x in (-half_width, half_width)]
    )
    around = np.arange(n)
    following = (around + 1) % n
    quads = np.stack([around, following, n + following, n + around], axis=1)
    return points, quads if side > 0 else quads[:, ::-1]


def _widest(result: Result) -> float:
    """Half the width of the artery where and when it is widest, mm."""
    xs = [np.asarray(kept.state.x)[kept.model.mesh.plane(0, -1), 0] for kept in result.states]
    return max(float(np.max(np.abs(x))) for x in xs)
