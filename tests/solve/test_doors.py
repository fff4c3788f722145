"""Python's doors say in one sentence what is wrong, before anything is solved."""

from __future__ import annotations

import dataclasses
import multiprocessing
import pickle
import threading
from concurrent.futures import ProcessPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.core import failures
from jaxclamp.core.records import quantity, record, static
from jaxclamp.physics.jaws import Cylinder, Jaw
from jaxclamp.scenes.files import require_computable
from jaxclamp.scenes.presets import presets
from jaxclamp.solve import gaps
from jaxclamp.solve.clamping import inflate

SMALL = ["mesh.circumferential=4", "mesh.axial=6", "mesh.radial=[1, 1]", "stop.occlusion=0.6"]


def small(*overrides: str) -> jc.Scene:
    return jc.load_scene("human-lad", [*SMALL, *overrides])


@pytest.mark.parametrize("door", [jc.clamp, inflate, lambda s: jc.evaluate(s, jc.clamp_force())])
def test_a_name_is_no_scene(door):
    with pytest.raises(TypeError, match=r"expected a scene, such as jaxclamp\.load_scene"):
        door("human-lad")


def test_a_factory_is_no_measure():
    result = jc.clamp(small())
    calls = (
        lambda: jc.evaluate(small(), jc.clamp_force),
        lambda: jc.value_and_gradient(result, jc.clamp_force),
        lambda: result.measure(jc.clamp_force),
        lambda: jc.gradients(result, [jc.clamp_force]),
    )
    for call in calls:
        with pytest.raises(TypeError, match=r"the function clamp_force; call it, such as clamp_force\(\)"):
            call()


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("stop.occlusion", 92.5, r"stop\.occlusion = 92\.5: expected a number at least"),
        ("clamp.jaw.radius", "3", r'clamp\.jaw\.radius_mm = "3": expected a number'),
        ("clamp.jaw.radius", None, r"clamp\.jaw\.radius_mm"),
        ("mesh.radial", (5,), r"mesh\.radial = \[5\]: expected one count for each of 2 layers"),
        ("mesh.axial", 0, r"mesh\.axial = 0: expected a whole number from 2"),
    ],
)
def test_what_cannot_be_solved_is_refused_at_once(path, value, said):
    with pytest.raises(jc.SceneError, match=said):
        jc.clamp(jc.replace(small(), path, value))


IMPOSSIBLE = {
    "artery.pressure_kPa": 2e4,
    "artery.length_mm": 0.01,
    "artery.layers[0].opening_angle_deg": 340.0,
    "artery.layers[0].material.c_kPa": 1e12,
    "artery.layers[1].thickness_mm": 300.0,
    "artery.layers[1].name": "media",
    "clamp.jaw.radius_mm": 1e9,
    "contact.smoothing_mm": 5.0,
    "mesh.axial": 1,
    "mesh.radial": [1],
    "mesh.element": "q9",
    "mesh.axial_grading": "steep",
    "solver.tolerance": 0.5,
    "solver.continuation": "luman",
    "stop.occlusion": 92.5,
}
"""single keys with which the small scene makes no sense, by itself or beside the others"""
PYTHON_DOORS = {
    "clamp": jc.clamp,
    "inflate": inflate,
    "evaluate": lambda s: jc.evaluate(s, jc.clamp_force()),
}


@pytest.mark.parametrize("door", PYTHON_DOORS)
@pytest.mark.parametrize("key", IMPOSSIBLE)
def test_python_says_what_a_scene_file_says(key, door):
    value = IMPOSSIBLE[key]
    with pytest.raises(jc.SceneError) as of_file:
        small(f"{key}={value}")
    with pytest.raises(jc.SceneError) as of_python:
        PYTHON_DOORS[door](jc.replace(small(), key, tuple(value) if isinstance(value, list) else value))
    said = str(of_file.value).removeprefix("human-lad with overrides: ")
    assert str(of_python.value).removeprefix("scene: ") == said


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("artery", "human-lad-wall", r'artery = "human-lad-wall": expected a record Artery'),
        ("clamp.jaw", 3.0, r"clamp\.jaw = 3\.0: expected a record Jaw"),
        ("artery.layers", [], r"artery\.layers = .*: expected a tuple of 1 to 200"),
        ("artery.layers[0]", None, r"artery\.layers\[0\] = .*None.*: expected a record Layer"),
        ("artery.layers[0].material.c", True, r"c_kPa = true: expected a number"),
        ("clamp.jaw.radius", [1.0, "2"], r"clamp\.jaw\.radius_mm = .*: expected a number"),
        ("mesh.radial[1]", 0.5, r"mesh\.radial\[1\] = .*: expected a list of whole numbers"),
    ],
)
def test_what_is_of_another_kind_is_refused_when_it_is_set(path, value, said):
    with pytest.raises(jc.SceneError, match=said):
        jc.replace(small(), path, value)


