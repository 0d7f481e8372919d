"""Every metric of runs over an axis: runs of one configuration together, as IQM and band.

A `Panel` is a metric; it has a `Curve` for each group of runs (and agent).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from runner.analysis.axes import Axis
from runner.analysis.compare.statistics import iqm_band
from runner.analysis.groups import Group
from runner.analysis.series import LOGGED, lines_in, points_of, title_of
from runner.errors import RunnerError
from runner.recording.metrics import METRIC_OF, SHARES
from runner.util.arrays import Floats


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
