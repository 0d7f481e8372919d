"""The evaluations of a run, numbered by the training episodes before them, and its reports of training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.metrics import METRICS, defined_metrics, finite_mean, is_usable
from runner.recording.reader import Recording
from runner.util.values import finite

RECENT_EPISODES: Final = 100
"""Training episodes that the summary of a loop averages, the last ones."""

Record = dict[str, Any]
"""The values of an evaluation or a report by name, as JSON can hold them."""


@dataclass(frozen=True)
class Evaluation:
    """The trials of one evaluation."""

    after: int
    """Training episodes before it."""
    train_step: int
    """Training steps before it."""
    start: int
    """First trial, counted over all evaluations."""
    stop: int
    number: int = 0
    """Number of the evaluation from 0, also where a repair lost others."""

    def trial(self, number: int, where: str) -> int:
        """Return the number of a trial, counted from 0, among those of all evaluations.

        Raises:
            RecordingError: there is no such trial; the message begins with `where`.
        """
        trials = self.stop - self.start
        if not 0 <= number < trials:
            raise RecordingError(
                f"{where}: found no trial {number:,} of the evaluation after {self.after:,} episodes; "
                f"it has {trials:,}, from 0."
            )
        return self.start + number


def evaluations_of(recording: Recording) -> list[Evaluation]:
    """Return a run's evaluations: those with metrics; of a loop, its trials between training episodes."""
    if recording.is_job:
        return [
            Evaluation(
                after=int(metrics["episode"]),
                train_step=int(metrics["step"]),
                start=int(metrics["evaluation"] * metrics["trials"]),
                stop=int((metrics["evaluation"] + 1) * metrics["trials"]),
                number=int(metrics["evaluation"]),
            )
            for metrics in recording.metrics("eval")
        ]
    trained, tested = (
        np.concatenate([np.empty(0, np.uint64), *(block["log_time"] for block in recording.blocks(topic))])
        for topic in (schema.TRAIN_EPISODE, schema.EVAL_EPISODE)
    )
    ends = [block["last_step"].astype(np.int64) + 1 for block in recording.blocks(schema.TRAIN_EPISODE)]
    steps = np.concatenate([np.zeros(1, np.int64), *ends])
    episodes = np.searchsorted(trained, tested)
    found = np.unique(episodes, return_index=True, return_counts=True)
    return [
        Evaluation(after, int(steps[after]), start, start + trials, number)
        for number, (after, start, trials) in enumerate(zip(*(each.tolist() for each in found), strict=True))
    ]


def evaluation_after(evaluations: Sequence[Evaluation], episodes: int, where: str) -> Evaluation:
    """Return the evaluation after a number of training episodes.

    Raises:
        RecordingError: there is none; the message begins with `where`.
    """
    found = {one.after: one for one in evaluations}
    if episodes in found:
        return found[episodes]
    known = "it has none at all."
    if found:
        nearest = min(found, key=lambda after: abs(after - episodes))
        known = f"it has {len(found):,}, the nearest after {nearest:,}."
    raise RecordingError(f"{where}: found no evaluation after {episodes:,} episodes; {known}")


def evaluation_records(recording: Recording) -> list[Record]:
    """Return the evaluations of a recording, in order.

    Each has `episode` (training episodes before it), the metrics by their keys (`success_percent`,
    `mean_length`, ...; None where the environment does not define them), `events` by name, summed over the
    trials, and under `training` the values of `training_records`.

    The evaluations of a loop are its evaluation episodes between two training episodes. They have neither
    `step` nor `training`; values that are not finite are left out of the means and counted in `not_finite`.
    """
    agents, events = recording.agents, recording.event_names
    if recording.is_job:
        return [evaluation_record(metrics, agents, events) for metrics in recording.metrics("eval")]
    trials = recording.episodes("eval")
    return [_loop_record(recording, one, trials[one.start : one.stop]) for one in evaluations_of(recording)]


