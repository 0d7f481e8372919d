"""The steps of a phase: whole, or by their actions alone; as turns of environments.

A vector steps its environments in rounds, each in its turn. At some turns it only resets an environment: the
row is no step then, and its `taken` is false. A recording of a single environment has no such columns.

Where only actions are recorded, everything else comes again when the environment takes them. A message has a
block of consecutive steps in columns: the action, the place in the episode, the ends. The observations and
rewards are represented by digests: one for each episode up to its last step in the block. Numbers are stored
as differences from what the step before of the same environment lets expect: mostly 0. Every column is stored
byte by byte, as that compresses best.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Final

import numpy as np
from blake3 import blake3
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.messages import Message
from runner.recording.topic_chunks import FOREVER, TopicChunks, within
from runner.util.arrays import Array, Flags, Floats, Ints, RecordDType, Records


@dataclass(eq=False, kw_only=True)
class Steps(TopicChunks):
    """The steps of a phase: numbered from 0, over all environments."""

    actions: TopicChunks
    """The messages of steps of which only the actions were recorded."""
    environments: int
    """How many environments take turns."""

    @property
    def are_actions(self) -> bool:
        """Whether only the actions of the steps were recorded."""
        return bool(self.actions)

    @property
    def are_known(self) -> bool:
        """Whether any step was recorded, whole or by its action."""
        return bool(self or self.actions)

    @cached_property
    def have_turns(self) -> bool:
        """Whether environments take turns, so that a row has `environment` and `taken`."""
        return "taken" in (self.row_dtype.names or ())

    def round_of(self, number: int) -> range:
        """Return the numbers of the rows in the round of a row: environments of a vector step at once."""
        start = number - number % self.environments
        return range(start, start + self.environments)

    def taken(self) -> Iterator[Records]:
        """Yield the steps in blocks, as `rows`, without turns at which an environment was only reset."""
        return map(taken, self.rows())

    def total(self) -> int:
        """Return how many steps were recorded, whole or by their actions alone."""
        if not self.are_actions:
            return self.count()
        last = self.actions.decoded(chunks=range(len(self.actions) - 1, len(self.actions)))
        return max(int(fields["step"] + fields["count"]) for fields in last)

    @property
    def row_dtype(self) -> RecordDType:
        """The dtype of `rows`; of actions alone, `kept_dtype`."""
        return kept_dtype(super().row_dtype) if self.are_actions else super().row_dtype

    def rows(self, times: range | None = None) -> Iterator[Records]:
        """Yield the steps in blocks, in any layout; those of actions alone have the fields of `kept_dtype`.

        Args:
            times: their `log_time` in ns, from the first to before the last; None for all.

        Raises:
            RecordingError: they are damaged.
        """
        if not self.are_actions:
            return super().rows(times)
        if times is None:
            return self._unpacked()
        # A message has the time of its last step.
        blocks = self._unpacked(times=range(times.start, FOREVER))
        return within(blocks, "log_time", max(times.start, 0), max(times.stop, 0))

    def numbered(self, numbers: range) -> Iterator[Records]:
        """Yield the steps of these numbers in blocks, as `rows` does."""
        if not (self.are_actions and numbers):
            return super().numbered(numbers)
        blocks = self._unpacked(chunks=self.actions.chunks_from("step", numbers.start))
        return within(blocks, "step", numbers.start, numbers.stop)

    def rows_between(self, field: str, start: int, stop: int = FOREVER) -> Iterator[Records]:
        """Yield the steps with such values of a field that never decreases, in blocks as `rows` does."""
        if not self.are_actions:
            return super().rows_between(field, start, stop)
        return within(self._unpacked(), field, start, stop)

    def _unpacked(self, times: range | None = None, chunks: Sequence[int] | None = None) -> Iterator[Records]:
        """Yield the steps of each message with actions, as `TopicChunks.messages` selects them."""
        where = f"{self.file.path}: {self.actions.topic.name}"
        for fields in self.actions.decoded(times=times, chunks=chunks):
            yield unpacked(fields, self.row_dtype, self.environments, where)

    @cached_property
    def chunk_numbers(self) -> tuple[Ints, Ints]:
        """The number of each chunk's first step, and the number after its last."""
        if self.are_actions:
            raise RecordingError(
                f"{self.file.path}: has only the actions of the steps in {self.topic.name}: `rows` yields "
                "them, `total` counts them, and `dualtaxi rerecord` brings the whole steps back."
            )
        return super().chunk_numbers


