"""Algorithms compared over several environments by normalised scores, as Agarwal et al. (2021) advise.

Each run's value is normalised by its environment: 0 is the score of a random policy and 1 that of an expert,
from a table; or 0 the worst and 1 the best value of any run there. Statistics are over all runs of all
environments; intervals are percentile intervals of a bootstrap that resamples the seeds of each environment.
The definitions are those of the library rliable, which a test compares them with.
"""

from __future__ import annotations

import csv
import itertools
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from runner.analysis import statistics
from runner.analysis.compare.moments import (
    Moment,
    Seed,
    few_seeds,
    higher_is_better,
    measured,
    moment_in_words,
    seed_of,
    shared_span,
    uneven_ends,
)
from runner.analysis.groups import Group, grouped, metrics_of
from runner.analysis.series import RunSeries, full_name, points_of, title_of
from runner.analysis.statistics import Estimate
from runner.errors import RunnerError
from runner.util.arrays import Floats
from runner.util.humanize import listed

MIN_MAX: Final = "minmax"
"""Stands for a normalisation by the worst and the best value of each environment."""
_MAX_TABLE: Final = 1 << 20
_SCORES: Final = ("random", "expert")
POINTS: Final = 101
"""Levels of a profile, and positions of a curve."""


@dataclass(frozen=True)
class Bounds:
    """The values that are the scores 0 and 1 in an environment."""

    zero: float
    one: float

    def score(self, values: Floats) -> Floats:
        """Return the normalised scores of values."""
        return (values - self.zero) / (self.one - self.zero)


@dataclass(frozen=True)
class AlgorithmResult:
    """The scores of one algorithm over all environments."""

    label: str
    seeds: dict[str, int]
    """Environment to its number of seeds."""
    scores: dict[str, list[float]]
    """Environment to the score of each seed."""
    iqm: Estimate
    median: Estimate
    """Median over the environments of their mean scores."""
    mean: Estimate
    optimality_gap: Estimate
    """By how much scores fall short of 1, on average; above 1 nothing is gained."""
    profile: list[float]
    """Share of all runs whose score is at least each threshold."""
    profile_low: list[float]
    profile_high: list[float]
    curve: list[float]
    """IQM of the scores at each position."""
    curve_low: list[float]
    curve_high: list[float]


@dataclass(frozen=True)
class ImprovementResult:
    """The probability that a run of A scores higher than one of B in an environment drawn at random."""

    a: str
    b: str
    probability: Estimate


@dataclass(frozen=True)
class TaskComparison:
    """The result of comparing algorithms over environments."""

    metric: str
    title: str
    moment: str
    normalised_by: str
    tasks: dict[str, Bounds]
    algorithms: list[AlgorithmResult]
    improvements: list[ImprovementResult]
    thresholds: list[float]
    axis: str
    """Label of the axis of the curves."""
    positions: list[float]
    notes: list[str]


def compare_algorithms(
    series: Sequence[RunSeries],
    table: Mapping[str, Bounds] | None,
    by: str | None = None,
    metrics: Sequence[str] = (),
    moment: Moment = Moment("last"),  # noqa: B008 - frozen
) -> TaskComparison:
    """Return the comparison of runs, grouped over environments, by the metric chosen or the return."""
    groups, notes = grouped(series, by, across_tasks=True)
    return compare_tasks(groups, metric_of_tasks(groups, metrics), moment, table, notes)


