"""The layered tube: where the nodes of a block lie, from stress-free open sectors to one closed tube.

The angle is counted from the fold (the x axis) over the compression axis (the y axis, 90 deg) on, the
length from the clamp plane (z = 0). Each cell has its own stress-free coordinates, in the open sector of
its layer; all cells share the current coordinates of the nodes of the closed tube. A node on the
interface of two layers has therefore two stress-free positions and one current one.

The counts and gradings of `MeshSettings` are those of a quarter of the circumference and half the length;
a model of more than that is the same mesh, mirrored. Positions are functions of the scene's floats, in JAX.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.fem.grid import Mesh, build_block
from jaxclamp.fem.symmetry import Symmetry, symmetry_of
from jaxclamp.scenes.scene import Artery, Clamp, MeshSettings


def build_tube(settings: MeshSettings, clamp: Clamp) -> Mesh:
    """Topology of the modelled part of the tube."""
    symmetry = symmetry_of(settings, clamp)
    around, along = (span[1] - span[0] for span in (symmetry.quarters, symmetry.halves))
    counts = around * settings.circumferential, along * settings.axial
    block = build_block(settings.element, settings.radial, *counts, symmetry.wraps)
    return dataclasses.replace(block, planes=symmetry.planes)


def circumferential_line(mesh: Mesh, settings: MeshSettings, quarter: int) -> int | None:
    """Grid line at so many right angles from the fold; None where that is not modelled."""
    first, last = Symmetry(mesh.planes).quarters
    if mesh.wraps:
        return mesh.element.order * settings.circumferential * (quarter % 4)
    inside = [k for k in (quarter, quarter - 4, quarter + 4) if first <= k <= last]
    return mesh.element.order * settings.circumferential * (inside[0] - first) if inside else None


def middle_line(mesh: Mesh, settings: MeshSettings) -> int:
    """Axial grid line at mid-length."""
    return -Symmetry(mesh.planes).halves[0] * settings.axial * mesh.element.order


def end_lines(mesh: Mesh) -> tuple[int, ...]:
    """Axial grid lines at the artery's ends."""
    return (-1,) if "z" in mesh.planes else (0, -1)


def supports(mesh: Mesh, settings: MeshSettings) -> np.ndarray:
    """True for degrees of freedom that do not move across the artery or out of a plane, (n_nodes, 3).

    Mirror planes hold their normal displacement, and the planar ends their axial one. Without the plane
    y = 0 (x = 0) nothing but the jaws would say how high (how far aside) the artery lies: its ends then
    keep their place across along their horizontal (vertical) diameter, where a mirror plane would hold
    them. No force and no parameter is added: where the mirror plane holds, those supports carry nothing.
    """
    symmetry = Symmetry(mesh.planes)
    held = np.zeros((mesh.n_nodes, 3), dtype=bool)
    ends = np.concatenate([mesh.plane(2, line) for line in end_lines(mesh)])
    for component, axis, quarters in ((0, "x", (1, 3)), (1, "y", (0, 2))):
        lines = [circumferential_line(mesh, settings, quarter) for quarter in quarters]
        for nodes in (mesh.plane(1, line) for line in lines if line is not None):
            held[nodes if axis in symmetry else np.intersect1d(nodes, ends), component] = True
    if "z" in symmetry:
        held[mesh.plane(2, 0), 2] = True
    held[ends, 2] = True
    return held


def _graded(s: Array | np.ndarray, grading: Array) -> Array:
    """Shares s of a line's elements as shares of its length: expm1(g s) / expm1(g), ever wider."""
    curved = jnp.abs(grading) > 1e-6
    g = jnp.where(curved, grading, 1.0)
    straight_to_second_order = s + grading * s * (s - 1.0) / 2.0
    return jnp.where(curved, jnp.expm1(g * s) / jnp.expm1(g), straight_to_second_order)


def angles(mesh: Mesh, settings: MeshSettings) -> Array:
    """Angle of each circumferential grid line in the closed tube, rad, (n_c,); where it wraps, and 2 pi."""
    n = mesh.element.order * settings.circumferential
    share = _graded(np.linspace(0.0, 1.0, n + 1), settings.circumferential_grading)  # of a right angle
    first, last = Symmetry(mesh.planes).quarters
    lines = [k + share if k % 2 == 0 else k + 1 - share[::-1] for k in range(first, last)]
    return 0.5 * jnp.pi * jnp.concatenate([lines[0], *(line[1:] for line in lines[1:])])


