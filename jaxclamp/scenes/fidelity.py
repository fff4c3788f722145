"""Fidelities: a mesh by one word, and the errors that were measured with it on one scene."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from jaxclamp.scenes.scene import Artery

COUNTS = ("circumferential", "axial", "radial")
"""the keys of a mesh that a fidelity decides"""

FIDELITIES = {
    "draft": (10, 10, 5),
    "standard": (14, 15, 8),
    "reference": (28, 36, 16),
    "seed": (10, 15, 8),
}
"""elements over the quarter circumference, over the half length, through the wall"""

SEED = {"element": "q1p0", "circumferential_grading": 0.0, "radial_grading": 0.0}
"""what else the mesh of the study of 2002 has: uniform round the artery and through its layers, one pressure
per cell"""

RADIAL_GRADING = 5.0
"""how much the elements of layers are drawn together towards the layer inside, where each is softer than that
one: its fibres stiffen within a twelfth of its thickness there (docs/trust.md)"""

ERRORS_ON_HUMAN_LAD = {
    name: dict(zip(("smooth axial peak", "jaw force", "stress at P", "lumen radius"), errors, strict=True))
    for name, errors in {
        "draft": (0.04, 0.03, 0.05, 0.002),
        "standard": (0.03, 0.015, 0.025, 0.002),
        "reference": (0.01, 0.005, 0.004, 0.002),
        "seed": (0.02, 0.03, 0.03, 0.002),
    }.items()
}
"""relative errors measured on human-lad, rounded: docs/trust.md; the peak is the media's. On other scenes the
stress at P has been off by up to 36 %: what counts is the estimate of a result's errors"""


def mesh_for(fidelity: str, artery: Artery, own: dict[str, Any] | None = None) -> dict[str, Any]:
    """The mesh of a fidelity as a table, with the keys that a scene has of its own.

    The radial elements are shared out by the layers' thickness.
    """
    circumferential, axial, radial = FIDELITIES[fidelity]
    if fidelity == "reference":
        counts = [2 * count for count in mesh_for("standard", artery)["radial"]]
    else:
        counts = list(_shares(radial, [float(layer.thickness) for layer in artery.layers]))
    mesh = dict(zip(COUNTS, (circumferential, axial, counts), strict=True)) | (own or {})
    round_, through = grading(mesh["circumferential"]), radial_grading(artery)
    gradings = {"circumferential_grading": round_, "radial_grading": through}
    return gradings | (SEED if fidelity == "seed" else {}) | mesh


def grading(circumferential: Any) -> float:
    """How much a mesh is drawn together towards the fold, by its elements over the quarter circumference.

    With fewer than ten an element would cover more than 19 degrees on the other side.
    """
    return 2.0 if isinstance(circumferential, int) and circumferential >= 10 else 0.0


def radial_grading(artery: Artery) -> float:
    """How much the elements of all layers but the innermost are drawn together towards the layer inside."""
    c = [float(np.max(np.asarray(layer.material.c))) for layer in artery.layers]
    return RADIAL_GRADING if all(b < a for a, b in itertools.pairwise(c)) and len(c) > 1 else 0.0


def _shares(total: int, sizes: list[float]) -> tuple[int, ...]:
    """`total` shared out in proportion to `sizes`, by largest remainder, at least one each."""
    quotas = [total * size / sum(sizes) for size in sizes]
    counts = [int(quota) for quota in quotas]
    by_remainder = sorted(range(len(sizes)), key=lambda i: counts[i] - quotas[i])
    for i in by_remainder[: total - sum(counts)]:
        counts[i] += 1
    return tuple(max(1, count) for count in counts)
