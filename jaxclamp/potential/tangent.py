"""From densities at points to residual and sparse tangent.

A density is a pointwise scalar of n_c vectors y_c = sum_a S[q, c, a] x_a (tangents, or a position) and,
where rigid things move, of the rigid coordinates. Its first and second derivatives with respect to both
come from autodiff; the stencil S is the same for every cell, so that the contraction to cell vectors and
matrices is one product with a constant matrix. Cell matrices are kept as the six component pairs (xx, yy,
zz, xy, xz, yz) over all pairs of nodes. One program serves every piece of one kind and size.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxclamp.core.records import record, static
from jaxclamp.core.tensors import Tensor, det, pointwise_derivatives, stacked, total
from jaxclamp.fem.pattern import PAIRS, Layout
from jaxclamp.potential.densities import RIGID, Density, Solid, dilatation, mixed_energy
from jaxclamp.potential.energy import (
    AnyArray,
    State,
    at_points,
    cell_pressures,
    condensed_pressures,
    dilatations,
    gather,
    group_points,
)
from jaxclamp.potential.terms import Group, Potential


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


@record
class Pressures:
    """The pressures of some cells, and what they belong to."""

    p: Array
    """(n_m, n_cells)"""
    modes: Array
    """(n_m, n_q)"""
    stiffness: Array
    """M^-1, (n_m, n_m, n_cells)"""


@record
class Piece:
    """The cells of one block of a group, cut out of potential and state; it knows no names."""

    stencil: Array
    """(n_q, n_c, n_en)"""
    x: Array
    """current position of the nodes, mm, (n_en, 3, n_cells)"""
    q: Array
    """rigid coordinates, mm, (n_q,)"""
    densities: tuple[Density, ...] = static()
    """of the terms"""
    heres: tuple[Any, ...]
    """what each knows of the points"""
    moved: bool = static()
    """a density depends on q"""
    pressures: Pressures | None
    """None where cells need not keep their volume"""


@record
class Linearised:
    """A piece, linearised. What it does not have is None."""

    energy: Array
    """with the pressures at their best, uJ"""
    force: Array
    """d Pi/dx of the cells' nodes at the stored pressures, mN, (n_en, 3, n_cells)"""
    matrix: Array
    """condensed tangent, mN/mm, (n_en, n_en, 6, n_cells)"""
    missing_force: Array | None = None
    """what condensing the pressures adds to the force, mN, (n_en, 3, n_cells)"""
    volume_error: Array | None = None
    """largest |mean J - 1 - p / bulk| of a cell"""
    J_range: Array | None = None
    """smallest and largest volume ratio, (2,)"""
    rigid_slope: Array | None = None
    """d Pi/dq, mN, (n_q,)"""
    coupling: Array | None = None
    """d2 Pi/dx dq, mN/mm, (n_q, n_en, 3, n_cells)"""
    rigid_stiffness: Array | None = None
    """d2 Pi/dq2, mN/mm, (n_q, n_q)"""


@record
class Linearisation:
    """Potential, forces and condensed tangent at a state."""

    energy: Array
    """potential with the pressures at their best, uJ"""
    residual: Array
    """d Pi/dx of the free degrees of freedom, pressures condensed, mN, (n_free,)"""
    imbalance: Array
    """norm of the free forces at the *stored* pressures, mN: what a trial state is judged by, because
    a step changes the stored pressures to first order only"""
    reactions: Array
    """norm of the forces on the supports, mN"""
    volume_error: Array
    """largest |mean J - 1 - p / bulk| of a cell"""
    values: Array
    """condensed tangent in the order of the pattern, mN/mm, (n_nonzeros,)"""
    rigid_force: Array
    """-d Pi/dq: force on the modelled part of the jaws, mN, (n_q,)"""
    coupling: Array
    """d2 Pi/dx dq on the free degrees of freedom, mN/mm, (n_free, n_q)"""
    rigid_stiffness: Array
    """d2 Pi/dq2, mN/mm, (n_q, n_q)"""
    J_min: Array
    """smallest volume ratio at a point"""
    J_max: Array
    """largest volume ratio at a point"""

    @property
    def jaw_force(self) -> Array:
        """Force on the modelled part of the jaws, mN."""
        return self.rigid_force[0]


# --- pieces -----------------------------------------------------------------------------------------


@jax.jit
def cut(group: Group, state: State) -> list[Piece]:
    """A group at a state cut into its blocks.

    A program of its own: slices inside the program that differentiates would keep it from being vectorised.
    """
    return [piece(group, state, *block) for block in group.blocks]