def evaluation_record(metrics: Mapping[str, Any], agents: Sequence[str], events: Sequence[str]) -> Record:
    """Return the recorded metrics of a job's evaluation under the names of `evaluation_records`."""

    def known(value: Any) -> Any:  # NaN stands for unknown
        return dict(zip(agents, value, strict=True)) if isinstance(value, list) else finite(value)

    return {
        "evaluation": metrics["evaluation"],
        "episode": metrics["episode"],
        "step": metrics["step"],
        "trials": metrics["trials"],
        "successes": metrics["successes"] if metrics["successes"] >= 0 else None,
        **{each.key: known(metrics[each.field]) for each in METRICS},
        "terminations": metrics["terminations"],
        "events": dict(zip(events, metrics["events"], strict=True)),
        "training": _training_values(metrics, agents),
    }


def _loop_record(recording: Recording, evaluation: Evaluation, trials: NDArray[np.void]) -> Record:
    agents, environment = recording.agents, recording.environment
    defined = defined_metrics(bool(environment["success_events"]), environment["penalty_below"] is not None)
    values = {metric: metric.of_trials(trials) for metric in defined}
    means = {
        metric.key: dict(zip(agents, map(finite_mean, each.T), strict=True))
        if metric.per_agent
        else finite_mean(each)
        for metric, each in values.items()
    }
    counts = trials["events"].sum(axis=0, dtype=int).tolist()
    return {
        "evaluation": evaluation.number,
        "episode": evaluation.after,
        "trials": len(trials),
        "successes": int(trials["success"].sum()) if environment["success_events"] else None,
        **{metric.key: means.get(metric.key) for metric in METRICS},
        "terminations": int(trials["terminated"].sum()),
        "not_finite": sum(int((~is_usable(each)).sum()) for each in values.values()),
        "events": dict(zip(recording.event_names, counts, strict=True)),
    }


def evaluation_summary(record: Mapping[str, Any]) -> Record:
    """Return the metrics of an evaluation record by name, summed over agents; None if any is unknown."""
    summary = {"episode": record["episode"], "trials": record["trials"]}
    for metric in METRICS:
        value = record[metric.key]
        if metric.per_agent:
            value = None if None in value.values() else sum(value.values())
        summary[metric.name] = value
    return summary


def training_records(recording: Recording) -> list[Record]:
    """Return the reports of training of a job, in order."""
    agents = recording.agents
    return [
        {"episode": metrics["episode"], "step": metrics["step"]} | _training_values(metrics, agents)
        for metrics in recording.metrics("train")
    ]


def _training_values(metrics: Mapping[str, Any], agents: Sequence[str]) -> Record:
    """Return the progress of training in a report, or at an evaluation."""
    rewards = zip(metrics["rewards"], metrics["reward_counts"], strict=True)
    return {
        "mean_length": finite(metrics["mean_length"]),  # unknown before the first episode ends
        "reward_counts": [{"reward": reward, "steps": steps} for reward, steps in rewards],
        "zero_cells": dict(zip(agents, metrics["zero_cells"], strict=True)),
        "percent_filled": dict(zip(agents, metrics["percent_filled"], strict=True)),
        **{name: metrics[name] for name in ("epsilon", "step_size", "discount")},
    }


def loop_summary(recording: Recording) -> Record:
    """Return the last results of a loop, computed from its recording.

    Keys: `last_evaluation` (an `evaluation_summary`, or None), `recent_training` with `episodes`,
    `mean_length` and `mean_return` of the last `RECENT_EPISODES`, and `logged`, the last value logged under
    each name. A value that is unknown or not finite is None.
    """
    total = recording.count(schema.TRAIN_EPISODE)
    evaluations = evaluation_records(recording)
    recent = recording.episodes("train", max(0, total - RECENT_EPISODES), total)
    logged = (
        dict(recording.result.logged)
        if "logged" in recording.result
        else {one["name"]: finite(one["value"]) for one in recording.decoded(schema.SCALAR_TOPIC)}
    )
    return {
        "last_evaluation": evaluation_summary(evaluations[-1]) if evaluations else None,
        "recent_training": {
            "episodes": len(recent),
            "mean_length": finite_mean(recent["length"]),
            "mean_return": finite_mean(recent["returns"].sum(axis=1)),
        },
        "logged": logged,
    }
