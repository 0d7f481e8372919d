"""A sweep's job: run by processes within the slots there are, or by a Ray cluster."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Generic, Self

from runner.client.jobs import BestTrial, LogEvent, SweepProgress
from runner.service.jobs.channel import (
    OTHER_OWNER_SECONDS,
    REPORT_SECONDS,
    JobSpec,
    Outcome,
    PipeChannel,
    Slots,
    wait_for_owners,
)
from runner.sweep import state, sweeps_in
from runner.sweep.cluster import RayWorkers
from runner.sweep.loading import from_values
from runner.sweep.local import LocalWorkers, R, T, Workers
from runner.sweep.plan import limit_of, plan_of, require_disk
from runner.sweep.running import INTERRUPTED, SweepStatus, run_sweep
from runner.sweep.task import Result, Task


def run_sweep_job(spec: JobSpec, channel: PipeChannel) -> Outcome:
    """Run what is left of a sweep."""
    sweep = from_values(spec.values)
    with _locked_sweep(spec, channel.stop):
        exists = spec.name in sweeps_in(spec.recordings)
        state.begin(sweep, spec.recordings, resume=exists, accept_changes=spec.accept_changes)
        if spec.retry:
            state.forget_failures(spec.name, spec.recordings)
        wait_for_owners(state.runs_of(spec.name, spec.recordings).values(), channel.stop)
        before = len(state.runs_of(spec.name, spec.recordings))
        plan = plan_of(sweep)
        require_disk(plan, before, spec.recordings)
        reporter = _SweepReporter(channel)
        workers: Workers[Task, Result]
        with slotted_workers(spec, channel, plan.runs) as workers:
            _, status = run_sweep(
                sweep,
                spec.recordings,
                workers,
                stop=channel.stop,
                report=reporter.report,
                limit=limit_of(sweep.file.limits, plan, spec.recordings, before),
                accept_changes=spec.accept_changes,
            )
        reporter.send(status)
    if status.stopped == INTERRUPTED and channel.stop():
        return Outcome("interrupted")
    if status.stopped:
        return Outcome("failed", f"stopped: {status.stopped}")
    if status.failed:
        return Outcome("failed", f"{status.failed:,} of {status.runs:,} runs failed; the sweep says why.")
    return Outcome("finished")


@contextlib.contextmanager
def _locked_sweep(spec: JobSpec, stop: Callable[[], bool]) -> Iterator[None]:
    """Keep every other process from running the sweep; wait for one that is about to stop."""
    deadline = time.monotonic() + OTHER_OWNER_SECONDS
    with contextlib.ExitStack() as stack:
        while True:
            try:
                stack.enter_context(state.locked(spec.name, spec.recordings))
                break
            except state.SweepBusy:
                if time.monotonic() > deadline or stop():
                    raise
                time.sleep(REPORT_SECONDS)
        yield


def slotted_workers(
    spec: JobSpec, channel: PipeChannel, runs: int
) -> AbstractContextManager[Workers[T, R], None]:
    """Return what runs the job's tasks: processes of this machine within the slots, or a cluster."""
    if spec.ray is not None:
        return RayWorkers(None, spec.ray, runs)
    return SlottedWorkers(LocalWorkers(runs), channel)


class SlottedWorkers(Generic[T, R]):
    """Workers of which at most as many are busy as the server grants slots at the moment."""

    def __init__(self, workers: LocalWorkers[T, R], channel: PipeChannel) -> None:
        self._workers, self._channel = workers, channel
        self._busy, self._sent = 0, (0, 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._workers.__exit__(*error)

    @property
    def idle(self) -> int:
        """How many more tasks can be given."""
        slots = self._channel.slots
        self._report(slots)
        return max(0, min(self._workers.idle, slots - self._busy))

    def submit(self, task: T) -> None:
        """Start a task on an idle worker."""
        self._busy += 1
        self._report(self._channel.slots)
        self._workers.submit(task)

    def collect(self, seconds: float) -> list[tuple[T, R | None]]:
        """Return what is done, waiting that long for it; None for a worker that died and was replaced."""
        done = self._workers.collect(seconds)
        self._busy -= len(done)
        self._report(self._channel.slots)
        return done

    def stop(self) -> None:
        """Have every worker close its recording and return its task as interrupted."""
        self._workers.stop()

    def _report(self, slots: int) -> None:
        """Confirm the number of slots, and report how many are in use, if either has changed."""
        if self._sent != (slots, self._busy):
            self._sent = slots, self._busy
            self._channel.send(Slots(max(slots, self._busy)))


class _SweepReporter:
    """Sends a sweep's progress a few times a second, and each trial that is the best one yet."""

    def __init__(self, channel: PipeChannel) -> None:
        self._channel = channel
        self._sent, self._best = 0.0, -1

    def report(self, status: SweepStatus) -> None:
        """Accept the sweep's progress."""
        if time.monotonic() - self._sent >= REPORT_SECONDS:
            self._sent = time.monotonic()
            self.send(status)

    def send(self, status: SweepStatus) -> None:
        """Send the sweep's progress."""
        best = status.best
        if best is not None and best.number != self._best:
            self._best = best.number
            text = f"trial {best.number} is the best so far: {best.value:g}"
            self._channel.send((LogEvent(text),))
        shown = None
        if best is not None:
            # A level that was never reached is infinite or None; JSON has no infinity.
            value = best.value if best.value is not None and math.isfinite(best.value) else None
            shown = BestTrial(best.number, value, best.values)
        progress = SweepProgress(
            done=status.done,
            runs=status.runs,
            running=status.running,
            pruned=status.pruned,
            failed=status.failed,
            bytes=status.bytes,
            best=shown,
        )
        self._channel.send(progress)
