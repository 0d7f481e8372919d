"""The metrics of runs over an axis, read from their recordings, for plots and comparisons."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.axes import EPISODES, STEPS, Axis, Positions, edges_of, positions
from runner.analysis.evaluations import (
    EvaluationRecord,
    TrainingRecord,
    evaluation_records,
    training_records,
)
from runner.environments.naming import event_in_words, spoken
from runner.errors import RunnerError, shortened
from runner.recording import schema
from runner.recording.messages import Message
from runner.recording.metrics import LARGEST, METRIC_OF, METRICS, SHARES, finite_mean, is_usable
from runner.recording.reader import Recording, open_recording
from runner.util.humanize import counted
from runner.util.values import JsonView

Readings = dict[str, dict[str, float]]
"""Metric -> line (an agent, a reward, or "") -> value."""

FURTHER_NAMES: Final = ""
"""Among the values left out: those under further names than are read."""
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
    config: JsonView
    evaluation: list[tuple[float, Readings]]
    """(position, readings) of every evaluation; positions on an axis of whole numbers are integers."""
    training: list[tuple[float, Readings]]
    """(position, readings) of every report of training, those at evaluations among them."""
    content_digest: str = ""
    """Digest of the recording; empty if that is not finished."""
    not_finite: Mapping[str, int] = field(default_factory=dict)
    """Metric -> number of recorded values that are infinite, NaN or too large to be averaged, which the
    readings leave out."""
    axis: Axis = EPISODES
    """The axis of the positions."""
    environment: str = ""
    """The environment's id, with its keyword arguments: `FrozenLake-v1 map_name=8x8`."""
    recent: Readings = field(default_factory=dict)
    """Means over the last training episodes of a finished loop, those that `ls` and `show` average too."""
    recent_episodes: int = 0
    """Number of these episodes."""
    is_unended: bool = False
    """Whether no training episode of a loop ended: its length and return are those of the unfinished ones."""

    @property
    def finished(self) -> bool:
        """Whether the run is finished."""
        return self.status == "finished"

    @property
    def can_train_again(self) -> bool:
        """Whether the runner trained it and reported at evaluations; else it is read at even distances."""
        return "made_by" not in self.config

    @property
    def has_goal(self) -> bool:
        """Whether the run's episodes have a goal, which is better reached sooner.

        A loop has one if its environment defines success: a pole is to be held for as long as possible.
        """
        return self.can_train_again or any("success_percent" in readings for _, readings in self.evaluation)


def values_left_out(runs: Collection[RunSeries]) -> list[str]:
    """Return a sentence for each run whose readings leave values out."""
    return [
        f"Run {run.run_id}: left out, as they are infinite, not a number or beyond {LARGEST:g}: "
        + ", ".join(
            f"{counted(count, 'value')} of “{title_of(metric)[0]}”"
            for metric, count in run.not_finite.items()
            if metric != FURTHER_NAMES
        )
        + "."
        for run in runs
        if run.not_finite.keys() - {FURTHER_NAMES}
    ] + [
        f"Run {run.run_id}: left out, as they have other names than the first {_MAX_NAMES} that were logged: "
        f"{count:,} values."
        for run in runs
        if (count := run.not_finite.get(FURTHER_NAMES))
    ]


def title_of(metric: str) -> tuple[str, str]:
    """Return a metric's title and its unit."""
    if metric.startswith("event."):
        return f"Event: {event_in_words(metric.removeprefix('event.'))}", "times per trial, mean"
    if metric.startswith(LOGGED):
        name = " ".join(metric.removeprefix(LOGGED).split())
        return f"Logged: {shortened(name, _MAX_TITLE)}", "as logged, mean"
    return METRIC_OF[metric].title, METRIC_OF[metric].unit


# --- curves -------------------------------------------------------------------------------------------


def points_of(run: RunSeries, metric: str, line: str, aligned: bool) -> dict[float, float]:
    """Return value by position; a reward that was never paid is 0 percent of the steps.

    A line is an agent, a reward, or "". With `aligned`, of the reports of training only those at evaluations
    count, which are at the same episodes in every run of a configuration; all of them if the run has no
    evaluation, or on another axis.
    """
    source = run.training if metric.startswith("training.") else run.evaluation
    is_aligned = aligned and run.axis is EPISODES and run.can_train_again
    at_evaluations = {place for place, _ in run.evaluation} if is_aligned else set()
    missing = 0.0 if metric == SHARES else np.nan
    points = {
        place: readings[metric].get(line, missing)
        for place, readings in source
        if metric in readings and (not at_evaluations or place in at_evaluations)
    }
    return {place: value for place, value in points.items() if not np.isnan(value)}


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