def piece(group: Group, state: State, first: int, last: int) -> Piece:
    """The cells of a group from `first` to before `last`."""
    whole = (first, last) == (0, group.nodes.shape[1])
    cells = lambda a: a if whole or jnp.ndim(a) < 2 else a[..., first:last]  # noqa: E731
    part = lambda tree: jax.tree_util.tree_map(cells, tree)  # noqa: E731
    pressures = None
    if group.volume is not None:
        assert group.modes is not None
        start = group.volume.cells[0]
        pressures = Pressures(
            p=state.p[:, start + first : start + last],
            modes=group.modes,
            stiffness=part(group.volume.stiffness),
        )
    return Piece(
        stencil=group.stencil,
        x=gather(state.x, group.nodes[:, first:last]),
        q=state.q,
        densities=tuple(term.density for term in group.terms),
        heres=tuple(part(term.here) for term in group.terms),
        moved=group.moved,
        pressures=pressures,
    )


def piece_energy(piece: Piece, x: Array, heres: tuple[Any, ...], stiffness: Array) -> Array:
    """Energy of a piece of the wall, the pressures at their best, uJ, with other positions and data."""
    assert piece.pressures is not None
    y, solid = at_points(piece.stencil, x), heres[0]
    D = dilatations(piece.pressures.modes, solid, y)
    points = total(
        jnp.sum(density(y, piece.q, here)) for density, here in zip(piece.densities, heres, strict=True)
    )
    return points + 0.5 * jnp.sum(D * condensed_pressures(stiffness, D))


@jax.jit
def linearise_piece(piece: Piece) -> Linearised:
    """Energy, forces and condensed tangent of the cells of a piece.

    Where cells keep their volume, the tangent uses the *stored* pressures in its geometric part and
    eliminates their increments cell by cell: K = K_xx(p) + G M^-1 G', residual = d Psi/dx +
    G M^-1 int N (J - 1). With p updated along the step (`advance`) this is Newton's method on (x, p).
    """
    y = at_points(piece.stencil, piece.x)
    names, shape, n_c = list(y), y[0, 0].shape, piece.stencil.shape[1]
    moving = [jnp.broadcast_to(q, shape) for q in piece.q] if piece.moved else []

    def density(v: list[Array]) -> Array:
        at, q = dict(zip(names, v[: len(names)], strict=True)), v[len(names) :] or piece.q
        known = list(zip(piece.densities, piece.heres, strict=True))
        terms = []
        if piece.pressures is not None:  # the solid comes first, and its pressures with it
            terms.append(mixed_energy(at, _interpolated(piece.pressures), known.pop(0)[1]))
        terms += [one(at, q, here) for one, here in known]
        return total(terms)

    value, first, second = pointwise_derivatives(density, [*y.values(), *moving])
    n_y = len(names)
    moduli = second[:n_y, :n_y].reshape(n_c, 3, n_c, 3, *shape)
    six = jnp.stack([moduli[:, i, :, j] for i, j in PAIRS], axis=2)
    found: dict[str, Any] = {
        "energy": jnp.sum(value),
        "force": to_nodes(piece.stencil, first[:n_y].reshape(n_c, 3, *shape)),
        "matrix": to_matrices(piece.stencil, six),
    }
    if piece.moved:
        mixed = second[n_y:, :n_y].reshape(len(moving), n_c, 3, *shape)
        found["rigid_slope"] = jnp.sum(first[n_y:], axis=(1, 2))
        found["coupling"] = jnp.stack([to_nodes(piece.stencil, part) for part in mixed])
        found["rigid_stiffness"] = jnp.sum(second[n_y:, n_y:], axis=(2, 3))
    if piece.pressures is not None:
        found |= _condensed(piece.pressures, piece.heres[0], piece.stencil, y, found)
    return Linearised(**found)


def _interpolated(pressures: Pressures) -> Array:
    """Pressure at the points, (n_q, n_cells)."""
    return jnp.einsum("mq,mc->qc", pressures.modes, pressures.p)


def _condensed(
    pressures: Pressures, solid: Solid, stencil: Array, y: Tensor, found: dict[str, Any]
) -> dict[str, Any]:
    """What eliminating the pressures of the cells changes and adds."""
    p, modes, stiffness = pressures.p, pressures.modes, pressures.stiffness
    D = dilatations(modes, solid, y)
    missing = condensed_pressures(stiffness, D) - p  # to p = M^-1 int N (J - 1)
    slope = stacked(jax.grad(lambda v: jnp.sum(dilatation(v, solid)))(y))
    by_mode = [to_nodes(stencil, slope * mode[:, None]) for mode in modes]
    stiff = [total(stiffness[m, n] * mode for n, mode in enumerate(by_mode)) for m in range(len(by_mode))]
    added = total(
        jnp.stack([a[:, None, i] * b[None, :, j] for i, j in PAIRS], axis=2)
        for a, b in zip(by_mode, stiff, strict=True)
    )
    J = det(y) * det(solid.to_local)
    compliance = 1.0 / (stiffness[0, 0] * jnp.sum(solid.dV, axis=0))
    return {
        # potential with p eliminated: replace int p (J - 1) by 1/2 D' M^-1 D
        "energy": found["energy"] + 0.5 * jnp.sum(D * (missing + p)) - jnp.sum(p * D),
        "matrix": found["matrix"] + added,
        "missing_force": total(mode * missing[m] for m, mode in enumerate(by_mode)),
        "volume_error": jnp.max(jnp.abs(jnp.einsum("mq,mc->qc", modes, missing)) * compliance),
        "J_range": jnp.stack([jnp.min(J), jnp.max(J)]),
    }


