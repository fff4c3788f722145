"""The table of reported figures: each number of result.json, the console, reports and studies is one entry.

A figure is a function of the equilibria, of the last state as seen from the one in the body, so that it can
be differentiated. To add one, add an entry to `FIGURES`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.fem.landmarks import lumen_area, lumen_height, lumen_width
from jaxclamp.observe import closure
from jaxclamp.observe.balance import balance
from jaxclamp.observe.equilibria import Equilibria
from jaxclamp.observe.injury import damage_of_layer, over_thresholds, told
from jaxclamp.observe.measures import (
    contact_of_a_jaw,
    contact_points,
    force_aside,
    rigid_coordinate,
    smooth_peak,
    stress_at_P,
    sunk,
    travel_of_a_jaw,
)
from jaxclamp.observe.stresses import gaps, noise
from jaxclamp.potential.energy import gather
from jaxclamp.potential.terms import JAWS

Read = Callable[[Equilibria], Any]

NODES_SUNK = "node_penetration_mm"
"""a figure that is not reported"""
J_OFF = 0.05
"""a wall keeps its volume; a point whose J is further from 1 is not resolved"""

POINT, WHOLE = 1.0, 2.0
"""orders with which figures converge as the mesh is refined; stress at a point, such as P or where it
peaks, has the cell's constant pressure in it, and the place of a peak wanders from point to point"""


def as_it_is(equilibria: Equilibria) -> Equilibria:
    """The view of figures of shape and contact."""
    return equilibria


def stressed(equilibria: Equilibria) -> Equilibria:
    """The view of figures of stress."""
    return equilibria


@dataclasses.dataclass(frozen=True)
class Figure:
    """One reported number, or one for each layer."""

    key: str
    """as in result.json: name, and unit behind the last underscore"""
    label: str
    """in words, for reports"""
    read: Callable[[Any], Any]
    """the value in the key's unit, from the view; by layer a dict"""
    view: Callable[[Equilibria], Any] = as_it_is
    """what figures of one kind share; they are compiled together"""
    contract: bool = True
    """always there, null in a result without any state"""
    order: float | None = None
    """order of convergence for the estimate of its error; None: none is given"""
    shown: tuple[str, ...] = ()
    """where it is listed: "summary" (console), "headlines", "numbers", "peaks" and "means" (report), "study"
    and "study peaks" (a study's page)"""

    @property
    def unit(self) -> str:
        """Of the value, as in the key."""
        unit = self.key.rpartition("_")[2]
        return unit if unit in ("mm", "mm2", "kPa", "N", "mN", "uJ") else ""

    def __call__(self, equilibria: Equilibria) -> Any:
        """The value: JAX scalars, differentiable."""
        return self.read(self.view(equilibria))


def by_layer(read: Callable[[Equilibria, str], Any]) -> Read:
    """A figure for each layer."""
    return lambda e: {name: read(e, name) for name in e.marks.layer_names}


def ratio(value: Array, base: Array, least: Array) -> Array:
    """value / base; not a number where the base is no more than `least`."""
    nothing = jnp.abs(base) <= least
    return jnp.where(nothing, jnp.nan, value / jnp.where(nothing, 1.0, base))


# --- shape and contact ------------------------------------------------------------------------------


def _travel(e: Equilibria) -> Array:
    return jnp.maximum(travel_of_a_jaw(e), 0.0)


def _height(e: Equilibria) -> Array:
    return lumen_height(e.last.x, e.marks)


def _area(e: Equilibria) -> Array:
    return lumen_area(e.last.x, e.marks)


def _penetration(e: Equilibria) -> Array:
    deepest = [jnp.max(-gaps(group, e.last)) for group in e.potential.of(JAWS)]
    return jnp.maximum(jnp.max(jnp.stack(deepest)), 0.0)


# --- stress -----------------------------------------------------------------------------------------


def _all_J(e: Equilibria) -> Array:
    return jnp.concatenate([e.stresses(i).J for i in range(len(e.marks.layer_names))], axis=1)


def _share_off(e: Equilibria) -> Array:
    """Share of the wall's stress-free volume whose J is off by more than `J_OFF`."""
    dV = jnp.concatenate([group.solid.dV for group in e.potential.layers], axis=1)
    return jnp.sum(jnp.where(jnp.abs(_all_J(e) - 1.0) > J_OFF, dV, 0.0)) / jnp.sum(dV)


def _greatest(component: str) -> Read:
    def read(e: Equilibria, name: str) -> Array:
        return jnp.max(getattr(e.stresses(e.marks.layer(name)), component))

    return by_layer(read)