def test_an_array_where_a_scene_has_one_number_is_refused():
    with pytest.raises(jc.SceneError, match=r"radius_mm = .*shape \(2,\).*: expected one number"):
        jc.clamp(jc.replace(small(), "clamp.jaw.radius", np.array([1.0, 2.0])))


def test_directions_and_gradients_are_scenes_with_any_numbers():
    assert jc.replace(small(), "stop.occlusion", -3.0).stop.occlusion == -3.0


def test_differences_may_step_over_the_end_of_a_range():
    """By a millionth: the slope by a pressure of 0 can be had by central differences."""
    require_computable(jc.replace(small(), "artery.pressure", -1e-3))
    with pytest.raises(jc.SceneError, match=r"pressure_kPa = -0\.1: expected a number at least 0 kPa"):
        require_computable(jc.replace(small(), "artery.pressure", -0.1))
    with pytest.raises(jc.SceneError, match=r"thickness_mm = -1e-12: expected a number greater than 0"):
        require_computable(jc.replace(small(), "artery.layers[0].thickness", -1e-12))


@record
class Upside(Jaw):
    """A bar whose gap has the wrong sign."""

    shape: str = static("upside down")
    radius: jax.Array = quantity("mm", 0.0, 1e4)

    def gap(self, point):
        return self.radius - ((point[1] - self.radius) ** 2 + point[2] ** 2) ** 0.5

    def half_extent(self):
        return self.radius

    def curvatures(self):
        return np.ones(1)


@record
class Doubled(Cylinder):
    """A bar whose gap is twice the distance."""

    shape: str = static("doubled")

    def gap(self, point):
        return 2.0 * super().gap(point)


@record
class Undefined(Cylinder):
    """A bar whose gap is undefined to the sides of its middle."""

    shape: str = static("undefined")

    def gap(self, point):
        return jnp.where(jnp.abs(point[2]) > 1.0, jnp.nan, super().gap(point))


@record
class Kinked(Cylinder):
    """A bar whose gap has values, but no derivative."""

    shape: str = static("kinked")

    def gap(self, point):
        return super().gap(point) + jnp.where(point[2] > 1.0, jnp.sqrt(0.0 * point[2]), 0.0)


@record
class Tilted(Cylinder):
    """A bar that is lower to one side of the artery, where its gap is no distance."""

    shape: str = static("tilted")

    def gap(self, point):
        return super().gap(point) + jnp.maximum(point[0] - 1.0, 0.0)


@pytest.mark.parametrize(
    ("jaw", "said"),
    [
        (Doubled, "of length 1 there; it is .* mm with one of 2 at x = 0, y = 2.06, z = -2.85 mm$"),
        (Undefined, "it is nan mm with one of 0 at x = 0, y = 0, z = -2.85 mm$"),
        (Kinked, "it is .* mm with one of nan at x = 0, y = 2.06, z = -2.85 mm$"),
        (Tilted, "it is .* mm with one of 1.41 at x = 3.73, y = "),
    ],
)
def test_a_gap_that_is_no_distance_is_named(jaw, said):
    with pytest.raises(jc.SceneError, match=rf"clamp\.jaw of shape '{jaw.__name__.lower()}': .*{said}"):
        jc.clamp(jc.replace(small(), "clamp.jaw", jaw(radius=3.0)))


JAWS = (
    *(each.name for each in presets("jaw")),
    "{ shape = 'flat', half_width_mm = 1.0, edge_radius_mm = 0.02 }",
    "{ shape = 'flat', half_width_mm = 0.02, edge_radius_mm = 3.0 }",
    "{ shape = 'spline', half_width_mm = 2.0, slopes = [0.0, 0.2, 0.3, 0.3], edge_radius_mm = 0.5 }",
    "{ shape = 'spline', half_width_mm = 2.0, slopes = [0.5, -0.3, 0.6, -0.2, 0.4], edge_radius_mm = 0.3 }",
    "{ shape = 'spline', half_width_mm = 2.0, slopes = [0.1, 2.0, 9.0, 20.0], edge_radius_mm = 0.1 }",
)


