"""A sweep from its start or where it stopped to its end: on disk, locked, within its limits."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from runner.sweep import state
from runner.sweep.cluster import worker_pool
from runner.sweep.local import Workers
from runner.sweep.model import Sweep
from runner.sweep.plan import Plan, limit_of, plan_of, require_disk
from runner.sweep.running import SweepStatus, run_sweep
from runner.sweep.task import Result, Task
from runner.sweep.trials import Trials


def run_whole_sweep(
    sweep: Sweep,
    recordings: Path,
    workers: int | None,
    ray: str | None,
    *,
    resume: bool,
    retry_failed: bool,
    accept_changes: bool,
    stop: Callable[[], bool],
    report: Callable[[SweepStatus], None],
    planned: Callable[[Plan, int], None] = lambda *_: None,
) -> tuple[Trials, SweepStatus]:
    """Run what is left of a sweep; return its trials and its status.

    `workers` and `ray` are as for `worker_pool`, `stop` and `report` as for `run_sweep`. `planned` is called
    before the first run, with what the sweep takes and the number of its runs that there are already.

    Raises:
        SweepBusy: another process runs the sweep.
        RunnerError: it exists, and is not to be resumed or differs; or the disk would not hold its runs.
    """
    with state.locked(sweep.name, recordings):
        state.require_startable(sweep, recordings, resume, accept_changes)
        plan = plan_of(sweep)
        before = len(state.runs_of(sweep.name, recordings))
        require_disk(plan, before, recordings)
        planned(plan, before)
        pool: Workers[Task, Result]
        with worker_pool(workers, ray, plan.runs) as pool:
            state.begin(sweep, recordings, resume, accept_changes)
            if retry_failed:
                state.forget_failures(sweep.name, recordings)
            return run_sweep(
                sweep,
                recordings,
                pool,
                stop=stop,
                report=report,
                limit=limit_of(sweep.file.limits, plan, recordings, before),
                accept_changes=accept_changes,
            )
