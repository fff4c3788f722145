"""What is read off an equilibrium: stresses, lumen, forces, contact, peaks, and independent checks.

Everything is a JAX function of the body and its states, so that it can be differentiated; all
sizes are those of the whole artery, not of the modelled eighth.

Axial stress is the Cauchy stress along the artery's axis, sigma_zz, as in the seed's maps.
Circumferential and radial stress are those along the deformed image of the stress-free
circumferential and radial lines: the wall carries these directions with it when it flattens.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.records import record, static
from jaxclamp.core.tensors import (
    Tensor,
    cross,
    det,
    largest_eigenvalue,
    norm,
    product,
    smooth_maximum,
    total,
    transpose,
)
from jaxclamp.fem.elements import Element, gauss, lagrange, tensor_rule
from jaxclamp.fem.tube import Mesh
from jaxclamp.physics.materials import Material
from jaxclamp.potential.densities import Stencils
from jaxclamp.potential.tangent import (
    AnyArray,
    Body,
    Piece,
    State,
    at_points,
    contact_potential,
    cut,
    gaps,
    intima_potential,
    lumen_volume,
    piece,
    potential,
)

PARTS = 8
"""the model is one eighth of the artery"""
PARTS_OF_A_JAW = 4
"""and carries a quarter of the force on one jaw"""
PEAK_SHARPNESS = 40.0
"""exponent of the power mean that stands for a maximum"""


@record
class Landmarks:
    """Nodes where the seed looks, and the stencils of the quantities read there."""

    lumen_top: int = static()
    """inner surface, compression axis, mid-length"""
    lumen_ring: np.ndarray
    """inner surface at mid-length, from the fold to the compression axis, (n_c,)"""
    outer_top: int = static()
    """outer surface, compression axis, mid-length"""
    P_cell: int = static()
    """cell whose corner is P: inner surface of the media, compression axis, mid-length"""
    P_weights: np.ndarray
    """extrapolation from that cell's quadrature points to P, (n_q,)"""
    fold_plane: np.ndarray
    """nodes with y = 0"""
    layer_names: tuple[str, ...] = static()
    element: Element = static()


def extrapolation(element: Element) -> np.ndarray:
    """From values at a cell's quadrature points to its nodes, (n_en, n_q)."""
    nodes = tensor_nodes(element)
    return lagrange(gauss(element.points_per_axis)[0], nodes)[0]


def tensor_nodes(element: Element) -> np.ndarray:
    """Local coordinates of the nodes, (n_en, 3)."""
    return element.nodes_1d[element.node_grid]


def layer_of_P(layer_names: tuple[str, ...]) -> int:
    """The innermost layer called "media", or the innermost."""
    return layer_names.index("media") if "media" in layer_names else 0


def find_landmarks(mesh: Mesh, layer_names: tuple[str, ...]) -> Landmarks:
    """The nodes and cells of interest; P is on the innermost layer called "media", or the innermost."""
    layer = layer_of_P(layer_names)
    P = mesh.node(mesh.layer_inner_line(layer), -1, 0)
    first, last = mesh.layer_cells[layer]
    corner, cell = np.argwhere(mesh.cells[:, first:last] == P)[0]
    return Landmarks(
        lumen_top=mesh.node(0, -1, 0),
        lumen_ring=np.array([mesh.node(0, c, 0) for c in range(mesh.grid[1])]),
        outer_top=mesh.node(-1, -1, 0),
        P_cell=int(first + cell),
        P_weights=extrapolation(mesh.element)[corner],
        fold_plane=mesh.fold_plane,
        layer_names=layer_names,
        element=mesh.element,
    )


def cauchy_stress(
    piece: Piece, modes: AnyArray, gradients: AnyArray, material: Material
) -> tuple[Tensor, Tensor]:
    """Deformation gradient and Cauchy stress (kPa) by components, each (n_q, n_cells), Eqs. (7) to (9).

    sigma = p I + (1/J) d psi_bar/dF F', with the pressure of the cell.
    modes: (n_m, n_q); gradients: dN/dxi, (n_q, 3, n_en); F has its columns along the material axes
    """
    F = product(transpose(at_points(gradients, piece.x)), piece.geometry.to_local)
    P = jax.grad(lambda G: jnp.sum(material.psi_bar(G)))(F)
    p = jnp.einsum("mq,mc->qc", modes, piece.p)
    J = det(F)
    tau = product(P, transpose(F))
    return F, {(i, j): tau[i, j] / J + p if i == j else tau[i, j] / J for i, j in tau}


def along(F: Tensor, sigma: Tensor, axis: int) -> Array:
    """Normal stress along the deformed image of a material axis (0 radial, 1 circumferential), kPa."""
    t = [F[i, axis] for i in range(3)]
    squared_length = total(component * component for component in t)
    return total(t[i] * sigma[i, j] * t[j] for i in range(3) for j in range(3)) / squared_length


