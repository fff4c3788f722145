"""Addresses of a scene's values: one grammar, exact answers, and refusals in one short sentence."""

import dataclasses
import math
import pickle
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.core.failures import BadAddress, SceneError
from jaxclamp.core.records import UNIT_FACTOR
from jaxclamp.scenes import schema
from jaxclamp.scenes.address import LONGEST, describe, get, replace, steps, text
from jaxclamp.scenes.wording import CONVERSIONS, did_you_mean, split_unit
from jaxclamp.trust.estimates import bulk_paths, multiplied

SPLINE = 'clamp.jaw={shape="spline", half_width_mm=3, slopes=[0.1, 0.2, 0.4], edge_radius_mm=1}'


def lad(*overrides: str) -> jc.Scene:
    return jc.load_scene("human-lad", [SPLINE, *overrides])


def addresses(record, path=""):
    """Every address of a value, with its field: without units, and with them."""
    for field in dataclasses.fields(record):
        value, name = getattr(record, field.name), f"{path}{field.name}"
        if dataclasses.is_dataclass(value):
            yield from addresses(value, f"{name}.")
        elif isinstance(value, tuple) and (not value or dataclasses.is_dataclass(value[0])):
            for i, item in enumerate(value):
                yield from addresses(item, f"{name}[{i}].")
        else:
            yield name, f"{path}{schema.file_key(field)}", field, value


# --- the grammar ----------------------------------------------------------------------------------


def test_steps_and_text_are_inverse():
    address = "artery.layers[0].material.c"
    assert steps(address) == ("artery", "layers", 0, "material", "c")
    assert steps("c[3][14]") == ("c", 3, 14)
    for one in (address, "c[3][14]", "title"):
        assert text(steps(one)) == one


NONSENSE = [
    "",
    ".",
    "artery.",
    ".artery",
    "artery..length",
    "artery.layers[-1].name",
    "artery.layers[0",
    "artery.layers[].name",
    "artery.layers[٣].name",
    "artery.läyers",
    "artery layers",
    "title\n",
    "[0]",
    "a." * 20_000 + "a",
    "a" * 1_000_000,
    "layers" + "[0]" * 10_000,
    "artery.layers[" + "9" * 5000 + "]",
    None,
    3,
    b"title",
]

NOWHERE = [
    *("a", "artery.x", "artery.length.x", "title.x", "title[0]", "artery[0]", "artery.length[0]"),
    *("artery.layers[2].name", "artery.layers.name", "artery.layers[0][0]", "clamp.jaw.slopes[3]"),
    *("clamp.jaw.slopes[0][0]", "clamp.jaw.slopes.x", "mesh.radial[2]", "clamp.jaw.gap", "__class__"),
    "artery.layers[999999999999999999999].name",
    "artery.layers[" + "9" * (LONGEST - 20) + "]",
    "x" * (LONGEST - 1),
    ".".join("a" * (LONGEST // 2)),
]


@pytest.mark.parametrize("address", [*NONSENSE, *NOWHERE], ids=lambda a: repr(a)[:40])
def test_what_leads_nowhere_is_refused_at_once_in_one_short_sentence(address):
    scene = lad()
    start = time.perf_counter()
    for ask in (get, describe, lambda s, a: replace(s, a, 1.0)):
        with pytest.raises(BadAddress) as caught:
            ask(scene, address)
        assert isinstance(caught.value, KeyError)
        assert isinstance(caught.value, SceneError)
        sentence = str(caught.value)
        assert 20 < len(sentence) < 250
        assert sentence.isprintable()
        assert not sentence.startswith('"'), "a KeyError's quotes"
    assert time.perf_counter() - start < 0.5


def test_refusals_travel_between_processes():
    again = pickle.loads(pickle.dumps(BadAddress("a sentence")))
    assert (type(again), str(again), again.exit_code) == (BadAddress, "a sentence", 2)


@pytest.mark.parametrize("override", [f"{address}=1" for address in [*NONSENSE[:17], *NOWHERE]])
def test_overrides_refuse_them_too(override):
    start = time.perf_counter()
    with pytest.raises(SceneError) as caught:
        lad(override)
    assert len(str(caught.value)) < 400
    assert str(caught.value).isprintable()
    assert time.perf_counter() - start < 0.5


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("artery.presure", "did you mean pressure_kPa?"),
        ("clamp.jaw.half_widht_mm", "did you mean half_width_mm?"),
        ("clamp.jaw.edge", "did you mean edge_radius_mm?"),
        ("clmp.jaw", "did you mean clamp?"),
        ("artery.qqq", "known here: length_mm, axial_stretch, pressure_kPa, layers"),
        ("artery.layers[2].name", "a position from [0] to [1]"),
        ("artery.layers[99999999999999999999].name", "a position from [0] to [1]"),
        ("clamp.jaw.slopes[3]", "a position from [0] to [2]"),
        ("artery.length[0]", "it is not a list"),
        ("title.x", "no fields"),
        ("artery.pressure_mmHg", "did you mean pressure_kPa? (1 mmHg = 0.133322 kPa)"),
        ("artery.pressure_mmhg", "(1 mmHg = 0.133322 kPa)"),
        ("artery.presure_mmHg", "did you mean pressure_kPa? (1 mmHg = 0.133322 kPa)"),
        ("artery.length_cm", "did you mean length_mm? (1 cm = 10 mm)"),
        ("artery.layers[0].thickness_um", "did you mean thickness_mm? (1 um = 0.001 mm)"),
        ("artery.layers[0].material.c_MPa", "did you mean c_kPa? (1 MPa = 1000 kPa)"),
        ("artery.layers[0].material.bulk_Pa", "did you mean bulk_kPa? (1 Pa = 0.001 kPa)"),
        ("artery.layers[0].opening_angle_rad", "did you mean opening_angle_deg? (1 rad = 57.2958 deg)"),
        ("contact.stiffness_MPa_per_mm", "did you mean stiffness_kPa_per_mm? (1 MPa/mm = 1000 kPa/mm)"),
        ("artery.pressure_mm", "did you mean pressure_kPa? (it is in kPa)"),
        ("artery.axial_stretch_mm", "did you mean axial_stretch? (it has no unit)"),
    ],
)
def test_refusals_name_what_was_meant(address, words):
    with pytest.raises(BadAddress) as caught:
        get(lad(), address)
    assert words in str(caught.value)


