"""Groups of runs whose configurations differ in nothing but the seed, and the curves of their metrics.

A `Panel` is a metric over an axis; it has a `Curve` for each group of runs (and agent): IQM and band.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np

from runner.analysis.axes import Axis
from runner.analysis.series import LOGGED, RunSeries, full_name, lines_in, points_of, title_of
from runner.analysis.statistics import iqm_band
from runner.errors import RunnerError, nearest, shortened
from runner.recording.metrics import METRIC_OF, METRICS, SHARES
from runner.util.arrays import Floats
from runner.util.humanize import listed, setting
from runner.util.values import JsonView, flatten

Key = TypeVar("Key", bound=Hashable)

_MAX_EXPECTED: Final = 2000
"""Characters of the metrics that a message lists."""
_NOT_CONTENT: Final = ("seeds", "recording", "name")
_TRAINING_METRICS: Final = ("training.mean_return", "training.mean_reward", "training.mean_length")


@dataclass(frozen=True)
class Group:
    """Runs of one configuration."""

    label: str
    runs: tuple[RunSeries, ...]
    left_out: tuple[str, ...] = ()
    """The ids of runs that repeat one of these."""

    @property
    def axis(self) -> Axis:
        """The axis over which its runs were read."""
        return self.runs[0].axis

    @property
    def described(self) -> str:
        """The label and the runs: `quick, 3 runs (k3v9m2xq seed 0, ...)`."""
        runs = [
            run.run_id
            + ("" if run.seed is None else f" seed {run.seed}")
            + ("" if run.finished else f", {run.status}")
            for run in self.runs
        ]
        count = f"{len(self.runs)} runs: " if len(self.runs) > 1 else "run "
        again = f"; left out, as they are the same: {listed(self.left_out)}" if self.left_out else ""
        return f"{self.label} ({count}{listed(runs)}{again})"


def groups_of(series: Sequence[RunSeries]) -> list[Group]:
    """Return the runs by name and configuration, in the order given, labelled by name and by what differs.

    A run that was recorded twice counts once, or it would weigh twice in a median. Of a job's runs with one
    seed the last finished one counts, or else the last one. Of loops, which may share a seed, the last run of
    each content counts.
    """
    return _labelled(_gathered(series, lambda run: (run.name, _content(run))).values())


def grouped(
    series: Sequence[RunSeries], by: str | None = None, across_tasks: bool = False
) -> tuple[list[Group], list[str]]:
    """Return runs in groups for a comparison, and notes on them, a sentence each.

    A group has the runs whose configurations differ in nothing but the seed, whatever their names and however
    they were recorded; or, with `by`, the runs that have the same value there. A job that was run twice
    counts once, as in `groups_of`. Several loops of one configuration and seed, such as the workers of one
    training, all count: the value of their seed is the mean over them.

    Args:
        series: the runs.
        by: path of a configuration's value, such as `quirks.epsilon_exploits`.
        across_tasks: whether runs in different environments are one group, if nothing else differs.

    Raises:
        RunnerError: no run has a value of that path.
    """
    content = _content_without_task if across_tasks else _content
    if by is None:
        groups = _labelled(_gathered(series, content).values())
    else:
        by_value = _gathered(series, _value_at(by, series))
        groups = [_group(f"{by} = {value}", runs) for value, runs in by_value.items()]
    notes = duplicates(groups)
    for group in groups:
        if (count := len({content(run) for run in group.runs})) > 1:
            notes.append(f"{group.label} has runs of {count} configurations")
    return groups, notes


def require_two(groups: Sequence[Group], by: str | None) -> None:
    """Refuse a single group.

    Raises:
        RunnerError: there are not two groups.
    """
    if len(groups) > 1:
        return
    (group,) = groups
    count = len(group.runs)
    if count == 1:
        raise RunnerError(
            f"found one run, {group.runs[0].run_id}, expected at least two to compare; a job that "
            "was run twice counts once, and runner.record's `config` distinguishes loops."
        )
    if by is not None:
        raise RunnerError(f"found {count} runs, all with {group.label}, expected two values at least.")
    raise RunnerError(
        f"found {count} runs of one configuration, {group.label}, expected two configurations at "
        "least; `dualtaxi plot` draws them as one line, `dualtaxi ls` lists what there is."
    )


def duplicates(groups: Sequence[Group]) -> list[str]:
    """Return a sentence about the runs that are left out because they repeat others, if there are any."""
    left_out = [run_id for group in groups for run_id in group.left_out]
    return [f"left out, as the same run is there: {listed(left_out)}"] if left_out else []


def metrics_of(groups: Sequence[Group], metrics: Sequence[str] = ()) -> list[tuple[str, str]]:
    """Return the (metric, line) pairs to compare: the chosen ones, or else evaluations, or else training.

    Args:
        groups: the runs.
        metrics: names of metrics (`mean_return`, of all its agents), of single lines
            (`mean_return.taxi_1`), or of values that loops logged (`loss`, or `training.logged.loss`).

    Raises:
        RunnerError: no run has one of them, or any at all.
    """
    runs = [run for group in groups for run in group.runs]
    by_name: dict[str, list[tuple[str, str]]] = {}
    for metric, line in lines_in(runs):
        if metric != SHARES:
            for name in {metric, full_name(metric, line)}:
                by_name.setdefault(name, []).append((metric, line))
    if not by_name:
        raise RunnerError(
            "found neither an evaluation nor a report of training in any run, so there is nothing to compare."
        )
    usual = [metric.name for metric in METRICS]
    if not any(metric.name in by_name for metric in METRICS if metric.requires == "success_events"):
        usual.sort(key=lambda name: name != "mean_return")  # without a goal the return says most
    names = (
        metrics
        or [name for name in usual if name in by_name]
        or [name for name in _TRAINING_METRICS if name in by_name]
    )
    pairs: dict[tuple[str, str], None] = {}
    for name in names:
        of_name = by_name.get(name) or by_name.get(f"{LOGGED}{name}")
        if of_name is None:
            logged = {other for run in runs for other in run.names}
            known = sorted(logged | {other.removeprefix(LOGGED) for other in by_name})
            expected = shortened(", ".join(known), _MAX_EXPECTED)
            near = nearest(name.removeprefix(LOGGED), known)
            raise RunnerError(f"metric: found {name!r}, expected one of {expected}.{near}")
        pairs |= dict.fromkeys(of_name)
    return list(pairs)


def flat_config(config: JsonView) -> dict[str, object]:
    """Return the values of a configuration by dotted key, but for its name and seeds."""
    return {key: value for key, value in flatten(config).items() if key not in ("seeds", "name")}


def _content(run: RunSeries) -> str:
    return json.dumps({k: v for k, v in run.config.items() if k not in _NOT_CONTENT}, sort_keys=True)


def _content_without_task(run: RunSeries) -> str:
    """Return the configuration without the environment, and without values that repeat its id."""
    names = {run.environment, run.config.get("env", {}).get("id", run.environment)}

    def stripped(value: object) -> object:
        if not isinstance(value, Mapping):
            return value
        return {
            key: stripped(item)
            for key, item in value.items()
            if not (isinstance(item, str) and item in names)
        }

    config = {k: stripped(v) for k, v in run.config.items() if k not in (*_NOT_CONTENT, "env")}
    return json.dumps(config, sort_keys=True)


def _group(label: str, runs: Sequence[RunSeries]) -> Group:
    """Return a group of these runs, each once: of repetitions the last given, finished ones first."""
    best: dict[Hashable, RunSeries] = {}
    for run in runs:
        # A job follows from its seed; loops need their content, as workers of one training share a seed.
        identity = run.seed if run.can_train_again else run.content_digest or run.run_id
        key = (_content(run), identity)
        if key not in best or run.finished >= best[key].finished:
            best[key] = run
    unique = tuple(best.values())
    return Group(label, unique, tuple(run.run_id for run in runs if run not in unique))


def _gathered(series: Iterable[RunSeries], key: Callable[[RunSeries], Key]) -> dict[Key, list[RunSeries]]:
    """Return the runs by the key of each, in the order given."""
    gathered: dict[Key, list[RunSeries]] = {}
    for run in series:
        gathered.setdefault(key(run), []).append(run)
    return gathered


def _labelled(runs_of: Iterable[Sequence[RunSeries]]) -> list[Group]:
    """Return a group for each sequence of runs, labelled by their names and the values in which it differs.

    Only groups of the same names differ by values in their labels, so that a label stays short.
    """
    named = [
        (" / ".join(dict.fromkeys(run.name for run in runs)), flat_config(runs[0].config), runs)
        for runs in runs_of
    ]
    groups = []
    for name, config, runs in named:
        differing = _differing_keys([values for other, values, _ in named if other == name])
        values = ", ".join(f"{key}={setting(config[key])}" for key in differing if key in config)
        groups.append(_group(f"{name}, {values}" if values else name, runs))
    return groups


def _differing_keys(configs: Sequence[Mapping[str, object]]) -> list[str]:
    """Return the keys whose values are not the same in all flat configurations, but for the recording's."""
    differing = [
        key
        for key in sorted({key for config in configs for key in config})
        if not key.startswith("recording.")
        and any(config.get(key) != configs[0].get(key) for config in configs)
    ]
    if "env.id" not in differing:
        return differing

    def repeats_id(key: str, config: JsonView) -> bool:
        env_id = str(config.get("env.id"))
        return config.get(key) in (env_id, env_id.rpartition(":")[2])

    # Values that repeat the environment's id, such as config.env_id, say nothing more.
    return [
        key for key in differing if key == "env.id" or not all(repeats_id(key, config) for config in configs)
    ]