@record
class Stresses:
    """Stress at the quadrature points, kPa, each (n_q, n_cells)."""

    circumferential: Array
    axial: Array
    radial: Array
    """along the deformed image of the radial line"""
    greatest: Array
    """greatest principal stress"""
    J: Array
    """volume ratio"""


def piece_stresses(piece: Piece, stencils: Stencils, material: Material) -> Stresses:
    """Stress components of interest at the quadrature points of some cells of one layer."""
    F, sigma = cauchy_stress(piece, stencils.modes, stencils.wall, material)
    return Stresses(
        circumferential=along(F, sigma, 1),
        axial=sigma[2, 2],
        radial=along(F, sigma, 0),
        greatest=largest_eigenvalue(sigma),
        J=det(F),
    )


_piece_stresses = jax.jit(piece_stresses)


def stresses(body: Body, state: State) -> Stresses:
    """Stress components of interest at every quadrature point."""
    materials = body.parameters.materials
    parts = [
        _piece_stresses(cells, body.stencils, materials[layer])
        for cells, (layer, _, _) in zip(cut(body, state), body.topology.blocks, strict=True)
    ]
    return jax.tree_util.tree_map(lambda *arrays: jnp.concatenate(arrays, axis=-1), *parts)


def layer_stresses(body: Body, state: State, layer: int) -> Stresses:
    """The same for one layer."""
    cells = piece(body, state, *body.topology.layer_cells[layer])
    return piece_stresses(cells, body.stencils, body.parameters.materials[layer])


def lumen_ring_area(ring: Array, element: Element) -> Array:
    """Area inside the closed lumen whose first quadrant is the curve `ring` (n_c, 2), mm^2."""
    m = element.order
    points, weights = gauss(m + 1)
    N, dN = lagrange(element.nodes_1d, points[:, None])
    starts = np.arange(0, ring.shape[0] - 1, m)
    edges = ring[starts[:, None] + np.arange(m + 1)]  # (n_edges, m + 1, 2)
    x, dx = jnp.einsum("qa,eai->qei", N, edges), jnp.einsum("qa,eai->qei", dN[:, 0], edges)
    swept = 0.5 * (x[..., 0] * dx[..., 1] - x[..., 1] * dx[..., 0])
    return 4.0 * jnp.sum(weights[:, None] * swept)


def contact_pressure(body: Body, state: State, element: Element) -> tuple[Array, Array]:
    """Contact pressure on the deformed outer wall, kPa, and current area of the points, mm^2."""
    facets = body.topology.outer_facets
    n = round(body.stencils.contact.shape[0] ** 0.5)
    points, weights = tensor_rule((n, n))
    tangents = jnp.einsum("qka,aci->kiqc", lagrange(element.nodes_1d, points)[1], state.x[facets])
    da = norm(cross(tangents[0], tangents[1])) * weights[:, None]
    pressure = -jax.grad(lambda g: jnp.sum(body.parameters.contact.energy(g)))(gaps(body, state))
    return pressure * body.geometry.dA / da, da


def mean_contact_pressure(body: Body, state: State, element: Element) -> tuple[Array, Array]:
    """Contact force over contact area, kPa (0 without contact), and that area in the model, mm^2.

    A point counts as in contact where it presses with more than stiffness times smoothing, in part
    where it presses less, smoothly.
    """
    pressure, da = contact_pressure(body, state, element)
    contact = body.parameters.contact
    onset = contact.stiffness * contact.smoothing
    share = jnp.clip(pressure * da / body.geometry.dA / onset, 0.0, 1.0)
    area = jnp.sum(da * share**2 * (3.0 - 2.0 * share))
    mean = jnp.sum(pressure * da) / jnp.where(area > 0.0, area, 1.0)
    return jnp.where(area > 0.0, mean, 0.0), area


Report = dict[str, Any]


def observe(body: Body, state: State, pressure: Array, marks: Landmarks) -> Report:
    """Every number reported of one equilibrium, keys as in result.json, JAX scalars.

    Lengths mm, stresses kPa, forces N, energies uJ. Several programs rather than one: they compile
    faster.
    """
    s = stresses(body, state)
    return (
        _lumen_and_contact(body, state, marks)
        | _balance(body, state, pressure, marks)
        | _stress_report(body, state, s, marks)
    )


