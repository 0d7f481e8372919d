"""The clock of a recording: how much time had passed after how many steps.

`/clock` has a sample about once a second. A session is the time in which one process records; the pause
before a run is resumed does not count.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.messages import encode
from runner.recording.reader import Recording
from runner.recording.schema import STEP_NANOSECONDS
from runner.util.arrays import Floats, Ints

SAMPLE_SECONDS: Final = 1.0
_SAMPLES_A_DURATION: Final = 3600
"""After an hour samples become rarer, so that their interval stays this fraction of the duration."""
MAX_SAMPLES: Final = 1 << 20
_MAX_SECONDS: Final = 1e10


def interval(seconds: float) -> float:
    """Return after how many seconds the next sample is due in a session that has lasted `seconds`."""
    return max(SAMPLE_SECONDS, seconds / _SAMPLES_A_DURATION)


class Stopwatch:
    """Measures a session, which begins at the first call of `begin`."""

    def __init__(self) -> None:
        self.started = 0.0
        """When the session began, in seconds since 1970, UTC."""
        self._origin: float | None = None
        self._next = 0.0

    def begin(self) -> bool:
        """Begin the session, unless it has begun; return whether it begins now."""
        if self._origin is not None:
            return False
        self.started = time.time()
        self._origin = time.monotonic()
        self._next = SAMPLE_SECONDS
        return True

    def is_due(self) -> bool:
        """Return whether it is time for another sample, and plan the next one."""
        if self.seconds < self._next:
            return False
        self._next = self.seconds + interval(self.seconds)
        return True

    @property
    def has_begun(self) -> bool:
        """Whether the session has begun."""
        return self._origin is not None

    @property
    def seconds(self) -> float:
        """Seconds since the beginning of the session; 0 before."""
        return 0.0 if self._origin is None else time.monotonic() - self._origin

    def seconds_at(self, monotonic: float) -> float:
        """Return the seconds since the beginning of the session at a time of `time.monotonic`."""
        return -math.inf if self._origin is None else monotonic - self._origin

    def sample(self) -> bytes:
        """Return a `dualtaxi.Clock`: the time now."""
        return encode(schema.CLOCK, {"started": self.started, "seconds": self.seconds})


@dataclass(frozen=True, eq=False)
class Clock:
    """How much time had passed after how many steps, without pauses before a run was resumed."""

    positions: Ints
    """[samples], never decreasing: steps executed so far, of training and evaluation together."""
    seconds: Floats
    """[samples], never decreasing."""
    started: Floats
    """[samples]: when the session of the sample began, in seconds since 1970, UTC."""
    earlier: Mapping[float, float] = field(default_factory=dict)
    """When each session began -> the seconds that had been recorded before."""

    @property
    def duration(self) -> float:
        """The seconds that were recorded."""
        return float(self.seconds[-1])

    @property
    def steps_a_second(self) -> float | None:
        """The mean rate, of training and evaluation together; None if no step or no time was recorded."""
        steps = int(self.positions[-1] - self.positions[0])
        return steps / self.duration if steps and self.duration > 0 else None

    def seconds_at(self, positions: Ints) -> Floats:
        """Return the seconds that had passed at each number of steps, interpolated between samples.

        Args:
            positions: [n], numbers of steps of training and evaluation together: of any message
                `log_time // STEP_NANOSECONDS`. After the last sample time stands still.
        """
        after = np.searchsorted(self.positions, positions, side="left")
        i = np.minimum(after, len(self.positions) - 1)
        before = np.maximum(after - 1, 0)
        gap = self.positions[i] - self.positions[before]
        done = (np.asarray(positions) - self.positions[before]) / np.maximum(gap, 1)
        passed = self.seconds[i] - self.seconds[before]
        return np.asarray(self.seconds[before] + np.clip(done, 0.0, 1.0) * passed)

    def run_seconds(self, started: Floats, seconds: Floats) -> Floats:
        """Return the seconds of the run for seconds of its sessions, [n]; `started` are their beginnings."""
        return seconds + [self.earlier.get(start, 0.0) for start in started.tolist()]


def read_clock(recording: Recording) -> Clock | None:
    """Return the clock of a recording; None if it has no samples.

    Raises:
        RecordingError: samples are damaged, or more than 1,048,576.
    """
    rows: list[tuple[int, float, float]] = []
    for fields in recording.table(schema.CLOCK_TOPIC).decoded(max_bytes=1024):
        row = (fields["log_time"] // STEP_NANOSECONDS, fields["seconds"], fields["started"])
        if len(rows) == MAX_SAMPLES or not all(map(math.isfinite, row)) or not 0 <= row[1] < _MAX_SECONDS:
            raise RecordingError(
                f"{recording.path}: {schema.CLOCK_TOPIC.name}: found {fields['seconds']} seconds in sample "
                f"{len(rows)}, expected at most {MAX_SAMPLES:,} samples of less than {_MAX_SECONDS:g} s."
            )
        rows.append(row)
    if not rows:
        return None
    positions = np.array([row[0] for row in rows], np.int64)
    seconds, started = np.array([row[1:] for row in rows]).T
    ends = np.flatnonzero(started[1:] != started[:-1])
    earlier = np.zeros(len(rows))
    earlier[ends + 1] = seconds[ends]
    earlier = np.cumsum(earlier)
    seconds = seconds + earlier
    if (np.diff(positions) < 0).any() or (np.diff(seconds) < 0).any():
        raise RecordingError(f"{recording.path}: {schema.CLOCK_TOPIC.name}: found a clock that goes back.")
    return Clock(positions, seconds, started, dict(zip(started.tolist(), earlier.tolist(), strict=True)))
