"""The metrics of runs over training episodes, read from their recordings, for plots and comparisons."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.evaluations import (
    EvaluationRecord,
    TrainingRecord,
    evaluation_records,
    training_records,
)
from runner.environments.naming import event_in_words, spoken
from runner.errors import RecordingError, RunnerError
from runner.recording import schema
from runner.recording.metrics import LARGEST, METRIC_OF, METRICS, SHARES, is_usable
from runner.recording.reader import Recording

Readings = dict[str, dict[str, float]]
"""Metric -> line (an agent, a reward, or "") -> value."""

LOGGED: Final = "training.logged."
"""Prefix of the names under which a loop logged values."""
_MAX_TITLE: Final = 40
_MAX_POINTS: Final = 200
_MAX_NAMES: Final = 64


@dataclass(frozen=True)
class RunSeries:
    """The metrics of one run."""

    run_id: str
    name: str
    seed: int | None
    """None for a loop without one."""
    status: str
    """`finished`, `interrupted` or `failed`."""
    config: Mapping[str, Any]
    evaluation: list[tuple[int, Readings]]
    """(episode, readings) of every evaluation."""
    training: list[tuple[int, Readings]]
    """(episode, readings) of every report of training, those at evaluations among them."""
    content_digest: str = ""
    """Digest of the recording; empty if that is not finished."""
    not_finite: Mapping[str, int] = field(default_factory=dict)
    """Metric -> number of recorded values that are infinite, NaN or too large to be averaged, which the
    readings leave out."""

    @property
    def finished(self) -> bool:
        """Whether the run is finished."""
        return self.status == "finished"

    @property
    def is_loop(self) -> bool:
        """Whether the run was recorded from a loop, whose training is read at even numbers of episodes."""
        return "made_by" in self.config

    @property
    def has_goal(self) -> bool:
        """Whether the run's episodes have a goal, which is better reached sooner.

        A loop has one if its environment defines success: a pole is to be held for as long as possible.
        """
        return not self.is_loop or any("success_percent" in readings for _, readings in self.evaluation)


def values_left_out(runs: Iterable[RunSeries]) -> list[str]:
    """Return a sentence for each run whose readings leave values out."""
    return [
        f"Run {run.run_id}: left out, as they are infinite, not a number or beyond {LARGEST:g}: "
        + ", ".join(
            f"{count:,} value{'s' if count > 1 else ''} of “{title_of(metric)[0]}”"
            for metric, count in run.not_finite.items()
        )
        + "."
        for run in runs
        if run.not_finite
    ]


def title_of(metric: str) -> tuple[str, str]:
    """Return a metric's title and its unit."""
    if metric.startswith("event."):
        return f"Event: {event_in_words(metric.removeprefix('event.'))}", "times per trial, mean"
    if metric.startswith(LOGGED):
        name = " ".join(metric.removeprefix(LOGGED).split())
        name = name if len(name) <= _MAX_TITLE else name[: _MAX_TITLE - 1] + "…"
        return f"Logged: {name}", "as logged, mean"
    return METRIC_OF[metric].title, METRIC_OF[metric].unit


# --- curves -------------------------------------------------------------------------------------------


def points_of(run: RunSeries, metric: str, line: str, aligned: bool) -> dict[int, float]:
    """Return value by episode; a reward that was never paid is 0 percent of the steps.

    Args:
        run: the run.
        metric: the metric.
        line: an agent, a reward, or "".
        aligned: of the reports of training only those at evaluations, which are at the same episodes in
            every run of a configuration; all of them if the run has no evaluation.
    """
    source = run.training if metric.startswith("training.") else run.evaluation
    at_evaluations = set() if run.is_loop else {episode for episode, _ in run.evaluation}
    missing = 0.0 if metric == SHARES else np.nan
    points = {
        episode: readings[metric].get(line, missing)
        for episode, readings in source
        if metric in readings and (not aligned or not at_evaluations or episode in at_evaluations)
    }
    return {episode: value for episode, value in points.items() if not np.isnan(value)}


def first_crossing(points: Mapping[int, float], level: float) -> int | None:
    """Return the first episode at which a curve is at a level, or on the other side than where it began."""
    below = points[min(points)] < level
    for episode in sorted(points):
        if points[episode] >= level if below else points[episode] <= level:
            return episode
    return None


