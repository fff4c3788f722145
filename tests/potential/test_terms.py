"""The list of terms: absent ones cost nothing, term by term; a term of one's own is one entry.

A feature added to the engine (a law, a jaw, a contact, a layer) must leave the study's scene as it is.
The counts below were read off when it had two HGO layers, a cylinder, blood pressure and both contacts.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.fem.tube import closed_positions
from jaxclamp.potential import kinds
from jaxclamp.potential.energy import with_equilibrium_pressure
from jaxclamp.potential.kinds import Kind, needed
from jaxclamp.potential.model import Model, build_model, potential_of
from jaxclamp.potential.tangent import cut, linearise, linearise_piece
from jaxclamp.potential.terms import BLOOD, INTIMA, JAWS, KEPT_VOLUME, Term
from jaxclamp.show.description import describe
from jaxclamp.solve.stages import Clamping
from tube import MEDIA
from walks import material

EQUATIONS = {"wall: media": 2350, BLOOD: 215, JAWS: 305, INTIMA: 180}
"""of the programs that take the time, as JAX 0.10 traces them (2141, 195, 275, 164), and a tenth"""


def equations(jaxpr) -> int:
    """Operations of a traced program, with those of the programs it calls."""
    count = 0
    for equation in jaxpr.eqns:
        found = [p for v in equation.params.values() for p in (v if isinstance(v, tuple | list) else [v])]
        called = [getattr(p, "jaxpr", p) for p in found if hasattr(p, "jaxpr") or hasattr(p, "eqns")]
        count += sum(map(equations, called)) if called else 1
    return count


def small(*overrides: str) -> jc.Scene:
    counts = ["mesh.circumferential=3", "mesh.axial=3", "mesh.radial=[1, 1]"]
    return jc.load_scene("human-lad", [*counts, *overrides])


def programs(scene: jc.Scene, closing: bool = True) -> dict[str, int]:
    """Size of the program of each term that the scene needs."""
    model = build_model(scene)
    potential = model.solved(closing)
    x = closed_positions(model.mesh, scene.mesh, scene.artery)
    state = with_equilibrium_pressure(model.potential, x, jnp.asarray([10.0]))
    pieces = [cut(group, state) for group in potential.groups]
    return {
        group.names[0]: equations(jax.make_jaxpr(linearise_piece)(blocks[0]).jaxpr)
        for group, blocks in zip(potential.groups, pieces, strict=True)
    }


def test_the_programs_of_the_study_do_not_grow():
    found = programs(small())
    assert set(found) == {"wall: media", "wall: adventitia", BLOOD, JAWS, INTIMA}
    assert all(found[name] <= EQUATIONS[name] for name in EQUATIONS), found


def test_absent_terms_have_no_program():
    """No blood at pressure 0, no contact before the jaws close, no intima far from closure."""
    every, no_blood = programs(small()), programs(small("artery.pressure_kPa=0"))
    assert set(every) - set(no_blood) == {BLOOD}
    in_body = programs(small(), closing=False)
    assert set(every) - set(in_body) == {JAWS, INTIMA}
    far = programs(small("stop.occlusion=0.4"))
    assert set(every) - set(far) == {INTIMA}
    for fewer in (no_blood, in_body, far):
        assert all(fewer[name] == every[name] for name in fewer)


def test_a_law_without_fibres_has_none_in_its_program():
    scene = small()
    plain = material(dataclasses.replace(MEDIA, law="neo"), 1e4)
    layers = tuple(dataclasses.replace(layer, material=plain) for layer in scene.artery.layers)
    without = dataclasses.replace(scene, artery=dataclasses.replace(scene.artery, layers=layers))
    assert programs(without)["wall: media"] < 0.7 * programs(scene)["wall: media"]


def test_a_cylinder_does_not_pay_for_splines():
    spline = 'clamp.jaw={shape="spline", half_width_mm=2.4, slopes=[0.15, 0.35, 0.6], edge_radius_mm=0.6}'
    assert programs(small())[JAWS] < programs(small(spline))[JAWS]


def seen_by_stage(scene: jc.Scene) -> dict[str, set[str]]:
    """Terms that the solver had in each stage."""
    found: dict[str, set[str]] = {}

    class Watched(Clamping):
        def keep(self, stage, *rest):
            groups = self.system.at(rest[0].pressure).groups
            found.setdefault(stage, {name for group in groups for name in group.names})
            super().keep(stage, *rest)

    clamping = Watched(build_model(scene), lambda event: None)
    clamping.close(clamping.in_body(clamping.load_free()))
    return found


def test_each_stage_is_solved_with_what_it_needs():
    stages = seen_by_stage(small("stop.occlusion=0.3"))
    wall = {"wall: media", "wall: adventitia", KEPT_VOLUME}
    assert stages == {"load-free": wall, "physiological": wall | {BLOOD}, "clamping": wall | {BLOOD, JAWS}}
    assert seen_by_stage(small("stop.occlusion=0.6"))["clamping"] == wall | {BLOOD, JAWS, INTIMA}


def test_inner_walls_that_meet_unexpectedly_bring_their_term_back(monkeypatch):
    """The stop says that it is far from closure, and is not: the answer is that with the term."""
    scene = jc.load_scene("human-lad", ["mesh.circumferential=5", "mesh.axial=7", "mesh.radial=[2, 1]"])
    scene = jc.replace(scene, "stop.occlusion", 0.985)
    expected = jc.clamp(scene)
    assert expected.final["lumen_contact_force_N"] > 0.0
    monkeypatch.setattr(jc.OcclusionStop, "far_from_closure", lambda self: True)
    found = jc.clamp(scene)
    for key in ("clamp_force_N", "lumen_contact_force_N", "lumen_width_mm"):
        assert found.final[key] == pytest.approx(expected.final[key], rel=1e-9), key
    assert found.every_term
    assert INTIMA in found.to_dict()["model"]["terms"]
    assert jc.with_errors(found).errors["clamp_force_N"]["error"] is not None
    # what was tried first counts, and a neighbour knows better
    assert found.solver["newton_iterations"] > expected.solver["newton_iterations"]
    warm = jc.clamp(jc.replace(scene, "clamp.jaw.radius", 3.02), guess=found)
    assert warm.every_term
    assert len(warm.states) == 3


@pytest.mark.parametrize("pressure", [0.0, 13.33])
def test_show_lists_the_terms_there_are(pressure):
    described = describe(jc.load_scene("human-lad", [f"artery.pressure_kPa={pressure}"], "seed"))
    assert described["unknowns"] == 4266
    assert (BLOOD in described["terms"]) == (pressure > 0.0)
    assert set(described["terms"]) >= {"wall: media", "wall: adventitia", KEPT_VOLUME, JAWS}
    assert all(len(reason) > 20 for reason in described["terms"].values())


def test_the_derivative_by_a_pressure_of_zero_is_there():
    """The solver leaves blood out at pressure 0; its derivative does not."""
    scene = small("artery.pressure_kPa=0", "stop.occlusion=0.4")
    result = jc.clamp(scene)
    _, gradient = jc.value_and_gradient(result, jc.clamp_force())
    h = 1e-3
    more = jc.clamp(jc.replace(scene, "artery.pressure", h)).measure(jc.clamp_force())
    half = jc.clamp(jc.replace(scene, "artery.pressure", h / 2)).measure(jc.clamp_force())
    least = result.measure(jc.clamp_force())
    slope = (4.0 * half - 3.0 * least - more) / h  # one-sided, second order
    assert float(gradient.artery.pressure) == pytest.approx(slope, rel=1e-5)


# --- a term of one's own ------------------------------------------------------------------------------

BED = "elastic bed"
STIFFNESS = 0.05


def bed_energy(y, q, here):
    """Springs that pull the outer wall back to the axis: k/2 (x**2 + y**2) per stress-free area."""
    return 0.5 * here["stiffness"] * (y[0, 0] ** 2 + y[0, 1] ** 2) * here["dA"]


def bed_terms(made):
    dA = kinds.facet_areas(made.body, made.stencils.contact, outer=True)
    here = {"stiffness": jnp.asarray(STIFFNESS), "dA": dA}
    yield Term(name=BED, region="upper outside", stencil="contact", density=bed_energy, here=here)


@pytest.fixture
def with_bed(monkeypatch):
    kind = Kind(lambda scene: {BED: "springs round the artery, for the test"}, bed_terms)
    monkeypatch.setattr(kinds, "KINDS", (*kinds.KINDS, kind))


def test_a_term_of_ones_own_is_one_entry(with_bed):
    """Residual, tangent, balance and the adjoint loop over it with no further word."""
    scene = jc.load_scene("human-lad", ["mesh.circumferential=4", "mesh.axial=5", "mesh.radial=[1, 1]"])
    scene = jc.replace(scene, "stop.occlusion", 0.6)
    assert BED in needed(scene)
    result = jc.clamp(scene)
    assert result.final["residual_mN"] < 1e-4
    assert result.final["clamp_force_N"] > 0.0
    _, gradient = jc.value_and_gradient(result, jc.clamp_force())
    h = 1e-4
    forces = [
        jc.clamp(jc.replace(scene, "clamp.jaw.radius", 3.0 + s * h), guess=result).measure(jc.clamp_force())
        for s in (1.0, -1.0)
    ]
    slope = (forces[0] - forces[1]) / (2.0 * h)
    assert float(gradient.clamp.jaw.radius) == pytest.approx(slope, rel=1e-5)


def test_the_potential_is_a_function_of_every_float():
    """The same potential from traced floats as from concrete ones."""
    scene = jax.tree_util.tree_map(jnp.asarray, small())
    model: Model = build_model(small())
    x = closed_positions(model.mesh, scene.mesh, scene.artery)
    state = with_equilibrium_pressure(model.potential, x, jnp.asarray([2.0]))
    traced = jax.jit(lambda s: potential_of(s, model.discretisation).data)(scene)
    again = linearise(model.potential.with_data(traced), state, model.pattern)
    np.testing.assert_allclose(
        again.residual, linearise(model.potential, state, model.pattern).residual, atol=1e-10
    )
