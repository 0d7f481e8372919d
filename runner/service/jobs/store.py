"""The jobs of a recordings folder in SQLite, on disk before a request is answered.

    recordings/.jobs/jobs.sqlite

A job is a configuration with all its seeds, or a sweep. Its number is its place in the queue.
"""

from __future__ import annotations

import contextlib
import json
import sqlite3
import threading
from collections import Counter, defaultdict
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, Self

from runner.client.jobs import OVER, EventData, JobEvent, LogEvent, RunEvent, StateEvent
from runner.config.document import read_yaml, write_yaml
from runner.errors import RunnerError, StorageError
from runner.runs.catalogue.database import transaction
from runner.runs.locking import acquired
from runner.service.errors import JobNotFound, QueueFull
from runner.util.values import JsonView

if TYPE_CHECKING:
    from filelock import FileLock

Kind = Literal["config", "sweep", "branch", "explain"]
WITHOUT_RUNS: Final = ("sweep", "explain")
"""Kinds of jobs that are no runs, of seeds, but tasks for several workers."""
State = Literal["queued", "running", "interrupted", "finished", "failed", "cancelled"]

FOLDER: Final = ".jobs"
DATABASE_FILE: Final = "jobs.sqlite"
LOCK_FILE: Final = f"{FOLDER}/queue.lock"
MAX_EVENTS: Final = 50_000
"""Stored events of a job; beyond them only its states are stored."""
EVENTS_PER_READ: Final = 2000
# With exclusive locking the write-ahead log needs no shared memory, so network disks will do. Seeds exceed
# SQLite's integers. The name of the index is in use in files that older servers wrote.
_SCHEMA: Final = """
PRAGMA locking_mode = exclusive;
PRAGMA journal_mode = wal;
PRAGMA synchronous = full;
CREATE TABLE IF NOT EXISTS jobs (
    number INTEGER NOT NULL PRIMARY KEY, kind TEXT NOT NULL, name TEXT NOT NULL, runs INTEGER NOT NULL,
    created TEXT NOT NULL, workers INTEGER NOT NULL, state TEXT NOT NULL, started TEXT NOT NULL,
    ended TEXT NOT NULL, error TEXT NOT NULL, deaths INTEGER NOT NULL, accept_changes INTEGER NOT NULL,
    retry INTEGER NOT NULL, submitted TEXT NOT NULL, "values" TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS runs (
    job INTEGER NOT NULL, seed TEXT NOT NULL, run_id TEXT NOT NULL, started INTEGER NOT NULL,
    PRIMARY KEY (job, seed)
);
CREATE TABLE IF NOT EXISTS events (
    id INTEGER NOT NULL PRIMARY KEY, job INTEGER NOT NULL, kind TEXT NOT NULL, data TEXT NOT NULL
);
CREATE INDEX IF NOT EXISTS _eventrow_job ON events (job);
"""


@dataclass(frozen=True)
class Job:
    """A submitted job and its state. Times are in UTC, as ISO 8601; empty if they have not come."""

    number: int
    kind: Kind
    name: str
    runs: int
    """Number of runs: a configuration's seeds; a sweep's trials, times its seeds."""
    created: str
    workers: int = 1
    """How many workers it holds while it is running."""
    state: State = "queued"
    started: str = ""
    ended: str = ""
    error: str = ""
    """Why it failed; empty if it did not."""
    deaths: int = 0
    """Number of its workers that died since it was submitted or resumed."""
    accept_changes: bool = False
    """Whether to resume runs that were started by other code."""
    retry: bool = False
    """Whether to repeat failed runs of a sweep."""

    @property
    def is_over(self) -> bool:
        """Whether nothing more happens unless a user resumes it."""
        return self.state in OVER


class _RunOfJob(NamedTuple):
    run_id: str
    is_started: bool


_FIELDS: Final = ", ".join(field.name for field in fields(Job))
_PLACES: Final = ", ".join("?" for _ in fields(Job))


