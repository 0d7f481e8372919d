"""Branch the training of a job: another action at a step, or other settings from it on, with the same draws.

    branch = branch_training(run, at="120:5", action={"taxi_1": "north"}, overrides=["epsilon=0.1"])

A branch is a job of its own: the configuration of its parent, and in `branches` what was changed at which
step. It is trained from the beginning, as a resumed run is, in the environment that the parent recorded. A
draw is a function of the seed, the episode and its place in it, so that every step before the branch comes
out as in the parent, and after it every draw that the change does not touch.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from runner.analysis.diff.divergence import first_difference, unbroken
from runner.analysis.episodes import EpisodeRef, StepLike, reference_to, training_step, training_steps
from runner.config import ExperimentConfig, from_mapping
from runner.config.model import Job
from runner.config.sections import BranchSection, ChangesSection
from runner.environments.mdp import Mdp
from runner.environments.naming import agent_actions, agent_of, joint_action, numbered_actions, own_action
from runner.errors import ConfigError, RunnerError
from runner.execution.session import Report, recorded_tables, run_job
from runner.recording.reader import Recording, open_recording
from runner.runs.branches import TrainingOrigin, origin_in
from runner.runs.run import Run, create_run, recordings_folder, unless_empty
from runner.util.processes import Stop
from runner.util.values import checked_run_name

Action = str | int | Mapping[str, str | int]
"""A joint action, or the actions of some agents, by name or number."""

OF_THE_WHOLE: Final = ("episodes", "recording")
"""Keys that a branch may have of its own, since they change no step before it."""


@dataclass(frozen=True)
class TrainingBranch:
    """A branch of training."""

    run: Run
    """The run that it was recorded in."""
    origin: TrainingOrigin
    at: EpisodeRef
    """The step by its episode."""


def branch_training(
    run: Run,
    *,
    at: StepLike,
    action: Action | None = None,
    overrides: Sequence[str] = (),
    episodes: int | None = None,
    name: str | None = None,
    recordings: str | os.PathLike[str] | None = None,
    report: Report = lambda _: None,
    stop: Stop = lambda: False,
) -> TrainingBranch:
    """Train a job again with a change at one of its training steps, and record it as a run of its own.

    Args:
        run: a run that was trained here, with or without recorded steps; it may be a branch itself.
        at: the first step that may differ: its number, or `EPISODE:T`.
        action: what is done at this step instead: by agent, where the other agents act as they would, or a
            joint action such as `north + east`; each a name or a number.
        overrides: `KEY=VALUE` each, as for `--set`: the settings from this step on. Also
            `recording.KEY=VALUE`, which holds for the whole branch.
        episodes: the training episodes of the branch, counted from the beginning; the parent's by default.
        name: of the new run; `NAME.branch` by default.
        recordings: the folder of the new run: $DUALTAXI_RECORDINGS, or ./recordings, by default.
        report: called with the progress a few times a second.
        stop: called every few milliseconds; return True to stop.

    Raises:
        ConfigError: there is no such agent, action or setting, or the setting cannot change at a step.
        RecordingError: there is no such step, or the recording is damaged.
        RunnerError: the episodes before the branch are not those of the parent.
        StorageError: the folder of the new run cannot be written.
    """
    run_name = branch_name(run, name)
    folder = recordings_folder(recordings)
    with open_recording(run.recording) as recording:
        job, where = branch_job(recording, at, action, overrides, episodes)
        fresh = create_run(folder, job.config, job.seed, run_name, parent=run)
        branch = train_branch(recording, job, fresh, report, stop)
    origin = origin_in(job.config.to_mapping())
    assert isinstance(origin, TrainingOrigin)
    return TrainingBranch(branch, origin, where)


def branch_name(run: Run, name: str | None) -> str:
    """Return the name of a branch of a run: the one that was chosen, checked, or `NAME.branch`."""
    return checked_run_name(name) or f"{run.name[:90]}.branch"


def train_branch(parent: Recording, job: Job, run: Run, report: Report, stop: Stop) -> Run:
    """Train the job of a branch as a run, in the environment that its parent recorded.

    Raises:
        RunnerError: the episodes before the branch are not those of the parent.
    """
    step = job.config.branches[-1].step
    with unless_empty(run):
        initial = recorded_tables(parent)
        branch = run_job(job, run, report, stop, mdp=parent.mdp, initial=initial)
    _check_beginning(parent, branch, reference_to(parent, step).episode)
    return branch


def branch_job(
    recording: Recording,
    at: StepLike,
    action: Action | None,
    overrides: Sequence[str],
    episodes: int | None,
) -> tuple[Job, EpisodeRef]:
    """Return the job of a branch, and its step by its episode; arguments as for `branch_training`."""
    at = EpisodeRef.parse(at)
    parent, taken = from_mapping(recording.config), training_steps(recording)
    is_end = at == EpisodeRef.parse(taken)  # from there on, training can be longer
    step = taken if is_end else training_step(recording, at)
    where = reference_to(recording, step)
    now = parent.from_step(step)
    total = [] if episodes is None else [f"episodes={episodes}"]
    wanted = from_mapping(now.to_mapping(), [*overrides, *total])
    if wanted.episodes <= where.episode:
        raise ConfigError(
            f"episodes: found {wanted.episodes:,}, expected more than {where.episode:,}: the branch begins "
            "in this training episode, and those before it count too. `--episodes N` trains more."
        )
    branch = BranchSection(
        run=recording.run_id,
        step=step,
        actions=chosen_actions(recording.mdp, action),
        settings=_changes(now, wanted),
    )
    seed = recording.seed or 0
    given = wanted.to_mapping()
    branches = [step_branch.model_dump(mode="json") for step_branch in (*parent.branches, branch)]
    changes = {key: given[key] for key in OF_THE_WHOLE} | {"seeds": [seed], "branches": branches}
    return Job(from_mapping(parent.to_mapping() | changes), seed), where


def chosen_actions(mdp: Mdp, action: Action | None) -> dict[str, str]:
    """Return the action of each agent that has one, both by their names."""
    if action is None:
        return {}
    if isinstance(action, Mapping):
        by_agent = [(agent_of(mdp, agent), str(value)) for agent, value in action.items()]
        numbers = {agent: own_action(mdp, agent, value) for agent, value in by_agent}
    else:
        numbers = dict(enumerate(agent_actions(mdp, joint_action(mdp, str(action)))))
    names = numbered_actions(mdp)
    return {mdp.agents[agent]: names[agent][value] for agent, value in numbers.items()}


def _changes(now: ExperimentConfig, wanted: ExperimentConfig) -> ChangesSection:
    """Return the settings of a branch.

    Raises:
        ConfigError: something differs that cannot change at a step.
    """
    differing = [key for key, value in wanted if value != getattr(now, key)]
    fixed = [key for key in differing if key not in (*ChangesSection.model_fields, *OF_THE_WHOLE)]
    if fixed:
        can = [key for key in ChangesSection.model_fields if getattr(now, key) is not None]
        raise ConfigError(
            f"{fixed[0]}: cannot change at a step of training; {', '.join(can)} can. "
            "A new run with this setting can begin with the tables of a step: "
            "`initial_q: {run: RUN, step: STEP}`."
        )
    return ChangesSection(
        **{key: getattr(wanted, key) for key in differing if key in ChangesSection.model_fields}
    )


def _check_beginning(parent: Recording, branch: Run, episodes: int) -> None:
    """Check that the episodes before a branch are those of its parent.

    Raises:
        RunnerError: they are not.
    """
    with open_recording(branch.recording) as recording:
        count = min(episodes, unbroken(parent)[1], recording.train.episodes.count())
        ours, theirs = (run.train.episodes.blocks(0, count) for run in (recording, parent))
        left, right = first_difference(ours, theirs, ("episode", "last_step", "returns"))
    differing = right if left is None else left
    if differing is not None:
        episode = int(differing["episode"][0])
        raise RunnerError(
            f"run {branch.run_id}: training episode {episode:,} is not that of its parent {parent.run_id}, "
            "though the branch begins later: the parent was recorded with other versions of NumPy or Numba, "
            f"or on another kind of processor. `dualtaxi diff {parent.run_id} {branch.run_id}` shows them."
        )
