"""Where a run's first tables come from, if from another run: its id and step, and the tables themselves.

A name answers to another run tomorrow, and an interrupted run goes on. So what `initial_q` names is settled
when the job is created: from then on the configuration says which run it is, and after which step.
"""

from __future__ import annotations

from pathlib import Path

from runner.archive.places import at_hand
from runner.config import ExperimentConfig, from_mapping
from runner.config.job import Job
from runner.config.sections import RunTable
from runner.environments.mdp import Mdp
from runner.errors import RunnerError
from runner.learning.learner import Held
from runner.recording import schema
from runner.recording.reader import Recording, open_recording
from runner.replay.tables import held_at
from runner.runs.resolve import find_run
from runner.runs.run import Run


def settle(job: Job, run: Run) -> tuple[Job, Run]:
    """Return a job and its run with the configuration `settled`; noted in `run.json` if that changed it.

    Raises:
        RunnerError: `initial_q` names no run, or its folder cannot be written.
    """
    config = settled(job.config, run.folder.parent, exclude=run.run_id)
    if config == job.config:
        return job, run
    return Job(config, job.seed), run.update(config=config.to_mapping())


def settled(config: ExperimentConfig, recordings: Path, exclude: str = "") -> ExperimentConfig:
    """Return a configuration that says by id and step which table it begins with, if it begins with a run's.

    Args:
        config: the configuration.
        recordings: the folder to find the run in.
        exclude: the id of the run that begins with the table, which is never meant.

    Raises:
        RunnerError: `initial_q` names no run, or one that cannot be read.
    """
    start = config.initial_q
    if not isinstance(start, RunTable):
        return config
    source, step = find_run(start.run, recordings, exclude), start.step
    if step is None:
        with open_recording(at_hand(source).recording) as recording:
            step = _last_step(recording)
    return from_mapping(
        config.to_mapping() | {"initial_q": {"run": address(source, recordings), "step": step}}
    )


def address(run: Run, recordings: Path) -> str:
    """Return what a run is found by, from a recordings folder: its id, or its path if it is elsewhere."""
    inside = run.folder.parent.resolve() == recordings.resolve()
    return run.run_id if inside and not run.stands_alone else str(run.recording.resolve())


def configured_tables(job: Job, run: Run, mdp: Mdp) -> list[Held] | None:
    """Return what the learners of the run held that a settled job's `initial_q` names; None if it names none.

    Raises:
        RunnerError: there is no such run or step, or its tables have another shape.
    """
    start = job.config.initial_q
    if not isinstance(start, RunTable):
        return None
    source = find_run(start.run, run.folder.parent, exclude=run.run_id)
    with open_recording(at_hand(source).recording) as recording:
        held = held_at(recording, _last_step(recording) if start.step is None else start.step)
    joint = job.config.tables == "joint"
    shapes = [(mdp.states, n) for n in ([mdp.joint_actions] if joint else mdp.action_counts)]
    found = [one["q"].shape for one in held]
    if found != shapes:
        raise RunnerError(f"initial_q: run {source.run_id} has tables of shape {found}, expected {shapes}.")
    return held


def _last_step(recording: Recording) -> int:
    """Return how many training steps a recording knows of, also one that leaves its steps out."""
    recorded = recording.count(schema.TRAIN_STEP)
    ended = recording.count(schema.TRAIN_EPISODE)
    last = int(recording.episodes("train", ended - 1, ended)[0]["last_step"]) + 1 if ended else 0
    return max(recorded, last)
