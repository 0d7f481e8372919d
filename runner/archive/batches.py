"""A recording's messages as batches of columns, each checked to turn back into the same messages."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from typing import Final

import numpy as np
import pyarrow as pa
from blake3 import blake3

from runner.archive.columns import Shape, checked_batch, record_bytes, shape_of
from runner.archive.layout import Records, Table
from runner.archive.manifest import Entry
from runner.archive.rows import message_payload, message_row
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.blocks import message_record
from runner.recording.reader import Recording
from runner.recording.schema import STEP_NANOSECONDS, Topic
from runner.util.values import Json

_ROWS_AT_ONCE: Final = 1024
_BYTES_AT_ONCE: Final = 4 << 20


class Batches:
    """The messages of a recording as Arrow columns; counts and hashes the messages that it yielded."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._where = str(recording.path)
        mdp = recording.mdp if recording.tabular else None
        extras = tuple(recording.extra_layouts)
        self.shape: Shape = shape_of(recording.run, mdp, self._where, extras)
        self._hashes = {topic.name: blake3() for topic in recording.topics}
        self._counts = dict.fromkeys(self._hashes, 0)

    @property
    def entries(self) -> dict[str, Entry]:
        """Number and hash of the messages that were yielded, by topic."""
        return {
            name: Entry(count, self._hashes[name].hexdigest())
            for name, count in self._counts.items()
            if count
        }

    @property
    def steps(self) -> int:
        """The number of steps that were yielded."""
        return self._counts["/train/step"] + self._counts["/eval/step"]

    def of(self, table: Table) -> Iterator[pa.RecordBatch]:
        """Yield the rows of a table in the order in which they were recorded."""
        if table.topics[0] in self.shape.dtypes:
            yield from (batch for _, _, batch in self.blocks(table))
            return
        rows: list[Json] = []
        size = 0
        merged_rows = heapq.merge(*map(self._rows, table.topics), key=lambda pair: pair[0]["position"])
        for row, message_size in merged_rows:
            rows.append(row)
            size += message_size
            if len(rows) == _ROWS_AT_ONCE or size > _BYTES_AT_ONCE:
                yield pa.RecordBatch.from_pylist(rows, table.columns)
                rows, size = [], 0
        if rows:
            yield pa.RecordBatch.from_pylist(rows, table.columns)

    def blocks(self, table: Table) -> Iterator[tuple[Topic, Records, pa.RecordBatch]]:
        """Yield the messages of a fixed-width table: their topic, as records and as columns."""
        train, evaluation = table.topics
        for topic, records in _merged(self._recording, (train, evaluation)):
            batch = checked_batch(topic, records, self.shape, self._where)
            self._count(topic, record_bytes(records), len(records))
            yield topic, records, batch

    def messages(self, topic: Topic) -> Iterator[tuple[int, bytes]]:
        """Yield position and payload of a topic's messages."""
        for time, payload in self._recording.table(topic).messages():
            position, rest = divmod(time, STEP_NANOSECONDS)
            if rest:
                raise self._unarchivable(topic, f"at {time} ns")
            self._count(topic, message_record(topic, time, payload), 1)
            yield position, payload

    def compare(self, topic: Topic, position: int, restored: bytes, payload: bytes) -> None:
        """Compare a payload with the one restored from its columns."""
        if restored != payload:
            raise self._unarchivable(topic, f"after {position} steps")

    def _unarchivable(self, topic: Topic, place: str, why: str = "") -> RecordingError:
        """Return the error for a message that columns cannot represent."""
        return RecordingError(
            f"{self._where}: {topic.name} {place}: found a message that no recorder writes, so that it "
            f"cannot be archived{why}; `dualtaxi verify` names the damage."
        )

    def _rows(self, topic: Topic) -> Iterator[tuple[Json, int]]:
        """Yield a row for each message, and the message's size in bytes."""
        for position, payload in self.messages(topic):
            try:
                row = message_row(topic, payload, self.shape)
                restored = message_payload(topic, position, row, self.shape)
            except (RecordingError, ValueError, LookupError) as error:
                raise self._unarchivable(topic, f"after {position} steps", f" ({error})") from error
            self.compare(topic, position, restored, payload)
            yield row | {"run_id": self.shape.run_id, "position": position}, len(payload)

    def _count(self, topic: Topic, records: bytes | memoryview, count: int) -> None:
        self._hashes[topic.name].update(records)
        self._counts[topic.name] += count


def _merged(recording: Recording, topics: tuple[Topic, Topic]) -> Iterator[tuple[Topic, Records]]:
    """Yield the messages of two topics of one size, of training and evaluation, as they were recorded."""
    heads = []
    for topic in topics:
        is_extra = topic.message is schema.EXTRA
        blocks = recording.phase(topic.phase).extras.blocks() if is_extra else recording.table(topic).blocks()
        if (block := next(blocks, None)) is not None:
            heads.append((topic, block, blocks))
    while len(heads) == 2:
        heads.sort(key=lambda head: int(head[1]["log_time"][0]))
        (topic, block, blocks), (_, other, _) = heads
        n = max(int(np.searchsorted(block["log_time"], other["log_time"][0])), 1)
        yield topic, block[:n]
        rest = block[n:] if n < len(block) else next(blocks, None)
        heads[:1] = [] if rest is None else [(topic, rest, blocks)]
    for topic, block, blocks in heads:
        yield topic, block
        yield from ((topic, further) for further in blocks)
