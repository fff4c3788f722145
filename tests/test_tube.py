"""The finite-element tube against the semi-analytic one: radius and stresses, order by order."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest
from tube import ADVENTITIA, MEDIA, RING, SEED, SEED_PRESSURE, SEED_STRETCH, Compressible, Incompressible, Sector
from walks import inflate, mesh, tube_scene

from jaxclamp.measures import stresses
from jaxclamp.meshes import stress_free_positions

BULK = 1e4

# Two meshes per element, the second halved in the radial and circumferential directions together;
# the axial direction is uniform and has nothing to resolve.
MESHES = {
    "q1p0": (mesh("q1p0", 8, 2, (4, 2), axial_grading=0.0), mesh("q1p0", 16, 2, (8, 4), axial_grading=0.0)),
    "q2p1": (mesh("q2p1", 10, 1, (2, 2), axial_grading=0.0), mesh("q2p1", 20, 1, (4, 4), axial_grading=0.0)),
}


def cut(sector: Sector, share: float) -> tuple[Sector, Sector]:
    """One layer written as two of the same sector."""
    inner = dataclasses.replace(sector, thickness=share * sector.thickness)
    outer = dataclasses.replace(
        sector, inner_radius=inner.outer_radius, thickness=(1.0 - share) * sector.thickness
    )
    return inner, outer


def drawn(seed: int) -> tuple[tuple[Sector, Sector], float, float]:
    """Two layers that fit round each other within 3 %, pressure and stretch, at random."""
    rng = np.random.default_rng(seed)

    def material() -> tuple[float, float, float, float]:
        return rng.uniform(10.0, 60.0), rng.uniform(0.5, 8.0), rng.uniform(1.0, 10.0), rng.uniform(5.0, 50.0)

    inner = Sector(rng.uniform(2.0, 4.0), rng.uniform(0.3, 0.6), rng.uniform(0.0, 160.0), *material())
    closed_outer = (inner.inner_radius + 0.5 * inner.thickness) / inner.k + 0.5 * inner.thickness
    angle, thickness = rng.uniform(0.0, 160.0), rng.uniform(0.15, 0.35)
    k = 360.0 / (360.0 - angle)
    fit = rng.uniform(0.97, 1.03)
    outer = Sector(fit * (closed_outer + 0.5 * thickness) * k - 0.5 * thickness, thickness, angle, *material())
    return (inner, outer), rng.uniform(6.0, 16.0), rng.uniform(1.0, 1.25)


CASES = {
    "seed": (SEED, SEED_PRESSURE, SEED_STRETCH),
    "media": (cut(MEDIA, 2 / 3), SEED_PRESSURE, SEED_STRETCH),
    "adventitia": (cut(ADVENTITIA, 2 / 3), SEED_PRESSURE, SEED_STRETCH),
    "closed ring": (cut(RING[0], 2 / 3), SEED_PRESSURE, SEED_STRETCH),
    **{f"drawn {seed}": drawn(seed) for seed in range(3)},
}


@dataclasses.dataclass(frozen=True)
class Errors:
    """Of one state on one mesh."""

    radius: float
    """of the lumen, mean over the circumference, over the exact radius"""
    hoop: float
    """root mean square over the wall, over that of the exact circumferential stress"""
    axial: float
    """the same of the axial stress, over that of the exact circumferential stress"""
    radial: float


MODELS: dict = {}


@functools.cache
def errors(element: str, fineness: int, case: str) -> tuple[Errors, Errors]:
    """Errors of the load-free and of the physiological state."""
    sectors, pressure, stretch = CASES[case]
    scene = tube_scene(sectors, pressure, stretch, MESHES[element][fineness], BULK)
    model, load_free, physiological = inflate(scene, MODELS.get((element, fineness)))
    MODELS[element, fineness] = model
    return (
        compare(model, load_free.state, Compressible(sectors, 0.0, 1.0, BULK)),
        compare(model, physiological.state, Compressible(sectors, pressure, stretch, BULK)),
    )


def compare(model, state, exact: Compressible) -> Errors:
    """Lumen radius all round, and stresses at every quadrature point."""
    scene = model.scene
    X = np.asarray(stress_free_positions(model.mesh, scene.mesh, scene.artery))
    N = model.mesh.element.shape(model.mesh.element.quadrature()[0])[0]
    at_points = np.einsum("qa,iac->iqc", N, X)
    R = np.hypot(at_points[0], at_points[1])
    found, dV = stresses(model.body, state), np.asarray(model.body.geometry.dV)
    squares = dict.fromkeys(("circumferential", "axial", "radial", "exact"), 0.0)
    for number, (first, last) in enumerate(model.mesh.layer_cells):
        profile = exact.profile(number, R[:, first:last].ravel())
        weight = dV[:, first:last].ravel()
        squares["exact"] += np.sum(weight * profile.hoop**2)
        for name, values in (
            ("circumferential", profile.hoop),
            ("axial", profile.axial),
            ("radial", profile.radial),
        ):
            difference = np.asarray(getattr(found, name))[:, first:last].ravel() - values
            squares[name] += np.sum(weight * difference**2)
    ring = np.asarray(state.x)[model.marks.lumen_ring]
    radius = np.mean(np.hypot(ring[:, 0], ring[:, 1]))
    root = {name: math.sqrt(square / squares["exact"]) for name, square in squares.items()}
    return Errors(
        radius / exact.inner_radius - 1.0, root["circumferential"], root["axial"], root["radial"]
    )
