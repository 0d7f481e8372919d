"""How two runs' curves differ: at the end, in area, and when each first reaches a level."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from runner.analysis.axes import first_crossing, mean_height
from runner.analysis.evaluations import evaluation_records
from runner.analysis.series import (
    evaluation_readings,
    full_name,
    lines_in,
    points_of,
    read_series,
    single_agent_unnamed,
    training_readings,
)
from runner.errors import RunnerError, nearest
from runner.recording.metrics import METRIC_OF, METRICS, is_higher_better
from runner.recording.reader import Recording

_COMPARED: Final = (*METRICS, METRIC_OF["training.mean_length"], METRIC_OF["training.percent_filled"])
_OF_LOOPS: Final = ("training.mean_length", "training.mean_return")


@dataclass(frozen=True)
class MetricDiff:
    """One metric of two runs, over training episodes."""

    name: str
    episodes: list[int]
    """Episodes at which both have a value."""
    a: list[float]
    b: list[float]
    end_a: float
    """The last value of all, also where the other has none; of a loop's training the mean at its end."""
    end_b: float
    area: float
    """Mean difference b - a: the area between the curves over the episodes both have, by their span."""
    crossings: dict[str, tuple[int | None, int | None]]
    """Target level, as text, to the episodes at which a and b first reach it."""

    @property
    def same(self) -> bool:
        """Whether both curves are the same."""
        return self.a == self.b and self.end_a == self.end_b


def metric_diffs(a: Recording, b: Recording, targets: Mapping[str, float]) -> list[MetricDiff]:
    """Return how each metric of evaluations and of a loop's training differs.

    With the first crossing of each target's level.

    Raises:
        RunnerError: they have no metric of that name.
    """
    (curves_a, ends_a), (curves_b, ends_b) = _curves(a), _curves(b)
    names = [name for name in curves_a if name in curves_b]
    for name in targets:
        if name not in names:
            known = f"expected one of {', '.join(names)}" if names else "but both runs have no metric"
            raise RunnerError(f"target: found {name!r}, {known}.{nearest(name, names)}")
    diffs = []
    for name in names:
        left, right = curves_a[name], curves_b[name]
        episodes = sorted(left.keys() & right.keys())
        crossings = {}
        if (level := targets.get(name)) is not None:
            rising = is_higher_better(name, has_goal="success_percent" in names)
            crossings[f"{level:g}"] = (
                first_crossing(left, level, rising),
                first_crossing(right, level, rising),
            )
        diffs.append(
            MetricDiff(
                name=name,
                episodes=episodes,
                a=[left[episode] for episode in episodes],
                b=[right[episode] for episode in episodes],
                end_a=ends_a[name],
                end_b=ends_b[name],
                area=mean_height(episodes, [right[episode] - left[episode] for episode in episodes]),
                crossings=crossings,
            )
        )
    return diffs


def _curves(recording: Recording) -> tuple[dict[str, dict[int, float]], dict[str, float]]:
    """Return metric to episode to value, without values that are unknown, and the value at the end of each.

    A loop's training ends with the mean over its last episodes, as in `ls` and `show`.
    """
    curves: dict[str, dict[int, float]] = {}
    recent: dict[str, float] = {}
    for record in evaluation_records(recording):
        readings = evaluation_readings(record)
        if not recording.can_train_again:
            readings = single_agent_unnamed(readings)
        if record.training is not None:
            readings |= training_readings(record.training)
        for metric in _COMPARED:
            for line, value in readings.get(metric.name, {}).items():
                curves.setdefault(full_name(metric.name, line), {})[record.episode] = value
    if not recording.can_train_again and recording.train.episodes.count():
        series = read_series(recording, metrics=_OF_LOOPS)
        for name, line in lines_in([series]):
            if name in _OF_LOOPS:
                full = full_name(name, line)
                points = points_of(series, name, line, aligned=False)
                curves[full] = {int(at): value for at, value in points.items()}
                if (end := series.recent.get(name, {}).get(line)) is not None:
                    recent[full] = end
    return curves, {name: curve[max(curve)] for name, curve in curves.items()} | recent
