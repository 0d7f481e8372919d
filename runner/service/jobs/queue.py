"""The queue of jobs, and the processes that run them next to the server."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Final, Self

from runner.client.jobs import EventData, LogEvent, QueueStatus, StateEvent
from runner.errors import StorageError
from runner.execution.estimate import free_bytes
from runner.service.errors import StateConflict
from runner.service.jobs.checking import JobChecker
from runner.service.jobs.store import CheckedJob, JobStore, QueuedJob, now
from runner.service.jobs.worker import JobSpec, work
from runner.service.logs import LOG
from runner.service.processes import PRELOADED
from runner.util.humanize import size
from runner.util.processes import process_context, start_process

STOP_SECONDS: Final = 15.0
"""How long a worker may take to close its recording before it is killed."""
LOOK_SECONDS: Final = 0.1
"""Time between two looks for a job to start or to stop."""
MAX_DEATHS: Final = 2
"""A job fails when this number of its workers have died."""
RESERVE_BYTES: Final = 256 << 20
"""No job is started while the disk has less space."""
RETRY_SECONDS: Final = 5.0
"""Time between attempts to start a worker when the system has no process to give."""


class WorkerPool:
    """Runs the queued jobs of a store, each in a worker process, or on a Ray cluster.

    One thread starts the workers. For each of them, another one receives its events, and stops it when its
    job is no longer running. The other methods read.
    """

    def __init__(self, store: JobStore, size: int, ray: str | None) -> None:
        self.size = size
        self.ray = ray
        self._store = store
        self._context = process_context(PRELOADED)
        self._busy: dict[int, tuple[QueuedJob, threading.Thread]] = {}
        """The jobs whose worker has not ended, by number, each with the thread that follows its worker."""
        self._start_problem, self._retry_at = "", 0.0
        """Why the last attempt to start a worker failed, and when to try again (monotonic seconds)."""
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="jobs", daemon=True)

    def start(self) -> None:
        """Start running jobs."""
        self._thread.start()

    def stop(self) -> None:
        """Have every worker close its recording, and wait until all have ended."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()

    @property
    def is_working(self) -> bool:
        """Whether queued jobs are started: the thread that does so is alive and can start workers."""
        return self._thread.is_alive() and not self._start_problem

    def waiting_for(self) -> str:
        """Return why the next job is not started although a worker is free; empty if it would be."""
        job, free = self._next_job(), self._free()
        needed = 0 if job is None else self._needed(job)
        if job is not None and needed > free > 0:
            return f"job {job.number} waits for {needed} workers; free: {free}"
        return self._start_problem or self._short_of_disk()

    def _run(self) -> None:
        """Start workers until the server stops, then wait for their ends."""
        while not self._stopping.wait(LOOK_SECONDS):
            with _logged(), self._store.lock:
                self._start_next()
        for _, thread in list(self._busy.values()):
            thread.join()

    def _start_next(self) -> None:
        """Start the first queued job, if the workers that it needs are free."""
        job = self._next_job()
        if job is None:
            self._start_problem = ""
            return
        if time.monotonic() < self._retry_at or job.number in self._busy:
            return
        if self._needed(job) > self._free() or self._short_of_disk():
            return
        job = replace(job, workers=self._needed(job))
        spec = JobSpec(self._store.path(job.number), job)
        try:
            ours, theirs = self._context.Pipe()
            with contextlib.closing(theirs):
                # Not a daemon: a sweep's worker has child processes of its own.
                process = start_process(self._context, work, theirs, spec, self.ray, name=f"job-{job.number}")
        except OSError as error:  # no process, memory or descriptor is left
            self._start_problem = f"no worker process can be started ({error.strerror or error})"
            self._retry_at = time.monotonic() + RETRY_SECONDS
            LOG.warning("worker", extra={"job": job.number, "problem": self._start_problem})
            return
        except Exception as error:
            problem = f"its worker cannot be started: {error}"
            self._store.update(job.number, state="failed", error=problem, ended=now())
            raise
        self._start_problem = ""
        self._store.update(job.number, state="running", started=job.started or now(), progress=None)
        thread = threading.Thread(target=self._follow, args=(job, process, ours), daemon=True)
        self._busy[job.number] = job, thread
        try:
            thread.start()
        except RuntimeError as error:  # no thread is left
            self._start_problem = str(error)
            self._retry_at = time.monotonic() + RETRY_SECONDS
            ours.close()  # its worker stops
            self._end(job, process, None)

    def _next_job(self) -> QueuedJob | None:
        """Return the job that is started next: jobs start in the order of their numbers."""
        return next((job for job in self._store.jobs() if job.state == "queued"), None)

    def _needed(self, job: QueuedJob) -> int:
        """Return how many workers a job uses: this server may have fewer than the one it was submitted to."""
        return min(job.workers, self.size)

    def _free(self) -> int:
        return self.size - sum(job.workers for job, _ in list(self._busy.values()))

    def _short_of_disk(self) -> str:
        free = free_bytes(self._store.recordings)
        if free >= RESERVE_BYTES:
            return ""
        return f"disk: {size(free)} are free, and a job is started when {size(RESERVE_BYTES)} are"

    def _follow(self, job: QueuedJob, process: BaseProcess, pipe: Connection) -> None:
        """Keep the events of a worker until it ends; stop it when its job is no longer running."""
        outcome: StateEvent | None = None
        kill_at = math.inf
        try:
            while outcome is None:
                if kill_at < math.inf:
                    if time.monotonic() > kill_at:
                        process.kill()
                elif self._stopping.is_set() or not self._store.is_running(job.number):
                    kill_at = time.monotonic() + STOP_SECONDS
                    with contextlib.suppress(OSError):  # it is dead
                        pipe.send(None)
                if pipe.poll(LOOK_SECONDS):
                    event: EventData = pipe.recv()
                    if isinstance(event, StateEvent):
                        outcome = event
                    else:
                        with _logged():
                            self._store.report(job.number, event)
        except (EOFError, OSError):
            pass  # it is dead
        except Exception:  # an event that cannot be read; after it the pipe is useless
            LOG.exception("jobs")
            process.kill()
        pipe.close()
        with _logged():
            self._end(job, process, outcome)

    def _end(self, job: QueuedJob, process: BaseProcess, outcome: StateEvent | None) -> None:
        """Free the workers of a job whose process is about to end, with its outcome; None if it died.

        A job that was cancelled, and perhaps queued again, keeps its state. When a worker died, or was
        stopped from outside, its job is queued again, unless too many workers died.
        """
        process.join(STOP_SECONDS)
        process.kill()
        process.join()
        with self._store.lock:
            del self._busy[job.number]
            if not self._store.is_running(job.number):
                return
            job = self._store.job(job.number)
            deaths = job.deaths + (outcome is None)
            if outcome is None:
                code = process.exitcode
                self._store.report(job.number, LogEvent(f"the worker died (exit code {code})"))
                error = (
                    f"its worker died {deaths} times, at last with exit code {code}; was there enough memory?"
                )
                outcome = StateEvent("failed", error) if deaths >= MAX_DEATHS else StateEvent("interrupted")
            is_over = outcome.state != "interrupted"
            state = outcome.state if is_over or self._stopping.is_set() else "queued"
            ended = now() if is_over else ""
            self._store.update(job.number, state=state, error=outcome.error or "", ended=ended, deaths=deaths)


