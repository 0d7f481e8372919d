"""When a metric is read: at the last or best evaluation, after some episodes, over all, at a crossing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

from runner.analysis.compare.statistics import NEVER
from runner.analysis.groups import Group
from runner.analysis.series import RunSeries, first_crossing, mean_height, points_of
from runner.errors import RunnerError
from runner.recording.metrics import METRIC_OF

Kind = Literal["last", "best", "area", "episode", "crossing"]
_OF_WHOLE_RUNS: Final[tuple[Kind, ...]] = ("last", "best", "area")


def higher_is_better(metric: str, groups: Sequence[Group]) -> bool | None:
    """Return whether higher values of a metric are better; None where neither is, in general."""
    better = METRIC_OF[metric].better if metric in METRIC_OF else None
    if better == "lower_to_goal":
        return False if all(run.has_goal for group in groups for run in group.runs) else None
    return None if better is None else better == "higher"


@dataclass(frozen=True)
class Moment:
    """A moment, or a way to reduce a curve to one number.

    last: the last evaluation. best: the best of all. area: the mean of the curve by the trapezoid rule,
    over the episodes that every run has. episode: the evaluation after `number` training episodes.
    crossing: after how many episodes the curve is first at `level`, coming from the other side.
    """

    kind: Kind
    number: int = 0
    level: float | None = None

    @property
    def described(self) -> str:
        """A description of the moment."""
        match self.kind:
            case "last":
                return "at the last evaluation"
            case "best":
                return "at each run's best evaluation"
            case "area":
                return "the mean over training, by area under the curve"
            case "episode":
                return f"after {self.number:,} training episodes"
            case "crossing":
                return f"training episodes until it is first at {self.level:g}"


def moment_of(
    moment: str, target: tuple[str, float] | None, chosen: Sequence[str]
) -> tuple[Moment, Sequence[str]]:
    """Return the moment that options stand for, and the metrics: a target names its own.

    Args:
        moment: `last`, `best`, `area`, or a number of training episodes.
        target: a metric and its level, instead; or None.
        chosen: metrics.

    Raises:
        RunnerError: it is none of these, or both are given.
    """
    if target is not None:
        if moment != "last" or chosen:
            raise RunnerError("target: found a moment or a metric as well, expected it alone.")
        metric, level = target
        return Moment("crossing", level=level), (metric,)
    if moment.isascii() and moment.isdecimal():
        return Moment("episode", number=int(moment)), chosen
    for kind in _OF_WHOLE_RUNS:
        if moment == kind:
            return Moment(kind), chosen
    raise RunnerError(
        f"moment: found {moment!r}, expected last, best, area, or a number of training episodes."
    )


def value_of(
    run: RunSeries, metric: str, line: str, moment: Moment, groups: Sequence[Group]
) -> tuple[float | None, str]:
    """Return a run's value of a metric, or None and why it has none."""
    read = points_of(run, metric, line, aligned=True)
    points = {episode: value for episode, value in read.items() if math.isfinite(value)}
    if not points:
        return None, f"has no {metric}{'.' + line if line else ''}"
    if moment.kind == "episode":
        return points.get(moment.number), f"has none after {moment.number:,} episodes"
    if not run.finished:
        return None, "not finished; --moment EPISODE takes it as far as it got"
    if moment.kind == "area":
        return _area(points, _shared_episodes(metric, line, groups))
    if moment.level is not None:
        at = first_crossing(points, moment.level)
        return NEVER if at is None else float(at), ""
    best = min if higher_is_better(metric, groups) is False else max
    return best(points.values()) if moment.kind == "best" else points[max(points)], ""


def _shared_episodes(metric: str, line: str, groups: Sequence[Group]) -> list[int]:
    """Return the episodes at which every finished run that has the metric has it."""
    runs = [run for group in groups for run in group.runs if run.finished]
    episodes = [set(points_of(run, metric, line, aligned=True)) for run in runs]
    return sorted(set.intersection(*(some for some in episodes if some)))


def _area(points: dict[int, float], episodes: Sequence[int]) -> tuple[float | None, str]:
    if len(episodes) < 2:
        return None, "fewer than two evaluations after as many episodes as in the other runs"
    return mean_height(episodes, [points[episode] for episode in episodes]), ""
