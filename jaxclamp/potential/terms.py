"""The list of terms: the potential of a scene is their sum, and everything else loops over them.

    Pi(x, p; q) = sum_cells int [psi_bar(F) + p (J - 1)] dV - 1/2 p' M p      wall, incompressibility
                  - pressure * V_lumen(x)                                     blood pressure
                  + int phi(gap(x; q)) dA                                     jaw contact
                  + int phi(gap between the walls) dA                         intima contact

of the modelled part, with one, two or four pressures p per cell and M = int N_m N_n / bulk dV, so that at
equilibrium p = bulk (J - 1) averaged over the cell (mean dilatation, Q1/P0) or projected on the linear
functions (Q2/P1); q are the rigid coordinates (`densities.RIGID`).

A term says where it lives (a region of the mesh), what it looks at there (a stencil), and its density.
Terms of one region and stencil form a group: they are differentiated together. To add a term, write its
density and one entry of `KINDS`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.records import record, static
from jaxclamp.fem.pattern import Layout, Region
from jaxclamp.fem.stencils import Stencils
from jaxclamp.fem.tube import closed_radii
from jaxclamp.physics.contact import Contact
from jaxclamp.potential.bodies import Body, facet_areas, pressure_stiffness, solids
from jaxclamp.potential.densities import (
    Blood,
    Density,
    Meeting,
    Touch,
    blood_energy,
    intima_energy,
    jaw_energy,
    shape_energy,
)
from jaxclamp.scenes.scene import Artery, Clamp, MeshSettings, Scene


@record
class Term:
    """One summand of the potential: the integral of a density over the points of a region."""

    name: str = static()
    """as shown to users"""
    region: str = static()
    """such as "layer 0" or "upper outside" of the mesh"""
    stencil: str = static()
    """what it looks at there, see `build_potential`"""
    density: Density = static()
    """uJ at the points, see `densities`"""
    here: Any
    """what the density knows of its points; where regions are cut into blocks, arrays of two or more axes
    have the cells last"""
    moved: bool = static(default=False)
    """the density depends on the rigid coordinates"""


@record
class Volume:
    """Cells keep their volume: 1/2 D' M^-1 D with D = int N_m (J - 1) dV, by pressures of the cells.

    It lives on the points of a solid, whose term comes first in its group.
    """

    name: str = static()
    """as shown to users"""
    region: str = static()
    """that of its solid"""
    stencil: str = static()
    """that of its solid"""
    cells: tuple[int, int] = static()
    """first and last-plus-one among the pressures of a state"""
    stiffness: Array
    """M^-1, kPa/mm^3, (n_m, n_m, n_cells)"""


@record
class Group:
    """Terms on the same points."""

    region: str = static()
    """where they live"""
    nodes: np.ndarray
    """(n_en, n_cells)"""
    size: int = static()
    """cells of a block"""
    stencil: Array | np.ndarray
    """(n_q, n_c, n_en)"""
    terms: tuple[Term, ...]
    """differentiated together"""
    volume: Volume | None
    """None where cells need not keep their volume"""
    modes: Array | np.ndarray | None
    """of the pressure, (n_m, n_q); None without `volume`"""

    @property
    def moved(self) -> bool:
        """True if a term depends on the rigid coordinates."""
        return any(term.moved for term in self.terms)

    @property
    def solid(self) -> Any:
        """What is known of the points of a layer of the wall, whose term comes first."""
        return self.terms[0].here

    def here(self, name: str) -> Any:
        """What a term of the group knows of its points."""
        return next(term.here for term in self.terms if term.name == name)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the terms."""
        names = tuple(term.name for term in self.terms)
        return names if self.volume is None else (*names, self.volume.name)


