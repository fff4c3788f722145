"""From densities at points to residual and sparse tangent.

A density is a pointwise scalar of n_c vectors y_c = sum_a S[q, c, a] x_a (tangents, or a position) and,
where rigid things move, of the rigid coordinates. Its first and second derivatives with respect to both
come from autodiff; the stencil S is the same for every cell, so that the contraction to cell vectors and
matrices is one product with a constant matrix. Cell matrices are kept as the six component pairs (xx, yy,
zz, xy, xz, yz) over all pairs of nodes. One program serves every piece of one kind and size.
"""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.records import record, static
from jaxclamp.core.tensors import Tensor, components, det, pointwise_derivatives, stacked, total
from jaxclamp.fem.pattern import PAIRS, Layout, Pattern
from jaxclamp.potential.densities import Density, Solid, dilatation
from jaxclamp.potential.energy import (
    AnyArray,
    State,
    at_points,
    cell_pressures,
    condensed_pressures,
    dilatations,
    gather,
    group_points,
    stacked_at_points,
)
from jaxclamp.potential.terms import Group, Potential
from jaxclamp.potential.wall import by_pairs, wall_derivatives, wall_energy

Tree = TypeVar("Tree")


def to_nodes(stencil: AnyArray, dy: Array) -> Array:
    """The transpose of `at_points`: (n_c, 3, n_q, n_cells) to (n_en, 3, n_cells)."""
    n_q, n_c, n_en = stencil.shape
    flat = jnp.moveaxis(dy, 2, 0).reshape(n_q * n_c, -1)
    return (jnp.reshape(stencil, (n_q * n_c, n_en)).T @ flat).reshape(n_en, 3, -1)


def to_matrices(stencil: AnyArray, moduli: Array) -> Array:
    """Cell matrices from second derivatives at the points.

    moduli: d2/dy_ci dy_dj for the six PAIRS (i, j), (n_c, n_c, n_q, 6, n_cells)
    Returns K[a, i, b, j]: (n_en, n_en, 6, n_cells).
    """
    n_en = stencil.shape[2]
    products = jnp.einsum("qca,qdb->abcdq", stencil, stencil).reshape(n_en**2, -1)
    return (products @ moduli.reshape(products.shape[1], -1)).reshape(n_en, n_en, 6, -1)


@record
class Pressures:
    """The pressures of some cells, and what they belong to."""

    p: Array
    """(n_m, n_cells)"""
    modes: AnyArray
    """(n_m, n_q)"""
    stiffness: Array
    """M^-1, (n_m, n_m, n_cells)"""


@record
class Piece:
    """Cells of one group, cut out of potential and state; it knows no names."""

    stencil: AnyArray
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
    """A piece, linearised, cell by cell. What it does not have is None."""

    energy: Array
    """with the pressures at their best, uJ, (n_cells,)"""
    force: Array
    """d Pi/dx of the cells' nodes at the stored pressures, mN, (n_en, 3, n_cells)"""
    matrix: Array | None
    """condensed tangent, mN/mm, (n_en, n_en, 6, n_cells)"""
    missing_force: Array | None = None
    """what condensing the pressures adds to the force, mN, (n_en, 3, n_cells)"""
    volume_error: Array | None = None
    """|mean J - 1 - p / bulk|, (n_cells,)"""
    J_range: Array | None = None
    """smallest and largest volume ratio, (2, n_cells)"""
    rigid_slope: Array | None = None
    """d Pi/dq, mN, (n_q, n_cells)"""
    coupling: Array | None = None
    """d2 Pi/dx dq, mN/mm, (n_q, n_en, 3, n_cells)"""
    rigid_stiffness: Array | None = None
    """d2 Pi/dq2, mN/mm, (n_q, n_q, n_cells)"""


