"""The steps, resets and episodes of a recording as NumPy records, however they were recorded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.actions import kept_dtype, unpacked
from runner.recording.blocks import topic_dtype
from runner.recording.messages import Message
from runner.recording.topic_chunks import TopicChunks
from runner.recording.topic_reader import TopicReader

FOREVER: Final = 2**63 - 1
"""A time in nanoseconds that no message has."""
_OBJECT: Final = np.dtype(object)
_ROWS: Final = 1024
_ROWS_BYTES: Final = 16 << 20
"""The most messages of varying size in a block of `rows`, and the bytes of values with which one ends."""


class RowReader(TopicReader):
    """Reads steps, resets and episodes in blocks, in any of the layouts that they may have."""

    @property
    def has_steps(self) -> bool:
        """Whether any whole step was recorded."""
        return any(self.phase(phase).steps for phase in schema.PHASES)

    @property
    def has_actions(self) -> bool:
        """Whether any action was recorded, with its step or alone."""
        return any(self.has_actions_of(phase) for phase in schema.PHASES)

    def has_actions_of(self, phase: str) -> bool:
        """Return whether any action of a phase was recorded."""
        return bool(self.phase(phase).steps) or self.has_actions_alone(phase)

    def has_actions_alone(self, phase: str) -> bool:
        """Return whether actions of a phase were recorded without their steps."""
        return bool(self.phase(phase).actions)

    def step_count(self, phase: str) -> int:
        """Return how many steps of a phase were recorded, whole or their actions alone."""
        if not self.has_actions_alone(phase):
            return self.phase(phase).steps.count()
        actions = self.phase(phase).actions
        return max(int(one["step"] + one["count"]) for one in actions.decoded(first_chunk=len(actions) - 1))

    def actions(self, phase: str, times: range | None = None) -> Iterator[NDArray[np.void]]:
        """Yield the steps of a loop's phase of which only the actions were recorded, in blocks.

        Their fields are those of `kept_dtype`; `times` as for `rows`.

        Raises:
            RecordingError: they are damaged.
        """
        own = self.phase(phase)
        dtype, where = self.row_dtype(own.steps), f"{self.path}: {own.actions.topic.name}"
        # A message has the time of its last step.
        for fields in own.actions.decoded(times=times and range(times.start, FOREVER)):
            block = unpacked(fields, dtype, self.environments, where)
            if times is not None:
                if block["log_time"][0] >= times.stop:
                    return
                block = block[(block["log_time"] >= times.start) & (block["log_time"] < times.stop)]
            yield block

    def rows(self, table: TopicChunks, times: range | None = None) -> Iterator[NDArray[np.void]]:
        """Yield the steps, resets or episodes of a loop as records in blocks, however they are recorded.

        Values of varying size are objects: the bytes that `spaces.decode` takes. Steps whose actions alone
        were recorded have the fields of `kept_dtype`.

        Args:
            table: the steps, resets or episodes of a phase.
            times: their `log_time` in ns, from the first to before the last; None for all.

        Raises:
            RecordingError: they are damaged.
        """
        if self._are_alone(table):
            yield from self.actions(table.topic.phase, times)
        elif table.dtype is None:
            yield from self._decoded_rows(table, times)
        else:
            yield from table.blocks() if times is None else table.blocks_between(times)

    def row_dtype(self, table: TopicChunks) -> np.dtype[np.void]:
        """Return the dtype of `rows`."""
        if table.dtype is None:
            return topic_dtype(table.topic, len(self.agents), 0, _OBJECT, _OBJECT)
        return kept_dtype(table.dtype) if self._are_alone(table) else table.dtype

    def _are_alone(self, table: TopicChunks) -> bool:
        """Return whether a table holds steps, of which only the actions were recorded."""
        return table.topic.message in schema.STEP_MESSAGES and self.has_actions_alone(table.topic.phase)

    def _decoded_rows(self, table: TopicChunks, times: range | None) -> Iterator[NDArray[np.void]]:
        """Yield messages of varying size as records, their values of spaces as bytes."""
        learners, number = len(self.agents), schema.NUMBERED_BY[table.topic.message]
        dtype, size = self.row_dtype(table), 0
        messages: list[Message] = []
        for message in table.decoded(times=times):
            if len(rewards := message.get("rewards", [0.0] * learners)) != learners:
                raise RecordingError(
                    f"{self.path}: {table.topic.name}, {number} {message[number]}: found {len(rewards)} "
                    f"rewards, expected {learners}."
                )
            messages.append(message)
            size += sum(len(value) for value in message.values() if isinstance(value, bytes))
            if len(messages) == _ROWS or size > _ROWS_BYTES:
                yield _records_of(messages, dtype)
                messages, size = [], 0
        if messages:
            yield _records_of(messages, dtype)

    def whole_steps(self, phase: str) -> int:
        """Return how many steps of a loop's phase are known to have their resets.

        In a recording that was cut off these are the steps up to the first end of an episode after its last
        reset: what comes later may lack its reset, since topics are written one after the other.
        """
        n, total = self.environments, self.step_count(phase)
        if "content_digest" in self.result:
            return total
        own, last = self.phase(phase), None
        start = own.resets.entry(len(own.resets) - 1).start_time if own.resets else FOREVER
        for resets in self.rows(own.resets, range(start, FOREVER)):
            last = resets[-1]
        if last is None:
            return 0
        for block in self.rows(own.steps, range(int(last["log_time"]), FOREVER)):
            over = (block["terminated"] | block["truncated"]) & (block["step"] >= last["step"])
            if over.any():
                return min(int(block["step"][np.argmax(over)]) // n * n + n, total // n * n)
        return total // n * n

    @property
    def last_step_time(self) -> int:
        """The `log_time` of the last step in a recording that was cut: later resets lost their steps."""
        if "content_digest" in self.result or any(map(self.has_actions_alone, schema.PHASES)):
            return FOREVER
        chunks = [self.phase(phase).steps for phase in schema.PHASES]
        return max((own.entry(len(own) - 1).end_time for own in chunks if own), default=0)


def _records_of(messages: Sequence[Message], dtype: np.dtype[np.void]) -> NDArray[np.void]:
    records = np.zeros(len(messages), dtype)
    for name in messages[0]:
        records[name] = [message[name] for message in messages]
    return records
