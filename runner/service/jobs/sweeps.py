"""A sweep's job: run by the processes that it was given, or by a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from runner.client.jobs import BestTrial, LogEvent, SweepProgress
from runner.errors import RunnerError
from runner.service.jobs.channel import (
    OTHER_OWNER_SECONDS,
    JobChannel,
    JobSpec,
    until_free,
    wait_for_owners,
)
from runner.sweep import state
from runner.sweep.loading import from_values
from runner.sweep.running import SweepStatus
from runner.sweep.whole import run_whole_sweep
from runner.util.values import finite


def run_sweep_job(spec: JobSpec, channel: JobChannel) -> None:
    """Run what is left of a sweep, once no other process runs it."""
    until_free(partial(_run_rest, spec, channel), state.SweepBusy, channel.stop, OTHER_OWNER_SECONDS)


def _run_rest(spec: JobSpec, channel: JobChannel) -> None:
    sweep = from_values(spec.values())
    recordings = spec.recordings
    wait_for_owners(state.runs_of(sweep.name, recordings).values(), channel.stop)
    _, status = run_whole_sweep(
        sweep,
        recordings,
        spec.workers,
        spec.ray,
        resume=True,
        retry_failed=spec.job.retry,
        accept_changes=spec.job.accept_changes,
        stop=channel.stop,
        report=_reporter(channel),
    )
    if status.stopped:
        raise RunnerError(f"stopped: {status.stopped}")
    if status.failed:
        raise RunnerError(
            f"{status.failed:,} of {status.runs:,} runs failed; `dualtaxi sweep show {sweep.name}` says why."
        )


def _reporter(channel: JobChannel) -> Callable[[SweepStatus], None]:
    """Return the function that sends a sweep's progress, and each trial that is the best one yet."""
    last = -1

    def report(status: SweepStatus) -> None:
        nonlocal last
        best = status.best
        shown = None
        if best is not None:
            if best.number != last:
                last = best.number
                channel.send(LogEvent(f"trial {best.number} is the best so far: {best.value:g}"))
            # A level that was never reached is infinite or None; JSON has no infinity.
            shown = BestTrial(best.number, finite(best.value), best.values)
        event = SweepProgress(
            done=status.done,
            runs=status.runs,
            running=status.running,
            pruned=status.pruned,
            failed=status.failed,
            bytes=status.bytes,
            best=shown,
        )
        channel.send(event)

    return report
