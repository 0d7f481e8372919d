"""Branches of a run at a step: checked; those of a loop play its episode on, and record that as a run."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, StrictFloat, StrictInt, StrictStr

from runner.analysis.episodes import EpisodeRef
from runner.archive.places import at_hand
from runner.client.jobs import LogEvent, RunEvent, RunProgress
from runner.config import ExperimentConfig, from_mapping
from runner.environments.gym_types import Space
from runner.errors import CannotRedo, ConfigError, RecordingError, RunnerError
from runner.execution.branching import OF_THE_WHOLE, branch_job, branch_name
from runner.execution.estimate import estimate
from runner.export.values import acted, actions_at
from runner.loops.actions import parsed_action
from runner.recording.gym_spaces import restore_space
from runner.recording.reader import Recording, open_recording
from runner.recording.spaces import Description
from runner.replay.makers import why_not_rerun
from runner.runs.resolve import run_of_id
from runner.runs.run import Run
from runner.service.errors import expecting
from runner.service.jobs.channel import JobChannel, JobSpec
from runner.service.jobs.store import CheckedJob
from runner.util.jsonable import as_json
from runner.util.values import Json, checked_run_name

Action = StrictStr | StrictInt | StrictFloat | list[StrictInt | StrictFloat]
"""An action in JSON: a name, a number, or the numbers of an array."""


class BranchQuestion(BaseModel, extra="forbid", frozen=True):
    """A change of a recorded step; the fields are the arguments of `runner.branch`."""

    at: Annotated[str | int, expecting("a step such as 120:5, or its number in training")] = Field(
        description="The first step that may differ: `EPISODE:T`; of training also `step:N` or its number; "
        "of an evaluation of a loop `eval:N:TRIAL:T`."
    )
    action: Annotated[
        Action | dict[str, Action] | None,
        expecting("a number or a name, numbers in a list, or a mapping from agents to these"),
    ] = Field(
        default=None,
        description="A joint action, or one by agent; names or numbers, of a loop also a list of numbers. "
        "Null: as recorded.",
    )
    overrides: Annotated[
        tuple[str, ...], expecting('a list of KEY=VALUE, such as ["epsilon=0.5", "step_size=0.1"]')
    ] = Field(default=(), description="Of training: `KEY=VALUE` each, as for `--set`.")
    episodes: int | None = Field(default=None, description="Of training: episodes in all.")
    policy: Literal["recorded", "random", "constant"] = Field(
        default="recorded", description="Of a loop: what acts after the step."
    )
    seed: int = Field(default=0, ge=0, lt=2**32, description="Of a loop: the seed of the random policy.")
    name: str | None = Field(default=None, description="Name of the new run; `NAME.branch` by default.")


def check_branch(run: Run, question: BranchQuestion) -> CheckedJob:
    """Return the job of a branch of a run; the environment of a loop is not made."""
    from runner.debugging.branch import MAX_STEPS, branches_training, default_name  # slow to import

    at = EpisodeRef.parse(question.at)
    chosen = question.overrides, question.episodes, question.policy, question.seed
    is_trained = branches_training(run, at, *chosen, MAX_STEPS)
    with open_recording(run.recording) as recording:
        if is_trained:
            action: Any = question.action
            job, where = branch_job(recording, at, action, question.overrides, question.episodes)
            _require_change(recording, job.config, where)
            limit = recording.mdp.step_limit
            size = estimate(job.config, limit).typical_bytes if limit else 0
            name = branch_name(run, question.name)
            config = job.config
            return CheckedJob("branch", name, 1, size, config.to_mapping(), config.seeds)
        step = at.resolved(recording)
        step.steps_in(recording)
        if reason := why_not_rerun(recording):
            raise CannotRedo(reason)
        name = checked_run_name(question.name) or default_name(recording)
        _check_action(recording, step, question)
    values = {"run": run.run_id, **question.model_dump(mode="json"), "at": str(step)}
    return CheckedJob("episode", name, 1, 0, values, (0,))


def _require_change(recording: Recording, branch: ExperimentConfig, at: EpisodeRef) -> None:
    """Refuse a branch of training that repeats its parent."""
    change = branch.branches[-1]
    parent = from_mapping(recording.config)
    recorded: Mapping[str, str] = {}
    with contextlib.suppress(RecordingError):  # no steps were recorded
        recorded = actions_at(recording, at)
    is_of_whole = any(getattr(branch, key) != getattr(parent, key) for key in OF_THE_WHOLE)
    if not change.settings.given and change.actions.items() <= recorded.items() and not is_of_whole:
        raise ConfigError(
            f"nothing is changed: found the recorded actions at {at}, and the settings of run "
            f"{recording.run_id}; expected another action, other settings (overrides) or more episodes."
        )


def _check_action(recording: Recording, at: EpisodeRef, question: BranchQuestion) -> None:
    """Check an action of a loop, so far as the recording describes its space, and that it changes something.

    In a game, the agents that act at a step are known when it is played.
    """
    action = question.action
    is_recorded = question.action is None
    space = None if len(recording.agents) > 1 else known_space(recording.spaces["action"])
    if space is not None and action is not None:
        names = recording.phase(at.phase).action_names()
        parsed = parsed_action(space, action, space.sample(), names)
        with contextlib.suppress(RecordingError):  # the step is lost, which is reported when it is played
            step = recording.phase(at.phase).episode(at.number_in(recording)).one(at.t)
            is_recorded = as_json(parsed) == as_json(acted(recording, step))
    if is_recorded and question.policy == "recorded":
        raise ConfigError(
            f"nothing is changed: found the recorded action at {at}, and the recorded actions after it; "
            "expected another action, or other actions after it (policy: random or constant)."
        )


def known_space(description: Description) -> Space | None:
    """Return the space that a recording describes; None if Gymnasium has no such space."""
    try:
        return restore_space(description)
    except (AssertionError, LookupError, TypeError, ValueError, OverflowError):
        return None


def run_episode_job(spec: JobSpec, channel: JobChannel) -> None:
    """Play the episode on, unless that is done, and log where it led."""
    from runner.debugging.branch import EpisodeBranch, branch_episode  # slow to import

    values: Json = spec.values()
    parent = parent_in(spec, values.pop("run"))
    question = BranchQuestion.model_validate(values)
    ((seed, run_id),) = spec.job.run_ids.items()

    def report(steps: int) -> None:
        if channel.stop():
            raise KeyboardInterrupt
        channel.send(RunProgress(run_id, seed, train_steps=steps))

    if not (spec.recordings / run_id).is_dir():
        task = EpisodeBranch(
            at=EpisodeRef.parse(question.at),
            action=question.action,
            policy=question.policy,
            seed=question.seed,
            name=question.name,
            run_id=run_id,
        )
        report(0)  # the environment is made, and brought to the step
        branch = branch_episode(parent, task, spec.recordings, report)
        if branch.is_recorded_action:
            channel.send(LogEvent(f"the action is the one that was recorded at {task.at}"))
        channel.send(LogEvent(f"recorded: {branch.parent}; with the change: {branch.outcome}"))
    channel.send(RunEvent(run_id, seed))


def parent_in(spec: JobSpec, run_id: str) -> Run:
    """Return the run that a job branches, with its recording at hand.

    Raises:
        RunnerError: it is no longer there.
    """
    parent = run_of_id(run_id, spec.recordings)
    if parent is None:
        raise RunnerError(
            f"run {run_id}, the parent of this branch, is no longer there; import it, and resume the job."
        )
    return at_hand(parent)
