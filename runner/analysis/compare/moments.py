"""When a metric is read: at the last or best evaluation, at a position, over all, at a crossing."""

from __future__ import annotations

import contextlib
import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from runner.analysis.axes import EPISODES, Axis, first_crossing, mean_height
from runner.analysis.groups import Group
from runner.analysis.series import RunSeries, full_name, points_of
from runner.analysis.statistics import FEW_SEEDS, NEVER
from runner.errors import RunnerError
from runner.recording.metrics import is_higher_better
from runner.util.humanize import listed

Kind = Literal["last", "best", "area", "position", "crossing"]
Seed = int | str
"""A seed, or the id of a run without one."""

_OF_WHOLE_RUNS: Final[tuple[Kind, ...]] = ("last", "best", "area")
"""Moments that an option gives by name."""


def higher_is_better(metric: str, groups: Sequence[Group]) -> bool | None:
    """Return whether higher values of a metric are better; None where neither is, in general."""
    return is_higher_better(metric, all(run.has_goal for group in groups for run in group.runs))


@dataclass(frozen=True)
class Moment:
    """A moment, or a way to reduce a curve to one number.

    last: the last evaluation, or a loop's last training episodes. best: the best of all. area: the mean of
    the curve by the trapezoid rule, over the span that every run covers. position: after `number` training
    episodes, steps, ...; episodes must have an evaluation there, on other axes a run is interpolated between
    its readings. crossing: the position at which the curve is first at `level`, or at a better value; without
    a better side, at `level` or beyond, seen from where it begins.
    """

    kind: Kind
    number: float = 0
    level: float | None = None
    axis: Axis = EPISODES
    """The axis on which the runs are read."""


def moment_in_words(moment: Moment, metrics: Sequence[str], groups: Sequence[Group]) -> str:
    """Return at which moment these metrics are read: training has no evaluations."""
    is_training = all(name.startswith("training.") for name in metrics)
    match moment.kind:
        case "last" if is_training:
            ends = {last_episodes(name, groups) for name in metrics}
            words = f"the mean over the {listed(sorted(ends))} of training"
            if "" in ends:
                words = "at the end of training, as last reported"
        case "last":
            words = "at the last evaluation"
        case "best":
            best = "the best report of each run's training" if is_training else "each run's best evaluation"
            words = f"at {best}"
        case "area":
            over = "" if moment.axis is EPISODES else f" over {moment.axis.title}"
            words = f"the mean over training, by area under the curve{over}"
        case "position":
            words = f"after {moment.axis.moment(moment.number)}"
        case "crossing":
            words = f"{moment.axis.label} until it is first at {moment.level:g}"
    return words


def last_episodes(metric: str, groups: Sequence[Group]) -> str:
    """Return which episodes the last value of a metric averages: `last 100 episodes`; empty for none."""
    runs = [run for group in groups for run in group.runs if metric in run.recent]
    counts = sorted({run.recent_episodes for run in runs})
    if not counts:
        return ""
    if counts == [1]:
        return "last episode"
    return f"last {f'{counts[0]} to ' if len(counts) > 1 else ''}{counts[-1]} episodes"


def window_notes(groups: Sequence[Group], metrics: Sequence[str], moment: Moment) -> Iterator[str]:
    """Yield a note on the window that a value of training averages, unless only last values are compared."""
    if moment.kind == "last" or not any(name.startswith("training.") for name in metrics):
        return
    windows: dict[str, list[str]] = {}
    for group in groups:
        run = group.runs[0]
        window = ""
        if log := run.config.get("log"):
            window = f"the last {log['episodes']:,} episodes (lengths) or {log['window']:,} steps (rewards)"
        elif run.training:
            ends = [0.0, *sorted(at for at, _ in run.training)]
            width = min(after - before for before, after in itertools.pairwise(ends))
            if width > 1 or not run.axis.whole:
                window = f"stretches of {run.axis.moment(width)}"
        if window:
            windows.setdefault(window, []).append(group.label)
    if windows:
        parts = "; ".join(f"{window} in {listed(labels)}" for window, labels in windows.items())
        yield f"a value of training is the mean over a window: {parts}"


def few_seeds(groups: Sequence[Group], seeds: Mapping[str, int]) -> Iterator[str]:
    """Yield a note if groups have fewer seeds, by label, than their intervals need."""
    few = [group for group in groups if seeds[group.label] < FEW_SEEDS]
    if not few:
        return
    listed_groups = ", ".join(f"{group.label} ({seeds[group.label]})" for group in few)
    has_setting = any("seeds" in run.config for group in few for run in group.runs)
    more = (
        "the setting `seeds: {count: 10}` runs ten"
        if has_setting
        else "record more, each with a seed of its own"
    )
    yield (
        f"fewer than {FEW_SEEDS} seeds in {listed_groups}: bootstrap intervals of so few are "
        f"too narrow (at 4 seeds one of 95 % covers 86 % of the time), so take them as a hint; {more}"
    )