@dataclasses.dataclass(frozen=True)
class Linearisation:
    """Potential, forces and condensed tangent at a state, on the host."""

    energy: float
    """potential with the pressures at their best, uJ"""
    wall_energy: float
    """of the wall alone, uJ"""
    wall_force: np.ndarray
    """its derivative by the nodes, mN, (n_nodes, 3)"""
    residual: np.ndarray
    """d Pi/dx of the free degrees of freedom, pressures condensed, mN, (n_free,)"""
    missing: np.ndarray
    """part of it that comes with condensing: forces of the pressures that the volumes ask for beyond the
    *stored* ones, mN, (n_free,)"""
    reactions: float
    """norm of the forces on the supports, mN"""
    volume_error: float
    """largest |mean J - 1 - p / bulk| of a cell"""
    values: np.ndarray
    """condensed tangent in the order of the pattern, mN/mm, (n_nonzeros,)"""
    rigid_force: np.ndarray
    """-d Pi/dq: force on the modelled part of the jaws, mN, (n_q,)"""
    coupling: np.ndarray
    """d2 Pi/dx dq on the free degrees of freedom, mN/mm, (n_free, n_q)"""
    rigid_stiffness: np.ndarray
    """d2 Pi/dq2, mN/mm, (n_q, n_q)"""
    J_min: float
    """smallest volume ratio at a point"""
    J_max: float
    """largest volume ratio at a point"""

    @property
    def imbalance(self) -> float:
        """Norm of the free forces at the *stored* pressures, mN.

        What a trial state is judged by, because a step changes the stored pressures to first order only.
        """
        with np.errstate(over="ignore", invalid="ignore"):  # a trial state may be absurd
            return float(np.linalg.norm(self.residual - self.missing))

    @property
    def jaw_force(self) -> float:
        """Force on the modelled part of the jaws, mN."""
        return float(self.rigid_force[0])


# --- pieces -----------------------------------------------------------------------------------------


def whole(group: Group, state: State) -> Piece:
    """All cells of a group at a state."""
    pressures = None
    if group.volume is not None:
        assert group.modes is not None
        p = state.p[:, slice(*group.volume.cells)]
        pressures = Pressures(p=p, modes=group.modes, stiffness=group.volume.stiffness)
    return Piece(
        stencil=group.stencil,
        x=gather(state.x, group.nodes),
        q=state.q,
        densities=tuple(term.density for term in group.terms),
        heres=tuple(term.here for term in group.terms),
        moved=group.moved,
        pressures=pressures,
    )


def cut(group: Group, state: State) -> list[Piece]:
    """A group at a state cut into its blocks, all of one size, on the host.

    The last one is filled up with its last cell, again and again: see `joined`. Slices inside the program
    that differentiates would keep it from being vectorised.
    """
    group, state = jax.tree_util.tree_map(np.asarray, (group, state))
    cells, n = whole(group, state), group.nodes.shape[1]
    if n == group.size:
        return [cells]

    def block(first: int) -> Piece:
        missing = max(first + group.size - n, 0)

        def of(a: Any) -> Any:
            found = a[..., first : first + group.size]
            return np.concatenate([found, *[found[..., -1:]] * missing], axis=-1) if missing else found

        heres = jax.tree_util.tree_map(lambda a: of(a) if is_of_cells(a, n) else a, cells.heres)
        pressures = cells.pressures
        if pressures is not None:
            pressures = dataclasses.replace(pressures, p=of(pressures.p), stiffness=of(pressures.stiffness))
        return dataclasses.replace(cells, x=of(cells.x), heres=heres, pressures=pressures)

    return [block(first) for first in range(0, n, group.size)]


def is_of_cells(known: Any, n: int) -> bool:
    """True for what each of n cells has for itself, last axis; the rest they share."""
    return np.ndim(known) > 1 and np.shape(known)[-1] == n


def joined(group: Group, blocks: list[Tree]) -> Tree:
    """What blocks of a group have found, cells last, as that of the group, on the host."""
    n = group.nodes.shape[1]
    return jax.tree_util.tree_map(lambda *parts: np.concatenate(parts, axis=-1)[..., :n], *blocks)


