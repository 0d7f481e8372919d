"""The objective of a sweep: readings of a metric during a run, the value of the run, and pruning."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from runner.analysis.axes import first_crossing, mean_height
from runner.analysis.evaluations import evaluation_record
from runner.analysis.series import (
    evaluation_readings,
    exact_readings,
    full_name,
    training_readings,
)
from runner.analysis.statistics import NEVER
from runner.errors import RunnerError, nearest
from runner.recording import schema
from runner.recording.messages import Message
from runner.recording.metrics import is_higher_better
from runner.recording.reader import Recording
from runner.sweep.model import Objective

Curve = dict[int, float]
"""Reading by training episode."""


def curve_of(recording: Recording, metric: str) -> Curve:
    """Return the finite readings of a metric at the evaluations of a recording."""
    agents = recording.agents
    events = recording.environment["event_names"]
    exact = {
        measures["evaluation"]: measures for measures in recording.table(schema.OPTIMALITY_TOPIC).decoded()
    }
    evaluations = [
        (metrics["episode"], readings(metrics, exact.get(metrics["evaluation"]), agents, events))
        for metrics in recording.eval.all_metrics()
    ]
    curve = {episode: read[metric] for episode, read in evaluations if metric in read}
    if not curve:
        raise never_recorded(metric, {name for _, read in evaluations for name in read})
    return {episode: reading for episode, reading in curve.items() if math.isfinite(reading)}


def readings(
    metrics: Message, exact: Message | None, agents: Sequence[str], events: Sequence[str]
) -> dict[str, float]:
    """Return the readings of an evaluation by name; `mean_return` without an agent if there is but one."""
    record = evaluation_record(metrics, agents, events)
    by_metric = evaluation_readings(record)
    if record.training:
        by_metric |= training_readings(record.training)
    if exact is not None:
        by_metric |= exact_readings(exact, agents)
    flat = {
        full_name(metric, line): value for metric, lines in by_metric.items() for line, value in lines.items()
    }
    alone = {metric: next(iter(lines.values())) for metric, lines in by_metric.items() if len(lines) == 1}
    return flat | alone


def never_recorded(metric: str, known: set[str]) -> RunnerError:
    """Return the error of an objective that no evaluation has."""
    if not known:
        return RunnerError(
            f"objective.metric: found {metric!r}, which was never recorded: there are no evaluations. "
            "Set `evaluation` in the base."
        )
    hint = nearest(metric, known)
    if metric.startswith("exact.") and not any(name.startswith("exact.") for name in known):
        hint = " Set `evaluation: {exact: true}` in the base for exact measures."
    listed = ", ".join(sorted(name for name in known if not name.startswith("training.reward.")))
    return RunnerError(
        f"objective.metric: found {metric!r}, which was never recorded, expected one of {listed}.{hint}"
    )


def value_of(objective: Objective, curve: Curve) -> float:
    """Return the value of a run; NEVER for a level that is not reached; NaN without a reading."""
    if not curve:
        return math.nan
    episodes = sorted(curve)
    values = [curve[episode] for episode in episodes]
    match objective.at:
        case "last":
            return values[-1]
        case "best":
            return objective.sign * max(objective.sign * value for value in values)
        case "area":
            if len(values) == 1:
                return values[0]
            return mean_height(episodes, values)
        case "first_over":
            assert objective.level is not None
            rising = is_higher_better(objective.metric, has_goal=True)
            at = first_crossing(curve, objective.level, rising)
            return NEVER if at is None else float(at)


def pruning_bounds(objective: Objective, curves: Sequence[Curve], percentile: float) -> Curve:
    """Return by episode the bound that the best reading of a run so far must reach.

    A run may be worse than a `percentile` of the finished trials, whose readings the curves are.
    """
    bests: dict[int, list[float]] = {}
    for curve in curves:
        episodes = sorted(curve)
        best = itertools.accumulate((objective.sign * curve[episode] for episode in episodes), max)
        for episode, value in zip(episodes, best, strict=True):
            bests.setdefault(episode, []).append(value)
    return {
        episode: objective.sign * float(np.percentile(values, 100 - percentile))
        for episode, values in sorted(bests.items())
    }


def should_prune(objective: Objective, curve: Curve, bounds: Mapping[int, float]) -> bool:
    """Return whether the best reading so far is worse than the bound at the last episode that has one."""
    passed = [episode for episode in bounds if curve and episode <= max(curve)]
    if not passed:
        return False
    at = max(passed)
    best = max((objective.sign * value for episode, value in curve.items() if episode <= at), default=-np.inf)
    return bool(best < objective.sign * bounds[at])
