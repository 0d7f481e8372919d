"""A run's measures as named numbers over training steps: what metric stores and spreadsheets take.

    train/mean_length, train/percent_filled/taxi_1, train/reward_counts/-1, train/epsilon, ...
    eval/success_percent, eval/mean_return/taxi_1, eval/events/taxi_1.drop_off, eval/training/epsilon, ...
    eval/exact/value/taxi_1, eval/exact/optimal_value, ... with `evaluation: {exact: true}`
    train/logged/loss, ... what somebody's own loop logged
    train/episode/length, train/episode/return/taxi_1, ... of each episode: in TensorBoard; of loops in MLflow

What is unknown (a mean over no episode, success where the environment does not say what it is) is left
out, so every number is one that was recorded, unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from runner.errors import RecordingError
from runner.recording.metrics import METRICS
from runner.recording.reader import Recording
from runner.recording.schema import EVAL_EPISODE, SCALAR_TOPIC, STEP_NANOSECONDS, TRAIN_EPISODE

_OF_TRAINING = ("mean_length", "zero_cells", "percent_filled", "epsilon", "step_size", "discount")
_EXACT = {
    **{name: name for name in ("success_percent", "timeout_percent", "mean_length", "mean_penalties")},
    **{"mean_returns": "mean_return", "values": "value", "best_responses": "best_response"},
    **{f"optimal_{name}": f"optimal_{name}" for name in ("value", "success_percent", "mean_length")},
}


@dataclass(frozen=True)
class Measures:
    """The numbers of one moment."""

    phase: str
    """`train` or `eval`."""
    position: int
    """Environment steps executed before, of training and evaluation together: the logical time."""
    step: int
    """Training steps taken."""
    episode: int
    """Training episodes done; with what a loop logged in evaluation, episodes of evaluation."""
    values: Mapping[str, float]
    """By name, without the phase."""


def measures(recording: Recording) -> Iterator[Measures]:
    """Yield the reports of training, the evaluations, their exact measures, and what a loop logged, in order.

    Raises:
        RecordingError: the recording is damaged.
    """
    agents, events = recording.agents, recording.event_names
    for phase in ("train", "eval"):
        for metrics in recording.iter_metrics(phase):
            values = training_values(metrics, agents)
            if phase == "eval":
                values = evaluation_values(metrics, agents, events) | {
                    f"training/{name}": value for name, value in values.items()
                }
            position = metrics["log_time"] // STEP_NANOSECONDS
            yield Measures(phase, position, metrics["step"], metrics["episode"], values)
    for exact in recording.optimality():
        position = exact["log_time"] // STEP_NANOSECONDS
        yield Measures("eval", position, exact["step"], exact["episode"], exact_values(exact, agents))
    if not recording.is_job:
        yield from _logged(recording)


def _logged(recording: Recording) -> Iterator[Measures]:
    """Yield the finite numbers that a loop logged."""
    for scalar in recording.decoded(SCALAR_TOPIC):
        if math.isfinite(scalar["value"]):
            position = scalar["log_time"] // STEP_NANOSECONDS
            step = scalar["step"] if scalar["phase"] == "train" else position - scalar["step"]
            values = {f"logged/{scalar['name']}": scalar["value"]}
            yield Measures(scalar["phase"], position, step, scalar["episode"], values)


def episodes(recording: Recording, phase: str) -> Iterator[Measures]:
    """Yield length and return of each episode of a phase, at its last step: `episode/return/AGENT`.

    Raises:
        RecordingError: the recording is damaged.
    """
    names = [f"episode/return/{agent}" for agent in recording.agents]
    topic = TRAIN_EPISODE if phase == "train" else EVAL_EPISODE
    for block in recording.blocks(topic):
        columns = (
            block[field].tolist() for field in ("log_time", "episode", "last_step", "length", "returns")
        )
        for time, episode, last_step, length, returns in zip(*columns, strict=True):
            position = time // STEP_NANOSECONDS
            step = last_step + 1 if phase == "train" else position - last_step - 1
            found = {"episode/length": float(length), **dict(zip(names, returns, strict=True))}
            finite = {name: value for name, value in found.items() if math.isfinite(value)}
            yield Measures(phase, position, step, episode, finite)


def training_values(metrics: Mapping[str, Any], agents: Sequence[str]) -> dict[str, float]:
    """Return how training stood, by name."""
    values: dict[str, float] = {}
    for name in _OF_TRAINING:
        values |= _named(name, metrics[name], agents)
    pairs = zip(metrics["rewards"], metrics["reward_counts"], strict=True)
    return values | {f"reward_counts/{reward:g}": float(count) for reward, count in pairs}


def evaluation_values(
    metrics: Mapping[str, Any], agents: Sequence[str], events: Sequence[str]
) -> dict[str, float]:
    """Return what came of an evaluation, by name."""
    values: dict[str, float] = {}
    for name in ("trials", "successes", "terminations"):
        if name != "successes" or metrics[name] >= 0:
            values |= _named(name, metrics[name], agents)
    for metric in METRICS:
        values |= _named(metric.name, metrics[metric.field], agents)
    return values | _named("events", metrics["events"], events)


def exact_values(exact: Mapping[str, Any], agents: Sequence[str]) -> dict[str, float]:
    """Return the exact measures of a greedy policy, by name."""
    values: dict[str, float] = {}
    for field, name in _EXACT.items():
        values |= _named(f"exact/{name}", exact[field], agents)
    return values


def created(recording: Recording) -> float:
    """Return when the run began, in seconds since 1970.

    Raises:
        RecordingError: it says no time.
    """
    try:
        return datetime.fromisoformat(recording.created).timestamp()
    except (ValueError, OverflowError) as error:
        raise RecordingError(
            f"{recording.path}: found {recording.created!r}, expected the time it was made."
        ) from error


def seconds_of(position: int) -> float:
    """Return logical time in seconds."""
    return position * STEP_NANOSECONDS / 1e9


def _named(name: str, value: Any, owners: Sequence[str]) -> dict[str, float]:
    """Return one number, or one for each owner; what is unknown is left out."""
    found = (
        {f"{name}/{owner}": float(part) for owner, part in zip(owners, value, strict=True)}
        if isinstance(value, list)
        else {name: float(value)}
    )
    return {key: number for key, number in found.items() if math.isfinite(number)}
