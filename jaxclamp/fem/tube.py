"""The layered tube as structured hexahedra, from stress-free open sectors to one closed wedge.

The modelled part is a quarter of the circumference (from the fold at theta = 0, the x axis, to
the compression axis at theta = 90 deg, the y axis) by half the length (from the clamp plane z = 0
to the artery's end). Each cell has its own stress-free coordinates, in the open sector of its
layer; all cells share the current coordinates of the nodes of the closed tube. A node on the
interface of two layers has therefore two stress-free positions and one current one.

Topology (`Mesh`) is integers and fixed fractions, made once with numpy; positions are functions
of the scene's floats, in JAX. Sizes: n_en nodes per cell, n_fn nodes per facet.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.records import record, static
from jaxclamp.fem.elements import ELEMENTS, Element
from jaxclamp.scenes.scene import Artery, MeshSettings


@record
class Mesh:
    """Topology of the wedge. Cells are ordered layer by layer from inside to outside."""

    element: Element = static()
    grid: tuple[int, int, int] = static()
    """nodes along (radial, circumferential, axial)"""
    cells: np.ndarray
    """node of each cell corner, (n_en, n_cells)"""
    cell_fraction: np.ndarray
    """position of the cell's nodes through their layer, 0 inside to 1 outside, (n_en, n_cells)"""
    layer_cells: tuple[tuple[int, int], ...] = static()
    """first and last-plus-one cell of each layer"""
    node_layer: np.ndarray
    """layer of each radial grid line for the closed guess (inner one at interfaces), (n_r,)"""
    node_fraction: np.ndarray
    """position of each radial grid line through that layer, (n_r,)"""
    lumen_facets: np.ndarray
    """nodes of the inner facets, (n_fn, n_facets)"""
    outer_facets: np.ndarray
    """nodes of the outer facets, (n_fn, n_facets)"""

    @property
    def n_nodes(self) -> int:
        return math.prod(self.grid)

    @property
    def n_cells(self) -> int:
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
    def fold_plane(self) -> np.ndarray:
        """Nodes with y = 0."""
        return self.plane(1, 0)

    @property
    def compression_plane(self) -> np.ndarray:
        """Nodes with x = 0."""
        return self.plane(1, -1)

    @property
    def clamp_plane(self) -> np.ndarray:
        """Nodes with z = 0."""
        return self.plane(2, 0)

    @property
    def end_plane(self) -> np.ndarray:
        """Nodes at the artery's end."""
        return self.plane(2, -1)

    def layer_inner_line(self, layer: int) -> int:
        """Radial grid position of the inner surface of a layer."""
        return int(np.searchsorted(self.node_layer, layer)) - (layer > 0)


def build_mesh(settings: MeshSettings) -> Mesh:
    """Topology for the given counts; the order of cells is layer, axial, circumferential, radial."""
    element = ELEMENTS[settings.element]
    m = element.order
    n_radial = sum(settings.radial)
    grid = (m * n_radial + 1, m * settings.circumferential + 1, m * settings.axial + 1)
    number = lambda r, c, z: (z * grid[1] + c) * grid[0] + r  # noqa: E731

    cells, fractions, layer_cells = [], [], []
    node_layer, node_fraction = [0], [0.0]
    first_radial, first_cell = 0, 0
    for layer, count in enumerate(settings.radial):
        z, c, r = np.meshgrid(
            np.arange(settings.axial), np.arange(settings.circumferential), np.arange(count), indexing="ij"
        )
        local = element.node_grid[:, :, None]
        radial = m * r.ravel() + local[:, 0]
        nodes = number(m * first_radial + radial, m * c.ravel() + local[:, 1], m * z.ravel() + local[:, 2])
        cells.append(nodes)
        fractions.append(radial / (m * count))
        layer_cells.append((first_cell, first_cell + nodes.shape[1]))
        node_layer += [layer] * (m * count)
        node_fraction += [(k + 1) / (m * count) for k in range(m * count)]
        first_radial += count
        first_cell += nodes.shape[1]

    along, around = np.meshgrid(np.arange(settings.axial), np.arange(settings.circumferential), indexing="ij")
    corner = element.facet_grid[:, :, None]
    facet = lambda r: number(r, m * around.ravel() + corner[:, 0], m * along.ravel() + corner[:, 1])  # noqa: E731
    return Mesh(
        element=element,
        grid=grid,
        cells=np.concatenate(cells, axis=1),
        cell_fraction=np.concatenate(fractions, axis=1),
        layer_cells=tuple(layer_cells),
        node_layer=np.array(node_layer),
        node_fraction=np.array(node_fraction),
        lumen_facets=facet(0),
        outer_facets=facet(grid[0] - 1),
    )


