"""Which entries the sparse tangent has, and where the matrix of each cell goes in it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
import scipy.sparse as sp

from jaxclamp.core.records import record, static

PAIRS = np.array([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)])
"""component pairs (i, j) of a symmetric 3 x 3 block, in the order in which matrices keep them"""

POINTS_PER_BLOCK = 1200
"""quadrature points differentiated together, in the wall of whatever mesh: one compiled program serves all,
and intermediate arrays fit a core's cache (of 768, 1200 and 2400 the quickest by a tenth)"""
FACETS_PER_BLOCK = 64
"""facets differentiated together, on the walls of whatever mesh"""


@dataclasses.dataclass(frozen=True)
class Pattern:
    """Upper triangle (with diagonal) of the symmetric tangent, by compressed rows."""

    indptr: np.ndarray
    """place of each row's first entry, (n + 1,)"""
    indices: np.ndarray
    """column of each entry, (n_nonzeros,)"""
    places: dict[str, sp.csr_matrix] = dataclasses.field(default_factory=dict)
    """by region: the entries of its matrices [a, b, pair, cell], block by block, summed into the tangent's
    values; (n_nonzeros, number of entries), ones"""

    @property
    def n(self) -> int:
        """Number of unknowns."""
        return len(self.indptr) - 1

    @property
    def diagonal(self) -> np.ndarray:
        """Place of each diagonal entry in the values, (n,)."""
        return self.indptr[:-1]


@record
class Region:
    """Some cells or facets: where terms live."""

    nodes: np.ndarray
    """of each cell or facet, (n_en, n_cells)"""
    size: int = static()
    """of a block: cells or facets differentiated together"""


@record
class Layout:
    """Numbers of the unknowns."""

    free: np.ndarray
    """degree of freedom 3 node + component of each unknown, (n_free,)"""
    n_nodes: int = static()
    """nodes of all bodies"""
    n_rigid: int = static(default=1)
    """rigid coordinates"""


def block_size(points_per_cell: int) -> int:
    """Cells of a block of the wall: the same on every mesh of one element."""
    return max(POINTS_PER_BLOCK // points_per_cell, 1)


def build_pattern(
    held: np.ndarray, regions: Mapping[str, tuple[np.ndarray, int]], n_rigid: int = 1
) -> tuple[Layout, dict[str, Region], Pattern]:
    """Number the unknowns and find the place of every matrix entry in the sparse tangent.

    held: True for degrees of freedom that are no unknowns, (n_nodes, 3)
    regions: by name, the nodes of cells or facets (n_en, n_cells) and the cells of a block
    n_rigid: rigid coordinates, which are no unknowns of the tangent
    """
    free = np.flatnonzero(~held.ravel())
    unknown = np.full(held.size, -1)
    unknown[free] = np.arange(len(free))
    n = len(free)
    entries = {
        name: np.concatenate(
            [
                _keys(nodes[:, first : first + size], size, unknown, n)
                for first in range(0, nodes.shape[1], size)
            ]
        )
        for name, (nodes, size) in regions.items()
    }
    distinct, place = np.unique(np.concatenate(list(entries.values())), return_inverse=True)
    skipped = int(distinct[0] == -1)
    ends = np.cumsum([keys.size for keys in entries.values()])[:-1]
    places = {
        name: _places(own - skipped, len(distinct) - skipped)
        for name, own in zip(entries, np.split(place.ravel(), ends), strict=True)
    }
    rows, indices = np.divmod(distinct[skipped:], n)
    indptr = np.searchsorted(rows, np.arange(n + 1))
    found = {name: Region(nodes=nodes.astype(np.int32), size=size) for name, (nodes, size) in regions.items()}
    layout = Layout(free=free.astype(np.int32), n_nodes=len(held), n_rigid=n_rigid)
    return layout, found, Pattern(indptr.astype(np.int32), indices.astype(np.int32), places)


def _places(place: np.ndarray, n_nonzeros: int) -> sp.csr_matrix:
    """Ones where an entry of cell matrices goes in the tangent's values; -1 goes nowhere."""
    (kept,) = np.nonzero(place >= 0)
    return sp.csr_matrix((np.ones(len(kept)), (place[kept], kept)), shape=(n_nonzeros, len(place)))


def _keys(nodes: np.ndarray, size: int, unknown: np.ndarray, n: int) -> np.ndarray:
    """Row times n plus column of every matrix entry [a, b, pair, cell] of a block, filled up to its size.

    -1 for what belongs nowhere.
    """
    rows = unknown[3 * nodes[:, None, None, :] + PAIRS[:, 0][:, None]]
    columns = unknown[3 * nodes[None, :, None, :] + PAIRS[:, 1][:, None]]
    rows, columns = np.broadcast_arrays(rows, columns)
    key = np.minimum(rows, columns) * np.int64(n) + np.maximum(rows, columns)
    local = np.arange(len(nodes))
    mirror = (local[:, None] > local[None])[:, :, None] & (PAIRS[:, 0] == PAIRS[:, 1])
    key[(rows < 0) | (columns < 0) | mirror[..., None]] = -1
    filling = ((0, 0), (0, 0), (0, 0), (0, size - nodes.shape[1]))
    return np.pad(key, filling, constant_values=-1).ravel()
