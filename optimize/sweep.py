"""Many scenes as independent jobs on dask: what is on disk stays, and a second start does the rest.

The driver writes the folder of each job, whole, as its answer comes; workers write nothing, so that they need
no disk in common. `results.parquet` is gathered from the folders in the end.
"""

from __future__ import annotations

import dataclasses
import itertools
import logging
import os
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from jaxclamp import EquilibriumError, Failure, Progress, Scene, by_value, clamp
from jaxclamp.scenes.files import loads_scene
from jaxclamp.show.console import as_json
from optimize.sweep_file import Job, Sweep
from optimize.sweep_folder import (
    AGAIN,
    DIED,
    DONE,
    FAILED,
    NOT_CONVERGED,
    REFUSED,
    TIMED_OUT,
    gather,
    held,
    status_of,
    write_job,
)

MOST_TRIES, PATIENCE = 3, 30.0
"""times that a job is sent, or that a scheduler may be lost in a row; seconds that one is looked for"""


class NoDask(Failure):
    """The packages of the extra, or the scheduler, are not there."""

    exit_code = 2


@dataclasses.dataclass(frozen=True)
class Cluster:
    """Where jobs are solved."""

    workers: int | None = None
    """processes on this machine; None: one for each core"""
    scheduler: str | None = None
    """address of a dask scheduler; None: this machine's own"""


def solve_job(scene: Scene) -> dict[str, Any]:
    """The record of a scene: status, failure, seconds and the content of result.json. A pure function."""
    begun = time.perf_counter()
    status, failure, result = DONE, None, None
    try:
        result = clamp(scene).to_dict()
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
            if status_of(folder, job) not in (None, *AGAIN):
                continue
            if job.text is None:
                write_job(folder, job, {"status": REFUSED, "failure": job.refusal, "seconds": 0.0})
            else:
                todo.append(job)
        try:
            if todo:
                with connected(cluster or Cluster()) as (client, scheduler):
                    _Driver(sweep, folder, client, scheduler, len(todo), tell).run(todo)
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


# ---------------------------------------------------------------------------------- on dask


@contextmanager
def connected(cluster: Cluster) -> Iterator[tuple[Any, str | None]]:
    """A client of the cluster, and its address unless it is this machine's own.

    Raises NoDask if no scheduler answers.
    """
    from distributed import Client, LocalCluster

    if cluster.scheduler is not None:
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # said in words of ours
        try:
            client = Client(cluster.scheduler, timeout=PATIENCE)
        except (OSError, ValueError) as error:
            raise NoDask(f"--scheduler {cluster.scheduler}: no scheduler answers there ({error})") from None
        with client:
            yield client, cluster.scheduler
        return
    count = cluster.workers or os.cpu_count() or 1
    with (
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            memory_limit=0,
            dashboard_address="127.0.0.1:0",  # any port: a fixed one may be taken, which dask would tell
            silence_logs=50,
            preload=["optimize.sweep_worker"],
        ) as local,
        Client(local) as client,
    ):
        yield client, None


