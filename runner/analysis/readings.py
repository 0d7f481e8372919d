"""The metrics of a run, read from its recording: at each evaluation, and at each report of training."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.evaluations import evaluation_records, training_records
from runner.analysis.series import LOGGED, Readings, RunSeries
from runner.environments.naming import spoken
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.metrics import LARGEST, METRICS, SHARES, is_usable
from runner.recording.reader import Recording

_POINTS: Final = 200
_MOST_NAMES: Final = 64


def read_series(recording: Recording) -> RunSeries:
    """Return the metrics of a recording, also of one that was cut off."""
    if not recording.is_job:
        return loop_series(recording)
    evaluations = evaluation_records(recording)
    training = [(record["episode"], training_readings(record)) for record in training_records(recording)]
    training += [(record["episode"], training_readings(record["training"])) for record in evaluations]
    agents = recording.agents
    exact = {measures["evaluation"]: exact_readings(measures, agents) for measures in recording.optimality()}
    return RunSeries(
        run_id=recording.run_id,
        name=recording.name,
        seed=recording.seed,
        status=recording.status,
        config=recording.config,
        evaluation=[
            (record["episode"], evaluation_readings(record) | exact.get(record["evaluation"], {}))
            for record in evaluations
        ],
        training=sorted(training, key=lambda entry: entry[0]),
        content_digest=recording.result.content_digest or "",
    )


def loop_series(recording: Recording) -> RunSeries:
    """Return returns and lengths of the episodes of somebody's own loop, and what it logged, over episodes.

    Of many training episodes it is the means of at most 200 stretches, of 1, 2, 5, 10, ... episodes, so that
    those of several runs agree; the evaluation's are by the training episodes that were done before. Values
    that are not finite are left out of the means, and counted in `not_finite`.
    """
    total = recording.count(schema.TRAIN_EPISODE)
    edges = np.arange(0, max(total, 1) + (width := _stretch(total)), width)
    not_finite: Counter[str] = Counter()
    training = _binned_episodes(recording, edges, not_finite)
    for name, values in _binned_scalars(recording, edges, not_finite).items():
        for k in np.flatnonzero(~np.isnan(values)).tolist():
            training.setdefault(int(edges[k + 1]), {})[f"{LOGGED}{name}"] = {"": float(values[k])}
    evaluations = evaluation_records(recording)
    if left_out := sum(record["not_finite"] for record in evaluations):
        not_finite["mean_return"] = left_out
    return RunSeries(
        run_id=recording.run_id,
        name=recording.name,
        seed=recording.seed,
        status=recording.status,
        config=_without_seed(recording.config, recording.seed),
        evaluation=[(record["episode"], _loop_readings(record)) for record in evaluations],
        training=sorted(training.items()),
        content_digest=recording.result.content_digest or "",
        not_finite=dict(not_finite),
    )


def evaluation_readings(record: Mapping[str, Any]) -> Readings:
    """Return the readings of a record of `runner.frames.evaluation_records`."""
    readings: Readings = {}
    for metric in METRICS:
        value = record[metric.key]
        lines = value if metric.per_agent else {"": value}
        if known := {line: value for line, value in lines.items() if value is not None}:
            readings[metric.name] = known
    for name, count in record["events"].items():
        agent, _, kind = name.rpartition(".")
        readings.setdefault(f"event.{kind}", {})[agent] = count / record["trials"]
    return readings


def _loop_readings(record: Mapping[str, Any]) -> Readings:
    """Return the readings of an evaluation of a loop; the return of a single agent has no name."""
    readings = evaluation_readings(record)
    for metric in METRICS:
        if metric.per_agent and len(record[metric.key]) == 1 and metric.name in readings:
            readings[metric.name] = {"": next(iter(readings[metric.name].values()))}
    return readings


def exact_readings(measures: Mapping[str, Any], agents: Sequence[str]) -> Readings:
    """Return exact measures beside the optimum's."""
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


def training_readings(side: Mapping[str, Any]) -> Readings:
    """Return the readings of training from a report, or from the training side of an evaluation."""
    counts = {entry["reward"]: entry["steps"] for entry in side["reward_counts"]}
    steps = sum(counts.values())
    length = side["mean_length"]
    readings: Readings = {} if length is None else {"training.mean_length": {"": length}}
    if steps:
        mean = sum(reward * count for reward, count in counts.items()) / steps
        readings["training.mean_reward"] = {"": mean}
        readings[SHARES] = {f"{r:g}": 100 * count / steps for r, count in counts.items()}
    return readings | {
        "training.percent_filled": dict(side["percent_filled"]),
        "training.zero_cells": dict(side["zero_cells"]),
        "training.schedule": {spoken(key): side[key] for key in ("epsilon", "step_size", "discount")},
    }


def _without_seed(config: Mapping[str, Any], seed: int | None) -> Mapping[str, Any]:
    """Return a loop's configuration without the run's own seed among its settings, as in vars(args)."""
    own = config.get("config")
    if not isinstance(own, Mapping) or own.get("seed") != seed:
        return config
    return {**config, "config": {key: value for key, value in own.items() if key != "seed"}}


def _stretch(episodes: int) -> int:
    """Return how many episodes are told as one."""
    widths: Iterator[int] = (factor * int(10**power) for power in range(18) for factor in (1, 2, 5))
    return next(width for width in widths if episodes <= width * _POINTS)


def _binned_episodes(
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
        means = _means(agents, returns[k], usable_returns[k])
        if means:
            readings["training.mean_return"] = means
    return found


def _means(agents: Sequence[str], sums: NDArray[np.float64], counts: NDArray[np.float64]) -> dict[str, float]:
    """Return the mean by agent, of those agents that have any usable value; one agent alone is ""."""
    return {
        agent if len(agents) > 1 else "": float(total / count)
        for agent, total, count in zip(agents, sums, counts, strict=True)
        if count
    }


def _binned_scalars(
    recording: Recording, edges: NDArray[np.int64], not_finite: Counter[str]
) -> dict[str, NDArray[np.float64]]:
    """Return the means of what was logged under each name between the edges; NaN where there was nothing."""
    bins = len(edges) - 1
    sums: dict[str, NDArray[np.float64]] = {}
    counts: dict[str, NDArray[np.float64]] = {}
    for scalar in recording.decoded(schema.SCALAR_TOPIC):
        name = scalar["name"] if scalar["phase"] == "train" else f"{scalar['name']} ({scalar['phase']})"
        if name not in sums:
            if len(sums) == _MOST_NAMES:
                raise RecordingError(f"{recording.path}: has scalars of more than {_MOST_NAMES} names.")
            sums[name], counts[name] = np.zeros(bins), np.zeros(bins)
        if not abs(scalar["value"]) <= LARGEST:
            not_finite[f"{LOGGED}{name}"] += 1
            continue
        k = min(max(int(np.searchsorted(edges, scalar["episode"], side="right")) - 1, 0), bins - 1)
        sums[name][k] += scalar["value"]
        counts[name][k] += 1
    with np.errstate(invalid="ignore"):
        return {name: sums[name] / counts[name] for name in sums}
