"""Rerun steps, compared with the recorded ones: what differs first, and in which episode."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from runner.errors import CannotRedo, shortened
from runner.recording import schema
from runner.recording.actions import EpisodeDigests, after_step
from runner.recording.differences import first_difference, first_differing_row
from runner.recording.reader import Recording
from runner.recording.spaces import Description, Value, decode
from runner.replay.recorded import RecordedReset, ended_episode
from runner.util.arrays import Array
from runner.util.jsonable import as_json

Frame = NDArray[np.uint8]
"""A picture, [height, width, 3]."""
PlacedReset = tuple[int, RecordedReset]
"""A reset, and the row that comes after it."""
_MAX_TEXT: Final = 200


@dataclass(frozen=True)
class Difference:
    """The first value in which an environment differs from a recording."""

    phase: str
    """`train` or `eval`."""
    episode: int | None
    """The number of the episode; None if it never ended, in one of several environments."""
    t: int
    """The step of the episode, from 0."""
    step: int
    """The step of the phase, from 0."""
    environment: int
    """Which environment of a vector."""
    field: str
    """`observation[2]`, `reward`, `terminated`, ...; `first observation[2]` after a reset."""
    recorded: object
    """The value, as JSON can hold it."""
    got: object

    def __str__(self) -> str:
        """Describe the difference in a line."""
        episode = f"episode {self.episode:,}" if self.episode is not None else f"step {self.step:,}"
        return (
            f"{self.phase} {episode}, t {self.t:,}: {self.field}: recorded {_short(self.recorded)}, "
            f"got {_short(self.got)}"
        )


class Start(NamedTuple):
    """A rerun reset."""

    row: int
    """The row that comes after it."""
    reset: RecordedReset
    got: Value
    """The first observation, as `RecordedReset.observation`."""
    frame: Frame | None = None
    """The picture after the reset, if pictures are drawn."""


@dataclass(eq=False)
class Returned:
    """What an environment returned for recorded actions and resets, until it raised an error."""

    rows: NDArray[np.void]
    """The recorded steps."""
    resets: Sequence[PlacedReset]
    """In order; each comes before its row."""
    got: NDArray[np.void]
    """Records with the fields of steps that come from the environment."""
    starts: list[Start] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    """A picture for each step; of a vector, of the environment that is drawn."""
    done: int = 0
    """The rows that are filled in."""
    error: Exception | None = None


@dataclass(frozen=True, eq=False)
class RerunSteps:
    """Consecutive steps of one environment, rerun; of one or more episodes."""

    phase: str
    environment: int
    """Which environment of a vector; 0 for a single one."""
    recorded: NDArray[np.void]
    """The recorded steps, as `Steps.rows` yields them; each environment of a vector counts its episodes."""
    got: NDArray[np.void]
    """What the environment returned: the fields `next_state` or `next_observation`, `rewards`, `terminated`,
    `truncated`, and of games `agents_terminated` and `agents_truncated`, each as in a recording."""
    starts: Sequence[Start] = ()
    """The resets in the block, in order."""
    frames: Sequence[Frame] = ()
    """The picture after each step, if pictures are drawn."""
    difference: Difference | None = None
    """The first difference, in the last row, or at the reset after it; the last block has it, if any has."""

    def __len__(self) -> int:
        return len(self.recorded)

    def require_equal(self) -> Self:
        """Return these steps.

        Raises:
            CannotRedo: they differ from the recorded ones.
        """
        if self.difference is not None:
            raise CannotRedo(f"The environment is not the recorded one: {self.difference}.")
        return self


class RerunComparison:
    """Compares rerun steps with a recording.

    Args:
        tolerance: absolute and relative, for floating-point observations and rewards; 0 compares bytes.
    """

    def __init__(self, recording: Recording, tolerance: float) -> None:
        self._recording, self._tolerance = recording, tolerance or None
        self._digests = {phase: EpisodeDigests() for phase in schema.PHASES}

    def of(self, phase: str, environment: int, returned: Returned) -> RerunSteps:
        """Return the steps of an environment up to the first difference."""
        rows, got, starts, done = returned.rows, returned.got, returned.starts, returned.done
        first = self._first_row(phase, environment, rows[:done], got[:done])
        failed, differing = self._first_start(starts), None
        if first is not None and (failed is None or starts[failed].row > first[0]):
            row, name = first
            done, starts = row + 1, [start for start in starts if start.row <= row]
            differing = _place_of(rows[row]), self._values(name, rows[row], got[row])
        elif failed is not None:
            done, starts = starts[failed].row, starts[: failed + 1]
            _, reset, value, _ = starts[failed]
            field, was, now = self._observation(reset.observation, value)
            differing = _place_of_reset(reset), (f"first {field}", was, now)
        elif returned.error is not None:
            text = f"{type(returned.error).__name__}: {returned.error}"
            differing = _failed_at(returned, text), ("error", None, text)
        difference = None
        if differing is not None:
            (episode, t, step), values = differing
            number: int | None = episode
            if self._recording.environments > 1:
                number = ended_episode(self._recording, phase, environment, step)
            difference = Difference(phase, number, t, step, environment, *values)
        frames = returned.frames[:done]
        return RerunSteps(phase, environment, rows[:done], got[:done], starts, frames, difference)

    def _first_row(
        self, phase: str, environment: int, rows: NDArray[np.void], got: NDArray[np.void]
    ) -> tuple[int, str] | None:
        """Return the first row that differs, and its first field that does; None if none does."""
        names = [name for name in got.dtype.names or () if name in (rows.dtype.names or ())]
        first = first_difference(rows, got, names, self._tolerance)
        digest = self._first_digest(phase, environment, rows, got)
        return (digest, "digest") if digest is not None and (first is None or digest < first[0]) else first

    def _first_start(self, starts: Sequence[Start]) -> int | None:
        """Return the number of the first reset whose observation differs; None if none does."""
        if not starts:
            return None
        values = np.empty((2, len(starts)), self._recording.train.resets.row_dtype["observation"])
        for k, start in enumerate(starts):
            values[0, k], values[1, k] = start.reset.observation, start.got
        return first_differing_row(values[0], values[1], self._tolerance)

    def _first_digest(
        self, phase: str, environment: int, rows: NDArray[np.void], got: NDArray[np.void]
    ) -> int | None:
        """Return the first row at which the episode so far has another digest than was recorded."""
        if not len(rows) or "digest" not in (rows.dtype.names or ()):
            return None
        after, t = got[after_step(got.dtype)], rows["t"]
        recorded = np.ascontiguousarray(rows["digest"])
        marked = set(np.flatnonzero(recorded.view(np.uint8).reshape(len(rows), -1).any(axis=1)).tolist())
        ends = got["terminated"], got["truncated"]
        digests = self._digests[phase].add(environment, t, after, got["rewards"], *ends, marked)
        wrong = (row for row, digest in digests if row in marked and digest != recorded[row].tobytes())
        return next(wrong, None)

    def _values(self, name: str, recorded: np.void, got: np.void) -> tuple[str, object, object]:
        """Return a field that differs, such as `observation[2]`, and its values."""
        if name == "digest":
            return "digest of the episode so far", recorded[name].tobytes().hex(), "another one"
        if name == after_step(got.dtype):
            return self._observation(recorded[name], got[name])
        if name != "rewards":
            return name, recorded[name].item(), got[name].item()
        agents = self._recording.agents
        paid, pays = (dict(zip(agents, row[name], strict=True)) for row in (recorded, got))
        agent, was, now = differing_value(paid, pays, {}, self._tolerance)
        return f"reward{agent if len(agents) > 1 else ''}", was, now

    def _observation(self, recorded: Value, got: Value) -> tuple[str, object, object]:
        space = self._recording.spaces["observation"]
        place, recorded, got = differing_value(recorded, got, space, self._tolerance)
        return f"observation{place}", recorded, got


def _place_of(row: np.void) -> tuple[int, int, int]:
    """Return episode, step of the episode, and step of the phase."""
    return int(row["episode"]), int(row["t"]), int(row["step"])


def _place_of_reset(reset: RecordedReset) -> tuple[int, int, int]:
    return reset.episode, 0, reset.step


def _failed_at(returned: Returned, text: str) -> tuple[int, int, int]:
    """Return where an environment raised an error: in the first row or reset that it did not return from."""
    rows, done, waiting = returned.rows, returned.done, returned.resets[len(returned.starts) :]
    if waiting and (waiting[0][0] <= done or done >= len(rows)):
        return _place_of_reset(waiting[0][1])
    if not len(rows):  # another environment of the vector raised it
        raise CannotRedo(f"The vector environment fails: {text}")
    return _place_of(rows[min(done, len(rows) - 1)])


# --- values -------------------------------------------------------------------------------------------


def differing_value(
    recorded: Value, got: Value, description: Description, tolerance: float | None = None
) -> tuple[str, object, object]:
    """Return where in two observations the first difference is, such as `[2]`, and both values there.

    Args:
        recorded: a NumPy value of a space, or its bytes.
    """
    if isinstance(recorded, bytes):
        recorded, got = (decode(description, each, "an observation") for each in (recorded, got))
    for place, left, right in _leaves("", recorded, got):
        if left.shape != right.shape or left.dtype != right.dtype:
            return place, _plain(left), _plain(right)
        first = first_differing_row(left.reshape(-1), right.reshape(-1), tolerance)
        if first is not None:
            at = np.unravel_index(first, left.shape)
            index = f"[{', '.join(map(str, at))}]" if at else ""
            return place + index, _plain(left[at]), _plain(right[at])
    return "", _plain(recorded), _plain(got)


def _leaves(place: str, recorded: Value, got: Value) -> Iterator[tuple[str, Array, Array]]:
    """Yield the arrays in two values of a space, with their places."""
    names: Any = getattr(getattr(recorded, "dtype", None), "names", None)
    if names or isinstance(recorded, dict):
        for name in names or recorded:
            yield from _leaves(f"{place}[{name!r}]", recorded[name], got[name])
    elif isinstance(recorded, tuple):
        for i, (left, right) in enumerate(zip(recorded, got, strict=True)):
            yield from _leaves(f"{place}[{i}]", left, right)
    else:
        yield place, np.asarray(recorded), np.asarray(got)


def _plain(value: object) -> object:
    return as_json(value.item() if isinstance(value, np.ndarray | np.generic) and not value.shape else value)


def _short(value: object) -> str:
    text = repr(value) if isinstance(value, str) else str(value)
    return shortened(text, _MAX_TEXT)
