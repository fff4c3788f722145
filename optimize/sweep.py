"""Many scenes as independent jobs on dask: what is on disk stays, and a second start does the rest.

The driver writes the folder of each job, whole, as its answer comes; workers write nothing, so that they need
no disk in common. `results.parquet` is gathered from the folders in the end.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from jaxclamp import BadFolder, EquilibriumError, Failure, Progress, by_value, clamp, versions
from jaxclamp.scenes.files import loads_scene
from jaxclamp.show.console import as_json
from optimize.journal import write_bytes, write_whole
from optimize.sweep_file import Job, Sweep

DONE, NOT_CONVERGED, REFUSED = "done", "not converged", "refused"
TIMED_OUT, DIED, FAILED = "timed out", "died", "failed"
"""of a job: the process that solved it ended; something else went wrong"""
AGAIN = (TIMED_OUT, DIED)
"""what a second start tries again"""
SWEEP, JOBS, RESULTS, RECORD, RESULT, SCENE = (
    "sweep.json",
    "jobs",
    "results.parquet",
    "job.json",
    "result.json",
    "scene.toml",
)
MOST_TRIES, PAUSE = 3, 5.0
"""times that a job is sent, or that a lost scheduler is looked for; seconds between"""


class NoDask(Failure):
    """The packages of the extra are not there."""

    exit_code = 2


@dataclasses.dataclass(frozen=True)
class Cluster:
    """Where jobs are solved."""

    workers: int | None = None
    """processes on this machine; None: one for each core"""
    scheduler: str | None = None
    """address of a dask scheduler; None: this machine's own"""


def solve_job(text: str) -> dict[str, Any]:
    """The record of a scene: status, failure, seconds and the content of result.json. A pure function."""
    begun = time.perf_counter()
    status, failure, result = DONE, None, None
    try:
        result = clamp(loads_scene(text)).to_dict()
    except EquilibriumError as error:
        status, failure = NOT_CONVERGED, str(error)
        result = None if error.result is None else error.result.to_dict()
    except Failure as error:
        status, failure = FAILED, str(error)
    record = {"status": status, "failure": failure, "seconds": time.perf_counter() - begun}
    return record | {"result": None if result is None else as_json(result)}


def run_sweep(
    sweep: Sweep,
    folder: Path,
    cluster: Cluster | None = None,
    resume: bool = False,
    progress: Callable[[Progress], Any] | None = None,
) -> list[dict[str, Any]]:
    """Solve the jobs that are not in the folder yet; the rows of all of them, as in results.parquet.

    Raises BadFolder for a folder of something else, NoDask without the extra `sweep`, OSError.
    """
    tell = progress or (lambda event: None)
    require_packages()
    with held(folder, sweep, resume):
        todo = []
        for job in sweep.jobs:
            if _status(folder, job) not in (None, *AGAIN):
                continue
            if job.text is None:
                write_job(folder, job, {"status": REFUSED, "failure": job.refusal, "seconds": 0.0})
            else:
                todo.append(job)
        try:
            if todo:
                with connected(cluster or Cluster()) as (client, local):
                    _Driver(sweep, folder, client, local, len(todo), tell).run(todo)
        finally:
            rows = gather(sweep, folder)
    return rows


def require_packages() -> None:
    """Raise NoDask unless the extra `sweep` is installed."""
    try:
        import distributed
        import pyarrow
    except ImportError as error:
        said = f"a sweep needs the package {error.name}: pip install 'jaxclamp[sweep]'"
        raise NoDask(said) from None
    _ = distributed, pyarrow


# ---------------------------------------------------------------------------------- on disk


@contextmanager
def held(folder: Path, sweep: Sweep, resume: bool) -> Iterator[None]:
    """Have the folder to oneself, as that of this sweep. Raises BadFolder."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / ".sweep.lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise BadFolder(f"{folder}: another sweep is writing there") from None
    try:
        known = folder / SWEEP
        if known.exists():
            found = _read(known).get("digest")
            if found != sweep.digest:
                raise BadFolder(f"{folder} holds another sweep: take another folder")
            if not resume:
                raise BadFolder(f"{folder} holds this sweep already: continue it with --resume")
        elif (folder / JOBS).exists():
            raise BadFolder(f"{folder}: {JOBS} there is not of a sweep: take another folder")
        (folder / JOBS).mkdir(exist_ok=True)
        for left in (folder / JOBS).glob(".*"):  # of a driver that was killed
            shutil.rmtree(left, ignore_errors=True)
        head = {"title": sweep.title, "digest": sweep.digest, "jobs": len(sweep.jobs), "versions": versions()}
        write_whole(known, as_json(head) + "\n")
        yield
    finally:
        lock.release()


def _read(path: Path) -> dict[str, Any]:
    """A JSON file; empty if it cannot be read."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def place_of(folder: Path, job: Job) -> Path:
    """The folder of a job."""
    return folder / JOBS / f"{job.number:06d}"


