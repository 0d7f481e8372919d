"""The metrics of runs over an axis, read from their recordings, for plots and comparisons."""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from runner.analysis.axes import EPISODES, Axis, Positions, edges_of, positions, stretches_at
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
from runner.recording.metrics import (
    LARGEST,
    METRIC_OF,
    METRICS,
    SHARES,
    TABLE_METRICS,
    finite_mean,
    is_usable,
)
from runner.recording.reader import Recording, open_recording
from runner.recording.run_file import has_environment
from runner.util.arrays import Floats
from runner.util.humanize import counted
from runner.util.values import JsonView

Readings = dict[str, dict[str, float]]
"""Metric -> line (an agent, a reward, or "") -> value."""

LOGGED: Final = "training.logged."
"""Prefix of the names under which a loop logged values."""
_MAX_TITLE: Final = 40
_MAX_POINTS: Final = 200
_MAX_EXACT: Final = 1_000
"""The most positions at which the values of a run without an environment are not averaged."""
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
    """(position, readings) of every report of training, also of the reports at evaluations."""
    content_digest: str = ""
    """Digest of the recording; empty if that is not finished."""
    not_finite: Mapping[str, int] = field(default_factory=dict)
    """Metric -> number of recorded values that are infinite, NaN or too large to be averaged, which the
    readings leave out."""
    unread: int = 0
    """Number of values that were logged under names beyond the first 64, which the readings leave out too."""
    axis: Axis = EPISODES
    """The axis of the positions."""
    environment: str = ""
    """The environment's id, with its keyword arguments: `FrozenLake-v1 map_name=8x8`."""
    recent: Readings = field(default_factory=dict)
    """Means over the last training episodes of a finished loop, as `ls` and `show` average them."""
    recent_episodes: int = 0
    """Number of these episodes."""
    is_unended: bool = False
    """Whether no training episode of a loop ended, so that length and return are of unfinished ones."""
    averaged: str = ""
    """What its values are means over, a sentence; empty if each recorded value is there."""
    aligned: Collection[float] = ()
    """The positions of the evaluations at which training is reported too: they are the same in every run of a
    configuration. Empty for loops, and on other axes than episodes."""
    names: Sequence[str] = ()
    """All names under which values were logged, also those that are not read."""

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
        )
        + "."
        for run in runs
        if run.not_finite
    ] + [
        f"Run {run.run_id}: left out, as they have other names than the first {_MAX_NAMES} that were logged: "
        f"{run.unread:,} values. Choose others by their names."
        for run in runs
        if run.unread
    ]


def title_of(metric: str) -> tuple[str, str]:
    """Return a metric's title and its unit."""
    if metric.startswith("event."):
        return f"Event: {event_in_words(metric.removeprefix('event.'))}", "times per trial, mean"
    if metric.startswith(LOGGED):
        name = " ".join(metric.removeprefix(LOGGED).split())
        return f"Logged: {shortened(name, _MAX_TITLE)}", "as logged, mean"
    return METRIC_OF[metric].title, METRIC_OF[metric].unit


def full_name(metric: str, line: str) -> str:
    """Return metric and line: `mean_return.taxi_1`."""
    return f"{metric}.{line}" if line else metric


# --- curves -------------------------------------------------------------------------------------------


def lines_in(runs: Iterable[RunSeries]) -> list[tuple[str, str]]:
    """Return the (metric, line) pairs of which any run has readings."""
    pairs = (
        (metric, line)
        for run in runs
        for _, readings in (*run.evaluation, *run.training)
        for metric, lines in readings.items()
        for line in lines
    )
    return list(dict.fromkeys(pairs))


def points_of(run: RunSeries, metric: str, line: str, aligned: bool) -> dict[float, float]:
    """Return value by position, ascending; a reward that was never paid is 0 percent of the steps.

    A line is an agent, a reward, or "". With `aligned`, of the reports of training only those at evaluations
    count, which are at the same episodes in every run of a configuration; all of them if the run has no
    evaluation, or on another axis.
    """
    source = run.training if metric.startswith("training.") else run.evaluation
    at_evaluations = set(run.aligned) if aligned else set()
    missing = 0.0 if metric == SHARES else np.nan
    points = {
        at: readings[metric].get(line, missing)
        for at, readings in source
        if metric in readings and (not at_evaluations or at in at_evaluations)
    }
    return {at: value for at, value in sorted(points.items()) if not np.isnan(value)}


