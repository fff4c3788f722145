"""Scene files: what is read is what was written, and what is wrong is refused in one sentence."""

import abc
import ast
import copy
import dataclasses
import math
import tomllib
from itertools import zip_longest
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxclamp.core.failures import SceneError
from jaxclamp.core.records import concrete_subclasses, quantity, record, static
from jaxclamp.fem.tube import build_tube, closed_radii
from jaxclamp.observe.stops import ClosedStop, OcclusionStop, PressedStop, TravelStop
from jaxclamp.scenes import schema
from jaxclamp.scenes.address import replace
from jaxclamp.scenes.files import (
    dump_scene,
    load_scene,
    loads_scene,
    own_mesh_keys,
    require_computable,
    require_possible,
)
from jaxclamp.scenes.presets import presets
from jaxclamp.scenes.scene import SolverSettings, Stop

HGO = {"law": "hgo", "c_kPa": 27.0, "k1_kPa": 0.64, "k2": 3.54, "fibre_angle_deg": 10.0, "bulk_kPa": 1e4}
CHOICES = {"fibre_energy": "eq10", "fibre_invariant": "full"}
GOH = {**HGO, "law": "goh", "dispersion": 0.1}
NEO = {"law": "neo-hookean", "c_kPa": 2.7, "bulk_kPa": 1e4}
CYLINDER = {"shape": "cylinder", "radius_mm": 3.0}
FLAT = {"shape": "flat", "half_width_mm": 2.0, "edge_radius_mm": 1.0}
SPLINE = {"shape": "spline", "half_width_mm": 3.0, "slopes": [0.1, 0.2], "edge_radius_mm": 1.0}


def scene_table(jaw, stop, first=HGO, second=HGO):
    """Every key of a scene file, with values that are valid."""
    return {
        "title": "A scene",
        "artery": {
            "length_mm": 45.0,
            "axial_stretch": 1.1,
            "pressure_kPa": 13.33,
            "layers": [
                {
                    "name": "media",
                    "inner_radius_mm": 3.302,
                    "thickness_mm": 0.493,
                    "opening_angle_deg": 160.0,
                    "material": copy.deepcopy(first),
                },
                {
                    "name": "adventitia",
                    "inner_radius_mm": 3.482,
                    "thickness_mm": 0.247,
                    "opening_angle_deg": 120.0,
                    "material": copy.deepcopy(second),
                },
            ],
        },
        "clamp": {"jaw": copy.deepcopy(jaw)},
        "stop": dict(stop),
        "contact": {
            "stiffness_kPa_per_mm": 2000.0,
            "smoothing_mm": 0.01,
            "intima_stiffness_ratio": 200.0,
            "intima_smoothing_ratio": 0.1,
        },
        "mesh": {
            "circumferential": 10,
            "axial": 15,
            "radial": [5, 3],
            "axial_grading": 2.5,
            "circumferential_grading": 0.5,
            "radial_grading": 1.5,
            "element": "q1p0",
            "contact_points": 4,
            "symmetry": "xz",
        },
        "solver": {
            "tolerance": 1e-9,
            "continuation": "travel",
            "path_mesh": "own",
            "linear_solver": "splu",
        },
    }


TABLES = {
    "cylinder, hgo, occlusion": scene_table(CYLINDER, {"occlusion": 0.925}, {**HGO, **CHOICES}, NEO),
    "flat, goh, travel": scene_table(FLAT, {"travel_mm": 2.4}, GOH, GOH),
    "spline, neo, force": scene_table(SPLINE, {"force_N": 0.5}, NEO, NEO),
}
OPTIONAL = {"title", "contact", "mesh", "solver", "fibre_energy", "fibre_invariant"}

# what is valid besides positive numbers below 1e30
MAY_BE_NEGATIVE = {"opening_angle_deg", "slopes"}
MAY_BE_ZERO = MAY_BE_NEGATIVE | {
    *("pressure_kPa", "k1_kPa", "k2", "fibre_angle_deg", "dispersion", "travel_mm"),
    *("axial_grading", "circumferential_grading", "radial_grading"),
}


def toml(table):
    return "\n".join(f"{schema.bare(key)} = {schema.toml_value(value)}" for key, value in table.items())


def loads(table, **options):
    return loads_scene(toml(table), source="scene.toml", **options)


def leaves(node, path=()):
    """Path and value of every value that is no table and no list of tables."""
    if isinstance(node, dict):
        return [leaf for key, value in node.items() for leaf in leaves(value, (*path, key))]
    if isinstance(node, list) and isinstance(node[0], dict):
        return [leaf for i, value in enumerate(node) for leaf in leaves(value, (*path, i))]
    return [(path, node)]


def changed(table, path, change):
    """A copy of a table after `change(owner, key)` at a path."""
    table = copy.deepcopy(table)
    owner = table
    for step in path[:-1]:
        owner = owner[step]
    change(owner, path[-1])
    return table


def with_value(table, path, value):
    return changed(table, path, lambda owner, key: owner.__setitem__(key, value))


LEAVES = {
    f"{'.'.join(map(str, path))} ({name})": (table, path, value)
    for name, table in TABLES.items()
    for path, value in leaves(table)
}


