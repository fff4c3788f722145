"""What a scene needs: the modelled part, its unknowns, and the energy terms, each with its reason."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from jaxclamp.assembly import Body, Pattern, build_topology
from jaxclamp.energies import Parameters, build_geometry, build_stencils
from jaxclamp.measures import Landmarks, find_landmarks
from jaxclamp.meshes import Mesh, build_mesh
from jaxclamp.pytree import shape_of
from jaxclamp.scene import Scene

SYMMETRY = (
    "one eighth: a quarter of the circumference (planes x = 0 and y = 0) by half the length "
    "(plane z = 0), because both jaws are alike and the clamp sits in the middle"
)


@dataclasses.dataclass(frozen=True)
class Model:
    """A scene made ready to compute with."""

    scene: Scene
    mesh: Mesh
    pattern: Pattern
    body: Body
    marks: Landmarks

    @property
    def half_length(self) -> float:
        """Load-free length of the modelled part, mm."""
        return 0.5 * float(self.scene.artery.length)


def build_model(scene: Scene, like: Model | None = None) -> Model:
    """Mesh, sparse pattern and stress-free geometry of a scene.

    like: a model whose integers are reused if the scene's static choices are the same.
    """
    if like is not None and shape_of(scene)[0] == shape_of(like.scene)[0]:
        body = dataclasses.replace(
            like.body,
            geometry=build_geometry(like.mesh, scene.mesh, scene.artery),
            parameters=_parameters(scene),
        )
        return dataclasses.replace(like, scene=scene, body=body)
    mesh = build_mesh(scene.mesh)
    topology, pattern = build_topology(mesh)
    body = Body(
        topology=topology,
        stencils=build_stencils(mesh, scene.mesh),
        geometry=build_geometry(mesh, scene.mesh, scene.artery),
        parameters=_parameters(scene),
    )
    body = jax.tree_util.tree_map(jnp.asarray, body)
    names = tuple(layer.name for layer in scene.artery.layers)
    return Model(scene, mesh, pattern, body, find_landmarks(mesh, names))


def _parameters(scene: Scene) -> Parameters:
    parameters = Parameters(
        materials=tuple(layer.material for layer in scene.artery.layers),
        contact=scene.contact,
        jaw=scene.clamp.jaw,
    )
    return jax.tree_util.tree_map(jnp.asarray, parameters)


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
    found["jaw contact"] = f"rigid '{scene.clamp.jaw.shape}' jaw against the outer wall, frictionless"
    return found