def uneven_ends(groups: Sequence[Group], metric: str, line: str) -> Iterator[str]:
    """Yield a note if the last evaluation is not at the same position of the axis in all groups."""
    curves = [
        (group.label, points)
        for group in groups
        for run in group.runs
        if run.finished and (points := points_of(run, metric, line, aligned=True))
    ]
    last = {label: max(points) for label, points in curves}
    if len(set(last.values())) < 2:
        return
    axis = groups[0].axis
    ends = ", ".join(f"after {axis.moment(end)} in {label}" for label, end in last.items())
    what = "report of training" if metric.startswith("training.") else "evaluation"
    shared = set.intersection(*(set(points) for _, points in curves))
    if axis is not EPISODES:  # where runs are interpolated
        shared = {min(last.values())}
    hint = f"; the moment {max(shared):.10g} compares after as many" if shared else ""
    yield f"the last {what} is {ends}{hint}"


def moment_of(
    moment: str, target: tuple[str, float] | None, metrics: Sequence[str], axis: Axis = EPISODES
) -> tuple[Moment, Sequence[str]]:
    """Return the moment that options stand for, and the metrics: a target names its own.

    A moment is `last`, `best`, `area`, or a position: a number of training episodes, or of the axis. A
    target, a metric and its level, replaces it.

    Raises:
        RunnerError: it is none of these, or both are given.
    """
    if target is not None:
        if moment != "last" or metrics:
            raise RunnerError(
                "target: it names its metric and when it is read, so it excludes metric and moment; "
                "drop it or them."
            )
        metric, level = target
        return Moment("crossing", level=level, axis=axis), (metric,)
    for kind in _OF_WHOLE_RUNS:
        if moment == kind:
            return Moment(kind, axis=axis), metrics
    if re.fullmatch("[0-9]{1,15}", moment):
        return Moment("position", number=int(moment), axis=axis), metrics
    with contextlib.suppress(ValueError):
        if not axis.whole and 0 <= (number := float(moment)) < math.inf:
            return Moment("position", number=number, axis=axis), metrics
    raise RunnerError(f"moment: found {moment!r}, expected last, best, area, or a number of {axis.label}.")


def seed_of(run: RunSeries) -> Seed:
    """Return a run's seed; its id if it has none: such runs are not repetitions of each other."""
    return run.run_id if run.seed is None else run.seed


def seed_order(seed: Seed) -> tuple[bool, Seed]:
    """Return the sort key of a seed: numbers come first."""
    return isinstance(seed, str), seed


def measured(
    group: Group, metric: str, line: str, moment: Moment, groups: Sequence[Group], notes: list[str]
) -> tuple[dict[Seed, float], list[str]]:
    """Return the mean value of each seed of a group, and its runs with a value, both by seed, ascending.

    `notes` gets the runs that are left out.
    """
    runs_of: dict[Seed, list[tuple[str, float]]] = {}
    without: dict[str, list[str]] = {}
    for run in group.runs:
        value, reason = value_of(run, metric, line, moment, groups)
        if value is None:
            without.setdefault(reason, []).append(run.run_id)
        else:
            runs_of.setdefault(seed_of(run), []).append((run.run_id, value))
    if metric.startswith("training.mean_") and any(run.is_unended for run in group.runs):
        unended = listed([run.run_id for run in group.runs if run.is_unended])
        notes.append(
            f"{group.label}: no episode ended in {unended}, so unfinished ones count as far as they got"
        )
    notes += [f"{group.label}, left out: {listed(runs)} ({reason})" for reason, runs in without.items()]
    seeds = sorted(runs_of, key=seed_order)
    run_ids = [run_id for seed in seeds for run_id, _ in runs_of[seed]]
    if len(run_ids) > len(seeds):
        notes.append(
            f"{group.label}: {len(run_ids)} runs of {len(seeds)} seeds, each seed with the mean of its runs"
        )
    return {seed: float(np.mean([value for _, value in runs_of[seed]])) for seed in seeds}, run_ids


def value_of(
    run: RunSeries, metric: str, line: str, moment: Moment, groups: Sequence[Group]
) -> tuple[float | None, str]:
    """Return a run's value of a metric, or None and why it has none."""
    curve = points_of(run, metric, line, aligned=True)
    points = {at: value for at, value in curve.items() if math.isfinite(value)}
    if not points:
        return None, f"has no {full_name(metric, line)}"
    positions = list(points)
    values = list(points.values())
    if moment.kind == "position":
        value = points.get(moment.number)
        at = moment.number
        if moment.axis is not EPISODES and positions[0] <= at <= positions[-1]:
            value = float(np.interp(at, positions, values))
        return value, f"has none after {moment.axis.moment(at)}"
    if not run.finished:
        return None, "not finished; an episode as the moment takes it as far as it got"
    if moment.kind == "area":
        finished = [other for group in groups for other in group.runs if other.finished]
        first, last = shared_span(finished, metric, line)
        if first >= last:
            return None, "it has no part of training in common with the other runs"
        span = sorted({first, *(at for at in positions if first <= at <= last), last})
        return mean_height(span, np.interp(span, positions, values).tolist()), ""
    if moment.level is not None:
        crossing = first_crossing(points, moment.level, higher_is_better(metric, groups))
        value = NEVER if crossing is None else float(crossing)
    elif moment.kind == "best":
        value = min(values) if higher_is_better(metric, groups) is False else max(values)
    else:
        value = run.recent.get(metric, {}).get(line, values[-1])
    return value, ""


def shared_span(runs: Sequence[RunSeries], metric: str, line: str) -> tuple[float, float]:
    """Return the first and the last position that every run with the metric covers."""
    curves = [points for run in runs if (points := points_of(run, metric, line, aligned=True))]
    return max(map(min, curves)), min(map(max, curves))