def wrong_values(key, value):
    """Values that no one could mean for this key."""
    if isinstance(value, str):
        text = [3, 1.5, True, ["a"], {"a": 1}, "two\nlines", "x" * 5000]
        return text if key in ("title", "name") else [*text, "", "nonsense"]
    numbers = [True, "3", "", {"a": 1}, math.nan, math.inf, -math.inf, 1e30, -1e30, 10**400, -(10**400)]
    if isinstance(value, int):
        return [*numbers, [3], 0, -1, 2.5, 10.0, 10**6]
    if key == "radial":
        return [
            *numbers,
            8,
            [],
            [5],
            [5, 3, 1],
            [5, 0],
            [5, -3],
            [5, 2.5],
            [5, True],
            [5, "3"],
            [5, 10**6],
            [[5, 3]],
        ]
    if isinstance(value, list):
        bad = [n for n in numbers if not isinstance(n, dict)]
        return [*numbers, 0.1, [], [[0.1]], *([0.1, n] for n in bad), [0.1] * 5000]
    numbers += [[value], []]
    numbers += [] if key in MAY_BE_NEGATIVE else [-1, -1e-3 * value]
    return (
        numbers
        if key in MAY_BE_ZERO
        else [*numbers, 0, 0.0, -0.0, *([1e-30] if key.endswith("_mm") and "_per_" not in key else [])]
    )


def refusal(table, **options):
    """The sentence with which a scene is refused."""
    with pytest.raises(SceneError) as caught:
        loads(table, **options)
    sentence = str(caught.value)
    assert sentence.startswith("scene.toml")
    assert sentence.isprintable(), "one line"
    assert len(sentence) < 500
    return sentence


def same(one, other):
    """Equal records, to the last bit."""
    a, b = (jax.tree_util.tree_flatten(scene) for scene in (one, other))
    return a[1] == b[1] and all(
        np.array_equal(x, y) and type(x) is type(y) for x, y in zip(a[0], b[0], strict=True)
    )


# ------------------------------------------------------------------------------------- presets


def test_human_lad_is_the_study_of_2002():
    scene = load_scene("human-lad")
    media, adventitia = scene.artery.layers
    assert (scene.artery.length, scene.artery.axial_stretch, scene.artery.pressure) == (45.0, 1.1, 13.33)
    assert (media.inner_radius, media.thickness, media.material.c, media.material.k1) == (
        3.302,
        0.493,
        27.0,
        0.64,
    )
    assert math.degrees(media.opening_angle) == pytest.approx(160.0, rel=1e-15)
    assert math.degrees(adventitia.material.fibre_angle) == pytest.approx(40.0, rel=1e-15)
    assert (adventitia.inner_radius, adventitia.material.k2, adventitia.material.bulk) == (3.482, 15.4, 1e4)
    assert media.material.fibre_energy == "eq4"
    assert (scene.clamp.jaw.radius, scene.stop.occlusion) == (3.0, 0.925)
    assert (scene.contact.stiffness, scene.contact.smoothing) == (2000.0, 0.01)
    mesh = load_scene("human-lad", fidelity="seed").mesh
    assert (mesh.circumferential, mesh.axial, mesh.radial, mesh.axial_grading) == (10, 15, (5, 3), 2.5)
    assert (mesh.element, mesh.circumferential_grading, mesh.radial_grading) == ("q1p0", 0.0, 0.0)
    assert [layer.name for layer in scene.artery.layers] == ["media", "adventitia"]


def test_eq10_preset_differs_from_human_lad_only_in_the_fibre_energy():
    printed = load_scene(
        "human-lad", [f'artery.layers[{i}].material.fibre_energy="eq10"' for i in (0, 1)] + ["title=x"]
    )
    assert same(load_scene("human-lad-eq10", ["title=x"]), printed)


def test_wall_preset_is_the_artery_of_human_lad():
    assert same(load_scene("human-lad", ["artery=human-lad-wall"]), load_scene("human-lad"))


@pytest.mark.parametrize("name", [preset.name for preset in presets("scene")])
def test_scene_presets_load_and_round_trip(name):
    scene = load_scene(name)
    text = dump_scene(scene)
    assert same(loads_scene(text), scene)
    assert dump_scene(loads_scene(text)) == text


@pytest.mark.parametrize("kind", ["artery", "jaw"])
def test_parts_can_be_named_in_scenes_and_overrides(kind):
    for part in presets(kind):
        place = "artery" if kind == "artery" else "clamp.jaw"
        by_override = load_scene("human-lad", [f"{place}={part.name}"])
        table = copy.deepcopy(tomllib.loads(dump_scene(load_scene("human-lad"))))
        (table if kind == "artery" else table["clamp"])[place.split(".")[-1]] = part.name
        table.pop("mesh")
        assert same(loads(table), by_override)
        assert same(loads_scene(dump_scene(by_override)), by_override)


def test_presets_have_unique_names_and_titles():
    everything = presets()
    assert len({p.name for p in everything}) == len(everything) >= 10
    assert all(p.text.startswith("# ") and len(p.title) > 10 for p in everything)