def mean_height(episodes: Sequence[int], values: Sequence[float]) -> float:
    """Return the area under a curve, by the trapezoid rule, over its span; nan for fewer than two points."""
    if len(episodes) < 2:
        return math.nan
    return float(np.trapezoid(values, episodes)) / (episodes[-1] - episodes[0])


def parse_target(text: str) -> tuple[str, float]:
    """Return metric and level of a target such as `success_percent=80`.

    Raises:
        RunnerError: the text is no target.
    """
    metric, _, level = text.partition("=")
    try:
        return metric, float(level)
    except ValueError:
        raise RunnerError(f"found {text!r}, expected METRIC=LEVEL such as success_percent=80.") from None


# --- reading ------------------------------------------------------------------------------------------


def read_series(recording: Recording) -> RunSeries:
    """Return the metrics of a recording, also of one that was cut off.

    The returns and lengths of a loop's training episodes, and the values it logged, are means over at most
    200 stretches of 1, 2, 5, 10, ... episodes, so that those of several runs agree. Values that are not
    finite are left out of the means, and counted in `not_finite`.
    """
    not_finite: Counter[str] = Counter()
    evaluations = evaluation_records(recording)
    config = recording.config
    if recording.has_reports:
        agents = recording.agents
        exact = {each["evaluation"]: exact_readings(each, agents) for each in recording.optimality()}
        readings = [evaluation_readings(each) | exact.get(each.number, {}) for each in evaluations]
        reports = [*training_records(recording), *(each.training for each in evaluations if each.training)]
        training = [(each.episode, training_readings(each)) for each in reports]
    else:
        readings = [_single_agent_unnamed(evaluation_readings(each)) for each in evaluations]
        training = list(_loop_training(recording, not_finite).items())
        if left_out := sum(each.not_finite for each in evaluations):
            not_finite["mean_return"] = left_out
        own = config.get("config")
        if isinstance(own, Mapping) and own.get("seed") == recording.seed:  # as in vars(args)
            config = {**config, "config": {key: value for key, value in own.items() if key != "seed"}}
    return RunSeries(
        run_id=recording.run_id,
        name=recording.name,
        seed=recording.seed,
        status=recording.status,
        config=config,
        evaluation=[(each.episode, own) for each, own in zip(evaluations, readings, strict=True)],
        training=sorted(training, key=lambda entry: entry[0]),
        content_digest=recording.result.content_digest or "",
        not_finite=dict(not_finite),
    )


def evaluation_readings(record: EvaluationRecord) -> Readings:
    """Return the readings of an evaluation."""
    readings: Readings = {}
    for name, lines in record.values.items():
        if known := {line: value for line, value in lines.items() if value is not None}:
            readings[name] = known
    for name, count in record.events.items():
        agent, _, kind = name.rpartition(".")
        readings.setdefault(f"event.{kind}", {})[agent] = count / record.trials
    return readings


def exact_readings(measures: Mapping[str, Any], agents: Sequence[str]) -> Readings:
    """Return exact measures next to those of the optimum."""
    readings = {
        name: {"": measures[name], "optimum": measures[f"optimal_{name}"]}
        for name in ("success_percent", "mean_length")
    }
    readings["value"] = {"": sum(measures["values"]), "optimum": measures["optimal_value"]}
    readings["to_gain"] = {
        agent: best - own
        for agent, own, best in zip(agents, measures["values"], measures["best_responses"], strict=True)
    }
    return {f"exact.{name}": lines for name, lines in readings.items()}


def training_readings(report: TrainingRecord) -> Readings:
    """Return the readings of a report of training."""
    counts = dict(report.reward_counts)
    steps = sum(counts.values())
    length = report.mean_length
    readings: Readings = {} if length is None else {"training.mean_length": {"": length}}
    if steps:
        mean = sum(reward * count for reward, count in counts.items()) / steps
        readings["training.mean_reward"] = {"": mean}
        readings[SHARES] = {f"{r:g}": 100 * count / steps for r, count in counts.items()}
    return readings | {
        "training.percent_filled": dict(report.percent_filled),
        "training.zero_cells": {agent: float(cells) for agent, cells in report.zero_cells.items()},
        "training.schedule": {
            "epsilon": report.epsilon,
            spoken("step_size"): report.step_size,
            "discount": report.discount,
        },
    }