def parse_target(text: str) -> tuple[str, float]:
    """Return metric and level of a target such as `success_percent=80`.

    Raises:
        RunnerError: the text is no target.
    """
    metric, _, level = text.partition("=")
    with contextlib.suppress(ValueError):
        if not math.isnan(number := float(level)):
            return metric, number
    raise RunnerError(f"found {text!r}, expected METRIC=LEVEL such as success_percent=80.")


# --- reading ------------------------------------------------------------------------------------------


def series_of(paths: Iterable[Path], axis: Axis = EPISODES, metrics: Collection[str] = ()) -> list[RunSeries]:
    """Return the metrics of recordings over an axis, see `read_series`."""
    series = []
    for path in paths:
        with open_recording(path) as recording:
            series.append(read_series(recording, axis, metrics))
    return series


def read_series(recording: Recording, axis: Axis = EPISODES, metrics: Collection[str] = ()) -> RunSeries:
    """Return the metrics of a recording over an axis, also of one that was cut off.

    The returns and lengths of a loop's training episodes, and the values it logged, are means over at most
    200 stretches of 1, 2, 5, 10, ... episodes (or steps, ...), so that stretches of several runs agree. A run
    of values alone is read as it is if it has at most 1,000 positions. Values that are not finite are left
    out of the means, and counted in `not_finite`.

    Of the names under which values were logged the first 64 are read; or those among `metrics`, such as
    `loss` or `training.logged.loss`, if any are given.

    Raises:
        RecordingError: the recording is damaged, or does not have the axis.
    """
    not_finite: Counter[str] = Counter()
    moments = positions(recording, axis)
    evaluations = evaluation_records(recording)
    evaluated = [moments.of_moment(record.episode, record.step) for record in evaluations]
    readings = [evaluation_readings(record) for record in evaluations]
    averaged = ""
    names: Counter[str] = Counter()
    unread = 0
    recent: Readings = {}
    recent_episodes, is_unended = 0, False
    aligned: Sequence[float] = ()
    if recording.eval.has_metrics:
        aligned = evaluated if axis is EPISODES else ()
        exact = {
            measures["evaluation"]: exact_readings(measures, recording.agents)
            for measures in recording.table(schema.OPTIMALITY_TOPIC).decoded()
        }
        for record, values in zip(evaluations, readings, strict=True):
            values.update(exact.get(record.number, {}))
        reports = [
            *training_records(recording),
            *(record.training for record in evaluations if record.training),
        ]
        training = [
            (moments.of_moment(report.episode, report.step), training_readings(report)) for report in reports
        ]
    else:
        axis = moments.axis
        readings = [single_agent_unnamed(values) for values in readings]
        wanted = {name.removeprefix(LOGGED) for name in metrics}
        training, averaged = _loop_training(recording, moments, names, wanted, not_finite)
        unread = 0 if wanted else sum(list(names.values())[_MAX_NAMES:])
        is_unended = not recording.train.episodes.count()
        if recording.status == "finished" and len(last := recording.train.recent_episodes()):
            recent = _episode_readings(
                recording, float(last["length"].mean()), map(finite_mean, last["returns"].T)
            )
            recent_episodes = len(last)
        if left_out := sum(record.not_finite for record in evaluations):
            not_finite["mean_return"] = left_out
    return RunSeries(
        run_id=recording.run_id,
        name=recording.name,
        seed=recording.seed,
        status=recording.status,
        config=_config(recording),
        evaluation=list(zip(evaluated, readings, strict=True)),
        training=sorted(training, key=lambda entry: entry[0]),
        content_digest=recording.result.content_digest or "",
        not_finite=dict(not_finite),
        unread=unread,
        axis=axis,
        environment=_environment(recording),
        recent=recent,
        recent_episodes=recent_episodes,
        is_unended=is_unended,
        averaged=averaged,
        aligned=aligned,
        names=list(names),
    )


