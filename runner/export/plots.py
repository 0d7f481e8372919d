"""Every metric of runs over episodes: runs of one configuration together, as median and band.

What is computed here is what `plots_figure` draws: a `Panel` a metric, in it a `Curve` a group of runs
(and an agent). Runs belong to one group when their configurations differ in nothing but the seed.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import RunnerError
from runner.frames import evaluation_records, training_records
from runner.recording.reader import Recording
from runner.words import event_in_words, spoken

Readings = dict[str, dict[str, float]]
"""Metric -> line (an agent, a reward, or "") -> value."""


@dataclass(frozen=True)
class RunSeries:
    """The metrics of one run."""

    run_id: str
    name: str
    seed: int
    finished: bool
    config: Mapping[str, Any]
    evaluation: list[tuple[int, Readings]]
    """(episode, readings) of every evaluation."""
    training: list[tuple[int, Readings]]
    """(episode, readings) of every report of training, those at evaluations among them."""


@dataclass(frozen=True)
class Group:
    """Runs of one configuration."""

    label: str
    runs: tuple[RunSeries, ...]

    @property
    def described(self) -> str:
        """Its label, and which runs they are: `quick, 3 runs (k3v9m2xq seed 0, ...)`."""
        shown = ", ".join(
            f"{run.run_id} seed {run.seed}" + ("" if run.finished else ", interrupted")
            for run in self.runs[:MOST_NAMED]
        )
        more = len(self.runs) - MOST_NAMED
        shown += f", and {more} more" if more > 0 else ""
        count = f"{len(self.runs)} runs: " if len(self.runs) > 1 else "run "
        return f"{self.label} ({count}{shown})"


@dataclass(frozen=True)
class Curve:
    """One line of a panel, float64 arrays of equal length; `low` and `high` are the band."""

    group: int
    line: str
    episodes: NDArray[np.float64]
    median: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


@dataclass(frozen=True)
class Panel:
    """One metric of all groups."""

    metric: str
    title: str
    unit: str
    curves: tuple[Curve, ...]

    @property
    def lines(self) -> list[str]:
        """The names of its lines, in order."""
        return list(dict.fromkeys(curve.line for curve in self.curves))

    @property
    def percent(self) -> bool:
        """Whether its values are percent."""
        return self.unit.startswith("percent")

    @property
    def at_least_zero(self) -> bool:
        """Whether no value is below zero, so that the axis can begin there."""
        return all(not (curve.low < 0).any() for curve in self.curves)


MOST_NAMED: Final = 6
SHARES: Final = "training.reward"
"""The metric whose lines are shares of a whole."""

_TITLES: Final = {
    "finish_percent": ("Evaluation trials that succeed", "percent of trials"),
    "mean_length": ("Length of evaluation trials", "steps, mean"),
    "mean_penalties": ("Penalties in evaluation trials", "a trial, mean"),
    "mean_return": ("Return of evaluation trials", "summed reward, mean"),
    "training.mean_length": ("Length of training episodes", "steps, running mean"),
    "training.mean_reward": ("Reward in training", "a step, running mean"),
    "training.percent_filled": ("Q-table filled", "percent of its cells"),
    "training.zero_cells": ("Q-table cells still zero", "cells"),
    "training.schedule": ("Schedules", "value"),
    SHARES: ("Training steps by reward", "percent of recent steps"),
}
"""Metric -> title and unit, in the order they are shown; events come after the evaluation's."""


def read_series(recording: Recording) -> RunSeries:
    """Return the metrics of a recording, also of one that was cut off."""
    evaluations = evaluation_records(recording)
    training = [(record["episode"], _training(record)) for record in training_records(recording)]
    training += [(record["episode"], _training(record["training"])) for record in evaluations]
    return RunSeries(
        run_id=recording.run["run_id"],
        name=recording.run["name"],
        seed=int(recording.run["seed"]),
        finished=recording.result.get("status") == "finished",
        config=recording.config,
        evaluation=[(record["episode"], _evaluation(record)) for record in evaluations],
        training=sorted(training, key=lambda entry: entry[0]),
    )


def groups_of(series: Sequence[RunSeries]) -> list[Group]:
    """Return the runs by configuration, in the order given, labelled by name and by what differs."""
    found: dict[str, list[RunSeries]] = {}
    for run in series:
        content = {key: value for key, value in run.config.items() if key not in ("seeds", "recording")}
        found.setdefault(f"{run.name} {json.dumps(content, sort_keys=True)}", []).append(run)
    flat = [dict(_flat(runs[0].config)) for runs in found.values()]
    names = [runs[0].name for runs in found.values()]
    labels = [_label(i, names, flat) for i in range(len(names))]
    return [Group(label, tuple(runs)) for label, runs in zip(labels, found.values(), strict=True)]