@dataclass(frozen=True, eq=False)
class EpisodeSteps:
    """The steps of one episode, read when they are asked for."""

    table: Steps
    first: int
    """The number of its first step in the phase."""
    last: int
    """The number of its last step."""
    length: int
    environment: int = 0

    def __len__(self) -> int:
        return self.length

    @property
    def place(self) -> int:
        """The place of its environment in a round: 0 where environments follow one another."""
        return self.first - self.table.round_of(self.first).start

    def rows(self, start: int = 0, stop: int | None = None) -> Iterator[Records]:
        """Yield the steps from t = `start` to before `stop` in blocks, as `Steps.rows` does.

        Lost steps are left out.
        """
        stop = self.length if stop is None else min(stop, self.length)
        if not self.table.have_turns:
            yield from self.table.numbered(range(self.first + start, self.first + stop))
            return
        # An environment takes at most one step a row, so t = start is not before this row.
        for block in self.table.numbered(range(self.first + start, self.last + 1 if start < stop else 0)):
            is_inside = is_of_environment(block, self.environment)
            if stop - start < self.length:
                is_inside &= (block["t"] >= start) & (block["t"] < stop)
            if len(rows := block[is_inside]):
                yield rows
                if rows["t"][-1] == stop - 1:
                    return

    def one(self, t: int) -> np.void:
        """Return the step at t.

        Raises:
            RecordingError: it was lost.
        """
        for rows in self.rows(t, t + 1):
            row: np.void = rows[0]
            return row
        table = self.table
        raise RecordingError(f"{table.file.path}: {table.topic.name}: t {t:,} of an episode was lost.")

    def numbers(self) -> Ints:
        """Return the numbers of the steps in the phase."""
        if not self.table.have_turns:
            return np.arange(self.first, self.last + 1)
        return np.concatenate([np.empty(0, np.int64), *(rows["step"] for rows in self.rows())])


def aligned(blocks: Iterable[Records], n: int, stop: int | None = None) -> Iterator[tuple[Records, int]]:
    """Yield steps, up to number `stop`, in blocks of as many of each of n environments, and how many wait."""
    left: Records | None = None
    done = 0
    for block in blocks:
        rows = block if left is None or not len(left) else np.concatenate([left, block])
        if stop is not None:
            rows = rows[: max(stop - done, 0)]
        whole = len(rows) - len(rows) % n
        left = rows[whole:]
        done += whole
        yield rows[:whole], len(left)


def is_taken(rows: Records) -> Flags:
    """Return which rows are steps, and not only resets."""
    if "taken" not in (rows.dtype.names or ()):
        return np.ones(rows.shape, np.bool_)
    return np.asarray(rows["taken"].view(np.uint8) > 0)  # a damaged file may hold any byte


def taken(rows: Records) -> Records:
    """Return the rows that are steps."""
    are_steps = is_taken(rows)
    return rows if are_steps.all() else rows[are_steps]


def is_of_environment(rows: Records, environment: int) -> Flags:
    """Return which rows are steps that an environment took: all where only one was recorded."""
    if "environment" not in (rows.dtype.names or ()):
        return is_taken(rows)
    is_step: Flags = rows["environment"] == environment
    is_step &= is_taken(rows)
    return is_step