def piece_energy(piece: Piece, x: Array, heres: tuple[Any, ...], stiffness: Array) -> Array:
    """Energy of a piece of the wall, the pressures at their best, uJ, with other positions and data."""
    assert piece.pressures is not None
    Y, (solid, *others) = stacked_at_points(piece.stencil, x), heres
    shape, dilated = wall_energy(Y, solid)
    D = jnp.einsum("mq,qc->mc", piece.pressures.modes, dilated)
    further = zip(piece.densities[1:], others, strict=True)
    points = [shape, *(density(components(Y), piece.q, here) for density, here in further)]
    return total(map(jnp.sum, points)) + 0.5 * jnp.sum(D * condensed_pressures(stiffness, D))


@jax.jit
def linearise_piece(piece: Piece) -> Linearised:
    """Energy, forces and condensed tangent of the cells of a piece.

    Where cells keep their volume, the tangent uses the *stored* pressures in its geometric part and
    eliminates their increments cell by cell: K = K_xx(p) + G M^-1 G', residual = d Psi/dx +
    G M^-1 int N (J - 1). With p updated along the step (`advance`) this is Newton's method on (x, p).
    """
    y = at_points(piece.stencil, piece.x)
    names, shape, n_c = list(y), y[0, 0].shape, piece.stencil.shape[1]
    n_y, known = len(names), list(zip(piece.densities, piece.heres, strict=True))
    moving = [jnp.broadcast_to(q, shape) for q in piece.q] if piece.moved else []
    parts = []
    if piece.pressures is not None:  # the solid comes first, and its pressures with it
        parts.append(wall_derivatives(y, _interpolated(piece.pressures), known.pop(0)[1]))

    def density(v: list[Array]) -> Array:
        at, q = dict(zip(names, v[:n_y], strict=True)), v[n_y:] or piece.q
        return total(one(at, q, here) for one, here in known)

    if known:
        value, slope, second = pointwise_derivatives(density, [*y.values(), *moving])
        square = by_pairs(second[:n_y, :n_y].reshape(n_c, 3, n_c, 3, *shape))
        parts.append((value, slope[:n_y].reshape(n_c, 3, *shape), square))
    values, first, moduli = (total(each) for each in zip(*parts, strict=True))
    found: dict[str, Any] = {
        "energy": jnp.sum(values, axis=0),
        "force": to_nodes(piece.stencil, first),
        "matrix": to_matrices(piece.stencil, moduli),
    }
    if piece.moved:
        mixed = second[n_y:, :n_y].reshape(len(moving), n_c, 3, *shape)
        found["rigid_slope"] = jnp.sum(slope[n_y:], axis=1)
        found["coupling"] = jnp.stack([to_nodes(piece.stencil, part) for part in mixed])
        found["rigid_stiffness"] = jnp.sum(second[n_y:, n_y:], axis=2)
    if piece.pressures is not None:
        found |= _condensed(piece.pressures, piece.heres[0], piece.stencil, y, found)
    return Linearised(**found)


def _interpolated(pressures: Pressures) -> Array:
    """Pressure at the points, (n_q, n_cells)."""
    return jnp.einsum("mq,mc->qc", pressures.modes, pressures.p)


def _condensed(
    pressures: Pressures, solid: Solid, stencil: AnyArray, y: Tensor, found: dict[str, Any]
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
        "energy": found["energy"] + jnp.sum(D * (0.5 * (missing + p) - p), axis=0),
        "matrix": found["matrix"] + added,
        "missing_force": total(mode * missing[m] for m, mode in enumerate(by_mode)),
        "volume_error": jnp.max(jnp.abs(jnp.einsum("mq,mc->qc", modes, missing)), axis=0) * compliance,
        "J_range": jnp.stack([jnp.min(J, axis=0), jnp.max(J, axis=0)]),
    }


# --- the whole --------------------------------------------------------------------------------------


def linearise(potential: Potential, state: State, pattern: Pattern) -> Linearisation:
    """Forces and condensed tangent at a state, piece by piece."""
    pieces = [[linearise_piece(one) for one in cut(group, state)] for group in potential.groups]
    with np.errstate(over="ignore", invalid="ignore"):  # a trial state may be absurd
        return assemble(potential, pattern, jax.device_get(pieces))


