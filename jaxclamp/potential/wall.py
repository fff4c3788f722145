"""Derivatives of the wall's energy at points: kinematics in closed form, the law's own by autodiff.

With tangents y_c = dx/dxi_c and F = sum_c y_c (x) L_c, L = d xi/d X, the invariants of a `FibreLaw` are

    I1 = sum_K |F e_K|**2,   J = det y det L,   I4 = |F a|**2 = |sum_c m_c y_c|**2 with m = L a,

whose derivatives g_k by y_ci take a few products each:

    dI1/dy_ci = 2 sum_K L_cK F_iK,   dJ/dy_ci = det L (y_d x y_e)_i,   dI4/dy_ci = 2 m_c (F a)_i.

The energy w(I1, J, I4...) + p (J - 1) then has

    first  = sum_k w_k g_k + p g_J,
    second = sum_kl w_kl g_k (x) g_l + delta_ij S_cd + (w_J + p) det L eps_cde eps_ijk y_ek,
    S_cd   = 2 w_1 (L L')_cd + 2 sum w_4 m_c m_d,

with w_k and w_kl of a scalar in four variables. A law of all of F goes through nine directions instead.
Arrays are stacked and kept apart by barriers: XLA then compiles a few small loops instead of one large one.
"""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxclamp.core.tensors import Tensor, components, cross, det, pointwise_derivatives, stacked, total
from jaxclamp.fem.pattern import PAIRS
from jaxclamp.physics.materials import FibreLaw
from jaxclamp.potential.densities import Solid, deformation, dilatation, mixed_energy, shape_energy


def wall_derivatives(
    y: Mapping[tuple[int, int], Array], p: Array, solid: Solid
) -> tuple[Array, Array, Array]:
    """[psi_bar + p (J - 1)] dV and its derivatives by the tangents y.

    y: [c, i], each (n_q, n_cells); p: kPa, (n_q, n_cells)
    Returns energy (n_q, n_cells), first (3, 3, n_q, n_cells), and second by component pairs,
    (3, 3, n_q, 6, n_cells).
    """
    if isinstance(solid.material, FibreLaw):
        return _by_invariants(y, p, solid, solid.material)
    known = list(y)
    energy, first, second = pointwise_derivatives(
        lambda v: mixed_energy(dict(zip(known, v, strict=True)), p, solid), list(y.values())
    )
    shape = energy.shape
    return energy, first.reshape(3, 3, *shape), by_pairs(second.reshape(3, 3, 3, 3, *shape))


def wall_energy(Y: Array, solid: Solid) -> tuple[Array, Array]:
    """psi_bar dV and (J - 1) dV, each (n_q, n_cells), of tangents Y[c, i] (3, 3, n_q, n_cells).

    The same as `densities.shape_energy` and `dilatation`, in few operations on stacked arrays: a program that
    differentiates it again and again stays small.
    """
    law, L = solid.material, solid.to_local
    if not isinstance(law, FibreLaw):
        y = components(Y)
        return shape_energy(y, (), solid), dilatation(y, solid)
    J = _volume_ratio(Y, L)
    F, _, fibres = _kinematics(Y, L, law)
    psi = law.psi_of_invariants(jnp.sum(F * F, axis=(0, 1)), J, [jnp.sum(v * v, axis=0) for v in fibres])
    return psi * solid.dV, (J - 1.0) * solid.dV


def kirchhoff_stress(Y: Array, solid: Solid) -> tuple[Array, Array, Array]:
    """F and d psi_bar/dF F' in kPa, each (3, 3, n_q, n_cells), and J, of tangents Y[c, i].

    Of a law of invariants, 2 w_1 F F' + J w_J I + 2 sum w_4 (F a) (x) (F a).
    """
    law, L = solid.material, solid.to_local
    if not isinstance(law, FibreLaw):
        F = stacked(deformation(components(Y), solid))
        P = jax.grad(lambda F: jnp.sum(law.psi_bar(components(F))))(F)
        return F, det(F), total(P[:, k][:, None] * F[:, k][None] for k in range(3))
    F, _, fibres = _kinematics(Y, L, law)
    invariants = [jnp.sum(F * F, axis=(0, 1)), _volume_ratio(Y, L), *(jnp.sum(v * v, axis=0) for v in fibres)]
    w = jax.grad(lambda v: jnp.sum(law.psi_of_invariants(v[0], v[1], v[2:])))(invariants)
    F, fibres, w, J = lax.optimization_barrier((F, fibres, w, invariants[1]))
    left = total(F[:, k][:, None] * F[:, k][None] for k in range(3))
    parts = [w[0] * left, *(w4 * v[:, None] * v[None] for w4, v in zip(w[2:], fibres, strict=True))]
    return F, J, 2.0 * total(parts) + jnp.eye(3)[:, :, None, None] * (J * w[1])


