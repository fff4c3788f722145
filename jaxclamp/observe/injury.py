"""Measures of injury: what clamping does to the wall beyond what blood pressure does to it every day.

None of them is a verdict: thresholds are a user's, with a source, and figures are told as above or below
them. docs/injury.md has the formulas, the sources, and what they leave open.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
from jax import Array

from jaxclamp.core.tensors import norm, smooth_maximum, total
from jaxclamp.observe import closure
from jaxclamp.observe.equilibria import Equilibria
from jaxclamp.observe.measure import Measure
from jaxclamp.observe.measures import (
    MECHANICAL,
    PEAK_SHARPNESS,
    contact_points,
    smooth_peak,
    smooth_share_above,
)
from jaxclamp.observe.stresses import noise, touching
from jaxclamp.potential.densities import deformation
from jaxclamp.potential.energy import State, group_points
from jaxclamp.potential.terms import BLOOD, JAWS, Group
from jaxclamp.scenes.scene import InjuryThreshold

ONSET_STRETCH = 1.49
"""circumferential stretch (+- 0.11) from which human femoropopliteal arteries under 50 years are damaged
(axially 1.51 +- 0.13; above 50 years 1.26 +- 0.09 and 1.27 +- 0.09): Anttila et al., Acta Biomater 90 (2019)
225"""
LEAST_SHARE = 0.05
"""of a constituent's mean energy in the body over the layer: what a point is taken to store there at least,
so that fibres which are slack in the body are not damaged by the first load they see"""
STRESSES = {
    "axial_stress": "axial",
    "circumferential_stress": "circumferential",
    "principal_stress": "greatest",
}
"""measures of an `InjuryThreshold` that are of a layer, and what they are among `Stresses`"""


def smooth_peak_axial_stress_ratio(layer: str) -> Measure:
    """Smooth peak of the axial stress in a layer at the stop, over that in the body.

    Clamping multiplies the axial stress of the media (Gasser, Schulze-Bauer & Holzapfel, J Biomech Eng 124
    (2002) 355). The peaks need not be at one place.
    """
    return Measure("smooth_peak_axial_stress_ratio", "", _peak_ratio, ("axial", layer))


def smooth_peak_contact_pressure_excess() -> Measure:
    """Smooth maximum of the contact pressure in excess of blood pressure at the stop, kPa; 0 if it is below.

    Moore et al., J Vasc Surg 8 (1988) 422, found intimal injury from 5 kPa at the clamp on: less than an
    artery carries anyway, so that it can only be an excess.
    """
    return Measure("smooth_peak_contact_pressure_excess", "kPa", _peak_excess)


def intima_contact_area() -> Measure:
    """Area over which opposite inner walls press on each other at the stop, mm^2, smoothly counted.

    Endothelium is what meets there. Clamps strip it, the more the harder they close: Margovsky et al.,
    Cardiovasc Surg 7 (1999) 457.
    """
    return Measure("intima_contact_area", "mm2", closure.contact_area)


def smooth_peak_axial_strain_gradient() -> Measure:
    """Greatest gradient of the axial strain along the artery at the stop, smoothly, 1/mm.

    On the inner media, on the compression axis: the jaw's edge bends and pulls the wall there, and it is the
    edge, not the width, that injures (Hodgson 1993, of tourniquets). The strain is log(length at the stop /
    length in the body) of the pieces between neighbouring nodes; its gradient is the difference of
    neighbouring pieces over the distance of their middles in the body.
    """
    return Measure("smooth_peak_axial_strain_gradient", "1/mm", _strain_gradient)


def mean_damage(layer: str, onset_stretch: float = ONSET_STRETCH) -> Measure:
    """Damage of a layer at the stop, its mean over the volume, 0 to 1: see `damage_at_points`.

    Raises ValueError for an onset stretch that is not above 1.
    """
    return Measure("mean_damage", "", _mean_damage, (layer, _above_1(onset_stretch)))


def smooth_peak_damage(layer: str, onset_stretch: float = ONSET_STRETCH) -> Measure:
    """Damage of a layer at the stop, its p-norm over the volume, 0 to 1: see `damage_at_points`.

    Raises ValueError for an onset stretch that is not above 1.
    """
    return Measure("smooth_peak_damage", "", _peak_damage, (layer, _above_1(onset_stretch)))


def _above_1(onset_stretch: float) -> float:
    if not 1.0 < onset_stretch < float("inf"):
        raise ValueError(f"onset_stretch = {onset_stretch!r}: expected a number above 1")
    return float(onset_stretch)


def share_above_threshold(entry: int = 0) -> Measure:
    """What `final.injury[entry].share_above` is, smoothly counted: its slope by the threshold is known, too.

    entry: number of the scene's `[[injury]]`, from 0. A point counts by half at the threshold, as in
    `volume_above`.
    """
    return Measure("share_above_threshold", "", _smooth_share, (int(entry),))


def peak_over_threshold(entry: int = 0) -> Measure:
    """Smooth maximum of what the scene's `[[injury]]` number `entry`, from 0, is of, over its threshold."""
    return Measure("peak_over_threshold", "", _smooth_peak_over, (int(entry),))


