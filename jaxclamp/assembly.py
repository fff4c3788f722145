"""From densities at points to residual and sparse tangent.

A density is a pointwise scalar of n_c vectors y_c = sum_a S[q, c, a] x_a (tangents, or a position).
Its first and second derivatives with respect to y come from autodiff; the stencil S is the same
for every cell, so that the contraction to cell vectors and matrices is one product with a
constant matrix. Cell matrices are kept as the six component pairs (xx, yy, zz, xy, xz, yz) over
all pairs of nodes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.elements import tensor_rule
from jaxclamp.energies import (
    Geometry,
    Parameters,
    Stencils,
    contact_density,
    dilatation_density,
    jaw_gap,
    lumen_density,
    material_groups,
    over_cells,
    wall_density,
)
from jaxclamp.meshes import Mesh
from jaxclamp.pytree import record, static
from jaxclamp.tensors import Tensor, det, pointwise_derivatives, total

PAIRS = np.array([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)])

AnyArray = Array | np.ndarray
Density = Callable[[Tensor], Array]


def at_points(stencil: AnyArray, x: Array) -> Array:
    """y_c = sum_a S[q, c, a] x_a at every point: (n_c, 3, n_q, n_cells).

    stencil: (n_q, n_c, n_en); x: positions of the cells' nodes, (n_en, 3, n_cells)
    """
    n_q, n_c, n_en = stencil.shape
    y = jnp.matmul(jnp.reshape(stencil, (n_q * n_c, n_en)), x.reshape(n_en, -1))
    return jnp.moveaxis(y.reshape(n_q, n_c, 3, -1), 0, 2)


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
    keys = [(c, i) for c in range(n_c) for i in range(3)]
    of_components = lambda v: density(dict(zip(keys, v, strict=True)))  # noqa: E731
    value, first, second = pointwise_derivatives(of_components, [y[key] for key in keys])
    moduli = second.reshape(n_c, 3, n_c, 3, *y.shape[2:])
    six = jnp.stack([moduli[:, i, :, j] for i, j in PAIRS], axis=2)
    return value, to_nodes(stencil, first.reshape(y.shape)), to_matrices(stencil, six)


@record
class Topology:
    """Integers of the mesh and of the sparse pattern, passed to compiled functions as data."""

    cells: np.ndarray
    lumen_facets: np.ndarray
    outer_facets: np.ndarray
    slots: tuple[np.ndarray, ...]
    """where each entry of the matrices of cells, lumen and outer facets goes in the sparse values;
    the place behind the last one takes what belongs nowhere"""
    free: np.ndarray
    """degree of freedom 3 node + component of each unknown, (n_free,)"""
    layer_cells: tuple[tuple[int, int], ...] = static()
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

    wall, lumen, outer = (keys(nodes) for nodes in (mesh.cells, mesh.lumen_facets, mesh.outer_facets))
    stacked = np.concatenate([wall, lumen, outer])
    distinct, place = np.unique(stacked, return_inverse=True)
    skipped = int(distinct[0] == -1)
    n_nonzeros = len(distinct) - skipped
    slots = np.where(stacked < 0, n_nonzeros, place - skipped).astype(np.int32)
    ends = np.cumsum([wall.size, lumen.size])
    rows, indices = np.divmod(distinct[skipped:], n)
    indptr = np.searchsorted(rows, np.arange(n + 1))
    topology = Topology(
        cells=mesh.cells.astype(np.int32),
        lumen_facets=mesh.lumen_facets.astype(np.int32),
        outer_facets=mesh.outer_facets.astype(np.int32),
        slots=tuple(np.split(slots, ends)),
        free=free.astype(np.int32),
        layer_cells=mesh.layer_cells,
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


def _wall_densities(body: Body, p: Array) -> list[tuple[int, int, Density]]:
    """Wall density of each run of layers with one law: (first cell, last + 1, density)."""
    g, materials = body.geometry, body.parameters.materials
    at_point = jnp.einsum("mq,mc->qc", body.stencils.modes, p)
    ranges = body.topology.layer_cells
    runs: list[tuple[int, int, Density]] = []
    for first, last in material_groups(materials):
        start, stop = ranges[first][0], ranges[last - 1][1]
        counts = tuple(b - a for a, b in ranges[first:last])
        density = partial(
            wall_density,
            to_local=g.to_local[..., start:stop],
            dV=g.dV[..., start:stop],
            material=over_cells(materials[first:last], counts),
            p=at_point[:, start:stop],
        )
        runs.append((start, stop, density))
    return runs


def _lumen(body: Body, pressure: Array) -> Density:
    n = round(body.stencils.lumen.shape[0] ** 0.5)
    weights = jnp.asarray(tensor_rule((n, n))[1])[:, None]
    return lambda y: -pressure * lumen_density(y, weights)


def _jaw(body: Body, jaw_height: Array) -> Density:
    par = body.parameters
    return lambda y: contact_density(y, jaw_height, par.jaw, par.contact, body.geometry.dA)


def _dilatation(body: Body, dx_dxi: Array) -> Array:
    """int N_m (J - 1) dV of every cell, mm^3, (n_m, n_cells)."""
    density = dilatation_density(dx_dxi, body.geometry.to_local, body.geometry.dV)
    return jnp.einsum("mq,qc->mc", body.stencils.modes, density)


def _condensed_pressure(body: Body, dilatation: Array) -> Array:
    """The pressure in equilibrium with a dilatation: M^-1 int N_m (J - 1) dV, (n_m, n_cells)."""
    return jnp.einsum("mnc,nc->mc", body.geometry.pressure_stiffness, dilatation)


def potential(body: Body, x: Array, jaw_height: Array, pressure: Array) -> Array:
    """Pi with the pressures at their best, uJ: a function of positions and loads alone."""
    x_cells = _gather(x, body.topology.cells)
    dx_dxi = at_points(body.stencils.wall, x_cells)
    dilatation = _dilatation(body, dx_dxi)
    volumetric = 0.5 * jnp.sum(dilatation * _condensed_pressure(body, dilatation))
    zero = jnp.zeros_like(dilatation)
    wall = total(
        jnp.sum(density(dx_dxi[..., start:stop])) for start, stop, density in _wall_densities(body, zero)
    )
    lumen = jnp.sum(
        _lumen(body, pressure)(at_points(body.stencils.lumen, _gather(x, body.topology.lumen_facets)))
    )
    return wall + volumetric + lumen + contact_potential(body, x, jaw_height)


def contact_potential(body: Body, x: Array, jaw_height: Array) -> Array:
    """The contact energy of the modelled part, uJ."""
    y = at_points(body.stencils.contact, _gather(x, body.topology.outer_facets))
    return jnp.sum(_jaw(body, jaw_height)(y))


@jax.jit
def linearise(body: Body, state: State, pressure: Array) -> Linearisation:
    """Forces and condensed tangent at a state.

    The tangent uses the *stored* pressures in its geometric part and eliminates their increments
    cell by cell: K = K_xx(p) + G M^-1 G', residual = d Psi/dx + G M^-1 int N (J - 1). With p
    updated along the step (`advance`) this is Newton's method on (x, p).
    """
    top, st, g = body.topology, body.stencils, body.geometry
    x, n_nodes = state.x, state.x.shape[0]
    x_cells = _gather(x, top.cells)
    dx_dxi = at_points(st.wall, x_cells)

    energies, forces, matrices = [], [], []
    for start, stop, density in _wall_densities(body, state.p):
        e, f, k = cell_derivatives(density, st.wall, x_cells[..., start:stop])
        energies.append(jnp.sum(e))
        forces.append(f)
        matrices.append(k)
    wall_force, wall_matrix = jnp.concatenate(forces, axis=-1), jnp.concatenate(matrices, axis=-1)

    # pressures: force of each mode, and what is missing to p = M^-1 int N (J - 1)
    dilatation = _dilatation(body, dx_dxi)
    missing = _condensed_pressure(body, dilatation) - state.p
    slope = jax.grad(lambda y: jnp.sum(dilatation_density(y, g.to_local, g.dV)))(dx_dxi)
    modes = [to_nodes(st.wall, slope * mode[:, None]) for mode in st.modes]
    stiff_modes = [
        total([g.pressure_stiffness[m, n] * mode for n, mode in enumerate(modes)]) for m in range(len(modes))
    ]
    wall_force = wall_force + total([mode * missing[m] for m, mode in enumerate(modes)])
    wall_matrix = wall_matrix + total(
        jnp.stack([a[:, None, i] * b[None, :, j] for i, j in PAIRS], axis=2)
        for a, b in zip(modes, stiff_modes, strict=True)
    )
    # potential with p eliminated: replace int p (J - 1) by 1/2 D' M^-1 D
    volumetric = 0.5 * jnp.sum(dilatation * (missing + state.p)) - jnp.sum(state.p * dilatation)

    lumen_e, lumen_f, lumen_k = cell_derivatives(
        _lumen(body, pressure), st.lumen, _gather(x, top.lumen_facets)
    )
    jaw_e, jaw_f, jaw_k = cell_derivatives(
        _jaw(body, state.jaw_height), st.contact, _gather(x, top.outer_facets)
    )
    values = jnp.zeros(top.n_nonzeros + 1)
    for slots, matrix in zip(top.slots, (wall_matrix, lumen_k, jaw_k), strict=True):
        values = values.at[slots].add(matrix.ravel(), mode="promise_in_bounds")
    force = (
        _scatter(top.cells, wall_force, n_nodes)
        + _scatter(top.lumen_facets, lumen_f, n_nodes)
        + _scatter(top.outer_facets, jaw_f, n_nodes)
    ).ravel()

    slope_of_height = lambda d: jax.grad(contact_potential, argnums=(1, 2))(body, x, d)  # noqa: E731
    (_, along_height), (coupling, stiffness) = jax.jvp(
        slope_of_height, (state.jaw_height,), (jnp.ones_like(state.jaw_height),)
    )
    J = det(dx_dxi) * det(g.to_local)
    return Linearisation(
        energy=total(energies) + volumetric + jnp.sum(lumen_e) + jnp.sum(jaw_e),
        residual=force[top.free],
        reactions=jnp.linalg.norm(force.at[top.free].set(0.0)),
        volume_error=jnp.max(jnp.abs(jnp.einsum("mq,mc->qc", st.modes, missing)) * _compliance(body)),
        values=values[:-1],
        jaw_force=-along_height,
        jaw_coupling=coupling.ravel()[top.free],
        jaw_stiffness=stiffness,
        J_min=jnp.min(J),
        J_max=jnp.max(J),
    )


def _compliance(body: Body) -> Array:
    """1/bulk of every cell, (n_cells,)."""
    volume = jnp.sum(body.geometry.dV, axis=0)
    return 1.0 / (body.geometry.pressure_stiffness[0, 0] * volume)


@jax.jit
def advance(body: Body, state: State, dx: Array, d_height: Array, fraction: Array) -> State:
    """Go a fraction of the Newton step: free unknowns dx (n_free,), jaw, and condensed pressures."""
    step = jnp.zeros(state.x.size).at[body.topology.free].set(dx).reshape(state.x.shape)
    dilate = lambda x: _dilatation(  # noqa: E731
        body, at_points(body.stencils.wall, _gather(x, body.topology.cells))
    )
    dilatation, change = jax.jvp(dilate, (state.x,), (step,))
    dp = _condensed_pressure(body, dilatation + change) - state.p
    return State(
        x=state.x + fraction * step,
        p=state.p + fraction * dp,
        jaw_height=state.jaw_height + fraction * d_height,
    )


@jax.jit
def with_equilibrium_pressure(body: Body, x: Array, jaw_height: Array) -> State:
    """A state whose pressures fit its dilatation: p = M^-1 int N (J - 1) dV."""
    y = at_points(body.stencils.wall, _gather(x, body.topology.cells))
    return State(x=x, p=_condensed_pressure(body, _dilatation(body, y)), jaw_height=jaw_height)


def gaps(body: Body, state: State) -> Array:
    """Gap at the contact points, mm, (n_cq, n_facets)."""
    y = at_points(body.stencils.contact, _gather(state.x, body.topology.outer_facets))
    return jaw_gap(y[0], state.jaw_height, body.parameters.jaw)