def _place_of_axial_peak(e: Equilibria, name: str) -> Array:
    layer = e.marks.layer(name)
    group, element = e.potential.layers[layer], e.marks.element
    N = element.shape(element.quadrature()[0])[0]
    positions = jnp.einsum("qa,aic->iqc", N, gather(e.last.x, group.nodes)).reshape(3, -1)
    return positions[:, jnp.argmax(e.stresses(layer).axial)]


def _stress_ratio(component: str) -> Read:
    def read(e: Equilibria) -> Array:
        material = e.potential.layers[e.marks.P_layer].solid.material
        return ratio(stress_at_P(e, component), stress_at_P(e.in_body, component), noise(material))

    return read


# --- the table --------------------------------------------------------------------------------------

FIGURES = (
    Figure(
        "jaw_travel_mm", "travel of each jaw", _travel, order=WHOLE, shown=("summary", "numbers", "study")
    ),
    Figure(
        "clamp_height_mm",
        "how high the middle of the clamp is above the artery's axis: not 0 where jaws are not alike",
        lambda e: rigid_coordinate(e, "clamp_height"),
        contract=False,
    ),
    Figure(
        "side_force_N",
        "force that holds the artery sideways between jaws that push it aside",
        lambda e: 1e-3 * force_aside(e),
        contract=False,
    ),
    Figure(NODES_SUNK, "how far the wall's middle node is above the jaw's face", sunk, contract=False),
    Figure("lumen_height_mm", "lumen height", _height, order=WHOLE, shown=("summary", "numbers")),
    Figure(
        "lumen_width_mm",
        "lumen width",
        lambda e: lumen_width(e.last.x, e.marks),
        order=WHOLE,
        shown=("summary", "numbers", "study"),
    ),
    Figure("lumen_area_mm2", "lumen area", _area, order=WHOLE, shown=("numbers",)),
    Figure(
        "occlusion",
        "occlusion by height",
        lambda e: 1.0 - _height(e) / lumen_height(e.body.x, e.marks),
        shown=("summary", "headlines", "numbers"),
    ),
    Figure(
        "area_occlusion",
        "occlusion by area",
        lambda e: 1.0 - _area(e) / lumen_area(e.body.x, e.marks),
        shown=("summary", "numbers"),
    ),
    Figure("closed", "the lumen is closed at mid-length", closure.closed),
    Figure("closure", "closure by area, and by force between inner walls", closure.closure, contract=False),
    Figure("lumen_area_share", "lumen area, over that in the body", closure.area_share),
    Figure("lumen_opening_mm", "greatest height left of the lumen", closure.opening, contract=False),
    Figure("closed_length_mm", "length of artery that is closed", closure.length, contract=False),
    Figure("lumen_overlap_mm", "overlap of opposite inner walls", closure.overlap, contract=False),
    Figure("intima_contact_area_mm2", "contact area of opposite inner walls", closure.contact_area),
    Figure(
        "intima_force_share", "share of the jaw's force between inner walls", closure.carried, contract=False
    ),
    Figure(
        "outer_radius_mm",
        "outer radius on the compression axis",
        lambda e: e.last.x[e.marks.outer_top, 1],
        contract=False,
    ),
    Figure(
        "clamp_force_N",
        "force on one jaw",
        lambda b: 1e-3 * b.jaw_force,
        balance,
        order=WHOLE,
        shown=("summary", "headlines", "numbers", "study"),
    ),
    Figure(
        "mean_contact_pressure_kPa",
        "mean contact pressure",
        lambda e: contact_of_a_jaw(e)[0],
        contract=False,
        shown=("numbers",),
    ),
    Figure(
        "max_contact_pressure_kPa",
        "highest contact pressure",
        lambda e: jnp.max(contact_points(e)[0]),
        shown=("summary", "headlines", "numbers", "study"),
    ),
    Figure(
        "contact_area_mm2",
        "contact area of one jaw",
        lambda e: contact_of_a_jaw(e)[1],
        contract=False,
        shown=("numbers",),
    ),
    Figure(
        "max_penetration_mm",
        "deepest point of the wall inside a jaw",
        _penetration,
        shown=("summary", "study"),
    ),
    Figure(
        "lumen_contact_force_N",
        "force between opposite inner walls",
        lambda b: 1e-3 * b.inner_force,
        balance,
        contract=False,
    ),
    Figure(
        "total_energy_uJ", "energy of wall, blood and contact", lambda b: b.energy, balance, contract=False
    ),
    Figure("residual_mN", "forces left on free nodes", lambda b: b.residual, balance, contract=False),
    Figure("force_balance_error", "balance of vertical forces", lambda b: b.error, balance, contract=False),
    Figure(
        "axial_stress_at_P_kPa",
        "axial stress at P",
        lambda e: stress_at_P(e, "axial"),
        stressed,
        order=POINT,
        shown=("summary", "numbers", "study"),
    ),
    Figure(
        "axial_stress_ratio_at_P",
        "axial stress at P, over that in the body",
        _stress_ratio("axial"),
        stressed,
        shown=("summary", "headlines"),
    ),
    Figure(
        "circumferential_stress_at_P_kPa",
        "circumferential stress at P",
        lambda e: stress_at_P(e, "circumferential"),
        stressed,
        contract=False,
        shown=("numbers",),
    ),
    Figure(
        "circumferential_stress_ratio_at_P",
        "circumferential stress at P, over that in the body",
        _stress_ratio("circumferential"),
        stressed,
        shown=("summary",),
    ),
    Figure("J_min", "smallest volume ratio at a point", lambda e: jnp.min(_all_J(e)), stressed),
    Figure("J_share_off", f"share of the wall whose J is off by more than {J_OFF:.0%}", _share_off, stressed),
    Figure(
        "J_min_away_from_fold",
        "least J of a point over its cell's, away from the fold",
        lambda e: closure.volumes_away_from_fold(e)[0],
        stressed,
        contract=False,
    ),
    Figure(
        "J_max_away_from_fold",
        "greatest J of a point over its cell's, away from the fold",
        lambda e: closure.volumes_away_from_fold(e)[1],
        stressed,
        contract=False,
    ),
    Figure(
        "fold_stretch_ratio",
        "least stretch round the lumen, over that through the wall",
        closure.fold_stretch_ratio,
        stressed,
        contract=False,
    ),
    Figure("J_max", "largest volume ratio at a point", lambda e: jnp.max(_all_J(e)), stressed),
    Figure(
        "peak_axial_stress_kPa",
        "axial",
        _greatest("axial"),
        stressed,
        order=POINT,
        shown=("summary", "peaks", "study peaks"),
    ),
    Figure(
        "peak_axial_stress_location_mm", "place of the axial peak", by_layer(_place_of_axial_peak), stressed
    ),
    Figure(
        "smooth_peak_axial_stress_kPa",
        "axial, smooth peak",
        by_layer(lambda e, name: smooth_peak(e, "axial", name)),
        stressed,
        order=POINT,
        shown=("peaks", "study peaks"),
    ),
    Figure(
        "peak_circumferential_stress_kPa",
        "circumferential",
        _greatest("circumferential"),
        stressed,
        contract=False,
        shown=("peaks", "study peaks"),
    ),
    Figure(
        "peak_principal_stress_kPa",
        "greatest principal",
        _greatest("greatest"),
        stressed,
        contract=False,
        shown=("peaks",),
    ),
    Figure("damage", "damage", by_layer(damage_of_layer), stressed, order=POINT, shown=("summary", "means")),
    Figure("injury", "above your thresholds", over_thresholds, stressed),
)


