"""The queue of jobs: what can be requested of it; `WorkerPool` runs them."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from runner.client.jobs import LogEvent, QueueStatus
from runner.errors import StorageError
from runner.execution.estimate import free_bytes
from runner.service.errors import StateConflict
from runner.service.jobs.checking import JobChecker
from runner.service.jobs.store import CheckedJob, JobStore, QueuedJob, now
from runner.service.jobs.workers import WorkerPool
from runner.util.humanize import size


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
            given = min(workers or self.pool.size, self._usable_workers(checked))
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

    def _usable_workers(self, checked: CheckedJob) -> int:
        """Return the most workers that a job can use; a cluster has its own for the runs of a job."""
        if checked.seeds or self.pool.ray is not None:
            return 1
        return min(checked.runs, self.pool.size)

    def _refuse_running_sweep(self, name: str) -> None:
        for job in self.store.jobs():
            if job.kind == "sweep" and job.name == name and not job.is_over:
                raise StateConflict(
                    f"job {job.number} does the sweep {name!r} already; wait for its end, or cancel it."
                )
