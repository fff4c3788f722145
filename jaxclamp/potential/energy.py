"""The potential as one scalar: what forces, balances and sensitivities are derivatives of."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.records import record
from jaxclamp.core.tensors import Tensor, components, total
from jaxclamp.potential.densities import Solid, dilatation, swept_volume
from jaxclamp.potential.terms import BLOOD, Group, Potential

AnyArray = Array | np.ndarray


@record
class State:
    """A configuration: equilibrium or a trial."""

    x: Array
    """current position of the nodes, mm, (n_nodes, 3)"""
    p: Array
    """pressure modes of the cells, kPa, (n_m, n_cells)"""
    q: Array
    """rigid coordinates, mm, (n_q,): see `densities.RIGID`"""

    @property
    def jaw_height(self) -> Array:
        """Height of the jaw's lowest point above the axis, mm."""
        return self.q[0]


def at_points(stencil: AnyArray, x: Array) -> dict[tuple[int, int], Array]:
    """y_c = sum_a S[q, c, a] x_a at every point, by components [c, i]: each (n_q, n_cells).

    stencil: (n_q, n_c, n_en); x: positions of the cells' nodes, (n_en, 3, n_cells)
    """
    return components(stacked_at_points(stencil, x))


def stacked_at_points(stencil: AnyArray, x: Array) -> Array:
    """The same as one array, (n_c, 3, n_q, n_cells)."""
    n_q, n_c, n_en = stencil.shape
    y = jnp.matmul(jnp.reshape(stencil, (n_q * n_c, n_en)), x.reshape(n_en, -1))
    return jnp.moveaxis(y.reshape(n_q, n_c, 3, -1), 0, 2)


def gather(x: Array, nodes: AnyArray) -> Array:
    """Positions of the nodes of some cells, (n_en, 3, n_cells)."""
    return x[nodes].swapaxes(1, 2)


def group_points(group: Group, x: Array) -> dict[tuple[int, int], Array]:
    """What the densities of a group look at, at positions x (n_nodes, 3)."""
    return at_points(group.stencil, gather(x, group.nodes))


def energy(potential: Potential, x: Array, q: Array) -> Array:
    """Pi with the pressures at their best, uJ: a function of positions (n_nodes, 3) and q (n_q,) alone."""
    return total(group_energy(group, x, q) for group in potential.groups)


def group_energy(group: Group, x: Array, q: Array) -> Array:
    """The part of one group, uJ."""
    y = group_points(group, x)
    points = total(jnp.sum(term.density(y, q, term.here)) for term in group.terms)
    return points if group.volume is None else points + volumetric_energy(group, y)


def dilatations(modes: AnyArray, solid: Solid, y: Tensor) -> Array:
    """int N_m (J - 1) dV of every cell, mm^3, (n_m, n_cells)."""
    return jnp.einsum("mq,qc->mc", modes, dilatation(y, solid))


def condensed_pressures(stiffness: Array, dilatations: Array) -> Array:
    """The pressure in equilibrium with a dilatation: M^-1 int N_m (J - 1) dV, (n_m, n_cells)."""
    return jnp.einsum("mnc,nc->mc", stiffness, dilatations)


def volumetric_energy(group: Group, y: Tensor) -> Array:
    """1/2 D' M^-1 D of the cells of a solid, uJ."""
    assert group.volume is not None
    assert group.modes is not None
    D = dilatations(group.modes, group.solid, y)
    return 0.5 * jnp.sum(D * condensed_pressures(group.volume.stiffness, D))


def stored_energy(potential: Potential, x: Array) -> Array:
    """Strain energy of the wall of the modelled part, the pressures at their best, uJ."""
    return total(group_energy(group, x, jnp.zeros(0)) for group in potential.layers)


def lumen_volume(potential: Potential, x: Array) -> Array:
    """Volume of the modelled part of the lumen, mm^3."""
    (group,) = potential.of(BLOOD)
    return jnp.sum(swept_volume(group_points(group, x), group.here(BLOOD).weights))


def cell_pressures(potential: Potential, of_group: Callable[[Group], Array]) -> Array:
    """The pressures of all cells from those of each layer, (n_m, n_cells)."""
    return jnp.concatenate([of_group(group) for group in potential.layers], axis=1)


def settled(potential: Potential, x: Array, q: Array) -> State:
    """A state whose pressures fit its dilatation: p = M^-1 int N (J - 1) dV."""

    def of(group: Group) -> Array:
        assert group.volume is not None
        assert group.modes is not None
        D = dilatations(group.modes, group.solid, group_points(group, x))
        return condensed_pressures(group.volume.stiffness, D)

    return State(x=x, p=cell_pressures(potential, of), q=q)


_settled = jax.jit(settled)


def with_equilibrium_pressure(potential: Potential, x: Array, q: Array) -> State:
    """`settled`, compiled once for the wall alone."""
    found: State = _settled(potential.wall, x, q)
    return found