def _config(recording: Recording) -> JsonView:
    """Return the configuration; a loop's without the seed that it repeats, as `vars(args)` does."""
    config = recording.config
    loop = config.get("config")
    if not isinstance(loop, Mapping) or loop.get("seed") != recording.seed:
        return config
    return {**config, "config": {key: value for key, value in loop.items() if key != "seed"}}


def _environment(recording: Recording) -> str:
    if not has_environment(recording.config):
        return ""
    kwargs = recording.config.get("env", {}).get("kwargs", {})
    name = recording.environment["env_id"].rpartition(":")[2]
    return " ".join([name] + [f"{key}={value}" for key, value in kwargs.items()])


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
        agent: best - value
        for agent, value, best in zip(agents, measures["values"], measures["best_responses"], strict=True)
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
        **{
            metric.name: {agent: float(value) for agent, value in report.of_tables[metric.field].items()}
            for metric in TABLE_METRICS
            if metric.field in report.of_tables
        },
        "training.schedule": {
            "epsilon": report.epsilon,
            spoken("step_size"): report.step_size,
            "discount": report.discount,
        },
    }


def single_agent_unnamed(readings: Readings) -> Readings:
    """Return readings in which the values of a single agent have no name."""
    per_agent = {metric.name for metric in METRICS if metric.per_agent}
    return {
        name: {"": next(iter(lines.values()))} if name in per_agent and len(lines) == 1 else lines
        for name, lines in readings.items()
    }


def _loop_training(
    recording: Recording,
    moments: Positions,
    names: Counter[str],
    wanted: Collection[str],
    not_finite: Counter[str],
) -> tuple[list[tuple[float, Readings]], str]:
    """Return means over stretches of training by the end of the stretch, and a sentence on the stretches.

    Logged values are read under the names `wanted`, or under the first 64 names if that is empty. `names`
    gets the number of values of every name, and `not_finite` that of the values left out.
    """
    edges, averaged = _edges(recording, moments)
    training = _mean_episodes(recording, moments, edges, not_finite)
    means, has_several = _mean_scalars(recording, moments, edges, names, wanted, not_finite)
    for name, values in means.items():
        for k in np.flatnonzero(~np.isnan(values)).tolist():
            training.setdefault(k, {})[f"{LOGGED}{name}"] = {"": float(values[k])}
    ends = (edges.astype(np.int64) if moments.axis.whole else edges).tolist()
    if has_several:
        averaged = averaged or "Values at the same position are averaged."
    return [(ends[k + 1], readings) for k, readings in training.items()], averaged


def _edges(recording: Recording, moments: Positions) -> tuple[Floats, str]:
    """Return the edges of stretches, and a sentence on them if not each position has one of its own."""
    if has_environment(recording.config):
        done = recording.done()
        last = float(moments.at(done["episodes"], done["train_steps"]))
        first = 0.0
    else:
        steps = np.empty(0, np.int64)
        last_step = 0
        for _, rows in recording.scalars():
            last_step = max(last_step, int(rows["step"].max()))
            if len(steps) <= _MAX_EXACT:
                steps = np.union1d(steps, rows["step"])
        if len(steps) <= _MAX_EXACT:
            ends = np.unique(moments.at(0, steps))
            return np.concatenate([ends[:1] - 1, ends]) if len(ends) else np.arange(2.0), ""
        last = float(moments.at(0, last_step))
        first = -1.0 if moments.axis.whole else 0.0  # so that a stretch is steps 0 to 99, not 1 to 100
    edges = edges_of(moments.axis, last - first, _MAX_POINTS) + first
    return edges, f"Means over stretches of {moments.axis.length(float(edges[1] - edges[0]))}."


def lines_of(agents: Sequence[str]) -> Sequence[str]:
    """Return the lines of a value of each agent: their names, and none for a single agent."""
    return agents if len(agents) > 1 else [""]


def _episode_readings(recording: Recording, length: float, returns: Iterable[float | None]) -> Readings:
    """Return mean length and returns of training episodes as readings, without returns that are unknown."""
    means = zip(lines_of(recording.agents), returns, strict=True)
    return {
        "training.mean_length": {"": length},
        "training.mean_return": {
            line: mean for line, mean in means if mean is not None and np.isfinite(mean)
        },
    }