def _status(folder: Path, job: Job) -> str | None:
    return _read(place_of(folder, job) / RECORD).get("status")


def write_job(folder: Path, job: Job, record: dict[str, Any]) -> None:
    """Write the folder of a job: it is there whole, or not at all."""
    place = place_of(folder, job)
    new = place.with_name(f".{place.name}")
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir()
    if job.text is not None:
        write_whole(new / SCENE, job.text)
    if record.get("result"):
        write_whole(new / RESULT, record["result"] + "\n")
    head = {"job": job.number, "name": job.name, "varied": job.varied}
    kept = {key: record[key] for key in ("status", "failure", "seconds")}
    write_whole(new / RECORD, as_json(head | kept) + "\n")
    shutil.rmtree(place, ignore_errors=True)
    os.replace(new, place)


def gather(sweep: Sweep, folder: Path) -> list[dict[str, Any]]:
    """Rows of all jobs that are on disk, also as results.parquet."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = [row for job in sweep.jobs if (row := _row(folder, job)) is not None]
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {name: _column([row.get(name) for row in rows]) for name in names}
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table(columns), sink)
    write_bytes(folder / RESULTS, sink.getvalue().to_pybytes())
    return rows


def _row(folder: Path, job: Job) -> dict[str, Any] | None:
    """A job: itself, what is varied, how it ended, and every figure of `final`, KEY.LAYER for layers."""
    place = place_of(folder, job)
    record = _read(place / RECORD)
    if not record:
        return None
    row: dict[str, Any] = {"job": job.number, "name": job.name, **job.varied}
    row |= {key: record.get(key) for key in ("status", "failure", "seconds")}
    final = _read(place / RESULT).get("final") or {}
    for key, value in final.items():
        for part, one in value.items() if isinstance(value, dict) else [("", value)]:
            row[f"{key}.{part}" if part else key] = json.dumps(one) if isinstance(one, list | dict) else one
    return row


def _column(values: list[Any]) -> list[Any]:
    """Values of one type: text if any of them is, else numbers, or true and false."""
    if any(isinstance(value, str) for value in values):
        return [value if value is None or isinstance(value, str) else repr(value) for value in values]
    if any(isinstance(value, float) for value in values):
        return [None if value is None else float(value) for value in values]
    return values


# ---------------------------------------------------------------------------------- on dask


@contextmanager
def connected(cluster: Cluster) -> Iterator[tuple[Any, bool]]:
    """A client of the cluster, and whether that is this machine's own. Raises BadFolder if none answers."""
    from distributed import Client, LocalCluster

    if cluster.scheduler is not None:
        try:
            client = Client(cluster.scheduler, timeout=30)
        except (OSError, ValueError) as error:
            raise NoDask(f"--scheduler {cluster.scheduler}: no scheduler answers there ({error})") from None
        with client:
            yield client, False
        return
    count = cluster.workers or os.cpu_count() or 1
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with (
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            memory_limit=0,
            dashboard_address=None,
            silence_logs=50,
        ) as local,
        Client(local) as client,
    ):
        yield client, True


