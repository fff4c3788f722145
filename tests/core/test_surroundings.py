"""What process, settings and machine must be like: else one sentence, never a hang or an abort."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import jax
import pytest

import jaxclamp as jc
from jaxclamp.core import memory
from jaxclamp.core.starting import is_command_line
from jaxclamp.solve import memory as needs
from jaxclamp.solve import results

ROOT = Path(__file__).parents[2]
SMALL = ["mesh.circumferential=4", "mesh.axial=6", "mesh.radial=[1, 1]", "stop.occlusion=0.3"]
DOORS = {
    "clamp": jc.clamp,
    "evaluate": lambda scene: jc.evaluate(scene, jc.clamp_force()),
}


def script(text: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", text],
        env=os.environ | {"PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore"} | environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


# ------------------------------------------------------------------------------------- settings of JAX


@pytest.mark.parametrize("door", DOORS)
def test_settings_that_would_give_wrong_answers_are_named(door):
    scene = jc.load_scene("human-lad", SMALL)
    with jax.enable_x64(False), pytest.raises(jc.Unfit, match="jax_enable_x64 is off"):
        DOORS[door](scene)
    with jax.numpy_rank_promotion("raise"), pytest.raises(jc.Unfit, match="jax_numpy_rank_promotion is"):
        DOORS[door](scene)


def test_a_forked_process_is_told_what_works():
    """A fork of a process that only imported the package may compute; one that used JAX would hang."""
    text = """
import os, jaxclamp as jc, jax
scene = jc.load_scene("human-lad", ["mesh={circumferential=4, axial=6, radial=[1, 1]}"])
def forked():
    child = os.fork()
    if child == 0:
        from jaxclamp.core.surroundings import require_fit
        try:
            require_fit() if jax_is_new else jc.clamp(scene)
            os._exit(0)
        except jc.Unfit as error:
            os.write(1, str(error).encode())
            os._exit(4)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
