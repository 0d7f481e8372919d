"""The horizontal axes of metrics: training episodes, environment steps, updates, wall time, logged values.

A moment of a run is known by the training episodes and training steps before it; `Positions` returns where
such moments are on an axis. Pages, plots, reports, comparisons and exports read axes here.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runner.errors import RecordingError, RunnerError, nearest
from runner.recording.machine import read_clock
from runner.recording.reader import Recording
from runner.recording.run_file import has_environment
from runner.recording.schema import SCALAR_TOPIC, STEP_NANOSECONDS
from runner.util.arrays import Floats

Position = TypeVar("Position", int, float)

UPDATE_NAMES: Final = ("updates", "n_updates")
"""Names, or last parts of names such as `train/n_updates`, under which a loop logs its number of updates."""
_MAX_KNOWN: Final = 1 << 18


@dataclass(frozen=True)
class Axis:
    """An axis along which a run progresses."""

    name: str
    title: str
    """What it counts: `training steps`."""
    whole: bool
    """Whether its values are whole numbers."""
    unit: str = ""

    @property
    def label(self) -> str:
        """The title with its unit."""
        return f"{self.title}, {self.unit}" if self.unit else self.title

    def moment(self, value: float) -> str:
        """Return a value in words: `2,048 training steps`, `12.5 seconds of wall time`, `epoch 3`."""
        return self.length(value) if self.whole or self.unit else f"{self.title} {value:,.6g}"

    def length(self, value: float) -> str:
        """Return the length of a part of the axis in words."""
        if self.whole:
            return f"{value:,.0f} {self.title if value != 1 else self.title.removesuffix('s')}"
        return f"{value:,.6g} {self.unit} of {self.title}" if self.unit else f"{value:,.6g} of {self.title}"

    def counts(self, name: str) -> bool:
        """Return whether values logged under a name are positions on the axis."""
        return name.rpartition("/")[2] in UPDATE_NAMES if self is UPDATES else name == self.name


EPISODES: Final = Axis("episodes", "training episodes", whole=True)
STEPS: Final = Axis("steps", "training steps", whole=True)
UPDATES: Final = Axis("updates", "updates", whole=True)
TIME: Final = Axis("time", "wall time", whole=False, unit="seconds")
AXES: Final = {axis.name: axis for axis in (EPISODES, STEPS, UPDATES, TIME)}
LOGGED_STEPS: Final = Axis("steps", "steps", whole=True)
"""The steps of a run without an environment: those that were given with the values."""


def axis_of(name: str) -> Axis:
    """Return the axis of a name: one of `AXES`, or else the values logged under this name."""
    return AXES.get(name) or Axis(name, name, whole=False)


@dataclass(frozen=True)
class Positions:
    """The positions of a run's moments on an axis."""

    axis: Axis
    steps: Floats
    """Training steps at which the axis's value is known, ascending; not used for episodes and steps."""
    values: Floats
    """Its values there, which never decrease."""

    def at(self, episodes: ArrayLike, steps: ArrayLike) -> Floats:
        """Return the positions of moments by the training episodes and training steps before them."""
        if self.axis is EPISODES:
            return np.asarray(episodes, np.float64)
        taken = np.asarray(steps, np.float64)
        if self.axis.name == STEPS.name:  # also of LOGGED_STEPS
            return taken
        if self.axis is TIME:
            return np.interp(taken, self.steps, self.values)
        # a logged value holds until the next one
        return np.concatenate([[0.0], self.values])[np.searchsorted(self.steps, taken, side="right")]

    def of_moment(self, episodes: int, steps: int) -> float:
        """Return the position of one moment, an integer where the axis has whole numbers."""
        value = float(self.at(episodes, steps))
        return int(value) if self.axis.whole else value


def positions(recording: Recording, axis: Axis) -> Positions:
    """Return the positions of a recording's moments on an axis, or on the nearest one that it has.

    Raises:
        RecordingError: it has no such axis.
        RunnerError: there is none of this name.
    """
    steps, values = np.empty(0), np.empty(0)
    if axis is UPDATES and recording.eval.has_metrics:  # each training step of a job updates its tables
        axis = STEPS
    if axis in (EPISODES, STEPS):
        if not has_environment(recording.config):
            axis = LOGGED_STEPS
        elif axis is EPISODES and recording.table(SCALAR_TOPIC) and not any(recording.done().values()):
            axis = STEPS  # of values that were logged before the first step
    elif axis is TIME:
        steps, values = _times(recording)
    elif axis is not LOGGED_STEPS:
        steps, values = _logged(recording, axis)
    return Positions(axis, steps, values)


def axes_of(recording: Recording) -> list[Axis]:
    """Return the axes that a recording has: first those of `AXES`, then logged values."""
    axes: dict[Axis, None] = {}
    for axis in AXES.values():
        with contextlib.suppress(RecordingError):
            is_logged = positions(recording, axis).axis is LOGGED_STEPS
            axes[LOGGED_STEPS if is_logged else axis] = None
    return [*axes, *_logged_axes(recording)]


