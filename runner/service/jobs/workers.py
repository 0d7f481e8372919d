"""The processes that run jobs, next to the server: started, sent messages, and received from."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from multiprocessing import connection
from multiprocessing.process import BaseProcess
from typing import Any, Final

from runner.client.jobs import EventData, LogEvent, StateEvent
from runner.execution.estimate import free_bytes
from runner.service.jobs.channel import JobSpec
from runner.service.jobs.store import JobStore, QueuedJob, now
from runner.service.jobs.worker import work
from runner.service.logs import LOG
from runner.service.processes import PRELOADED
from runner.util.humanize import size
from runner.util.processes import process_context, start_process

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
    job: QueuedJob
    process: BaseProcess
    pipe: Any
    stopped: float | None = None
    """When the request to stop was sent."""

    def stop(self) -> None:
        """Ask the worker to close its recording; kill it if it does not."""
        if self.stopped is None:
            self.stopped = time.monotonic()
            with contextlib.suppress(OSError):  # it is dead
                self.pipe.send(None)
        elif time.monotonic() - self.stopped > STOP_SECONDS:
            self.process.kill()


class WorkerPool:
    """Runs the queued jobs of a store, each in a worker process, or on a Ray cluster.

    One thread starts the workers, receives their events, and stops a worker when its job is no longer
    running; the other methods read.
    """

    def __init__(self, store: JobStore, size: int, ray: str | None) -> None:
        self.size, self.ray, self._store = size, ray, store
        self._context = process_context(PRELOADED)
        self._busy: dict[int, _Worker] = {}
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
        """Start workers and receive their events, until the server stops."""
        while self._busy or not self._stopping.is_set():
            with _logged(), self._store.lock:
                self._start_next()
            with _logged():
                self._receive()

    def _start_next(self) -> None:
        """Start the first queued job, if the workers that it needs are free."""
        job = self._next_job()
        if job is None:
            self._start_problem = ""
            return
        if self._stopping.is_set() or time.monotonic() < self._retry_at or job.number in self._busy:
            return
        if self._needed(job) > self._free() or self._short_of_disk():
            return
        try:
            self._busy[job.number] = self._start_worker(job)
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

    def _start_worker(self, job: QueuedJob) -> _Worker:
        """Start the worker process of a job."""
        job = replace(job, workers=self._needed(job))
        spec = JobSpec(self._store.path(job.number), job)
        ours, theirs = self._context.Pipe()
        with contextlib.closing(theirs):
            # Not a daemon: a sweep's worker has child processes of its own.
            try:
                process = start_process(self._context, work, theirs, spec, self.ray, name=f"job-{job.number}")
            except BaseException:
                ours.close()
                raise
        return _Worker(job, process, ours)

    def _next_job(self) -> QueuedJob | None:
        """Return the job that is started next: jobs start in the order of their numbers."""
        return next((job for job in self._store.jobs() if job.state == "queued"), None)

    def _needed(self, job: QueuedJob) -> int:
        """Return how many workers a job uses: this server may have fewer than the one it was submitted to."""
        return min(job.workers, self.size)

    def _free(self) -> int:
        return self.size - sum(worker.job.workers for worker in list(self._busy.values()))

    def _short_of_disk(self) -> str:
        free = free_bytes(self._store.recordings)
        if free >= RESERVE_BYTES:
            return ""
        return f"disk: {size(free)} are free, and a job is started when {size(RESERVE_BYTES)} are"

    def _receive(self) -> None:
        """Receive events of workers, and stop workers that have nothing more to do."""
        by_pipe = {worker.pipe: worker for worker in self._busy.values()}
        if not by_pipe:
            self._stopping.wait(RECEIVE_SECONDS)
            return
        for worker in by_pipe.values():
            if self._stopping.is_set() or not self._store.is_running(worker.job.number):
                worker.stop()
        for pipe in connection.wait(list(by_pipe), RECEIVE_SECONDS):
            with _logged():
                self._receive_from(by_pipe[pipe])

    def _receive_from(self, worker: _Worker) -> None:
        """Handle one event of a worker, or its end."""
        event: EventData | None = None
        try:
            event = worker.pipe.recv()
        except (EOFError, OSError):
            pass
        except Exception:  # an event that cannot be read; after it the pipe is useless
            LOG.exception("jobs")
            worker.process.kill()
        if event is None or isinstance(event, StateEvent):
            self._end(worker, event)
        else:
            self._store.report(worker.job.number, event)

    def _end(self, worker: _Worker, outcome: StateEvent | None) -> None:
        """Remove a worker that is about to end, with the outcome of its job; None if it died.

        A job that was cancelled, and perhaps queued again, keeps its state. When a worker died, or was
        stopped from outside, its job is queued again, unless too many workers died.
        """
        worker.process.join(STOP_SECONDS)
        worker.process.kill()
        worker.process.join()
        worker.pipe.close()
        with self._store.lock:
            del self._busy[worker.job.number]
            if not self._store.is_running(worker.job.number):
                return
            job = self._store.job(worker.job.number)
            deaths = job.deaths + (outcome is None)
            if outcome is None:
                code = worker.process.exitcode
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
        time.sleep(RECEIVE_SECONDS)  # it may happen again at once