@pytest.mark.parametrize("jaw", JAWS)
def test_faces_that_ship_are_seen_and_have_a_distance(jaw):
    """Most of the points that are looked at are on the face."""
    scene = small(f"clamp.jaw={jaw}")
    gaps.require_a_gap(scene)
    z = float(scene.clamp.jaw.half_extent()) * gaps.ALONG
    gap = gaps.face(scene.clamp.jaw, np.zeros_like(z), z)[1]
    assert np.mean(np.abs(gap) < 1e-9) >= 0.9


def test_a_jaw_turned_inside_out_is_named():
    with pytest.raises(jc.SceneError, match=r"clamp\.jaw of shape 'upside down': expected a gap that is"):
        jc.clamp(jc.replace(small(), "clamp.jaw", Upside(radius=3.0)))


# --- case 4: ratios over rounding -------------------------------------------------------------------


def test_a_ratio_over_rounding_is_null():
    """A tube without opening angles, pressure and stretch has no stress in the body."""
    scene = small("artery.pressure_kPa=0", "artery.axial_stretch=1.0", "stop={travel_mm=0.3}")
    media, adventitia = scene.artery.layers
    inner = dataclasses.replace(media, inner_radius=1.7, opening_angle=0.0)
    outer = dataclasses.replace(adventitia, inner_radius=1.7 + media.thickness, opening_angle=0.0)
    result = jc.clamp(jc.replace(scene, "artery.layers", (inner, outer)))
    assert result.final["axial_stress_ratio_at_P"] is None
    assert result.final["circumferential_stress_ratio_at_P"] is None
    assert abs(result.final["axial_stress_at_P_kPa"]) > 0.1


# --- cases 1 and 8: threads and processes -----------------------------------------------------------


def flat(gradient: jc.Scene) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(a)) for a in jax.tree_util.tree_leaves(gradient)])


@pytest.mark.parametrize("count", [20, pytest.param(200, marks=pytest.mark.slow)])
def test_two_threads_differentiate_neighbouring_results(count):
    """Of results of which one was the other's guess."""
    first = jc.clamp(small())
    results = (first, jc.clamp(jc.replace(small(), "clamp.jaw.radius", 2.9), guess=first))
    measure = jc.smooth_peak_axial_stress("media")
    expected = [flat(jc.value_and_gradient(result, measure)[1]) for result in results]
    found: list[list[float]] = [[], []]

    def work(which: int) -> None:
        for _ in range(count):
            gradient = flat(jc.value_and_gradient(results[which], measure)[1])
            off = np.abs(gradient - expected[which]) / np.max(np.abs(expected[which]))
            found[which].append(float(np.max(off)))

    threads = [threading.Thread(target=work, args=(which,)) for which in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [len(f) for f in found] == [count, count]
    assert max(map(max, found)) < 1e-12


def every_failure() -> list[failures.Failure]:
    cause = failures.NotConverged("Newton's residual grows", 1.5, 0.2)
    made = [failures.EquilibriumError("clamping", "beyond occlusion 50%", cause, "refine"), cause]
    others = [cls for cls in vars(failures).values() if isinstance(cls, type)]
    plain = [c for c in others if issubclass(c, failures.Failure) and c not in {type(m) for m in made}]
    return made + [cls("one sentence") for cls in plain]


@pytest.mark.parametrize("failure", every_failure(), ids=lambda f: type(f).__name__)
def test_failures_pickle_with_their_sentence(failure):
    again = pickle.loads(pickle.dumps(failure))
    assert type(again) is type(failure)
    assert str(again) == str(failure)
    assert len(str(again)) > 5


def fail() -> None:
    raise every_failure()[0]


def test_a_failure_comes_back_from_a_pool():
    spawn = multiprocessing.get_context("spawn")
    said = "beyond occlusion 50%: Newton's residual grows"
    with ProcessPoolExecutor(1, mp_context=spawn) as pool, pytest.raises(jc.EquilibriumError, match=said):
        pool.submit(fail).result(timeout=120)