def compare_tasks(
    groups: Sequence[Group],
    metric: tuple[str, str],
    moment: Moment,
    table: Mapping[str, Bounds] | None,
    notes: Sequence[str] = (),
) -> TaskComparison:
    """Return the comparison of algorithms over the environments that all of them have.

    The groups are the runs of each algorithm, as `grouped` returns them for several tasks; the metric is
    (metric, line); a crossing cannot be normalised. The table has the scores 0 and 1 of each environment,
    None for the worst and the best value there; the notes are added to the comparison's own.

    Raises:
        RunnerError: there is no common environment, or the table lacks one.
    """
    statistics.require_scipy()
    if moment.level is not None:
        raise RunnerError("normalise: found a target as well, expected a moment: a level has no score.")
    own_notes: list[str] = []
    by_label = {group.label: dict(_values(group, metric, moment, groups, own_notes)) for group in groups}
    tasks = _common_tasks(by_label, own_notes)
    better = higher_is_better(metric[0], groups)
    if better is None and table is None:
        own_notes.append(f"higher is taken as better, as nobody can say it of {metric[0]}")
    bounds = _bounds(tasks, by_label, table, better is False, own_notes)
    tasks = list(bounds)
    scores = {
        label: {task: bounds[task].score(values[task]) for task in tasks}
        for label, values in by_label.items()
    }
    all_scores = np.concatenate([values for by_task in scores.values() for values in by_task.values()])
    thresholds = np.linspace(float(all_scores.min()), float(all_scores.max()), POINTS)
    if moment.kind != "position":  # which takes runs that are not finished too
        groups = [replace(group, runs=tuple(run for run in group.runs if run.finished)) for group in groups]
    first, last = shared_span(_runs(groups, tasks), *metric)
    # The positions that every run in these environments covers, evenly spaced.
    positions = np.linspace(first, last, POINTS) if first < last else np.array([float(last)])
    results = [
        _result(group.label, scores[group.label], thresholds, _curves(group, metric, bounds, positions))
        for group in groups
    ]
    own_notes += _seed_notes(results)
    own_notes += few_seeds(groups, {result.label: min(result.seeds.values()) for result in results})
    if moment.kind == "last":
        for task in tasks:
            in_task = [replace(group, runs=tuple(_runs([group], [task]))) for group in groups]
            own_notes += [f"{task}: {note}" for note in uneven_ends(in_task, *metric)]
    return TaskComparison(
        metric=full_name(*metric),
        title=title_of(metric[0])[0],
        moment=moment_in_words(moment, [metric[0]], groups),
        normalised_by="the worst and the best value in each environment"
        if table is None
        else "a table: 0 is the random, 1 the expert score",
        tasks=bounds,
        algorithms=results,
        improvements=[
            ImprovementResult(a, b, _improvement(scores[a], scores[b]))
            for a, b in itertools.combinations(scores, 2)
        ],
        thresholds=thresholds.tolist(),
        axis=groups[0].axis.label,
        positions=positions.tolist(),
        notes=[*notes, *own_notes],
    )


def metric_of_tasks(groups: Sequence[Group], metrics: Sequence[str]) -> tuple[str, str]:
    """Return the metric and line that environments are compared by: the one chosen, or the return.

    Raises:
        RunnerError: several are chosen, or the metric has several lines, or no run has it.
    """
    pairs = metrics_of(groups, metrics)
    if not metrics:
        pairs = [pair for pair in pairs if pair[0].endswith("mean_return")] or pairs[:1]
    if len(pairs) > 1:
        names = [full_name(*pair) for pair in pairs]
        raise RunnerError(f"metric: found {listed(names)}, expected one, as environments are compared by it.")
    return pairs[0]


def _values(
    group: Group, metric: tuple[str, str], moment: Moment, groups: Sequence[Group], notes: list[str]
) -> Iterator[tuple[str, Floats]]:
    """Yield each environment of a group with the values of its seeds, in the order of the seeds."""
    for task in dict.fromkeys(run.environment for run in group.runs):
        in_task = replace(group, label=f"{group.label} in {task}", runs=tuple(_runs([group], [task])))
        by_seed, _ = measured(in_task, *metric, moment, groups, notes)
        if by_seed:
            yield task, np.array(list(by_seed.values()))


def _common_tasks(by_label: Mapping[str, Mapping[str, Floats]], notes: list[str]) -> list[str]:
    """Return the environments in which all groups have values; `notes` gets the others."""
    all_tasks = list(dict.fromkeys(task for by_task in by_label.values() for task in by_task))
    tasks = [task for task in all_tasks if all(task in by_task for by_task in by_label.values())]
    if not tasks:
        listing = "; ".join(
            f"{label}: {listed(list(by_task)) or 'none'}" for label, by_task in by_label.items()
        )
        raise RunnerError(
            f"normalise: found no environment in which every group has a value ({listing}); "
            "group the runs otherwise, such as by name."
        )
    if left_out := [task for task in all_tasks if task not in tasks]:
        notes.append(f"left out, as not every group has a value there: {listed(left_out)}")
    return tasks


