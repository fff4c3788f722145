"""What files of a state hold beyond pictures: tensors, fibres, energy, and contact at its points.

Plain numpy, by layer, as in `pictures.fields`.
"""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
from jax import Array

from jaxclamp.core.tensors import stacked
from jaxclamp.fem.landmarks import extrapolation
from jaxclamp.observe.stresses import cauchy_stress, strain_energy
from jaxclamp.physics.materials import FibreLaw
from jaxclamp.pictures.fields import (
    DEFORMATION,
    LayerFields,
    averaged,
    contact_at_points,
    on_both_sides,
)
from jaxclamp.potential.energy import State
from jaxclamp.potential.model import Model
from jaxclamp.potential.tangent import Piece, cut, joined
from jaxclamp.potential.terms import JAWS, Group

CAUCHY = "cauchy_stress_kPa"
ENERGY = "strain_energy_density_kPa"
PRESSED = "highest_contact_pressure_kPa"


@jax.jit
def _of_piece(cells: Piece) -> tuple[Array, Array, Array]:
    F, sigma = cauchy_stress(cells)
    return stacked(F), stacked(sigma), strain_energy(cells)


_directions = jax.jit(lambda material: material.directions())


def with_tensors(model: Model, state: State, layers: tuple[LayerFields, ...]) -> tuple[LayerFields, ...]:
    """The layers of the modelled part with tensors and stress-free fibres at the points, and with the energy
    and the highest contact pressure of each cell."""
    pressed = highest_contact(model, state)
    found = []
    for layer, group, span in zip(layers, model.potential.layers, model.mesh.layer_cells, strict=True):
        F, sigma, energy = joined(group, jax.device_get([_of_piece(cells) for cells in cut(group, state)]))
        tensors = {CAUCHY: sigma, DEFORMATION: F}
        at = {name: on_both_sides(layer, name, _at_nodes(layer, v)) for name, v in tensors.items()}
        found.append(
            dataclasses.replace(
                layer,
                point_data=layer.point_data | at,
                cell_data=layer.cell_data | {ENERGY: energy, PRESSED: pressed[slice(*span)]},
                fibres=tuple(_at_nodes(layer, v) for v in _stress_free_fibres(group)),
            )
        )
    return tuple(found)


def _at_nodes(layer: LayerFields, values: np.ndarray) -> np.ndarray:
    """Extrapolated to the nodes and averaged there: (..., n_q, n_cells) to (n, ...)."""
    corners = extrapolation(layer.element) @ values.reshape(-1, *values.shape[-2:])
    at = [averaged(layer.cells, each, len(layer.points)) for each in corners]
    return np.stack(at, axis=-1).reshape(-1, *values.shape[:-2])


def _stress_free_fibres(group: Group) -> list[np.ndarray]:
    """Direction of each family along the material axes at the quadrature points, (3, n_q, n_cells)."""
    material, shape = group.solid.material, group.solid.dV.shape
    families = jax.device_get(_directions(material)) if isinstance(material, FibreLaw) else ()
    return [np.stack([np.broadcast_to(c, shape) for c in direction]) for direction in families]


def with_fibres(layers: tuple[LayerFields, ...]) -> tuple[LayerFields, ...]:
    """Layers with the deformed direction (a unit vector) and the stretch of every fibre family.

    Zero where a layer has fewer families than another.
    """
    most = max(len(layer.fibres) for layer in layers)
    return tuple(
        dataclasses.replace(layer, point_data=layer.point_data | _fibres(layer, most)) for layer in layers
    )


def _fibres(layer: LayerFields, families: int) -> dict[str, np.ndarray]:
    found = {}
    for number in range(families):
        rest = layer.fibres[number] if number < len(layer.fibres) else np.zeros((len(layer.points), 3))
        now = np.einsum("nij,nj->ni", layer.point_data[DEFORMATION], rest)
        stretch = np.linalg.norm(now, axis=1)
        found[f"fibre_{number + 1}"] = now / np.where(stretch > 0.0, stretch, 1.0)[:, None]
        found[f"fibre_{number + 1}_stretch"] = stretch
    return found


def highest_contact(model: Model, state: State) -> np.ndarray:
    """Highest contact pressure at the points of each cell's outer facet, kPa, 0 elsewhere, (n_cells,)."""
    highest = np.zeros(model.mesh.n_cells)
    for group in model.potential.of(JAWS):
        facets = model.discretisation.sides["upper" if group.here(JAWS).side > 0 else "lower"]
        highest[model.mesh.outer_cells[facets]] = np.max(contact_at_points(group, state)[0], axis=0)
    return highest