def turns_of(rows: Records) -> Iterator[tuple[int, Ints]]:
    """Yield each environment that took steps, and the places of its steps among the rows."""
    places = np.flatnonzero(is_taken(rows))
    if "environment" not in (rows.dtype.names or ()):
        yield 0, places
        return
    environment = rows["environment"][places]
    order = np.argsort(environment, kind="stable")
    edges = np.flatnonzero(np.diff(environment[order])) + 1
    for steps in np.split(places[order], edges):
        if len(steps):
            yield int(rows["environment"][steps[0]]), steps


DIGEST_BYTES: Final = 16
COLUMNS: Final = (
    "action",
    "environment",
    "taken",
    "terminated",
    "truncated",
    "episode",
    "t",
    "acted",
    "agents_terminated",
    "agents_truncated",
    "log_time",
)
"""The fields of a step that are kept, in the order of a message."""
_AS_DIFFERENCES: Final = ("environment", "episode", "t", "log_time")
"""The fields that are stored as differences from what the step before lets expect."""
MARK: Final = np.dtype([("row", "<u4"), ("digest", f"V{DIGEST_BYTES}")])
_MAX_BLOCK_BYTES: Final = 64 << 20
_MAX_STEP: Final = 1 << 62


def kept_dtype(step: RecordDType) -> RecordDType:
    """Return the dtype of steps of which the actions were recorded.

    `digest` covers the episode up to this step; it is all zeros where none was recorded.

    Args:
        step: the dtype of whole records.
    """
    columns = [(name, step[name]) for name in COLUMNS if name in (step.names or ())]
    return np.dtype([("step", "<i8"), *columns, ("digest", f"V{DIGEST_BYTES}")])


def after_step(step: RecordDType) -> str:
    """Return the name of the field of whole records with the observation after the step."""
    return "next_state" if "next_state" in (step.names or ()) else "next_observation"


class EpisodeDigests:
    """The running digests of the episodes of some environments, over what their steps brought."""

    def __init__(self) -> None:
        self._running: dict[int, blake3] = {}

    def add(
        self,
        environment: int,
        t: NDArray[np.integer],
        observations: Array,
        rewards: Floats,
        terminated: Flags,
        truncated: Flags,
        at: Iterable[int] = (),
    ) -> Iterator[tuple[int, bytes]]:
        """Yield rows of consecutive steps of an environment, each with the digest of its episode so far.

        The rows are the last of each episode, and those in `at`. Episodes whose beginning was not among the
        steps so far are left out. A digest is BLAKE3 over the steps from the first on: observation, rewards
        (float64), terminated, truncated.
        """
        rows = len(t)
        dtype = [("o", observations.dtype, observations.shape[1:]), ("r", "<f8", rewards.shape[1:])]
        steps = np.empty(rows, np.dtype([*dtype, ("e", "?", (2,))]))
        steps["o"], steps["r"] = observations, rewards
        steps["e"][:, 0], steps["e"][:, 1] = terminated, truncated
        edges = sorted({0, *np.flatnonzero(t == 0).tolist(), *(row + 1 for row in at), rows})
        data = steps.view(np.uint8).data
        size = steps.itemsize
        for first, stop in pairwise(edges):
            if t[first] == 0:
                self._running[environment] = blake3()
            if (running := self._running.get(environment)) is not None:
                running.update(data[first * size : stop * size])
                yield stop - 1, running.digest(DIGEST_BYTES)


def packed(rows: Records, n: int) -> Message:
    """Return the fields of a message with a block of steps, as `unpacked` returns them.

    Of each episode only the last digest in the block is kept.
    """
    columns = []
    for name in rows.dtype.names or ():
        if name in COLUMNS:
            values = np.ascontiguousarray(rows[name])
            if name in _AS_DIFFERENCES:
                values[n:] -= _following(rows, name, n)
            columns.append(values.view(np.uint8).reshape(len(rows), -1).T.tobytes())
    last = np.zeros(len(rows), np.bool_)  # of an episode, in the block
    digests = rows["digest"].copy().view(np.uint8).reshape(len(rows), -1)
    marked = np.asarray(digests.any(axis=1))
    for environment in range(min(n, len(rows))):
        steps = np.arange(environment, len(rows), n)
        steps = steps[marked[steps]]
        if len(steps):
            episode = rows["episode"][steps]
            last[steps] = np.append(episode[1:] != episode[:-1], True)
    marks = np.zeros(int(last.sum()), MARK)
    marks["row"] = np.flatnonzero(last)
    marks["digest"] = rows["digest"][last]
    return {
        "step": int(rows["step"][0]),
        "count": len(rows),
        "data": b"".join(columns),
        "digests": marks.tobytes(),
    }


