"""The metrics of runs over episodes, and what they are called: what plots and comparisons are made of."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from runner.environments.naming import event_in_words
from runner.errors import RunnerError
from runner.recording.metrics import LARGEST, METRIC_OF, SHARES

Readings = dict[str, dict[str, float]]
"""Metric -> line (an agent, a reward, or "") -> value."""


@dataclass(frozen=True)
class RunSeries:
    """The metrics of one run."""

    run_id: str
    name: str
    seed: int | None
    """None for a loop that was given none."""
    status: str
    """How it ended: `finished`, `interrupted` or `failed`."""
    config: Mapping[str, Any]
    evaluation: list[tuple[int, Readings]]
    """(episode, readings) of every evaluation."""
    training: list[tuple[int, Readings]]
    """(episode, readings) of every report of training, those at evaluations among them."""
    content_digest: str = ""
    """Of its recording; empty if that did not come to its end."""
    not_finite: Mapping[str, int] = field(default_factory=dict)
    """Metric -> number of recorded values that are infinite, NaN or too large to be averaged; the
    readings leave them out."""

    @property
    def finished(self) -> bool:
        """Whether it came to its end."""
        return self.status == "finished"


LOGGED: Final = "training.logged."
"""What somebody's own loop logged under a name of its own."""
_TITLE: Final = 40
"""Letters of a name for which there is room above a panel."""


def is_loop(run: RunSeries) -> bool:
    """Return whether a run is somebody's own loop, whose training is told at even numbers of episodes."""
    return "made_by" in run.config


def values_left_out(runs: Iterable[RunSeries]) -> list[str]:
    """Return a sentence for each run that says which values its readings leave out; none for most runs."""
    return [
        f"Run {run.run_id}: left out, as they are infinite, not a number or beyond {LARGEST:g}: "
        + ", ".join(
            f"{count:,} value{'s' if count > 1 else ''} of “{title_of(metric)[0]}”"
            for metric, count in run.not_finite.items()
        )
        + "."
        for run in runs
        if run.not_finite
    ]


def has_goal(run: RunSeries) -> bool:
    """Return whether a run's episodes are about getting somewhere, the sooner the better.

    Of a loop it is known where its environment says what success is; a pole is to be held as long as can be.
    """
    return not is_loop(run) or any("success_percent" in readings for _, readings in run.evaluation)


def title_of(metric: str) -> tuple[str, str]:
    """Return a metric's title and its unit."""
    if metric.startswith("event."):
        return f"Event: {event_in_words(metric.removeprefix('event.'))}", "times a trial, mean"
    if metric.startswith(LOGGED):
        name = " ".join(metric.removeprefix(LOGGED).split())
        return f"Logged: {name if len(name) <= _TITLE else name[: _TITLE - 1] + '…'}", "as logged, mean"
    return METRIC_OF[metric].title, METRIC_OF[metric].unit


def first_crossing(points: Mapping[int, float], level: float) -> int | None:
    """Return the first episode at which a curve is at a level, or on the other side than where it began."""
    below = points[min(points)] < level
    for episode in sorted(points):
        if points[episode] >= level if below else points[episode] <= level:
            return episode
    return None


def mean_height(episodes: Sequence[int], values: Sequence[float]) -> float:
    """Return the area under a curve, by the trapezoid rule, over its span; nan for fewer than two points."""
    if len(episodes) < 2:
        return math.nan
    return float(np.trapezoid(values, episodes)) / (episodes[-1] - episodes[0])


def parse_target(text: str) -> tuple[str, float]:
    """Return metric and level of a target such as `success_percent=80`.

    Raises:
        RunnerError: the text is no target.
    """
    metric, _, level = text.partition("=")
    try:
        return metric, float(level)
    except ValueError:
        raise RunnerError(
            f"target: found {text!r}, expected METRIC=LEVEL such as success_percent=80."
        ) from None


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
