"""Cold starts to 92.5 % occlusion with blunt, sharp, narrow and wide jaws on three meshes."""

from __future__ import annotations

import dataclasses

import pytest

import jaxclamp as jc
from jaxclamp.physics.jaws import Cylinder, Flat, Jaw
from jaxclamp.solve.limits import LARGEST_SINKING
from walks import mesh

MESHES = {"10x15x8": (10, 15, (5, 3)), "10x30x8": (10, 30, (5, 3)), "20x30x16": (20, 30, (10, 6))}

JAWS: dict[str, Jaw | None] = {
    **{f"cylinder {radius}": Cylinder(radius=radius) for radius in (0.5, 1.0, 3.0, 6.0, 12.0)},
    **{
        f"flat {half_width}, edge {edge}": Flat(half_width=half_width, edge_radius=edge)
        for half_width in (0.5, 1.0, 2.0, 3.0)
        for edge in (0.3, 1.0)
    },
    "wide and nearly flat": None,  # the preset, a spline
}


def close(jaw: str, counts: str) -> jc.Result:
    """The seed's artery, from its stress-free sectors to the stop; raises if that is not reached."""
    circumferential, axial, radial = MESHES[counts]
    shape = JAWS[jaw] or jc.load_scene("human-lad", ["clamp.jaw=wide-nearly-flat"]).clamp.jaw
    scene = jc.replace(jc.load_scene("human-lad"), "clamp.jaw", shape)
    return jc.clamp(dataclasses.replace(scene, mesh=mesh("q1p0", circumferential, axial, radial)))


def assert_closed(result: jc.Result) -> None:
    """At the stop, in balance, nothing inverted, nothing pushed through the jaw, energy accounted for."""
    final = result.final
    assert final["occlusion"] == pytest.approx(0.925, abs=1e-6)
    # contact is a penalty; a narrow, sharp edge on a coarse mesh sinks in by a fifth of the wall
    body = result.physiological.values
    wall = body["outer_radius_mm"] - 0.5 * body["lumen_height_mm"]
    assert final["max_penetration_mm"] < 0.5 * LARGEST_SINKING * wall
    for record in result.history:
        assert record["force_balance_error"] < 1e-6
        assert record["J_min"] > 0.0
    if not result.solver["snapped"]:
        assert result.solver["work_balance_error"] < 1e-2


@pytest.mark.parametrize(
    "jaw",
    [
        pytest.param("cylinder 0.5", marks=pytest.mark.slow),
        pytest.param("flat 1.0, edge 0.3", marks=pytest.mark.slow),
    ],
)
def test_two_jaws_on_the_mesh_of_the_study(jaw):
    assert_closed(close(jaw, "10x15x8"))


@pytest.mark.slow
@pytest.mark.parametrize("counts", MESHES)
@pytest.mark.parametrize("jaw", JAWS)
def test_every_jaw_on_every_mesh(jaw, counts):
    assert_closed(close(jaw, counts))
