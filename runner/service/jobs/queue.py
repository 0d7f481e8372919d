"""The queue of jobs: what was submitted and what became of it, on disk before it is answered.

    recordings/.jobs/17/job.json         kind, name, state, when, why it failed
    recordings/.jobs/17/submitted.yaml   as it came
    recordings/.jobs/17/config.yaml      what it means, every value present
    recordings/.jobs/17/runs.json        seed -> id of its run, written by the worker before the run begins
    recordings/.jobs/17/events.jsonl     what happened, a line an event

A job is a configuration with all its seeds, or a sweep. Its number is its place in the queue.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import threading
from collections.abc import Container, Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Literal, Self, get_args

from runner.client.jobs import OVER
from runner.config.document import write_yaml
from runner.errors import RunnerError, StorageError
from runner.service.jobs.folder_lock import hold
from runner.util.files import read_object

Kind = Literal["config", "sweep"]
State = Literal["queued", "running", "interrupted", "finished", "failed", "cancelled"]

FOLDER: Final = ".jobs"
JOB_FILE: Final = "job.json"
SUBMITTED_FILE: Final = "submitted.yaml"
CONFIG_FILE: Final = "config.yaml"
RUNS_FILE: Final = "runs.json"
EVENTS_FILE: Final = "events.jsonl"
_LOCK: Final = f"{FOLDER}/queue.lock"
MAX_JOB_BYTES: Final = 1 << 20
MAX_RUNS_BYTES: Final = 8 << 20
MAX_EVENTS_BYTES: Final = 8 << 20
"""After so much a job's events are no longer written down, but for its states."""
MAX_READ_BYTES: Final = 256 << 10
"""Of events at a time."""


class QueueFull(RunnerError):
    """There are as many unfinished jobs as there may be."""


class JobNotFound(RunnerError):
    """No job has this number."""


class JobStateConflict(RunnerError):
    """What is asked of a job does not go with the state that it is in."""


@dataclass(frozen=True)
class Job:
    """Something that was submitted, and what has become of it."""

    number: int
    kind: Kind
    name: str
    runs: int
    """How many it makes: a configuration's seeds; a sweep's trials, times its seeds."""
    created: str
    """In UTC, as ISO 8601 has it; so are the others."""
    state: State = "queued"
    started: str = ""
    ended: str = ""
    error: str = ""
    """Why it failed; empty if it did not."""
    deaths: int = 0
    """How many of its workers died, since it was last asked for."""
    accept_changes: bool = False
    """Whether to go on with runs that other code began."""
    retry: bool = False
    """Whether runs of a sweep that failed are tried again."""

    @property
    def is_over(self) -> bool:
        """Whether nothing more happens unless somebody asks for it."""
        return self.state in OVER


@dataclass(frozen=True)
class Event:
    """Something that happened to a job."""

    place: int
    """Where the next event begins: what a reader who has come so far asks for."""
    kind: str
    """`state`, `run` (one began) or `log`."""
    data: dict[str, Any]


