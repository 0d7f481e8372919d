"""Message records as NumPy arrays.

The most frequent messages (`Step`, `Episode`) use fixed-width fields only and write each of them, zeros too,
so that all messages of a channel have one size: consecutive MCAP message records are then a NumPy array of
one dtype, which the kernel fills, the file stores and the reader returns, and a standard protobuf parser
still reads each message.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Final

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Pb
from mcap.opcode import Opcode
from numpy.typing import NDArray

from runner.recording.schema import EPISODE, RESET, STEP, TRANSITION, Field, MessageType, Topic

FIXED: Final[dict[int, tuple[str, int]]] = {
    Pb.TYPE_DOUBLE: ("<f8", 1),
    Pb.TYPE_SFIXED64: ("<i8", 1),
    Pb.TYPE_FIXED64: ("<u8", 1),
    Pb.TYPE_FIXED32: ("<u4", 5),
    Pb.TYPE_BOOL: ("?", 0),
}
"""Kind of a field of fixed width -> its dtype, and protobuf's wire type."""
_DELIMITED: Final = 2
"""The wire type of fields that their length precedes: bytes, and packed fields."""

HEADER: Final = [
    ("opcode", "u1"),
    ("record_length", "<u8"),
    ("channel_id", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
]
"""An MCAP message record up to its data: 31 bytes. `sequence` is not used and is 0."""

HEADER_BYTES: Final = np.dtype(HEADER).itemsize
RECORD_HEAD: Final = struct.Struct("<BQ")
"""The head of any MCAP record: opcode, and the length of its body."""
MESSAGE: Final = int(Opcode.MESSAGE)
MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")
"""`HEADER` for one message: opcode, length, channel, sequence, log time, publish time."""


def with_varying(
    dtypes: Mapping[Topic, np.dtype[np.void]], topics: Iterable[Topic], learners: int
) -> dict[Topic, np.dtype[np.void]]:
    """Return the dtypes of all steps and resets; values that vary in size are objects, which hold bytes."""
    value = np.dtype(object)
    varying = [topic for topic in topics if topic.message in (TRANSITION, RESET) and topic not in dtypes]
    return {**dtypes, **{topic: topic_dtype(topic, learners, 0, value, value) for topic in varying}}


@lru_cache(64)
def record_dtype(message: MessageType, *sizes: int | np.dtype[np.generic]) -> np.dtype[np.void]:
    """Return the dtype of a whole MCAP message record of a fixed-width message.

    Fields named `tag…` hold protobuf's constant bytes (see `blank_records`).

    Args:
        sizes: of each repeated field the number of elements, of each bytes field its dtype, in order.
    """
    remaining = iter(sizes)
    layout: list[tuple[object, ...]] = list(HEADER)
    for field in message.fields:
        if field.kind == Pb.TYPE_BYTES:
            value = np.dtype(next(remaining))  # type: ignore[arg-type]
        elif field.repeated:
            value = np.dtype((FIXED[field.kind][0], (next(remaining),)))
        else:
            value = np.dtype(FIXED[field.kind][0])
        layout += [(f"tag_{field.name}", "u1", (len(_tag(field, value)),)), (field.name, value)]
    return np.dtype(layout)


def _tag(field: Field, value: np.dtype[np.generic]) -> bytes:
    """Return the constant bytes before a field's value: tag, and its length if it is bytes or packed."""
    if not field.repeated and field.kind != Pb.TYPE_BYTES:
        return bytes([field.number << 3 | FIXED[field.kind][1]])
    return bytes([field.number << 3 | _DELIMITED]) + varint(value.itemsize)


def varint(number: int) -> bytes:
    """Return a number as protobuf writes lengths: seven bits a byte, the lowest first."""
    low = []
    while number >= 128:
        low.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*low, number])


def blank_records(topic: Topic, dtype: np.dtype[np.void], n: int) -> NDArray[np.void]:
    """Return n message records of the topic with every constant byte set and every value 0.

    Records with objects are not those of a file, and have no constant bytes.
    """
    if dtype.hasobject:
        return np.zeros(n, dtype)
    return np.frombuffer(bytearray(_blank_record(topic, dtype)) * n, dtype)


@lru_cache(64)
def _blank_record(topic: Topic, dtype: np.dtype[np.void]) -> bytes:
    one = np.zeros((), dtype=dtype)
    one["opcode"] = MESSAGE
    one["record_length"] = dtype.itemsize - RECORD_HEAD.size
    one["channel_id"] = topic.channel
    for field in topic.message.fields:
        one[f"tag_{field.name}"] = list(_tag(field, dtype[field.name]))
    return one.tobytes()


def message_record(topic: Topic, log_time: int, payload: bytes) -> bytes:
    """Return the whole message record of one message, logged at a time in nanoseconds."""
    length = HEADER_BYTES - RECORD_HEAD.size + len(payload)
    return MESSAGE_HEAD.pack(MESSAGE, length, topic.channel, 0, log_time, log_time) + payload


def topic_dtype(
    topic: Topic,
    learners: int,
    events: int,
    action: np.dtype[np.generic] | None = None,
    observation: np.dtype[np.generic] | None = None,
) -> np.dtype[np.void]:
    """Return the dtype of a topic's message records in a run; spaces are those of a loop."""
    sizes: dict[MessageType, tuple[int | np.dtype[np.generic] | None, ...]] = {
        STEP: (learners,),
        EPISODE: (learners, events),
        TRANSITION: (action, observation, learners),
        RESET: (observation,),
    }
    given = [size for size in sizes[topic.message] if size is not None]
    assert len(given) == len(sizes[topic.message]), f"{topic.message.name} needs the dtypes of its spaces"
    return record_dtype(topic.message, *given)
