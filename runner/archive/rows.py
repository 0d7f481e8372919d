"""Message records as batches of columns, and back.

Records are those of the file where messages have one size. Others stand as `WHOLE` records: the time, and the
bytes of the whole message record; in between their fields are records too, in which values of varying size
are objects.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from runner.archive.columns import Shape, Table
from runner.archive.layout import PHASES
from runner.archive.values import numbers
from runner.recording import schema
from runner.recording.blocks import FIXED, HEADER_BYTES, blank_records, message_record
from runner.recording.messages import Message, decode, encode, encode_image, encode_log, log_level
from runner.recording.schema import STEP_NANOSECONDS, Field, Topic
from runner.util.arrays import Records

WHOLE: Final = np.dtype([("log_time", "<u8"), ("message", object)])
"""The dtype of messages of varying size as records."""
_TICK: Final = np.uint64(STEP_NANOSECONDS)
_MAX_POSITION: Final = 2**63 // STEP_NANOSECONDS


def batch_of(table: Table, topic: Topic, records: Records, shape: Shape) -> pa.RecordBatch:
    """Return the columns of message records.

    Raises:
        RecordingError: a message cannot be decoded.
        ValueError: a value fits into no column.
    """
    n, phases = len(records), PHASES if topic.phase in PHASES else (topic.phase,)
    columns = {
        "run_id": _constant(0, n, (shape.run_id,)),
        "phase": _constant(phases.index(topic.phase), n, phases),
        "position": pa.array((records["log_time"] // _TICK).astype(np.int64)),
    }
    fields = records if topic in shape.dtypes else _decoded(topic, records, shape)
    columns |= {column.name: column.read(fields) for column in table.messages}
    return pa.record_batch([columns[name] for name in table.columns.names], schema=table.columns)


def records_of(table: Table, topic: Topic, batch: pa.RecordBatch, shape: Shape) -> Iterator[Records]:
    """Yield the message records of rows that are all of one topic; extras in parts of one layout each.

    Raises:
        ValueError: a row has a value that no message has.
    """
    positions = numbers(batch.column("position"))
    if len(positions) and not 0 <= positions.min() <= positions.max() < _MAX_POSITION:
        raise ValueError(f"after {positions.min()} to {positions.max()} steps")
    times = positions.astype(np.uint64) * _TICK
    if topic.message is schema.EXTRA:
        starts = np.array([layout.start_time for layout in shape.extras], np.uint64)
        numbers_of_layouts = np.searchsorted(starts, times, "right") - 1
        for k in np.unique(numbers_of_layouts).tolist():
            mine = numbers_of_layouts == k
            dtype = shape.extras[k].record
            yield _filled(
                table, blank_records(topic, dtype, int(mine.sum())), times[mine], batch.filter(pa.array(mine))
            )
    elif topic in shape.dtypes:
        yield _filled(table, blank_records(topic, shape.dtypes[topic], len(times)), times, batch)
    else:
        fields = _filled(table, np.zeros(len(times), _dtype(topic, shape)), times, batch)
        yield _encoded(topic, fields, shape)


def whole(records: Records) -> NDArray[Any]:
    """Return message records as an array of their bytes, [n]."""
    if records.dtype == WHOLE:
        return records["message"]
    return records.view(f"V{records.itemsize}")


def bytes_of(records: Records) -> memoryview:
    """Return the bytes of whole message records, which follow one another."""
    if records.dtype == WHOLE:
        return memoryview(b"".join(whole(records)))
    return whole(records).data.cast("B")


def _filled(table: Table, records: Records, times: NDArray[np.uint64], batch: pa.RecordBatch) -> Records:
    """Return blank records with the values of rows."""
    records["log_time"] = times
    records["publish_time"] = times
    for column in table.messages:
        if column.write is not None:
            column.write(records, batch.column(column.name))
    return records


def _dtype(topic: Topic, shape: Shape) -> np.dtype[np.void]:
    """Return the dtype of the fields of messages of varying size."""

    def held(field: Field) -> object:
        if field.name in shape.spaces:
            return shape.spaces[field.name].dtype
        if field.repeated:
            return ("<f8", len(shape.learners)) if topic.message is schema.TRANSITION else object
        return FIXED[field.kind][0] if field.kind in FIXED else object

    times = [("log_time", "<u8"), ("publish_time", "<u8")]
    return np.dtype([*times, *((field.name, held(field)) for field in topic.message.fields)])


def _decoded(topic: Topic, records: Records, shape: Shape) -> Records:
    """Return the fields of `WHOLE` records."""
    rows = []
    for time, message in records.tolist():
        values = decode(topic.message, message[HEADER_BYTES:])
        if topic.message is schema.LOG:
            values["level"] = log_level(values["level"])
        for name in values.keys() & shape.spaces.keys():
            values[name] = shape.spaces[name].unpack(values[name])
        rows.append((time, time, *values.values()))
    return np.array(rows, _dtype(topic, shape))


def _encoded(topic: Topic, fields: Records, shape: Shape) -> Records:
    """Return the `WHOLE` records of fields."""
    columns = {field.name: fields[field.name].tolist() for field in topic.message.fields}
    for name in columns.keys() & shape.spaces.keys():
        columns[name] = shape.spaces[name].pack(fields[name])
    records = np.zeros(len(fields), WHOLE)
    records["log_time"] = fields["log_time"]
    rows = (dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True))
    records["message"] = [
        message_record(topic, time, _payload(topic, time, row))
        for time, row in zip(records["log_time"].tolist(), rows, strict=True)
    ]
    return records


def _payload(topic: Topic, time: int, row: Message) -> bytes:
    if topic.message is schema.LOG:
        return encode_log(row["message"], time / 1e9, row["level"], row["name"])
    if topic.message is schema.IMAGE:
        return encode_image(row["data"], row["format"], time // STEP_NANOSECONDS, row["frame_id"])
    return encode(topic.message, row)


def _constant(code: int, n: int, names: tuple[str, ...]) -> pa.DictionaryArray:
    return pa.DictionaryArray.from_arrays(pa.array(np.full(n, code, np.int8)), pa.array(names, pa.string()))
