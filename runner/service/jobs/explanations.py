"""A job that explains the difference between two runs or configurations: checked, and run."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Final

from pydantic import BaseModel, Field

from runner.client.jobs import LogEvent, SweepProgress
from runner.debugging.explain import (
    DEFAULT_SEEDS,
    EPISODES,
    RUNS,
    ExplanationBusy,
    Question,
    answer,
    ask,
    check_metric,
)
from runner.debugging.explanation import summary
from runner.debugging.mixtures import Measurement, MixtureResult
from runner.errors import ConfigError
from runner.service.jobs.channel import JobChannel, JobSpec, until_free
from runner.service.jobs.checking import MAX_RUNS, is_path, refuse_path
from runner.service.jobs.store import CheckedJob
from runner.sweep.cluster import worker_pool
from runner.sweep.local import Workers

BUSY: Final = "busy"
LINES: Final = {
    BUSY: "another job or command is explaining the same two; waiting for it",
    EPISODES: "two short runs are recorded to find the first step that differs",
}
"""Lines of the log, each at the first report of a stage."""


class ExplainQuestion(BaseModel, extra="forbid", frozen=True):
    """What is to be explained; the fields are the arguments of `runner.explain`."""

    a: str = Field(description="A run here, or the name of a shipped configuration.")
    b: str = Field(description="Another.")
    metric: str | None = Field(default=None, description="A metric of evaluations.")
    at: int | None = Field(default=None, description="Training episodes; the end of each by default.")
    seeds: int = DEFAULT_SEEDS
    workers: int | None = Field(default=None, ge=1, description="Of the server; default: all of them.")


def check_explanation(given: ExplainQuestion, recordings: Path) -> CheckedJob:
    """Return the job of an explanation, with runs by their ids."""
    for name, source in (("a", given.a), ("b", given.b)):
        if is_path(source):
            raise ConfigError(
                f"{name}: found the path {source!r}, expected a run here or a shipped configuration."
            )
    question = _question(given, recordings)
    check_metric(question)
    runs = question.mixtures[1] * given.seeds
    if runs > MAX_RUNS:
        raise ConfigError(f"seeds: makes {runs:,} runs, expected at most {MAX_RUNS:,} in a job.")
    sides = {"a": question.a.run_id or question.a.name, "b": question.b.run_id or question.b.name}
    return CheckedJob("explain", question.name, runs, 0, given.model_dump() | sides)


def run_explain_job(spec: JobSpec, channel: JobChannel) -> None:
    """Train what is left of an explanation, and store it."""
    question = _question(ExplainQuestion.model_validate(spec.values()), spec.recordings)
    stages = set[str]()

    def report(done: int, total: int, what: str) -> None:
        if what == RUNS:
            channel.send(SweepProgress(done, total))
        elif what not in stages:
            stages.add(what)
            channel.send(LogEvent(LINES[what]))

    workers: Workers[Measurement, MixtureResult]
    with worker_pool(spec.workers, spec.ray, question.mixtures[1]) as workers:
        result = until_free(
            partial(answer, question, workers, report, stop=channel.stop),
            ExplanationBusy,  # another job or command asks for another metric, or more seeds
            channel.stop,
            waiting=lambda: report(0, 0, BUSY),
        )
    for line in summary(result):
        channel.send(LogEvent(line))


def _question(given: ExplainQuestion, recordings: Path) -> Question:
    return ask(
        given.a,
        given.b,
        metric=given.metric,
        at=given.at,
        seeds=given.seeds,
        recordings=recordings,
        require=refuse_path,
    )
