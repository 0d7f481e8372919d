"""The jobs of a recordings folder in SQLite, on disk before a request is answered.

    recordings/.jobs/jobs.sqlite

A job is a configuration with all its seeds, or a sweep. Its number is its place in the queue.
"""

from __future__ import annotations

import contextlib
import json
import threading
from collections import Counter, defaultdict
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, Self

from peewee import (
    AutoField,
    BooleanField,
    CompositeKey,
    IntegerField,
    Model,
    PeeweeException,
    SchemaManager,
    SqliteDatabase,
    TextField,
)

from runner.client.jobs import OVER, EventData, JobEvent, LogEvent, RunEvent, StateEvent
from runner.config.document import read_yaml, write_yaml
from runner.errors import RunnerError, StorageError
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


class _JobRow(Model):
    number = IntegerField(primary_key=True)
    kind = TextField()
    name = TextField()
    runs = IntegerField()
    created = TextField()
    workers = IntegerField(default=1)
    state = TextField()
    started = TextField()
    ended = TextField()
    error = TextField()
    deaths = IntegerField()
    accept_changes = BooleanField()
    retry = BooleanField()
    submitted = TextField()
    values = TextField()

    class Meta:
        table_name = "jobs"


class _RunRow(Model):
    job = IntegerField()
    seed = TextField()
    """Decimal: seeds exceed SQLite's integers."""
    run_id = TextField()
    started = BooleanField()

    class Meta:
        table_name = "runs"
        primary_key = CompositeKey("job", "seed")


class _EventRow(Model):
    id = AutoField()
    job = IntegerField(index=True)
    kind = TextField()
    data = TextField()

    class Meta:
        table_name = "events"


_TABLES: Final = (_JobRow, _RunRow, _EventRow)


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
        self._file_lock = lock_folder(recordings, LOCK_FILE)
        # With exclusive locking the write-ahead log needs no shared memory, so network disks will do.
        pragmas = {"locking_mode": "exclusive", "journal_mode": "wal", "synchronous": "full"}
        # One connection, guarded by our own lock.
        self._database = SqliteDatabase(
            str(self.path), pragmas=pragmas, thread_safe=False, check_same_thread=False
        )
        try:
            with self._transaction("move it away to start with an empty queue"):
                for table in _TABLES:
                    SchemaManager(table, self._database).create_all()
                if not any(column.name == "workers" for column in self._database.get_columns("jobs")):
                    # The file is of a server whose jobs did not state their workers.
                    self._database.execute_sql("ALTER TABLE jobs ADD COLUMN workers INTEGER DEFAULT 1")  # type: ignore[no-untyped-call]
                columns = [getattr(_JobRow, field.name) for field in fields(Job)]
                rows = self._tuples(_JobRow.select(*columns).order_by(_JobRow.number))
                self._jobs = {row[0]: Job(*row) for row in rows}
                self._runs: defaultdict[int, dict[int, _RunOfJob]] = defaultdict(dict)
                for job, seed, *run in self._tuples(_RunRow.select()):
                    self._runs[job][int(seed)] = _RunOfJob(*run)
                self._event_counts = Counter(job for (job,) in self._tuples(_EventRow.select(_EventRow.job)))
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
            self._database.close()
            self._file_lock.release()

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
                row = asdict(job) | {"submitted": submitted, "values": write_yaml(values)}
                _JobRow.insert(row).execute(self._database)
                self._insert_state(job)
                for table, column in (
                    (_JobRow, _JobRow.number),
                    (_RunRow, _RunRow.job),
                    (_EventRow, _EventRow.job),
                ):
                    table.delete().where(column.in_(forgotten)).execute(self._database)
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
            with self._transaction("free some disk"):
                row = _JobRow.update(asdict(job)).where(_JobRow.number == number)
                row.execute(self._database)
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
            columns = (_EventRow.id, _EventRow.kind, _EventRow.data)
            own = _EventRow.select(*columns).where(_EventRow.job == number)
            if after and not self._tuples(own.where(_EventRow.id == after)):
                after = 0
            query = own.where(_EventRow.id > after).order_by(_EventRow.id).limit(EVENTS_PER_READ)
            rows = self._tuples(query)
            events = [JobEvent.from_json(kind, json.loads(data), str(id_)) for id_, kind, data in rows]
            return events, rows[-1][0] if rows else after

    def last_events(self, number: int, limit: int) -> tuple[list[JobEvent], int]:
        """Return the last events of a job, and the id of the last one."""
        with self.lock:
            self.job(number)
            query = _EventRow.select(_EventRow.id).where(_EventRow.job == number)
            ids = self._tuples(query.order_by(_EventRow.id.desc()).limit(1).offset(limit))
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
        return self._column(number, _JobRow.submitted)

    def values(self, number: int) -> dict[str, object]:
        """Return the configuration or sweep of a job, every value present."""
        return dict(read_yaml(self._column(number, _JobRow.values), f"job {number}").value)

    def _column(self, number: int, column: TextField) -> str:
        with self.lock:
            ((text,),) = self._tuples(_JobRow.select(column).where(_JobRow.number == number))
            return str(text)

    def _tuples(self, query: Any) -> list[tuple[Any, ...]]:
        return list(query.tuples().execute(self._database))

    def _insert_state(self, job: Job) -> None:
        self._insert_events(job.number, [StateEvent(job.state, job.error or None, now())])

    def _store_runs(
        self, number: int, runs: Mapping[int, _RunOfJob], events: Sequence[EventData] = ()
    ) -> None:
        with self._transaction():
            for seed, run in runs.items():
                row = {"job": number, "seed": str(seed), "run_id": run.run_id, "started": run.is_started}
                _RunRow.insert(row).on_conflict_replace().execute(self._database)
            self._insert_events(number, events)
        self._runs[number].update(runs)

    def _insert_events(self, number: int, data: Sequence[EventData]) -> None:
        events = map(JobEvent, data)
        rows = [{"job": number, "kind": each.kind, "data": json.dumps(each.as_json())} for each in events]
        if rows:
            _EventRow.insert_many(rows).execute(self._database)
            self._event_counts[number] += len(rows)

    @contextlib.contextmanager
    def _transaction(self, advice: str = "free some disk") -> Iterator[None]:
        try:
            with self._database.atomic():
                yield
        except PeeweeException as error:
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