MEASURES: tuple[Callable[..., Measure], ...] = (
    *MECHANICAL,
    smooth_peak_axial_stress_ratio,
    smooth_peak_contact_pressure_excess,
    intima_contact_area,
    smooth_peak_axial_strain_gradient,
    mean_damage,
    smooth_peak_damage,
)
"""every factory: study files can name those at the stop by the measure's name and unit"""


# --- stress, contact and strain -----------------------------------------------------------------------


def _peak_ratio(e: Equilibria, component: str, layer: str) -> Array:
    least = noise(e.potential.layers[e.marks.layer(layer)].solid.material)
    return smooth_peak(e, component, layer) / jnp.maximum(smooth_peak(e.in_body, component, layer), least)


def blood_pressure(e: Equilibria) -> Array:
    """Pressure of the blood, kPa."""
    (group,) = e.potential.of(BLOOD)
    pressure: Array = group.here(BLOOD).pressure
    return pressure


def _peak_excess(e: Equilibria) -> Array:
    pressure, area = contact_points(e)
    return smooth_maximum(pressure - blood_pressure(e), area, PEAK_SHARPNESS)


def axial_strain_gradient(e: Equilibria) -> tuple[Array, Array]:
    """Gradient of the axial log strain on the compression axis of the inner media, 1/mm, and the lengths in
    the body that it is of, mm; see `smooth_peak_axial_strain_gradient`."""
    before, now = (jnp.diff(state.x[e.marks.P_line], axis=0).T for state in (e.body, e.last))
    length = norm(before)
    strain = jnp.log(norm(now) / length)
    apart = 0.5 * (length[1:] + length[:-1])
    return jnp.diff(strain) / apart, apart


def _strain_gradient(e: Equilibria) -> Array:
    gradient, length = axial_strain_gradient(e)
    return smooth_maximum(jnp.abs(gradient), length, PEAK_SHARPNESS)


# --- damage -------------------------------------------------------------------------------------------


def energies(group: Group, state: State) -> list[Array]:
    """Strain energy of each constituent of a layer at its points, kPa, (n_q, n_cells) each."""
    parts: list[Array] = group.solid.material.constituents(
        deformation(group_points(group, state.x), group.solid)
    )
    return parts


def damage_of_constituent(ratio: Array, s: float) -> Array:
    """Damage of a constituent, 0 to 1, of its energy over that in the body.

    D = x^3 (10 - 15 x + 6 x^2), x = (sqrt(ratio) - 1) / (s - 1) between 0 and 1: with two continuous
    derivatives, one of the damage laws of FEBio, of Simo's sqrt(2 psi) (Comput Methods Appl Mech Eng 60
    (1987) 153). That damage begins at the energy in the body is the idea of Famaey, Vander Sloten & Kuhl,
    Biomech Model Mechanobiol 12 (2013) 123.
    """
    x = jnp.clip((jnp.sqrt(jnp.maximum(ratio, 1.0)) - 1.0) / (s - 1.0), 0.0, 1.0)
    return x**3 * (10.0 - 15.0 * x + 6.0 * x**2)


def damage_of_group(group: Group, body: State, last: State, s: float = ONSET_STRETCH) -> Array:
    """Damage of a layer at its points between two states, see `damage_at_points`, (n_q, n_cells)."""
    dV, least = group.solid.dV, noise(group.solid.material)
    return damage_of_energies(energies(group, body), energies(group, last), dV, least, s)


def damage_of_energies(
    before: Sequence[Array], now: Sequence[Array], dV: Array, least: Array | float, s: float
) -> Array:
    """The same from the energies of constituents at points with volumes dV; least: what counts as none."""
    lost = []
    for psi_0, psi in zip(before, now, strict=True):
        mean = jnp.sum(dV * psi_0) / jnp.sum(dV)
        base = jnp.maximum(jnp.maximum(psi_0, LEAST_SHARE * mean), least)
        lost.append(damage_of_constituent(psi / base, s) * psi)
    stored = total(now)
    strained = stored > 0.0
    return jnp.where(strained, total(lost) / jnp.where(strained, stored, 1.0), 0.0)


