"""Structured blocks of hexahedra: integers and fixed fractions, made once with numpy.

A block has three directions, called after the tube's: radial (through the layers), circumferential and
axial. A brick or a strip is a block as well; where its points lie is decided elsewhere.
Sizes: n_en nodes per cell, n_fn nodes per facet.
"""

from __future__ import annotations

import math

import numpy as np

from jaxclamp.core.records import record, static
from jaxclamp.fem.elements import ELEMENTS, Element


@record
class Mesh:
    """Topology of a block. Cells are ordered layer by layer from inside to outside."""

    element: Element = static()
    """of all cells"""
    grid: tuple[int, int, int] = static()
    """nodes along (radial, circumferential, axial)"""
    wraps: bool = static(default=False)
    """the circumferential direction is closed: its first grid line comes after its last"""
    planes: str = static(default="")
    """mirror planes of a tube, by the letters of their normals"""
    radial: tuple[int, ...] = static()
    """cells through each layer"""
    cells: np.ndarray
    """node of each cell corner, (n_en, n_cells)"""
    cell_fraction: np.ndarray
    """position of the cell's nodes through their layer, 0 inside to 1 outside, (n_en, n_cells)"""
    cell_line: np.ndarray
    """circumferential grid line of the cell's nodes, counted on where the block wraps, (n_en, n_cells)"""
    layer_cells: tuple[tuple[int, int], ...] = static()
    """first and last-plus-one cell of each layer"""
    node_layer: tuple[int, ...] = static()
    """layer of each radial grid line (the inner one at interfaces), (n_r,)"""
    node_fraction: np.ndarray
    """position of each radial grid line through that layer, (n_r,)"""
    inner_facets: np.ndarray
    """nodes of the inner facets, (n_fn, n_facets)"""
    outer_facets: np.ndarray
    """nodes of the outer facets, (n_fn, n_facets)"""

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return math.prod(self.grid)

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return self.cells.shape[1]

    def node(self, radial: int, circumferential: int, axial: int) -> int:
        """Number of the node at a grid position; negative positions count from the end."""
        position = (radial, circumferential, axial)
        r, c, z = (p % n for p, n in zip(position, self.grid, strict=True))
        return (z * self.grid[1] + c) * self.grid[0] + r

    def plane(self, axis: int, index: int) -> np.ndarray:
        """Nodes with grid position `index` along `axis` (0 radial, 1 circumferential, 2 axial)."""
        numbers = np.arange(self.n_nodes).reshape(self.grid[::-1])
        return np.take(numbers, index, axis=2 - axis).ravel()

    @property
    def inner_cells(self) -> np.ndarray:
        """The cells of the inner facets, (n_facets,)."""
        return np.arange(*self.layer_cells[0], self.radial[0])

    @property
    def outer_cells(self) -> np.ndarray:
        """The cells of the outer facets, (n_facets,)."""
        first, last = self.layer_cells[-1]
        return np.arange(first + self.radial[-1] - 1, last, self.radial[-1])

    def layer_inner_line(self, layer: int) -> int:
        """Radial grid position of the inner surface of a layer."""
        return int(np.searchsorted(self.node_layer, layer)) - (layer > 0)


def build_block(
    element: str, radial: tuple[int, ...], circumferential: int, axial: int, wraps: bool = False
) -> Mesh:
    """Topology for the given counts of cells; the order of cells is layer, axial, circumferential, radial."""
    kind = ELEMENTS[element]
    m = kind.order
    grid = (m * sum(radial) + 1, m * circumferential + (not wraps), m * axial + 1)
    number = lambda r, c, z: (z * grid[1] + c % grid[1]) * grid[0] + r  # noqa: E731

    cells, fractions, lines, layer_cells = [], [], [], []
    node_layer, node_fraction = [0], [0.0]
    first_radial, first_cell = 0, 0
    for layer, count in enumerate(radial):
        z, c, r = np.meshgrid(np.arange(axial), np.arange(circumferential), np.arange(count), indexing="ij")
        local = kind.node_grid[:, :, None]
        through = m * r.ravel() + local[:, 0]
        line = m * c.ravel() + local[:, 1]
        nodes = number(m * first_radial + through, line, m * z.ravel() + local[:, 2])
        cells.append(nodes)
        fractions.append(through / (m * count))
        lines.append(line)
        layer_cells.append((first_cell, first_cell + nodes.shape[1]))
        node_layer += [layer] * (m * count)
        node_fraction += [(k + 1) / (m * count) for k in range(m * count)]
        first_radial += count
        first_cell += nodes.shape[1]

    along, around = np.meshgrid(np.arange(axial), np.arange(circumferential), indexing="ij")
    corner = kind.facet_grid[:, :, None]
    facet = lambda r: number(r, m * around.ravel() + corner[:, 0], m * along.ravel() + corner[:, 1])  # noqa: E731
    return Mesh(
        element=kind,
        grid=grid,
        wraps=wraps,
        radial=radial,
        cells=np.concatenate(cells, axis=1),
        cell_fraction=np.concatenate(fractions, axis=1),
        cell_line=np.concatenate(lines, axis=1),
        layer_cells=tuple(layer_cells),
        node_layer=tuple(node_layer),
        node_fraction=np.array(node_fraction),
        inner_facets=facet(0),
        outer_facets=facet(grid[0] - 1),
    )
