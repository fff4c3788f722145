"""Sweeps: what a file asks for, jobs on dask, and that nothing is lost or done twice whatever dies."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import jaxclamp as jc
from jaxclamp.cli import main
from jaxclamp.scenes.files import loads_scene
from optimize import sweep as driver
from optimize.sweep import Cluster, run_sweep, solve_job
from optimize.sweep_file import load_sweep
from optimize.sweep_report import page

COARSE = ["mesh.circumferential=5", "mesh.axial=6", "mesh.radial=[2, 1]", "stop.occlusion=0.5"]
HEAD = f"""
title = "Radius and pressure"
scene = "human-lad"
set = {json.dumps(COARSE)}
"""
RADII = '[[vary]]\nkey = "clamp.jaw.radius_mm"\nvalues = [2.0, 3.0, -1.0]\n'
PRESSURES = '[[vary]]\nkey = "artery.pressure_kPa"\nlower = 10.0\nupper = 16.0\n'


def written(tmp_path, text):
    path = tmp_path / "s.toml"
    path.write_text(text, encoding="utf-8")
    return path


def table(folder):
    return pq.read_table(folder / "results.parquet").to_pylist()


# --- the file ---------------------------------------------------------------------------------------


def test_a_grid_with_a_latin_hypercube(tmp_path):
    sweep = load_sweep(written(tmp_path, HEAD + "samples = 4\n" + RADII + PRESSURES))
    assert len(sweep.jobs) == 12
    assert [job.number for job in sweep.jobs] == list(range(1, 13))
    pressures = np.array([job.varied["artery.pressure_kPa"] for job in sweep.jobs]).reshape(3, 4)
    # each sample lies in a quarter of its own, and every radius meets all of them
    assert sorted(((pressures[0] - 10.0) // 1.5).tolist()) == [0.0, 1.0, 2.0, 3.0]
    np.testing.assert_array_equal(pressures, np.tile(pressures[0], (3, 1)))
    assert [job.refusal is None for job in sweep.jobs] == [True] * 8 + [False] * 4
    assert "radius_mm = -1.0" in sweep.jobs[-1].refusal
    again = load_sweep(tmp_path / "s.toml")
    assert again.digest == sweep.digest
    other = load_sweep(written(tmp_path, HEAD + "samples = 4\nseed = 1\n" + RADII + PRESSURES))
    assert other.digest != sweep.digest


def test_rows_of_a_csv_file(tmp_path):
    (tmp_path / "patients.csv").write_text(
        "name,artery.pressure_kPa,clamp\nA,12.5,\nB,,yasargil-like\nC,much,\n", encoding="utf-8"
    )
    jobs = load_sweep(written(tmp_path, HEAD + 'csv = "patients.csv"\n')).jobs
    assert [job.name for job in jobs] == ["A", "B", "C"]
    assert jobs[0].varied == {"artery.pressure_kPa": 12.5}
    assert "hinge_distance_mm" in jobs[1].text
    assert "expected a number" in jobs[2].refusal


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "nothing is varied"),
        ("samples = 3\n" + RADII, "there are no ranges"),
        (PRESSURES, "samples is missing: expected a whole number"),
        (RADII + RADII, "it is varied already"),
        ("samples = 2\n" + PRESSURES.replace("16.0", "9.0"), "lower = 10 is not below upper = 9"),
        ("samples = 2\n" + PRESSURES.replace("pressure_kPa", "presure_kPa"), "pressure_kPa"),
        ('csv = "none.csv"\n', "No such file"),
        ("[[vary]]\nkey = 'a'\n", "expected key with values, or key with lower and upper"),
        ("sample = 3\n" + RADII, "did you mean samples?"),
        ("[[vary]]\nkey = 'artery.pressure_kPa'\nvalues = [2020-01-01]\n", "dates and times are no values"),
        ("time_limit_s = -1\n" + RADII, "time_limit_s = -1: expected a number from 1"),
    ],
)
def test_a_wrong_file_is_one_sentence_and_exit_code_2(tmp_path, capsys, text, said):
    path = written(tmp_path, HEAD + text)
    assert main(["sweep", str(path), "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"jaxclamp: {path}: ")
    assert said in line
    assert not (tmp_path / "out").exists()


# --- on disk ----------------------------------------------------------------------------------------


@pytest.fixture
def solved(monkeypatch):
    """A stand-in for the cluster: jobs are answered at once; hears which."""
    asked, answers = [], {}

    class Stand:
        def __init__(self, sweep, folder, client, local, count, tell):
            self.folder = folder

        def run(self, jobs):
            for job in jobs:
                asked.append(job.number)
                record = answers.get(job.number, {"status": "done"})
                if isinstance(record, BaseException):
                    raise record
                final = {"clamp_force_N": 0.1 * job.number, "peak": {"media": 1.0}}
                whole = {"failure": None, "seconds": 1.0, "result": json.dumps({"final": final})}
                driver.write_job(self.folder, job, whole | record)

    monkeypatch.setattr(driver, "_Driver", Stand)
    monkeypatch.setattr(driver, "connected", lambda cluster: contextlib.nullcontext((None, None)))
    return asked, answers


def test_a_second_start_solves_what_is_missing(tmp_path, solved):
    asked, answers = solved
    sweep = load_sweep(written(tmp_path, HEAD + "samples = 2\n" + RADII + PRESSURES))
    answers[2] = {"status": "timed out", "failure": "more than 1 s", "result": None}
    answers[3] = KeyboardInterrupt()
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        run_sweep(sweep, out)
    assert [(row["job"], row["status"]) for row in table(out)] == [
        (1, "done"),
        (2, "timed out"),
        (5, "refused"),
        (6, "refused"),
    ]
    with pytest.raises(jc.Failure, match="continue it with --resume"):
        run_sweep(sweep, out)
    answers.clear()
    rows = run_sweep(sweep, out, resume=True)
    assert asked == [1, 2, 3, 2, 3, 4]
    assert [row["status"] for row in rows] == ["done"] * 4 + ["refused"] * 2
    assert [row["clamp_force_N"] for row in table(out)] == [pytest.approx(0.1 * i) for i in range(1, 5)] + [
        None,
        None,
    ]
    assert table(out)[0]["peak.media"] == 1.0
    assert sorted(path.name for path in (out / "jobs").iterdir()) == [f"{i:06d}" for i in range(1, 7)]


def test_a_folder_of_something_else_is_refused(tmp_path, solved):
    sweep = load_sweep(written(tmp_path, HEAD + "samples = 2\n" + RADII + PRESSURES))
    run_sweep(sweep, tmp_path / "out")
    other = load_sweep(written(tmp_path, HEAD + "samples = 3\n" + RADII + PRESSURES))
    with pytest.raises(jc.Failure, match="holds another sweep"):
        run_sweep(other, tmp_path / "out", resume=True)
    (tmp_path / "there" / "jobs").mkdir(parents=True)
    with pytest.raises(jc.Failure, match="is not of a sweep"):
        run_sweep(sweep, tmp_path / "there")


def test_answers_of_other_versions_are_not_mixed(tmp_path, solved):
    sweep, out = load_sweep(written(tmp_path, HEAD + RADII)), tmp_path / "out"
    run_sweep(sweep, out)
    head = json.loads((out / "sweep.json").read_text())
    head["versions"]["jaxclamp"] = "0.0.1+abc"
    (out / "sweep.json").write_text(json.dumps(head))
    with pytest.raises(jc.BadFolder, match=r"holds answers of jaxclamp 0\.0\.1\+abc, and this is"):
        run_sweep(sweep, out, resume=True)


def test_lists_and_mixed_values_are_texts_in_the_table(tmp_path, solved):
    text = '[[vary]]\nkey = "mesh.radial"\nvalues = [[2, 1], 4, true]\n'
    sweep = load_sweep(written(tmp_path, HEAD + text))
    rows = run_sweep(sweep, tmp_path / "out")
    assert [row["mesh.radial"] for row in table(tmp_path / "out")] == ["[2, 1]", "4", "true"]
    assert "[2, 1]" in page(sweep, rows, [])


def test_without_the_extra_one_sentence_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    path = written(tmp_path, HEAD + RADII)
    assert main(["sweep", str(path), "--out", str(tmp_path / "out")]) == 2
    assert "pip install 'jaxclamp[sweep]'" in capsys.readouterr().err


def test_a_job_has_the_answer_of_its_scene():
    scene = jc.load_scene("human-lad", COARSE)
    record = solve_job(loads_scene(jc.dump_scene(scene)))
    assert record["status"] == "done"
    force = json.loads(record["result"])["final"]["clamp_force_N"]
    assert force == pytest.approx(jc.clamp(scene).final["clamp_force_N"], rel=1e-12)


# --- on dask ----------------------------------------------------------------------------------------


class FakeFuture:
    """A task that never ends."""

    status = "pending"

    def __init__(self, key):
        self.key, self.cancelled = key, False

    def done(self):
        return False

    def cancel(self):
        self.cancelled = True

    def release(self):
        pass


class FakeClient:
    """A scheduler of one process that nothing reaches."""

    def __init__(self):
        self.sent, self.restarted = [], []

    def scheduler_info(self, n_workers):
        return {"workers": {"a": {}}}

    def submit(self, task, key, pure):
        self.sent.append(FakeFuture(key))
        return self.sent[-1]

    def restart_workers(self, addresses, timeout, raise_for_error):
        self.restarted += addresses


def started(tmp_path, client):
    sweep = load_sweep(written(tmp_path, "time_limit_s = 1\n" + HEAD + RADII))
    found = driver._Driver(sweep, tmp_path, client, None, 1, lambda event: None)
    found.waiting.extend(sweep.jobs[:1])
    found._send()
    return found


def test_no_two_starts_have_a_key_in_common(tmp_path):
    """Dask answers a key that it knows with what it has, whoever asks."""
    client = FakeClient()
    for _ in range(2):
        started(tmp_path, client)
    assert len({future.key for future in client.sent}) == 2


def test_time_spent_waiting_for_a_process_is_not_of_the_limit(tmp_path):
    client = FakeClient()
    begun = started(tmp_path, client)
    (future,) = client.sent
    time.sleep(1.1)
    assert begun._late({future}) == {}
    begun._begins((0.0, {"key": future.key, "worker": "a"}))
    assert begun._late({future}) == {}
    time.sleep(1.1)
    assert begun._late({future})[future]["status"] == "timed out"
    assert future.cancelled
    assert client.restarted == ["a"]


def sweep_command(path, out, *more):
    root = str(Path(__file__).parents[2])
    environment = os.environ | {"PYTHONPATH": root}
    return [sys.executable, "-m", "jaxclamp", "sweep", str(path), "--out", str(out), *more], environment


@pytest.mark.parametrize(("workers", "each"), [(1, 500), pytest.param(2, 1, marks=pytest.mark.slow)])
def test_processes_solve_a_sweep(tmp_path, workers, each):
    """In one process, and in two that are replaced after every job."""
    samples = 4 * workers - 3
    text = HEAD + f"samples = {samples}\njobs_per_worker = {each}\n" + RADII.replace("3.0, ", "") + PRESSURES
    out = tmp_path / "out"
    command, environment = sweep_command(written(tmp_path, text), out, "--workers", str(workers), "--json")
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)
    assert [row["status"] for row in rows] == ["done"] * samples + ["refused"] * samples
    assert [row["job"] for row in table(out)] == list(range(1, 2 * samples + 1))
    assert all(row["clamp_force_N"] > 0.0 for row in rows[:samples])
    assert (out / "report.html").stat().st_size > 10_000
    written_at = {path: path.stat().st_mtime_ns for path in (out / "jobs").rglob("*.json")}
    assert main([*command[3:], "--resume"]) == 0  # nothing is left to do
    assert {path: path.stat().st_mtime_ns for path in (out / "jobs").rglob("*.json")} == written_at


OWN = """
import jax
import jax.numpy as jnp
import jaxclamp as jc

