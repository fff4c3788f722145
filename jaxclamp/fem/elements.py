"""Reference elements on [-1, 1]^3: nodes, quadrature, shape functions, pressure modes.

Local axes are (radial, circumferential, axial). To add an element, add one entry to `ELEMENTS`.

q1p0 keeps the mean volume of a cell alone. Where a wall is compressed along its surface, cells that are long
along the artery then buckle into waves that alternate along it with no mean change of volume, long before a
surface does: at a stretch ratio of 0.54 for cells four times as long as wide, against 0.296 (Biot 1963). q1pz
resists these waves by a second pressure, linear along the artery, whose modulus is the shear modulus times
how long the cell is over across: enough for cells ten times as long as wide, and too little to lock
(docs/closure.md).
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np


def gauss(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre points (n,) and weights (n,) on [-1, 1]."""
    return np.polynomial.legendre.leggauss(n)


def lobatto(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Lobatto points (n,), the ends among them, and weights (n,) on [-1, 1]; n of at least 2."""
    P = np.polynomial.legendre.Legendre.basis(n - 1)
    points = np.concatenate([[-1.0], np.sort(P.deriv().roots().real), [1.0]])
    return points, 2.0 / (n * (n - 1) * P(points) ** 2)


Rule = Callable[[int], tuple[np.ndarray, np.ndarray]]


def tensor_rule(counts: tuple[int, ...], rule: Rule = gauss) -> tuple[np.ndarray, np.ndarray]:
    """Product rule: points (n_q, dimensions) and weights (n_q,)."""
    rules = [rule(n) for n in counts]
    points = np.array(list(itertools.product(*[r[0] for r in rules])))
    weights = np.array([np.prod(w) for w in itertools.product(*[r[1] for r in rules])])
    return points, weights


@dataclasses.dataclass(frozen=True)
class Element:
    """A tensor-product Lagrange hexahedron with discontinuous pressure modes."""

    name: str
    """name in scene files"""
    order: int
    """polynomial order of the displacement"""
    pressure_axes: tuple[int, ...]
    """local axes along which a cell's pressure is linear; none: one pressure per cell (mean dilatation)"""
    linear_modulus: float | None
    """modulus of the linear pressures, in shear moduli of the material, of a cell as long as wide; None: its
    bulk modulus"""
    meshio_name: str
    """cell type in mesh files"""
    meshio_nodes: tuple[int, ...]
    """node of this element for each node of the mesh-file cell"""

    @property
    def nodes_1d(self) -> np.ndarray:
        """Equally spaced nodes along one axis, (order + 1,)."""
        return np.linspace(-1.0, 1.0, self.order + 1)

    @property
    def node_grid(self) -> np.ndarray:
        """Grid position (radial, circumferential, axial) of each node, integers (n_en, 3)."""
        return np.array(list(itertools.product(range(self.order + 1), repeat=3)))

    @property
    def facet_grid(self) -> np.ndarray:
        """Grid position (circumferential, axial) of the nodes of a cylindrical facet, (n_fn, 2)."""
        return np.array(list(itertools.product(range(self.order + 1), repeat=2)))

    @property
    def points_per_axis(self) -> int:
        """Gauss points per axis for the wall energy."""
        return self.order + 1

    def quadrature(self) -> tuple[np.ndarray, np.ndarray]:
        """Points (n_q, 3) and weights (n_q,) of the cell."""
        return tensor_rule((self.points_per_axis,) * 3)

    def shape(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Shape functions at `points` (n, dimensions): N (n, n_en), dN/dxi (n, dimensions, n_en)."""
        return lagrange(self.nodes_1d, points)

    def pressure_modes(self, points: np.ndarray) -> np.ndarray:
        """Pressure modes at `points` (n, 3): 1 and the coordinates along `pressure_axes`, (n_modes, n)."""
        return np.vstack([np.ones((1, len(points))), points[:, list(self.pressure_axes)].T])


def lagrange(nodes: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tensor-product Lagrange polynomials on `nodes` (m,) per axis, at points (n, dimensions).

    Returns values (n, m**dimensions) and gradients (n, dimensions, m**dimensions); the last axis
    varies fastest in the numbering of the nodes.
    """
    n_points, dimensions = points.shape
    value = np.empty((dimensions, n_points, len(nodes)))
    slope = np.empty_like(value)
    for k, node in enumerate(nodes):
        others = np.delete(nodes, k)
        polynomial = np.polynomial.Polynomial.fromroots(others) / np.prod(node - others)
        value[..., k] = polynomial(points.T)
        slope[..., k] = polynomial.deriv()(points.T)

    def product(factors: list[np.ndarray]) -> np.ndarray:
        result = factors[0]
        for factor in factors[1:]:
            result = (result[:, :, None] * factor[:, None, :]).reshape(n_points, -1)
        return result

    N = product(list(value))
    dN = np.stack(
        [
            product([slope[d] if d == axis else value[d] for d in range(dimensions)])
            for axis in range(dimensions)
        ],
        axis=1,
    )
    return N, dN


def _vtk_order(order: int) -> tuple[int, ...]:
    """Our node for each node of a VTK hexahedron (8 nodes, or 27: corners, edges, faces, centre).

    VTK numbers its corners (0,0,0) (1,0,0) (1,1,0) (0,1,0), then the same at the top.
    """
    m = order + 1
    position = lambda i, j, k: (i * m + j) * m + k  # noqa: E731
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    nodes = [tuple(order * c for c in corner) for corner in corners]
    if order == 2:
        round_bottom, round_top = [(0, 1), (1, 2), (2, 3), (3, 0)], [(4, 5), (5, 6), (6, 7), (7, 4)]
        edges = [*round_bottom, *round_top, (0, 4), (1, 5), (2, 6), (3, 7)]
        nodes += [tuple((a + b) // 2 for a, b in zip(nodes[p], nodes[q], strict=True)) for p, q in edges]
        nodes += [(0, 1, 1), (2, 1, 1), (1, 0, 1), (1, 2, 1), (1, 1, 0), (1, 1, 2), (1, 1, 1)]
    return tuple(position(*n) for n in nodes)


ELEMENTS = {
    e.name: e
    for e in (
        Element("q1p0", 1, (), None, "hexahedron", _vtk_order(1)),
        Element("q1pz", 1, (2,), 1.0, "hexahedron", _vtk_order(1)),
        Element("q2p1", 2, (0, 1, 2), None, "hexahedron27", _vtk_order(2)),
    )
}
