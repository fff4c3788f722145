"""What a scene would be modelled as, and what it would cost: said before anything is solved."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxclamp.fem.symmetry import symmetry_of
from jaxclamp.fem.tube import axial_fractions, build_tube, end_height
from jaxclamp.potential.kinds import needed
from jaxclamp.scenes.fitting import fitting_contact
from jaxclamp.scenes.notes import notes
from jaxclamp.scenes.scene import Scene
from jaxclamp.solve.linear_solvers import available
from jaxclamp.solve.memory import coarser_unknowns, predicted_MB, unknowns_of

USUAL_ITERATIONS = 90
"""Newton iterations of a whole clamping, on any mesh"""
START_SECONDS = 8.0
"""compilation and output, s"""
ITERATION_SECONDS, ITERATION_EXPONENT = 8.2e-7, 1.33
"""time of an iteration: factor times unknowns to the exponent, s (fitted to two meshes)"""


def describe(scene: Scene) -> dict[str, Any]:
    """What would be modelled, and what it would cost (s, MB); solves nothing.

    `symmetry` is the modelled share of the artery, `modelled` says it in words.
    """
    symmetry, mesh = symmetry_of(scene.mesh, scene.clamp), build_tube(scene.mesh, scene.clamp)
    solver = scene.solver
    unknowns = unknowns_of(scene)
    seconds = START_SECONDS + USUAL_ITERATIONS * ITERATION_SECONDS * unknowns**ITERATION_EXPONENT
    return {
        "symmetry": symmetry.share,
        "modelled": symmetry.words,
        "layers": {
            layer.name: f"{layer.material.law}, {count} elements through the thickness"
            for layer, count in zip(scene.artery.layers, scene.mesh.radial, strict=True)
        },
        "terms": needed(scene),
        "element": scene.mesh.element,
        "elements": mesh.n_cells,
        "unknowns": unknowns,
        "stop": scene.stop.kind,
        "contact": contact(scene),
        "continuation": solver.continuation,
        "linear_solver": available(unknowns)[0] if solver.linear_solver == "auto" else solver.linear_solver,
        "predicted_seconds": _rounded(seconds),
        "predicted_memory_MB": _rounded(predicted_MB(unknowns, coarser_unknowns(scene))),
        "warnings": warnings(scene),
        "notes": notes(scene),
    }


def contact(scene: Scene) -> str:
    """The contact law in words, beside the one that fits the wall (`docs/contact.md`)."""
    fits, stated = fitting_contact(scene.artery), scene.contact
    law, other = (
        f"{float(c.stiffness):.4g} kPa/mm, smoothed over {float(c.smoothing):.3g} mm" for c in (stated, fits)
    )
    rule = "(c + p) over 1 % of the wall's thickness, smoothed over 1 % of it"
    return f"{law}: fits the wall, {rule}" if stated == fits else f"{law}, as stated (by the wall: {other})"


def _rounded(estimate: float) -> float:
    """Two significant digits: it is no more than an estimate."""
    return float(f"{estimate:.2g}")


def warnings(scene: Scene) -> list[str]:
    """What the mesh cannot resolve, a sentence each."""
    artery, said = scene.artery, []
    lines = np.asarray(axial_fractions(build_tube(scene.mesh, scene.clamp), scene.mesh))
    heights = float(end_height(artery, 1.0)) * lines  # load-free, from one end or the middle to the other end
    for name, jaw in scene.clamp.kinds.items():
        under = np.minimum(np.abs(heights[:-1]), np.abs(heights[1:])) <= float(jaw.half_extent())
        widest = float(np.max(np.diff(heights)[under])) * float(artery.axial_stretch)
        radius, whose = float(jaw.least_radius()), {"jaw": "the jaw's"}.get(name, f"the {name} jaw's")
        if widest > radius:
            said.append(
                f"{whose} least radius of curvature is {radius:.3g} mm, and the facets under it are up to "
                f"{widest:.3g} mm long: stress at its edges is not resolved "
                "(use more axial elements, or a larger radius)"
            )
    return said