jax_is_new = True
forked()
jax.devices()
jax_is_new = False
forked()
"""
    done = script(text)
    first, second = done.stdout.split("\n", 1)
    assert first == "0"
    assert second.endswith("4\n")
    assert "this process was forked from one that had used JAX" in second
    assert "get_context('spawn')" in second


# ------------------------------------------------------------------------------------- versions


def test_a_change_of_the_code_is_another_version(tmp_path):
    """Of what is computed with, of the place where it lies nothing."""
    here, there = ROOT / "jaxclamp", tmp_path / "jaxclamp"
    assert results.versions()["jaxclamp"] == f"{version('jaxclamp')}+{results._digest_of(here)}"
    shutil.copytree(here, there, ignore=shutil.ignore_patterns("__pycache__"))
    (there / "notes.txt").write_text("mine")
    assert results._digest_of(there) == results._digest_of(here)
    file = there / "core" / "tensors.py"
    file.write_text(file.read_text().replace("0.5", "0.6", 1))
    results._digest_of.cache_clear()
    assert results._digest_of(there) != results._digest_of(here)


# ------------------------------------------------------------------------------------- devices


def test_show_needs_no_accelerator(tmp_path):
    done = script("from jaxclamp.cli import main; print(main(['show', 'human-lad']))", JAX_PLATFORMS="cuda")
    assert (done.stdout[-2:], done.stderr) == ("0\n", "")


def test_no_device_is_exit_4_in_a_sentence(tmp_path):
    if any(device.platform == "gpu" for device in jax.devices()):
        pytest.skip("there is a GPU")
    text = "from jaxclamp.cli import main; print(main(['run', 'human-lad', '--json']))"
    done = script(text, JAX_PLATFORMS="cuda")
    assert done.stdout == "4\n"
    assert done.stderr.startswith("jaxclamp: JAX has no device of cuda here: set")
    assert len(done.stderr.splitlines()) == 1


# ------------------------------------------------------------------------------------- memory


@pytest.fixture
def proc(tmp_path, monkeypatch):
    """A machine with 4 GB left, of which a container may have 1024 MB and has 524, 100 of them files."""
    (tmp_path / "proc" / "self").mkdir(parents=True)
    (tmp_path / "proc" / "meminfo").write_text("MemTotal: 8388608 kB\nMemAvailable: 4194304 kB\n")
    (tmp_path / "proc" / "self" / "status").write_text("VmSize:\t 2097152 kB\nVmRSS:\t 262144 kB\n")
    (tmp_path / "proc" / "self" / "cgroup").write_text("0::/pod/job\n")
    job = tmp_path / "cgroup" / "pod" / "job"
    job.mkdir(parents=True)
    (job / "memory.max").write_text("max\n")
    (job / "memory.current").write_text("1\n")
    (job / "memory.stat").write_text("anon 5\ninactive_file 0\n")
    (job.parent / "memory.max").write_text(f"{1024 * 2**20}\n")
    (job.parent / "memory.current").write_text(f"{524 * 2**20}\n")
    (job.parent / "memory.stat").write_text(f"anon 5\ninactive_file {100 * 2**20}\n")
    monkeypatch.setattr(memory, "PROC", tmp_path / "proc")
    monkeypatch.setattr(memory, "CGROUPS", tmp_path / "cgroup")
    return tmp_path


def test_the_least_of_machine_and_container_is_what_is_left(proc):
    assert memory.limits_MB()[0] == (600.0, "the container")
    assert memory.resident_MB() == 256.0
    (proc / "cgroup" / "pod" / "memory.max").write_text("max\n")
    assert memory.limits_MB() == [(4096.0, "the machine")]


def test_containers_of_version_1_are_seen(proc):
    (proc / "proc" / "self" / "cgroup").write_text("3:cpu:/\n4:memory:/lost\n")
    (proc / "cgroup" / "memory").mkdir()
    (proc / "cgroup" / "memory" / "memory.limit_in_bytes").write_text(f"{300 * 2**20}\n")
    (proc / "cgroup" / "memory" / "memory.usage_in_bytes").write_text(f"{100 * 2**20}\n")
    (proc / "cgroup" / "memory" / "memory.stat").write_text("cache 1\n")
    assert memory.limits_MB()[0] == (200.0, "the container")


def test_a_scene_that_does_not_fit_is_refused_before_anything_is_solved(proc):
    """850 MB and 0.025 MB for each of 1400 unknowns, of which 256 are there: 629 MB, and 600 are left."""
    needs.require_memory(100)
    with pytest.raises(jc.TooLittleMemory, match=r"about 629 MB more, and the container leaves 600 MB: take"):
        needs.require_memory(1400)
    with pytest.raises(jc.TooLittleMemory, match=r"about 629 MB more"):  # those of coarser meshes count
        needs.require_memory(1000, 400)
    scene = jc.load_scene("human-lad", ["mesh={circumferential=10, axial=15, radial=[5, 3]}"])
    with pytest.raises(jc.TooLittleMemory, match="4266 unknowns"):
        jc.clamp(scene)


def test_processes_at_once_are_counted_together(proc, monkeypatch):
    """629 MB as above, and twice 885 MB; a limit on addresses is one for each."""
    (proc / "cgroup" / "pod" / "memory.max").write_text("max\n")
    needs.require_memory(1400, processes=3)
    (proc / "proc" / "meminfo").write_text("MemAvailable: 1048576 kB\n")
    with pytest.raises(jc.TooLittleMemory, match=r"^3 starts at once, each of 1400 unknowns, need about 239"):
        needs.require_memory(1400, processes=3)
    monkeypatch.setattr(memory, "_of_machine", lambda: (1024.0, memory.ADDRESSES))
    needs.require_memory(1400, processes=3)


def test_where_the_system_does_not_tell_nothing_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(memory, "PROC", tmp_path)
    assert memory.limits_MB() == []
    needs.require_memory(10**9)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="Linux tells")
def test_a_limit_on_addresses_is_exit_4_in_a_sentence():
    text = """
import resource
from jaxclamp.cli import main
from jaxclamp.core import memory
size = memory._kB(memory.PROC / "self" / "status", "VmSize:")
resource.setrlimit(resource.RLIMIT_AS, (int(size * 1024) + 600 * 2**20,) * 2)  # JAX itself takes up to 450
print(main(["run", "human-lad", "--json"]))
"""
    done = script(text)
    assert done.stdout == "4\n"
    assert "ulimit -v leaves" in done.stderr
    assert len(done.stderr.splitlines()) == 1


# ------------------------------------------------------------------------------------- the command line


@pytest.mark.parametrize(
    ("started_as", "is_it"),
    [
        (["python", "/usr/bin/jaxclamp", "show"], True),
        (["python", "-X", "dev", "-P", "-m", "jaxclamp", "run"], True),
        (["python", "-m", "pytest", "jaxclamp"], False),
        (
            ["python", "-c", "from multiprocessing.spawn import ...", "--multiprocessing-fork"],
            False,
        ),
        (["python", "my_script.py", "jaxclamp"], False),
        (["python"], False),
    ],
)
def test_the_command_line_knows_itself(started_as, is_it):
    assert is_command_line(started_as) is is_it
