"""What the author of a measure reads at the points of a wall: the engine's fields, by the layer's name.

Every function takes the `Equilibria` that a measure is given and looks at its last state
(`equilibria.in_body` has the physiological one last); all are JAX functions. Points are the quadrature
points of the modelled part, batch axes last: (..., n_q points of a cell, n_cells).
"""

from __future__ import annotations

from jax import Array

from jaxclamp.core.tensors import Tensor, stacked
from jaxclamp.core.tensors import smooth_maximum as power_mean
from jaxclamp.observe import stresses as wall
from jaxclamp.observe.equilibria import Equilibria
from jaxclamp.observe.measures import PEAK_SHARPNESS, contact_points
from jaxclamp.potential.tangent import whole


def stresses(equilibria: Equilibria, layer: str) -> wall.Stresses:
    """Stress components of a layer at its points, kPa, and the volume ratio J, (n_q, n_cells) each."""
    return equilibria.stresses(equilibria.marks.layer(layer))


def _at_points(equilibria: Equilibria, layer: str) -> tuple[Tensor, Tensor]:
    group = equilibria.potential.layers[equilibria.marks.layer(layer)]
    return wall.cauchy_stress(whole(group, equilibria.last))


def deformation_gradient(equilibria: Equilibria, layer: str) -> Array:
    """F at the points of a layer, (3, 3, n_q, n_cells): rows x, y, z in space, columns along the radial,
    circumferential and axial lines of the stress-free layer."""
    return stacked(_at_points(equilibria, layer)[0])


def cauchy_stress(equilibria: Equilibria, layer: str) -> Array:
    """Cauchy stress at the points of a layer, kPa, (3, 3, n_q, n_cells), along x, y and z in space."""
    return stacked(_at_points(equilibria, layer)[1])


def volumes(equilibria: Equilibria, layer: str) -> Array:
    """Stress-free volume of the points of a layer, mm^3, (n_q, n_cells): the weights of means."""
    return equilibria.potential.layers[equilibria.marks.layer(layer)].solid.dV


def contact_pressures(equilibria: Equilibria) -> tuple[Array, Array]:
    """Contact pressure (kPa) and current area (mm^2) of the points at the jaws, (n_q, n_facets) each."""
    return contact_points(equilibria)


def smooth_maximum(values: Array, weights: Array) -> Array:
    """The maximum of positive values as a smooth function of them: a power mean weighted by volume or area.

    values, weights: of one shape; a scalar in the unit of the values
    """
    return power_mean(values, weights, PEAK_SHARPNESS)
