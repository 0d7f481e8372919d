"""Every metric of runs over episodes: runs of one configuration together, as median and band.

What is computed here is what `plots_figure` draws: a `Panel` a metric, in it a `Curve` a group of runs
(and an agent).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runner.analysis.groups import Group
from runner.analysis.series import LOGGED, points_of, title_of
from runner.errors import RunnerError
from runner.recording.metrics import METRIC_OF, SHARES


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


# --- inside -------------------------------------------------------------------------------------------


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


def _curve(number: int, group: Group, metric: str, line: str) -> Curve | None:
    """Return the median and the band of a metric, over the runs that have come as far.

    Runs report training after so many steps, so at different episodes: with several runs only the
    reports at evaluations are taken, which are at the same episodes. Somebody's own loop evaluates when it
    likes: between its points a run is interpolated, lest the line jump from one run to the other.
    """
    runs = [points_of(run, metric, line, aligned=len(group.runs) > 1) for run in group.runs]
    episodes = sorted({episode for points in runs for episode in points})
    if not episodes:
        return None
    values = np.array(
        [
            np.interp(episodes, list(points), list(points.values()), np.nan, np.nan)
            for points in (dict(sorted(run.items())) for run in runs if run)
        ]
    )
    return Curve(
        number,
        line,
        np.array(episodes, np.float64),
        np.nanmedian(values, axis=0),
        np.nanmin(values, axis=0),
        np.nanmax(values, axis=0),
    )


def _panel(metric: str, curves: tuple[Curve, ...]) -> Panel:
    return Panel(metric, *title_of(metric), curves)


def _rank(metric: str) -> tuple[int, int]:
    """Return where a metric stands: evaluation, its events, training."""
    order = list(METRIC_OF)
    if metric.startswith("event."):
        return 1, 0
    if metric.startswith(LOGGED):
        return 3, 0
    return (2 if metric.startswith("training.") else 0), order.index(metric)
