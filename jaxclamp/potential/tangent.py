"""From densities at points to residual and sparse tangent.

A density is a pointwise scalar of n_c vectors y_c = sum_a S[q, c, a] x_a (tangents, or a position).
Its first and second derivatives with respect to y come from autodiff; the stencil S is the same
for every cell, so that the contraction to cell vectors and matrices is one product with a
constant matrix. Cell matrices are kept as the six component pairs (xx, yy, zz, xy, xz, yz) over
all pairs of nodes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.records import record, static
from jaxclamp.core.tensors import Tensor, components, det, pointwise_derivatives, stacked, total
from jaxclamp.fem.elements import tensor_rule
from jaxclamp.fem.tube import Mesh
from jaxclamp.physics.materials import Material
from jaxclamp.potential.densities import (
    Geometry,
    Parameters,
    Stencils,
    contact_density,
    dilatation_density,
    intima_density,
    jaw_gap,
    lumen_density,
    wall_density,
)

PAIRS = np.array([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)])

AnyArray = Array | np.ndarray
Density = Callable[[Tensor], Array]


def at_points(stencil: AnyArray, x: Array) -> dict[tuple[int, int], Array]:
    """y_c = sum_a S[q, c, a] x_a at every point, by components [c, i]: each (n_q, n_cells).

    stencil: (n_q, n_c, n_en); x: positions of the cells' nodes, (n_en, 3, n_cells)
    """
    n_q, n_c, n_en = stencil.shape
    y = jnp.matmul(jnp.reshape(stencil, (n_q * n_c, n_en)), x.reshape(n_en, -1))
    return components(jnp.moveaxis(y.reshape(n_q, n_c, 3, -1), 0, 2))


def to_nodes(stencil: AnyArray, dy: Array) -> Array:
    """The transpose of `at_points`: (n_c, 3, n_q, n_cells) to (n_en, 3, n_cells)."""
    n_q, n_c, n_en = stencil.shape
    flat = jnp.moveaxis(dy, 2, 0).reshape(n_q * n_c, -1)
    return (jnp.reshape(stencil, (n_q * n_c, n_en)).T @ flat).reshape(n_en, 3, -1)


def to_matrices(stencil: AnyArray, moduli: Array) -> Array:
    """Cell matrices from second derivatives at the points.

    moduli: d2/dy_ci dy_dj for the six PAIRS (i, j), (n_c, n_c, 6, n_q, n_cells)
    Returns K[a, i, b, j]: (n_en, n_en, 6, n_cells).
    """
    n_en = stencil.shape[2]
    products = jnp.einsum("qca,qdb->abqcd", stencil, stencil).reshape(n_en**2, -1)
    return (products @ jnp.moveaxis(moduli, 3, 0).reshape(products.shape[1], -1)).reshape(n_en, n_en, 6, -1)


def cell_derivatives(density: Density, stencil: AnyArray, x: Array) -> tuple[Array, Array, Array]:
    """Energy at the points (n_q, n_cells), cell vectors (n_en, 3, n_cells), cell matrices."""
    n_c = stencil.shape[1]
    y = at_points(stencil, x)
    of_components = lambda v: density(dict(zip(y, v, strict=True)))  # noqa: E731
    value, first, second = pointwise_derivatives(of_components, list(y.values()))
    moduli = second.reshape(n_c, 3, n_c, 3, *value.shape)
    six = jnp.stack([moduli[:, i, :, j] for i, j in PAIRS], axis=2)
    return value, to_nodes(stencil, first.reshape(n_c, 3, *value.shape)), to_matrices(stencil, six)


@record
class Topology:
    """Integers of the mesh and of the sparse pattern, passed to compiled functions as data."""

    cells: np.ndarray
    lumen_facets: np.ndarray
    outer_facets: np.ndarray
    slots: tuple[np.ndarray, ...]
    """where the matrix entries of each block of cells, of the lumen and of the outer facets go in
    the sparse values; the place behind the last one takes what belongs nowhere"""
    free: np.ndarray
    """degree of freedom 3 node + component of each unknown, (n_free,)"""
    layer_cells: tuple[tuple[int, int], ...] = static()
    """first and last-plus-one cell of each layer"""
    blocks: tuple[tuple[int, int, int], ...] = static()
    """layer, first and last-plus-one cell of each block"""
    n_nonzeros: int = static()


@dataclasses.dataclass(frozen=True)
class Pattern:
    """Upper triangle (with diagonal) of the symmetric tangent, by compressed rows."""

    indptr: np.ndarray
    indices: np.ndarray

    @property
    def n(self) -> int:
        return len(self.indptr) - 1


def supported(mesh: Mesh) -> np.ndarray:
    """True for degrees of freedom held by symmetry planes and the planar end, (n_nodes, 3)."""
    held = np.zeros((mesh.n_nodes, 3), dtype=bool)
    held[mesh.compression_plane, 0] = True
    held[mesh.fold_plane, 1] = True
    held[mesh.clamp_plane, 2] = True
    held[mesh.end_plane, 2] = True
    return held


POINTS_PER_BLOCK = 2400
"""quadrature points differentiated together: their intermediate arrays then fit a core's cache"""


