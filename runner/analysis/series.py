"""The metrics of runs over episodes, and runs by configuration: what plots and comparisons are made of.

Runs belong to one group when their configurations differ in nothing but the seed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.frames import agents_of, evaluation_records, event_names_of, training_records
from runner.recording import schema
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
    status: str
    """How it ended: `finished`, `interrupted` or `failed`."""
    config: Mapping[str, Any]
    evaluation: list[tuple[int, Readings]]
    """(episode, readings) of every evaluation."""
    training: list[tuple[int, Readings]]
    """(episode, readings) of every report of training, those at evaluations among them."""
    content_digest: str = ""
    """Of its recording; empty if that did not come to its end."""

    @property
    def finished(self) -> bool:
        """Whether it came to its end."""
        return self.status == "finished"


@dataclass(frozen=True)
class Group:
    """Runs of one configuration."""

    label: str
    runs: tuple[RunSeries, ...]
    left_out: tuple[str, ...] = ()
    """The ids of runs that are one of these once more."""

    @property
    def described(self) -> str:
        """Its label, and which runs they are: `quick, 3 runs (k3v9m2xq seed 0, ...)`."""
        shown = ", ".join(
            f"{run.run_id} seed {run.seed}" + ("" if run.finished else f", {run.status}")
            for run in self.runs[:MOST_NAMED]
        )
        more = len(self.runs) - MOST_NAMED
        shown += f", and {more} more" if more > 0 else ""
        count = f"{len(self.runs)} runs: " if len(self.runs) > 1 else "run "
        again = f"; left out, as they are the same: {_few(self.left_out)}" if self.left_out else ""
        return f"{self.label} ({count}{shown}{again})"


MOST_NAMED: Final = 6
SHARES: Final = "training.reward"
"""The metric whose lines are shares of a whole."""
LOGGED: Final = "training.logged."
"""What somebody's own loop logged under a name of its own."""
_POINTS: Final = 200
_MOST_NAMES: Final = 64
_TITLE: Final = 40
"""Letters of a name for which there is room above a panel."""

TITLES: Final = {
    "finish_percent": ("Evaluation trials that succeed", "percent of trials"),
    "mean_length": ("Length of evaluation trials", "steps, mean"),
    "mean_penalties": ("Penalties in evaluation trials", "a trial, mean"),
    "mean_return": ("Return of evaluation trials", "summed reward, mean"),
    "exact.finish_percent": ("Start states that succeed, exactly", "percent of start states"),
    "exact.mean_length": ("Length of an episode, exactly", "steps, mean over start states"),
    "exact.value": ("Value of the greedy policy", "discounted, mean"),
    "exact.to_gain": ("To gain by a best response", "discounted, mean"),
    "training.mean_length": ("Length of training episodes", "steps, mean"),
    "training.mean_return": ("Return of training episodes", "summed reward, mean"),
    "training.mean_reward": ("Reward in training", "a step, running mean"),
    "training.percent_filled": ("Q-table filled", "percent of its cells"),
    "training.zero_cells": ("Q-table cells still zero", "cells"),
    "training.schedule": ("Schedules", "value"),
    SHARES: ("Training steps by reward", "percent of recent steps"),
}
"""Metric -> title and unit, in the order they are shown; events come after the evaluation's."""


def read_series(recording: Recording) -> RunSeries:
    """Return the metrics of a recording, also of one that was cut off."""
    if recording.kind != "job":
        return loop_series(recording)
    evaluations = evaluation_records(recording)
    training = [(record["episode"], training_readings(record)) for record in training_records(recording)]
    training += [(record["episode"], training_readings(record["training"])) for record in evaluations]
    agents = agents_of(recording)
    exact = {measures["evaluation"]: exact_readings(measures, agents) for measures in recording.optimality()}
    return RunSeries(
        run_id=recording.run["run_id"],
        name=recording.run["name"],
        seed=int(recording.run["seed"]),
        status=recording.result.get("status", "interrupted"),
        config=recording.config,
        evaluation=[
            (record["episode"], evaluation_readings(record) | exact.get(record["evaluation"], {}))
            for record in evaluations
        ],
        training=sorted(training, key=lambda entry: entry[0]),
        content_digest=recording.result.get("content_digest", ""),
    )


def loop_series(recording: Recording) -> RunSeries:
    """Return returns and lengths of the episodes of somebody's own loop, and what it logged, over episodes.

    Of many training episodes it is the means of at most 200 stretches, of 1, 2, 5, 10, ... episodes, so that
    those of several runs agree; the evaluation's are by the training episodes that were done before.
    """
    total = recording.count(schema.TRAIN_EPISODE)
    edges = np.arange(0, max(total, 1) + (width := _stretch(total)), width)
    training = _binned_episodes(recording, edges)
    for name, values in _binned_scalars(recording, edges).items():
        for k in np.flatnonzero(~np.isnan(values)).tolist():
            training.setdefault(int(edges[k + 1]), {})[f"{LOGGED}{name}"] = {"": float(values[k])}
    return RunSeries(
        run_id=recording.run["run_id"],
        name=recording.run["name"],
        seed=int(recording.run["seed"]),
        status=recording.result.get("status", "interrupted"),
        config=_without_seed(recording.config, int(recording.run["seed"])),
        evaluation=_loop_evaluations(recording),
        training=sorted(training.items()),
        content_digest=recording.result.get("content_digest", ""),
    )