def test_wide_nearly_flat_has_the_slopes_of_its_description():
    jaw = load_scene("human-lad", ["clamp.jaw=wide-nearly-flat"]).clamp.jaw
    stations = jaw.half_width * np.arange(1, jaw.slopes.size + 1) / (jaw.slopes.size + 0.5)
    expected = np.interp(stations, [0, 0.75, 1.5, 2.25, 3.0, 3.25], [0, 0.10, 0.41, 0.23, 0.13, 5.0])
    np.testing.assert_allclose(jaw.slopes, expected, atol=1e-4)


# ------------------------------------------------------------------------------------- wrong values


def test_the_tables_are_valid_and_complete():
    """Else the tests of wrong values would test nothing."""
    for table in TABLES.values():
        written = tomllib.loads(dump_scene(loads(table)))
        assert written == table


@pytest.mark.parametrize("leaf", LEAVES)
def test_wrong_values_are_refused_with_their_key(leaf):
    table, path, value = LEAVES[leaf]
    for wrong in wrong_values(path[-1], value):
        sentence = refusal(with_value(table, path, wrong))
        assert path[-1] in sentence, f"{wrong!r}: {sentence}"
        assert "expected" in sentence
        assert schema.shown(wrong)[:20] in sentence or isinstance(wrong, list), f"{wrong!r}: {sentence}"


@pytest.mark.parametrize("place", ["title", "artery", "clamp", "stop", "contact", "mesh", "solver"])
@pytest.mark.parametrize("wrong", [3, True, [1], math.nan])
def test_tables_of_a_wrong_type_are_refused(place, wrong):
    assert place in refusal(with_value(TABLES["flat, goh, travel"], (place,), wrong))


@pytest.mark.parametrize("path", [("artery", "layers"), ("artery", "layers", 0), ("clamp", "jaw")])
@pytest.mark.parametrize("wrong", [3, [], "nothing-like-this", [[]]])
def test_nested_tables_of_a_wrong_type_are_refused(path, wrong):
    assert str(path[1]) in refusal(with_value(TABLES["flat, goh, travel"], path, wrong))


@pytest.mark.parametrize("leaf", LEAVES)
def test_a_slip_in_a_key_is_named_and_the_key_suggested(leaf):
    table, path, _ = LEAVES[leaf]
    key = path[-1]
    slip = key[:2] + key[3:] if len(key) > 4 else key + "x"

    def misspell(owner, key):
        owner[slip] = owner.pop(key)

    sentence = refusal(changed(table, path, misspell))
    if key in ("law", "shape"):
        assert f"{key} is missing" in sentence
    else:
        assert (
            f"unknown key {'.'.join(map(str, path[:-1])).replace('.0', '[0]').replace('.1', '[1]')}"
            in sentence
        )
        assert slip in sentence
        assert len(key) <= 4 or f"did you mean {key}?" in sentence


def test_a_forgotten_unit_is_suggested():
    sentence = refusal(with_value(TABLES["flat, goh, travel"], ("artery", "layers", 0, "material", "c"), 3.0))
    assert "did you mean c_kPa?" in sentence


@pytest.mark.parametrize(
    ("path", "words"),
    [
        (
            ("artery", "pressure_mmHg"),
            "pressure_mmHg; did you mean pressure_kPa? (1 mmHg = 0.133322 kPa): pressure_kPa = 0.399966",
        ),
        (
            ("artery", "layers", 1, "thickness_um"),
            "did you mean thickness_mm? (1 um = 0.001 mm): thickness_mm = 0.003",
        ),
        (
            ("artery", "layers", 0, "material", "c_MPa"),
            "did you mean c_kPa? (1 MPa = 1000 kPa): c_kPa = 3000",
        ),
        (("stop", "force_mN"), "did you mean force_N? (1 mN = 0.001 N): force_N = 0.003"),
    ],
)
def test_a_wrong_unit_is_refused_with_the_right_one(path, words):
    assert words in refusal(with_value(TABLES["flat, goh, travel"], path, 3.0))


@pytest.mark.parametrize("key", ["x" * 100_000, "x\ny" * 1000, "artery." * 5000])
def test_long_keys_are_cut(key):
    for path in ((key,), ("artery", key), ("artery", "layers", 0, "material", key), ("stop", key)):
        assert len(refusal(with_value(TABLES["flat, goh, travel"], path, 3.0))) < 300


@pytest.mark.parametrize("leaf", LEAVES)
def test_missing_keys_are_named_or_have_defaults(leaf):
    table, path, _ = LEAVES[leaf]
    without = changed(table, path, lambda owner, key: owner.pop(key))
    if OPTIONAL & set(path):
        loads(without)
    elif path[0] == "stop":
        assert "stop = {}: expected exactly one of occlusion, travel_mm, force_N" in refusal(without)
    else:
        assert f"{path[-1]} is missing: expected" in refusal(without)


