"""A scene made ready to compute with: the modelled part, its unknowns, and the terms of its potential."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.programs import forget_if_crowded
from jaxclamp.core.records import record, shape_of
from jaxclamp.fem.grid import Mesh
from jaxclamp.fem.landmarks import Landmarks, find_landmarks
from jaxclamp.fem.pattern import FACETS_PER_BLOCK, Layout, Pattern, Region, block_size, build_pattern
from jaxclamp.fem.stencils import Stencils, build_stencils
from jaxclamp.fem.symmetry import Symmetry
from jaxclamp.fem.tube import build_tube, end_height, end_lines, middle_line, supports
from jaxclamp.physics.contact import Contact
from jaxclamp.potential.bodies import tube_body
from jaxclamp.potential.kinds import Made, all_terms, needed
from jaxclamp.potential.terms import Potential, Term, Volume, build_potential
from jaxclamp.scenes.scene import Artery, Clamp, MeshSettings, Scene


@record
class Discretisation:
    """What a scene's static choices alone decide: integers and fixed fractions, no physics."""

    mesh: Mesh
    """of the modelled part"""
    stencils: Stencils
    """of its element"""
    layout: Layout
    """of the unknowns"""
    regions: dict[str, Region]
    """where terms live, by name"""
    sides: dict[str, np.ndarray]
    """facets of the upper and (where it is modelled) the lower half"""
    marks: Landmarks
    """where figures are read"""


@dataclasses.dataclass(frozen=True)
class Model:
    """A scene made ready to compute with."""

    scene: Scene
    """what it was made of"""
    discretisation: Discretisation
    """of its static choices"""
    pattern: Pattern
    """of the sparse tangent"""
    potential: Potential
    """with every term, needed or not: derivatives see them all"""

    @property
    def mesh(self) -> Mesh:
        """The mesh of the modelled part."""
        return self.discretisation.mesh

    @property
    def marks(self) -> Landmarks:
        """The places where figures are read."""
        return self.discretisation.marks

    @property
    def symmetry(self) -> Symmetry:
        """The mirror planes in use."""
        return self.marks.symmetry

    def end_height(self, axial_stretch: float) -> float:
        """Distance of the artery's ends from mid-length at a stretch, mm."""
        return float(end_height(self.scene.artery, axial_stretch))

    def solved(self, closing: bool, every_term: bool = False) -> Potential:
        """The terms that an equilibrium needs, with or without the clamp; see `terms.needed`."""
        names = needed(self.scene, closing, every_term)
        return self.potential.keeping(lambda name: name in names)


def discretise(scene: Scene) -> tuple[Discretisation, Pattern]:
    """Mesh, sparse pattern and landmarks of a scene's static choices."""
    forget_if_crowded()  # another mesh brings other programs
    mesh = build_tube(scene.mesh, scene.clamp)
    stencils = build_stencils(mesh.element, scene.mesh.contact_points)
    symmetry, sides = Symmetry(mesh.planes), _sides(mesh, scene.mesh)
    size = block_size(len(stencils.weights))
    nodes = {f"layer {i}": (mesh.cells[:, slice(*span)], size) for i, span in enumerate(mesh.layer_cells)}
    nodes["lumen"] = (mesh.inner_facets, FACETS_PER_BLOCK)
    for name, facets in sides.items():
        nodes[f"{name} outside"] = (mesh.outer_facets[:, facets], FACETS_PER_BLOCK)
    meeting = mesh.inner_facets[:, sides["upper"]]
    if "lower" in sides:  # opposite walls, node by node: the lower facets' run the other way round
        order = mesh.element.order
        mirrored = np.flip(np.arange((order + 1) ** 2).reshape(order + 1, order + 1), axis=0).ravel()
        meeting = np.concatenate([meeting, mesh.inner_facets[mirrored][:, sides["lower"]]])
    nodes["upper inside"] = (meeting, FACETS_PER_BLOCK)
    if "x" not in symmetry:
        nodes["mid-length"] = (mesh.plane(2, middle_line(mesh, scene.mesh))[None], FACETS_PER_BLOCK)
    layout, regions, pattern = build_pattern(
        supports(mesh, scene.mesh), nodes, len(symmetry.rigid_coordinates)
    )
    marks = find_landmarks(mesh, scene.mesh, tuple(layer.name for layer in scene.artery.layers))
    layout, regions = jax.device_put((layout, regions))
    return Discretisation(
        mesh=mesh, stencils=stencils, layout=layout, regions=regions, sides=sides, marks=marks
    ), pattern