@record
class Potential:
    """The sum of all terms, and how its unknowns are numbered."""

    groups: tuple[Group, ...]
    """summed up"""
    layout: Layout
    """numbers of the unknowns"""

    def of(self, name: str) -> tuple[Group, ...]:
        """The groups with a term of that name, such as "jaw contact": one for each jaw modelled."""
        return tuple(group for group in self.groups if name in group.names)

    @property
    def layers(self) -> tuple[Group, ...]:
        """The groups of the wall, from inside to outside."""
        return tuple(group for group in self.groups if group.volume is not None)

    @property
    def wall(self) -> Potential:
        """The potential of the wall alone."""
        return dataclasses.replace(self, groups=self.layers)

    def keeping(self, wanted: Callable[[str], bool]) -> Potential:
        """The potential with those terms alone that are wanted, by name."""

        def kept(group: Group) -> Group:
            return dataclasses.replace(group, terms=tuple(t for t in group.terms if wanted(t.name)))

        groups = tuple(group for group in map(kept, self.groups) if group.terms)
        return dataclasses.replace(self, groups=groups)

    @property
    def surfaces(self) -> Potential:
        """All terms but those of the wall."""
        return dataclasses.replace(self, groups=tuple(g for g in self.groups if g.volume is None))

    @property
    def artery(self) -> Potential:
        """Wall and blood alone."""
        return self.keeping(lambda name: name not in OF_THE_CLAMP)

    @property
    def clamp(self) -> Potential:
        """Contact alone."""
        return self.keeping(lambda name: name in OF_THE_CLAMP)

    def changed(self, name: str, change: Callable[[Any], Any]) -> Potential:
        """The potential with what the terms of a name know of their points (`here`) changed."""

        def in_group(group: Group) -> Group:
            terms = tuple(
                dataclasses.replace(term, here=change(term.here)) if term.name == name else term
                for term in group.terms
            )
            return dataclasses.replace(group, terms=terms)

        return dataclasses.replace(self, groups=tuple(map(in_group, self.groups)))

    @property
    def data(self) -> tuple[tuple[tuple[Any, ...], Array | None], ...]:
        """The floats that a scene decides, by group: what terms know of their points, and M^-1."""
        return tuple(
            (tuple(term.here for term in group.terms), getattr(group.volume, "stiffness", None))
            for group in self.groups
        )

    def with_data(self, data: tuple[tuple[tuple[Any, ...], Array | None], ...]) -> Potential:
        """The potential with other floats, of the form of `data`."""

        def filled(group: Group, heres: tuple[Any, ...], stiffness: Array | None) -> Group:
            known = zip(group.terms, heres, strict=True)
            terms = tuple(dataclasses.replace(term, here=here) for term, here in known)
            volume = group.volume
            if volume is not None and stiffness is not None:
                volume = dataclasses.replace(volume, stiffness=stiffness)
            return dataclasses.replace(group, terms=terms, volume=volume)

        pairs = zip(self.groups, data, strict=True)
        return dataclasses.replace(self, groups=tuple(filled(group, *each) for group, each in pairs))

    def with_clamp_data(self, data: tuple[tuple[tuple[Any, ...], Array | None], ...]) -> Potential:
        """The potential with other floats in its contact terms, of the form of `clamp.data`."""
        return dataclasses.replace(self, groups=self.artery.groups + self.clamp.with_data(data).groups)

    def at_pressure(self, pressure: Array | float) -> Potential:
        """The potential with another blood pressure, kPa."""
        known = jnp.asarray(pressure, float)  # never of weak type: programs would be compiled once more
        return self.changed(BLOOD, lambda here: dataclasses.replace(here, pressure=known))


# --- the kinds of terms ---------------------------------------------------------------------------

SIDES = {"upper": 1, "lower": -1}
"""sign of y of each half of the circumference"""
BLOOD, JAWS, INTIMA, KEPT_VOLUME = "blood pressure", "jaw contact", "intima contact", "incompressibility"


@dataclasses.dataclass(frozen=True)
class Made:
    """A scene's wall on its mesh, ready for terms."""

    artery: Artery
    """of the scene"""
    clamp: Clamp
    """of the scene"""
    contact: Contact
    """of the scene"""
    settings: MeshSettings
    """of the scene"""
    body: Body
    """the wall"""
    stencils: Stencils
    """of its element"""
    sides: dict[str, np.ndarray]
    """facets of each half of the circumference that is modelled, by its name in `SIDES`; a facet stands where
    its mirror image stands in the other"""


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of term: why a scene needs it, and its terms."""

    reasons: Callable[[Scene], dict[str, str]]
    """name of each term -> why it is there; terms that the scene does not need are left out"""
    terms: Callable[[Made], Iterator[Term | Volume]]
    """for a discretised scene"""
    of_the_clamp: str | None = None
    """the term's name, if it is only there while the jaws close"""


KEPT = {
    "q1p0": "volume change averaged over each cell",
    "q1pz": "volume change averaged over each cell; its axial slope resisted softly",
    "q2p1": "pressure linear in each cell",
}
"""how the cells of each element keep their volume"""


def _wall_reasons(scene: Scene) -> dict[str, str]:
    return {
        f"wall: {layer.name}": f"layer with law '{layer.material.law}', stress-free as an open sector "
        "(residual stress needs no further term)"
        for layer in scene.artery.layers
    } | {KEPT_VOLUME: KEPT[scene.mesh.element]}


def _wall(made: Made) -> Iterator[Term | Volume]:
    names = [layer.name for layer in made.artery.layers]
    yield from wall_terms(made.body, made.stencils, names)


def wall_terms(body: Body, stencils: Stencils, names: Iterable[str]) -> Iterator[Term | Volume]:
    """The terms of a body, layer by layer."""
    known = zip(names, solids(body, stencils), body.mesh.layer_cells, strict=True)
    for number, (name, solid, cells) in enumerate(known):
        region, stiffness = f"layer {number}", pressure_stiffness(solid, stencils)
        yield Term(name=f"wall: {name}", region=region, stencil="cells", density=shape_energy, here=solid)
        yield Volume(name=KEPT_VOLUME, region=region, stencil="cells", cells=cells, stiffness=stiffness)


