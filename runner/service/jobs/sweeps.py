"""A sweep's job: run by the processes that it was given, or by a Ray cluster."""

from __future__ import annotations

import math
import time
from functools import partial

from runner.client.jobs import BestTrial, LogEvent, SweepProgress
from runner.errors import RunnerError
from runner.service.jobs.channel import (
    OTHER_OWNER_SECONDS,
    REPORT_SECONDS,
    JobChannel,
    JobSpec,
    until_free,
    wait_for_owners,
)
from runner.sweep import state
from runner.sweep.loading import from_values
from runner.sweep.running import SweepStatus
from runner.sweep.whole import run_whole_sweep


def run_sweep_job(spec: JobSpec, channel: JobChannel) -> None:
    """Run what is left of a sweep, once no other process runs it."""
    until_free(partial(_run_rest, spec, channel), state.SweepBusy, channel.stop, OTHER_OWNER_SECONDS)


def _run_rest(spec: JobSpec, channel: JobChannel) -> None:
    sweep, recordings = from_values(spec.values()), spec.recordings
    wait_for_owners(state.runs_of(sweep.name, recordings).values(), channel.stop)
    reporter = _SweepReporter(channel)
    _, status = run_whole_sweep(
        sweep,
        recordings,
        spec.workers,
        spec.ray,
        resume=True,
        retry_failed=spec.job.retry,
        accept_changes=spec.job.accept_changes,
        stop=channel.stop,
        report=reporter.report,
    )
    reporter.send(status)
    if status.stopped:
        raise RunnerError(f"stopped: {status.stopped}")
    if status.failed:
        raise RunnerError(f"{status.failed:,} of {status.runs:,} runs failed; the sweep says why.")


class _SweepReporter:
    """Sends a sweep's progress a few times a second, and each trial that is the best one yet."""

    def __init__(self, channel: JobChannel) -> None:
        self._channel = channel
        self._sent, self._best = 0.0, -1

    def report(self, status: SweepStatus) -> None:
        """Accept the sweep's progress."""
        if time.monotonic() - self._sent >= REPORT_SECONDS:
            self._sent = time.monotonic()
            self.send(status)

    def send(self, status: SweepStatus) -> None:
        """Send the sweep's progress."""
        best, shown = status.best, None
        if best is not None:
            if best.number != self._best:
                self._best = best.number
                self._channel.send(LogEvent(f"trial {best.number} is the best so far: {best.value:g}"))
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