@pytest.mark.parametrize("place", list(TABLES["flat, goh, travel"]))
def test_whole_tables_may_be_left_out_only_if_optional(place):
    without = changed(TABLES["flat, goh, travel"], (place,), lambda owner, key: owner.pop(key))
    if place in OPTIONAL:
        loads(without)
    else:
        assert f"{place} is missing" in refusal(without)


def test_defaults_are_those_of_the_records():
    table = {key: TABLES["flat, goh, travel"][key] for key in ("artery", "clamp", "stop")}
    scene = loads(table)
    assert (scene.mesh.element, scene.mesh.contact_points, scene.mesh.circumferential_grading) == (
        "q1pz",
        4,
        2.0,
    )
    assert (scene.solver.continuation, scene.solver.linear_solver, scene.title) == ("lumen", "auto", "")


# ------------------------------------------------------------------------------------- values together


def test_a_stop_is_exactly_one():
    both = scene_table(FLAT, {"occlusion": 0.9, "force_N": 1.0})
    stops = "occlusion, travel_mm, force_N, area_occlusion, closed, closed with force_N"
    assert f"exactly one of {stops}" in refusal(both)
    assert "stop.closed = false: expected true" in refusal(scene_table(FLAT, {"closed": False}))
    assert "stop.closed = 1: expected true" in refusal(scene_table(FLAT, {"closed": 1, "force_N": 1.0}))


def test_closure_is_a_stop_alone_or_with_a_force_to_press_on_to():
    alone, pressed = (loads(scene_table(FLAT, {"closed": True} | more)) for more in ({}, {"force_N": 3.0}))
    assert (type(alone.stop), float(alone.stop.target())) == (ClosedStop, 1.0)
    assert (type(pressed.stop), float(pressed.stop.target())) == (PressedStop, 3000.0)
    assert "[stop]\nclosed = true\nforce_N = 3.0\n" in dump_scene(pressed)
    assert loads_scene(dump_scene(alone)) == alone
    assert load_scene("human-lad", ["stop.closed=true"]).stop == alone.stop
    assert load_scene("human-lad", ["stop.closed=true", "stop.force_N=3"]).stop == pressed.stop
    assert load_scene("human-lad", ["stop.closed=true", "stop.occlusion=0.9"]).stop.kind == "occlusion"


@record
class AreaStop(Stop):
    """A stop of a user's own."""

    kind: str = static("area")
    area: jax.Array = quantity("mm2", 0.0, 1e3, open_lower=True)

    def measure(self, equilibria): ...


def test_a_stop_of_ones_own_needs_no_registration():
    assert AreaStop in concrete_subclasses(Stop)
    scene = loads(scene_table(FLAT, {"area_mm2": 2}))
    assert isinstance(scene.stop, AreaStop)
    assert scene.stop == AreaStop(area=2.0)
    text = dump_scene(scene)
    assert "[stop]\narea_mm2 = 2.0\n\n" in text
    assert same(loads_scene(text), scene)
    assert load_scene("human-lad", ["stop.area_mm2=3"]).stop == AreaStop(area=3.0)
    assert load_scene("human-lad", ["stop.area_mm2=3", "stop.travel_mm=1"]).stop == TravelStop(travel=1.0)
    assert "stop.area_mm2 = 0.0: expected a number greater than 0 mm2" in refusal(
        scene_table(FLAT, {"area_mm2": 0.0})
    )
    both = scene_table(FLAT, {"area_mm2": 1.0, "force_N": 1.0})
    assert "expected exactly one of occlusion, travel_mm, force_N, " in refusal(both)


def test_an_unknown_stop_is_refused_with_those_there_are():
    sentence = refusal(scene_table(FLAT, {"zzz": 1.0}))
    assert "unknown key stop.zzz; known here: occlusion, travel_mm, force_N, " in sentence
    assert "area_mm2" in sentence  # other tests have stops of their own
    assert "unknown key stop.kind" in refusal(scene_table(FLAT, {"kind": "area", "area_mm2": 1.0}))


def test_a_quantity_has_a_unit_that_is_known():
    with pytest.raises(ValueError, match="unit 'furlong': expected one of"):
        quantity("furlong", 0.0, 1.0)


def test_equal_jaws_are_one_and_different_ones_are_two():
    table = scene_table(FLAT, {"occlusion": 0.9})
    alike = {**table, "clamp": {"upper": FLAT, "lower": dict(reversed(FLAT.items()))}}
    assert same(loads(alike), loads(table))
    unlike = loads({**table, "clamp": {"upper": FLAT, "lower": CYLINDER}})
    assert [jaw.shape for jaw in unlike.clamp.jaws] == ["flat", "cylinder"]
    assert unlike.clamp.jaw is None
    for clamp in ({"upper": FLAT}, {"upper": FLAT, "lower": FLAT, "jaw": FLAT}):
        assert "expected either jaw, or both upper and lower" in refusal({**table, "clamp": clamp})
    assert "clamp.lower.half_width_mm" in refusal(
        {**table, "clamp": {"upper": FLAT, "lower": {**FLAT, "half_width_mm": -1}}}
    )


