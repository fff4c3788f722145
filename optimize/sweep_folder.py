"""What a sweep leaves on disk: a folder for each job, whole or not at all, and a table of them all."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from jaxclamp import BadFolder, versions
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
            found = _read(known)
            if found.get("digest") != sweep.digest:
                raise BadFolder(f"{folder} holds another sweep: take another folder")
            _require_same_versions(folder, found.get("versions"))
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


def _require_same_versions(folder: Path, before: dict[str, str] | None) -> None:
    """Refuse to mix answers of different versions in one table."""
    now, before = versions(), before or {}
    differ = [name for name in now if now[name] != before.get(name)]
    if differ:
        name = differ[0]
        said = f"{name} {before.get(name, 'unknown')}, and this is {now[name]}"
        raise BadFolder(f"{folder} holds answers of {said}: take another folder")


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


def status_of(folder: Path, job: Job) -> str | None:
    """How a job ended, by its folder; None if it is to be solved yet."""
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
    varied = {key: _plain(value) for key, value in job.varied.items()}
    row: dict[str, Any] = {"job": job.number, "name": job.name, **varied}
    row |= {key: record.get(key) for key in ("status", "failure", "seconds")}
    final = _read(place / RESULT).get("final") or {}
    for key, value in final.items():
        for part, one in value.items() if isinstance(value, dict) else [("", value)]:
            row[f"{key}.{part}" if part else key] = _plain(one)
    return row


def _plain(value: Any) -> Any:
    """A value for one cell: lists and tables are texts."""
    return json.dumps(value) if isinstance(value, list | dict) else value


def _column(values: list[Any]) -> list[Any]:
    """Values of one type: those of several are texts; numbers are floats if any is, or is too large."""
    known = [value for value in values if value is not None]
    kinds = {type(value) if isinstance(value, bool | str) else float for value in known}
    if len(kinds) > 1:
        return [value if value is None or isinstance(value, str) else json.dumps(value) for value in values]
    if kinds == {float} and any(isinstance(value, float) or abs(value) >= 2**63 for value in known):
        return [None if value is None else float(value) for value in values]
    return values
