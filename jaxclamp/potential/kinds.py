"""The kinds of terms: why a scene needs each, and how it is made of a discretised scene.

To add a term, write its density (`potential.densities`) and one entry of `KINDS`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.fem.stencils import Stencils
from jaxclamp.fem.symmetry import Symmetry, symmetry_of
from jaxclamp.fem.tube import closed_radii
from jaxclamp.physics.contact import Contact
from jaxclamp.potential.bodies import Body, facet_areas, pressure_stiffness, solids
from jaxclamp.potential.densities import (
    Blood,
    Hold,
    Meeting,
    Touch,
    blood_energy,
    intima_energy,
    jaw_energy,
    shape_energy,
    side_energy,
)
from jaxclamp.potential.terms import (
    BLOOD,
    INTIMA,
    JAWS,
    KEPT_VOLUME,
    OF_THE_CLAMP,
    SIDE,
    SIDES,
    Term,
    Volume,
)
from jaxclamp.scenes.scene import Artery, Clamp, MeshSettings, Scene


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
            floats=len(made.sides) > 1,
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


def _side_reasons(scene: Scene) -> dict[str, str]:
    if "x" in symmetry_of(scene.mesh, scene.clamp):
        return {}
    return {SIDE: "the section at mid-length stays in its place on average: nothing rubs, jaws push it aside"}


def _side(made: Made) -> Iterator[Term]:
    symmetry = Symmetry(made.body.mesh.planes)
    place, n = symmetry.rigid_place("side_force"), made.body.mesh.grid[0] * made.body.mesh.grid[1]
    if place is not None:
        here = Hold(share=jnp.full((1, 1), 1.0 / n), place=place)
        yield Term(
            name=SIDE, region="mid-length", stencil="nodes", density=side_energy, here=here, moved=True
        )


def _some(areas: Array, facets: np.ndarray) -> Array:
    return areas if len(facets) == areas.shape[1] else areas[:, facets]


KINDS = (
    Kind(_wall_reasons, _wall),
    Kind(_blood_reasons, _blood),
    Kind(_jaw_reasons, _jaws, of_the_clamp=JAWS),
    Kind(_intima_reasons, _intima, of_the_clamp=INTIMA),
    Kind(_side_reasons, _side, of_the_clamp=SIDE),
)


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
