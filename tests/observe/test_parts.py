"""Parts of a user's own, in a file: named by scene and study files, by value in other processes, refused."""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import jax
import pytest

import jaxclamp as jc
from jaxclamp.cli import main
from jaxclamp.core.records import concrete_subclasses, withdraw
from jaxclamp.scenes.files import loads_scene
from jaxclamp.sensitivity.worker import call_elsewhere
from optimize.study_file import load_study

PARTS = '''
from __future__ import annotations

import jax
import jax.numpy as jnp

import jaxclamp as jc

print("hello from the file")

@jc.record
class Tipped(jc.Jaw):
    """A bar of elliptic section."""

    shape: str = jc.static("tipped")
    half_width: jax.Array = jc.quantity("mm", 0.0, 1e3, open_lower=True)
    radius: jax.Array = jc.quantity("mm", 0.0, 1e3, open_lower=True)
    sides: int = jc.static(2)

    def gap(self, point):
        return jnp.sqrt((point[1] - self.radius) ** 2 + point[2] ** 2) - self.radius

    def half_extent(self):
        return self.radius

    def curvatures(self):
        return jnp.reshape(1.0 / self.radius, 1)

@jc.record
class Soft(jc.Material):
    """A neo-Hookean law."""

    law: str = jc.static("soft")
    c: jax.Array = jc.quantity("kPa", 0.0, 1e6)
    bulk: jax.Array = jc.quantity("kPa", 0.0, 1e9)

    def psi_bar(self, F):
        minor = lambda i, j, k, l: F[1, i] * F[2, j] - F[1, k] * F[2, l]
        J = F[0, 0] * minor(1, 2, 2, 1) - F[0, 1] * minor(0, 2, 2, 0) + F[0, 2] * minor(0, 1, 1, 0)
        squares = sum(F[i, j] ** 2 for i in range(3) for j in range(3))
        inside = J > 0.0
        scale = jnp.where(inside, J, 1.0) ** (-2.0 / 3.0)
        return jnp.where(inside, 0.5 * self.c * (scale * squares - 3.0), jnp.inf)

@jc.record
class Narrower(jc.Stop):
    """Close to a lumen of a given height."""

    kind: str = jc.static("narrower")
    height_left: jax.Array = jc.quantity("mm", 0.0, 1e3)

    def measure(self, equilibria):
        return jc.lumen_height()(equilibria)

def _mean(e, layer):
    volume = jc.volumes(e, layer)
    return jnp.sum(jc.stresses(e, layer).axial * volume) / jnp.sum(volume)

def mean_axial_stress(layer: str) -> jc.Measure:
    return jc.Measure("mean_axial_stress", "kPa", _mean, (layer,))

def weighed_force() -> jc.Measure:
    return 0.5 * jc.clamp_force() + 0.1 * jc.N
'''
SCENE = """
artery = "human-lad-wall"
clamp = { jaw = { shape = "tipped", half_width_mm = 1.0, radius_mm = 3.0 } }
stop = { occlusion = 0.6 }
mesh = { circumferential = 4, axial = 6, radial = [1, 1] }
contact = { stiffness_kPa_per_mm = 2000.0, smoothing_mm = 0.01 }
"""
STUDY = """
scene = "scene.toml"
objective = { measure = "mean_axial_stress_kPa", layer = "media" }
variables = [{ key = "clamp.jaw.radius_mm", lower = 2.9, upper = 3.2 }]
constraints = [{ measure = "weighed_force_N", upper = 5.0 }]
starts = 2
max_evaluations = 1
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with parts, a scene and a study; what it made known is forgotten afterwards."""
    for name, text in (("parts.py", PARTS), ("scene.toml", SCENE), ("study.toml", STUDY)):
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    for name in [n for n in sys.modules if n.startswith(("parts_", "others_"))]:
        from jaxclamp.observe.parts import _imported

        for part in vars(_imported.pop(name)).values():
            if isinstance(part, type):
                withdraw(part)
        del sys.modules[name]