@pytest.mark.parametrize(("unit", "words"), [("mN", "1 mN = 0.001 N"), ("g", "1 g = 0.00980665 N")])
def test_units_of_a_force(unit, words):
    assert did_you_mean(f"force_{unit}", ["occlusion", "force_N"]) == f"did you mean force_N? ({words})"


def test_conversions_are_those_of_the_units():
    """Against the definitions of the units in SI."""
    in_SI = {"mm": 1e-3, "mm2": 1e-6, "kPa": 1e3, "N": 1.0, "deg": math.pi / 180, "kPa_per_mm": 1e6}
    in_SI |= {
        "um": 1e-6,
        "cm": 1e-2,
        "m": 1.0,
        "cm2": 1e-4,
        "rad": 1.0,
        "mN": 1e-3,
        "kN": 1e3,
        "g": 9.80665e-3,
    }
    in_SI |= {"Pa": 1.0, "hPa": 100.0, "MPa": 1e6, "bar": 1e5, "psi": 6894.757, "MPa_per_mm": 1e9}
    in_SI |= {"mmHg": 133.322387415, "cmH2O": 98.0665}
    for unit, (target, factor) in CONVERSIONS.items():
        assert factor == pytest.approx(in_SI[unit] / in_SI[target], rel=5e-6), unit
        assert target in UNIT_FACTOR


def test_names_are_told_from_units():
    assert split_unit("inner_radius_mm") == ("inner_radius", "mm")
    assert split_unit("stiffness_kPa_per_mm") == ("stiffness", "kPa_per_mm")
    assert split_unit("fibre_angle") == ("fibre_angle", "")
    assert split_unit("mm") == ("mm", "")


# --- get, replace, describe ------------------------------------------------------------------------


def test_every_value_of_a_scene_has_an_address_with_and_without_its_unit():
    scene = lad("stop.force_N=0.4")
    found = list(addresses(scene))
    assert len(found) > 35
    for path, key, field, value in found:
        assert get(scene, path) is value
        assert replace(scene, path, value) == scene
        assert replace(scene, key, get(scene, key)) == scene, key
        if value is None:
            with pytest.raises(BadAddress, match=r"is not there in this scene|is a choice or a part"):
                describe(scene, path)
            continue
        if "range" not in field.metadata:
            with pytest.raises(BadAddress, match="expected a number"):
                describe(scene, path)
            continue
        for address in (path, key):
            place = describe(scene, address)
            assert (place.path, place.key) == (path, key)
            assert place.value is value
            assert place.range is field.metadata["range"]
            assert place.factor == UNIT_FACTOR[place.range.unit]


