"""What is minimised, constrained or differentiated: one number of the equilibria of a scene.

A `Measure` is a function of what is `Seen` of a scene: the body, and its states in the body and at
the stop. Values are in internal units: mm, kPa, mN, uJ. Maxima are smooth (volume- or
area-weighted power means, see `tensors.smooth_maximum`), so that they can be differentiated where
the place of the true peak jumps; `Result` gives the true peaks beside them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from jax.nn import sigmoid

from jaxclamp.core.records import record
from jaxclamp.core.tensors import smooth_maximum
from jaxclamp.observe import stresses as measures
from jaxclamp.observe.stresses import PARTS, PARTS_OF_A_JAW, PEAK_SHARPNESS, Landmarks, layer_stresses
from jaxclamp.potential.tangent import Body, State, contact_potential
from jaxclamp.potential.tangent import stored_energy as _stored_energy


@record
class Seen:
    """A scene's body and its equilibria."""

    body: Body
    marks: Landmarks
    physiological: State
    stop: State | None
    """None for a measure that needs only the physiological state"""


@dataclasses.dataclass(frozen=True)
class Measure:
    """A scalar function of the equilibria. Two measures of one name and arguments are equal."""

    name: str
    unit: str
    function: Callable[..., Array]
    arguments: tuple[str | float, ...] = ()
    needs_stop: bool = True

    def __call__(self, seen: Seen) -> Array:
        """The value in internal units, a JAX scalar."""
        return self.function(seen, *self.arguments)

    def __str__(self) -> str:
        inside = ", ".join(map(str, self.arguments))
        return f"{self.name}({inside})"


SMOOTHNESS_OF_THRESHOLD = 0.05
"""`volume_above` counts a point by half at the threshold; this part of it above, by 73 %"""


def smooth_peak_axial_stress(layer: str) -> Measure:
    """Smooth maximum of the axial stress in a layer at the stop, kPa."""
    return Measure("smooth_peak_axial_stress", "kPa", _smooth_peak, ("axial", layer))


def smooth_peak_circumferential_stress(layer: str) -> Measure:
    """Smooth maximum of the circumferential stress in a layer at the stop, kPa."""
    return Measure("smooth_peak_circumferential_stress", "kPa", _smooth_peak, ("circumferential", layer))


def smooth_peak_principal_stress(layer: str) -> Measure:
    """Smooth maximum of the greatest principal stress in a layer at the stop, kPa."""
    return Measure("smooth_peak_principal_stress", "kPa", _smooth_peak, ("greatest", layer))


def axial_stress_at_P() -> Measure:
    """Axial stress at P (inner media, compression axis, mid-length) at the stop, kPa."""
    return Measure("axial_stress_at_P", "kPa", _stress_at_P, ("axial",))


def circumferential_stress_at_P() -> Measure:
    """Circumferential stress at P at the stop, kPa."""
    return Measure("circumferential_stress_at_P", "kPa", _stress_at_P, ("circumferential",))


def clamp_force() -> Measure:
    """Force on one jaw (whole artery) at the stop, mN."""
    return Measure("clamp_force", "mN", _clamp_force)


def jaw_travel() -> Measure:
    """Travel of each jaw from its first contact to the stop, mm."""
    return Measure("jaw_travel", "mm", _jaw_travel)


def lumen_height() -> Measure:
    """Height of the lumen at mid-length on the compression axis at the stop, mm."""
    return Measure("lumen_height", "mm", _lumen_height)


def lumen_width() -> Measure:
    """Greatest width of the lumen at mid-length at the stop, mm."""
    return Measure("lumen_width", "mm", _lumen_width)


def lumen_area() -> Measure:
    """Area of the lumen at mid-length at the stop, mm^2."""
    return Measure("lumen_area", "mm2", _lumen_area)


def mean_contact_pressure() -> Measure:
    """Contact force over contact area at the stop, kPa."""
    return Measure("mean_contact_pressure", "kPa", _mean_contact_pressure)


def smooth_peak_contact_pressure() -> Measure:
    """Smooth maximum of the contact pressure at the stop, kPa."""
    return Measure("smooth_peak_contact_pressure", "kPa", _smooth_peak_contact_pressure)


def volume_above(layer: str, stress: float) -> Measure:
    """Share of a layer's volume whose axial stress at the stop is above `stress` (kPa), smoothly counted."""
    return Measure("volume_above", "", _volume_above, (layer, float(stress)))