class Queue:
    """The jobs of a recordings folder; its methods may be called by any thread of the process that has it.

    Args:
        recordings: the folder.
        most_waiting: how many jobs may be unfinished at once.
        most_kept: how many of those that are over are remembered.

    Raises:
        RunnerError: another process has it.
        StorageError: the folder cannot be written.
    """

    def __init__(self, recordings: Path, most_waiting: int = 1000, most_kept: int = 1000) -> None:
        self.recordings = recordings
        self.folder = recordings / FOLDER
        self._most_waiting, self._most_kept = most_waiting, most_kept
        self._lock = threading.RLock()
        self._held = hold(recordings, _LOCK)
        self._jobs = dict(sorted((job.number, job) for job in _read_jobs(self.folder)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let another process have the queue."""
        self._held.release()

    def folder_of(self, number: int) -> Path:
        """Return the folder of a job; it need not exist."""
        return self.folder / str(number)

    def jobs(self) -> list[Job]:
        """Return all jobs, in the order in which they were submitted."""
        with self._lock:
            return list(self._jobs.values())

    def job(self, number: int) -> Job:
        """Return a job.

        Raises:
            JobNotFound: there is none.
        """
        with self._lock:
            if number not in self._jobs:
                raise JobNotFound(f"no job {number}; `GET /jobs` lists those there are.")
            return self._jobs[number]

    def add(
        self,
        kind: Kind,
        name: str,
        runs: int,
        submitted: str,
        config: Mapping[str, Any],
        keep: Container[int] = (),
    ) -> Job:
        """Put a job at the end of the queue, on disk, and return it.

        Args:
            kind: a configuration or a sweep.
            name: what it is called.
            runs: how many it makes.
            submitted: the text as it came.
            config: the configuration or the sweep that it means, as plain values.
            keep: numbers of jobs that are not forgotten, though over: a worker is still closing them.

        Raises:
            QueueFull: there are too many already.
            StorageError: it cannot be written; then it is not in the queue.
        """
        with self._lock:
            waiting = sum(not job.is_over for job in self._jobs.values())
            if waiting >= self._most_waiting:
                raise QueueFull(
                    f"{waiting:,} jobs are unfinished, and more are not taken; wait for one to end."
                )
            job = Job(max(self._jobs, default=0) + 1, kind, name, runs, now())
            folder = self.folder_of(job.number)
            try:
                folder.mkdir()
                _write(folder / SUBMITTED_FILE, submitted)
                _write(folder / CONFIG_FILE, write_yaml(config))
                self._jobs[job.number] = job
                self._note(job, "state")
                self._save(job)
            except OSError as error:
                self._jobs.pop(job.number, None)
                shutil.rmtree(folder, ignore_errors=True)
                raise StorageError(f"{folder}: cannot be written ({error.strerror}).") from error
            self._forget(keep)
            return job

    def change(self, number: int, **facts: Any) -> Job:
        """Return a job with other facts, written down; a new state is an event.

        Raises:
            StorageError: it cannot be written; it is changed all the same, until the next start.
        """
        with self._lock:
            before = self.job(number)
            job = self._jobs[number] = replace(before, **facts)
            try:
                self._save(job)
                if job.state != before.state or job.error != before.error:
                    self._note(job, "state")
            except OSError as error:
                raise StorageError(
                    f"{self.folder_of(number)}: cannot be written ({error.strerror}); free some disk."
                ) from error
            return job

    def note(self, number: int, kind: str, data: Mapping[str, Any]) -> None:
        """Add an event to a job; one that finds no room is left out."""
        path = self.folder_of(number) / EVENTS_FILE
        with self._lock, contextlib.suppress(OSError):
            if path.exists() and path.stat().st_size > MAX_EVENTS_BYTES:
                return
            _append(path, kind, data)

    def events(self, number: int, place: int = 0) -> tuple[list[Event], int]:
        """Return a job's events from a place on, not all if they are many, and the place behind them.

        Args:
            number: which job.
            place: 0, or one that this function or an event told; any other is taken as 0.

        Raises:
            JobNotFound: there is none.
        """
        self.job(number)
        try:
            with (self.folder_of(number) / EVENTS_FILE).open("rb") as stream:
                if place < 0 or not _is_start(stream, place):
                    place = 0
                stream.seek(place)
                lines = stream.read(MAX_READ_BYTES).splitlines(keepends=True)
        except FileNotFoundError:
            return [], 0
        found = []
        for line in lines:
            if not line.endswith(b"\n"):
                break
            place += len(line)
            with contextlib.suppress(ValueError, TypeError, KeyError):
                said = json.loads(line)
                found.append(Event(place, str(said["event"]), dict(said["data"])))
        return found, place

    def last_events(self, number: int, most: int) -> tuple[list[Event], int]:
        """Return the last events of a job, read from the end of its file, and the place behind them.

        Args:
            number: which job.
            most: how many events are returned; fewer if they are longer than `MAX_READ_BYTES`.

        Raises:
            JobNotFound: there is none.
        """
        self.job(number)
        try:
            with (self.folder_of(number) / EVENTS_FILE).open("rb") as stream:
                place = max(0, stream.seek(0, os.SEEK_END) - MAX_READ_BYTES)
                if not _is_start(stream, place):
                    stream.seek(place)
                    place += len(stream.readline())
        except FileNotFoundError:
            return [], 0
        found, place = self.events(number, place)
        return found[-most:], place

    def runs_of(self, number: int) -> dict[int, str]:
        """Return the ids of the runs of a job that is no sweep, by seed, as far as they were begun."""
        return runs_in(self.folder_of(number))

    def submitted(self, number: int) -> str:
        """Return the text of a job as it came.

        Raises:
            JobNotFound: there is none, or its files were removed.
        """
        self.job(number)
        try:
            return (self.folder_of(number) / SUBMITTED_FILE).read_text(encoding="utf-8")
        except OSError as error:
            raise JobNotFound(f"the files of job {number} cannot be read ({error.strerror}).") from error

    def _save(self, job: Job) -> None:
        fresh = self.folder_of(job.number) / f"{JOB_FILE}.tmp"
        _write(fresh, json.dumps(asdict(job), indent=1, ensure_ascii=False) + "\n")
        fresh.replace(fresh.with_suffix(""))

    def _note(self, job: Job, kind: str) -> None:
        data = {"state": job.state, "time": now()} | ({"error": job.error} if job.error else {})
        _append(self.folder_of(job.number) / EVENTS_FILE, kind, data)

    def _forget(self, keep: Container[int]) -> None:
        """Remove the oldest jobs that are over, but for so many."""
        over = [number for number, job in self._jobs.items() if job.is_over and number not in keep]
        for number in over[: max(0, len(over) - self._most_kept)]:
            del self._jobs[number]
            _remove(self.folder_of(number))


def require_free(recordings: Path) -> None:
    """Refuse a folder that another process serves.

    Raises:
        RunnerError: one does.
        StorageError: the folder cannot be written.
    """
    hold(recordings, _LOCK).release()


def runs_in(folder: Path) -> dict[int, str]:
    """Return the ids of a job's runs by seed, as its folder says."""
    try:
        found = read_object(folder / RUNS_FILE, MAX_RUNS_BYTES)
    except (OSError, ValueError):
        return {}
    return {int(seed): str(run_id) for seed, run_id in found.items() if seed.isdecimal()}


def now() -> str:
    """Return the time, as jobs have it."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _read_jobs(folder: Path) -> Iterator[Job]:
    """Yield the jobs in a folder; what was not wholly submitted, or not wholly forgotten, is removed."""
    for entry in sorted(folder.iterdir()):
        if not (entry.name.isdecimal() and entry.is_dir()):
            continue
        job = _read_job(entry)
        if job is None:
            _remove(entry)
        else:
            _cut_torn(entry / EVENTS_FILE)
            yield job


def _read_job(folder: Path) -> Job | None:
    """Return the job in a folder; None if its file is missing or holds something else."""
    try:
        said = read_object(folder / JOB_FILE, MAX_JOB_BYTES)
        job = Job(**{field.name: said[field.name] for field in fields(Job)})
    except (OSError, ValueError, KeyError):
        return None
    kinds = {"int": int, "str": str, "bool": bool}
    sound = all(isinstance(getattr(job, f.name), kinds.get(str(f.type), str)) for f in fields(Job))
    known = job.state in get_args(State) and job.kind in get_args(Kind)
    return job if sound and known and str(job.number) == folder.name else None


def _remove(folder: Path) -> None:
    """Remove a job's folder, first what makes it one."""
    (folder / JOB_FILE).unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)


def _write(path: Path, text: str) -> None:
    with path.open("w", encoding="utf-8", newline="") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())


def _append(path: Path, kind: str, data: Mapping[str, Any]) -> None:
    line = json.dumps({"event": kind, "data": dict(data)}, ensure_ascii=False, separators=(",", ":"))
    with path.open("ab") as stream:
        stream.write(line.encode() + b"\n")


def _cut_torn(path: Path) -> None:
    """Cut off the last line of a file if its writer did not come to its end."""
    with contextlib.suppress(FileNotFoundError), path.open("r+b") as stream:
        end = stream.seek(0, os.SEEK_END)
        stream.seek(max(0, end - MAX_READ_BYTES))
        start = stream.tell()
        stream.truncate(start + stream.read().rfind(b"\n") + 1)


def _is_start(stream: Any, place: int) -> bool:
    """Return whether an event begins, or would begin, at a place."""
    if place == 0:
        return True
    stream.seek(place - 1)
    return bool(stream.read(1) == b"\n")
