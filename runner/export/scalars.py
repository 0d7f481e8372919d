"""A run's metrics as named numbers over training steps: what metric stores and spreadsheets take.

    train/mean_length, train/percent_filled/taxi_1, train/reward_counts/-1, train/epsilon, ...
    eval/success_percent, eval/mean_return/taxi_1, eval/events/taxi_1.drop_off, eval/training/epsilon, ...
    eval/exact/value/taxi_1, eval/exact/optimal_value, ... with `evaluation: {exact: true}`
    train/logged/loss, ... logged by a loop
    train/episode/length, train/episode/return/taxi_1, ... of each episode

Unknown values (a mean over no episode, success where the environment does not define it) are left out, so
every number is one that was recorded, unchanged.

TensorBoard's event file has the same numbers, and is the same whenever it is written: an event's wall time is
that of the recorded clock; without one, when the run began, plus logical time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np

from runner.analysis.series import training_steps_before
from runner.recording import schema
from runner.recording.machine import read_clock
from runner.recording.messages import Message
from runner.recording.metrics import METRICS
from runner.recording.reader import Recording
from runner.recording.schema import PHASES, SCALAR_TOPIC, STEP_NANOSECONDS
from runner.util.extras import require

_TRAINING: Final = ("mean_length", "zero_cells", "percent_filled", "epsilon", "step_size", "discount")
_EVALUATION: Final = {
    **{name: name for name in ("trials", "successes", "terminations")},
    **{metric.name: metric.field for metric in METRICS},
}
_EXACT: Final = {
    **{name: name for name in ("success_percent", "timeout_percent", "mean_length", "mean_penalties")},
    **{"mean_return": "mean_returns", "value": "values", "best_response": "best_responses"},
    **{f"optimal_{name}": f"optimal_{name}" for name in ("value", "success_percent", "mean_length")},
}
"""Name to field of a message, for each kind of metrics."""

EVENT_FILES: Final = ("events.out.tfevents.*",)


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
    """Training episodes finished; for values that a loop logged in evaluation, episodes of evaluation."""
    values: Mapping[str, float]
    """By name, without the phase."""

    @property
    def by_phase(self) -> dict[str, float]:
        """The values by name, with the phase: `train/epsilon`."""
        return {f"{self.phase}/{name}": value for name, value in self.values.items()}


def measures(recording: Recording) -> Iterator[Measures]:
    """Yield reports of training, evaluations, their exact metrics, and the values that a loop logged."""
    agents = recording.agents
    exact_values = {f"exact/{name}": field for name, field in _EXACT.items()}
    for phase in PHASES:
        for row in recording.phase(phase).metrics.decoded():
            values = _named(row, {name: name for name in _TRAINING}, agents)
            rewards = zip(row["rewards"], row["reward_counts"], strict=True)
            values |= {f"reward_counts/{reward:g}": float(count) for reward, count in rewards}
            if phase == "eval":
                training = {f"training/{name}": value for name, value in values.items()}
                names = dict(_EVALUATION)
                if row["successes"] < 0:  # the environment does not define success
                    del names["successes"]
                events = _named(row, {"events": "events"}, recording.environment["event_names"])
                values = _named(row, names, agents) | events | training
            yield _measures(phase, row, values)
    for row in recording.table(schema.OPTIMALITY_TOPIC).decoded():
        yield _measures("eval", row, _named(row, exact_values, agents))
    for scalar in recording.table(SCALAR_TOPIC).decoded():
        if math.isfinite(scalar["value"]):
            position = scalar["log_time"] // STEP_NANOSECONDS
            step = training_steps_before(scalar)
            values = {f"logged/{scalar['name']}": scalar["value"]}
            yield Measures(scalar["phase"], position, step, scalar["episode"], values)


def episodes(recording: Recording, phase: str) -> Iterator[Measures]:
    """Yield length and return of each episode of a phase, at its last step: `episode/return/AGENT`."""
    names = ["episode/length"] + [f"episode/return/{agent}" for agent in recording.agents]
    for block in recording.phase(phase).episodes.blocks():
        columns = (
            block[field].tolist() for field in ("log_time", "episode", "last_step", "length", "returns")
        )
        for time, episode, last_step, length, returns in zip(*columns, strict=True):
            position = time // STEP_NANOSECONDS
            step = last_step + 1 if phase == "train" else position - last_step - 1
            values = zip(names, [float(length), *returns], strict=True)
            yield Measures(phase, position, step, episode, _finite(values))


def wall_clock(recording: Recording) -> Callable[[int], float] | None:
    """Return a function that returns the seconds that had passed at a position; None without a clock.

    The clock of a run that several processes recorded is that of one of them: it does not count.
    """
    clock = read_clock(recording)
    if clock is None or recording.shards:
        return None
    return lambda position: float(np.interp(position, clock.positions, clock.seconds))


def times(recording: Recording) -> Callable[[int], float]:
    """Return a function that returns the time of a position in seconds since 1970.

    Where no clock was recorded, logical time is added to the time at which the run was created.
    """
    began = recording.created.timestamp()
    passed = wall_clock(recording) or (lambda position: position * STEP_NANOSECONDS / 1e9)
    return lambda position: began + passed(position)


def _measures(phase: str, row: Message, values: Mapping[str, float]) -> Measures:
    return Measures(phase, row["log_time"] // STEP_NANOSECONDS, row["step"], row["episode"], values)


def _named(row: Message, fields: Mapping[str, str], owners: Sequence[str]) -> dict[str, float]:
    """Return the known values of fields by name; a list has a value for each owner, `NAME/OWNER`."""
    values: dict[str, float] = {}
    for name, field in fields.items():
        if isinstance(value := row.get(field), list):
            parts = zip(owners, value, strict=True)
            values |= _finite((f"{name}/{owner}", float(part)) for owner, part in parts)
        elif value is not None:
            values |= _finite([(name, float(value))])
    return values


def _finite(values: Iterable[tuple[str, float]]) -> dict[str, float]:
    return {name: value for name, value in values if math.isfinite(value)}


def require_tensorboard() -> None:
    """Check that the writer is installed."""
    require("tensorboardX", extra="tensorboard", purpose="export tensorboard")


def write_events(recording: Recording, folder: Path) -> int:
    """Write the event file of a run into a folder; return how many numbers it has.

    Each number is at its training step, under its name of `runner.export.scalars`; length and return of an
    episode are at its last step.
    """
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.proto.summary_pb2 import Summary
    from tensorboardX.record_writer import RecordWriter

    began = recording.created.timestamp()
    at = times(recording)
    count = 0
    writer = RecordWriter(str(folder / f"events.out.tfevents.{int(began)}.{recording.run_id}"))
    try:
        writer.write(Event(wall_time=began, file_version="brain.Event:2").SerializeToString())
        for moment in chain(measures(recording), episodes(recording, "train")):
            numbers = [Summary.Value(tag=name, simple_value=x) for name, x in moment.by_phase.items()]
            event = Event(wall_time=at(moment.position), step=moment.step, summary=Summary(value=numbers))
            writer.write(event.SerializeToString())
            count += len(numbers)
    finally:
        writer.close()
    return count
