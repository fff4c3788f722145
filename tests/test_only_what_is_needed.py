"""What a scene does not have costs it nothing: size of the system and of the compiled programs.

A feature added to the engine (a law, a jaw, a contact, a layer) must leave the study's scene as it is.
The counts below were read off when it had two HGO layers, a cylinder, blood pressure and both contacts.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import pytest

import jaxclamp as jc
from jaxclamp.fem.tube import closed_positions
from jaxclamp.potential.model import build_model, describe
from jaxclamp.potential.tangent import assemble, cut, linearise_block, with_equilibrium_pressure
from tube import MEDIA
from walks import material

EQUATIONS = {"wall": 2300, "assembly": 1050}
"""of the programs that take the time, as JAX 0.10 traces them (2156 and 950), and a tenth"""


def equations(jaxpr) -> int:
    """Operations of a traced program, with those of the programs it calls."""
    count = 0
    for equation in jaxpr.eqns:
        found = [p for v in equation.params.values() for p in (v if isinstance(v, tuple | list) else [v])]
        called = [getattr(p, "jaxpr", p) for p in found if hasattr(p, "jaxpr") or hasattr(p, "eqns")]
        count += sum(map(equations, called)) if called else 1
    return count


def programs(scene: jc.Scene) -> dict[str, int]:
    model = build_model(scene)
    body = model.body
    x = closed_positions(model.mesh, scene.mesh, scene.artery)
    state = with_equilibrium_pressure(body, x, jnp.asarray(10.0))
    pieces = cut(body, state)
    laws = [body.parameters.materials[layer] for layer, _, _ in body.topology.blocks]
    blocks = [linearise_block(p, body.stencils, m) for p, m in zip(pieces, laws, strict=True)]
    wall = jax.make_jaxpr(linearise_block)(pieces[0], body.stencils, laws[0])
    whole = jax.make_jaxpr(assemble)(body, state, jnp.asarray(1.0), blocks)
    return {"wall": equations(wall.jaxpr), "assembly": equations(whole.jaxpr)}


def small(*overrides: str) -> jc.Scene:
    counts = ["mesh.circumferential=3", "mesh.axial=3", "mesh.radial=[1, 1]"]
    return jc.load_scene("human-lad", [*counts, *overrides])


def test_the_programs_of_the_study_do_not_grow():
    found = programs(small())
    assert all(found[name] <= EQUATIONS[name] for name in EQUATIONS), found


def test_a_law_without_fibres_has_none_in_its_program():
    scene = small()
    plain = material(dataclasses.replace(MEDIA, law="neo"), 1e4)
    layers = tuple(dataclasses.replace(layer, material=plain) for layer in scene.artery.layers)
    without = dataclasses.replace(scene, artery=dataclasses.replace(scene.artery, layers=layers))
    assert programs(without)["wall"] < 0.7 * programs(scene)["wall"]


def test_a_cylinder_does_not_pay_for_splines():
    spline = 'clamp.jaw={shape="spline", half_width_mm=2.4, slopes=[0.15, 0.35, 0.6], edge_radius_mm=0.6}'
    assert programs(small())["assembly"] < programs(small(spline))["assembly"]


@pytest.mark.parametrize("pressure", [0.0, 13.33])
def test_show_lists_the_terms_there_are(pressure):
    described = describe(jc.load_scene("human-lad", [f"artery.pressure_kPa={pressure}"]))
    assert described["unknowns"] == 4266
    assert ("blood pressure" in described["terms"]) == (pressure > 0.0)
    assert set(described["terms"]) >= {"wall: media", "wall: adventitia", "incompressibility", "jaw contact"}
    assert all(len(reason) > 20 for reason in described["terms"].values())
