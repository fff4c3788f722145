"""The measures that ship: what is minimised, constrained or differentiated.

Each is a function of the `Equilibria` of a scene: its potential, and its states in the body and at the stop.
Values are in internal units: mm, kPa, mN, uJ. Maxima are smooth (volume- or area-weighted power means, see
`tensors.smooth_maximum`), so that they can be differentiated where the place of the true peak jumps; `Result`
gives the true peaks beside them.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from jax.nn import sigmoid

from jaxclamp.core.tensors import smooth_maximum, total
from jaxclamp.fem import landmarks
from jaxclamp.observe.equilibria import Equilibria
from jaxclamp.observe.measure import Measure
from jaxclamp.observe.stresses import facet_contact, node_gaps, touching
from jaxclamp.potential.energy import group_energy
from jaxclamp.potential.energy import stored_energy as _stored_energy
from jaxclamp.potential.terms import JAWS, Potential

PEAK_SHARPNESS = 40.0
"""exponent of the power mean that stands for a maximum"""


SMOOTHNESS_OF_THRESHOLD = 0.05
"""`volume_above` counts a point by half at the threshold; this part of it above, by 73 %"""


def smooth_peak_axial_stress(layer: str) -> Measure:
    """Smooth maximum of the axial stress in a layer at the stop, kPa."""
    return Measure("smooth_peak_axial_stress", "kPa", smooth_peak, ("axial", layer))


def smooth_peak_circumferential_stress(layer: str) -> Measure:
    """Smooth maximum of the circumferential stress in a layer at the stop, kPa."""
    return Measure("smooth_peak_circumferential_stress", "kPa", smooth_peak, ("circumferential", layer))


def smooth_peak_principal_stress(layer: str) -> Measure:
    """Smooth maximum of the greatest principal stress in a layer at the stop, kPa."""
    return Measure("smooth_peak_principal_stress", "kPa", smooth_peak, ("greatest", layer))


def axial_stress_at_P() -> Measure:
    """Axial stress at P (inner media, compression axis, mid-length) at the stop, kPa."""
    return Measure("axial_stress_at_P", "kPa", stress_at_P, ("axial",))


def circumferential_stress_at_P() -> Measure:
    """Circumferential stress at P at the stop, kPa."""
    return Measure("circumferential_stress_at_P", "kPa", stress_at_P, ("circumferential",))


def clamp_force() -> Measure:
    """Force on one jaw (whole artery) at the stop, mN."""
    return Measure("clamp_force", "mN", force_on_a_jaw)


def side_force() -> Measure:
    """Force that holds the artery sideways at the stop, mN: 0 where jaws do not push it aside.

    Over twice the jaw's force, the least coefficient of friction with which nothing slides.
    """
    return Measure("side_force", "mN", force_aside)


def jaw_travel() -> Measure:
    """Travel of each jaw from its first contact to the stop, mm."""
    return Measure("jaw_travel", "mm", travel_of_a_jaw)


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


def jaw_contact_area() -> Measure:
    """Area of one jaw's contact with the wall at the stop, mm^2, smoothly counted."""
    return Measure("jaw_contact_area", "mm2", _contact_area)


def holding_force(friction: float) -> Measure:
    """Greatest force along the artery that the jaws could hold by friction at the stop, mN: Coulomb's bound.

    friction times the contact pressure's integral over both jaws; nothing rubs in the model, so it is a bound
    on what a grip could carry, not a load of the scene. friction: coefficient between jaw and wall, such as
    0.03 to 0.06 of endothelium on polished glass (Dunn et al., Tribol Lett 27 (2007) 233). Raises ValueError
    if it is not positive.
    """
    if not 0.0 < friction < float("inf"):
        raise ValueError(f"friction = {friction!r}: expected a coefficient above 0")
    return Measure("holding_force", "mN", _holding_force, (float(friction),))


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


MECHANICAL: tuple[Callable[..., Measure], ...] = (
    smooth_peak_axial_stress,
    smooth_peak_circumferential_stress,
    smooth_peak_principal_stress,
    axial_stress_at_P,
    circumferential_stress_at_P,
    clamp_force,
    side_force,
    jaw_travel,
    lumen_height,
    lumen_width,
    lumen_area,
    mean_contact_pressure,
    jaw_contact_area,
    holding_force,
    smooth_peak_contact_pressure,
    volume_above,
    stored_energy,
    physiological_lumen_radius,
    jaw_curvature,
    jaw_half_width,
)
"""the factories of this module; `injury.MEASURES` has all"""


# --- the functions ------------------------------------------------------------------------------


def smooth_peak(e: Equilibria, component: str, layer: str) -> Array:
    """Smooth maximum of a component of `Stresses` over the volume of a layer, kPa."""
    number = e.marks.layer(layer)
    dV = e.potential.layers[number].solid.dV
    return smooth_maximum(getattr(e.stresses(number), component), dV, PEAK_SHARPNESS)


def stress_at_P(e: Equilibria, component: str) -> Array:
    """A component of `Stresses` at P, kPa: extrapolated to that node in its cell."""
    stress = getattr(e.stresses(e.marks.P_layer), component)
    return jnp.asarray(e.marks.P_weights) @ stress[:, e.marks.P_cell]