def test_a_unit_in_the_name_is_the_unit_of_the_value():
    scene = lad("stop.force_N=0.4", "artery.layers[0].opening_angle_deg=160")
    assert (get(scene, "stop.force_N"), get(scene, "stop.force")) == (0.4, 400.0)
    assert get(scene, "artery.layers[0].opening_angle_deg") == 160.0
    assert replace(scene, "stop.force_N", 0.5).stop.force == 500.0
    assert replace(scene, "stop.force", 0.5).stop.force == 0.5
    as_in_a_file = lad("stop.force_N=0.4", "artery.layers[0].opening_angle_deg=123.4")
    assert replace(scene, "artery.layers[0].opening_angle_deg", 123.4) == as_in_a_file


def test_items_of_lists_of_numbers():
    scene = lad()
    changed = replace(scene, "clamp.jaw.slopes[1]", 0.25)
    assert np.asarray(changed.clamp.jaw.slopes).tolist() == [0.1, 0.25, 0.4]
    assert np.asarray(scene.clamp.jaw.slopes).tolist() == [0.1, 0.2, 0.4], "the scene itself stays"
    assert get(scene, "clamp.jaw.slopes[2]") == 0.4
    assert changed == lad("clamp.jaw.slopes[1]=0.25")
    place = describe(scene, "clamp.jaw.slopes[1]")
    assert (place.path, place.key, place.value) == ("clamp.jaw.slopes[1]", "clamp.jaw.slopes[1]", 0.2)
    assert replace(scene, "mesh.radial[1]", 4).mesh.radial == (5, 4)


def test_an_item_of_whole_numbers_is_not_rounded():
    scene = replace(lad(), "clamp.jaw.slopes", np.array([0, 1, 2]))
    assert np.asarray(replace(scene, "clamp.jaw.slopes[1]", 0.25).clamp.jaw.slopes).tolist() == [0, 0.25, 2]


def test_items_of_constants_per_point():
    c = jnp.arange(1.0, 7.0).reshape(2, 3)
    scene = replace(lad(), "artery.layers[0].material.c", c)
    address = "artery.layers[0].material.c_kPa[1][2]"
    assert get(scene, address) == 6.0
    changed = replace(scene, address, 9.0)
    np.testing.assert_array_equal(changed.artery.layers[0].material.c, c.at[1, 2].set(9.0))
    assert describe(scene, address).key == address
    assert describe(scene, address).path == "artery.layers[0].material.c[1][2]"


def test_parts_can_be_replaced_whole():
    scene, other = lad(), jc.load_scene("human-lad")
    assert replace(scene, "clamp.jaw", other.clamp.jaw) == other
    assert replace(scene.artery, "pressure_kPa", 12.0) == replace(scene, "artery.pressure", 12.0).artery


def test_replace_and_get_work_on_traced_values():
    """Against the derivatives by hand: of sums of squares, an angle in degrees and an item among them."""
    scene = lad()

    @jax.jit
    def total(c, slope, degrees):
        changed = replace(scene, "artery.layers[1].material.c_kPa", c)
        changed = replace(changed, "clamp.jaw.slopes[1]", slope)
        changed = replace(changed, "artery.layers[0].opening_angle_deg", degrees)
        return (
            get(changed, "artery.layers[1].material.c") ** 2
            + get(changed, "clamp.jaw.slopes[1]") ** 2
            + jnp.sum(changed.clamp.jaw.slopes)
            + get(changed, "artery.layers[0].opening_angle")
            + get(changed, "artery.layers[0].opening_angle_deg")
        )

    slopes = jax.grad(total, (0, 1, 2))(3.0, 0.3, 160.0)
    assert [float(s) for s in slopes] == pytest.approx([6.0, 2 * 0.3 + 1.0, math.pi / 180 + 1.0])


def test_penalties_are_multiplied_where_they_are():
    scene = jc.load_scene("human-lad")
    harder = multiplied(scene, (*bulk_paths(scene), "contact.stiffness"), 10.0)
    assert [layer.material.bulk for layer in harder.artery.layers] == [1e5, 1e5]
    assert (harder.contact.stiffness, harder.contact.smoothing) == (2e4, 0.01)
    per_point = replace(scene, "artery.layers[0].material.bulk", np.full((8, 4), 1e4))
    assert np.all(multiplied(per_point, bulk_paths(scene), 2.0).artery.layers[0].material.bulk == 2e4)