def series_of(paths: Iterable[Path], axis: Axis = EPISODES) -> list[RunSeries]:
    """Return the metrics of recordings over an axis, see `read_series`."""
    series = []
    for path in paths:
        with open_recording(path) as recording:
            series.append(read_series(recording, axis))
    return series


def read_series(recording: Recording, axis: Axis = EPISODES) -> RunSeries:
    """Return the metrics of a recording over an axis, also of one that was cut off.

    The returns and lengths of a loop's training episodes, and the values it logged, are means over at most
    200 stretches of 1, 2, 5, 10, ... episodes (or steps, ...), so that those of several runs agree. Values
    that are not finite are left out of the means, and counted in `not_finite`.

    Raises:
        RecordingError: the recording is damaged, or does not have the axis.
    """
    not_finite: Counter[str] = Counter()
    if axis is EPISODES and not recording.can_train_again and not any(recording.done().values()):
        axis = STEPS  # values without an environment have the steps that were given with them
    places = positions(recording, axis)
    evaluations = evaluation_records(recording)
    config = recording.config
    recent: Readings = {}
    recent_episodes, is_unended = 0, False
    if recording.has_reports:
        agents = recording.agents
        exact = {each["evaluation"]: exact_readings(each, agents) for each in recording.optimality()}
        readings = [evaluation_readings(each) | exact.get(each.number, {}) for each in evaluations]
        reports = [*training_records(recording), *(each.training for each in evaluations if each.training)]
        training = [(places.one(each.episode, each.step), training_readings(each)) for each in reports]
    else:
        readings = [_single_agent_unnamed(evaluation_readings(each)) for each in evaluations]
        training = _loop_training(recording, places, not_finite)
        is_unended = not recording.count(schema.TRAIN_EPISODE)
        if recording.status == "finished":
            recent, recent_episodes = _recent_training(recording)
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
        evaluation=[
            (places.one(each.episode, each.step), own)
            for each, own in zip(evaluations, readings, strict=True)
        ],
        training=sorted(training, key=lambda entry: entry[0]),
        content_digest=recording.result.content_digest or "",
        not_finite=dict(not_finite),
        axis=axis,
        environment=_environment(recording),
        recent=recent,
        recent_episodes=recent_episodes,
        is_unended=is_unended,
    )


def _environment(recording: Recording) -> str:
    kwargs = recording.config.get("env", {}).get("kwargs", {})
    name = recording.environment["env_id"].rpartition(":")[2]
    return " ".join([name, *(f"{key}={value}" for key, value in kwargs.items())])


def evaluation_readings(record: EvaluationRecord) -> Readings:
    """Return the readings of an evaluation."""
    readings: Readings = {}
    for name, lines in record.values.items():
        if numbers := {line: value for line, value in lines.items() if value is not None}:
            readings[name] = numbers
    for name, count in record.events.items():
        agent, _, kind = name.rpartition(".")
        readings.setdefault(f"event.{kind}", {})[agent] = count / record.trials
    return readings


def exact_readings(measures: Message, agents: Sequence[str]) -> Readings:
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


def _loop_training(
    recording: Recording, places: Positions, not_finite: Counter[str]
) -> list[tuple[float, Readings]]:
    """Return the means over stretches of training, by the end of the stretch."""
    done = recording.done()
    last = float(places.at(done["episodes"], done["train_steps"]))
    if not any(done.values()):
        times = (time for time, _ in recording.messages(schema.SCALAR_TOPIC))
        last = max(times, default=0) / schema.STEP_NANOSECONDS
    edges = edges_of(places.axis, last, _MAX_POINTS)
    training = _mean_episodes(recording, places, edges, not_finite)
    for name, values in _mean_scalars(recording, places, edges, not_finite).items():
        for k in np.flatnonzero(~np.isnan(values)).tolist():
            training.setdefault(k, {})[f"{LOGGED}{name}"] = {"": float(values[k])}
    ends = (edges.astype(np.int64) if places.axis.whole else edges).tolist()
    return [(ends[k + 1], readings) for k, readings in training.items()]