def _blood_reasons(scene: Scene) -> dict[str, str]:
    return {BLOOD: "follower load on the lumen, as enclosed volume"} if scene.artery.pressure != 0.0 else {}


def _blood(made: Made) -> Iterator[Term]:
    weights = jnp.asarray(made.stencils.lumen.weights)[:, None]
    here = Blood(pressure=jnp.asarray(made.artery.pressure), weights=weights)
    yield Term(name=BLOOD, region="lumen", stencil="lumen", density=blood_energy, here=here)


def _jaw_reasons(scene: Scene) -> dict[str, str]:
    shapes = " and ".join(f"'{jaw.shape}'" for jaw in scene.clamp.kinds.values())
    jaws = "jaw" if len(scene.clamp.kinds) == 1 else "jaws"
    return {JAWS: f"rigid {shapes} {jaws} against the outer wall, frictionless"}


def _jaws(made: Made) -> Iterator[Term]:
    areas = facet_areas(made.body, made.stencils.contact, outer=True)
    outer = closed_radii(made.body.mesh, made.settings, made.artery)[-1]
    placement, jaws = made.clamp.placement(outer), dict(zip(SIDES, made.clamp.jaws, strict=True))
    for name, facets in made.sides.items():
        here = Touch(
            jaw=jaws[name],
            placement=placement,
            contact=made.contact,
            dA=_some(areas, facets),
            rule=made.stencils.contact,
            side=SIDES[name],
        )
        yield Term(
            name=JAWS, region=f"{name} outside", stencil="contact", density=jaw_energy, here=here, moved=True
        )


def _intima_reasons(scene: Scene) -> dict[str, str]:
    if scene.stop.far_from_closure():
        return {}
    where = " in the plane of symmetry" if "y" in scene.clamp.planes else ""
    return {INTIMA: f"opposite inner walls meet{where} once the lumen closes"}


def _intima(made: Made) -> Iterator[Term]:
    areas, both = facet_areas(made.body, made.stencils.meeting, outer=False), "lower" in made.sides
    dA = _some(areas, made.sides["upper"])
    if both:  # a stress-free artery is its own mirror image
        dA = 0.5 * (dA + _some(areas, made.sides["lower"]))
    rule = made.stencils.meeting
    here = Meeting(contact=made.contact, dA=dA, rule=rule, plane=jnp.zeros(()), both=both)
    stencil = "meeting of both" if both else "meeting"
    yield Term(name=INTIMA, region="upper inside", stencil=stencil, density=intima_energy, here=here)


def _some(areas: Array, facets: np.ndarray) -> Array:
    return areas if len(facets) == areas.shape[1] else areas[:, facets]


KINDS = (
    Kind(_wall_reasons, _wall),
    Kind(_blood_reasons, _blood),
    Kind(_jaw_reasons, _jaws, of_the_clamp=JAWS),
    Kind(_intima_reasons, _intima, of_the_clamp=INTIMA),
)

OF_THE_CLAMP = tuple(kind.of_the_clamp for kind in KINDS if kind.of_the_clamp)
"""terms that are only there while the jaws close"""


def needed(scene: Scene, closing: bool = True, every_term: bool = False) -> dict[str, str]:
    """Name of every term that a scene needs, and why.

    closing: with those of the clamp; every_term: leave nothing of the clamp out because of the stop
    """
    kinds = [kind for kind in KINDS if closing or not kind.of_the_clamp]
    found = {name: reason for kind in kinds for name, reason in kind.reasons(scene).items()}
    if closing and every_term:
        unexpected = "needed on the way to the stop, although it seemed not to be"
        found = {**dict.fromkeys(OF_THE_CLAMP, unexpected), **found}
    return found


def all_terms(made: Made) -> tuple[Term | Volume, ...]:
    """Every term that a scene of this kind can have, needed or not: derivatives see them all."""
    return tuple(term for kind in KINDS for term in kind.terms(made))


def build_potential(
    terms: Iterable[Term | Volume], regions: dict[str, Region], stencils: Stencils, layout: Layout
) -> Potential:
    """Terms, grouped by the points that they share."""
    at: dict[str, Array | np.ndarray] = {
        "cells": stencils.cells,
        "lumen": stencils.lumen.surface,
        "contact": stencils.contact.position,
        "meeting": stencils.meeting.position,
        "meeting of both": stencils.meeting.of_two,
    }
    together: dict[tuple[str, str], list[Term | Volume]] = {}
    for term in terms:
        together.setdefault((term.region, term.stencil), []).append(term)

    def group(place: tuple[str, str], members: list[Term | Volume]) -> Group:
        region, volume = regions[place[0]], next((t for t in members if isinstance(t, Volume)), None)
        return Group(
            region=place[0],
            nodes=region.nodes,
            size=region.size,
            stencil=at[place[1]],
            terms=tuple(t for t in members if isinstance(t, Term)),
            volume=volume,
            modes=None if volume is None else stencils.modes,
        )

    return Potential(groups=tuple(group(*item) for item in together.items()), layout=layout)