def _logged_axes(recording: Recording) -> list[Axis]:
    """Return an axis for each name of which no value logged in training is below the value before it."""
    latest: dict[str, tuple[int, float]] = {}
    for series, rows in recording.scalars():
        for number, _, step, _, value in rows.tolist():
            name, phase = series[number]
            if phase == "train":
                earlier_step, earlier = latest.get(name, (0, 0.0))
                ascends = step >= earlier_step and value >= earlier and math.isfinite(value)
                latest[name] = (step, value if ascends else math.inf)  # which no later value reaches
    return [axis_of(name) for name, (_, value) in latest.items() if name not in AXES and value < math.inf]


def edges_of(axis: Axis, last: float, parts: int) -> Floats:
    """Return the edges of at most `parts` stretches of 1, 2, 5, 10, ... that reach from 0 to `last`.

    Runs of about the same length have the same edges. Only an axis without whole numbers has stretches
    shorter than 1. `last` is finite and not negative.
    """
    width = round_width(max(last / parts, 1.0 if axis.whole else 0.0) or 1.0)
    return np.arange(max(math.ceil(last / width * (1 - 1e-12)), 1) + 1, dtype=np.float64) * width


def round_width(width: float) -> float:
    """Return the smallest of 1, 2, 5, 10, 20, ... that is at least a width above 0."""
    power = 10.0 ** math.floor(math.log10(width))
    return next(edge for edge in (power, 2 * power, 5 * power, 10 * power) if edge >= width * (1 - 1e-12))


def stretches_at(edges: Floats, at: Floats) -> NDArray[np.intp]:
    """Return the number of the stretch that has each position; a position at an edge ends a stretch."""
    return (np.searchsorted(edges, at) - 1).clip(0, len(edges) - 2)


def _times(recording: Recording) -> tuple[Floats, Floats]:
    """Return training steps, and the seconds that had passed when they were taken.

    The clock counts the steps of evaluations too. In a run that has any, it is read at the ends of training
    episodes, so that an evaluation is at the time at which it began.
    """
    clock = read_clock(recording)
    if clock is None or recording.shards:
        reason = "no clock was recorded"
        if recording.shards:
            reason = "several processes took its steps at the same time, and the clock is that of one"
        raise RecordingError(f"{recording.path}: has no axis of wall time: {reason}.")
    done = recording.done()
    if not done["eval_steps"]:
        return clock.positions.astype(np.float64), clock.seconds
    stride = max(1, math.ceil(done["episodes"] / _MAX_KNOWN))
    steps, values = [np.zeros(1)], [np.zeros(1)]
    for block in recording.train.episodes.blocks():
        sampled = block[block["episode"] % stride == 0]
        steps.append(sampled["last_step"] + 1.0)
        values.append(clock.seconds_at((sampled["log_time"] // STEP_NANOSECONDS).astype(np.int64)))
    if len(steps) == 1:
        return clock.positions.astype(np.float64), clock.seconds
    return np.concatenate(steps), np.concatenate(values)


def _logged(recording: Recording, axis: Axis) -> tuple[Floats, Floats]:
    """Return training steps, and the positions on an axis that the loop logged there.

    Of more than 262,144 values every second, fourth, ... is used.

    Raises:
        RecordingError: they decrease, or no updates were logged.
        RunnerError: nothing else was logged under the name.
    """
    steps: list[int] = []
    values: list[float] = []
    first, every, count = "", 1, 0
    for series, rows in recording.scalars():
        is_position = np.array([phase == "train" and axis.counts(name) for name, phase in series])
        for number, _, step, _, value in rows[is_position[rows["series"]]].tolist():
            name = series[number][0]
            first = first or name
            if name != first:  # another name that counts updates
                continue
            is_later = step >= (steps[-1] if steps else 0) and value >= (values[-1] if values else 0)
            if not (is_later and math.isfinite(value)):
                raise RecordingError(
                    f"{recording.path}: found {value:g} logged as {name!r} at training step "
                    f"{step:,}, expected numbers that do not decrease: it has no axis of "
                    f"{axis.title}."
                )
            count += 1
            if count % every == 0:
                steps.append(step)
                values.append(value)
            if len(steps) > _MAX_KNOWN:
                steps = steps[1::2]
                values = values[1::2]
                every = 2 * every
    if not steps and axis is UPDATES:
        raise RecordingError(
            f"{recording.path}: has no axis of updates: nothing was logged as {' or '.join(UPDATE_NAMES)}; "
            'rec.log("updates", COUNT) records it.'
        )
    if not steps:
        raise RunnerError(
            f"axis: found {axis.name!r}, expected one of {', '.join(AXES)}, or a name under which run "
            f"{recording.run_id} logged numbers that do not decrease.{nearest(axis.name, AXES)}"
        )
    return np.array(steps, np.float64), np.array(values, np.float64)


def first_crossing(points: Mapping[Position, float], level: float, rising: bool | None) -> Position | None:
    """Return the first position at which a curve has reached a level, from below if `rising`.

    Without it the side where the curve begins decides.
    """
    if rising is None:
        rising = points[min(points)] < level
    reached = (at for at in sorted(points) if (points[at] >= level if rising else points[at] <= level))
    return next(reached, None)


def mean_height(at: Sequence[float], values: Sequence[float]) -> float:
    """Return the area under a curve, by the trapezoid rule, over its span; nan for fewer than two points."""
    if len(at) < 2:
        return math.nan
    return float(np.trapezoid(values, at)) / (at[-1] - at[0])