def _volume_ratio(Y: Array, L: Array) -> Array:
    return jnp.sum(Y[0] * jnp.cross(Y[1], Y[2], axis=0), axis=0) * det(L)


def _kinematics(Y: Array, L: Array, law: FibreLaw) -> tuple[Array, list[Array], list[Array]]:
    """F (3, 3, n_q, n_cells); of each fibre family m = L a and F a, each (3, n_q, n_cells)."""
    F = total(Y[c][:, None] * L[c][None] for c in range(3))
    axes = [total(a[k] * L[:, k] for k in range(3)) for a in law.directions()]
    return F, axes, [total(m[c] * Y[c] for c in range(3)) for m in axes]


def by_pairs(second: Array) -> Array:
    """Second derivatives (n_c, 3, n_c, 3, n_q, n_cells) by the six PAIRS, (n_c, n_c, n_q, 6, n_cells)."""
    return jnp.stack([second[:, i, :, j] for i, j in PAIRS], axis=3)


def _by_invariants(y: Tensor, p: Array, solid: Solid, law: FibreLaw) -> tuple[Array, Array, Array]:
    Y, L = stacked(y), solid.to_local
    F, axes, fibres = _kinematics(Y, L, law)
    cofactor = jnp.stack([jnp.stack(cross(Y[c - 2], Y[c - 1])) for c in range(3)])
    scale = det(L)
    J = scale * jnp.sum(Y[0] * cofactor[0], axis=0)
    I1, I4 = jnp.sum(F * F, axis=(0, 1)), [jnp.sum(v * v, axis=0) for v in fibres]
    value, w, w2 = pointwise_derivatives(lambda v: law.psi_of_invariants(v[0], v[1], v[2:]), [I1, J, *I4])
    along_I1 = 2.0 * total(L[:, k][:, None] * F[:, k][None] for k in range(3))
    g = jnp.stack(
        [along_I1, scale * cofactor, *(2.0 * m[:, None] * v[None] for m, v in zip(axes, fibres, strict=True))]
    )
    w, w2 = w.at[1].add(p) * solid.dV, w2 * solid.dV
    metric = w[0] * total(L[:, k][:, None] * L[:, k][None] for k in range(3))
    S = 2.0 * total([metric, *(w[2 + k] * m[:, None] * m[None] for k, m in enumerate(axes))])
    first = total(w[k] * g[k] for k in range(len(g)))
    h = total(w2[:, k][:, None, None] * g[k][None] for k in range(len(g)))
    g, h, S, turning, first = lax.optimization_barrier((g, h, S, w[1] * scale * Y, first))
    second = jnp.stack([_pair(i, j, g, h, S, turning) for i, j in PAIRS.tolist()], axis=3)
    return (value + p * (J - 1.0)) * solid.dV, first, lax.optimization_barrier(second)


def _pair(i: int, j: int, g: Array, h: Array, S: Array, turning: Array) -> Array:
    """d2/dy_ci dy_dj of one pair of components, (3, 3, n_q, n_cells)."""
    low_rank = total(g[k][:, i][:, None] * h[k][:, j][None] for k in range(len(g)))
    if i == j:
        return low_rank + S
    a, b, c = turning[:, 3 - i - j] if (j - i) % 3 == 1 else -turning[:, 3 - i - j]
    nothing = jnp.zeros_like(a)
    return low_rank + jnp.stack(
        [jnp.stack([nothing, c, -b]), jnp.stack([-c, nothing, a]), jnp.stack([b, -a, nothing])]
    )