@jc.record
class Round(jc.Jaw):
    shape: str = jc.static("round")
    half_width: jax.Array = jc.quantity("mm", 0.0, 1e3, open_lower=True)
    radius: jax.Array = jc.quantity("mm", 0.0, 1e3, open_lower=True)
    sides: int = jc.static(2)

    def gap(self, point):
        return jnp.sqrt((point[1] - self.radius) ** 2 + point[2] ** 2) - self.radius

    def half_extent(self):
        return self.radius

    def curvatures(self):
        return jnp.reshape(1.0 / self.radius, 1)
"""


@pytest.mark.slow
def test_parts_of_ones_own_go_to_the_processes(tmp_path):
    own = tmp_path / "own.py"
    own.write_text(OWN, encoding="utf-8")
    jaw = "values = [{ jaw = { shape = 'round', half_width_mm = 1.0, radius_mm = 3.0 } }]"
    path, out = written(tmp_path, f"{HEAD}[[vary]]\nkey = 'clamp'\n{jaw}\n"), tmp_path / "out"
    command, environment = sweep_command(path, out, "--workers", "1", "--import", str(own))
    subprocess.run(command, env=environment, capture_output=True, timeout=200, check=True)
    assert [row["status"] for row in table(out)] == ["done"]
    own.write_text(OWN + "# another\n", encoding="utf-8")
    again = subprocess.run(
        [*command, "--resume"], env=environment, capture_output=True, text=True, timeout=200, check=False
    )
    assert again.returncode == 2
    assert "holds another sweep" in again.stderr


@pytest.mark.slow
def test_a_job_that_takes_too_long_is_ended(tmp_path):
    slow = HEAD.replace("mesh.axial=6", "mesh.axial=40").replace(
        "mesh.circumferential=5", "mesh.circumferential=30"
    )
    path = written(tmp_path, slow + "time_limit_s = 3\n" + RADII)
    rows = run_sweep(load_sweep(path), tmp_path / "out", Cluster(workers=2))
    assert [row["status"] for row in rows] == ["timed out", "timed out", "refused"]


def python(*words):
    """A process of dask's own command line."""
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen([sys.executable, "-m", *map(str, words)], env=environment, **quiet)


