"""A job that branches the training of a run: checked, and run as a run of its own."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, Field

from runner.archive.places import at_hand
from runner.config.job import Job
from runner.errors import RunnerError
from runner.execution.branching import branch_job, branch_name, train_branch
from runner.execution.estimate import estimate
from runner.execution.session import Report, Stop
from runner.recording.reader import open_recording
from runner.runs.resolve import run_of_id
from runner.runs.run import Run
from runner.service.jobs.checking import CheckedJob


class BranchQuestion(BaseModel, extra="forbid", frozen=True):
    """A change of a training step; the fields are the arguments of `runner.branch`."""

    at: str | int = Field(description="The first step that may differ: `EPISODE:T`, or its number.")
    action: str | int | dict[str, str | int] | None = Field(
        default=None, description="A joint action, or one by agent; names or numbers. Null: as recorded."
    )
    overrides: tuple[str, ...] = Field(default=(), description="`KEY=VALUE` each, as for `--set`.")
    episodes: int | None = Field(default=None, description="Training episodes in all.")
    name: str | None = Field(default=None, description="Name of the new run; `NAME.branch` by default.")


def check_branch(run: Run, question: BranchQuestion) -> CheckedJob:
    """Return the job of a branch of a run."""
    with open_recording(run.recording) as recording:
        recording.require_job("a branch of training", "`dualtaxi branch` plays an episode of a loop on.")
        job, _ = branch_job(recording, question.at, question.action, question.overrides, question.episodes)
        limit = recording.mdp.step_limit
    size = estimate(job.config, limit).typical_bytes if limit else 0
    return CheckedJob("branch", branch_name(run, question.name), 1, size, job.config.to_mapping())


def parent_of(job: Job, recordings: Path) -> Run:
    """Return the run that a branch changes, which must still be there."""
    number = job.config.branches[-1].run
    parent = run_of_id(number, recordings)
    if parent is None:
        raise RunnerError(f"run {number}, the parent of this branch, is no longer there.")
    return at_hand(parent)


def run_branch(parent: Run, job: Job, run: Run, report: Report, stop: Stop) -> Run:
    """Train a branch."""
    with open_recording(parent.recording) as recording:
        return train_branch(recording, job, run, report, stop)