def trained_before(recording: Recording) -> NDArray[np.int64]:
    """Return for each evaluation episode of somebody's own loop how many of training had ended before."""
    trained, tested = (
        np.concatenate([np.empty(0, np.uint64), *(block["log_time"] for block in recording.blocks(topic))])
        for topic in (schema.TRAIN_EPISODE, schema.EVAL_EPISODE)
    )
    return np.searchsorted(trained, tested)


def groups_of(series: Sequence[RunSeries]) -> list[Group]:
    """Return the runs by configuration, in the order given, labelled by name and by what differs.

    A run that was recorded twice counts once, lest it weigh twice in a median: of a job's runs of one seed
    the finished and then the last given counts; of somebody's own loops, which a seed need not tell apart,
    the last of those of one content.
    """
    found: dict[str, list[RunSeries]] = {}
    for run in series:
        content = {key: value for key, value in run.config.items() if key not in ("seeds", "recording")}
        found.setdefault(f"{run.name} {json.dumps(content, sort_keys=True)}", []).append(run)
    flat = [dict(flat_config(runs[0].config)) for runs in found.values()]
    names = [runs[0].name for runs in found.values()]
    labels = [label_of(i, names, flat) for i in range(len(names))]
    once = [each_once(runs, _sameness) for runs in found.values()]
    return [
        Group(label, tuple(kept), tuple(run.run_id for run in runs if run not in kept))
        for label, kept, runs in zip(labels, once, found.values(), strict=True)
    ]


def each_once(runs: Sequence[RunSeries], same: Callable[[RunSeries], Hashable]) -> list[RunSeries]:
    """Return of the runs that are the same one run: a finished one if there is one, the last given."""
    best: dict[Hashable, RunSeries] = {}
    for run in runs:
        key = same(run)
        if key not in best or run.finished >= best[key].finished:
            best[key] = run
    return list(best.values())


def left_out(groups: Sequence[Group]) -> list[str]:
    """Return what is to be said of runs that are there twice: a sentence, or nothing."""
    twice = [run_id for group in groups for run_id in group.left_out]
    return [f"left out, as the same run is there: {_few(twice)}"] if twice else []