@pytest.mark.parametrize("angle", np.linspace(-340.0, 345.0, 30).tolist())
def test_layers_are_refused_exactly_where_the_closing_map_has_no_radius(angle):
    table = with_value(TABLES["flat, goh, travel"], ("artery", "layers", 0, "opening_angle_deg"), angle)
    table["artery"]["layers"] = table["artery"]["layers"][:1]
    table["mesh"].pop("radial")
    middle, share, layer = 3.302 + 0.493 / 2, 1 - angle / 360, table["artery"]["layers"][0]
    inner_squared = (middle * share) ** 2 - (middle**2 - layer["inner_radius_mm"] ** 2) * share
    if inner_squared > 0:
        scene = loads(table)
        radii = np.asarray(closed_radii(build_tube(scene.mesh, scene.clamp), scene.mesh, scene.artery))
        assert np.all(np.diff(radii) > 0)
        assert radii[0] > 0
    else:
        sentence = refusal(table)
        assert "artery.layers[0].opening_angle_deg" in sentence
        assert "'media' can close" in sentence


def test_a_layer_that_would_not_fit_round_the_one_inside_is_refused():
    for radius in (1.0, 10.0):
        table = with_value(TABLES["flat, goh, travel"], ("artery", "layers", 1, "inner_radius_mm"), radius)
        sentence = refusal(table)
        assert "artery.layers[1].inner_radius_mm" in sentence
        assert "'adventitia' would be stretched" in sentence


def test_layer_names_are_unique_and_not_blank():
    table = TABLES["flat, goh, travel"]
    assert "no other layer" in refusal(with_value(table, ("artery", "layers", 1, "name"), "media"))
    assert "not empty" in refusal(with_value(table, ("artery", "layers", 1, "name"), " "))


def test_a_layer_need_not_be_called_media():
    scene = loads(with_value(TABLES["flat, goh, travel"], ("artery", "layers", 0, "name"), "wall"))
    assert scene.artery.layers[0].name == "wall"


def test_too_many_elements_are_refused_with_their_number():
    table = with_value(TABLES["flat, goh, travel"], ("mesh", "axial"), 400)
    table["mesh"]["circumferential"] = 400
    assert "400 x 400 x 8 = 1280000 elements: expected at most 200000" in refusal(table)


# ------------------------------------------------------------------------------------- units, mesh


def test_numbers_become_floats_in_internal_units():
    scene = loads(with_value(TABLES["spline, neo, force"], ("artery", "length_mm"), 45))
    assert type(scene.artery.length) is float
    assert scene.artery.layers[0].opening_angle == pytest.approx(math.pi * 160 / 180, rel=1e-15)
    assert scene.stop.force == 500.0  # mN
    assert scene.clamp.jaw.slopes.dtype == np.float64
    assert scene.clamp.jaw.slopes.tolist() == [0.1, 0.2]
    assert scene.mesh.radial == (5, 3)


@pytest.mark.parametrize(
    ("fidelity", "counts"),
    [
        ("draft", (10, 10, (3, 2))),
        ("standard", (14, 15, (5, 3))),
        ("reference", (28, 36, (10, 6))),
        ("seed", (10, 15, (5, 3))),
    ],
)
def test_fidelity_chooses_the_mesh_where_the_scene_does_not(fidelity, counts):
    mesh = load_scene("human-lad", fidelity=fidelity).mesh
    assert (mesh.circumferential, mesh.axial, mesh.radial) == counts
    assert mesh.axial_grading == 2.5
    uniform = fidelity == "seed"
    assert (mesh.element, mesh.circumferential_grading) == (("q1p0", 0.0) if uniform else ("q1pz", 2.0))
    assert mesh.radial_grading == (0.0 if uniform else 5.0)  # the adventitia is softer than the media
    harder = load_scene("human-lad", ["artery.layers[1].material.c_kPa=28"], fidelity).mesh
    assert harder.radial_grading == 0.0
    few = load_scene("human-lad", ["mesh.circumferential=9"], fidelity).mesh
    assert few.circumferential_grading == 0.0  # an element on the other side would cover 20 degrees
    mixed = load_scene("human-lad", ["mesh.axial=33"], fidelity).mesh
    assert (mixed.circumferential, mixed.axial, mixed.radial) == (counts[0], 33, counts[2])


def test_every_layer_gets_an_element():
    thin = [f"artery.layers[1].{key}" for key in ("thickness_mm=0.02", "inner_radius_mm=3.5")]
    assert load_scene("human-lad", thin, "draft").mesh.radial[1] >= 1


def test_unknown_fidelity_is_refused():
    with pytest.raises(SceneError, match="expected one of draft, standard, reference, seed"):
        load_scene("human-lad", fidelity="fine")