def _bounds(
    tasks: Sequence[str],
    by_label: Mapping[str, Mapping[str, Floats]],
    table: Mapping[str, Bounds] | None,
    lower_is_better: bool,
    notes: list[str],
) -> dict[str, Bounds]:
    """Return the values of the scores 0 and 1: of the table, or the worst and the best there."""
    if table is not None:
        if lacking := [task for task in tasks if task not in table]:
            raise RunnerError(
                f"normalise: the table has no row for {listed(lacking)}; it has {listed(list(table))}."
            )
        return {task: table[task] for task in tasks}
    bounds = {}
    equal = []
    for task in tasks:
        values = np.concatenate([by_task[task] for by_task in by_label.values()])
        low, high = float(values.min()), float(values.max())
        if low == high:
            equal.append(f"{task} ({low:g})")
        else:
            bounds[task] = Bounds(high, low) if lower_is_better else Bounds(low, high)
    if equal and not bounds:
        raise RunnerError(
            f"normalise: {MIN_MAX}: found one value in every run, in {listed(equal)}, expected different "
            "ones; a table of scores can normalise them."
        )
    if equal:
        notes.append(
            f"left out, as every run has the same value there, so {MIN_MAX} has no scale: {listed(equal)}; a "
            "table of scores can normalise them"
        )
    return bounds


def _seed_notes(results: Sequence[AlgorithmResult]) -> Iterator[str]:
    for result in results:
        counts = set(result.seeds.values())
        if counts == {1}:
            yield f"{result.label} has one seed in each environment: it has no interval"
        elif 1 in counts:
            yield f"{result.label} has one seed in some environments: its intervals are too narrow"
        if len(counts) > 1:
            yield f"{result.label} has other numbers of seeds in other environments: more seeds weigh more"


# --- tables of scores ---------------------------------------------------------------------------------


def scores_of(given: str | Path) -> dict[str, Bounds] | None:
    """Return the table in a file, or in a text of CSV; None for `minmax`."""
    if str(given) == MIN_MAX:
        return None
    return read_table(given) if isinstance(given, Path) else parse_table(given, "scores.csv")


def read_table(path: Path) -> dict[str, Bounds]:
    """Return the scores of a random policy and of an expert by environment, from CSV, YAML or JSON.

    CSV has the columns task, random and expert; YAML and JSON map an environment to `random` and `expert`.

    Raises:
        RunnerError: the file cannot be read, or is no such table.
    """
    try:
        if path.stat().st_size > _MAX_TABLE:
            raise RunnerError(f"{path}: found more than {_MAX_TABLE:,} bytes, expected a table of scores.")
        text = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8"
        raise RunnerError(f"{path}: cannot be read ({reason}).") from error
    return parse_table(text, path.name)


def parse_table(text: str, name: str) -> dict[str, Bounds]:
    """Return the table of a text, see `read_table`; its format follows the ending of the name.

    Raises:
        RunnerError: it is no such table.
    """
    ending = Path(name).suffix.lower()
    if ending not in (".csv", ".yaml", ".yml", ".json"):
        raise RunnerError(f"{name}: found the ending {ending!r}, expected .csv, .yaml or .json.")
    table: dict[str, Bounds] = {}
    for task, scores in _rows(text, ending, name):
        try:
            bounds = Bounds(*(float(scores[score]) for score in _SCORES))
        except (KeyError, TypeError, ValueError, OverflowError):
            bounds = Bounds(math.nan, math.nan)
        if not math.isfinite(bounds.one - bounds.zero) or len(scores) != len(_SCORES):
            raise RunnerError(f"{name}: {task}: found {scores}, expected finite numbers, random and expert.")
        is_equal = bounds.zero == bounds.one
        if is_equal or task in table:
            problem = f"{bounds.zero:g} as random and as expert" if is_equal else "a second row"
            raise RunnerError(f"{name}: {task}: found {problem}, expected one row with two different scores.")
        table[task] = bounds
    if not table:
        raise RunnerError(f"{name}: found no row, expected one for each environment.")
    return table


