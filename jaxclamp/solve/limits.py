"""Where a clamped state is no longer what the model means: bodies that sink into each other."""

from __future__ import annotations

from jaxclamp.observe.figures import NODES_SUNK, Record

ROUNDING = 1e-9
"""overlap of opposite inner walls, as part of the lumen radius, that is none: nodes on the fold lie at 0"""
LARGEST_SINKING = 0.5
"""jaw and wall, or opposite inner walls, may overlap by this part of the wall's thickness"""
CRUMPLED = (0.4, 1.8)
"""volume of a point over that of its cell, away from the fold; seen: 0.6 to 1.4 on meshes that resolve it,
0.5 to 1.6 with one cell through a thick layer, beyond 2.3 where cells fold up in themselves"""


def walls_meet(values: Record, lumen_radius: float) -> bool:
    """True if opposite inner walls overlap; lumen_radius: in the body, mm."""
    return bool(values["lumen_overlap_mm"] > ROUNDING * lumen_radius)


def crumpled(values: Record) -> str | None:
    """What tells that a converged state is one of crumpled cells, and what to do; None if nothing does."""
    least, most = values["J_min_away_from_fold"], values["J_max_away_from_fold"]
    if least < CRUMPLED[0] or most > CRUMPLED[1]:
        return (
            f"cells crumple (J is {least:.2g} to {most:.2g} of a cell's, away from the fold): refine the mesh"
        )
    return None


def sinking(values: Record, thickness: float) -> str | None:
    """What sinks into what, and what to do; None if nothing does. thickness: of the wall in the body, mm."""
    if values["max_penetration_mm"] > LARGEST_SINKING * thickness:
        return "the jaws sink into the wall: raise contact.stiffness_kPa_per_mm"
    if values["lumen_overlap_mm"] > LARGEST_SINKING * thickness:
        return "the inner walls sink into each other: raise contact.stiffness_kPa_per_mm"
    if values[NODES_SUNK] > LARGEST_SINKING * thickness:
        return "the jaw sinks in between the contact points of the wall: refine the mesh under it"
    return None
