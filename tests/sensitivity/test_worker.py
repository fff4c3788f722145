"""The process behind compiled programs: it takes what scripts define, says nothing, and may die."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from jaxclamp.core.failures import EquilibriumError, NotConverged, WorkerLost
from jaxclamp.sensitivity.worker import call_elsewhere

ROOT = Path(__file__).parents[2]

OWN_PARTS = """
import jax, jax.numpy as jnp, jaxclamp as jc
from jaxclamp.core.records import quantity, record, static
from jaxclamp.physics.jaws import Jaw
from jaxclamp.physics.materials import Material
from jaxclamp.sensitivity.worker import call_elsewhere

@record
class Bar(Jaw):
    shape: str = static("own bar")
    radius: jax.Array = quantity("mm", 0.0, 1e4)
    def gap(self, p):
        return jnp.sqrt((p[1] - self.radius) ** 2 + p[2] ** 2) - self.radius
    def half_extent(self):
        return self.radius
    def curvatures(self):
        return jnp.ones(1) / self.radius

@record
class Own(Material):
    law: str = static("own law")
    c: jax.Array = quantity("kPa", 0.0, 1e6)
    bulk: jax.Array = quantity("kPa", 0.0, 1e9)
    def psi_bar(self, F):
        J = jc_det(F)
        return 0.5 * self.c * (sum(F[i, j] ** 2 for i in range(3) for j in range(3)) * J ** (-2 / 3) - 3.0)

def jc_det(F):
    minor = lambda i, j, k, l: F[1, i] * F[2, j] - F[1, k] * F[2, l]
    return F[0, 0] * minor(1, 2, 2, 1) - F[0, 1] * minor(0, 2, 2, 0) + F[0, 2] * minor(0, 1, 1, 0)

scene = jc.load_scene(
    "human-lad", ["mesh.circumferential=4", "mesh.axial=6", "mesh.radial=[1, 1]", "stop.occlusion=0.6"]
)
scene = jc.replace(scene, "clamp.jaw", Bar(radius=3.0))
scene = jc.replace(scene, "artery.layers[1].material", Own(c=20.0, bulk=1e4))
"""

TRAVELS = """
def seen(scene):
    leaves = jax.tree_util.tree_leaves(scene)
    return scene, len(leaves), float(scene.clamp.jaw.gap((0.0, 0.0, 4.0)))

again, leaves, gap = call_elsewhere(seen, scene)
assert again == scene and type(again.clamp.jaw) is Bar
assert leaves == len(jax.tree_util.tree_leaves(scene))
assert gap == 2.0, gap

radius = lambda c: jc.evaluate(
    jc.replace(scene, "artery.layers[1].material.c", c), jc.physiological_lumen_radius()
)
direct, (compiled,) = float(radius(25.0)), jax.jit(jax.vmap(radius))(jnp.array([25.0]))
assert abs(direct - compiled) < 1e-9 * direct, (direct, compiled)
print("done")
"""

COMPILED = """
force = lambda r: jc.evaluate(jc.replace(scene, "clamp.jaw.radius", r), jc.clamp_force())
direct = [float(force(r)) for r in (2.9, 3.1)]
radii = jnp.array([2.9, 3.1])
for found in (jax.vmap(force)(radii), jax.lax.map(force, radii), [jax.jit(force)(r) for r in radii]):
    assert max(abs(a - b) for a, b in zip(direct, found)) < 1e-6 * direct[0], (direct, found)
print("done")
"""


def script(text: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a script, in a folder whose modules would stop it if anything imported them."""
    (folder / "scripts").mkdir()
    path = folder / "scripts" / "mine.py"
    path.write_text(text)
    for name in ("jax", "cloudpickle", "argparse", "pickle"):
        (folder / f"{name}.py").write_text(f"raise SystemExit('{name}.py was executed')")
    return subprocess.run(
        [sys.executable, str(path)],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.mark.parametrize("use", [TRAVELS, pytest.param(COMPILED, marks=pytest.mark.slow)])
def test_jaws_and_laws_of_a_script_reach_the_process(tmp_path, use):
    """With warnings as errors, and modules in the current folder that are named like others."""
    done = script(OWN_PARTS + use, tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "done\n", "")


def refuse() -> None:
    raise EquilibriumError("clamping", "at 2 mm", NotConverged("cut"), "refine")


def divide() -> float:
    return 1 / 0


def end() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_errors_come_back_as_what_they_are():
    with pytest.raises(EquilibriumError, match="in stage 'clamping', at 2 mm: cut; refine"):
        call_elsewhere(refuse)
    with pytest.raises(RuntimeError, match="ZeroDivisionError: division by zero"):
        call_elsewhere(divide)


def test_after_its_death_another_is_started():
    first = call_elsewhere(os.getpid)
    with pytest.raises(WorkerLost, match="has ended, perhaps for lack of memory; the next call starts"):
        call_elsewhere(end)
    assert call_elsewhere(os.getpid) not in (first, os.getpid())


def test_what_it_prints_is_kept_apart_from_its_answers(capfd):
    assert call_elsewhere(print, "hello") is None
    assert capfd.readouterr().out == ""


def test_a_failure_in_a_callback_is_not_logged_with_a_traceback(caplog):
    log = logging.getLogger("jax._src.callback")
    for error in (ValueError("a bug"), WorkerLost("one sentence")):
        try:
            raise error
        except Exception:
            log.exception("failed")
    assert [str(record.exc_info[1]) for record in caplog.records] == ["a bug"]