def test_own_mesh_keys_are_those_of_the_file(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(toml(TABLES["flat, goh, travel"]))
    assert own_mesh_keys(path) == ["circumferential", "axial", "radial"]
    assert own_mesh_keys("human-lad") == []


# ------------------------------------------------------------------------------------- overrides


def test_overrides_change_one_value_each():
    overrides = [
        "clamp.jaw={shape='spline', half_width_mm=2, slopes=[0.1, 0.2, 0.3], edge_radius_mm=1}",
        "clamp.jaw.slopes[1]=0.25",
        "artery.layers[0].material.c_kPa = 30",
        "artery.layers[1].name=outer",
        'title="a = b"',
        "solver.continuation=travel",
    ]
    scene = load_scene("human-lad", overrides)
    assert scene.clamp.jaw.slopes.tolist() == [0.1, 0.25, 0.3]
    assert scene.artery.layers[0].material.c == 30.0
    assert (scene.artery.layers[1].name, scene.title, scene.solver.continuation) == (
        "outer",
        "a = b",
        "travel",
    )
    untouched = load_scene("human-lad")
    assert same(scene.artery.layers[1].material, untouched.artery.layers[1].material)


@pytest.mark.parametrize(("override", "kind"), [("travel_mm=2", "travel"), ("force_N=0.4", "force")])
def test_a_stop_replaces_the_other_kind(override, kind):
    assert load_scene("human-lad", [f"stop.{override}"]).stop.kind == kind
    assert load_scene("human-lad", [f"stop.{override}", "stop.occlusion=0.5"]).stop.occlusion == 0.5


def test_a_jaw_replaces_two_and_two_replace_one():
    two = load_scene("human-lad", ["clamp.upper=flat-2mm", "clamp.lower=flat-2mm"])
    assert same(two, load_scene("human-lad", ["clamp.jaw=flat-2mm"]))


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("clamp.jaw.radious_mm=1", ["clamp.jaw.radious_mm", "did you mean radius_mm?"]),
        ("clamp.jaws.radius_mm=1", ["clamp.jaws", "did you mean jaw?"]),
        ("artery.layers[2].thickness_mm=1", ["artery.layers[2].thickness_mm", "[0] to [1]"]),
        ("artery.layers.thickness_mm=1", ["artery.layers.thickness_mm", "[0] to [1]"]),
        ("artery.layers[0][0]=1", ["artery.layers[0][0]", "does not exist"]),
        ("artery.length_mm.x=1", ["artery.length_mm.x", "45.0"]),
        ("clamp.jaw=flat-2m", ["clamp.jaw", "did you mean flat-2mm?"]),
        ("clamp.jaw=human-lad-wall", ["clamp.jaw", "no jaw"]),
        ("clamp.jaw.shape=flat", ["clamp.jaw.radius_mm", 'shape = "flat"']),
        ("clamp.jaw.radius_mm=3mm", ["clamp.jaw.radius_mm", '"3mm"', "expected a number"]),
        ("clamp.jaw.radius_mm=", ["clamp.jaw.radius_mm", "after the ="]),
        ("clamp.jaw.radius_mm=1\ntitle=2", ["after the ="]),
        ("clamp.jaw.radius_mm", ["KEY=VALUE"]),
        ("=3", ["KEY=VALUE"]),
        ("", ["KEY=VALUE"]),
        ("artery..length_mm=3", ["KEY=VALUE"]),
        ("mesh.axial=2020-01-01", ["mesh.axial", "2020-01-01"]),
        ("stop.oclusion=0.4", ["stop.oclusion", "did you mean occlusion?"]),
    ],
)
def test_wrong_overrides_are_refused(override, words):
    with pytest.raises(SceneError) as caught:
        load_scene("human-lad", [override])
    sentence = str(caught.value)
    assert sentence.startswith("human-lad")
    assert "override" in sentence or "jaw =" in sentence
    assert all(word in sentence for word in words), sentence
    assert sentence.isprintable()


# ------------------------------------------------------------------------------------- files


def test_files_and_presets_are_told_apart(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = dump_scene(load_scene("rabbit-carotid"))
    for name in ("mine.toml", "mine"):
        (tmp_path / name).write_text(text, encoding="utf-8-sig")
        assert same(load_scene(name), load_scene("rabbit-carotid"))
        assert same(load_scene(tmp_path / name), load_scene("rabbit-carotid"))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"title = 'a'\nartery = \n", ["not valid TOML", "line 2"]),
        (b"title = 1\ntitle = 2\n", ["not valid TOML"]),
        (b"\xff\xfe\x00", ["UTF-8"]),
        (b"#" * 2_000_000, ["1000 kB"]),
        (b"a = " + b"[" * 5000, ["not valid TOML"]),
        (b"length = " + b"9" * 5000, ["not valid TOML"]),
        (b"", ["artery is missing"]),
    ],
)
def test_files_that_cannot_be_read_are_refused(tmp_path, content, words):
    path = tmp_path / "scene.toml"
    path.write_bytes(content)
    with pytest.raises(SceneError) as caught:
        load_scene(str(path))
    assert str(path) in str(caught.value)
    assert all(word in str(caught.value) for word in words), str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nowhere/scene.toml", ["nowhere/scene.toml", "no such file"]),
        ("scene.toml", ["no such file"]),
        ("..", [".."]),
        ("a\0b.toml", ["cannot be read"]),
        ("a\nb.toml", ["no such file"]),
        ("human-lat", ["did you mean human-lad?"]),
        ("flat-2mm", ["no scene", "clamp.jaw"]),
        ("", ["no preset scene"]),
    ],
)
def test_scenes_that_do_not_exist_are_refused(name, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SceneError) as caught:
        load_scene(name)
    assert all(word in str(caught.value) for word in words), str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("slopes", ["[-0.5, -0.5, -0.2, 0.5]", "[-1.0]", "[0.1, -1.0, 0.2]"])
