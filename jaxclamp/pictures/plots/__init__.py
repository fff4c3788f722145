"""Figures of a clamping: each a function of the result that returns a matplotlib figure.

Figures touch no global state of matplotlib. `figures(result)` makes all that the result allows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from jaxclamp.pictures.plots.curves import plot_force_travel, plot_stress_at_P
from jaxclamp.pictures.plots.maps import plot_axial_stress_maps, plot_damage_maps
from jaxclamp.pictures.plots.sections import plot_sections
from jaxclamp.pictures.plots.states import Clamped
from jaxclamp.pictures.plots.style import Picture, png, svg
from jaxclamp.pictures.plots.wall import plot_wall_stress

__all__ = [
    "Picture",
    "Plate",
    "figures",
    "plot_axial_stress_maps",
    "plot_damage_maps",
    "plot_force_travel",
    "plot_sections",
    "plot_stress_at_P",
    "plot_wall_stress",
    "png",
    "svg",
]


@dataclasses.dataclass(frozen=True)
class Plate:
    """A figure with its name (of a file, without suffix), title and caption."""

    name: str
    title: str
    caption: str
    figure: Picture


STEP = (
    "Where the closing path was walked on a coarser mesh, the curve is that mesh's alone, and filled "
    "marks beside it are of the scene's own: the step between them is what the mesh changes."
)
PLATES = (
    (
        "wall_stress",
        "Stress through the wall",
        "Circumferential and axial Cauchy stress along the compression axis at mid-length, "
        "extrapolated to the nodes and averaged within each layer: residual stress alone (left), "
        "and under blood pressure and axial stretch (right).",
        plot_wall_stress,
    ),
    (
        "sections",
        "Deformed sections",
        "Cross-section at mid-length and section along the artery, with the elements and the jaws, "
        "from the artery in the body (A) to the last state.",
        plot_sections,
    ),
    (
        "stress_at_P",
        "Stress at P",
        "Axial and circumferential stress at P, the inner surface under the middle of the jaw, over "
        f"their values in the body; letters mark the sections shown. {STEP}",
        plot_stress_at_P,
    ),
    (
        "axial_stress_maps",
        "Axial stress in the layers",
        "Axial Cauchy stress in the last state: each layer unrolled, with the highest value through "
        "its thickness (left; a cross marks the highest of all), and as it lies under the jaw (right). "
        "Arrows on the bar of colours: a small part of a layer, mostly where the mesh is too coarse for a "
        "fold, has stresses beyond them.",
        plot_axial_stress_maps,
    ),
    (
        "damage_maps",
        "Damage of the layers",
        "Damage in the last state, as above: the share of its strain energy that a point would lose by a law "
        "that begins at the energy in the body (docs/injury.md). Post-processed: the wall does not soften. A "
        "scale to compare clamps on, not a verdict.",
        plot_damage_maps,
    ),
    (
        "force_travel",
        "Force and occlusion",
        "Force on one jaw, and occlusion of the lumen by height and by area, against the travel of "
        f"each jaw from first contact. {STEP}",
        plot_force_travel,
    ),
)


def figures(result: Clamped) -> Iterator[Plate]:
    """Every figure that the converged states allow, one at a time."""
    for name, title, caption, draw in PLATES:
        needs_clamping = draw is not plot_wall_stress
        if result.load_free is None or (needs_clamping and result.physiological is None):
            continue
        yield Plate(name, title, caption, draw(result))
