"""The places where the study of 2002 looks, on the nodes of a mesh."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.records import record, static
from jaxclamp.fem.elements import Element, gauss, lagrange
from jaxclamp.fem.grid import Mesh
from jaxclamp.fem.symmetry import Symmetry
from jaxclamp.fem.tube import circumferential_line, middle_line
from jaxclamp.scenes.scene import MeshSettings


@record
class Landmarks:
    """Nodes where the seed looks, and the stencils of the quantities read there."""

    lumen_top: int = static()
    """inner surface, compression axis, mid-length"""
    lumen_bottom: int | None = static()
    """its mirror image, where that is modelled"""
    lumen_ring: np.ndarray
    """inner surface at mid-length, round the modelled part (closed where it wraps), (n,)"""
    lumen_line: np.ndarray
    """inner surface on the compression axis, along the modelled part, (n,)"""
    opposite_line: np.ndarray | None
    """its mirror image, where that is modelled, (n,)"""
    outer_top: int = static()
    """outer surface, compression axis, mid-length"""
    P_line: np.ndarray
    """inner surface of P's layer on the compression axis, along the modelled part, (n,)"""
    P_layer: int = static()
    """layer of P: the innermost one called "media", or the innermost"""
    P_cell: int = static()
    """cell of that layer, counted in it, whose corner is P: inner surface, compression axis, mid-length"""
    P_weights: np.ndarray
    """extrapolation from that cell's quadrature points to P, (n_q,)"""
    layer_names: tuple[str, ...] = static()
    """from inside to outside"""
    element: Element = static()
    """of the mesh"""
    symmetry: Symmetry = static()
    """the mirror planes in use"""

    def layer(self, name: str) -> int:
        """Number of a layer. Raises KeyError."""
        if name not in self.layer_names:
            raise KeyError(f"there is no layer '{name}': expected one of {', '.join(self.layer_names)}")
        return self.layer_names.index(name)


def extrapolation(element: Element) -> np.ndarray:
    """From values at a cell's quadrature points to its nodes, (n_en, n_q)."""
    return lagrange(gauss(element.points_per_axis)[0], tensor_nodes(element))[0]


def tensor_nodes(element: Element) -> np.ndarray:
    """Local coordinates of the nodes, (n_en, 3)."""
    return element.nodes_1d[element.node_grid]


def layer_of_P(layer_names: tuple[str, ...]) -> int:
    """The innermost layer called "media", or the innermost."""
    return layer_names.index("media") if "media" in layer_names else 0


def find_landmarks(mesh: Mesh, settings: MeshSettings, layer_names: tuple[str, ...]) -> Landmarks:
    """The nodes and cells of interest."""
    top, middle = circumferential_line(mesh, settings, 1), middle_line(mesh, settings)
    bottom = circumferential_line(mesh, settings, 3)
    assert top is not None
    layer = layer_of_P(layer_names)
    P = mesh.node(mesh.layer_inner_line(layer), top, middle)
    first, last = mesh.layer_cells[layer]
    element = mesh.element
    # of the cells that share P, the one between the fold and the compression axis, on the positive side
    corner = int(np.flatnonzero(np.all(element.node_grid == [0, element.order, 0], axis=1))[0])
    cell = int(np.flatnonzero(mesh.cells[corner, first:last] == P)[0])
    ring = range(mesh.grid[1] + mesh.wraps)
    line = lambda c: np.array([mesh.node(0, c, z) for z in range(mesh.grid[2])])  # noqa: E731
    return Landmarks(
        lumen_top=mesh.node(0, top, middle),
        lumen_bottom=None if bottom is None else mesh.node(0, bottom, middle),
        lumen_ring=np.array([mesh.node(0, c % mesh.grid[1], middle) for c in ring]),
        lumen_line=line(top),
        opposite_line=None if bottom is None else line(bottom),
        outer_top=mesh.node(-1, top, middle),
        P_line=np.array([mesh.node(mesh.layer_inner_line(layer), top, z) for z in range(mesh.grid[2])]),
        P_layer=layer,
        P_cell=cell,
        P_weights=extrapolation(element)[corner],
        layer_names=layer_names,
        element=element,
        symmetry=Symmetry(mesh.planes),
    )


def lumen_height(x: Array, marks: Landmarks) -> Array:
    """Height of the lumen at mid-length on the compression axis, mm; x: positions, (n_nodes, 3)."""
    top = x[marks.lumen_top, 1]
    return 2.0 * top if marks.lumen_bottom is None else top - x[marks.lumen_bottom, 1]


def half_height(x: Array, marks: Landmarks) -> float:
    """Half the height of the lumen, mm, of known positions."""
    on_host: Any = np.asarray(x)  # JAX would compile every slice
    return 0.5 * float(lumen_height(on_host, marks))


def lumen_width(x: Array, marks: Landmarks) -> Array:
    """Greatest width of the lumen at mid-length, mm; x: positions, (n_nodes, 3)."""
    across = x[marks.lumen_ring, 0]
    return 2.0 * jnp.max(across) if "x" in marks.symmetry else jnp.max(across) - jnp.min(across)


def lumen_area(x: Array, marks: Landmarks) -> Array:
    """Area inside the lumen at mid-length, mm^2; x: positions, (n_nodes, 3)."""
    ring = x[marks.lumen_ring, :2]
    m = marks.element.order
    points, weights = gauss(m + 1)
    N, dN = lagrange(marks.element.nodes_1d, points[:, None])
    starts = np.arange(0, ring.shape[0] - 1, m)
    edges = ring[starts[:, None] + np.arange(m + 1)]  # (n_edges, m + 1, 2)
    place, along = jnp.einsum("qa,eai->qei", N, edges), jnp.einsum("qa,eai->qei", dN[:, 0], edges)
    swept = 0.5 * (place[..., 0] * along[..., 1] - place[..., 1] * along[..., 0])
    return marks.symmetry.parts_of_a_section * jnp.sum(weights[:, None] * swept)


def lumen_opening(x: Array, marks: Landmarks) -> Array:
    """Greatest height of the lumen at mid-length over its width, mm: of what is left beside the fold, too.

    Where the lower half is modelled, too, between opposite nodes.
    """
    heights = x[marks.lumen_ring, 1]
    if marks.lumen_bottom is None:
        return 2.0 * jnp.max(jnp.abs(heights))
    return jnp.max(
        jnp.abs(heights - heights[::-1])
    )  # the fold is in the middle of the ring, or where it closes


def closed_length(x: Array, marks: Landmarks, height: Array) -> Array:
    """Length along the artery over which the lumen is lower than `height` on the compression axis, mm.

    Linear between the nodes; x: positions, (n_nodes, 3)
    """
    line = x[marks.lumen_line]
    below = line * jnp.array([1.0, -1.0, 1.0]) if marks.opposite_line is None else x[marks.opposite_line]
    y, dz = 0.5 * (line[:, 1] - below[:, 1] - height), jnp.diff(0.5 * (line[:, 2] + below[:, 2]))
    a, b = jnp.minimum(y[:-1], y[1:]), jnp.maximum(y[:-1], y[1:])
    crossing = (a < 0.0) & (b > 0.0)
    share = jnp.where(crossing, -a / jnp.where(crossing, b - a, 1.0), jnp.where(b <= 0.0, 1.0, 0.0))
    return (2.0 if "z" in marks.symmetry else 1.0) * jnp.sum(share * dz)
