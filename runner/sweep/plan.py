"""The runs and the disk that a sweep will take, measured by a run of one episode; and its limits."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from runner.config import ConfigError, ExperimentConfig, from_mapping
from runner.config.job import Job
from runner.environments.loading import load_mdp
from runner.environments.mdp import Mdp
from runner.errors import StorageError
from runner.execution.estimate import estimate, free_bytes
from runner.execution.session import run_job
from runner.recording.reader import open_recording
from runner.runs.run import create_run
from runner.sweep.model import Sweep, SweepLimits
from runner.sweep.objective import curve_of
from runner.sweep.running import Limit, SweepStatus
from runner.sweep.search import Search
from runner.sweep.task import Task
from runner.util.humanize import size

BYTES_PER_EPISODE: Final = 40
BYTES_PER_EVALUATION: Final = 1500
COMPRESSED_SHARE: Final = 0.75
"""Size of a compressed table as a share of its bytes."""


@dataclass(frozen=True)
class Plan:
    """What a sweep will take."""

    trials: int
    runs: int
    bytes_per_run: int
    """An estimate: recordings grow with what is learned."""
    excluded: int = 0
    """Points of a grid without runs, because their values contradict each other."""

    @property
    def bytes(self) -> int:
        """The estimate for all runs together."""
        return self.runs * self.bytes_per_run


def plan_of(sweep: Sweep) -> Plan:
    """Return what a sweep will take, measured by its first trial with one episode."""
    search = Search(sweep)
    is_grid = sweep.file.searched.is_grid
    configs: list[ExperimentConfig] = []
    errors: list[ConfigError] = []
    for values in search.ask(search.trials if is_grid else sweep.file.batch):
        try:
            configs.append(sweep.config(values))
        except ConfigError as error:
            errors.append(error)
    if not configs:
        raise errors[0]
    config = configs[0]
    mdp = load_mdp(config.env.id, config.env.kwargs, config.rewards)
    bytes_per_run = _measured_bytes(config, mdp, sweep.objective.metric) + _estimated_bytes(config, mdp)
    excluded = len(errors) if is_grid else 0
    trials = search.trials - excluded
    return Plan(trials, trials * len(sweep.seeds), bytes_per_run, excluded)


def _measured_bytes(config: ExperimentConfig, mdp: Mdp, metric: str) -> int:
    """Return the bytes of a run of one episode, which must have readings of the metric."""
    values = config.to_mapping() | {"initial_q": 0.0}  # there are no other runs in a temporary folder
    if config.evaluation is not None:
        values["evaluation"] |= {"every": 1, "trials": 1}
    short = from_mapping(values, ["episodes=1"])
    with tempfile.TemporaryDirectory() as folder:
        run = create_run(Path(folder), short, short.seeds[0])
        run = run_job(Job(short, short.seeds[0]), run, mdp=mdp)
        with open_recording(run.recording) as recording:
            curve_of(recording, metric)
            return recording.file.size


def _estimated_bytes(config: ExperimentConfig, mdp: Mdp) -> int:
    """Return an estimate of the bytes that one episode does not show."""
    counts = (mdp.joint_actions,) if config.tables == "joint" else mdp.action_counts
    table = mdp.states * sum(counts) * 8
    one = estimate(config, mdp.step_limit)
    trials = one.evaluations * (config.evaluation.trials if config.evaluation else 0)
    return round(
        one.snapshots * table * COMPRESSED_SHARE
        + (config.episodes + trials) * BYTES_PER_EPISODE
        + one.evaluations * BYTES_PER_EVALUATION
        + (one.typical_bytes if config.recording.steps == "all" else 0)
    )


def require_disk(plan: Plan, done: int, recordings: Path) -> None:
    """Refuse a sweep that does not fit on the disk; `done` of its runs exist already.

    Raises:
        StorageError: there is too little space.
    """
    needed = max(0, plan.runs - done) * plan.bytes_per_run
    free = free_bytes(recordings)
    if needed > free:
        raise StorageError(
            f"{recordings}: {plan.runs - done:,} runs need about {size(needed)}, and {size(free)} are free: "
            "free some, choose another --recordings, or try fewer values."
        )


def limit_of(limits: SweepLimits, plan: Plan, recordings: Path, before: int) -> Limit:
    """Return the function that gives the reason why a task may not be started, if there is one.

    `before` is the number of runs of the sweep that existed before.
    """

    def reason(status: SweepStatus, task: Task) -> str:
        runs = before + status.started - status.resumed
        in_progress = (status.running + 1) * plan.bytes_per_run
        if limits.runs is not None and not task.run_id and runs >= limits.runs:
            return f"limits.runs: {limits.runs:,} runs were started"
        if limits.seconds is not None and status.seconds >= limits.seconds:
            return f"limits.seconds: {limits.seconds:g} s are over"
        if limits.disk is not None and status.bytes + in_progress > limits.disk:
            return (
                f"limits.disk: {size(status.bytes)} of {size(limits.disk)} are used, and a run needs about "
                f"{size(plan.bytes_per_run)}"
            )
        if free_bytes(recordings) < in_progress:
            return f"the disk of {recordings} is full: a run needs about {size(plan.bytes_per_run)}"
        return ""

    return reason