def unpacked(fields: Message, dtype: RecordDType, n: int, where: str) -> Records:
    """Return the steps in a message.

    Args:
        n: how many environments take turns.

    Raises:
        RecordingError: the message is damaged.
    """
    count, data = fields["count"], fields["data"]
    names = [name for name in dtype.names or () if name in COLUMNS]
    width = sum(dtype[name].itemsize for name in names)
    is_whole = 0 < count * dtype.itemsize <= _MAX_BLOCK_BYTES and len(data) == count * width
    if not (is_whole and 0 <= fields["step"] < _MAX_STEP):
        raise RecordingError(f"{where}: found {len(data):,} bytes for {count:,} steps of {width} bytes")
    if len(fields["digests"]) % MARK.itemsize:
        raise RecordingError(f"{where}: found digests of {len(fields['digests']):,} bytes")
    rows = np.zeros(count, dtype)
    rows["step"] = fields["step"] + np.arange(count)
    at = 0
    for name in names:
        size = dtype[name].itemsize
        planes = np.frombuffer(data, np.uint8, count * size, at).reshape(size, count)
        values = np.ascontiguousarray(planes.T).view(dtype[name].base).reshape(count, *dtype[name].shape)
        if name in _AS_DIFFERENCES:
            values = _summed(values, rows, name, n)
        rows[name] = values
        at += count * size
    marks = np.frombuffer(fields["digests"], MARK)
    if (marks["row"] >= count).any():
        raise RecordingError(f"{where}: found the digest of a step that it does not have")
    rows["digest"][marks["row"]] = marks["digest"]
    return rows


def _following(rows: Records, name: str, n: int) -> Array:
    """Return the numbers to expect of the rows from number n on, by what their environments did before."""
    now, later = rows[:-n], rows[n:]
    if name == "episode":
        return np.asarray(now["episode"] + _is_over(now))
    if name == "t":
        return np.where(now["episode"] == later["episode"], now["t"] + is_taken(now), 0)
    return np.array(now[name])


def _summed(values: Array, rows: Records, name: str, n: int) -> Array:
    """Return the numbers whose differences from `_following` these are; rows have the columns before them."""
    n = min(n, len(rows))
    turns, sums = _rounds(rows, n), _rounds(values, n)
    begins = turns["episode"][1:] != turns["episode"][:-1]
    if name == "episode":
        sums[1:] += _is_over(turns[:-1])
    if name == "t":
        sums[1:] += is_taken(turns[:-1]) & ~begins
    sums = sums.cumsum(axis=0, dtype=values.dtype)
    if name == "t":  # as it only grows, what was summed before an episode is the largest of all before
        sums[1:] -= np.maximum.accumulate(np.where(begins, sums[:-1], 0), axis=0)
    return sums.reshape(-1)[: len(rows)]


def _rounds(values: NDArray[Any], n: int) -> NDArray[Any]:
    """Return values as [rounds, n], the last round filled with zeros."""
    padded = np.zeros(-(-len(values) // n) * n, values.dtype)
    padded[: len(values)] = values
    return padded.reshape(-1, n)


def _is_over(rows: Records) -> Flags:
    return np.asarray(rows["terminated"] | rows["truncated"])


ACTION_TOPICS: Final = (schema.TRAIN_ACTIONS, schema.EVAL_ACTIONS)
"""The topics of actions that are recorded alone."""