# --- the whole --------------------------------------------------------------------------------------


def linearise(potential: Potential, state: State) -> Linearisation:
    """Forces and condensed tangent at a state, piece by piece."""
    pieces = [[linearise_piece(one) for one in cut(group, state)] for group in potential.groups]
    return assemble(potential, pieces)


@jax.jit
def assemble(potential: Potential, pieces: list[list[Linearised]]) -> Linearisation:
    """Pieces summed into residual and tangent."""
    layout = potential.layout
    # one scatter per block: XLA's is many times slower on a concatenation
    values = jnp.zeros(layout.n_nonzeros + 1)
    force = jnp.zeros((layout.n_nodes, 3))
    missing = jnp.zeros_like(force)
    for group, blocks in zip(potential.groups, pieces, strict=True):
        for (first, last), slots, block in zip(group.blocks, group.slots, blocks, strict=True):
            nodes = group.nodes[:, first:last]
            values = values.at[slots].add(block.matrix.ravel(), mode="promise_in_bounds")
            force = _added(force, nodes, block.force)
            if block.missing_force is not None:
                missing = _added(missing, nodes, block.missing_force)
    imbalance = jnp.linalg.norm(force.ravel()[layout.free])
    force = (force + missing).ravel()
    slope, coupling, stiffness = _rigid(potential, pieces)
    every = [block for blocks in pieces for block in blocks]
    J = jnp.stack([block.J_range for block in every if block.J_range is not None])
    errors = [block.volume_error for block in every if block.volume_error is not None]
    return Linearisation(
        energy=total(block.energy for block in every),
        residual=force[layout.free],
        imbalance=imbalance,
        reactions=jnp.linalg.norm(force.at[layout.free].set(0.0)),
        volume_error=jnp.max(jnp.stack(errors)),
        values=values[:-1],
        rigid_force=-slope,
        coupling=coupling,
        rigid_stiffness=stiffness,
        J_min=jnp.min(J),
        J_max=jnp.max(J),
    )


def _added(field: Array, nodes: AnyArray, cells: Array) -> Array:
    """A field (n_nodes, 3) with what cells have at their nodes (n_en, 3, n_cells) added."""
    return field.at[nodes].add(jnp.swapaxes(cells, 1, 2))


def _rigid(potential: Potential, pieces: list[list[Linearised]]) -> tuple[Array, Array, Array]:
    """Derivatives of Pi by q: slope (n_q,), coupling with the unknowns (n_free, n_q), stiffness."""
    layout, n_q = potential.layout, len(RIGID)
    slope, stiffness = jnp.zeros(n_q), jnp.zeros((n_q, n_q))
    mixed = [jnp.zeros((layout.n_nodes, 3)) for _ in range(n_q)]
    for group, blocks in zip(potential.groups, pieces, strict=True):
        for (first, last), block in zip(group.blocks, blocks, strict=True):
            if block.coupling is None:
                continue
            assert block.rigid_slope is not None
            assert block.rigid_stiffness is not None
            slope, stiffness = slope + block.rigid_slope, stiffness + block.rigid_stiffness
            nodes = group.nodes[:, first:last]
            mixed = [_added(field, nodes, part) for field, part in zip(mixed, block.coupling, strict=True)]
    return slope, jnp.stack([field.ravel()[layout.free] for field in mixed], axis=1), stiffness


def on_nodes(layout: Layout, v: Array) -> Array:
    """Unknowns (n_free,) as a field (n_nodes, 3), zero where nodes are held."""
    return jnp.zeros(3 * layout.n_nodes).at[layout.free].set(v).reshape(layout.n_nodes, 3)


@jax.jit
def advance(potential: Potential, state: State, dx: Array, dq: Array, fraction: Array) -> State:
    """Go a fraction of the Newton step: free unknowns dx (n_free,), dq (n_q,), and condensed pressures."""
    step = on_nodes(potential.layout, dx)

    def condensed(group: Group) -> Array:
        assert group.volume is not None
        modes, solid = group.modes, group.solid
        assert modes is not None
        D = lambda x: dilatations(modes, solid, group_points(group, x))  # noqa: E731
        now, change = jax.jvp(D, (state.x,), (step,))
        return condensed_pressures(group.volume.stiffness, now + change)

    dp = cell_pressures(potential, condensed) - state.p
    return State(x=state.x + fraction * step, p=state.p + fraction * dp, q=state.q + fraction * dq)