class _Driver:
    """A sweep under way: what is waiting, what is being solved, what is done."""

    def __init__(
        self,
        sweep: Sweep,
        folder: Path,
        client: Any,
        local: bool,
        count: int,
        tell: Callable[[Progress], Any],
    ) -> None:
        self.sweep, self.folder, self.client, self.local, self.tell = sweep, folder, client, local, tell
        self.count, self.done, self.begun = count, 0, time.perf_counter()
        self.waiting: deque[Job] = deque()
        self.flying: dict[Any, tuple[Job, float]] = {}
        self.tries: dict[int, int] = {}
        self.solved_by: dict[str, int] = {}
        """jobs of each process, by its address"""

    def run(self, jobs: list[Job]) -> None:
        """Solve the jobs, those of one mesh after another."""
        from distributed import wait

        self.waiting.extend(sorted(jobs, key=lambda job: job.shape))
        self.tell(Progress("sweep", 0.0, f"{self.count} jobs"))
        lost = 0
        while self.waiting or self.flying:
            try:
                self._send()
                with suppress(TimeoutError):
                    wait(list(self.flying), timeout=1.0, return_when="FIRST_COMPLETED")
                for future in [future for future in self.flying if future.done()]:
                    self._take(future)
                self._end_late_ones()
                lost = 0
            except OSError as error:  # the scheduler went; what flew is sent again
                lost += 1
                if lost > MOST_TRIES:
                    raise NoDask(
                        f"the scheduler is lost ({error}): what is done is in {self.folder}"
                    ) from None
                self._recall()
                time.sleep(PAUSE)

    def _send(self) -> None:
        """A job to each process that has none; more would only wait there."""
        room = max(1, len(self.client.scheduler_info(n_workers=-1)["workers"]))
        while self.waiting and len(self.flying) < room:
            job = self.waiting.popleft()
            tried = self.tries[job.number] = self.tries.get(job.number, 0) + 1
            key = f"job-{job.number}-{tried}"
            future = self.client.submit(by_value(_at_worker, job.text), key=key, pure=False)
            self.flying[future] = job, time.perf_counter()

    def _take(self, future: Any) -> None:
        """Write down what a job came to."""
        job, _ = self.flying.pop(future)
        if future.status in ("cancelled", "lost"):
            self._once_more(job, "its process was lost")
            return
        error = future.exception()
        if error is None:
            record = future.result()
            self._write(job, record)
            self._renew(record["worker"])
        elif type(error).__name__ == "KilledWorker":
            self._write(
                job, {"status": DIED, "failure": "the processes that solved it ended", "seconds": None}
            )
        else:
            said = f"{type(error).__name__}: {error}"
            self._write(job, {"status": FAILED, "failure": said, "seconds": None})
        future.release()

    def _once_more(self, job: Job, why: str) -> None:
        if self.tries.get(job.number, 0) < MOST_TRIES:
            self.waiting.appendleft(job)
        else:
            self._write(job, {"status": DIED, "failure": why, "seconds": None})

    def _end_late_ones(self) -> None:
        """End the processes of jobs that take too long."""
        now, limit = time.perf_counter(), self.sweep.time_limit_s
        late = [future for future, (_, sent) in self.flying.items() if now - sent > limit]
        if not late:
            return
        busy = self.client.processing()
        for future in late:
            job, _ = self.flying.pop(future)
            where = [address for address, keys in busy.items() if future.key in map(str, keys)]
            future.cancel()
            self._write(job, {"status": TIMED_OUT, "failure": f"more than {limit:g} s", "seconds": limit})
            self._restart(where)

    def _renew(self, address: str) -> None:
        """Replace a process that has solved enough: what it keeps in memory goes with it."""
        self.solved_by[address] = self.solved_by.get(address, 0) + 1
        if self.local and self.solved_by[address] >= self.sweep.jobs_per_worker:
            self.solved_by[address] = 0
            self._restart([address])

    def _restart(self, addresses: list[str]) -> None:
        if addresses:
            with suppress(Exception):  # it may have gone by itself; a cluster may not restart workers
                self.client.restart_workers(addresses, timeout=30, raise_for_error=False)

    def _recall(self) -> None:
        """Have all that flies wait again."""
        for job, _ in self.flying.values():
            self.waiting.appendleft(job)
        self.flying.clear()

    def _write(self, job: Job, record: dict[str, Any]) -> None:
        write_job(self.folder, job, record)
        self.done += 1
        left = (self.count - self.done) * (time.perf_counter() - self.begun) / self.done
        said = f"job {job.number}: {record['status']}, about {left:.0f} s left"
        self.tell(Progress("sweep", self.done / self.count, said))


def _at_worker(text: str) -> dict[str, Any]:
    """The same in a process of the cluster, with its address."""
    from distributed import get_worker

    return solve_job(text) | {"worker": get_worker().address}