def test_a_jaw_whose_middle_is_not_its_lowest_point_is_refused(slopes):
    """Travel and first contact are measured from the middle."""
    jaw = f"clamp.jaw={{shape='spline', half_width_mm=2, slopes={slopes}, edge_radius_mm=1}}"
    with pytest.raises(SceneError, match=r"clamp\.jaw\.slopes.*lowest point"):
        load_scene("human-lad", [jaw])


# ------------------------------------------------------------------------------------- round trip


def numbers(least, most):
    return st.floats(least, most, allow_subnormal=False)


materials = st.one_of(
    st.fixed_dictionaries(
        {"law": st.just("neo-hookean"), "c_kPa": numbers(0.1, 1e3), "bulk_kPa": numbers(1, 1e6)}
    ),
    st.fixed_dictionaries(
        {
            "law": st.just("hgo"),
            "c_kPa": numbers(0.1, 1e3),
            "k1_kPa": numbers(0, 1e3),
            "k2": numbers(0, 100),
            "fibre_angle_deg": numbers(0, 90),
            "bulk_kPa": numbers(1, 1e6),
            "fibre_energy": st.sampled_from(["eq4", "eq10"]),
        }
    ),
)
jaws = st.one_of(
    st.fixed_dictionaries({"shape": st.just("cylinder"), "radius_mm": numbers(0.1, 100)}),
    st.fixed_dictionaries(
        {
            "shape": st.just("spline"),
            "half_width_mm": numbers(0.1, 30),
            "slopes": st.lists(numbers(0, 5), min_size=1, max_size=20),
            "edge_radius_mm": numbers(0.1, 10),
        }
    ),
)
stops = st.one_of(
    st.fixed_dictionaries({"occlusion": numbers(0.01, 0.99)}),
    st.fixed_dictionaries({"travel_mm": numbers(0, 5)}),
    st.fixed_dictionaries({"force_N": numbers(0.01, 10)}),
)
titles = st.text(st.characters(codec="utf-8").filter(str.isprintable), max_size=50)


@given(
    title=titles,
    jaw=jaws,
    stop=stops,
    material=materials,
    angle=numbers(-100, 200),
    thickness=numbers(0.1, 0.6),
)
def test_a_scene_that_was_read_is_written_exactly(title, jaw, stop, material, angle, thickness):
    table = scene_table(jaw, stop, material, material)
    table["title"] = title
    for layer in table["artery"]["layers"]:
        layer |= {"opening_angle_deg": angle, "thickness_mm": thickness}
    scene = loads(table)
    again = loads_scene(dump_scene(scene))
    assert again.title == title
    assert same(again, scene)


@given(angle=numbers(-6, 6))
def test_angles_set_in_python_are_written_to_the_last_digit(angle):
    lad = load_scene("human-lad")
    media = dataclasses.replace(lad.artery.layers[0], opening_angle=angle)
    written = schema.table(media)["opening_angle_deg"] * math.pi / 180
    assert written == pytest.approx(angle, rel=4e-16, abs=0)


# ------------------------------------------------------------------------------------- equal scenes


def test_scenes_compare_by_value_also_with_arrays():
    spline = loads(TABLES["spline, neo, force"])
    again = loads(TABLES["spline, neo, force"])
    assert (spline == again) is True
    assert (spline != again) is False
    assert (spline == replace(again, "clamp.jaw.slopes", jnp.asarray(again.clamp.jaw.slopes))) is True
    for address, value in [
        ("clamp.jaw.slopes[1]", 0.21),
        ("clamp.jaw.slopes", np.array([0.1, 0.2, 0.3])),
        ("clamp.jaw.slopes", 0.1),
        ("artery.pressure", 13.34),
        ("artery.layers[1].name", "outer"),
        ("artery.layers", spline.artery.layers[:1]),
        ("mesh.radial[0]", 6),
        ("stop", OcclusionStop(occlusion=0.5)),
        ("artery.layers[0].material.c", np.full((3, 4), 2.7)),
    ]:
        changed = replace(spline, address, value)
        assert (changed == spline) is False, address
        assert (changed == replace(again, address, value)) is True, address
    assert spline != "spline"
    assert OcclusionStop(occlusion=0.5) != TravelStop(travel=0.5)


def test_records_without_arrays_can_be_hashed_and_equal_ones_alike():
    one, other = load_scene("human-lad"), load_scene("human-lad")
    assert hash(one) == hash(other)
    assert hash(one) != hash(load_scene("mouse-aorta"))
    assert len({SolverSettings(), SolverSettings(tolerance=1e-8), SolverSettings(tolerance=1e-9)}) == 2
    with pytest.raises(TypeError, match="unhashable"):
        hash(loads(TABLES["spline, neo, force"]))