def _value_at(path: str, series: Sequence[RunSeries]) -> Callable[[RunSeries], str]:
    """Return a function that returns a run's value at a path of the configuration, as JSON."""

    def paths(values: Mapping[str, object], prefix: str = "") -> dict[str, object]:
        by_path: dict[str, object] = {}
        for key, value in values.items():
            by_path[f"{prefix}{key}"] = value
            if isinstance(value, Mapping):
                by_path |= paths(value, f"{prefix}{key}.")
        return by_path

    all_paths = {name for run in series for name in paths(run.config)}
    if path not in all_paths:
        raise RunnerError(
            f"by: found {path!r}, expected a path of the configuration such as discount or "
            f"evaluation.trials; `dualtaxi config check` prints all.{nearest(path, sorted(all_paths))}"
        )
    return lambda run: json.dumps(paths(run.config).get(path), sort_keys=True)


# --- curves -------------------------------------------------------------------------------------------


class NoMetrics(RunnerError):
    """No run has any metric."""


@dataclass(frozen=True)
class Curve:
    """One line of a panel, float64 arrays of equal length.

    For several runs it is their interquartile mean with its 95 % interval, or below four runs their mean and
    range.
    """

    group: int
    line: str
    places: Floats
    """Positions on the axis of the groups."""
    middle: Floats
    low: Floats
    high: Floats
    runs: Floats
    """Each run that has the metric, [runs, positions], NaN where it has no value."""
    ids: tuple[str, ...] = ()
    """The ids of these runs."""