def refused(capsys, *arguments: str) -> str:
    """The one sentence of a command that ends with exit code 2."""
    assert main(arguments) == 2
    said = capsys.readouterr()
    assert said.err.startswith("jaxclamp: ")
    assert said.err.count("\n") == 1
    return said.err.removeprefix("jaxclamp: ").rstrip()


def test_files_name_what_was_imported(folder):
    module = jc.import_parts("parts.py")
    scene = jc.load_scene("scene.toml", ["artery.layers[0].material={law='soft', c_kPa=20.0, bulk_kPa=1e4}"])
    assert type(scene.clamp.jaw) is module.Tipped
    assert type(scene.artery.layers[0].material) is module.Soft
    text = jc.dump_scene(scene)
    assert text.startswith('# needs Soft of "parts.py" (--import)\n# needs Tipped of "parts.py" (--import)\n')
    assert loads_scene(text) == scene
    stop = jc.load_scene("scene.toml", ["stop.height_left_mm=2.0"]).stop
    assert type(stop) is module.Narrower
    problem = load_study("study.toml").problem
    assert str(problem.objective) == "mean_axial_stress(media)"
    assert problem.constraints[0].upper == 5000.0


def test_what_a_file_prints_is_no_result(folder, capsys):
    assert main(["show", "scene.toml", "--import", "parts.py", "--json"]) == 0
    captured = capsys.readouterr()
    assert captured.err == "hello from the file\n"
    assert json.loads(captured.out)["elements"] == 48


def test_a_result_says_what_it_needs(folder):
    """The face is that of the cylinder."""
    jc.import_parts("parts.py")
    result, cylinder = jc.clamp(jc.load_scene("scene.toml")), jc.clamp(jc.load_scene("human-lad", SMALL))
    (own,) = result.to_dict()["own_parts"]
    assert (own["part"], own["from"], len(own["sha256"])) == ("Tipped", "parts.py", 64)
    assert cylinder.to_dict()["own_parts"] == []
    force = jc.clamp_force()
    assert result.measure(force) == pytest.approx(cylinder.measure(force), rel=1e-9)


SMALL = ["mesh.circumferential=4", "mesh.axial=6", "mesh.radial=[1, 1]", "stop.occlusion=0.6"]


@pytest.mark.slow
def test_a_study_of_several_starts_takes_them_along(folder, capsys):
    study = ["optimise", "study.toml", "--import", "parts.py", "--quiet", "--out", "found"]
    assert main(study) == 0
    content = json.loads((folder / "found" / "study.json").read_text())
    assert {row["start"] for row in content["iterations"]} == {1, 2}
    assert all(row["failure"] == "" for row in content["iterations"])
    assert {own["from"] for own in content["own_parts"]} == {"parts.py"}
    other = json.loads((folder / "found" / "start-2" / "study.json").read_text())
    assert other["own_parts"] == content["own_parts"]
    (folder / "parts.py").write_text(PARTS.replace('print("hello from the file")', ""))
    capsys.readouterr()
    assert "the study in that folder is another one" in refused(capsys, *study, "--resume")


def seen(scene: jc.Scene, measure: jc.Measure) -> tuple[jc.Scene, int, float, str]:
    """What another process makes of a scene with parts of one's own, and of a measure."""
    jc.require_possible(scene)
    gap = float(scene.clamp.jaw.gap((0.0, 0.0, 4.0)))
    return scene, len(jax.tree_util.tree_leaves(scene)), gap, jc.dump_scene(scene)


def test_they_travel_by_value(folder):
    jc.import_parts("parts.py")
    scene, measure = jc.load_scene("scene.toml"), load_study("study.toml").problem.objective
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        back = pool.submit(jc.by_value(seen_and_back, scene, measure)).result()
    for found in (back(), call_elsewhere(seen, scene, measure)):
        assert found == (scene, len(jax.tree_util.tree_leaves(scene)), 2.0, jc.dump_scene(scene))


