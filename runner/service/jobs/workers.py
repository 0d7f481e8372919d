"""The processes that run jobs, next to the server: started, sent messages, and received from."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Container, Iterator
from dataclasses import dataclass
from multiprocessing import connection
from multiprocessing.process import BaseProcess
from typing import Any, Final

from runner.client.jobs import JobProgress, LogEvent, RunEvent
from runner.config import from_mapping
from runner.errors import StorageError
from runner.execution.estimate import free_bytes
from runner.runs.run import new_run_id
from runner.service.jobs.channel import JobSpec, Message, Outcome
from runner.service.jobs.store import WITHOUT_RUNS, Job, JobStore, now
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
    job: Job
    process: BaseProcess
    pipe: Any
    outcome: Outcome | None = None
    stopped: float | None = None
    """When the request to stop was sent."""

    def stop(self) -> None:
        self.stopped = self.stopped or time.monotonic()
        with contextlib.suppress(OSError):  # it is dead
            self.pipe.send(None)


class WorkerPool:
    """Runs the queued jobs of a store, each in a worker process, or on a Ray cluster.

    One thread starts the workers and receives their messages; the other methods read, or send a request.
    """

    def __init__(self, store: JobStore, size: int, ray: str | None) -> None:
        self.size, self._store, self._ray, self._lock = size, store, ray, store.lock
        self._context = process_context(PRELOADED)
        self._busy: dict[int, _Worker] = {}
        self._progress: dict[int, JobProgress] = {}
        """The last progress that each job's worker sent, also when the job is over."""
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

    @property
    def is_on_cluster(self) -> bool:
        """Whether a Ray cluster runs the jobs."""
        return self._ray is not None

    @property
    def busy(self) -> Container[int]:
        """The numbers of the jobs that have a worker."""
        return self._busy

    def stop_job(self, number: int) -> None:
        """Have the worker of a job, if it has one, close its recording."""
        with self._lock:
            if number in self._busy:
                self._busy[number].stop()

    def progress(self, number: int) -> JobProgress | None:
        """Return the progress that a job's worker last sent, also when it is over; None if none did."""
        return self._progress.get(number)

    def waiting_for(self) -> str:
        """Return why the next job is not started although a worker is free; empty if it would be."""
        job, free = self._next_job(), self._free()
        needed = 0 if job is None else self._needed(job)
        if job is not None and needed > free > 0:
            return f"job {job.number} waits for {needed} workers; free: {free}"
        return self._start_problem or self._short_of_disk()

    def _run(self) -> None:
        """Start workers and receive their messages, until the server stops."""
        while not self._stopping.is_set():
            with _logged(), self._lock:
                self._start_next()
            with _logged():
                self._receive()
        with self._lock:
            for worker in self._busy.values():
                worker.stop()
        while self._busy:
            with _logged():
                self._receive()

    def _start_next(self) -> None:
        """Start the first queued job, if the workers that it needs are free."""
        job = self._next_job()
        if job is None:
            self._start_problem = ""
            return
        if self._needed(job) > self._free() or job.number in self._busy or self._short_of_disk():
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
            self._store.set_state(job.number, "failed", error=problem, ended=now())
            raise
        self._start_problem = ""
        remembered = {each.number for each in self._store.jobs()} - {job.number}
        self._progress = {number: last for number, last in self._progress.items() if number in remembered}
        self._store.set_state(job.number, "running", started=job.started or now())

    def _start_worker(self, job: Job) -> _Worker:
        """Start the worker process of a job."""
        values = self._store.values(job.number)
        spec = JobSpec(
            job=job,
            values=values,
            run_ids=self._reserved_runs(job, values),
            recordings=self._store.recordings,
            workers=self._needed(job) if self._ray is None else None,
            ray=self._ray,
        )
        ours, theirs = self._context.Pipe()
        with contextlib.closing(theirs):
            # Not a daemon: a sweep's worker has child processes of its own.
            try:
                process = start_process(self._context, work, theirs, spec, name=f"job-{job.number}")
            except BaseException:
                ours.close()
                raise
        return _Worker(job, process, ours)

    def _reserved_runs(self, job: Job, values: dict[str, object]) -> dict[int, str]:
        """Return the run id of each seed, stored before the run exists: so no run is started twice."""
        if job.kind in WITHOUT_RUNS:
            return {}
        run_ids = self._store.run_ids(job.number, started=False)
        seeds = [seed for seed in from_mapping(values).seeds if seed not in run_ids]
        missing = {seed: new_run_id(self._store.recordings) for seed in seeds}
        self._store.reserve_runs(job.number, missing)
        return run_ids | missing

    def _next_job(self) -> Job | None:
        """Return the job that is started next: jobs start in the order of their numbers."""
        return next((job for job in self._store.jobs() if job.state == "queued"), None)

    def _needed(self, job: Job) -> int:
        """Return how many workers a job uses: this server may have fewer than the one it was submitted to."""
        return min(job.workers, self.size)

    def _free(self) -> int:
        return self.size - sum(self._needed(worker.job) for worker in list(self._busy.values()))

    def _short_of_disk(self) -> str:
        free = free_bytes(self._store.recordings)
        if free >= RESERVE_BYTES:
            return ""
        return f"disk: {size(free)} are free, and a job is started when {size(RESERVE_BYTES)} are"

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
            message: Message = worker.pipe.recv()
        except Exception as error:
            if not isinstance(error, EOFError | OSError):  # after an unpicklable message the pipe is useless
                LOG.exception("jobs")
                worker.process.kill()
            self._remove(worker)
            return
        number = worker.job.number
        with self._lock:
            if isinstance(message, Outcome):
                worker.outcome = message
                self._store_outcome(self._store.job(number), message)
            elif isinstance(message, RunEvent):
                self._store.start_run(number, message.seed, message.run_id)
            elif isinstance(message, tuple):
                self._store.log(number, message)
            else:
                self._progress[number] = message

    def _store_outcome(self, job: Job, outcome: Outcome) -> None:
        """Store the outcome of a job; one that was cancelled, and perhaps queued again, keeps its state."""
        if job.state != "running":
            return
        if outcome.state == "interrupted":
            self._store.set_state(job.number, "interrupted" if self._stopping.is_set() else "queued")
        else:
            self._store.set_state(job.number, outcome.state, error=outcome.error, ended=now())

    def _remove(self, worker: _Worker) -> None:
        """Remove a worker whose process has ended, or is about to; queue its job again if it died, once."""
        worker.pipe.close()
        worker.process.join(STOP_SECONDS)
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()
        with self._lock:
            del self._busy[worker.job.number]
            job = self._store.job(worker.job.number)
            if worker.outcome is not None or job.state != "running":
                return
            code, deaths = worker.process.exitcode, job.deaths + 1
            self._store.log(job.number, [LogEvent(f"the worker died (exit code {code})")])
            if deaths < MAX_DEATHS:
                self._store.set_state(job.number, "queued", deaths=deaths)
                return
            error = f"its worker died {deaths} times, at last with exit code {code}; was there enough memory?"
            self._store.set_state(job.number, "failed", deaths=deaths, error=error, ended=now())


@contextlib.contextmanager
def _logged() -> Iterator[None]:
    """Log an exception and continue: what goes wrong with one job must not stop the others."""
    try:
        yield
    except Exception:
        LOG.exception("jobs")
        time.sleep(RECEIVE_SECONDS)  # it may happen again at once
