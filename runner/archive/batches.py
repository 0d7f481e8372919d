"""A recording's messages as batches of columns, and back.

Message records are those of the file where messages have one size. Others have the bytes of the whole message
record as an object, and then its fields, in which values of varying size are objects too. `Batches` checks
that each batch turns back into the same messages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa
from blake3 import blake3
from numpy.typing import NDArray

from runner.archive.columns import Shape, Table, numbers
from runner.archive.layout import Entry
from runner.errors import RecordingError, RunnerError
from runner.recording import schema
from runner.recording.layout import HEADER_BYTES, blank_records, message_record
from runner.recording.messages import Message, decode, encode, encode_image, encode_log, log_level
from runner.recording.reader import Recording, extra_layouts
from runner.recording.schema import STEP_NANOSECONDS, MessageType, Topic
from runner.recording.topic_chunks import TopicChunks
from runner.util.arrays import Records

_TICK: Final = np.uint64(STEP_NANOSECONDS)
_MAX_POSITION: Final = 2**63 // STEP_NANOSECONDS


def batch_of(
    table: Table, topic: Topic, records: Records, shape: Shape, names: Sequence[str] | None = None
) -> pa.RecordBatch:
    """Return the columns of message records; all of them, or some by name.

    Raises:
        RecordingError: a message cannot be decoded.
        ValueError: a value fits into no column.
    """
    n = len(records)
    phases = schema.PHASES if topic.phase in schema.PHASES else (topic.phase,)
    reads: dict[str, Callable[[Records], pa.Array]] = {
        "run_id": lambda _: _constant(0, n, (shape.run_id,)),
        "phase": lambda _: _constant(phases.index(topic.phase), n, phases),
        "position": lambda records: pa.array((records["log_time"] // _TICK).astype(np.int64)),
    }
    reads |= {column.name: column.read for column in table.messages}
    fields = _decoded(topic, records, shape) if records.dtype.hasobject else records
    columns = table.columns if names is None else pa.schema(map(table.columns.field, names))
    return pa.RecordBatch.from_arrays([reads[name](fields) for name in columns.names], schema=columns)


def records_of(
    table: Table, topic: Topic, batch: pa.RecordBatch, shape: Shape
) -> Iterator[tuple[Topic, Records]]:
    """Yield the message records of rows that are all of one topic, with their topic.

    Extras come in parts of one layout each, with its topic.

    Raises:
        ValueError: a row has a value that no message has.
    """
    positions = numbers(batch.column("position"))
    if len(positions) and not 0 <= positions.min() <= positions.max() < _MAX_POSITION:
        raise ValueError(f"after {positions.min()} to {positions.max()} steps")
    times = positions.astype(np.uint64) * _TICK
    layouts = [(0, topic)]
    if topic.message is schema.EXTRA:
        layouts = [
            (names.start_time, schema.extra_topic(topic.phase, names.number)) for names in shape.extras
        ]
    starts = np.array([start for start, _ in layouts], np.uint64)
    numbers_of_layouts = np.searchsorted(starts, times, "right") - 1
    for k in np.unique(numbers_of_layouts).tolist():
        mine = numbers_of_layouts == k
        own_topic = layouts[k][1]
        rows = batch if mine.all() else batch.filter(pa.array(mine))
        dtype = shape.dtypes[own_topic]
        records = (
            np.zeros(rows.num_rows, dtype)
            if dtype.hasobject
            else blank_records(own_topic, shape.messages[own_topic], rows.num_rows)
        )
        records["log_time"] = records["publish_time"] = times[mine]
        for column in table.messages:
            if column.write is not None:
                column.write(records, rows.column(column.name))
        if records.dtype.hasobject:
            _encode(own_topic, records, shape)
        yield own_topic, records


def whole(records: Records) -> NDArray[Any]:
    """Return message records as an array of their bytes, [n]."""
    if records.dtype.hasobject:
        return records["record"]
    return records.view(f"V{records.itemsize}")


def bytes_of(records: Records) -> memoryview:
    """Return the bytes of whole message records, which follow one another."""
    if records.dtype.hasobject:
        return memoryview(b"".join(whole(records)))
    return whole(records).data.cast("B")


def _decoded(topic: Topic, records: Records, shape: Shape) -> Records:
    """Return records with the fields of their messages."""
    rows = []
    for time, record in records[["log_time", "record"]].tolist():
        values = decode(shape.messages[topic], record[HEADER_BYTES:])
        if topic.message is schema.LOG:
            values["level"] = log_level(values["level"])
        for name, value in values.items():
            if (space := shape.space(topic, name)) is not None:
                values[name] = space.unpack(value)
        rows.append((time, time, record, *values.values()))
    return np.array(rows, records.dtype)


def _encode(topic: Topic, records: Records, shape: Shape) -> None:
    """Encode the fields of records, and set their messages."""
    columns = {field.name: records[field.name].tolist() for field in shape.messages[topic].fields}
    for name in columns:
        if (space := shape.space(topic, name)) is not None:
            columns[name] = space.pack(records[name])
    rows = (dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True))
    records["record"] = [
        message_record(topic, time, _payload(topic, shape.messages[topic], time, row))
        for time, row in zip(records["log_time"].tolist(), rows, strict=True)
    ]


def _payload(topic: Topic, message: MessageType, time: int, row: Message) -> bytes:
    if topic.message is schema.LOG:
        return encode_log(row["message"], time / 1e9, row["level"], row["name"])
    if topic.message is schema.IMAGE:
        return encode_image(row["data"], row["format"], time // STEP_NANOSECONDS, row["frame_id"])
    return encode(message, row)


def _constant(code: int, n: int, names: tuple[str, ...]) -> pa.DictionaryArray:
    return pa.DictionaryArray.from_arrays(pa.array(np.full(n, code, np.int8)), pa.array(names, pa.string()))


_ROWS_AT_ONCE: Final = 1024
_BYTES_AT_ONCE: Final = 4 << 20


class Batches:
    """The messages of a recording as Arrow columns; counts and hashes the messages that it yielded."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.shape = Shape(recording, list(extra_layouts(recording).values()))
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
        return sum(self._counts[name] for name in schema.STEP_TOPICS)

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

        Of messages that vary in size, only the times and the whole message records are set.
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
            number: the number of the first message.

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
