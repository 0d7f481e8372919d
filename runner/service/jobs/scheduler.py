"""The jobs of a recordings folder, done by worker processes beside the server.

    with Jobs(recordings, workers=2) as jobs:
        job = jobs.submit(text, "quick.yaml")
        jobs.progress(job.number)

One thread starts the workers and hears what they tell; everything else only asks or notes a wish.
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

from runner.errors import StorageError
from runner.execution.estimate import free_bytes
from runner.service.jobs.checking import Checked, Checker
from runner.service.jobs.queue import Job, JobStateConflict, Queue, now
from runner.service.jobs.spec import Order, Outcome
from runner.service.jobs.worker import work
from runner.service.logs import LOG

GOODBYE_SECONDS: Final = 15.0
"""How long a worker may take to close its recording before it is ended."""
HEAR_SECONDS: Final = 0.1
MOST_DEATHS: Final = 2
"""A job whose worker died so often without being asked for again has failed."""
SOURCE: Final = "job.yaml"
"""What a text is called that came without a name."""
RESERVE_BYTES: Final = 256 << 20
"""No job is begun while the disk has less."""
RETRY_SECONDS: Final = 5.0
"""Time between attempts to start a worker when the system has no process to give."""


@dataclass
class _Worker:
    """A process at work on a job."""

    number: int
    process: Any
    pipe: Any
    slots: int = 1
    """How many processes it may use."""
    taken: int = 1
    """How many it has said to use, or to be allowed, last."""
    outcome: Outcome | None = None
    stopped: float | None = None
    """When it was told to stop."""

    def tell(self, word: str, value: Any = None) -> None:
        """Tell it something, if it lives."""
        with contextlib.suppress(OSError):
            self.pipe.send((word, value))


@dataclass(frozen=True)
class Standing:
    """How the queue stands."""

    workers: int
    """How many processes may learn at once."""
    running: int
    queued: int
    free_bytes: int
    """Of the disk of the recordings."""
    waiting_for: str
    """Why no further job is begun, though there is a worker; empty if one would be."""


class Jobs:
    """The jobs of a recordings folder; its methods may be called by any thread.

    Args:
        recordings: the folder; made if it is missing.
        workers: how many processes learn at once.
        most_waiting: how many jobs may be unfinished at once.
        ray: the address of a cluster of Ray that does the work instead.

    Raises:
        RunnerError: another process serves the folder, or Ray is not installed.
        StorageError: the folder cannot be written.
    """

    def __init__(
        self, recordings: Path, workers: int, *, most_waiting: int = 1000, ray: str | None = None
    ) -> None:
        if ray is not None:
            from runner.sweep.cluster import require_ray

            require_ray()
        self.recordings, self.workers, self._ray = recordings.absolute(), workers, ray
        self.queue = Queue(self.recordings, most_waiting)
        self._checker = Checker(self.recordings)
        self._context = multiprocessing.get_context("spawn")
        self.watchers = 0
        """How many are being told of events; of the routes that tell them."""
        self._busy: dict[int, _Worker] = {}
        self._progress: dict[int, dict[str, Any]] = {}
        """What the worker of each job said last, also after its end."""
        self._lock = threading.RLock()
        self._start_problem, self._retry_at = "", 0.0
        """Why the last attempt to start a worker failed, and when to try again (monotonic seconds)."""
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="jobs", daemon=True)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Begin to work: what was running or interrupted when the last server ended comes first."""
        for job in self.queue.jobs():
            if job.state in ("running", "interrupted"):
                self._change(job.number, state="queued")
        self._thread.start()

    def stop(self) -> None:
        """Have every worker close its recording; its job is gone on with at the next start."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()
        self._checker.close()
        self.queue.close()

    @property
    def is_working(self) -> bool:
        """Whether queued jobs will be started: the thread that does so is alive and can start workers."""
        return self._thread.is_alive() and not self._start_problem

    @property
    def stopping(self) -> bool:
        """Whether the server is about to end."""
        return self._stopping.is_set()

    async def check(self, text: str, source: str = SOURCE) -> Checked:
        """Return what a text means, without queueing it; arguments and errors as for `submit`."""
        return await self._checker.check(text, source)

    def submit(self, text: str, source: str = SOURCE) -> Job:
        """Check the text of a configuration or a sweep, and queue it; waits for the check.

        Args:
            text: YAML, as a file has it.
            source: the file's name, for messages; it names what has no name of its own.

        Raises:
            ConfigError: it cannot be used; a line for each problem, with line, column and key.
            Busy: others were being checked all the time.
        """
        return self.add(text, self._checker.check_now(text, source))

    def add(self, text: str, checked: Checked) -> Job:
        """Queue a text that was checked.

        Raises:
            QueueFull: there are too many jobs already.
            StorageError: the disk would not hold its recordings.
            JobStateConflict: a sweep of this name is being done.
        """
        free = free_bytes(self.recordings)
        if checked.bytes > free:
            raise StorageError(
                f"{checked.name}: its recordings need about {checked.bytes / 1e9:,.1f} GB, and "
                f"{free / 1e9:,.1f} GB are free: free some, or record less (recording.steps, seeds)."
            )
        with self._lock:
            if checked.kind == "sweep":
                self._sweep_is_free(checked.name)
            return self.queue.add(
                checked.kind, checked.name, checked.runs, text, checked.values, keep=self._busy
            )

    def cancel(self, number: int) -> Job:
        """Have a job not be done, or its worker close its recording; what is recorded is kept.

        Raises:
            JobNotFound: there is none.
            JobStateConflict: it is over.
        """
        with self._lock:
            job = self.queue.job(number)
            if job.is_over:
                raise JobStateConflict(f"job {number} is {job.state} already; there is nothing to cancel.")
            job = self._change(number, state="cancelled", ended=now())
            if number in self._busy:
                self._tell_to_stop(self._busy[number])
            return job

    def resume(self, number: int, accept_changes: bool = False) -> Job:
        """Queue a job again that failed or was cancelled: it goes on where it was.

        Args:
            number: which.
            accept_changes: go on with runs that other code began.

        Raises:
            JobNotFound: there is none.
            JobStateConflict: it is finished, or not over yet.
        """
        with self._lock:
            job = self.queue.job(number)
            if job.state not in ("failed", "cancelled"):
                hint = "there is nothing to do" if job.state == "finished" else "let it"
                raise JobStateConflict(f"job {number} is {job.state}; {hint}.")
            if job.kind == "sweep":
                self._sweep_is_free(job.name)
            asked = {"accept_changes": accept_changes, "retry": True}
            return self._change(number, state="queued", error="", ended="", deaths=0, **asked)

    def progress(self, number: int) -> dict[str, Any] | None:
        """Return how far a job was when its worker last said so, also after its end; None if none did."""
        with self._lock:
            return self._progress.get(number)

    def standing(self) -> Standing:
        """Return how the queue stands."""
        with self._lock:
            states = [job.state for job in self.queue.jobs()]
            return Standing(
                self.workers,
                states.count("running"),
                states.count("queued"),
                free_bytes(self.recordings),
                self._start_problem or self._short_of_disk(),
            )

    def _change(self, number: int, **facts: Any) -> Job:
        """Change a job; a disk that is full does not stop the others."""
        with contextlib.suppress(StorageError):
            return self.queue.change(number, **facts)
        return self.queue.job(number)

    def _sweep_is_free(self, name: str) -> None:
        for job in self.queue.jobs():
            if job.kind == "sweep" and job.name == name and not job.is_over:
                raise JobStateConflict(f"job {job.number} does the sweep {name!r} already.")

    def _run(self) -> None:
        """Start workers and hear them, until the server stops."""
        while not self._stopping.is_set():
            with _logged(), self._lock:
                self._begin()
                self._share()
            with _logged():
                self._hear()
        with self._lock:
            for worker in self._busy.values():
                self._tell_to_stop(worker)
        while self._busy:
            with _logged():
                self._hear()

    def _begin(self) -> None:
        """Start a worker for the first job that waits, if there is a slot."""
        waiting = next((job for job in self.queue.jobs() if job.state == "queued"), None)
        if waiting is None:
            self._start_problem = ""
            return
        taken = sum(max(worker.slots, worker.taken) for worker in self._busy.values())
        if taken >= self.workers or waiting.number in self._busy or self._short_of_disk():
            return
        if time.monotonic() < self._retry_at:
            return
        try:
            self._busy[waiting.number] = self._worker(waiting)
        except OSError as error:  # no process, memory or file descriptor is left: the job waits for one
            self._start_problem = f"no worker process can be started ({error.strerror or error})"
            self._retry_at = time.monotonic() + RETRY_SECONDS
            LOG.warning("worker", extra={"job": waiting.number, "problem": self._start_problem})
            return
        except Exception as error:
            self._change(
                waiting.number, state="failed", error=f"its worker cannot be started: {error}", ended=now()
            )
            raise
        self._start_problem = ""
        kept = {job.number for job in self.queue.jobs()} - {waiting.number}
        self._progress = {number: said for number, said in self._progress.items() if number in kept}
        self._change(waiting.number, state="running", started=waiting.started or now())

    def _worker(self, job: Job) -> _Worker:
        """Return a new worker process for a job, started.

        Raises:
            OSError: the system has no process, pipe or memory for it.
        """
        order = Order(
            job.number,
            job.kind,
            job.name,
            self.queue.folder_of(job.number),
            self.recordings,
            job.accept_changes,
            job.retry,
            self._ray,
        )
        ours, theirs = self._context.Pipe()
        with contextlib.closing(theirs):
            # Not a daemon: a sweep's worker has child processes of its own.
            process = self._context.Process(target=work, args=(theirs, order), name=f"job-{job.number}")
            try:
                process.start()
            except BaseException:
                ours.close()
                raise
        return _Worker(job.number, process, ours)

    def _share(self) -> None:
        """Give the slots that nobody waits for to the first sweep, and take them back when somebody does."""
        if self._ray is not None:
            return  # a sweep's workers are the cluster's
        jobs = {job.number: job for job in self.queue.jobs()}
        waiting = any(job.state == "queued" for job in jobs.values()) and not self._short_of_disk()
        spare = max(0, self.workers - len(self._busy) - waiting)
        for number in sorted(self._busy):
            worker = self._busy[number]
            slots = 1 + (spare if jobs[number].kind == "sweep" else 0)
            if jobs[number].kind == "sweep":
                spare = 0
            if slots != worker.slots:
                worker.slots = slots
                worker.tell("slots", slots)

    def _short_of_disk(self) -> str:
        free = free_bytes(self.recordings)
        if free >= RESERVE_BYTES:
            return ""
        return (
            f"disk: {free / 1e6:,.0f} MB are free, and a job is begun when {RESERVE_BYTES / 1e6:,.0f} MB are"
        )

    def _hear(self) -> None:
        """Take in what workers tell, and see to those that are gone or do not go."""
        by_pipe = {worker.pipe: worker for worker in self._busy.values()}
        if not by_pipe:
            self._stopping.wait(HEAR_SECONDS)
            return
        for pipe in connection.wait(list(by_pipe), HEAR_SECONDS):
            with _logged():
                self._receive(by_pipe[pipe])
        for worker in by_pipe.values():
            if worker.stopped is not None and time.monotonic() - worker.stopped > GOODBYE_SECONDS:
                worker.process.kill()

    def _receive(self, worker: _Worker) -> None:
        """Take in one message of a worker, or its end."""
        try:
            word, value = worker.pipe.recv()
        except Exception as error:  # also what cannot be unpickled: the pipe is of no use any more
            if not isinstance(error, EOFError | OSError):
                LOG.exception("jobs")
                worker.process.kill()
            self._part(worker)
            return
        with self._lock:
            if word == "over":
                worker.outcome = value
                self._settle(self.queue.job(worker.number), worker)
            elif word == "progress":
                self._progress[worker.number] = value
            elif word == "slots":
                worker.taken = value
            else:
                self.queue.note(worker.number, word, value | {"time": now()})

    def _part(self, worker: _Worker) -> None:
        """Take leave of a worker whose process has ended, or is about to."""
        worker.pipe.close()
        worker.process.join(GOODBYE_SECONDS)
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()
        with self._lock:
            del self._busy[worker.number]
            if worker.outcome is None:
                self._count_death(self.queue.job(worker.number), worker)

    def _settle(self, job: Job, worker: _Worker) -> None:
        """Write down what came of a job; one that was cancelled, and perhaps queued again, stays so."""
        outcome = worker.outcome
        if outcome is None or job.state != "running":
            return
        if outcome.state == "interrupted":
            self._change(job.number, state="interrupted" if self.stopping else "queued")
        else:
            self._change(job.number, state=outcome.state, error=outcome.error, ended=now())

    def _count_death(self, job: Job, worker: _Worker) -> None:
        """Queue a job again whose worker died over it, but not for ever."""
        if job.state != "running":
            return
        code, deaths = worker.process.exitcode, job.deaths + 1
        self.queue.note(job.number, "log", {"text": f"the worker died (exit code {code})", "time": now()})
        if deaths < MOST_DEATHS:
            self._change(job.number, state="queued", deaths=deaths)
        else:
            error = f"its worker died {deaths} times, at last with exit code {code}; was there enough memory?"
            self._change(job.number, state="failed", deaths=deaths, error=error, ended=now())

    def _tell_to_stop(self, worker: _Worker) -> None:
        worker.stopped = worker.stopped or time.monotonic()
        worker.tell("stop")


@contextlib.contextmanager
def _logged() -> Iterator[None]:
    """Log an exception and carry on: whatever goes wrong with one job must not stop the others."""
    try:
        yield
    except Exception:
        LOG.exception("jobs")
        time.sleep(HEAR_SECONDS)  # it may come again at once
