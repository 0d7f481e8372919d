"""How two runs' curves differ: at the end, in area, and when each first reaches a level."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from runner.analysis.axes import first_crossing, mean_height
from runner.errors import RunnerError, nearest
from runner.recording.metrics import METRIC_OF, METRICS
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
    crossings: dict[str, tuple[int | None, int | None]] = field(default_factory=dict)
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
    values = [_values(recording) for recording in (a, b)]
    names = [name for name in values[0] if name in values[1]]
    for name in targets:
        if names and name not in names:
            listed = ", ".join(names)
            raise RunnerError(f"target: found {name!r}, expected one of {listed}.{nearest(name, names)}")
    diffs = []
    for name in names:
        left, right = values[0][name], values[1][name]
        episodes = sorted(left.keys() & right.keys())
        ours, theirs = [left[e] for e in episodes], [right[e] for e in episodes]
        area = mean_height(episodes, [y - x for x, y in zip(ours, theirs, strict=True)])
        level = targets.get(name)
        crossings = (
            {}
            if level is None
            else {f"{level:g}": (first_crossing(left, level), first_crossing(right, level))}
        )
        ends = left[max(left)], right[max(right)]
        diffs.append(MetricDiff(name, episodes, ours, theirs, *ends, area, crossings))
    return diffs


def _values(recording: Recording) -> dict[str, dict[int, float]]:
    """Return metric to episode to value; what is unknown (nan) is left out."""
    agents = recording.agents
    table: dict[str, dict[int, float]] = {}
    for metrics in recording.eval.metrics.decoded():
        for metric in _COMPARED:
            value = metrics[metric.field]
            lines = [f"{metric.name}.{agent}" for agent in agents] if metric.per_agent else [metric.name]
            for line, own in zip(lines, value if metric.per_agent else [value], strict=False):
                if not math.isnan(own):
                    table.setdefault(line, {})[int(metrics["episode"])] = float(own)
    return table


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