def panels_of(groups: Sequence[Group]) -> list[Panel]:
    """Return a panel for each metric that any run has.

    Raises:
        RunnerError: no run has any metric.
    """
    curves: dict[str, list[Curve]] = {}
    for number, group in enumerate(groups):
        for metric, line in _metrics(group):
            curve = _curve(number, group, metric, line)
            if curve is not None:
                curves.setdefault(metric, []).append(curve)
    if len(groups) > 1:  # as many lines as rewards: too many for several groups, whose mean is shown
        curves.pop(SHARES, None)
    if not curves:
        runs = ", ".join(run.run_id for group in groups for run in group.runs)
        raise RunnerError(
            f"found no metrics in {runs}: neither an evaluation nor a report of training was recorded."
        )
    return [_panel(metric, tuple(curves[metric])) for metric in sorted(curves, key=_rank)]


# --- reading ------------------------------------------------------------------------------------------


def _evaluation(record: Mapping[str, Any]) -> Readings:
    trials = record["trials"]
    known = {} if record["finish_percent"] is None else {"finish_percent": {"": record["finish_percent"]}}
    events: Readings = {}
    for name, count in record["events"].items():
        agent, _, kind = name.rpartition(".")
        events.setdefault(f"event.{kind}", {})[agent] = count / trials
    means = {
        "mean_length": {"": record["mean_length"]},
        "mean_penalties": {"": record["mean_penalties"]},
        "mean_return": dict(record["mean_returns"]),
    }
    return known | means | events


def _training(side: Mapping[str, Any]) -> Readings:
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


def _metrics(group: Group) -> Iterator[tuple[str, str]]:
    """Yield the (metric, line) pairs of a group's runs, each once."""
    seen = {}
    for run in group.runs:
        for _, readings in (*run.evaluation, *run.training):
            for metric, lines in readings.items():
                seen.update(dict.fromkeys((metric, line) for line in lines))
    rewards = sorted((pair for pair in seen if pair[0] == SHARES), key=lambda pair: float(pair[1]))
    yield from (pair for pair in seen if pair[0] != SHARES)
    yield from rewards


# --- curves -------------------------------------------------------------------------------------------


def _curve(number: int, group: Group, metric: str, line: str) -> Curve | None:
    """Return the median and the band of a metric, over the runs that have come as far.

    Runs report training after so many steps, so at different episodes: with several runs only the
    reports at evaluations are taken, which are at the same episodes.
    """
    runs = [_points(run, metric, line, aligned=len(group.runs) > 1) for run in group.runs]
    episodes = sorted({episode for points in runs for episode in points})
    if not episodes:
        return None
    values = np.array([[points.get(episode, np.nan) for episode in episodes] for points in runs])
    return Curve(
        number,
        line,
        np.array(episodes, np.float64),
        np.nanmedian(values, axis=0),
        np.nanmin(values, axis=0),
        np.nanmax(values, axis=0),
    )


def _points(run: RunSeries, metric: str, line: str, aligned: bool) -> dict[int, float]:
    """Return value by episode; a reward that did not come is 0 percent of the steps."""
    source = run.training if metric.startswith("training.") else run.evaluation
    at_evaluations = {episode for episode, _ in run.evaluation}
    missing = 0.0 if metric == SHARES else np.nan
    points = {
        episode: readings[metric].get(line, missing)
        for episode, readings in source
        if metric in readings and (not aligned or not at_evaluations or episode in at_evaluations)
    }
    return {episode: value for episode, value in points.items() if not np.isnan(value)}


def _panel(metric: str, curves: tuple[Curve, ...]) -> Panel:
    if metric.startswith("event."):
        kind = event_in_words(metric.removeprefix("event."))
        return Panel(metric, f"Event: {kind}", "times a trial, mean", curves)
    return Panel(metric, *_TITLES[metric], curves)


def _rank(metric: str) -> tuple[int, int]:
    """Return where a metric stands: evaluation, its events, training."""
    order = list(_TITLES)
    if metric.startswith("event."):
        return 1, 0
    return (2 if metric.startswith("training.") else 0), order.index(metric)


def _label(own: int, names: Sequence[str], flat: Sequence[Mapping[str, Any]]) -> str:
    """Return a group's name, with the values in which it differs from others of that name."""
    same = [flat[i] for i, name in enumerate(names) if name == names[own]]
    keys = sorted({key for other in same for key in other if key not in ("name", "seeds")})
    differing = [key for key in keys if any(other.get(key) != same[0].get(key) for other in same)]
    told = ", ".join(f"{key}={flat[own].get(key)}" for key in differing if not key.startswith("recording."))
    return f"{names[own]}, {told}" if told else names[own]


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of a configuration by dotted key."""
    for key, value in values.items():
        if key in ("seeds", "name") and not prefix:
            continue
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