def _few(run_ids: Sequence[str]) -> str:
    more = len(run_ids) - MOST_NAMED
    return ", ".join(run_ids[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def _sameness(run: RunSeries) -> Hashable:
    return run.content_digest or run.run_id if is_loop(run) else run.seed


def is_loop(run: RunSeries) -> bool:
    """Return whether a run is somebody's own loop, whose training is told at even numbers of episodes."""
    return "made_by" in run.config


def has_goal(run: RunSeries) -> bool:
    """Return whether a run's episodes are about getting somewhere, the sooner the better.

    Of a loop it is known where its environment says what success is; a pole is to be held as long as can be.
    """
    return not is_loop(run) or any("finish_percent" in readings for _, readings in run.evaluation)


def title_of(metric: str) -> tuple[str, str]:
    """Return a metric's title and its unit."""
    if metric.startswith("event."):
        return f"Event: {event_in_words(metric.removeprefix('event.'))}", "times a trial, mean"
    if metric.startswith(LOGGED):
        name = " ".join(metric.removeprefix(LOGGED).split())
        return f"Logged: {name if len(name) <= _TITLE else name[: _TITLE - 1] + '…'}", "as logged, mean"
    return TITLES[metric]


def points_of(run: RunSeries, metric: str, line: str, aligned: bool) -> dict[int, float]:
    """Return value by episode; a reward that did not come is 0 percent of the steps.

    Args:
        run: whose.
        metric: which.
        line: an agent, a reward, or "".
        aligned: of the reports of training only those at evaluations, which are at the same episodes in
            every run of a configuration; all of them if the run has no evaluation.
    """
    source = run.training if metric.startswith("training.") else run.evaluation
    at_evaluations = set() if is_loop(run) else {episode for episode, _ in run.evaluation}
    missing = 0.0 if metric == SHARES else np.nan
    points = {
        episode: readings[metric].get(line, missing)
        for episode, readings in source
        if metric in readings and (not aligned or not at_evaluations or episode in at_evaluations)
    }
    return {episode: value for episode, value in points.items() if not np.isnan(value)}


# --- inside -------------------------------------------------------------------------------------------


def evaluation_readings(record: Mapping[str, Any]) -> Readings:
    """Return the readings of a record of `runner.frames.evaluation_records`."""
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


def exact_readings(measures: Mapping[str, Any], agents: Sequence[str]) -> Readings:
    """Return exact measures beside the optimum's."""
    readings = {
        name: {"": measures[name], "optimum": measures[f"optimal_{name}"]}
        for name in ("finish_percent", "mean_length")
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


def _without_seed(config: Mapping[str, Any], seed: int) -> Mapping[str, Any]:
    """Return a loop's configuration without the run's own seed among its settings, as in vars(args)."""
    own = config.get("config")
    if not isinstance(own, Mapping) or own.get("seed") != seed:
        return config
    return {**config, "config": {key: value for key, value in own.items() if key != "seed"}}


def _stretch(episodes: int) -> int:
    """Return how many episodes are told as one."""
    widths: Iterator[int] = (factor * int(10**power) for power in range(18) for factor in (1, 2, 5))
    return next(width for width in widths if episodes <= width * _POINTS)


def _binned_episodes(recording: Recording, edges: NDArray[np.int64]) -> dict[int, Readings]:
    """Return mean length and return of the training episodes between the edges."""
    agents, bins = agents_of(recording), len(edges) - 1
    count, length = np.zeros(bins), np.zeros(bins)
    returns = np.zeros((bins, len(agents)))
    for block in recording.blocks(schema.TRAIN_EPISODE):
        at = (np.searchsorted(edges, block["episode"], side="right") - 1).clip(0, bins - 1)
        count += np.bincount(at, minlength=bins)
        length += np.bincount(at, block["length"], minlength=bins)
        for i in range(len(agents)):
            returns[:, i] += np.bincount(at, block["returns"][:, i], minlength=bins)
    found: dict[int, Readings] = {}
    for k in np.flatnonzero(count).tolist():
        mean = (returns[k] / count[k]).tolist()
        found[int(edges[k + 1])] = {
            "training.mean_length": {"": float(length[k] / count[k])},
            "training.mean_return": _by_agent(agents, mean),
        }
    return found


def _by_agent(agents: Sequence[str], values: Sequence[float]) -> dict[str, float]:
    return {agent if len(agents) > 1 else "": value for agent, value in zip(agents, values, strict=True)}


def _binned_scalars(recording: Recording, edges: NDArray[np.int64]) -> dict[str, NDArray[np.float64]]:
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
        if not math.isfinite(scalar["value"]):
            continue  # a figure has no place for it
        k = min(max(int(np.searchsorted(edges, scalar["episode"], side="right")) - 1, 0), bins - 1)
        sums[name][k] += scalar["value"]
        counts[name][k] += 1
    with np.errstate(invalid="ignore"):
        return {name: sums[name] / counts[name] for name in sums}


def _loop_evaluations(recording: Recording) -> list[tuple[int, Readings]]:
    """Return the means of the evaluation episodes, by the training episodes that were done before."""
    before, first = trained_before(recording), 0
    agents, events = agents_of(recording), event_names_of(recording)
    known = bool(recording.environment["success_events"])
    found: dict[int, list[NDArray[np.void]]] = {}
    for block in recording.blocks(schema.EVAL_EPISODE):
        after, first = before[first : first + len(block)], first + len(block)
        for episodes in np.unique(after).tolist():
            found.setdefault(episodes, []).append(block[after == episodes])
    evaluations = []
    for episodes, parts in found.items():
        trials = np.concatenate(parts)
        means = trials["returns"].mean(axis=0).tolist()
        readings: Readings = {
            "mean_length": {"": float(trials["length"].mean())},
            "mean_return": _by_agent(agents, means),
        }
        if known:
            readings["finish_percent"] = {"": 100 * float(trials["success"].mean())}
        for i, name in enumerate(events):
            agent, _, kind = name.rpartition(".")
            readings.setdefault(f"event.{kind}", {})[agent] = float(trials["events"][:, i].mean())
        evaluations.append((episodes, readings))
    return sorted(evaluations, key=lambda one: one[0])


def label_of(own: int, names: Sequence[str], flat: Sequence[Mapping[str, Any]]) -> str:
    """Return a group's name, with the values in which it differs from others of that name."""
    same = [flat[i] for i, name in enumerate(names) if name == names[own]]
    keys = sorted({key for other in same for key in other if key not in ("name", "seeds")})
    differing = [key for key in keys if any(other.get(key) != same[0].get(key) for other in same)]
    told = ", ".join(f"{key}={flat[own].get(key)}" for key in differing if not key.startswith("recording."))
    return f"{names[own]}, {told}" if told else names[own]


def flat_config(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of a configuration by dotted key."""
    for key, value in values.items():
        if key in ("seeds", "name") and not prefix:
            continue
        if isinstance(value, Mapping):
            yield from flat_config(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