class JobStore:
    """The jobs of a recordings folder; thread-safe. One process at a time has it.

    The jobs and their run ids are held in memory too: the scheduler and every page that follows a run read
    them several times a second, without lock or disk, and a full disk does not stop them. Of jobs that are
    over, `max_over` are remembered.
    """

    def __init__(self, recordings: Path, max_unfinished: int = 1000, max_over: int = 1000) -> None:
        self.recordings, self.path = recordings, recordings / FOLDER / DATABASE_FILE
        self._max_unfinished, self._max_over = max_unfinished, max_over
        self.lock = threading.RLock()
        """Held by methods that use the database, and by callers over several calls that belong together; not
        by methods that copy a dictionary, which no other thread changes meanwhile."""
        self._open = contextlib.ExitStack()
        self._open.callback(lock_folder(recordings, LOCK_FILE).release)
        try:
            with self._storing("move it away to start with an empty queue"):
                # One connection, guarded by our own lock.
                database = sqlite3.connect(self.path, isolation_level=None, check_same_thread=False)
                self._database = self._open.enter_context(contextlib.closing(database))
                database.executescript(_SCHEMA)
                if not self._rows("SELECT 1 FROM pragma_table_info('jobs') WHERE name = 'workers'"):
                    # The file is of a server whose jobs did not state their workers.
                    database.execute("ALTER TABLE jobs ADD COLUMN workers INTEGER DEFAULT 1")
                jobs = self._rows(f"SELECT {_FIELDS} FROM jobs ORDER BY number")
                self._jobs = {row[0]: Job(*row[:-2], *map(bool, row[-2:])) for row in jobs}
                self._runs: defaultdict[int, dict[int, _RunOfJob]] = defaultdict(dict)
                for job, seed, *run in self._rows("SELECT job, seed, run_id, started FROM runs"):
                    self._runs[job][int(seed)] = _RunOfJob(*run)
                counts = self._rows("SELECT job, COUNT(*) FROM events GROUP BY job")
                self._event_counts = Counter(dict(counts))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the database, and release the folder for other processes."""
        with self.lock:
            self._open.close()

    def jobs(self) -> list[Job]:
        """Return all jobs, in the order of submission."""
        return list(self._jobs.values())

    def job(self, number: int) -> Job:
        """Return a job.

        Raises:
            JobNotFound: there is none.
        """
        job = self._jobs.get(number)
        if job is None:
            raise JobNotFound(f"no job {number}; `dualtaxi remote jobs` and the page /queue list them.")
        return job

    def add(
        self,
        kind: Kind,
        name: str,
        runs: int,
        submitted: str,
        values: JsonView,
        workers: int = 1,
        keep: Container[int] = (),
    ) -> Job:
        """Append a job to the queue, on disk, and return it.

        The text is `submitted`, `values` what it means, every value present; jobs of the numbers in `keep`
        are not forgotten although they are over: a worker is still closing them.

        Raises:
            QueueFull: there are too many unfinished jobs.
        """
        with self.lock:
            unfinished = sum(not job.is_over for job in self._jobs.values())
            if unfinished >= self._max_unfinished:
                raise QueueFull(
                    f"{unfinished:,} jobs are unfinished, the maximum; wait until one of them is over."
                )
            job = Job(max(self._jobs, default=0) + 1, kind, name, runs, now(), workers)
            over = [old.number for old in self._jobs.values() if old.is_over and old.number not in keep]
            forgotten = over[: max(0, len(over) - self._max_over)]
            with self._transaction():
                row = (*astuple(job), submitted, write_yaml(values))
                columns, places = f'{_FIELDS}, submitted, "values"', f"{_PLACES}, ?, ?"
                self._database.execute(f"INSERT INTO jobs ({columns}) VALUES ({places})", row)
                self._insert_state(job)
                for column in ("jobs WHERE number", "runs WHERE job", "events WHERE job"):
                    self._database.executemany(f"DELETE FROM {column} = ?", [(old,) for old in forgotten])
            for number in forgotten:
                del self._jobs[number], self._event_counts[number]
                self._runs.pop(number, None)
            self._jobs[job.number] = job
            return job

    def update(self, number: int, **changes: Any) -> Job:
        """Change fields of a job, and return it; a new state or error is an event.

        Raises:
            StorageError: it cannot be written; it is changed until the next start all the same.
        """
        with self.lock:
            before = self.job(number)
            job = self._jobs[number] = replace(before, **changes)
            with self._transaction():
                statement = f"UPDATE jobs SET ({_FIELDS}) = ({_PLACES}) WHERE number = ?"
                self._database.execute(statement, (*astuple(job), number))
                if (job.state, job.error) != (before.state, before.error):
                    self._insert_state(job)
            return job

    def set_state(self, number: int, state: State, **changes: object) -> Job:
        """Do as `update`; if the disk is full, the change holds until the next start."""
        with contextlib.suppress(StorageError):
            return self.update(number, state=state, **changes)
        return self.job(number)

    def log(self, number: int, lines: Sequence[LogEvent]) -> None:
        """Add lines to the log of a job; those beyond the limit, or that cannot be written, are dropped."""
        with self.lock, contextlib.suppress(StorageError), self._transaction():
            limit = max(0, MAX_EVENTS - self._event_counts[number])
            self._insert_events(number, [replace(line, time=now()) for line in lines[:limit]])

    def event_count(self, number: int) -> int:
        """Return what grows with each event of a job, so that nobody reads the events in vain."""
        return self._event_counts[number]

    def events(self, number: int, after: int = 0) -> tuple[list[JobEvent], int]:
        """Return a job's next events, not all if there are many, and the id of the last one.

        They follow the event of the id `after`; 0, or what is no event of the job, is before the first ones.
        """
        with self.lock:
            self.job(number)
            if after and not self._rows("SELECT 1 FROM events WHERE job = ? AND id = ?", number, after):
                after = 0
            query = "SELECT id, kind, data FROM events WHERE job = ? AND id > ? ORDER BY id LIMIT ?"
            rows = self._rows(query, number, after, EVENTS_PER_READ)
            events = [JobEvent.from_json(kind, json.loads(data), str(id_)) for id_, kind, data in rows]
            return events, rows[-1][0] if rows else after

    def last_events(self, number: int, limit: int) -> tuple[list[JobEvent], int]:
        """Return the last events of a job, and the id of the last one."""
        with self.lock:
            self.job(number)
            query = "SELECT id FROM events WHERE job = ? ORDER BY id DESC LIMIT 1 OFFSET ?"
            ids = self._rows(query, number, limit)
            return self.events(number, ids[0][0] if ids else 0)

    def run_ids(self, number: int, started: bool = True) -> dict[int, str]:
        """Return the run ids of a configuration's job by seed: of started runs, or all reserved ones."""
        runs = self._runs.get(number, {}).copy()
        return {seed: run.run_id for seed, run in sorted(runs.items()) if run.is_started or not started}

    def reserve_runs(self, number: int, run_ids: Mapping[int, str]) -> None:
        """Store the ids of runs by seed before they are made, so that no run is started twice."""
        with self.lock:
            self._store_runs(number, {seed: _RunOfJob(run_id, False) for seed, run_id in run_ids.items()})

    def start_run(self, number: int, seed: int, run_id: str) -> None:
        """Store that a run was started, as an event too."""
        with self.lock, contextlib.suppress(StorageError):
            self._store_runs(number, {seed: _RunOfJob(run_id, True)}, [RunEvent(run_id, seed, now())])

    def submitted(self, number: int) -> str:
        """Return the text of a job as it was submitted."""
        self.job(number)
        return self._text(number, "submitted")

    def values(self, number: int) -> dict[str, object]:
        """Return the configuration or sweep of a job, every value present."""
        return dict(read_yaml(self._text(number, '"values"'), f"job {number}").value)

    def _text(self, number: int, column: str) -> str:
        with self.lock:
            return str(self._rows(f"SELECT {column} FROM jobs WHERE number = ?", number)[0][0])

    def _rows(self, query: str, *values: object) -> list[tuple[Any, ...]]:
        return self._database.execute(query, values).fetchall()

    def _insert_state(self, job: Job) -> None:
        self._insert_events(job.number, [StateEvent(job.state, job.error or None, now())])

    def _store_runs(
        self, number: int, runs: Mapping[int, _RunOfJob], events: Sequence[EventData] = ()
    ) -> None:
        with self._transaction():
            rows = [(number, str(seed), *run) for seed, run in runs.items()]
            self._database.executemany("INSERT OR REPLACE INTO runs VALUES (?, ?, ?, ?)", rows)
            self._insert_events(number, events)
        self._runs[number].update(runs)

    def _insert_events(self, number: int, data: Sequence[EventData]) -> None:
        rows = [(number, event.kind, json.dumps(event.as_json())) for event in map(JobEvent, data)]
        self._database.executemany("INSERT INTO events (job, kind, data) VALUES (?, ?, ?)", rows)
        self._event_counts[number] += len(rows)

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._storing("free some disk"), transaction(self._database, "IMMEDIATE"):
            yield

    @contextlib.contextmanager
    def _storing(self, advice: str) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise StorageError(f"{self.path}: cannot be written ({error}); {advice}.") from error


def lock_folder(recordings: Path, lock_file: str) -> FileLock:
    """Lock a part of a recordings folder against other processes, until it is released or this one ends.

    The lock file is relative to the folder, which is created if it is missing.
    """
    busy = f"{recordings} is served by another process already; stop it, or choose another --recordings."
    return acquired(recordings / lock_file, RunnerError(busy))


def now() -> str:
    """Return the current time as jobs have it."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")
