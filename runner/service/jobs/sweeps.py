"""A sweep, done: by processes within the slots there are, or by a cluster of Ray."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from runner.service.jobs.channel import Line
from runner.service.jobs.spec import (
    OTHERS_SECONDS,
    TELL_SECONDS,
    Order,
    Outcome,
    described,
    wait_for_others,
)

if TYPE_CHECKING:
    from runner.sweep.local import Workers
    from runner.sweep.task import Result, Task
    from runner.sweep.trials import SweepStatus


def do_sweep(order: Order, line: Line) -> Outcome:
    """Do what is left of a job that is a sweep.

    Raises:
        RunnerError: it cannot be done, or another process does it.
    """
    from runner.sweep import state
    from runner.sweep.loading import from_values
    from runner.sweep.names import sweeps_in
    from runner.sweep.plan import plan_of, require_disk, room
    from runner.sweep.trials import INTERRUPTED, run_sweep

    sweep = from_values(described(order))
    with _held(order, line.stop):
        there = order.name in sweeps_in(order.recordings)
        state.begin(sweep, order.recordings, resume=there, accept_changes=order.accept_changes)
        if order.retry:
            state.forget_failures(order.name, order.recordings)
        wait_for_others(state.runs_of(order.name, order.recordings).values(), line.stop)
        before = len(state.runs_of(order.name, order.recordings))
        plan = plan_of(sweep)
        require_disk(plan, before, order.recordings)
        telling = _SweepTelling(line)
        with _workers(order, line, plan.runs) as workers:
            _, standing = run_sweep(
                sweep,
                order.recordings,
                workers,
                stop=line.stop,
                report=telling.report,
                room=room(sweep.file.limits, plan, order.recordings, before),
                accept_changes=order.accept_changes,
            )
        telling.tell(standing)
    if standing.stopped == INTERRUPTED and line.stop():
        return Outcome("interrupted")
    if standing.stopped:
        return Outcome("failed", f"stopped: {standing.stopped}")
    if standing.failed:
        return Outcome("failed", f"{standing.failed:,} of {standing.runs:,} runs failed; the sweep says why.")
    return Outcome("finished")


@contextlib.contextmanager
def _held(order: Order, stop: Callable[[], bool]) -> Iterator[None]:
    """Keep every other process from doing the sweep; wait for one that is about to stop.

    Raises:
        RunnerError: one still does it after a minute.
    """
    from runner.sweep import state

    deadline = time.monotonic() + OTHERS_SECONDS
    with contextlib.ExitStack() as stack:
        while True:
            try:
                stack.enter_context(state.held(order.name, order.recordings))
                break
            except state.SweepBusy:
                if time.monotonic() > deadline or stop():
                    raise
                time.sleep(TELL_SECONDS)
        yield


@contextlib.contextmanager
def _workers(order: Order, line: Line, runs: int) -> Iterator[Workers]:
    """Give those who do a sweep's runs: this machine's within the slots, or a cluster's."""
    if order.ray is not None:
        from runner.sweep.cluster import RayWorkers

        with RayWorkers(None, order.ray, runs) as remote:
            yield remote
        return
    from runner.sweep.local import LocalWorkers

    with LocalWorkers(runs) as local:
        yield Sharing(local, line)


class Sharing:
    """Workers of whom no more are busy than there are slots just now.

    Args:
        workers: they.
        line: says how many; is told how many are busy.
    """

    def __init__(self, workers: Workers, line: Line) -> None:
        self._workers, self._line = workers, line
        self._busy, self._told = 0, (0, 0)

    @property
    def idle(self) -> int:
        """How many more tasks can be given."""
        slots = self._line.slots
        self._tell(slots)
        return max(0, min(self._workers.idle, slots - self._busy))

    def give(self, task: Task) -> None:
        """Have an idle worker do a task."""
        self._busy += 1
        self._tell(self._line.slots)
        self._workers.give(task)

    def collect(self, seconds: float) -> list[tuple[Task, Result | None]]:
        """Return what is done, waiting so long for it; None for a worker that died, and was replaced."""
        done = self._workers.collect(seconds)
        self._busy -= len(done)
        self._tell(self._line.slots)
        return done

    def stop(self) -> None:
        """Have every worker close its recording and return its task as interrupted."""
        self._workers.stop()

    def _tell(self, slots: int) -> None:
        """Say how many slots are heeded, and how many are taken, if that has changed."""
        if self._told != (slots, self._busy):
            self._told = slots, self._busy
            self._line.tell("slots", max(slots, self._busy))


class _SweepTelling:
    """Passes a sweep's standing on, a few times a second, and each trial that is the best so far."""

    def __init__(self, line: Line) -> None:
        self._line = line
        self._last, self._best = 0.0, -1

    def report(self, standing: SweepStatus) -> None:
        """Take in how the sweep stands."""
        if time.monotonic() - self._last >= TELL_SECONDS:
            self._last = time.monotonic()
            self.tell(standing)

    def tell(self, standing: SweepStatus) -> None:
        """Pass it on."""
        best = standing.best
        if best is not None and best.number != self._best:
            self._best = best.number
            text = f"trial {best.number} is the best so far: {best.value:g}"
            self._line.tell("log", {"text": text})
        self._line.tell(
            "progress",
            {
                "done": standing.done,
                "runs": standing.runs,
                "running": standing.running,
                "pruned": standing.pruned,
                "failed": standing.failed,
                "bytes": standing.bytes,
                "best": best and {"trial": best.number, "value": _known(best.value), "values": best.values},
            },
        )


def _known(value: float | None) -> float | None:
    """Return a value that JSON has a word for; None for a level that was never reached."""
    return value if value is not None and math.isfinite(value) else None
