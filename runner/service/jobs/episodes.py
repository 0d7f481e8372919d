"""A job that plays an episode of a loop on from a step, and records that as a run."""

from __future__ import annotations

from runner.analysis.episodes import EpisodeRef
from runner.archive.places import at_hand
from runner.client.jobs import LogEvent, RunEvent, RunProgress
from runner.errors import RunnerError
from runner.runs.resolve import run_of_id
from runner.runs.run import Run
from runner.service.jobs.channel import JobChannel, JobSpec
from runner.service.jobs.checking import BranchQuestion
from runner.util.values import Json


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
        raise RunnerError(f"run {run_id}, the parent of this branch, is no longer there.")
    return at_hand(parent)