def damage_at_points(e: Equilibria, layer: str, onset_stretch: float = ONSET_STRETCH) -> Array:
    """Damage of a layer at its points in the last state, 0 to 1, (n_q, n_cells).

    Of the energy that the wall stores by its change of shape, the share that damage would take of it,
    sum D_c psi_c / sum psi_c over the constituents c (ground substance, each family of fibres), in
    psi = sum (1 - D_c) psi_c. D_c is `damage_of_constituent` of psi_c at the last state over psi_c at the
    same point in the body, or over `LEAST_SHARE` of its mean there if that is more.

    onset_stretch: s, how many times as much as in the body sqrt(psi_c) is where a constituent is damaged
    altogether. No source has a value for it; the stretch at which arteries begin to be damaged stands for it,
    see `ONSET_STRETCH`. Post-processed: the wall does not soften.
    """
    group = e.potential.layers[e.marks.layer(layer)]
    return damage_of_group(group, e.body, e.last, onset_stretch)


def _mean_damage(e: Equilibria, layer: str, onset_stretch: float) -> Array:
    dV = e.potential.layers[e.marks.layer(layer)].solid.dV
    return jnp.sum(dV * damage_at_points(e, layer, onset_stretch)) / jnp.sum(dV)


def damage_of_layer(e: Equilibria, layer: str) -> Array:
    """Mean damage of a layer over its volume, 0 to 1, with the onset stretch of `ONSET_STRETCH`."""
    return _mean_damage(e, layer, ONSET_STRETCH)


def _peak_damage(e: Equilibria, layer: str, onset_stretch: float) -> Array:
    dV = e.potential.layers[e.marks.layer(layer)].solid.dV
    return smooth_maximum(damage_at_points(e, layer, onset_stretch), dV, PEAK_SHARPNESS)


# --- a user's thresholds --------------------------------------------------------------------------------


def _seen(e: Equilibria, given: InjuryThreshold) -> tuple[Array, Array]:
    """What a threshold is of at its points, kPa, and their weights: volume, or area in contact."""
    if given.measure in STRESSES:
        number = e.marks.layer(given.layer)
        return getattr(e.stresses(number), STRESSES[given.measure]), e.potential.layers[number].solid.dV
    found = [touching(group, e.last) for group in e.potential.of(JAWS)]
    pressure, area = (
        jnp.concatenate(parts, axis=1) for parts in zip(*((p, da * s) for p, da, s in found), strict=True)
    )
    least = blood_pressure(e) if given.measure == "contact_pressure_excess" else 0.0
    return jnp.maximum(pressure - least, 0.0), area


def _share(part: Array, weights: Array) -> Array:
    """Weighted mean of 0 and 1, 0 where there is no weight: no contact."""
    whole = jnp.sum(weights)
    there = whole > 0.0
    return jnp.where(there, jnp.sum(weights * part) / jnp.where(there, whole, 1.0), 0.0)


def over_thresholds(e: Equilibria) -> list[dict[str, Array]]:
    """Of each of the scene's thresholds: itself, the share above it, and the peak over it."""
    found = []
    for given in e.injury:
        values, weights = _seen(e, given)
        share = _share(jnp.where(values > given.threshold, 1.0, 0.0), weights)
        peak = jnp.maximum(jnp.max(values), 0.0) / given.threshold
        found.append({"threshold_kPa": given.threshold, "share_above": share, "peak_over_threshold": peak})
    return found


def told(injury: Sequence[InjuryThreshold], figures: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """`over_thresholds` with what each is of and where it comes from: as in result.json."""
    names = ("threshold_kPa", "share_above", "peak_over_threshold")
    return [
        {"measure": given.measure, "layer": given.layer or None}
        | {name: values[name] for name in names}
        | {"source": given.source}
        for given, values in zip(injury, figures, strict=True)
    ]


def _given(e: Equilibria, entry: int) -> InjuryThreshold:
    if not 0 <= entry < len(e.injury):
        raise IndexError(f"the scene has {len(e.injury)} [[injury]]: there is no number {entry}, from 0")
    return e.injury[entry]


def _smooth_share(e: Equilibria, entry: int) -> Array:
    given = _given(e, entry)
    values, weights = _seen(e, given)
    return smooth_share_above(values, weights, given.threshold)


def _smooth_peak_over(e: Equilibria, entry: int) -> Array:
    given = _given(e, entry)
    return smooth_maximum(*_seen(e, given), PEAK_SHARPNESS) / given.threshold