@contextlib.contextmanager
def _logged() -> Iterator[None]:
    """Log an exception and continue: what goes wrong with one job must not stop the others."""
    try:
        yield
    except Exception:
        LOG.exception("jobs")
        time.sleep(LOOK_SECONDS)  # it may happen again at once


class JobQueue:
    """The jobs of a recordings folder, done by worker processes or on a Ray cluster; thread-safe."""

    def __init__(
        self, recordings: Path, workers: int, *, max_unfinished: int = 1000, ray: str | None = None
    ) -> None:
        self.recordings = recordings.absolute()
        self.store = JobStore(self.recordings, max_unfinished)
        self.pool = WorkerPool(self.store, workers, ray)
        self.checker = JobChecker(self.recordings)
        self.watchers = 0
        """Number of open event streams."""

    def __enter__(self) -> Self:
        """Start working: jobs that the last server left running or interrupted come first."""
        for job in self.store.jobs():
            if job.state in ("running", "interrupted"):
                self.store.update(job.number, state="queued")
        self.pool.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Have every worker close its recording; the next server of the folder resumes its job."""
        self.pool.stop()
        self.checker.close()
        self.store.close()

    def add(self, text: str, checked: CheckedJob, workers: int | None = None) -> QueuedJob:
        """Queue a text that was checked.

        `workers` are what it asks for, by default all for a sweep or an explanation. A job gets no more than
        it can use, and than there are; its log says so.

        Raises:
            StorageError: the disk would not hold its recordings.
        """
        free = free_bytes(self.recordings)
        if checked.bytes > free:
            raise StorageError(
                f"{checked.name}: its recordings need about {size(checked.bytes)}, and "
                f"{size(free)} are free: free some, or record less (recording.steps, seeds)."
            )
        with self.store.lock:
            if checked.kind == "sweep":
                self._refuse_running_sweep(checked.name)
            # A cluster has workers of its own for the runs of a job.
            usable = 1 if checked.seeds or self.pool.ray is not None else min(checked.runs, self.pool.size)
            given = min(workers or self.pool.size, usable)
            job = self.store.add(checked, text, given)
            if workers is not None and workers > given:
                line = f"{workers} workers were requested; it gets {given}, the most that it can use here"
                self.store.report(job.number, LogEvent(line))
            return job

    def cancel(self, number: int) -> QueuedJob:
        """Cancel a job; its worker closes its recording, which stays.

        Raises:
            StateConflict: it is over.
        """
        with self.store.lock:
            job = self.store.job(number)
            if job.is_over:
                raise StateConflict(f"job {number} is {job.state} already; there is nothing to cancel.")
            return self.store.update(number, state="cancelled", ended=now())

    def resume(self, number: int, accept_changes: bool = False) -> QueuedJob:
        """Queue a failed or cancelled job again; it continues where it stopped.

        Runs that other code started are resumed only if the changes are accepted.

        Raises:
            StateConflict: it is finished, or not over yet.
        """
        with self.store.lock:
            job = self.store.job(number)
            if job.state not in ("failed", "cancelled"):
                hint = "there is nothing to do" if job.state == "finished" else "wait for its end"
                raise StateConflict(f"job {number} is {job.state}; {hint}.")
            if job.kind == "sweep":
                self._refuse_running_sweep(job.name)
            return self.store.update(
                number,
                state="queued",
                error="",
                ended="",
                deaths=0,
                retry=True,
                accept_changes=accept_changes,
            )

    def status(self) -> QueueStatus:
        """Return the state of the queue."""
        states = [job.state for job in self.store.jobs()]
        return QueueStatus(
            self.pool.size,
            states.count("running"),
            states.count("queued"),
            free_bytes(self.recordings),
            self.pool.waiting_for(),
        )

    def _refuse_running_sweep(self, name: str) -> None:
        for job in self.store.jobs():
            if job.kind == "sweep" and job.name == name and not job.is_over:
                raise StateConflict(
                    f"job {job.number} does the sweep {name!r} already; wait for its end, or cancel it."
                )