@contextlib.contextmanager
def cluster_at(port):
    """A scheduler with one worker."""
    address = f"tcp://127.0.0.1:{port}"
    started = [
        python("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard"),
        python("distributed.cli.dask_worker", address, "--nthreads", 1, "--no-dashboard"),
    ]
    try:
        yield address
    finally:
        for process in started:
            process.kill()
            process.wait()


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.mark.slow
def test_two_sweeps_on_one_scheduler_have_their_own_answers(tmp_path):
    running = []
    with cluster_at(free_port()) as address:
        for name, pressures in (("a", [10.0, 11.0]), ("b", [15.0, 16.0])):
            path = tmp_path / f"{name}.toml"
            path.write_text(f"{HEAD}[[vary]]\nkey = 'artery.pressure_kPa'\nvalues = {pressures}\n")
            command, environment = sweep_command(path, tmp_path / name, "--scheduler", address, "--quiet")
            running.append(subprocess.Popen(command, env=environment))
        assert [process.wait(timeout=200) for process in running] == [0, 0]
    for name in "ab":
        for job in sorted((tmp_path / name / "jobs").iterdir()):
            asked = json.loads((job / "job.json").read_text())["varied"]["artery.pressure_kPa"]
            solved = json.loads((job / "result.json").read_text())["scene"]["artery"]["pressure_kPa"]
            assert solved == asked


