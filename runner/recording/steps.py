"""The steps of a phase, whole or by their actions alone."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from runner.errors import RecordingError
from runner.recording.actions import kept_dtype, unpacked
from runner.recording.topic_chunks import FOREVER, TopicChunks, within
from runner.recording.turns import is_of_environment, taken
from runner.util.arrays import Ints, RecordDType, Records


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