def _mean_episodes(
    recording: Recording, places: Positions, edges: NDArray[np.float64], not_finite: Counter[str]
) -> dict[int, Readings]:
    """Return mean length and return of the training episodes that end in each stretch, by its number."""
    agents, bins = recording.agents, len(edges) - 1
    count, length = np.zeros(bins), np.zeros(bins)
    returns, usable_returns = np.zeros((bins, len(agents))), np.zeros((bins, len(agents)))
    for block in recording.blocks(schema.TRAIN_EPISODE):
        ends = places.at(block["episode"] + 1, block["last_step"] + 1)
        at = (np.searchsorted(edges, ends) - 1).clip(0, bins - 1)
        count += np.bincount(at, minlength=bins)
        length += np.bincount(at, block["length"], minlength=bins)
        usable = is_usable(block["returns"])
        if not usable.all():
            not_finite["training.mean_return"] += int((~usable).sum())
        for i in range(len(agents)):
            own = usable[:, i]
            usable_returns[:, i] += np.bincount(at[own], minlength=bins)
            returns[:, i] += np.bincount(at[own], block["returns"][own, i], minlength=bins)
    by_stretch: dict[int, Readings] = {}
    for k in np.flatnonzero(count).tolist():
        readings = by_stretch.setdefault(k, {})
        readings["training.mean_length"] = {"": float(length[k] / count[k])}
        means = {
            agent if len(agents) > 1 else "": float(returns[k, i] / usable_returns[k, i])
            for i, agent in enumerate(agents)
            if usable_returns[k, i]
        }
        if means:
            readings["training.mean_return"] = means
    if not by_stretch and (unfinished := _unfinished_episodes(recording)):
        by_stretch[bins - 1] = unfinished
    return by_stretch


def _unfinished_episodes(recording: Recording) -> Readings:
    """Return mean length and return of training episodes of which none ended; nothing without rewards."""
    if not recording.count(schema.TRAIN_STEP) or recording.has_actions_alone("train"):
        return {}
    agents, steps, total = recording.agents, 0, 0.0
    for block in recording.rows("/train/step"):
        steps += len(block)
        total = total + block["rewards"].sum(axis=0, dtype=np.float64)
    returns = np.broadcast_to(total, len(agents)) / recording.environments
    if not np.isfinite(returns).all():
        return {}
    lines = agents if len(agents) > 1 else [""]
    return {
        "training.mean_length": {"": steps / recording.environments},
        "training.mean_return": dict(zip(lines, returns.tolist(), strict=True)),
    }


def _recent_training(recording: Recording) -> tuple[Readings, int]:
    """Return mean length and return of the last training episodes of a loop, and how many these are."""
    episodes, agents = recording.recent_episodes(), recording.agents
    if not len(episodes):
        return {}, 0
    lines = agents if len(agents) > 1 else [""]
    means = {"training.mean_length": {"": finite_mean(episodes["length"])}}
    means["training.mean_return"] = dict(zip(lines, map(finite_mean, episodes["returns"].T), strict=True))
    recent = {
        metric: {line: value for line, value in own.items() if value is not None}
        for metric, own in means.items()
    }
    return recent, len(episodes)


def _mean_scalars(
    recording: Recording, places: Positions, edges: NDArray[np.float64], not_finite: Counter[str]
) -> dict[str, NDArray[np.float64]]:
    """Return the means of the values logged under each name in each stretch; NaN where there are none."""
    ends = edges[1:].tolist()
    bins = len(ends)
    after = (0, 0)  # training steps, and the episodes that ended in them
    sums: dict[str, NDArray[np.float64]] = {}
    counts: dict[str, NDArray[np.float64]] = {}
    for scalar in recording.decoded(schema.SCALAR_TOPIC):
        name = scalar["name"] if scalar["phase"] == "train" else f"{scalar['name']} ({scalar['phase']})"
        if name not in sums:
            if len(sums) == _MAX_NAMES:
                not_finite[FURTHER_NAMES] += 1
                continue
            sums[name], counts[name] = np.zeros(bins), np.zeros(bins)
        if not abs(scalar["value"]) <= LARGEST:
            not_finite[f"{LOGGED}{name}"] += 1
            continue
        step, episodes = training_step(scalar), scalar["episode"]
        if scalar["phase"] != "train":
            if step != after[0]:
                after = (step, recording.first_from(schema.TRAIN_EPISODE, "last_step", step))
            episodes = after[1]
        k = min(bisect_left(ends, places.one(episodes + 1, step)), bins - 1)
        sums[name][k] += scalar["value"]
        counts[name][k] += 1
    with np.errstate(invalid="ignore"):
        return {name: sums[name] / counts[name] for name in sums}


def training_step(scalar: Message) -> int:
    """Return the training steps before a logged value; one logged in evaluation has steps of its own."""
    step = int(scalar["step"])
    return step if scalar["phase"] == "train" else scalar["log_time"] // schema.STEP_NANOSECONDS - step