@pytest.mark.slow
@pytest.mark.parametrize("returns", [False, True])
def test_a_scheduler_that_is_lost(tmp_path, returns):
    """It is found again, or one sentence says so; what is done stays."""
    path, out, port = written(tmp_path, HEAD + "samples = 20\n" + PRESSURES), tmp_path / "out", free_port()
    with cluster_at(port) as address:
        command, environment = sweep_command(path, out, "--scheduler", address, "--quiet")
        running = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
        end = time.monotonic() + 100.0
        while len(list(out.glob("jobs/0*"))) < 2 and time.monotonic() < end:
            time.sleep(0.2)
    with cluster_at(port) if returns else contextlib.nullcontext():
        said = running.communicate(timeout=200)[1]
    rows = table(out)
    assert {row["status"] for row in rows} == {"done"}
    if returns:
        assert (running.returncode, len(rows), said) == (0, 20, "")
    else:
        assert running.returncode == 2
        assert len(said.splitlines()) == 1
        assert "is lost: go on with --resume" in said


@pytest.mark.slow
def test_two_processes_solve_more_than_one(tmp_path):
    """Seconds of 40 jobs, without those of starting; a machine of two busy cores allows no sharp bound."""
    path = written(tmp_path, HEAD + "samples = 40\n" + PRESSURES)
    seconds = []
    for workers in (1, 2):
        times = []
        run_sweep(
            load_sweep(path),
            tmp_path / str(workers),
            Cluster(workers),
            progress=lambda event, times=times: times.append(time.perf_counter()),
        )
        assert len(times) == 41
        seconds.append(times[-1] - times[10])
    assert seconds[1] < seconds[0], seconds


@pytest.mark.slow
def test_nothing_is_lost_or_done_twice_whatever_dies(tmp_path):
    """Processes and driver are killed at random; it is started again until nothing is missing."""
    count = int(os.environ.get("SWEEP_JOBS", "60"))
    path = written(tmp_path, HEAD + f"samples = {count}\n" + PRESSURES)
    out, chance, killed, starts = tmp_path / "out", random.Random(0), 0, 0
    while True:
        starts += 1
        command, environment = sweep_command(
            path, out, "--workers", "2", *(["--resume"] if starts > 1 else [])
        )
        running = subprocess.Popen(
            command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        end = time.monotonic() + chance.uniform(25.0, 60.0)
        while running.poll() is None and time.monotonic() < end:
            time.sleep(chance.uniform(4.0, 10.0))
            found = subprocess.run(
                ["pgrep", "-P", str(running.pid)], capture_output=True, text=True, check=False
            )
            children = [int(pid) for pid in found.stdout.split()]
            if children:
                killed += 1
                os.kill(chance.choice(children), signal.SIGKILL)
        if running.poll() is None:
            running.kill()
            running.wait()
            killed += 1
        if running.returncode == 0:
            break
        assert starts < 100
    rows = table(out)
    assert killed >= 3, starts
    assert [row["job"] for row in rows] == list(range(1, count + 1))
    assert [row["status"] for row in rows] == ["done"] * count
    assert len(list((out / "jobs").iterdir())) == count