def jaw_forces(potential: Potential, x: Array, q: Array) -> Array:
    """Force on the modelled part of each jaw, against its closing, mN, (n_jaws,)."""
    of = lambda group: -jax.grad(group_energy, argnums=2)(group, x, q)[0]  # noqa: E731
    return jnp.stack([of(group) for group in potential.of(JAWS)])


def force_on_a_jaw(e: Equilibria) -> Array:
    """Force on one jaw of the whole artery, mN."""
    modelled = jnp.sum(jaw_forces(e.potential, e.last.x, e.last.q))
    return e.marks.symmetry.parts_of_a_jaw * modelled


def rigid_coordinate(e: Equilibria, name: str) -> Array:
    """A rigid coordinate (`densities.RIGID`); 0 where it is not there."""
    place = e.marks.symmetry.rigid_place(name)
    return jnp.zeros(()) if place is None else e.last.q[place]


def force_aside(e: Equilibria) -> Array:
    """Force that holds the whole artery sideways, mN."""
    return e.marks.symmetry.parts * jnp.abs(rigid_coordinate(e, "side_force"))


def sunk(e: Equilibria) -> Array:
    """How far the outer wall's node in the middle is above the jaw's face there, mm.

    A bar thinner than the facets are long passes between contact points. Of jaws that may end before the
    middle: how deep any node is inside one.
    """
    here = e.potential.of(JAWS)[0].here(JAWS)
    if here.placement.tip is not None:
        deepest = [jnp.max(-node_gaps(group, e.last)) for group in e.potential.of(JAWS)]
        return jnp.max(jnp.stack(deepest))
    back = sum(part.height(0.0, 0.0) for part in getattr(here.jaw, "relief", []))
    middle = rigid_coordinate(e, "clamp_height")
    return e.last.x[e.marks.outer_top, 1] - middle - e.last.jaw_height - back


def travel_of_a_jaw(e: Equilibria) -> Array:
    """Travel of each jaw from its first contact with the artery in the body, mm."""
    return e.body.x[e.marks.outer_top, 1] - e.last.jaw_height


def _lumen_height(e: Equilibria) -> Array:
    return landmarks.lumen_height(e.last.x, e.marks)


def _lumen_width(e: Equilibria) -> Array:
    return landmarks.lumen_width(e.last.x, e.marks)


def _lumen_area(e: Equilibria) -> Array:
    return landmarks.lumen_area(e.last.x, e.marks)


def contact_of_a_jaw(e: Equilibria) -> tuple[Array, Array]:
    """Mean contact pressure, kPa (0 without contact), and contact area of one jaw, mm^2."""
    found = [touching(group, e.last) for group in e.potential.of(JAWS)]
    force = total(jnp.sum(pressure * da) for pressure, da, _ in found)
    area = total(jnp.sum(da * share) for _, da, share in found)
    mean = force / jnp.where(area > 0.0, area, 1.0)
    return jnp.where(area > 0.0, mean, 0.0), e.marks.symmetry.parts_of_a_jaw * area


def _mean_contact_pressure(e: Equilibria) -> Array:
    return contact_of_a_jaw(e)[0]


def _contact_area(e: Equilibria) -> Array:
    return contact_of_a_jaw(e)[1]


def _holding_force(e: Equilibria, friction: float) -> Array:
    pressure, area = contact_points(e)
    return 2.0 * friction * e.marks.symmetry.parts_of_a_jaw * jnp.sum(pressure * area)


def contact_points(e: Equilibria) -> tuple[Array, Array]:
    """Contact pressure (kPa) and current area (mm^2) of all points at the jaws, (n_q, n_facets) each."""
    found = [facet_contact(group, e.last) for group in e.potential.of(JAWS)]
    pressure, area = (jnp.concatenate(parts, axis=1) for parts in zip(*found, strict=True))
    return pressure, area


def _smooth_peak_contact_pressure(e: Equilibria) -> Array:
    return smooth_maximum(*contact_points(e), PEAK_SHARPNESS)


def _volume_above(e: Equilibria, layer: str, threshold: float) -> Array:
    number = e.marks.layer(layer)
    dV = e.potential.layers[number].solid.dV
    return smooth_share_above(e.stresses(number).axial, dV, threshold)


def smooth_share_above(values: Array, weights: Array, threshold: Array | float) -> Array:
    """Share of the weights whose value is above a threshold, see `SMOOTHNESS_OF_THRESHOLD`; 0 without any."""
    width = SMOOTHNESS_OF_THRESHOLD * jnp.abs(threshold) + 1e-9
    whole = jnp.sum(weights)
    there = whole > 0.0
    above = jnp.sum(weights * sigmoid((values - threshold) / width))
    return jnp.where(there, above / jnp.where(there, whole, 1.0), 0.0)


def _wall_energy(e: Equilibria) -> Array:
    return e.marks.symmetry.parts * _stored_energy(e.potential, e.last.x)


def _physiological_radius(e: Equilibria) -> Array:
    return 0.5 * landmarks.lumen_height(e.body.x, e.marks)


def _jaw_curvature(e: Equilibria) -> Array:
    curvatures = jnp.abs(e.jaw.curvatures())
    return smooth_maximum(curvatures, jnp.full(curvatures.shape, 1.0), PEAK_SHARPNESS) * (
        curvatures.size ** (1.0 / PEAK_SHARPNESS)
    )


def _jaw_half_width(e: Equilibria) -> Array:
    return e.jaw.half_extent()