def _single_agent_unnamed(readings: Readings) -> Readings:
    """Return readings in which the values of a single agent have no name."""
    per_agent = {metric.name for metric in METRICS if metric.per_agent}
    return {
        name: {"": next(iter(lines.values()))} if name in per_agent and len(lines) == 1 else lines
        for name, lines in readings.items()
    }


def _loop_training(recording: Recording, not_finite: Counter[str]) -> dict[int, Readings]:
    """Return the means over stretches of training episodes, by the last episode of the stretch."""
    total = recording.count(schema.TRAIN_EPISODE)
    widths = (factor * 10**power for power in range(18) for factor in (1, 2, 5))
    width = next(width for width in widths if total <= width * _MAX_POINTS)
    edges = np.arange(0, max(total, 1) + width, width)
    training = _mean_episodes(recording, edges, not_finite)
    for name, values in _mean_scalars(recording, edges, not_finite).items():
        for k in np.flatnonzero(~np.isnan(values)).tolist():
            training.setdefault(int(edges[k + 1]), {})[f"{LOGGED}{name}"] = {"": float(values[k])}
    return training


def _mean_episodes(
    recording: Recording, edges: NDArray[np.int64], not_finite: Counter[str]
) -> dict[int, Readings]:
    """Return mean length and return of the training episodes between the edges."""
    agents, bins = recording.agents, len(edges) - 1
    count, length = np.zeros(bins), np.zeros(bins)
    returns, usable_returns = np.zeros((bins, len(agents))), np.zeros((bins, len(agents)))
    for block in recording.blocks(schema.TRAIN_EPISODE):
        at = (np.searchsorted(edges, block["episode"], side="right") - 1).clip(0, bins - 1)
        count += np.bincount(at, minlength=bins)
        length += np.bincount(at, block["length"], minlength=bins)
        usable = is_usable(block["returns"])
        if not usable.all():
            not_finite["training.mean_return"] += int((~usable).sum())
        for i in range(len(agents)):
            own = usable[:, i]
            usable_returns[:, i] += np.bincount(at[own], minlength=bins)
            returns[:, i] += np.bincount(at[own], block["returns"][own, i], minlength=bins)
    found: dict[int, Readings] = {}
    for k in np.flatnonzero(count).tolist():
        readings = found.setdefault(int(edges[k + 1]), {})
        readings["training.mean_length"] = {"": float(length[k] / count[k])}
        means = {
            agent if len(agents) > 1 else "": float(returns[k, i] / usable_returns[k, i])
            for i, agent in enumerate(agents)
            if usable_returns[k, i]
        }
        if means:
            readings["training.mean_return"] = means
    return found


def _mean_scalars(
    recording: Recording, edges: NDArray[np.int64], not_finite: Counter[str]
) -> dict[str, NDArray[np.float64]]:
    """Return the means of the values logged under each name between the edges; NaN where there are none."""
    bins = len(edges) - 1
    sums: dict[str, NDArray[np.float64]] = {}
    counts: dict[str, NDArray[np.float64]] = {}
    for scalar in recording.decoded(schema.SCALAR_TOPIC):
        name = scalar["name"] if scalar["phase"] == "train" else f"{scalar['name']} ({scalar['phase']})"
        if name not in sums:
            if len(sums) == _MAX_NAMES:
                raise RecordingError(f"{recording.path}: has scalars of more than {_MAX_NAMES} names.")
            sums[name], counts[name] = np.zeros(bins), np.zeros(bins)
        if not abs(scalar["value"]) <= LARGEST:
            not_finite[f"{LOGGED}{name}"] += 1
            continue
        k = min(max(int(np.searchsorted(edges, scalar["episode"], side="right")) - 1, 0), bins - 1)
        sums[name][k] += scalar["value"]
        counts[name][k] += 1
    with np.errstate(invalid="ignore"):
        return {name: sums[name] / counts[name] for name in sums}