@dataclass(frozen=True)
class Panel:
    """One metric of all groups."""

    metric: str
    title: str
    unit: str
    curves: tuple[Curve, ...]
    axis: Axis

    @property
    def last(self) -> float:
        """The last position of any curve."""
        return max(float(curve.places[-1]) for curve in self.curves)

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
        """Whether no value is below zero, so that the axis can start there."""
        return all(not (curve.low < 0).any() for curve in self.curves)


def smoothed(places: Floats, values: Floats, memory: float) -> Floats:
    """Return the exponential mean of values, which begins at the first.

    A value's weight falls to 1/e over the memory, so the line does not depend on how many points there are.

    Args:
        places: float64 [n], ascending positions.
        values: float64 [n], without NaN.
        memory: a length of the axis, above 0.
    """
    weights = -np.expm1(-np.diff(places) / memory)
    means = [float(values[0])]
    for weight, value in zip(weights.tolist(), values[1:].tolist(), strict=True):
        means.append(means[-1] + weight * (value - means[-1]))
    return np.array(means)


def panels_of(groups: Sequence[Group]) -> list[Panel]:
    """Return a panel for each metric that any run has.

    Raises:
        NoMetrics: no run has any metric.
    """
    curves: dict[str, list[Curve]] = {}
    for number, group in enumerate(groups):
        lines = sorted(lines_in(group.runs), key=lambda pair: float(pair[1]) if pair[0] == SHARES else 0)
        for metric, line in lines:  # rewards by value
            if (curve := _curve(number, group, metric, line)) is not None:
                curves.setdefault(metric, []).append(curve)
    if len(groups) > 1:  # as many lines as rewards: too many for several groups, whose mean is shown
        curves.pop(SHARES, None)
    if not curves:
        runs = ", ".join(run.run_id for group in groups for run in group.runs)
        raise NoMetrics(
            f"found no metrics in {runs}: neither an evaluation nor a report of training was recorded."
        )
    return [
        Panel(metric, *title_of(metric), tuple(curves[metric]), groups[0].axis)
        for metric in sorted(curves, key=_rank)
    ]


def _curve(number: int, group: Group, metric: str, line: str) -> Curve | None:
    """Return the line and the band of a metric, over the runs that have come as far.

    Runs report training every number of steps, so at different episodes: of several runs, only the reports at
    evaluations are drawn, which are at the same episodes. Loops evaluate at any episode, and on other axes
    positions differ: between its points a run is interpolated, so that the line does not jump between runs.
    """
    runs = [points_of(run, metric, line, aligned=len(group.runs) > 1) for run in group.runs]
    places = np.array(sorted({place for points in runs for place in points}), np.float64)
    if not len(places):
        return None
    values = np.array(
        [np.interp(places, list(points), list(points.values()), np.nan, np.nan) for points in runs if points]
    )
    ids = tuple(run.run_id for run, points in zip(group.runs, runs, strict=True) if points)
    inside = ~np.isnan(values).all(axis=0)  # between the end of one run and the beginning of another
    return Curve(number, line, places[inside], *iqm_band(values[:, inside]), values[:, inside], ids)


def _rank(metric: str) -> tuple[int, int]:
    """Return the position of a metric: evaluation, its events, training, logged values."""
    if metric.startswith("event."):
        return 1, 0
    if metric.startswith(LOGGED):
        return 3, 0
    return (2 if metric.startswith("training.") else 0), list(METRIC_OF).index(metric)