def axial_fractions(mesh: Mesh, settings: MeshSettings) -> Array:
    """Position of each axial grid line over half the length, 0 at the clamp to 1 at the end, (n_z,)."""
    half = _graded(np.linspace(0.0, 1.0, mesh.element.order * settings.axial + 1), settings.axial_grading)
    return half if mesh.grid[2] == half.shape[0] else jnp.concatenate([-half[:0:-1], half])


def through(share: np.ndarray, settings: MeshSettings, layer: int) -> Array:
    """Place in a layer, 0 inside to 1 outside, below which a share of its radial elements lies.

    Nodes inside an element are evenly spaced.
    """
    if layer == 0:
        return jnp.asarray(share)
    ends = np.linspace(0.0, 1.0, settings.radial[layer] + 1)
    return jnp.interp(jnp.asarray(share), ends, _graded(ends, settings.radial_grading))


def radial_places(mesh: Mesh, settings: MeshSettings) -> Array:
    """Number of the layer plus place through it, 0 to 1, of each radial grid line, (n_r,)."""
    layers = np.asarray(mesh.node_layer)
    within = [mesh.node_fraction[layers == k] for k in range(len(mesh.layer_cells))]
    return jnp.concatenate([through(share, settings, k) + k for k, share in enumerate(within)])


@jax.jit
def grid_lines(mesh: Mesh, settings: MeshSettings) -> tuple[Array, Array, Array]:
    """`axial_fractions`, `angles` and `radial_places`, in one program."""
    return axial_fractions(mesh, settings), angles(mesh, settings), radial_places(mesh, settings)


def _heights(mesh: Mesh, settings: MeshSettings, artery: Artery) -> Array:
    """Load-free axial position of each axial grid line, mm, (n_z,)."""
    return end_height(artery, 1.0) * axial_fractions(mesh, settings)


def end_height(artery: Artery, axial_stretch: Array | float) -> Array:
    """Distance of the artery's ends from mid-length at a stretch, mm."""
    return 0.5 * artery.length * axial_stretch


def sector_share(opening_angle: Array) -> Array:
    """Angle of the open sector over the full circle, 1/k = (360 - alpha) / 360."""
    return 1.0 - opening_angle / (2.0 * jnp.pi)


def stress_free_positions(mesh: Mesh, settings: MeshSettings, artery: Artery) -> Array:
    """Position of each cell's nodes in the open sector of its layer, mm, (3, n_en, n_cells)."""
    n_r, n_c, _ = mesh.grid
    angle = angles(mesh, settings)[mesh.cell_line]
    height = _heights(mesh, settings, artery)[mesh.cells // (n_r * n_c)]
    radius, opened = [], []
    for k, (layer, (first, last)) in enumerate(zip(artery.layers, mesh.layer_cells, strict=True)):
        place = through(mesh.cell_fraction[:, first:last], settings, k)
        radius.append(layer.inner_radius + layer.thickness * place)
        opened.append(angle[:, first:last] * sector_share(layer.opening_angle))
    R, phi = jnp.concatenate(radius, axis=1), jnp.concatenate(opened, axis=1)
    return jnp.stack([R * jnp.cos(phi), R * jnp.sin(phi), height])


def closed_radii(mesh: Mesh, settings: MeshSettings, artery: Artery) -> Array:
    """A guess of the load-free radius of each radial grid line, mm, (n_r,).

    The incompressible closing map r**2 = r_i**2 + (R**2 - R_i**2) / k. The innermost layer keeps
    the length of its middle surface, each further layer closes round the one inside.
    A square that is not positive marks layers that cannot close.
    """
    inner_squared, squares = None, []
    places = radial_places(mesh, settings)
    for number, layer in enumerate(artery.layers):
        share = sector_share(layer.opening_angle)
        R = layer.inner_radius + layer.thickness * (places[np.asarray(mesh.node_layer) == number] - number)
        if inner_squared is None:
            middle = layer.inner_radius + 0.5 * layer.thickness
            inner_squared = (middle * share) ** 2 - (middle**2 - layer.inner_radius**2) * share
        squares.append(inner_squared + (R**2 - layer.inner_radius**2) * share)
        inner_squared = squares[-1][-1]
    return jnp.sqrt(jnp.concatenate(squares))


@jax.jit
def closed_positions(mesh: Mesh, settings: MeshSettings, artery: Artery) -> Array:
    """A guess of the load-free position of each node, mm, (n_nodes, 3)."""
    around = angles(mesh, settings)[: mesh.grid[1]]
    z, theta, r = jnp.meshgrid(
        _heights(mesh, settings, artery), around, closed_radii(mesh, settings, artery), indexing="ij"
    )
    return jnp.stack([r * jnp.cos(theta), r * jnp.sin(theta), z], axis=-1).reshape(-1, 3)