def _sides(mesh: Mesh, settings: MeshSettings) -> dict[str, np.ndarray]:
    """Facets of the upper half and, where it is modelled, their mirror images in the lower one."""
    first, last = Symmetry(mesh.planes).quarters
    quarter = first + np.arange((last - first) * settings.circumferential) // settings.circumferential
    facets = np.arange(mesh.inner_facets.shape[1]).reshape(-1, len(quarter))
    upper = np.isin(quarter, (0, 1))
    found = {"upper": facets[:, upper].ravel()}
    if not np.all(upper):  # the fold is in the middle of the quarters, or where they close
        found["lower"] = facets[:, ::-1][:, upper].ravel()
    return found


def potential_of(scene: Scene, discretisation: Discretisation) -> Potential:
    """The potential of a scene with all its terms; a JAX function of every float in it."""
    return _potential(_terms_in_a_program, scene, discretisation)


def _potential(terms: Terms, scene: Scene, d: Discretisation) -> Potential:
    found = terms(scene.artery, scene.clamp, scene.contact, scene.mesh, d)
    return build_potential(found, d.regions, d.stencils, d.layout)


def _terms(
    artery: Artery, clamp: Clamp, contact: Contact, settings: MeshSettings, d: Discretisation
) -> tuple[Term | Volume, ...]:
    body = tube_body(d.mesh, d.stencils, settings, artery)
    return all_terms(Made(artery, clamp, contact, settings, body, d.stencils, d.sides))


Terms = Callable[[Artery, Clamp, Contact, MeshSettings, Discretisation], tuple[Term | Volume, ...]]
_terms_in_a_program = jax.jit(_terms)
# called once for a scene, it is compiled for a short compilation rather than for speed
_terms_of_a_scene = jax.jit(_terms, compiler_options={"xla_backend_optimization_level": 0})


def positions(scene: Scene, discretisation: Discretisation, free: Array) -> Array:
    """Positions of all nodes, mm, (n_nodes, 3): the free ones (n_free,), the planes and the moved ends."""
    mesh, layout = discretisation.mesh, discretisation.layout
    end = end_height(scene.artery, scene.artery.axial_stretch)
    held = jnp.zeros((layout.n_nodes, 3))
    for line in end_lines(mesh):
        held = held.at[mesh.plane(2, line), 2].set(end if line == -1 else -end)
    return held.ravel().at[layout.free].set(free).reshape(layout.n_nodes, 3)


def build_model(scene: Scene, like: Model | None = None) -> Model:
    """A scene made ready to compute with.

    like: a model whose discretisation is reused if the scene's static choices are the same.
    """
    if like is not None and same_kind(scene, like.scene):
        discretisation, pattern = like.discretisation, like.pattern
    else:
        discretisation, pattern = discretise(scene)
    # float64 arrays, as in derivatives: Python's floats would make JAX compile everything once more
    floats = jax.tree_util.tree_map(lambda leaf: np.asarray(leaf, float), scene)
    return Model(scene, discretisation, pattern, _potential(_terms_of_a_scene, floats, discretisation))


def bare(scene: Scene) -> Scene:
    """The scene without title, solver and sources: programs that take it are not compiled anew for those."""
    plain = dataclasses.replace(scene.solver, tolerance=0.0, continuation="", path_mesh="", linear_solver="")
    injury = tuple(given.unsourced for given in scene.injury)
    return dataclasses.replace(scene, title="", solver=plain, injury=injury)


def same_kind(a: Scene, b: Scene) -> bool:
    """True if two scenes differ in floats, title, solver settings and thresholds only."""
    alike = lambda s: dataclasses.replace(s, title="", solver=a.solver, injury=())  # noqa: E731
    kinds = [shape_of(alike(s), np.shape) for s in (a, b)]
    return bool(kinds[0] == kinds[1])
