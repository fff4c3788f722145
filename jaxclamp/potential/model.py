"""What a scene needs: the modelled part, its unknowns, and the energy terms, each with its reason."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxclamp.core.records import record, shape_of
from jaxclamp.fem.tube import Mesh, axial_fractions, build_mesh
from jaxclamp.observe.stresses import Landmarks, find_landmarks
from jaxclamp.potential.densities import Parameters, Stencils, build_geometry, build_stencils
from jaxclamp.potential.tangent import Body, Pattern, Topology, build_topology, supported
from jaxclamp.scenes.scene import Scene
from jaxclamp.solve.linear_solvers import available

SYMMETRY = (
    "one eighth: a quarter of the circumference (planes x = 0 and y = 0) by half the length "
    "(plane z = 0), because both jaws are alike and the clamp sits in the middle"
)


@record
class Discretisation:
    """What a scene's static choices alone decide: integers and fixed fractions, no physics."""

    mesh: Mesh
    topology: Topology
    stencils: Stencils
    marks: Landmarks


@dataclasses.dataclass(frozen=True)
class Model:
    """A scene made ready to compute with."""

    scene: Scene
    discretisation: Discretisation
    pattern: Pattern
    body: Body

    @property
    def mesh(self) -> Mesh:
        return self.discretisation.mesh

    @property
    def marks(self) -> Landmarks:
        return self.discretisation.marks

    @property
    def half_length(self) -> float:
        """Load-free length of the modelled part, mm."""
        return 0.5 * float(self.scene.artery.length)


def discretise(scene: Scene) -> tuple[Discretisation, Pattern]:
    """Mesh, sparse pattern and landmarks of a scene's static choices."""
    mesh = build_mesh(scene.mesh)
    topology, pattern = build_topology(mesh)
    marks = find_landmarks(mesh, tuple(layer.name for layer in scene.artery.layers))
    stencils = build_stencils(mesh, scene.mesh)
    topology, stencils = jax.tree_util.tree_map(jnp.asarray, (topology, stencils))
    return Discretisation(mesh=mesh, topology=topology, stencils=stencils, marks=marks), pattern


def body_of(scene: Scene, discretisation: Discretisation) -> Body:
    """The body of a scene; a JAX function of every float in it."""
    parameters = Parameters(
        materials=tuple(layer.material for layer in scene.artery.layers),
        contact=scene.contact,
        jaw=scene.clamp.jaw,
    )
    return Body(
        topology=discretisation.topology,
        stencils=discretisation.stencils,
        geometry=build_geometry(discretisation.mesh, scene.mesh, scene.artery),
        parameters=parameters,
    )


def build_model(scene: Scene, like: Model | None = None) -> Model:
    """A scene made ready to compute with.

    like: a model whose discretisation is reused if the scene's static choices are the same.
    """
    if like is not None and same_kind(scene, like.scene):
        discretisation, pattern = like.discretisation, like.pattern
    else:
        discretisation, pattern = discretise(scene)
    # float64 arrays, as in derivatives: Python's floats would make JAX compile everything once more
    floats = jax.tree_util.tree_map(lambda leaf: jnp.asarray(leaf, jnp.float64), scene)
    return Model(scene, discretisation, pattern, body_of(floats, discretisation))


def same_kind(a: Scene, b: Scene) -> bool:
    """True if two scenes differ in floats, title and solver settings only."""
    kinds = [shape_of(dataclasses.replace(s, title="", solver=a.solver), np.shape) for s in (a, b)]
    return bool(kinds[0] == kinds[1])


def terms(scene: Scene) -> dict[str, str]:
    """The energy terms of the model and why each is there."""
    found = {
        f"wall: {layer.name}": f"layer with law '{layer.material.law}', stress-free as an open sector "
        "(residual stress needs no further term)"
        for layer in scene.artery.layers
    }
    found["incompressibility"] = (
        "volume change averaged over each cell"
        if scene.mesh.element == "q1p0"
        else "pressure linear in each cell"
    )
    if float(scene.artery.pressure) != 0.0:
        found["blood pressure"] = "follower load on the lumen, as enclosed volume"
    found["lumen contact"] = "opposite inner walls meet in the plane of symmetry once the lumen closes"
    found["jaw contact"] = f"rigid '{scene.clamp.jaw.shape}' jaw against the outer wall, frictionless"
    return found


USUAL_ITERATIONS = 90
"""Newton iterations of a whole clamping, on any mesh"""
START_SECONDS = 8.0
"""compilation and output, s"""
ITERATION_SECONDS, ITERATION_EXPONENT = 8.2e-7, 1.33
"""time of an iteration: factor times unknowns to the exponent, s (fitted to two meshes)"""
START_MEMORY, MEMORY_PER_UNKNOWN = 500.0, 0.025
"""MB: Python with the compiled programs, and what the factors add (the same two meshes)"""


def describe(scene: Scene) -> dict[str, Any]:
    """What would be modelled, and what it would cost; solves nothing."""
    mesh = build_mesh(scene.mesh)
    unknowns = 3 * mesh.n_nodes - int(supported(mesh).sum())
    return {
        "symmetry": SYMMETRY,
        "layers": {
            layer.name: f"{layer.material.law}, {count} elements through the thickness"
            for layer, count in zip(scene.artery.layers, scene.mesh.radial, strict=True)
        },
        "terms": terms(scene),
        "element": scene.mesh.element,
        "elements": mesh.n_cells,
        "unknowns": unknowns,
        "stop": scene.stop.kind,
        "continuation": scene.solver.continuation,
        "linear_solver": available(unknowns)[0]
        if scene.solver.linear_solver == "auto"
        else scene.solver.linear_solver,
        "predicted_seconds": _rounded(
            START_SECONDS + USUAL_ITERATIONS * ITERATION_SECONDS * unknowns**ITERATION_EXPONENT
        ),
        "predicted_memory_MB": _rounded(START_MEMORY + MEMORY_PER_UNKNOWN * unknowns),
        "warnings": warnings(scene, mesh),
    }


def _rounded(estimate: float) -> float:
    """Two significant digits: it is no more than an estimate."""
    return float(f"{estimate:.2g}")


def warnings(scene: Scene, mesh: Mesh) -> list[str]:
    """What the mesh cannot resolve."""
    heights = 0.5 * float(scene.artery.length) * np.asarray(axial_fractions(mesh, scene.mesh))
    jaw = scene.clamp.jaw
    under = heights[:-1] <= float(jaw.half_extent())
    widest = float(np.max(np.diff(heights)[under])) * float(scene.artery.axial_stretch)
    radius = float(jaw.least_radius())
    if widest > radius:
        return [
            f"the jaw's least radius of curvature is {radius:.3g} mm, and the facets under it are up to "
            f"{widest:.3g} mm long: stress at its edges is not resolved "
            "(use more axial elements, or a larger radius)"
        ]
    return []