def test_traced_records_equal_themselves_and_are_not_guessed_at():
    """A record is itself; whether two traced values are the same is for JAX to refuse."""

    @jax.jit
    def traced(scene, other):
        assert scene == scene
        assert scene == replace(scene, "title", scene.title)
        with pytest.raises(jax.errors.TracerArrayConversionError):
            assert scene == other
        return scene.artery.pressure

    scene = jax.tree_util.tree_map(jnp.asarray, load_scene("human-lad"))
    assert float(traced(scene, scene)) == 13.33


# ------------------------------------------------------------------------------------- made in Python


def per_point(value=27.0, shape=(8, 150)):
    """A scene whose media has a constant for each point."""
    return replace(load_scene("human-lad"), "artery.layers[0].material.c", jnp.full(shape, value))


def test_constants_per_point_are_computable_and_cannot_be_written():
    require_computable(per_point())
    for refused in (dump_scene, require_possible):
        with pytest.raises(SceneError) as caught:
            refused(per_point())
        assert str(caught.value) == (
            "scene: artery.layers[0].material.c_kPa is an array of shape (8, 150): "
            "a scene file holds one number there"
        )


def test_one_constant_that_is_not_finite_is_found():
    scene = per_point()
    wrong = replace(scene, "artery.layers[0].material.c[3][14]", math.nan)
    with pytest.raises(SceneError, match=r"artery\.layers\[0\]\.material\.c_kPa\[3\]\[14\] = nan: expected"):
        require_computable(wrong)
    thin = replace(scene, "artery.layers[1].thickness", np.full((1, 2), 0.0))
    with pytest.raises(SceneError, match=r"layers\[1\]\.thickness_mm\[0\]\[0\] = 0\.0: expected"):
        require_computable(thin)
    require_computable(replace(scene, "artery.layers[0].material.k1", np.zeros((8, 150))))


def test_slopes_that_are_one_number_cannot_be_written():
    scene = replace(loads(TABLES["spline, neo, force"]), "clamp.jaw.slopes", 0.1)
    with pytest.raises(SceneError, match=r"slopes is an array of shape \(\): a scene file holds a list"):
        dump_scene(scene)


# ------------------------------------------------------------------------------------- the schema


@pytest.mark.parametrize("choice", ["auto", "xyz", "xy", "xz", "yz", "x", "y", "z", "none"])
def test_symmetry_is_a_choice_of_the_mesh(choice):
    scene = load_scene("human-lad", [f"mesh.symmetry={choice}"])
    assert scene.mesh.symmetry == choice
    assert same(loads_scene(dump_scene(scene)), scene)


def undocumented(path):
    """Public functions, classes and fields of a module that say nothing about themselves."""

    def of(body, prefix, fields):
        for node, following in zip_longest(body, body[1:]):
            name = getattr(node, "name", None)
            if isinstance(node, ast.AnnAssign) and fields:
                name = node.target.id
                said = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
                said = said or _is_tag(node)
            elif isinstance(node, ast.FunctionDef | ast.ClassDef):
                said = ast.get_docstring(node) is not None
            else:
                continue
            if not name.startswith("_") and not said:
                yield f"{prefix}{name}"
            if isinstance(node, ast.ClassDef) and not name.startswith("_"):
                yield from of(node.body, f"{prefix}{name}.", True)

    return list(of(ast.parse(path.read_text(encoding="utf-8")).body, f"{path.stem}.", False))


def _is_tag(node):
    """A record's own name, or a constant of its class, explained where its base is."""
    return ast.unparse(node.annotation).startswith("ClassVar") or ast.unparse(node).startswith("kind: str = ")


@pytest.mark.parametrize("room", ["core", "scenes", "scenes/presets"])
def test_everything_public_says_what_it_is(room):
    folder = Path(schema.__file__).parents[1] / room
    modules = sorted(folder.glob("*.py"))
    assert modules
    assert [name for path in modules for name in undocumented(path)] == []


class Tool(abc.ABC):
    """Something with one abstract method, as jaws and materials have."""

    sort: str

    @abc.abstractmethod
    def use(self) -> None: ...


@record
class Hook(Tool):
    sort: str = static("hook")
    reach: jax.Array = quantity("mm", 1.0, 10.0, default=2.0)
    bends: jax.Array = quantity("deg", 0.0, 90.0, many=True)

    def use(self) -> None: ...


def test_a_new_record_needs_no_change_to_be_read_and_written():
    table = {"sort": "hook", "reach_mm": 3, "bends_deg": [0, 90]}
    hook = schema.read(Tool, table, "tool")
    assert isinstance(hook, Hook)
    assert hook.bends == pytest.approx([0, math.pi / 2])
    assert schema.table(hook) == table
    assert schema.read(Tool, {"sort": "hook", "bends_deg": [1]}).reach == 2.0
    with pytest.raises(schema.BadKey, match=r"tool.bends_deg\[1\] = 91.*at most 90 deg"):
        schema.read(Tool, table | {"bends_deg": [0, 91]}, "tool")
    with pytest.raises(
        schema.BadKey, match=r'tool.sort = "hock": expected one of "hook"; did you mean hook\?'
    ):
        schema.read(Tool, table | {"sort": "hock"}, "tool")