@jax.jit
def _lumen_and_contact(body: Body, state: State, marks: Landmarks) -> Report:
    """Lumen, outer wall and contact."""
    ring = state.x[marks.lumen_ring, :2]
    pressures, _ = contact_pressure(body, state, marks.element)
    mean, area = mean_contact_pressure(body, state, marks.element)
    return {
        "jaw_height_mm": state.jaw_height,
        "lumen_height_mm": 2.0 * state.x[marks.lumen_top, 1],
        "lumen_width_mm": 2.0 * jnp.max(ring[:, 0]),
        "lumen_overlap_mm": 2.0 * jnp.max(-state.x[body.topology.lumen_facets, 1]),
        "lumen_area_mm2": lumen_ring_area(ring, marks.element),
        "outer_radius_mm": state.x[marks.outer_top, 1],
        "max_contact_pressure_kPa": jnp.max(pressures),
        "mean_contact_pressure_kPa": mean,
        "contact_area_mm2": PARTS_OF_A_JAW * area,
        "max_penetration_mm": jnp.maximum(jnp.max(-gaps(body, state)), 0.0),
    }


@partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
def _balance(body: Body, state: State, pressure: Array, marks: Landmarks) -> Report:
    """Energy, jaw force, and the checks of equilibrium.

    Residual and balance come from the gradient of the potential, not from the assembled system
    that was solved. The balance is that of the modelled part along y: the cut through the wall, the
    pressure on the lumen's projection and the contact of the inner walls against the force on the jaw;
    relative to the largest of them, or, where all vanish, to a thousandth of the wall's other forces.

    Called once a state, it is compiled for a short compilation rather than for speed.
    """
    energy, elastic = jax.value_and_grad(potential, argnums=1)(body, state.x, state.jaw_height, 0.0)
    volume, swelling = jax.value_and_grad(lumen_volume, argnums=1)(body, state.x)
    residual = (elastic - pressure * swelling).ravel()[body.topology.free]
    jaw_force = -jax.grad(contact_potential, argnums=2)(body, state.x, state.jaw_height)
    between_walls = jax.grad(intima_potential, argnums=2)(body, state.x, 0.0)
    pushed = pressure * _lifting(body, state)
    supports = (elastic[:, 1] - pushed)[marks.fold_plane]
    imbalance = jnp.abs(jnp.sum(supports) + jnp.sum(pushed) + between_walls - jaw_force)
    largest = jnp.max(jnp.stack([jnp.abs(jaw_force), jnp.sum(pushed), jnp.sum(jnp.abs(supports))]))
    return {
        "clamp_force_N": 1e-3 * PARTS_OF_A_JAW * jaw_force,
        "lumen_contact_force_N": 1e-3 * PARTS_OF_A_JAW * between_walls,
        "total_energy_uJ": PARTS * (energy - pressure * volume),
        "residual_mN": jnp.linalg.norm(residual),
        "force_balance_error": imbalance / (jnp.maximum(largest, 1e-3 * jnp.linalg.norm(elastic)) + 1e-6),
    }


@jax.jit
def _stress_report(body: Body, state: State, s: Stresses, marks: Landmarks) -> Report:
    """Stress at P, the range of J, and the peaks of every layer over its quadrature points."""
    report: Report = {
        "axial_stress_at_P_kPa": marks.P_weights @ s.axial[:, marks.P_cell],
        "circumferential_stress_at_P_kPa": marks.P_weights @ s.circumferential[:, marks.P_cell],
        "J_min": jnp.min(s.J),
        "J_max": jnp.max(s.J),
    }
    positions = at_points_of_cells(body, state.x, marks.element)
    for name, (first, last) in zip(marks.layer_names, body.topology.layer_cells, strict=True):
        axial = s.axial[:, first:last]
        place = jnp.argmax(axial)
        found = {
            "peak_axial_stress_kPa": axial.ravel()[place],
            "peak_axial_stress_location_mm": positions[:, :, first:last].reshape(3, -1)[:, place],
            "smooth_peak_axial_stress_kPa": smooth_maximum(
                axial, body.geometry.dV[:, first:last], PEAK_SHARPNESS
            ),
            "peak_circumferential_stress_kPa": jnp.max(s.circumferential[:, first:last]),
            "peak_principal_stress_kPa": jnp.max(s.greatest[:, first:last]),
        }
        for key, value in found.items():
            report.setdefault(key, {})[name] = value
    return report


def at_points_of_cells(body: Body, x: Array, element: Element) -> Array:
    """Current position of the quadrature points, mm, (3, n_q, n_cells)."""
    N = element.shape(element.quadrature()[0])[0]
    return jnp.einsum("qa,aci->iqc", N, x[body.topology.cells])


def _lifting(body: Body, state: State) -> Array:
    """Vertical force of a unit pressure on each node, mm^2: int N n_y da, (n_nodes,)."""
    facets = body.topology.lumen_facets
    n = round(body.stencils.lumen.shape[0] ** 0.5)
    weights = tensor_rule((n, n))[1][:, None]
    y = at_points(body.stencils.lumen, jnp.swapaxes(state.x[facets], 1, 2))
    normal = cross([y[1, i] for i in range(3)], [y[2, i] for i in range(3)])
    at_corners = body.stencils.lumen[:, 0].T @ (normal[1] * weights)
    return jnp.zeros(state.x.shape[0]).at[facets].add(at_corners)
