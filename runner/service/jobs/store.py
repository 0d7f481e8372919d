"""The jobs of a recordings folder, each in a folder of its own, on disk before a request is answered.

    recordings/.jobs/17/state.json       the job and its state; replaced atomically
    recordings/.jobs/17/job.yaml         what it does: its configuration or sweep, every value present
    recordings/.jobs/17/submitted.yaml   the text that was submitted
    recordings/.jobs/17/log.jsonl        its events, a line each

A job is a configuration with all its seeds, or a sweep. Its number is its place in the queue.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import threading
from collections import deque
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final, Literal

from pydantic import TypeAdapter

from runner.client.jobs import (
    JobEvent,
    JobFacts,
    JobProgress,
    JobStatus,
    LogEvent,
    RunEvent,
    RunOfJob,
    StateEvent,
)
from runner.config.document import read_yaml, write_yaml
from runner.errors import RunnerError, StorageError
from runner.runs.run import acquired, new_run_id
from runner.service.errors import JobNotFound, LimitReached
from runner.util.files import replacing, storage_errors

if TYPE_CHECKING:
    from filelock import FileLock

Kind = Literal["config", "sweep", "branch", "episode", "explain"]

FOLDER: Final = ".jobs"
LOCK_FILE: Final = f"{FOLDER}/queue.lock"
STATE_FILE: Final = "state.json"
VALUES_FILE: Final = "job.yaml"
TEXT_FILE: Final = "submitted.yaml"
LOG_FILE: Final = "log.jsonl"
MAX_LOG_BYTES: Final = 8 << 20
"""Size of a job's log; beyond it only its states and the starts of its runs are stored."""
EVENTS_PER_READ: Final = 2000


@dataclass(frozen=True)
class JobEstimate:
    """What a submitted text, or a question about runs, will make."""

    kind: Kind
    name: str
    runs: int
    bytes: int
    """The estimated size of its recordings; 0 if unknown."""


@dataclass(frozen=True)
class CheckedJob(JobEstimate):
    """The meaning of a submitted text, or of a question about runs."""

    values: dict[str, object]
    """The configuration, the sweep or the question, every value present."""
    seeds: tuple[int, ...] = ()
    """Seeds of the runs that one worker makes, in order; empty for a sweep or an explanation, whose runs
    several workers share."""


@dataclass(frozen=True, kw_only=True)
class QueuedJob(JobFacts):
    """A stored job; its progress is kept in memory only."""

    kind: Kind
    deaths: int = 0
    """Number of its workers that died since it was submitted or resumed."""
    accept_changes: bool = False
    """Whether to resume runs that were started by other code."""
    retry: bool = False
    """Whether to repeat failed runs of a sweep."""
    run_ids: dict[int, str] = field(default_factory=dict)
    """The ids of its runs by seed, in order: reserved before a run is made, so that no run is
    started twice."""
    begun: int = 0
    """How many of these runs were started."""

    @property
    def started_runs(self) -> dict[int, str]:
        """The ids of its started runs by seed."""
        return dict(sorted(islice(self.run_ids.items(), self.begun)))

    def status(self) -> JobStatus:
        """Return the job as clients see it."""
        progress = self.progress if self.state == "running" else None
        begun = [RunOfJob(*run) for run in self.started_runs.items()]
        return _STATUS.validate_python(vars(self) | {"progress": progress, "begun": begun})


_STORED: Final = TypeAdapter(QueuedJob)
_STATUS: Final = TypeAdapter(JobStatus)