def assemble(potential: Potential, pattern: Pattern, pieces: list[list[Any]]) -> Linearisation:
    """Pieces summed into residual and tangent, on the host: a sum is no program to compile."""
    layout, n_q = potential.layout, potential.layout.n_rigid
    free = np.asarray(layout.free)
    values = np.zeros(len(pattern.indices))
    wall, missing, loads = np.zeros((3, layout.n_nodes, 3))
    slope, stiffness, coupling = np.zeros(n_q), np.zeros((n_q, n_q)), np.zeros((n_q, layout.n_nodes, 3))
    found: list[Any] = []
    for group, blocks in zip(potential.groups, pieces, strict=True):
        nodes = np.asarray(group.nodes)
        values += pattern.places[group.region] @ np.concatenate([block.matrix.ravel() for block in blocks])
        cells: Any = joined(group, [dataclasses.replace(block, matrix=None) for block in blocks])
        found.append(cells)
        _add(loads if group.volume is None else wall, nodes, cells.force)
        if group.volume is not None:
            _add(missing, nodes, cells.missing_force)
        if group.moved:
            slope += np.sum(cells.rigid_slope, axis=-1)
            stiffness += np.sum(cells.rigid_stiffness, axis=-1)
            for field, of_cells in zip(coupling, cells.coupling, strict=True):
                _add(field, nodes, of_cells)
    residual = (wall + missing + loads).ravel()
    held = np.delete(residual, free)
    of_wall = [cells for cells in found if cells.J_range is not None]
    J = np.concatenate([cells.J_range for cells in of_wall], axis=-1)
    return Linearisation(
        energy=sum(float(np.sum(cells.energy)) for cells in found),
        wall_energy=sum(float(np.sum(cells.energy)) for cells in of_wall),
        wall_force=wall + missing,
        residual=residual[free],
        missing=missing.ravel()[free],
        reactions=float(np.linalg.norm(held)),
        volume_error=float(np.max(np.concatenate([cells.volume_error for cells in of_wall]))),
        values=values,
        rigid_force=-slope,
        coupling=coupling.reshape(n_q, -1)[:, free].T,
        rigid_stiffness=stiffness,
        J_min=float(np.min(J)),
        J_max=float(np.max(J)),
    )


def _add(field: np.ndarray, nodes: np.ndarray, cells: np.ndarray) -> None:
    """Add to a field (n_nodes, 3) what cells have at their nodes (n_en, 3, n_cells)."""
    for i in range(3):
        field[:, i] += np.bincount(nodes.ravel(), cells[:, i].ravel(), len(field))


def on_nodes(layout: Layout, v: Array) -> Array:
    """Unknowns (n_free,) as a field (n_nodes, 3), zero where nodes are held."""
    return jnp.zeros(3 * layout.n_nodes).at[layout.free].set(v).reshape(layout.n_nodes, 3)


def advance(potential: Potential, state: State, dx: AnyArray, dq: AnyArray, fraction: float) -> State:
    """Go a fraction of the Newton step: free unknowns dx (n_free,), dq (n_q,), and condensed pressures."""
    return _advance(potential.wall, state, dx, dq, fraction)


@jax.jit
def _advance(wall: Potential, state: State, dx: Array, dq: Array, fraction: Array) -> State:
    step = on_nodes(wall.layout, dx)

    def condensed(group: Group) -> Array:
        assert group.volume is not None
        modes, solid = group.modes, group.solid
        assert modes is not None
        D = lambda x: dilatations(modes, solid, group_points(group, x))  # noqa: E731
        now, change = jax.jvp(D, (state.x,), (step,))
        return condensed_pressures(group.volume.stiffness, now + change)

    dp = cell_pressures(wall, condensed) - state.p
    return State(x=state.x + fraction * step, p=state.p + fraction * dp, q=state.q + fraction * dq)
