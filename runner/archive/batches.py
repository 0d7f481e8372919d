"""A recording's messages as batches of columns, each checked to turn back into the same messages."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
import pyarrow as pa
from blake3 import blake3

from runner.archive.columns import Shape, Table
from runner.archive.manifest import Entry
from runner.archive.rows import batch_of, bytes_of, records_of, whole
from runner.errors import RecordingError, RunnerError
from runner.recording import schema
from runner.recording.blocks import message_record
from runner.recording.reader import Recording, extra_layouts
from runner.recording.schema import Topic
from runner.recording.topic_chunks import TopicChunks
from runner.util.arrays import Records

_ROWS_AT_ONCE: Final = 1024
_BYTES_AT_ONCE: Final = 4 << 20


class Batches:
    """The messages of a recording as Arrow columns; counts and hashes the messages that it yielded."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.shape = Shape(recording, extra_layouts(recording))
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
        return (batch for _, _, batch in self.blocks(table))

    def blocks(self, table: Table) -> Iterator[tuple[Topic, Records, pa.RecordBatch]]:
        """Yield the messages of a table by time: their topic, as records and as columns."""
        sources = {topic: self.records(topic) for topic in self.shape.topics_of(table)}
        heads = {
            topic: block for topic, blocks in sources.items() if (block := next(blocks, None)) is not None
        }
        while heads:
            topic = min(heads, key=lambda topic: int(heads[topic]["log_time"][0]))
            block = heads.pop(topic)
            others = [other["log_time"][0] for other in heads.values()]
            n = int(np.searchsorted(block["log_time"], min(others), "right")) if others else len(block)
            batch = self._checked(table, topic, block[:n], self._counts[topic.name])
            self.count(topic, bytes_of(block[:n]), n)
            yield topic, block[:n], batch
            rest = block[n:] if n < len(block) else next(sources[topic], None)
            if rest is not None:
                heads[topic] = rest

    def records(self, topic: Topic, chunks: Sequence[int] | None = None) -> Iterator[Records]:
        """Yield the messages of a topic, or of some of its chunks, as records.

        They are `WHOLE` ones if they vary in size.
        """
        stored = self.chunks_of(topic)
        if stored is None:
            return
        if not self.shape.dtypes[topic].hasobject:
            yield from stored.stored(chunks)
        else:
            messages = []
            size = 0
            for time, payload in stored.messages(chunks=chunks):
                messages.append((time, message_record(topic, time, payload)))
                size += len(payload)
                if len(messages) == _ROWS_AT_ONCE or size > _BYTES_AT_ONCE:
                    yield self._records_of(topic, messages)
                    messages = []
                    size = 0
            if messages:
                yield self._records_of(topic, messages)

    def chunks_of(self, topic: Topic) -> TopicChunks | None:
        """Return the chunks of a topic; None for a layout of extras without any."""
        if topic.message is not schema.EXTRA:
            return self._recording.table(topic)
        parts = self._recording.phase(topic.phase).extras.parts
        return next((chunks for _, chunks in parts if chunks.topic is topic), None)

    def _records_of(self, topic: Topic, messages: list[tuple[int, bytes]]) -> Records:
        """Return records that have times and message records only."""
        records = np.zeros(len(messages), self.shape.dtypes[topic])
        records["log_time"], records["record"] = zip(*messages, strict=True)
        return records

    def count(self, topic: Topic, records: bytes | memoryview, count: int) -> None:
        """Count and hash messages, given as whole message records."""
        self._hashes[topic.name].update(records)
        self._counts[topic.name] += count

    def _checked(self, table: Table, topic: Topic, records: Records, number: int) -> pa.RecordBatch:
        """Return the columns of message records, which turn back into exactly these records.

        Args:
            number: that of the first message.

        Raises:
            RecordingError: they do not: a message has what no recorder writes.
        """
        why = ""
        try:
            batch = batch_of(table, topic, records, self.shape)
            restored = list(records_of(table, topic, batch, self.shape))
            if [(source, part.dtype) for source, part in restored] == [(topic, records.dtype)]:
                differs = whole(records) != whole(restored[0][1])
                if not differs.any():
                    return batch
                number += int(differs.argmax())
        except (RecordingError, ValueError, LookupError) as error:
            if len(records) > 1:  # one by one, to name the message
                for k in range(len(records)):
                    self._checked(table, topic, records[k : k + 1], number + k)
            if isinstance(error, UnicodeEncodeError):
                raise RunnerError(
                    f"{self._recording.path}: message {number} of {topic.name} has a text with the unpaired "
                    f"surrogate {error.object[error.start]!r}, which no Parquet or CSV file can hold; it is "
                    "read in Python, by open_recording."
                ) from error
            why = f" ({error})"
        raise self.unarchivable(topic, number, why)

    def unarchivable(self, topic: Topic, number: int, why: str = "") -> RecordingError:
        """Return the error for a message that columns cannot represent."""
        return RecordingError(
            f"{self._recording.path}: message {number} of {topic.name} has what no recorder writes, so "
            f"that it cannot be archived{why}; `dualtaxi verify` names the damage."
        )
