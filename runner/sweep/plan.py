"""What a sweep is going to take, found out by a run of one episode; and where it must stop."""

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
from runner.sweep.model import Limits, Sweep
from runner.sweep.readings import curve_of
from runner.sweep.search import Search
from runner.sweep.task import Task
from runner.sweep.trials import Room, SweepStatus
from runner.util.humanize import size

BYTES_AN_EPISODE: Final = 40
BYTES_AN_EVALUATION: Final = 1500
TABLE_SHARE: Final = 0.75
"""What a learned table keeps of its bytes when it is compressed."""


@dataclass(frozen=True)
class Plan:
    """What is to be done."""

    trials: int
    runs: int
    bytes_a_run: int
    """About; recordings grow with what is learned."""
    excluded: int = 0
    """Points of a grid that are left out: their values do not go together."""

    @property
    def bytes(self) -> int:
        """Of all runs together, about."""
        return self.runs * self.bytes_a_run


def plan_of(sweep: Sweep) -> Plan:
    """Return what a sweep is going to take, tried out by its first trial with one episode.

    Raises:
        RunnerError: the environment cannot be used, or the objective is not recorded.
    """
    search = Search(sweep.file)
    suggested = search.ask(search.trials if sweep.file.strategy == "grid" else sweep.file.batch)
    configs: list[ExperimentConfig] = []
    problems: list[ConfigError] = []
    for values in suggested:
        try:
            configs.append(sweep.config(values))
        except ConfigError as error:
            problems.append(error)
    if not configs:
        raise problems[0]
    mdp = load_mdp(configs[0].env.id, configs[0].env.kwargs, configs[0].rewards)
    bytes_a_run = _try_out(configs[0], mdp, sweep.objective.metric) + _growth(configs[0], mdp)
    excluded = len(problems) if sweep.file.strategy == "grid" else 0
    trials = search.trials - excluded
    return Plan(trials, trials * len(sweep.seeds), bytes_a_run, excluded)


def _try_out(config: ExperimentConfig, mdp: Mdp, metric: str) -> int:
    """Return the bytes of a run of one episode, after its readings were looked at."""
    values = config.to_mapping()
    if config.evaluation is not None:
        values["evaluation"] = values["evaluation"] | {"every": 1, "trials": 1}
    short = from_mapping(values, ["episodes=1"])
    with tempfile.TemporaryDirectory() as folder:
        run = create_run(Path(folder), short, short.seeds[0])
        run = run_job(Job(short, short.seeds[0]), run, mdp=mdp)
        with open_recording(run.recording) as recording:
            curve_of(recording, metric)
            return recording.size


def _growth(config: ExperimentConfig, mdp: Mdp) -> int:
    """Return about how many bytes all that one episode does not show will take."""
    counts = (mdp.joint_actions,) if config.tables == "joint" else mdp.action_counts
    table = mdp.states * sum(counts) * 8
    one = estimate(config, mdp.step_limit)
    trials = one.evaluations * (config.evaluation.trials if config.evaluation else 0)
    return round(
        one.snapshots * table * TABLE_SHARE
        + (config.episodes + trials) * BYTES_AN_EPISODE
        + one.evaluations * BYTES_AN_EVALUATION
        + (one.typical_bytes if config.recording.steps == "all" else 0)
    )


def require_disk(plan: Plan, done: int, recordings: Path) -> None:
    """Refuse a sweep that the disk would not hold.

    Args:
        plan: what it takes.
        done: runs that are there already.
        recordings: the folder they go to.

    Raises:
        StorageError: there is too little.
    """
    needed, free = max(0, plan.runs - done) * plan.bytes_a_run, free_bytes(recordings)
    if needed > free:
        raise StorageError(
            f"{recordings}: {plan.runs - done:,} runs need about {size(needed)}, and {size(free)} are free: "
            "free some, choose another --recordings, or try fewer values."
        )


def room(limits: Limits, plan: Plan, recordings: Path, before: int) -> Room:
    """Return what says why a task may not be begun.

    Args:
        limits: the sweep's.
        plan: what a run takes.
        recordings: where to.
        before: the sweep's runs that there were.
    """

    def reason(status: SweepStatus, task: Task) -> str:
        runs = before + status.begun - status.resumed
        under_way = (status.running + 1) * plan.bytes_a_run
        if limits.runs is not None and not task.run_id and runs >= limits.runs:
            return f"limits.runs: {limits.runs:,} runs were begun"
        if limits.seconds is not None and status.seconds >= limits.seconds:
            return f"limits.seconds: {limits.seconds:g} s are over"
        if limits.disk is not None and status.bytes + under_way > limits.disk:
            return (
                f"limits.disk: {size(status.bytes)} of {size(limits.disk)} are used, and a run needs about "
                f"{size(plan.bytes_a_run)}"
            )
        if free_bytes(recordings) < under_way:
            return f"the disk of {recordings} is full: a run needs about {size(plan.bytes_a_run)}"
        return ""

    return reason