def _rows(text: str, ending: str, name: str) -> list[tuple[str, Any]]:
    """Return the environments of a table, each with its scores by name."""
    import yaml

    try:
        if ending != ".csv":
            table = json.loads(text) if ending == ".json" else yaml.safe_load(text)
            if not isinstance(table, Mapping):
                raise RunnerError(f"{name}: expected a mapping of environments to `random` and `expert`.")
            return [(str(task), scores) for task, scores in table.items()]
        reader = csv.DictReader(text.splitlines())
        if sorted(reader.fieldnames or ()) != sorted(("task", *_SCORES)):
            columns = ", ".join(reader.fieldnames or ()) or "none"
            raise RunnerError(f"{name}: found the columns {columns}, expected task, {', '.join(_SCORES)}.")
        return [(str(row.pop("task")), row) for row in reader]
    except (ValueError, RecursionError, csv.Error, yaml.YAMLError) as error:
        raise RunnerError(f"{name}: cannot be parsed ({' '.join(str(error).split())}).") from error


# --- statistics ---------------------------------------------------------------------------------------


def _result(
    label: str, scores: Mapping[str, Floats], thresholds: Floats, curves: Sequence[Floats]
) -> AlgorithmResult:
    """Return the statistics of an algorithm; `curves` has [seeds, positions] for each environment."""
    strata = [values[:, np.newaxis] for values in scores.values()]
    reached = [(values >= thresholds).astype(np.float64) for values in strata]
    profile = statistics.stratified(reached, lambda drawn: np.concatenate(drawn).mean(axis=0))
    share, share_low, share_high = (part.tolist() for part in profile)
    curve, curve_low, curve_high = (part.tolist() for part in statistics.stratified(curves, _iqm))
    return AlgorithmResult(
        label=label,
        seeds={task: len(values) for task, values in scores.items()},
        scores={task: values.tolist() for task, values in scores.items()},
        iqm=_estimate(strata, _iqm),
        median=_estimate(strata, lambda drawn: np.median([task.mean(axis=0) for task in drawn], axis=0)),
        mean=_estimate(strata, lambda drawn: np.mean([task.mean(axis=0) for task in drawn], axis=0)),
        optimality_gap=_estimate(strata, lambda drawn: 1 - np.minimum(np.concatenate(drawn), 1).mean(axis=0)),
        profile=share,
        profile_low=share_low,
        profile_high=share_high,
        curve=curve,
        curve_low=curve_low,
        curve_high=curve_high,
    )


def _iqm(drawn: Sequence[Floats]) -> Floats:
    return statistics.iqm(np.concatenate(drawn), 0)


def _estimate(
    strata: Sequence[Floats], statistic: Callable[[Sequence[Floats]], Floats], cells: int = 0
) -> Estimate:
    value, low, high = statistics.stratified(strata, statistic, cells)
    return Estimate(float(value[0]), float(low[0]), float(high[0]))


def _improvement(a: Mapping[str, Floats], b: Mapping[str, Floats]) -> Estimate:
    """Return the mean over environments of the probability that a run of A scores higher; ties count half."""

    def probability(drawn: Sequence[Floats]) -> Floats:
        pairs = zip(drawn[::2], drawn[1::2], strict=True)
        signs = [np.sign(ours[:, np.newaxis] - theirs).mean(axis=(0, 1)) for ours, theirs in pairs]
        return np.asarray(0.5 + 0.5 * np.mean(signs, axis=0))

    strata = [scores[task][:, np.newaxis] for task in a for scores in (a, b)]
    return _estimate(strata, probability, cells=max(len(a[task]) * len(b[task]) for task in a))


def _runs(groups: Sequence[Group], tasks: Sequence[str]) -> list[RunSeries]:
    return [run for group in groups for run in group.runs if run.environment in tasks]


def _curves(
    group: Group, metric: tuple[str, str], bounds: Mapping[str, Bounds], positions: Floats
) -> list[Floats]:
    """Return the scores of a group's seeds at each position, [seeds, positions] for each environment."""
    curves = []
    for task, scale in bounds.items():
        seeds: dict[Seed, list[Floats]] = {}
        for run in _runs([group], [task]):
            if points := points_of(run, *metric, aligned=True):
                values = np.interp(positions, list(points), list(points.values()))
                seeds.setdefault(seed_of(run), []).append(scale.score(values))
        curves.append(np.array([np.mean(runs, axis=0) for runs in seeds.values()]))
    return curves
