"""How two runs' curves differ: at the end, in area, and when each first reaches a level."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from runner.analysis.axes import first_crossing, mean_height
from runner.analysis.evaluations import evaluation_records
from runner.analysis.series import evaluation_readings, full_name, single_agent_unnamed, training_readings
from runner.errors import RunnerError, nearest
from runner.recording.metrics import METRIC_OF, METRICS, is_higher_better
from runner.recording.reader import Recording

_COMPARED: Final = (*METRICS, METRIC_OF["training.mean_length"], METRIC_OF["training.percent_filled"])


@dataclass(frozen=True)
class MetricDiff:
    """One metric of two runs, over training episodes."""

    name: str
    episodes: list[int]
    """Episodes at which both have a value."""
    a: list[float]
    b: list[float]
    end_a: float
    """The last value of all, also where the other has none."""
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
    """Return how each metric of the evaluations differs, with the first crossing of each target's level.

    Raises:
        RunnerError: they have no metric of that name.
    """
    curves_a, curves_b = _curves(a), _curves(b)
    names = [name for name in curves_a if name in curves_b]
    for name in targets:
        if name not in names:
            known = f"expected one of {', '.join(names)}" if names else "but no evaluations of both runs"
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
                end_a=left[max(left)],
                end_b=right[max(right)],
                area=mean_height(episodes, [right[episode] - left[episode] for episode in episodes]),
                crossings=crossings,
            )
        )
    return diffs


def _curves(recording: Recording) -> dict[str, dict[int, float]]:
    """Return metric to episode to value, without values that are unknown."""
    curves: dict[str, dict[int, float]] = {}
    for record in evaluation_records(recording):
        readings = evaluation_readings(record)
        if not recording.can_train_again:
            readings = single_agent_unnamed(readings)
        if record.training is not None:
            readings |= training_readings(record.training)
        for metric in _COMPARED:
            for line, value in readings.get(metric.name, {}).items():
                curves.setdefault(full_name(metric.name, line), {})[record.episode] = value
    return curves


def loop_means(recording: Recording) -> dict[str, float]:
    """Return mean length and return over the training episodes of a recording; nothing without any."""
    episodes = 0
    length = 0
    total = 0.0
    for block in recording.train.episodes.blocks():
        episodes += len(block)
        length += int(block["length"].sum())
        total += float(block["returns"].sum())
    if not episodes:
        return {}
    return {"mean_length": round(length / episodes, 3), "mean_return": round(total / episodes, 3)}
