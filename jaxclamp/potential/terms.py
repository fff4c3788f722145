"""The list of terms: the potential of a scene is their sum, and everything else loops over them.

    Pi(x, p; q) = sum_cells int [psi_bar(F) + p (J - 1)] dV - 1/2 p' M p      wall, incompressibility
                  - pressure * V_lumen(x)                                     blood pressure
                  + int phi(gap(x; q)) dA                                     jaw contact
                  + int phi(gap between the walls) dA                         intima contact
                  + side force * mean x at mid-length                         hold sideways

of the modelled part, with one, two or four pressures p per cell and M = int N_m N_n / bulk dV, so that at
equilibrium p = bulk (J - 1) averaged over the cell (mean dilatation, Q1/P0) or projected on the linear
functions (Q2/P1); q are the rigid coordinates (`densities.RIGID`).

A term says where it lives (a region of the mesh), what it looks at there (a stencil), and its density.
Terms of one region and stencil form a group: they are differentiated together. `potential.kinds` makes them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.records import record, static
from jaxclamp.fem.pattern import Layout, Region
from jaxclamp.fem.stencils import Stencils
from jaxclamp.potential.densities import (
    Density,
)

SIDES = {"upper": 1, "lower": -1}
"""sign of y of each half of the circumference"""
BLOOD, JAWS, INTIMA, KEPT_VOLUME = "blood pressure", "jaw contact", "intima contact", "incompressibility"
SIDE = "hold sideways"
OF_THE_CLAMP = (JAWS, INTIMA, SIDE)
"""terms that are only there while the jaws close"""


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
        "nodes": np.ones((1, 1, 1)),
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
