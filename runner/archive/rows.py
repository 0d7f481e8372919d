"""Message records as batches of columns, and back.

Records are those of the file where messages have one size. Others have the bytes of the whole message record
as an object, and then its fields, in which values of varying size are objects too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from runner.archive.columns import Shape, Table
from runner.archive.layout import PHASES
from runner.archive.values import numbers
from runner.recording import schema
from runner.recording.blocks import HEADER_BYTES, blank_records, message_record
from runner.recording.messages import Message, decode, encode, encode_image, encode_log, log_level
from runner.recording.schema import STEP_NANOSECONDS, MessageType, Topic
from runner.util.arrays import Records

_TICK: Final = np.uint64(STEP_NANOSECONDS)
_MAX_POSITION: Final = 2**63 // STEP_NANOSECONDS


def batch_of(
    table: Table, topic: Topic, records: Records, shape: Shape, names: Sequence[str] | None = None
) -> pa.RecordBatch:
    """Return the columns of message records; all of them, or those of some names.

    Raises:
        RecordingError: a message cannot be decoded.
        ValueError: a value fits into no column.
    """
    n = len(records)
    phases = PHASES if topic.phase in PHASES else (topic.phase,)
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
    """Set the messages of records to those of their fields."""
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