def cut_into_blocks(
    layer_cells: tuple[tuple[int, int], ...], points_per_cell: int
) -> tuple[tuple[int, int, int], ...]:
    """Blocks (layer, first cell, last + 1) of one size, a common divisor of the layers' counts.

    One size means one compiled program; a block within a layer has one material.
    """
    common = math.gcd(*[last - first for first, last in layer_cells])
    wanted = max(POINTS_PER_BLOCK // points_per_cell, 1)
    size = max(d for d in range(1, min(wanted, common) + 1) if common % d == 0)
    return tuple(
        (layer, start, start + size)
        for layer, (first, last) in enumerate(layer_cells)
        for start in range(first, last, size)
    )


def build_topology(mesh: Mesh) -> tuple[Topology, Pattern]:
    """Number the unknowns and find the place of every cell-matrix entry in the sparse tangent."""
    free = np.flatnonzero(~supported(mesh).ravel())
    unknown = np.full(3 * mesh.n_nodes, -1)
    unknown[free] = np.arange(len(free))
    n = len(free)

    def keys(nodes: np.ndarray) -> np.ndarray:
        rows = unknown[3 * nodes[:, None, None, :] + PAIRS[:, 0][:, None]]
        columns = unknown[3 * nodes[None, :, None, :] + PAIRS[:, 1][:, None]]
        rows, columns = np.broadcast_arrays(rows, columns)
        key = np.minimum(rows, columns) * np.int64(n) + np.maximum(rows, columns)
        local = np.arange(len(nodes))
        mirror = (local[:, None] > local[None])[:, :, None] & (PAIRS[:, 0] == PAIRS[:, 1])
        key[(rows < 0) | (columns < 0) | mirror[..., None]] = -1
        return key.ravel()

    blocks = cut_into_blocks(mesh.layer_cells, len(mesh.element.quadrature()[1]))
    parts = [mesh.cells[:, first:last] for _, first, last in blocks] + [mesh.lumen_facets, mesh.outer_facets]
    entries = [keys(nodes) for nodes in parts]
    stacked = np.concatenate(entries)
    distinct, place = np.unique(stacked, return_inverse=True)
    skipped = int(distinct[0] == -1)
    n_nonzeros = len(distinct) - skipped
    slots = np.where(stacked < 0, n_nonzeros, place - skipped).astype(np.int32)
    ends = np.cumsum([part.size for part in entries[:-1]])
    rows, indices = np.divmod(distinct[skipped:], n)
    indptr = np.searchsorted(rows, np.arange(n + 1))
    topology = Topology(
        cells=mesh.cells.astype(np.int32),
        lumen_facets=mesh.lumen_facets.astype(np.int32),
        outer_facets=mesh.outer_facets.astype(np.int32),
        slots=tuple(np.split(slots, ends)),
        free=free.astype(np.int32),
        layer_cells=mesh.layer_cells,
        blocks=blocks,
        n_nonzeros=n_nonzeros,
    )
    return topology, Pattern(indptr.astype(np.int32), indices.astype(np.int32))


@record
class Body:
    """Everything the compiled functions need about one scene, besides state and loads."""

    topology: Topology
    stencils: Stencils
    geometry: Geometry
    parameters: Parameters


@record
class State:
    """A configuration: equilibrium or a trial."""

    x: Array
    """current position of the nodes, mm, (n_nodes, 3)"""
    p: Array
    """pressure modes of the cells, kPa, (n_m, n_cells)"""
    jaw_height: Array
    """height of the jaw's lowest point above the axis, mm"""


@record
class Linearisation:
    """Potential, forces and condensed tangent at a state."""

    energy: Array
    """potential with the pressures at their best, uJ"""
    residual: Array
    """d Pi/dx of the free degrees of freedom, pressures condensed, mN, (n_free,)"""
    imbalance: Array
    """norm of the free forces at the *stored* pressures, mN: what a trial state is judged by, because
    the condensed residual multiplies every change of volume that is of second order by the bulk modulus"""
    reactions: Array
    """norm of the forces on the supports, mN"""
    volume_error: Array
    """largest |mean J - 1 - p/bulk| of a cell"""
    values: Array
    """upper triangle of the condensed tangent, mN/mm, (n_nonzeros,)"""
    jaw_force: Array
    """-d Pi/d jaw_height of the modelled part (upward on the jaw is positive), mN"""
    jaw_coupling: Array
    """d2 Pi/dx d jaw_height, mN/mm, (n_free,)"""
    jaw_stiffness: Array
    """d2 Pi/d jaw_height**2, mN/mm"""
    J_min: Array
    J_max: Array


def _gather(x: Array, nodes: AnyArray) -> Array:
    """Positions of the cells' nodes, (n_en, 3, n_cells)."""
    return jnp.swapaxes(x[nodes], 1, 2)


def _scatter(nodes: AnyArray, values: Array, n_nodes: int) -> Array:
    """Sum of cell vectors (n_en, 3, n_cells) at the nodes, (n_nodes, 3)."""
    return jnp.zeros((n_nodes, 3)).at[nodes].add(jnp.swapaxes(values, 1, 2))


def _lumen(body: Body, pressure: Array | float) -> Density:
    n = round(body.stencils.lumen.shape[0] ** 0.5)
    weights = jnp.asarray(tensor_rule((n, n))[1])[:, None]
    return lambda y: -pressure * lumen_density(y, weights)


def _jaw(body: Body, jaw_height: Array) -> Density:
    par = body.parameters
    return lambda y: contact_density(y, jaw_height, par.jaw, par.contact, body.geometry.dA)


def _intima(body: Body, plane: Array | float = 0.0) -> Density:
    return lambda y: intima_density(y, plane, body.parameters.contact, body.geometry.dA_inner)


def _dilatation(stencils: Stencils, geometry: Geometry, dx_dxi: Tensor) -> Array:
    """int N_m (J - 1) dV of every cell, mm^3, (n_m, n_cells)."""
    density = dilatation_density(dx_dxi, geometry.to_local, geometry.dV)
    return jnp.einsum("mq,qc->mc", stencils.modes, density)


def _condensed_pressure(geometry: Geometry, dilatation: Array) -> Array:
    """The pressure in equilibrium with a dilatation: M^-1 int N_m (J - 1) dV, (n_m, n_cells)."""
    return jnp.einsum("mnc,nc->mc", geometry.pressure_stiffness, dilatation)


def potential(body: Body, x: Array, jaw_height: Array, pressure: Array) -> Array:
    """Pi with the pressures at their best, uJ: a function of positions and loads alone."""
    return artery_potential(body, x, pressure) + touch_potential(body, x, jaw_height)


def artery_potential(body: Body, x: Array, pressure: Array) -> Array:
    """The part of wall and blood, uJ."""
    return stored_energy(body, x) - pressure * lumen_volume(body, x)


def touch_potential(body: Body, x: Array, jaw_height: Array) -> Array:
    """The part of all contact, uJ."""
    return contact_potential(body, x, jaw_height) + intima_potential(body, x, 0.0)


def stored_energy(body: Body, x: Array) -> Array:
    """Strain energy of the wall of the modelled part, the pressures at their best, uJ."""
    dx_dxi = at_points(body.stencils.wall, _gather(x, body.topology.cells))
    geometry = body.geometry
    wall = total(
        _isochoric(
            {key: values[:, first:last] for key, values in dx_dxi.items()},
            geometry.to_local[..., first:last],
            geometry.dV[:, first:last],
            material,
        )
        for material, (first, last) in zip(body.parameters.materials, body.topology.layer_cells, strict=True)
    )
    return wall + _volumetric(body.stencils, geometry, dx_dxi)


def _isochoric(dx_dxi: Tensor, to_local: Array, dV: Array, material: Material) -> Array:
    return jnp.sum(wall_density(dx_dxi, to_local, dV, material, jnp.zeros(())))


def _volumetric(stencils: Stencils, geometry: Geometry, dx_dxi: Tensor) -> Array:
    dilatation = _dilatation(stencils, geometry, dx_dxi)
    return 0.5 * jnp.sum(dilatation * _condensed_pressure(geometry, dilatation))


def lumen_volume(body: Body, x: Array) -> Array:
    """Volume of the modelled part of the lumen, mm^3."""
    y = at_points(body.stencils.lumen, _gather(x, body.topology.lumen_facets))
    return jnp.sum(_lumen(body, -1.0)(y))


def contact_potential(body: Body, x: Array, jaw_height: Array) -> Array:
    """The contact energy of the outer wall of the modelled part, uJ."""
    y = at_points(body.stencils.contact, _gather(x, body.topology.outer_facets))
    return jnp.sum(_jaw(body, jaw_height)(y))


def intima_potential(body: Body, x: Array, plane: Array | float) -> Array:
    """The contact energy of the inner wall of the modelled part against the plane y = `plane`, uJ."""
    y = at_points(body.stencils.meeting, _gather(x, body.topology.lumen_facets))
    return jnp.sum(_intima(body, plane)(y))


@record
class Block:
    """Some cells of one layer, linearised."""

    energy: Array
    """wall energy with the pressures at their best, uJ"""
    force: Array
    """d Pi/dx of the cells' nodes at the stored pressures, mN, (n_en, 3, n_cells)"""
    missing_force: Array
    """what condensing the pressures adds to it, mN, (n_en, 3, n_cells)"""
    matrix: Array
    """condensed tangent, mN/mm, (n_en, n_en, 6, n_cells)"""
    volume_error: Array
    J_min: Array
    J_max: Array


@record
class Piece:
    """The cells of one block, cut out of body and state."""

    x: Array
    """current position of the nodes, mm, (n_en, 3, n_cells)"""
    p: Array
    """pressure modes, kPa, (n_m, n_cells)"""
    geometry: Geometry


@jax.jit
def cut(body: Body, state: State) -> list[Piece]:
    """Body and state cut into blocks.

    A program of its own: slices inside the program that differentiates would keep it from being vectorised.
    """
    return [piece(body, state, first, last) for _, first, last in body.topology.blocks]


def piece(body: Body, state: State, first: int, last: int) -> Piece:
    """The cells from `first` to before `last`."""
    none = jnp.zeros((0, body.geometry.dV.shape[-1]))
    g = replace(body.geometry, dA=none, dA_inner=none)
    return Piece(
        x=_gather(state.x, body.topology.cells[:, first:last]),
        p=state.p[:, first:last],
        geometry=jax.tree_util.tree_map(lambda a: a[..., first:last], g),
    )


def block_energy(piece: Piece, stencils: Stencils, material: Material) -> Array:
    """Strain energy of the cells of a block, the pressures at their best, uJ."""
    g = piece.geometry
    dx_dxi = at_points(stencils.wall, piece.x)
    return _isochoric(dx_dxi, g.to_local, g.dV, material) + _volumetric(stencils, g, dx_dxi)


@jax.jit
def linearise_block(piece: Piece, stencils: Stencils, material: Material) -> Block:
    """Energy, forces and condensed tangent of the cells of a block.

    The tangent uses the *stored* pressures in its geometric part and eliminates their increments
    cell by cell: K = K_xx(p) + G M^-1 G', residual = d Psi/dx + G M^-1 int N (J - 1). With p
    updated along the step (`advance`) this is Newton's method on (x, p).
    """
    x, p, g = piece.x, piece.p, piece.geometry
    at_point = jnp.einsum("mq,mc->qc", stencils.modes, p)
    density = partial(wall_density, to_local=g.to_local, dV=g.dV, material=material, p=at_point)
    energies, force, matrix = cell_derivatives(density, stencils.wall, x)

    # pressures: force of each mode, and what is missing to p = M^-1 int N (J - 1)
    dx_dxi = at_points(stencils.wall, x)
    dilatation = _dilatation(stencils, g, dx_dxi)
    missing = _condensed_pressure(g, dilatation) - p
    slope = stacked(jax.grad(lambda y: jnp.sum(dilatation_density(y, g.to_local, g.dV)))(dx_dxi))
    modes = [to_nodes(stencils.wall, slope * mode[:, None]) for mode in stencils.modes]
    stiff_modes = [
        total(g.pressure_stiffness[m, n] * mode for n, mode in enumerate(modes)) for m in range(len(modes))
    ]
    missing_force = total(mode * missing[m] for m, mode in enumerate(modes))
    matrix = matrix + total(
        jnp.stack([a[:, None, i] * b[None, :, j] for i, j in PAIRS], axis=2)
        for a, b in zip(modes, stiff_modes, strict=True)
    )
    # potential with p eliminated: replace int p (J - 1) by 1/2 D' M^-1 D
    volumetric = 0.5 * jnp.sum(dilatation * (missing + p)) - jnp.sum(p * dilatation)
    J = det(dx_dxi) * det(g.to_local)
    compliance = 1.0 / (g.pressure_stiffness[0, 0] * jnp.sum(g.dV, axis=0))
    return Block(
        energy=jnp.sum(energies) + volumetric,
        force=force,
        missing_force=missing_force,
        matrix=matrix,
        volume_error=jnp.max(jnp.abs(jnp.einsum("mq,mc->qc", stencils.modes, missing)) * compliance),
        J_min=jnp.min(J),
        J_max=jnp.max(J),
    )


@jax.jit
def artery_forces(body: Body, x: Array, pressure: Array) -> Array:
    """d Pi/dx of wall and blood without contact, mN, (n_nodes, 3): what `linearise` gives without the
    tangent, in one program that is cheap to differentiate."""
    forces: Array = jax.grad(artery_potential, argnums=1)(body, x, pressure)
    return forces


@jax.jit
def contact_forces(body: Body, x: Array, jaw_height: Array) -> tuple[Array, Array]:
    """d Pi/dx of all contact, mN, (n_nodes, 3), and d Pi/d jaw_height, mN."""
    slopes: tuple[Array, Array] = jax.grad(touch_potential, argnums=(1, 2))(body, x, jaw_height)
    return slopes


@jax.jit
def assemble(body: Body, state: State, pressure: Array, blocks: list[Block]) -> Linearisation:
    """Blood pressure, contact, and the blocks of the wall, summed into residual and tangent."""
    top, st = body.topology, body.stencils
    x, n_nodes = state.x, state.x.shape[0]
    lumen_e, lumen_f, lumen_k = cell_derivatives(
        _lumen(body, pressure), st.lumen, _gather(x, top.lumen_facets)
    )
    meet_e, meet_f, meet_k = cell_derivatives(_intima(body), st.meeting, _gather(x, top.lumen_facets))
    jaw_e, jaw_f, jaw_k = cell_derivatives(
        _jaw(body, state.jaw_height), st.contact, _gather(x, top.outer_facets)
    )
    # one scatter per block: XLA's is many times slower on a concatenation
    values = jnp.zeros(top.n_nonzeros + 1)
    for slots, matrix in zip(top.slots, [*[b.matrix for b in blocks], lumen_k + meet_k, jaw_k], strict=True):
        values = values.at[slots].add(matrix.ravel(), mode="promise_in_bounds")
    inner = _scatter(top.lumen_facets, lumen_f + meet_f, n_nodes)
    force = inner + _scatter(top.outer_facets, jaw_f, n_nodes)
    missing = jnp.zeros_like(force)
    for (_, first, last), block in zip(top.blocks, blocks, strict=True):
        force = force + _scatter(top.cells[:, first:last], block.force, n_nodes)
        missing = missing + _scatter(top.cells[:, first:last], block.missing_force, n_nodes)
    imbalance = jnp.linalg.norm(force.ravel()[top.free])
    force = (force + missing).ravel()

    slope_of_height = lambda d: jax.grad(contact_potential, argnums=(1, 2))(body, x, d)  # noqa: E731
    (_, along_height), (coupling, stiffness) = jax.jvp(
        slope_of_height, (state.jaw_height,), (jnp.ones_like(state.jaw_height),)
    )
    return Linearisation(
        energy=total(b.energy for b in blocks) + jnp.sum(lumen_e) + jnp.sum(meet_e) + jnp.sum(jaw_e),
        residual=force[top.free],
        imbalance=imbalance,
        reactions=jnp.linalg.norm(force.at[top.free].set(0.0)),
        volume_error=jnp.max(jnp.stack([b.volume_error for b in blocks])),
        values=values[:-1],
        jaw_force=-along_height,
        jaw_coupling=coupling.ravel()[top.free],
        jaw_stiffness=stiffness,
        J_min=jnp.min(jnp.stack([b.J_min for b in blocks])),
        J_max=jnp.max(jnp.stack([b.J_max for b in blocks])),
    )


def linearise(body: Body, state: State, pressure: Array | float) -> Linearisation:
    """Forces and condensed tangent at a state, block by block."""
    materials = [body.parameters.materials[layer] for layer, _, _ in body.topology.blocks]
    pieces = cut(body, state)
    blocks = [linearise_block(p, body.stencils, m) for p, m in zip(pieces, materials, strict=True)]
    return assemble(body, state, pressure, blocks)


@jax.jit
def advance(body: Body, state: State, dx: Array, d_height: Array, fraction: Array) -> State:
    """Go a fraction of the Newton step: free unknowns dx (n_free,), jaw, and condensed pressures."""
    step = jnp.zeros(state.x.size).at[body.topology.free].set(dx).reshape(state.x.shape)
    dilate = lambda x: _dilatation(  # noqa: E731
        body.stencils, body.geometry, at_points(body.stencils.wall, _gather(x, body.topology.cells))
    )
    dilatation, change = jax.jvp(dilate, (state.x,), (step,))
    dp = _condensed_pressure(body.geometry, dilatation + change) - state.p
    return State(
        x=state.x + fraction * step,
        p=state.p + fraction * dp,
        jaw_height=state.jaw_height + fraction * d_height,
    )


@jax.jit
def with_equilibrium_pressure(body: Body, x: Array, jaw_height: Array) -> State:
    """A state whose pressures fit its dilatation: p = M^-1 int N (J - 1) dV."""
    y = at_points(body.stencils.wall, _gather(x, body.topology.cells))
    p = _condensed_pressure(body.geometry, _dilatation(body.stencils, body.geometry, y))
    return State(x=x, p=p, jaw_height=jaw_height)


def gaps(body: Body, state: State) -> Array:
    """Gap at the contact points, mm, (n_cq, n_facets)."""
    y = at_points(body.stencils.contact, _gather(state.x, body.topology.outer_facets))
    return jaw_gap([y[0, i] for i in range(3)], state.jaw_height, body.parameters.jaw)