def shown_in(place: str) -> tuple[Figure, ...]:
    """The figures listed in a place, such as "summary"."""
    return tuple(figure for figure in FIGURES if place in figure.shown)


# --- read off -----------------------------------------------------------------------------------------

Record = dict[str, Any]


def _values(view: Callable[[Equilibria], Any], e: Equilibria) -> Record:
    seen = view(e)
    return {figure.key: figure.read(seen) for figure in FIGURES if figure.view is view}


_read = partial(jax.jit, static_argnums=0, compiler_options={"xla_backend_optimization_level": 0})(_values)


def read_figures(equilibria: Equilibria) -> Record:
    """Every figure of the last state, keys as in result.json: host floats, None for what is not defined.

    Several programs rather than one: they compile faster.
    """
    views = dict.fromkeys(figure.view for figure in FIGURES)
    found: Record = {}
    seen = dataclasses.replace(equilibria, injury=tuple(given.unsourced for given in equilibria.injury))
    for view in views:
        found |= _read(view, seen)
    found = jax.tree_util.tree_map(lambda leaf: np.asarray(leaf).tolist(), jax.device_get(found))
    found["injury"] = told(equilibria.injury, found["injury"])
    names = equilibria.marks.layer_names
    in_order = lambda v: {n: _defined(v[n]) for n in names} if isinstance(v, dict) else _defined(v)  # noqa: E731
    return {figure.key: in_order(found[figure.key]) for figure in FIGURES}


def _defined(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value
