"""The initial Q-tables of a job that come from another run, by its id and a step.

A name may stand for another run tomorrow, and an interrupted run may be resumed. So `initial_q` is resolved
when the job is created: from then on the configuration has the run's id and the step.
"""

from __future__ import annotations

from pathlib import Path

from runner.archive.places import opened
from runner.config import ExperimentConfig, from_mapping
from runner.config.job import Job
from runner.config.sections import RunTable
from runner.environments.mdp import Mdp
from runner.errors import RunnerError
from runner.learning.learner import NamedTables
from runner.recording.reader import Recording
from runner.replay.steps import last_step
from runner.replay.tables import named_tables_at, tables_before_training
from runner.runs.resolve import find_run
from runner.runs.run import Run


def resolve_initial_q(config: ExperimentConfig, recordings: Path, exclude: str = "") -> ExperimentConfig:
    """Return a configuration whose `initial_q`, if it is a run's table, has the run's id and the step.

    Args:
        exclude: the id of the run that begins with the table, which is never meant.
    """
    start = config.initial_q
    if not isinstance(start, RunTable):
        return config
    source = find_run(start.run, recordings, exclude)
    step = start.step
    if step is None:
        with opened(source) as recording:
            step = last_step(recording)
    return from_mapping(
        config.to_mapping() | {"initial_q": {"run": address(source, recordings), "step": step}}
    )


def resolve_job(job: Job, run: Run) -> tuple[Job, Run]:
    """Return a job and its run with `initial_q` resolved, also in `run.json`."""
    config = resolve_initial_q(job.config, run.folder.parent, exclude=run.run_id)
    if config == job.config:
        return job, run
    return Job(config, job.seed), run.update(config=config.to_mapping())


def address(run: Run, recordings: Path) -> str:
    """Return how to find a run from a recordings folder: by its id, or by its path if it is elsewhere."""
    inside = run.folder.parent.resolve() == recordings.resolve()
    return run.run_id if inside and not run.stands_alone else str(run.recording.resolve())


def configured_tables(
    config: ExperimentConfig, mdp: Mdp, recordings: Path, exclude: str = ""
) -> list[NamedTables] | None:
    """Return what the learners of the run in `initial_q` have; None if the configuration has none.

    Args:
        exclude: the id of a run that is never meant.

    Raises:
        RunnerError: there is no such run or step, or its tables have another shape.
    """
    start = config.initial_q
    if not isinstance(start, RunTable):
        return None
    source = find_run(start.run, recordings, exclude=exclude)
    with opened(source) as recording:
        tables = named_tables_at(recording, last_step(recording) if start.step is None else start.step)
    joint = config.tables == "joint"
    shapes = [(mdp.states, n) for n in ([mdp.joint_actions] if joint else mdp.action_counts)]
    found = [table["q"].shape for table in tables]
    if found != shapes:
        raise RunnerError(f"initial_q: run {source.run_id} has tables of shape {found}, expected {shapes}.")
    return tables


def recorded_tables(recording: Recording) -> list[NamedTables] | None:
    """Return the tables that a run took from another run, from its own first snapshots.

    None if it took none, or was interrupted before them: then its configuration has their origin.
    """
    if not isinstance(from_mapping(recording.config).initial_q, RunTable):
        return None
    return tables_before_training(recording)