NOTEBOOK = """
from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor

import jax

import jaxclamp as jc
from jaxclamp.physics.jaws import Cylinder

@jc.record
class Own(Cylinder):
    shape: str = jc.static("own")

    def half_extent(self):
        return half * self.radius

half = 0.5

def seen(scene):
    jc.require_possible(scene)
    return jc.dump_scene(scene), float(scene.clamp.jaw.half_extent())

scene = jc.replace(jc.load_scene("human-lad"), "clamp.jaw", Own(radius=3.0))
with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
    found = pool.submit(jc.by_value(seen, scene)).result()
assert found == (jc.dump_scene(scene), 1.5), found
assert found[0].startswith('# needs Own of "__main__"')
"""


def test_those_of_a_notebook_travel_too(tmp_path):
    """`__main__` has no file there, as with `python -c`."""
    done = subprocess.run(
        [sys.executable, "-c", NOTEBOOK], cwd=tmp_path, capture_output=True, text=True, timeout=120,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")


def seen_and_back(*arguments):
    """What `seen` gives, by value on the way back, too."""
    return jc.by_value(tuple, seen(*arguments))


def test_a_file_that_has_changed_takes_the_place_of_the_earlier(folder):
    first = jc.import_parts("parts.py")
    assert jc.import_parts(folder / "parts.py") is first
    (folder / "parts.py").write_text(PARTS.replace('"soft"', '"softer"'))
    second = jc.import_parts("parts.py")
    assert type(jc.load_scene("scene.toml").clamp.jaw) is second.Tipped is not first.Tipped
    with pytest.raises(jc.SceneError, match=r'law = "soft": expected one of .*"softer"; did you mean softer'):
        jc.load_scene("scene.toml", ["artery.layers[0].material.law=soft"])


BAD = {
    "missing": (None, "others.py: there is no such file"),
    "syntax": ("x = (1,\ny = 2\n", "others.py, line 1: SyntaxError: '(' was never closed"),
    "raises": ("def f():\n    1 / 0\nf()\n", "others.py, line 2: ZeroDivisionError: division by zero"),
    "ends": ("import sys\nsys.exit()", "others.py, line 2: SystemExit"),
    "no text": ("\0", "others.py: "),
    "needs a neighbour": (
        "\nimport beside",
        "others.py, line 2: ModuleNotFoundError: No module named 'beside'",
    ),
    "refused": (
        "import jaxclamp as jc\njc.load_scene('human-lat')",
        "others.py, line 2: there is no preset scene called 'human-lat'; did you mean human-lad?",
    ),
    "a name that ships": (
        PARTS.replace('"tipped"', '"cylinder"'),
        'others.py: jaw Tipped is called "cylinder", as is Cylinder that ships: expected another name',
    ),
    "a law that ships": (
        PARTS.replace('"soft"', '"hgo"'),
        'others.py: law Soft is called "hgo", as is HGO that ships: expected another name',
    ),
    "a key that ships": (
        PARTS.replace("height_left", "travel"),
        'others.py: stop Narrower is called "travel_mm", as is TravelStop that ships: expected another name',
    ),
    "a measure that ships": (
        PARTS.replace("def weighed_force", "def clamp_force"),
        'others.py: measure clamp_force is called "clamp_force", as is clamp_force that ships: '
        "expected another name",
    ),
    "no record": (
        PARTS.replace("@jc.record\nclass Tipped", "class Tipped"),
        "others.py: jaw Tipped is no record: put @record above its class",
    ),
    "no function": (
        PARTS.replace("def half_extent", "def extent"),
        "others.py: jaw Tipped has no half_extent",
    ),
    "no name": (
        PARTS.replace('law: str = jc.static("soft")', "kind: int = jc.static(1)"),
        'others.py: law Soft has no name: expected a field law: str = static("...")',
    ),
    "no shear modulus": (
        PARTS.replace("c: jax.Array", "mu: jax.Array"),
        "others.py: law Soft has no c: expected quantities c and bulk, its shear and bulk modulus",
    ),
    "no moduli": (
        PARTS.replace('c: jax.Array = jc.quantity("kPa", 0.0, 1e6)', "c: int = jc.static(1)").replace(
            "bulk: jax.Array", "k: jax.Array"
        ),
        "others.py: law Soft has no c and no bulk: expected quantities c and bulk",
    ),
    "two targets": (
        PARTS.replace(
            "    height_left:", '    more: jax.Array = jc.quantity("mm", 0.0, 1.0)\n    height_left:'
        ),
        "others.py: stop Narrower has 2 quantities: expected one, its target",
    ),
    "an argument": (
        PARTS.replace("def weighed_force()", "def weighed_force(weight)"),
        "others.py: measure weighed_force takes weight: "
        "a study file can give layer, stress, onset_stretch, friction only",
    ),
    "no measure": (
        PARTS.replace("return 0.5 * jc.clamp_force() + 0.1 * jc.N", "return 3"),
        "others.py: measure weighed_force gives 3: expected a Measure",
    ),
    "units": (
        PARTS.replace("0.1 * jc.N", "0.1"),
        "others.py: measure weighed_force cannot be made: TypeError: 0.5 * clamp_force() + 0.1: the",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_one_sentence_and_leaves_nothing(folder, capsys, name):
    text, said = BAD[name]
    if text is not None:
        (folder / "others.py").write_text(text.replace('print("hello from the file")', ""))
    before, modules = concrete_subclasses(jc.Jaw), set(sys.modules)
    assert refused(capsys, "show", "human-lad", "--import", "others.py").startswith(said)
    assert concrete_subclasses(jc.Jaw) == before
    assert {n for n in set(sys.modules) - modules if n.startswith("others")} == set()


@pytest.mark.parametrize("key", ["clamp.jaw.shape", "artery.layers[0].material.law"])
def test_what_nobody_knows_may_be_ones_own(key):
    with pytest.raises(
        jc.SceneError, match=r"expected one of .* \(one of your own is known once .*--import FILE"
    ):
        jc.load_scene("human-lad", [f"{key}=qqqq"])
    with pytest.raises(jc.SceneError, match=r"did you mean [a-z]+\?$"):  # a slip of the pen is none
        jc.load_scene("human-lad", [f"{key}={'cylindr' if 'jaw' in key else 'ngh'}"])


def test_a_law_of_a_script_without_moduli_is_refused():
    @jc.record
    class Bare(jc.Material):
        law: str = jc.static("bare")
        c: jax.Array = jc.quantity("kPa", 0.0, 1e6)

        def psi_bar(self, F):
            return 0.5 * self.c * (sum(F[i, j] ** 2 for i in range(3) for j in range(3)) - 3.0)

    said = r'artery.layers\[0\].material.law = "bare": expected a law with the quantities c and bulk$'
    human = jc.load_scene("human-lad")
    media = dataclasses.replace(human.artery.layers[0], material=Bare(c=20.0))
    artery = dataclasses.replace(human.artery, layers=(media, human.artery.layers[1]))
    try:
        with pytest.raises(jc.SceneError, match=said):
            jc.load_scene("human-lad", ["artery.layers[0].material={law='bare', c_kPa=20.0}"])
        with pytest.raises(jc.SceneError, match=said):
            jc.clamp(dataclasses.replace(human, artery=artery))
    finally:
        withdraw(Bare)


def test_two_files_with_a_name_in_common(folder, capsys):
    (folder / "others.py").write_text(PARTS.replace('print("hello from the file")', ""))
    jc.import_parts("parts.py")
    said = refused(capsys, "show", "human-lad", "--import", "others.py")
    assert said == (
        'others.py: jaw Tipped is called "tipped", as is Tipped of parts.py: expected another name'
    )