def _graded(n: int, grading: Array) -> Array:
    """n numbers from 0 to 1, spaced ever wider: expm1(g s) / expm1(g), uniform for g = 0."""
    s = jnp.linspace(0.0, 1.0, n)
    curved = jnp.abs(grading) > 1e-6
    g = jnp.where(curved, grading, 1.0)
    straight_to_second_order = s + grading * s * (s - 1.0) / 2.0
    return jnp.where(curved, jnp.expm1(g * s) / jnp.expm1(g), straight_to_second_order)


def angles(mesh: Mesh, settings: MeshSettings) -> Array:
    """Angle of each circumferential grid line in the closed tube, rad, (n_c,)."""
    return 0.5 * jnp.pi * _graded(mesh.grid[1], settings.circumferential_grading)


def axial_fractions(mesh: Mesh, settings: MeshSettings) -> Array:
    """Position of each axial grid line, 0 at the clamp to 1 at the end, (n_z,)."""
    return _graded(mesh.grid[2], settings.axial_grading)


def _heights(mesh: Mesh, settings: MeshSettings, artery: Artery) -> Array:
    """Load-free axial position of each axial grid line, mm, (n_z,)."""
    return 0.5 * artery.length * axial_fractions(mesh, settings)


def sector_share(opening_angle: Array) -> Array:
    """Angle of the open sector over the full circle, 1/k = (360 - alpha) / 360."""
    return 1.0 - opening_angle / (2.0 * jnp.pi)


def stress_free_positions(mesh: Mesh, settings: MeshSettings, artery: Artery) -> Array:
    """Position of each cell's nodes in the open sector of its layer, mm, (3, n_en, n_cells)."""
    n_r, n_c, _ = mesh.grid
    angle = angles(mesh, settings)[mesh.cells // n_r % n_c]
    height = _heights(mesh, settings, artery)[mesh.cells // (n_r * n_c)]
    radius, opened = [], []
    for layer, (first, last) in zip(artery.layers, mesh.layer_cells, strict=True):
        radius.append(layer.inner_radius + layer.thickness * mesh.cell_fraction[:, first:last])
        opened.append(angle[:, first:last] * sector_share(layer.opening_angle))
    R, phi = jnp.concatenate(radius, axis=1), jnp.concatenate(opened, axis=1)
    return jnp.stack([R * jnp.cos(phi), R * jnp.sin(phi), height])


def closed_radii(mesh: Mesh, artery: Artery) -> Array:
    """A guess of the load-free radius of each radial grid line, mm, (n_r,).

    The incompressible closing map r**2 = r_i**2 + (R**2 - R_i**2) / k. The innermost layer keeps
    the length of its middle surface, each further layer closes round the one inside.
    A square that is not positive marks layers that cannot close.
    """
    inner_squared, squares = None, []
    for number, layer in enumerate(artery.layers):
        share = sector_share(layer.opening_angle)
        R = layer.inner_radius + layer.thickness * mesh.node_fraction[mesh.node_layer == number]
        if inner_squared is None:
            middle = layer.inner_radius + 0.5 * layer.thickness
            inner_squared = (middle * share) ** 2 - (middle**2 - layer.inner_radius**2) * share
        squares.append(inner_squared + (R**2 - layer.inner_radius**2) * share)
        inner_squared = squares[-1][-1]
    return jnp.sqrt(jnp.concatenate(squares))


def closed_positions(mesh: Mesh, settings: MeshSettings, artery: Artery) -> Array:
    """A guess of the load-free position of each node, mm, (n_nodes, 3)."""
    z, theta, r = jnp.meshgrid(
        _heights(mesh, settings, artery), angles(mesh, settings), closed_radii(mesh, artery), indexing="ij"
    )
    return jnp.stack([r * jnp.cos(theta), r * jnp.sin(theta), z], axis=-1).reshape(-1, 3)