def _mean_episodes(
    recording: Recording, moments: Positions, edges: Floats, not_finite: Counter[str]
) -> dict[int, Readings]:
    """Return mean length and return of the training episodes that end in each stretch, by its number."""
    agents = len(recording.agents)
    bins = len(edges) - 1
    count, length = np.zeros(bins), np.zeros(bins)
    totals, usable_returns = np.zeros((bins, agents)), np.zeros((bins, agents))
    for block in recording.train.episodes.blocks():
        at = stretches_at(edges, moments.at(block["episode"] + 1, block["last_step"] + 1))
        count += np.bincount(at, minlength=bins)
        length += np.bincount(at, block["length"], minlength=bins)
        usable = is_usable(block["returns"])
        if not usable.all():
            not_finite["training.mean_return"] += int((~usable).sum())
        for i in range(agents):
            ends = at[usable[:, i]]
            usable_returns[:, i] += np.bincount(ends, minlength=bins)
            totals[:, i] += np.bincount(ends, block["returns"][usable[:, i], i], minlength=bins)
    with np.errstate(invalid="ignore"):
        lengths, returns = length / count, totals / usable_returns
    by_stretch = {
        k: _episode_readings(recording, float(lengths[k]), returns[k].tolist())
        for k in np.flatnonzero(count).tolist()
    }
    if not by_stretch and recording.train.steps:  # no episode ended: the unfinished ones
        steps = 0
        total = np.zeros(1)
        for block in recording.train.steps.rows():
            steps += len(block)
            total = total + block["rewards"].sum(axis=0, dtype=np.float64)
        means = np.broadcast_to(total, agents) / recording.environments
        if np.isfinite(means).all():
            unfinished = _episode_readings(recording, steps / recording.environments, means.tolist())
            by_stretch[bins - 1] = unfinished
    return by_stretch


def _mean_scalars(
    recording: Recording,
    moments: Positions,
    edges: Floats,
    names: Counter[str],
    wanted: Collection[str],
    not_finite: Counter[str],
) -> tuple[dict[str, Floats], bool]:
    """Return the means of the values logged under each name in each stretch; NaN where there are none.

    Also whether any is the mean of several values.
    """
    bins = len(edges) - 1
    sums: dict[str, Floats] = {}
    counts: dict[str, Floats] = {}
    for series, rows in recording.scalars():
        steps, episodes = rows["step"].copy(), rows["episode"].copy()
        in_evaluation = np.array([phase != "train" for _, phase in series])[rows["series"]]
        if in_evaluation.any():  # its step counts evaluation steps; see `training_steps_before`
            evaluated = rows[in_evaluation]
            training_steps = (evaluated["log_time"] // schema.STEP_NANOSECONDS).astype(np.int64)
            steps[in_evaluation] = training_steps - evaluated["step"]
            distinct, at = np.unique(steps[in_evaluation], return_inverse=True)
            ended = [recording.train.episodes.first_from("last_step", step) for step in distinct.tolist()]
            episodes[in_evaluation] = np.array(ended)[at]
        reached = moments.at(episodes + 1, steps)
        stretches = stretches_at(edges, np.trunc(reached) if moments.axis.whole else reached)
        usable = is_usable(rows["value"])
        for k, (logged, phase) in enumerate(series):
            name = logged if phase == "train" else f"{logged} ({phase})"
            of_series = rows["series"] == k
            names[name] += int(of_series.sum())
            if name not in sums:
                is_read = name in wanted if wanted else len(sums) < _MAX_NAMES
                if not is_read:
                    continue
                sums[name], counts[name] = np.zeros(bins), np.zeros(bins)
            if left_out := int((of_series & ~usable).sum()):
                not_finite[f"{LOGGED}{name}"] += left_out
            of_series &= usable
            np.add.at(sums[name], stretches[of_series], rows["value"][of_series])  # in their order
            counts[name] += np.bincount(stretches[of_series], minlength=bins)
    with np.errstate(invalid="ignore"):
        means = {name: sums[name] / counts[name] for name in sums}
    return means, any((count > 1).any() for count in counts.values())


def training_steps_before(scalar: Message) -> int:
    """Return the training steps before a logged value; one logged in evaluation has steps of its own."""
    step = int(scalar["step"])
    return step if scalar["phase"] == "train" else scalar["log_time"] // schema.STEP_NANOSECONDS - step
