"""Nested meshes: the closing path is walked on a coarser mesh, the stop is found on the scene's own.

A closing takes some 70 Newton iterations; carried over to a mesh of twice the elements per direction, its
end takes 5 to 10 there. So the path is walked on the coarsest mesh that still bends as the wall does, and the
stop is solved for on the mesh that was asked for, from the coarser mesh's solution.
"""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from jaxclamp.scenes.scene import MeshSettings, Scene

COARSENINGS = (1.3, 2.0)
"""elements of a mesh over elements of the one before it in the chain, per direction"""
LEAST_CELLS = 280
"""a mesh of fewer elements carries no closing path: walls crumple on it that do not on finer ones"""
NEAR = 0.06
"""how far a state at the stop may be from the coarser mesh's, as part of the lumen's width there; seen: 0.02
on one path, 0.1 and more between two equilibria"""


def coarser(mesh: MeshSettings) -> tuple[MeshSettings, float]:
    """A mesh coarsened as evenly in all directions as whole numbers allow, and by how much per direction."""
    counts = np.array([mesh.circumferential, mesh.axial, *mesh.radial], float)
    least = np.array([2, 2, *[1] * len(mesh.radial)])

    def unevenness(factor: float) -> float:
        return float(np.ptp(np.log(counts / np.maximum(np.round(counts / factor), least))))

    factor = min(np.linspace(*COARSENINGS, 71), key=unevenness)
    fewer = np.maximum(np.round(counts / factor), least).astype(int).tolist()
    coarse = dataclasses.replace(mesh, circumferential=fewer[0], axial=fewer[1], radial=tuple(fewer[2:]))
    return coarse, (cells(mesh) / cells(coarse)) ** (1.0 / 3.0)


def cells(mesh: MeshSettings) -> int:
    """Elements of a quarter circumference and half the length."""
    return mesh.circumferential * mesh.axial * sum(mesh.radial)


def on_coarser_mesh(scene: Scene) -> Scene | None:
    """The scene on a coarser mesh; None where its constants are those of each point of its mesh."""
    if any(np.ndim(leaf) > 1 for leaf in jax.tree_util.tree_leaves(scene.artery)):
        return None
    return dataclasses.replace(scene, mesh=coarser(scene.mesh)[0])


def to_walk_on(scene: Scene) -> Scene | None:
    """The scene on the mesh before its own, towards that of its closing path; None where that is its own."""
    coarse = on_coarser_mesh(scene) if scene.solver.path_mesh == "coarser" else None
    return coarse if coarse is not None and cells(coarse.mesh) >= LEAST_CELLS else None