class _Driver:
    """A sweep under way: what is waiting, what is being solved, what is done."""

    def __init__(
        self,
        sweep: Sweep,
        folder: Path,
        client: Any,
        scheduler: str | None,
        count: int,
        tell: Callable[[Progress], Any],
    ) -> None:
        self.sweep, self.folder, self.client, self.scheduler = sweep, folder, client, scheduler
        self.tell, self.count, self.done, self.begun = tell, count, 0, time.perf_counter()
        self.waiting: deque[Job] = deque()
        self.flying: dict[Any, Job] = {}
        self.started: dict[str, tuple[str, float]] = {}
        """address of its process and time of each task that has begun, by its key; filled by dask's thread"""
        self.tries: dict[int, int] = {}
        self.solved_by: dict[str, int] = {}
        """jobs of each process, by its address"""
        self.name = f"jaxclamp-{uuid.uuid4().hex[:12]}"
        """dask takes tasks of one key for the same: keys of this start are no other's"""
        self.serial, self.lost = itertools.count(1), 0

    def run(self, jobs: list[Job]) -> None:
        """Solve the jobs, those of one mesh after another."""
        self.waiting.extend(sorted(jobs, key=lambda job: job.shape))
        self.tell(Progress("sweep", 0.0, f"{self.count} jobs"))
        self._listen()
        while self.waiting or self.flying:
            for job, record in self._answers():
                self._write(job, record)

    def _answers(self) -> list[tuple[Job, dict[str, Any] | None]]:
        """Send jobs, and wait a little for answers; None for a job that is to be sent again."""
        from distributed import wait
        from distributed.client import ClosedClientError

        try:
            self._send()
            with suppress(TimeoutError):
                wait(list(self.flying), timeout=1.0, return_when="FIRST_COMPLETED")
            ended = {future: self._answer(future) for future in list(self.flying) if future.done()}
            ended |= self._late(set(self.flying) - set(ended))
        except (OSError, CancelledError, ClosedClientError):
            self._look_again()
            return []
        self.lost = 0
        found = [(self.flying.pop(future), record) for future, record in ended.items()]
        for future in ended:
            self.started.pop(future.key, None)
            future.release()
        return found

    def _send(self) -> None:
        """A job to each process that has none; more would only wait there."""
        room = max(1, len(self.client.scheduler_info(n_workers=-1)["workers"]))
        while self.waiting and len(self.flying) < room:
            job = self.waiting.popleft()
            key = f"{self.name}-{job.number}-{next(self.serial)}"
            task = by_value(_at_worker, loads_scene(job.text or ""), self.name, key)  # with parts of its own
            self.flying[self.client.submit(task, key=key, pure=False)] = job

    def _answer(self, future: Any) -> dict[str, Any] | None:
        """What a task came to; None if it went with its process."""
        if future.status in ("cancelled", "lost"):
            return None
        error = future.exception()
        if error is None:
            record: dict[str, Any] = future.result()
            self._renew(record["worker"])
            return record
        if type(error).__name__ == "KilledWorker":
            return {"status": DIED, "failure": "the processes that solved it ended", "seconds": None}
        return {"status": FAILED, "failure": f"{type(error).__name__}: {error}", "seconds": None}

    def _late(self, futures: set[Any]) -> dict[Any, dict[str, Any]]:
        """Tasks that take too long, ended with their processes; time spent waiting for one does not count."""
        now, limit = time.perf_counter(), self.sweep.time_limit_s
        found = {}
        for future in futures:
            address, begun = self.started.get(future.key, ("", now))
            if now - begun > limit:
                found[future] = {"status": TIMED_OUT, "failure": f"more than {limit:g} s", "seconds": limit}
                future.cancel()
                self._restart(address)
        return found

    def _renew(self, address: str) -> None:
        """Replace a process that has solved enough: what it keeps in memory goes with it."""
        self.solved_by[address] = self.solved_by.get(address, 0) + 1
        if self.scheduler is None and self.solved_by[address] >= self.sweep.jobs_per_worker:
            self.solved_by[address] = 0
            self._restart(address)

    def _restart(self, address: str) -> None:
        with suppress(Exception):  # it may have gone by itself; a cluster may not restart workers
            self.client.restart_workers([address], timeout=30, raise_for_error=False)

    def _listen(self) -> None:
        """Hear when tasks begin."""
        self.client.subscribe_topic(self.name, self._begins)

    def _begins(self, event: tuple[float, dict[str, str]]) -> None:
        self.started[event[1]["key"]] = event[1]["worker"], time.perf_counter()

    def _look_again(self) -> None:
        """Have what flies wait again, while dask connects anew. Raises NoDask if it cannot."""
        self.waiting.extendleft(reversed(self.flying.values()))
        self.flying.clear()
        self.lost += 1
        end = time.monotonic() + 2.0 * PATIENCE
        time.sleep(1.0)
        while self.client.status not in ("running", "closed") and time.monotonic() < end:
            time.sleep(0.2)
        if self.client.status != "running" or self.lost > MOST_TRIES:
            where = self.scheduler or "this machine"
            raise NoDask(
                f"the scheduler at {where} is lost: go on with --resume, {self.folder} has what is done"
            )
        self._listen()

    def _write(self, job: Job, record: dict[str, Any] | None) -> None:
        """Write down what a job came to, or have it wait once more."""
        if record is None:
            self.tries[job.number] = self.tries.get(job.number, 0) + 1
            if self.tries[job.number] < MOST_TRIES:
                self.waiting.appendleft(job)
                return
            record = {"status": DIED, "failure": "its process was lost", "seconds": None}
        write_job(self.folder, job, record)
        self.done += 1
        left = (self.count - self.done) * (time.perf_counter() - self.begun) / self.done
        said = f"job {job.number}: {record['status']}, about {left:.0f} s left"
        self.tell(Progress("sweep", self.done / self.count, said))


def _at_worker(scene: Scene, topic: str, key: str) -> dict[str, Any]:
    """The same in a process of the cluster, with its address; says when it begins."""
    from distributed import get_worker

    worker = get_worker()
    worker.log_event(topic, {"key": key, "worker": worker.address})
    return solve_job(scene) | {"worker": worker.address}