class JobStore:
    """The jobs of a recordings folder; thread-safe. One process at a time has it.

    The folder is the truth; jobs are held in memory too, but for their texts and logs. The scheduler and
    every page that follows a run read them several times a second, without lock or disk, and a full disk
    does not stop them. Of jobs that are over, `max_over` are remembered.
    """

    def __init__(self, recordings: Path, max_unfinished: int = 1000, max_over: int = 1000) -> None:
        self.recordings = recordings
        self._max_unfinished = max_unfinished
        self._max_over = max_over
        self.lock = threading.RLock()
        """Held by methods that change jobs, and by callers over several calls that belong together; not by
        methods that read, as no other thread changes a job or a dictionary of jobs meanwhile."""
        self._jobs: dict[int, QueuedJob] = {}
        self._log_sizes: dict[int, int] = {}
        self._file_lock = lock_folder(recordings, LOCK_FILE)
        try:
            with storage_errors(recordings / FOLDER):
                names = [folder.name for folder in (recordings / FOLDER).iterdir()]
                for number in sorted(int(name) for name in names if name.isdecimal()):
                    self._load(number)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Release the folder for other processes."""
        self._file_lock.release()

    def jobs(self) -> list[QueuedJob]:
        """Return all jobs, in the order of submission."""
        return list(self._jobs.values())

    def job(self, number: int) -> QueuedJob:
        """Return a job.

        Raises:
            JobNotFound: there is none.
        """
        job = self._jobs.get(number)
        if job is None:
            raise JobNotFound(f"no job {number}; `dualtaxi remote jobs` and the page /queue list them.")
        return job

    def is_running(self, number: int) -> bool:
        """Return whether a job is running, which a forgotten job is not."""
        job = self._jobs.get(number)
        return job is not None and job.state == "running"

    def add(self, checked: CheckedJob, submitted: str, workers: int = 1) -> QueuedJob:
        """Append the job that a submitted text means to the queue, on disk, and return it.

        Raises:
            LimitReached: there are too many unfinished jobs.
            StorageError: it cannot be written.
        """
        with self.lock:
            unfinished = sum(not job.is_over for job in self._jobs.values())
            if unfinished >= self._max_unfinished:
                raise LimitReached(
                    f"{unfinished:,} jobs are unfinished, the maximum; wait until one of them is over."
                )
            number = max(self._jobs, default=0) + 1
            run_ids = {seed: new_run_id(self.recordings) for seed in checked.seeds}
            job = QueuedJob(
                number=number,
                kind=checked.kind,
                name=checked.name,
                runs=checked.runs,
                workers=workers,
                created=now(),
                run_ids=run_ids,
            )
            try:
                with storage_errors(self.path(number), "free some disk"):
                    self.path(number).mkdir()
                    _write(self.path(number, TEXT_FILE), submitted.encode())
                    _write(self.path(number, VALUES_FILE), write_yaml(checked.values).encode())
                    self._append(number, StateEvent("queued"))
                    self._write_state(job)  # last: from now on it is a job
            except BaseException:
                self._forget(number)
                raise
            self._jobs[number] = job
            over = [old.number for old in self._jobs.values() if old.is_over]
            for oldest in over[: max(0, len(over) - self._max_over)]:
                self._forget(oldest)
            return job

    def update(self, number: int, **changes: Any) -> QueuedJob:
        """Change fields of a job, and return it; a new state or error is an event.

        If the disk is full, the change holds until the next start.
        """
        with self.lock:
            before = self.job(number)
            job = replace(before, **changes)
            with contextlib.suppress(OSError):
                if (job.state, job.error) != (before.state, before.error):
                    self._append(number, StateEvent(job.state, job.error or None))
                self._write_state(job)
            self._jobs[number] = job
            return job

    def report(self, number: int, event: RunEvent | LogEvent | JobProgress) -> None:
        """Keep what the worker of a job reports.

        Lines of the log beyond its limit, or that cannot be written, are dropped; so is all about a job that
        was forgotten while its worker closed a recording.
        """
        with self.lock:
            job = self._jobs.get(number)
            if job is None:
                return
            if isinstance(event, JobProgress):
                self._jobs[number] = replace(job, progress=event)
                return
            if isinstance(event, RunEvent):
                self.update(number, begun=max(job.begun, list(job.run_ids).index(event.seed) + 1))
            if isinstance(event, RunEvent) or self._log_sizes[number] < MAX_LOG_BYTES:
                with contextlib.suppress(OSError):
                    self._append(number, event)

    def log_size(self, number: int) -> int:
        """Return the size of a job's log, which is the id of its last event."""
        return self._log_sizes.get(number, 0)

    def events(self, number: int, after: int = 0) -> tuple[list[JobEvent], int]:
        """Return a job's next events, not all if there are many, and the id of the last one.

        An event's id is the place in the log where it ends. They follow the event of the id `after`; 0, or
        what is no event of the job, is before the first ones.
        """
        events: list[JobEvent] = []
        with self._open(number, LOG_FILE) as log:
            log.seek(max(after - 1, 0))
            if after and log.read(1) != b"\n":
                after = log.seek(0)
            for line in islice(log, EVENTS_PER_READ):
                if not line.endswith(b"\n"):
                    break  # it is being written
                after += len(line)
                with contextlib.suppress(RunnerError):  # damaged when the machine stopped
                    events.append(JobEvent.from_line(line, str(after)))
        return events, after

    def last_events(self, number: int, limit: int) -> list[JobEvent]:
        """Return the last events of a job."""
        with self._open(number, LOG_FILE) as log:
            lines = deque(log, limit)
            return self.events(number, log.tell() - sum(map(len, lines)))[0]

    def submitted(self, number: int) -> str:
        """Return the text of a job as it was submitted."""
        with self._open(number, TEXT_FILE) as text:
            return text.read().decode()

    def _open(self, number: int, name: str) -> BinaryIO:
        self.job(number)
        try:
            return self.path(number, name).open("rb")
        except FileNotFoundError:
            self.job(number)  # it was forgotten in the meantime
            raise

    def _load(self, number: int) -> None:
        """Read a job from its folder, and remove the folder if its submission was not completed."""
        path = self.path(number, STATE_FILE)
        if not path.exists():
            self._forget(number)
            return
        self._jobs[number] = read_job(path.parent)
        log = self.path(number, LOG_FILE).read_bytes()
        self._log_sizes[number] = log.rfind(b"\n") + 1  # without a line that was not written whole

    def _forget(self, number: int) -> None:
        self._jobs.pop(number, None)
        self._log_sizes.pop(number, None)
        shutil.rmtree(self.path(number), ignore_errors=True)

    def _append(self, number: int, data: StateEvent | RunEvent | LogEvent) -> None:
        size = self._log_sizes.get(number, 0)
        line = f"{JobEvent(replace(data, time=now())).as_line()}\n".encode()
        with self.path(number, LOG_FILE).open("r+b" if size else "wb") as log:
            log.seek(size)  # over a line that was not written to its end because the disk was full
            log.write(line)
        self._log_sizes[number] = size + len(line)

    def _write_state(self, job: QueuedJob) -> None:
        _write(self.path(job.number, STATE_FILE), _STORED.dump_json(job, exclude={"progress"}))

    def path(self, number: int, name: str = "") -> Path:
        """Return the folder of a job, or a file in it."""
        return self.recordings / FOLDER / str(number) / name


def _write(path: Path, data: bytes) -> None:
    """Replace a file, on disk when this returns."""
    with replacing(path) as fresh, fresh.open("xb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


def read_job(folder: Path) -> QueuedJob:
    """Return the job in a folder.

    Raises:
        StorageError: its file cannot be read, or describes no job.
    """
    path = folder / STATE_FILE
    try:
        with storage_errors(path):
            return _STORED.validate_json(path.read_bytes())
    except ValueError as error:
        raise StorageError(
            f"{path}: found a file that describes no job; move its folder away to start without the job."
        ) from error


def read_values(folder: Path) -> dict[str, object]:
    """Return the configuration, sweep or question of the job in a folder, every value present."""
    return dict(read_yaml((folder / VALUES_FILE).read_bytes().decode(), f"job {folder.name}").value)


def lock_folder(recordings: Path, lock_file: str) -> FileLock:
    """Lock a part of a recordings folder against other processes, until it is released or this one ends.

    The lock file is relative to the folder, which is created if it is missing.
    """
    busy = f"{recordings} is served by another process already; stop it, or choose another --recordings."
    return acquired(recordings / lock_file, RunnerError(busy))


def now() -> str:
    """Return the current time as jobs have it."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")