def stored_energy() -> Measure:
    """Strain energy of the whole artery's wall at the stop, uJ."""
    return Measure("stored_energy", "uJ", _wall_energy)


def physiological_lumen_radius() -> Measure:
    """Radius of the lumen in the body, without clamp, mm."""
    return Measure("physiological_lumen_radius", "mm", _physiological_radius, needs_stop=False)


def jaw_curvature() -> Measure:
    """Greatest curvature of the jaw's face that its shape parameters allow, smoothly, 1/mm.

    Convex and concave: its inverse is the least radius that has to be machined.
    """
    return Measure("jaw_curvature", "1/mm", _jaw_curvature)


def jaw_half_width() -> Measure:
    """Distance from the jaw's middle to its side along the artery, mm."""
    return Measure("jaw_half_width", "mm", _jaw_half_width)


# --- the functions ------------------------------------------------------------------------------


def _at_stop(seen: Seen) -> State:
    assert seen.stop is not None
    return seen.stop


def _layer(seen: Seen, name: str) -> int:
    if name not in seen.marks.layer_names:
        raise KeyError(f"there is no layer '{name}': expected one of {', '.join(seen.marks.layer_names)}")
    return seen.marks.layer_names.index(name)


def _smooth_peak(seen: Seen, component: str, layer: str) -> Array:
    number = _layer(seen, layer)
    first, last = seen.body.topology.layer_cells[number]
    stress = getattr(layer_stresses(seen.body, _at_stop(seen), number), component)
    return smooth_maximum(stress, seen.body.geometry.dV[:, first:last], PEAK_SHARPNESS)


def _stress_at_P(seen: Seen, component: str) -> Array:
    layer = measures.layer_of_P(seen.marks.layer_names)
    first, _ = seen.body.topology.layer_cells[layer]
    stress = getattr(layer_stresses(seen.body, _at_stop(seen), layer), component)
    return jnp.asarray(seen.marks.P_weights) @ stress[:, seen.marks.P_cell - first]


def _clamp_force(seen: Seen) -> Array:
    state = _at_stop(seen)
    return -PARTS_OF_A_JAW * jax.grad(contact_potential, argnums=2)(seen.body, state.x, state.jaw_height)


def _jaw_travel(seen: Seen) -> Array:
    return seen.physiological.x[seen.marks.outer_top, 1] - _at_stop(seen).jaw_height


def _lumen_height(seen: Seen) -> Array:
    return 2.0 * _at_stop(seen).x[seen.marks.lumen_top, 1]


def _lumen_width(seen: Seen) -> Array:
    return 2.0 * jnp.max(_at_stop(seen).x[seen.marks.lumen_ring, 0])


def _lumen_area(seen: Seen) -> Array:
    ring = _at_stop(seen).x[seen.marks.lumen_ring, :2]
    return measures.lumen_ring_area(ring, seen.marks.element)


def _mean_contact_pressure(seen: Seen) -> Array:
    return measures.mean_contact_pressure(seen.body, _at_stop(seen), seen.marks.element)[0]


def _smooth_peak_contact_pressure(seen: Seen) -> Array:
    pressure, area = measures.contact_pressure(seen.body, _at_stop(seen), seen.marks.element)
    return smooth_maximum(pressure, area, PEAK_SHARPNESS)


def _volume_above(seen: Seen, layer: str, threshold: float) -> Array:
    number = _layer(seen, layer)
    first, last = seen.body.topology.layer_cells[number]
    stress = layer_stresses(seen.body, _at_stop(seen), number).axial
    dV = seen.body.geometry.dV[:, first:last]
    width = SMOOTHNESS_OF_THRESHOLD * abs(threshold) + 1e-9
    return jnp.sum(dV * sigmoid((stress - threshold) / width)) / jnp.sum(dV)


def _wall_energy(seen: Seen) -> Array:
    return PARTS * _stored_energy(seen.body, _at_stop(seen).x)


def _physiological_radius(seen: Seen) -> Array:
    return seen.physiological.x[seen.marks.lumen_top, 1]


def _jaw_curvature(seen: Seen) -> Array:
    curvatures = jnp.abs(seen.body.parameters.jaw.curvatures())
    return smooth_maximum(curvatures, jnp.full(curvatures.shape, 1.0), PEAK_SHARPNESS) * (
        curvatures.size ** (1.0 / PEAK_SHARPNESS)
    )


def _jaw_half_width(seen: Seen) -> Array:
    return seen.body.parameters.jaw.half_extent()
