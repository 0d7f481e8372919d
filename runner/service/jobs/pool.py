"""The jobs of a recordings folder, run by worker processes next to the server.

One thread starts the workers and receives their messages; the other methods read, or store a request.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing import connection
from pathlib import Path
from typing import Any, Final, Self

from runner.client.jobs import JobProgress
from runner.config import from_mapping
from runner.errors import StorageError
from runner.execution.estimate import free_bytes
from runner.runs.run import new_run_id
from runner.service.errors import JobStateConflict
from runner.service.jobs.channel import JobSpec, Outcome
from runner.service.jobs.checking import CheckedJob, JobChecker
from runner.service.jobs.store import Job, JobStore, now
from runner.service.jobs.worker import work
from runner.service.logs import LOG
from runner.sweep.cluster import require_ray

STOP_SECONDS: Final = 15.0
"""How long a worker may take to close its recording before it is killed."""
RECEIVE_SECONDS: Final = 0.1
MAX_DEATHS: Final = 2
"""A job fails when this number of its workers have died."""
RESERVE_BYTES: Final = 256 << 20
"""No job is started while the disk has less space."""
RETRY_SECONDS: Final = 5.0
"""Time between attempts to start a worker when the system has no process to give."""


@dataclass
class _Worker:
    number: int
    """The number of its job."""
    process: Any
    pipe: Any
    slots: int = 1
    """How many processes it may use."""
    confirmed: int = 1
    """How many it last reported to use, or to be allowed."""
    outcome: Outcome | None = None
    stopped: float | None = None
    """When the request to stop was sent."""

    def send(self, kind: str, value: Any = None) -> None:
        with contextlib.suppress(OSError):  # it is dead
            self.pipe.send((kind, value))

    def stop(self) -> None:
        self.stopped = self.stopped or time.monotonic()
        self.send("stop")


@dataclass(frozen=True)
class QueueStatus:
    """The state of the queue."""

    workers: int
    """How many processes may train at once."""
    running: int
    queued: int
    free_bytes: int
    """Of the disk of the recordings."""
    waiting_for: str
    """Why no further job is started although there is a worker; empty if one would be."""


class JobPool:
    """The jobs of a recordings folder; thread-safe.

    Args:
        recordings: the folder; created if it is missing.
        workers: how many processes train at once.
        max_unfinished: the maximum number of unfinished jobs.
        ray: the address of a Ray cluster that does the work instead.

    Raises:
        RunnerError: another process serves the folder, or Ray is not installed.
        StorageError: the folder cannot be written.
    """

    def __init__(
        self, recordings: Path, workers: int, *, max_unfinished: int = 1000, ray: str | None = None
    ) -> None:
        if ray is not None:
            require_ray()
        self.recordings, self.workers, self._ray = recordings.absolute(), workers, ray
        self.store = JobStore(self.recordings, max_unfinished)
        self.checker = JobChecker(self.recordings)
        self._context = multiprocessing.get_context("spawn")
        self.watchers = 0
        """Number of open event streams."""
        self._busy: dict[int, _Worker] = {}
        self._progress: dict[int, JobProgress] = {}
        """The last progress that each job's worker sent, also when the job is over."""
        self._lock = threading.RLock()
        self._start_problem, self._retry_at = "", 0.0
        """Why the last attempt to start a worker failed, and when to try again (monotonic seconds)."""
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="jobs", daemon=True)

    def __enter__(self) -> Self:
        """Start working: jobs that the last server left running or interrupted come first."""
        for job in self.store.jobs():
            if job.state in ("running", "interrupted"):
                self._update(job.number, state="queued")
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Have every worker close its recording; the next server of the folder resumes its job."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()
        self.checker.close()
        self.store.close()

    @property
    def is_working(self) -> bool:
        """Whether queued jobs are started: the thread that does so is alive and can start workers."""
        return self._thread.is_alive() and not self._start_problem

    def add(self, text: str, checked: CheckedJob) -> Job:
        """Queue a text that was checked.

        Raises:
            QueueFull: there are too many unfinished jobs.
            StorageError: the disk would not hold its recordings.
            JobStateConflict: a sweep of this name is unfinished.
        """
        free = free_bytes(self.recordings)
        if checked.bytes > free:
            raise StorageError(
                f"{checked.name}: its recordings need about {checked.bytes / 1e9:,.1f} GB, and "
                f"{free / 1e9:,.1f} GB are free: free some, or record less (recording.steps, seeds)."
            )
        with self._lock:
            if checked.kind == "sweep":
                self._refuse_running_sweep(checked.name)
            return self.store.add(
                checked.kind, checked.name, checked.runs, text, checked.values, keep=self._busy
            )

    def cancel(self, number: int) -> Job:
        """Cancel a job; its worker closes its recording, which stays.

        Raises:
            JobNotFound: there is none.
            JobStateConflict: it is over.
        """
        with self._lock:
            job = self.store.job(number)
            if job.is_over:
                raise JobStateConflict(f"job {number} is {job.state} already; there is nothing to cancel.")
            job = self._update(number, state="cancelled", ended=now())
            if number in self._busy:
                self._busy[number].stop()
            return job

    def resume(self, number: int, accept_changes: bool = False) -> Job:
        """Queue a failed or cancelled job again; it continues where it stopped.

        Args:
            number: the job's number.
            accept_changes: resume runs that were started by other code.

        Raises:
            JobNotFound: there is none.
            JobStateConflict: it is finished, or not over yet.
        """
        with self._lock:
            job = self.store.job(number)
            if job.state not in ("failed", "cancelled"):
                hint = "there is nothing to do" if job.state == "finished" else "wait for its end"
                raise JobStateConflict(f"job {number} is {job.state}; {hint}.")
            if job.kind == "sweep":
                self._refuse_running_sweep(job.name)
            options = {"accept_changes": accept_changes, "retry": True}
            return self._update(number, state="queued", error="", ended="", deaths=0, **options)

    def progress(self, number: int) -> JobProgress | None:
        """Return the progress that a job's worker last sent, also when it is over; None if none did."""
        with self._lock:
            return self._progress.get(number)

    def status(self) -> QueueStatus:
        """Return the state of the queue."""
        with self._lock:
            states = [job.state for job in self.store.jobs()]
            return QueueStatus(
                self.workers,
                states.count("running"),
                states.count("queued"),
                free_bytes(self.recordings),
                self._start_problem or self._short_of_disk(),
            )

    def _update(self, number: int, **changes: Any) -> Job:
        with contextlib.suppress(StorageError):  # a full disk does not stop the other jobs
            return self.store.update(number, **changes)
        return self.store.job(number)

    def _refuse_running_sweep(self, name: str) -> None:
        for job in self.store.jobs():
            if job.kind == "sweep" and job.name == name and not job.is_over:
                raise JobStateConflict(f"job {job.number} does the sweep {name!r} already.")

    def _run(self) -> None:
        """Start workers and receive their messages, until the server stops."""
        while not self._stopping.is_set():
            with _logged(), self._lock:
                self._start_next()
                self._share_slots()
            with _logged():
                self._receive()
        with self._lock:
            for worker in self._busy.values():
                worker.stop()
        while self._busy:
            with _logged():
                self._receive()

    def _start_next(self) -> None:
        """Start a worker for the first queued job, if there is a slot."""
        job = next((job for job in self.store.jobs() if job.state == "queued"), None)
        if job is None:
            self._start_problem = ""
            return
        slots = sum(max(worker.slots, worker.confirmed) for worker in self._busy.values())
        if slots >= self.workers or job.number in self._busy or self._short_of_disk():
            return
        if time.monotonic() < self._retry_at:
            return
        try:
            self._busy[job.number] = self._start_worker(job)
        except (OSError, StorageError) as error:  # no process, memory, descriptor or disk space is left
            reason = error.strerror if isinstance(error, OSError) and error.strerror else error
            self._start_problem = f"no worker process can be started ({reason})"
            self._retry_at = time.monotonic() + RETRY_SECONDS
            LOG.warning("worker", extra={"job": job.number, "problem": self._start_problem})
            return
        except Exception as error:
            problem = f"its worker cannot be started: {error}"
            self._update(job.number, state="failed", error=problem, ended=now())
            raise
        self._start_problem = ""
        remembered = {each.number for each in self.store.jobs()} - {job.number}
        self._progress = {number: last for number, last in self._progress.items() if number in remembered}
        self._update(job.number, state="running", started=job.started or now())

    def _start_worker(self, job: Job) -> _Worker:
        """Start the worker process of a job.

        Raises:
            OSError: the system has no process, pipe or memory for it.
            StorageError: the ids of its runs cannot be stored.
        """
        values = self.store.values(job.number)
        spec = JobSpec(
            number=job.number,
            kind=job.kind,
            name=job.name,
            values=values,
            run_ids=self._reserved_runs(job, values),
            recordings=self.recordings,
            accept_changes=job.accept_changes,
            retry=job.retry,
            ray=self._ray,
        )
        ours, theirs = self._context.Pipe()
        with contextlib.closing(theirs):
            # Not a daemon: a sweep's worker has child processes of its own.
            process = self._context.Process(target=work, args=(theirs, spec), name=f"job-{job.number}")
            try:
                process.start()
            except BaseException:
                ours.close()
                raise
        return _Worker(job.number, process, ours)

    def _reserved_runs(self, job: Job, values: dict[str, Any]) -> dict[int, str]:
        """Return the run id of each seed, stored before the run exists: so no run is started twice."""
        if job.kind == "sweep":
            return {}
        run_ids = self.store.run_ids(job.number, started=False)
        seeds = [seed for seed in from_mapping(values).seeds if seed not in run_ids]
        missing = {seed: new_run_id(self.recordings) for seed in seeds}
        self.store.reserve_runs(job.number, missing)
        return run_ids | missing

    def _share_slots(self) -> None:
        """Give the slots that no job waits for to the first sweep, and take them back when one does."""
        if self._ray is not None:
            return  # a sweep's workers are the cluster's
        jobs = {job.number: job for job in self.store.jobs()}
        is_waiting = any(job.state == "queued" for job in jobs.values()) and not self._short_of_disk()
        spare = max(0, self.workers - len(self._busy) - is_waiting)
        for number, worker in sorted(self._busy.items()):
            slots = 1
            if jobs[number].kind == "sweep":
                slots, spare = 1 + spare, 0
            if slots != worker.slots:
                worker.slots = slots
                worker.send("slots", slots)

    def _short_of_disk(self) -> str:
        free = free_bytes(self.recordings)
        if free >= RESERVE_BYTES:
            return ""
        needed = f"{RESERVE_BYTES / 1e6:,.0f} MB"
        return f"disk: {free / 1e6:,.0f} MB are free, and a job is started when {needed} are"

    def _receive(self) -> None:
        """Receive messages of workers, and handle those that died or do not stop."""
        by_pipe = {worker.pipe: worker for worker in self._busy.values()}
        if not by_pipe:
            self._stopping.wait(RECEIVE_SECONDS)
            return
        for pipe in connection.wait(list(by_pipe), RECEIVE_SECONDS):
            with _logged():
                self._receive_from(by_pipe[pipe])
        for worker in by_pipe.values():
            if worker.stopped is not None and time.monotonic() - worker.stopped > STOP_SECONDS:
                worker.process.kill()

    def _receive_from(self, worker: _Worker) -> None:
        """Handle one message of a worker, or its end."""
        try:
            kind, value = worker.pipe.recv()
        except Exception as error:
            if not isinstance(error, EOFError | OSError):  # after an unpicklable message the pipe is useless
                LOG.exception("jobs")
                worker.process.kill()
            self._remove(worker)
            return
        number = worker.number
        with self._lock:
            if kind == "over":
                worker.outcome = value
                self._store_outcome(self.store.job(number), value)
            elif kind == "progress":
                self._progress[number] = value
            elif kind == "slots":
                worker.confirmed = value
            elif kind == "run":
                self.store.start_run(number, value["seed"], value["run_id"])
            else:
                self.store.add_events(number, kind, [data | {"time": now()} for data in value])

    def _store_outcome(self, job: Job, outcome: Outcome) -> None:
        """Store the outcome of a job; one that was cancelled, and perhaps queued again, keeps its state."""
        if job.state != "running":
            return
        if outcome.state == "interrupted":
            self._update(job.number, state="interrupted" if self._stopping.is_set() else "queued")
        else:
            self._update(job.number, state=outcome.state, error=outcome.error, ended=now())

    def _remove(self, worker: _Worker) -> None:
        """Remove a worker whose process has ended, or is about to; queue its job again if it died, once."""
        worker.pipe.close()
        worker.process.join(STOP_SECONDS)
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()
        with self._lock:
            del self._busy[worker.number]
            job = self.store.job(worker.number)
            if worker.outcome is not None or job.state != "running":
                return
            code, deaths = worker.process.exitcode, job.deaths + 1
            death = {"text": f"the worker died (exit code {code})", "time": now()}
            self.store.add_events(job.number, "log", [death])
            if deaths < MAX_DEATHS:
                self._update(job.number, state="queued", deaths=deaths)
                return
            error = f"its worker died {deaths} times, at last with exit code {code}; was there enough memory?"
            self._update(job.number, state="failed", deaths=deaths, error=error, ended=now())


@contextlib.contextmanager
def _logged() -> Iterator[None]:
    """Log an exception and continue: what goes wrong with one job must not stop the others."""
    try:
        yield
    except Exception:
        LOG.exception("jobs")
        time.sleep(RECEIVE_SECONDS)  # it may happen again at once
