"""The steps of a loop's recording in blocks, with the resets before them, for the check of consistency."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.recording import schema
from runner.recording.episode_log import Flags
from runner.recording.reader import Recording
from runner.recording.schema import Topic
from runner.recording.topic_chunks import TopicChunks
from runner.util.arrays import Ints

OnBlock = Callable[[Topic, NDArray[np.void]], None]
"""Called with each block of a fixed-width topic when it is read."""


class Inconsistent(Exception):
    """Something that does not follow from the rest: the message says what, and where."""


class Block(NamedTuple):
    """Steps of all environments, and the resets before them."""

    first: int
    """The number of the first step."""
    rows: NDArray[np.void]
    """[steps of each environment, environments]."""
    resets: NDArray[np.void] | None
    reset_at: tuple[Ints, Ints]
    """The place in `rows` that each reset comes before."""
    is_over: Flags
    """[like `rows`]: whether a game of several agents ended with a step without the end of any of them."""

    @property
    def was_reset(self) -> Flags:
        """[like `rows`]: whether a reset came before a step."""
        was_reset = np.zeros(self.rows.shape, np.bool_)
        was_reset[self.reset_at] = True
        return was_reset


def aligned(
    blocks: Iterable[NDArray[np.void]], n: int, stop: int | None = None
) -> Iterator[tuple[NDArray[np.void], int]]:
    """Yield steps, up to number `stop`, in blocks of as many of each of n environments, and how many wait."""
    left: NDArray[np.void] | None = None
    done = 0
    for block in blocks:
        rows = block if left is None or not len(left) else np.concatenate([left, block])
        if stop is not None:
            rows = rows[: max(stop - done, 0)]
        whole = len(rows) - len(rows) % n
        left = rows[whole:]
        done += whole
        yield rows[:whole], len(left)


class Blocks:
    """The blocks of a phase, each of whole steps of all environments.

    Args:
        complete: whether the recording was completed; else the blocks end at its last reset.
    """

    def __init__(self, recording: Recording, phase: str, complete: bool, on_block: OnBlock) -> None:
        self._recording, self._phase, self._complete = recording, recording.phase(phase), complete
        self._n = recording.environments
        self.resets = Queue(records_of(recording, self._phase.resets, on_block))
        self.episodes = Queue(records_of(recording, self._phase.episodes, on_block))
        self._steps = records_of(recording, self._phase.steps, on_block)
        self.steps = 0
        """Steps in the blocks so far."""

    def __iter__(self) -> Iterator[Block]:
        stop = None
        if not self._complete:  # the number of the step after the last recorded reset
            blocks = records_of(self._recording, self._phase.resets)
            stop = max((int(block["step"][-1]) for block in blocks), default=0)
        left = 0
        for rows, waiting in aligned(self._steps, self._n, stop):
            left = waiting
            if len(rows):
                yield self._block(self.steps, rows)
                self.steps += len(rows)
        if left and self._complete:
            raise Inconsistent(
                f"{self._phase.steps.topic.name}: found {self.steps + left} steps, expected as many of each "
                f"of the {self._n} environments"
            )

    def _block(self, first: int, rows: NDArray[np.void]) -> Block:
        n, is_over = self._n, np.zeros(len(rows), np.bool_)
        # A game of several agents may end without the end of any of them: its episode record says so.
        if len(self._recording.agents) > 1 and n == 1:
            for block in self.episodes.peek_while("last_step", first + len(rows)):
                silent = ~(block["terminated"] | block["truncated"]) & (block["last_step"] >= first)
                is_over[block["last_step"][silent] - first] = True
        resets, at = self.resets.take_while("step", first + len(rows)), (np.empty(0, np.int64),) * 2
        if resets is not None and len(resets):
            step, environment = resets["step"], resets["environment"].astype(np.int64)
            if ((environment >= self._recording.own_environments) | (step % n != 0) | (step < first)).any():
                where = self._phase.resets.topic.name
                raise Inconsistent(f"{where}: found resets out of order, or of no environment")
            at = (step - first) // n, environment % n
        return Block(first, rows.reshape(-1, n), resets, at, is_over.reshape(-1, n))


def check_without_steps(recording: Recording, phase: str, on_block: OnBlock) -> int:
    """Check the numbers of resets, episodes and actions of a phase whose whole steps were left out.

    Returns the time of its last recorded action in nanoseconds, 0 without any.

    Raises:
        Inconsistent: they are not numbered consecutively.
    """
    own = recording.phase(phase)
    for table in (own.resets, own.episodes):
        for _ in records_of(recording, table, on_block):
            pass
    expected = 0
    last = 0
    for rows in recording.phase(phase).steps.rows():
        if rows["step"][0] != expected or (np.diff(rows["log_time"].astype(np.int64)) <= 0).any():
            raise Inconsistent(
                f"{own.steps.actions.topic.name}: found step {rows['step'][0]:,}, expected {expected:,}"
            )
        expected, last = expected + len(rows), int(rows["log_time"][-1])
    return last


class Queue:
    """The records of a topic in order, taken as they are needed."""

    def __init__(self, blocks: Iterator[NDArray[np.void]]) -> None:
        self._blocks = (block for block in blocks if len(block))
        self._held: list[NDArray[np.void]] = []

    def take(self, count: int) -> NDArray[np.void] | None:
        """Return the next records, at most `count`; None if there are none."""
        while sum(map(len, self._held)) < count and self._read():
            continue
        if not self._held:
            return None
        whole = np.concatenate(self._held)
        self._held = [whole[count:]] if len(whole) > count else []
        return whole[:count]

    def take_while(self, name: str, stop: int) -> NDArray[np.void] | None:
        """Return the next records whose field is below `stop`; the field never decreases."""
        return self.take(sum(len(part) for part in self.peek_while(name, stop)))

    def peek_while(self, name: str, stop: int) -> list[NDArray[np.void]]:
        """Return the same records in parts, and leave them in the queue."""
        while (not self._held or self._held[-1][name][-1] < stop) and self._read():
            continue
        parts = []
        for part in self._held:
            after = np.flatnonzero(part[name] >= stop)
            parts.append(part[: after[0]] if after.size else part)
            if after.size:
                break
        return parts

    def drain(self) -> None:
        """Read all remaining records, and drop them."""
        self._held = []
        for _ in self._blocks:
            pass

    def _read(self) -> bool:
        block = next(self._blocks, None)
        if block is not None:
            self._held.append(block)
        return block is not None


def records_of(
    recording: Recording, table: TopicChunks, on_block: OnBlock = lambda *_: None
) -> Iterator[NDArray[np.void]]:
    """Yield the records of a topic in blocks, as `TopicChunks.rows` does.

    Raises:
        Inconsistent: messages are not numbered consecutively, or are of actions without their steps.
    """
    topic, first = table.topic, 0
    number = schema.NUMBERED_BY[topic.message]
    if topic.message in schema.STEP_MESSAGES and recording.phase(topic.phase).steps.are_actions:
        raise Inconsistent(f"{topic.name}: found actions alone, expected whole steps as in the configuration")
    for block in table.rows():
        if table.dtype is not None:
            on_block(topic, block)
        if (wrong := np.flatnonzero(block[number] != first + np.arange(len(block)))).size:
            found, expected = block[number][wrong[0]], first + wrong[0]
            raise Inconsistent(f"{topic.name}: found {number} {found}, expected {expected}")
        yield block
        first += len(block)
