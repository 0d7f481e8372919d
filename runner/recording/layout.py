"""The messages of a run: their fields, by learners, events and spaces; message records as NumPy arrays.

A step over states has `state`, `action` and `next_state`; in other spaces `action` and `next_observation`
have the types of the spaces' values, with a field for each part of a `Dict` or `Tuple` (`fields`).

The most frequent messages (steps, resets, episodes) write every field, zeros too. Unless they have values of
varying size, all messages of a channel have one size then: consecutive MCAP message records are a NumPy array
of one dtype, which the kernel fills, the file stores and the reader returns, and any Protobuf parser still
reads each message.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Pb
from mcap.opcode import Opcode
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.fields import Field, space_field
from runner.recording.schema import MessageType, Topic
from runner.util.arrays import DType, Flags, RecordDType, Records, Unsigned
from runner.util.values import Json, is_whole

_MAX_STATES: Final = 2**32
"""The most states and the most actions that steps over states number."""
DTYPE_OF: Final[Mapping[int, str]] = {
    Pb.TYPE_DOUBLE: "<f8",
    Pb.TYPE_SFIXED64: "<i8",
    Pb.TYPE_FIXED64: "<u8",
    Pb.TYPE_FIXED32: "<u4",
    Pb.TYPE_BOOL: "?",
}
"""The dtype of each type of numbers in Protobuf."""
MAGIC: Final = b"\x89MCAP0\r\n"
"""The first and the last bytes of an MCAP file; `mcap.writer`, which has them too, takes 20 ms to load."""
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


@dataclass(frozen=True)
class Layout:
    """What the messages of a run depend on."""

    kind: str
    """A key of `schema.KINDS`."""
    learners: int
    events: int
    spaces: str = ""
    """The descriptions of the `observation` and the `action` space as JSON; empty for a job."""
    has_turns: bool = False
    """Whether environments take turns, so that steps and episodes name theirs."""

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The topics of its recordings."""
        return schema.KINDS[self.kind]

    @cached_property
    def has_states(self) -> bool:
        """Whether its steps are over states: both spaces are `Discrete`; else over values of its spaces."""
        spaces = json.loads(self.spaces or "null")
        return not spaces or all(
            spaces[name].get("type") == "Discrete" and is_whole(spaces[name].get("n"), 1, _MAX_STATES)
            for name in ("observation", "action")
        )

    @cached_property
    def varies(self) -> bool:
        """Whether values of its spaces vary in size."""
        return any(self.dtype(topic) is None for topic in self._messages)

    def message(self, topic: Topic) -> MessageType:
        """Return the type of a topic's messages."""
        return self._messages.get(topic, topic.message)

    def dtype(self, topic: Topic) -> RecordDType | None:
        """Return the dtype of a topic's message records in the file; None if they vary in size."""
        return record_dtype(self.message(topic))

    def row_dtype(self, topic: Topic) -> RecordDType:
        """Return the dtype in which the messages of one of `schema.ROW_TOPICS` are put down and read."""
        return row_dtype(self.message(topic))

    @cached_property
    def _messages(self) -> dict[Topic, MessageType]:
        """The messages of the topics that are put down as rows."""
        types = {"step": schema.STEP, "episode": schema.EPISODE, "reset": schema.RESET}
        if self.spaces:
            spaces: Json = json.loads(self.spaces)
            observation = space_field(1, "observation", spaces["observation"])
            types["reset"] = _with_values(schema.RESET, observation)
            if not self.has_states:
                after = space_field(3, "next_observation", spaces["observation"])
                types["step"] = _with_values(schema.STEP, space_field(2, "action", spaces["action"]), after)
                more = schema.AGENT_FIELDS if self.kind == "game" else ()
                types["step"] = replace(types["step"], fields=types["step"].fields + more)
        if self.has_turns:
            turns = schema.ENVIRONMENT_OF_STEP, *types["step"].fields, schema.TAKEN
            episodes = *types["episode"].fields, schema.ENVIRONMENT_OF_EPISODE
            types["step"] = replace(types["step"], fields=turns)
            types["episode"] = replace(types["episode"], fields=episodes)
        sizes = {"rewards": self.learners, "returns": self.learners, "events": self.events}
        types = {name: _sized(message, sizes) for name, message in types.items()}
        if not all(field.has_one_size for message in types.values() for field in message.values):
            for name, message in types.items():
                if message.values:  # they come last, so that the rest has one size
                    fields = tuple(sorted(message.fields, key=lambda field: field.is_value))
                    types[name] = replace(message, fields=fields, varies=True)
        return {
            topic: types[topic.name.rpartition("/")[2]] for topic in self.topics if topic in schema.ROW_TOPICS
        }


@lru_cache(64)
def layout_of(kind: str, learners: int, events: int, spaces: str = "", has_turns: bool = False) -> Layout:
    """Return a layout, the same one each time: what follows from it is computed once."""
    return Layout(kind, learners, events, spaces, has_turns)


def _with_values(message: MessageType, *values: Field) -> MessageType:
    """Return a message with values of spaces in place of states."""
    left_out = schema.OF_STATES | {"observation"}
    others = tuple(field for field in message.fields if field.name not in left_out)
    return replace(message, fields=(*values, *others))


def _sized(message: MessageType, sizes: Mapping[str, int]) -> MessageType:
    """Return a message with the dtypes of its numbers; `sizes` has the lengths of repeated ones."""
    fields = []
    for field in message.fields:
        number = None if field.is_value else DTYPE_OF.get(field.kind)
        shape = (sizes.get(field.name),) if field.repeated else ()
        fields.append(field if number is None else replace(field, dtype=np.dtype((number, shape))))
    return replace(message, fields=tuple(fields))


@lru_cache(256)
def record_dtype(message: MessageType) -> RecordDType | None:
    """Return the dtype of a whole MCAP message record of a message; None if its messages vary in size.

    Fields named `tag_…` hold Protobuf's constant bytes (see `blank_records`).
    """
    if message.varies or not all(field.has_one_size for field in message.fields):
        return None
    layout: list[tuple[object, ...]] = list(HEADER)
    for field in message.fields:
        layout += [(f"tag_{field.name}", "u1", (len(field.tag),)), (field.name, field.stored_dtype)]
    return np.dtype(layout)


@lru_cache(256)
def row_dtype(message: MessageType) -> RecordDType:
    """Return the dtype in which a message is put down and read.

    That of its records, unless these store a value in another way: then it has no constant bytes. If
    messages vary in size, the values of spaces are objects, which hold bytes as `spaces` describes them.
    """
    record = record_dtype(message)
    fields: list[tuple[str, DType]] = []
    for field in message.fields:
        is_object = record is None and field.is_value
        fields.append((field.name, np.dtype(object) if is_object else field.row_dtype))
    if record is not None and all(record[name] == dtype for name, dtype in fields):
        return record
    return np.dtype([*HEADER, *fields])


def rows_of(message: MessageType, records: Records) -> Records:
    """Return message records of one size as rows: the same memory, unless values are stored in another way.

    Raises:
        RecordingError: a number is outside of its space's dtype.
    """
    dtype = row_dtype(message)
    if dtype == records.dtype:
        return records
    rows = np.empty(len(records), dtype)
    for name in dtype.names or ():
        rows[name] = records[name]
    for field in message.fields:
        if not field.are_exact(rows[field.name], records[field.name]):
            raise RecordingError(f"{message.full_name}: found a number in {field.name} out of its range")
    return rows


def blank_records(topic: Topic, message: MessageType, n: int) -> Records:
    """Return n message records of a topic with every constant byte set and every value 0.

    Messages that vary in size are encoded when they are written: their rows have no constant bytes.
    """
    dtype = record_dtype(message)
    if dtype is None:
        return np.zeros(n, row_dtype(message))
    return np.frombuffer(bytearray(_blank_record(topic, message)) * n, dtype)


@lru_cache(64)
def constant_bytes(topic: Topic, message: MessageType) -> tuple[NDArray[np.uint8], Flags]:
    """Return a blank message record of one size, and which of its bytes after the header no value changes."""
    blank, full = (np.frombuffer(_blank_record(topic, message, fill), np.uint8) for fill in (0, 255))
    is_constant = blank == full
    is_constant[:HEADER_BYTES] = False
    return blank, is_constant


@lru_cache(256)
def _blank_record(topic: Topic, message: MessageType, fill: int = 0) -> bytes:
    """Return a message record of one size with its constant bytes, and this byte in all of its values."""
    dtype = record_dtype(message)
    assert dtype is not None
    stored = np.full(dtype.itemsize, fill, np.uint8)
    stored[:HEADER_BYTES] = 0
    record: Records = stored.view(dtype)
    record["opcode"] = MESSAGE
    record["record_length"] = dtype.itemsize - RECORD_HEAD.size
    record["channel_id"] = topic.channel
    for field in message.fields:
        record[f"tag_{field.name}"] = list(field.tag)
        field.put_constants(stored, dtype.fields[field.name][1])  # type: ignore[index]
    return stored.tobytes()


def message_record(topic: Topic, log_time: int, payload: bytes) -> bytes:
    """Return the whole message record of one message, logged at a time in nanoseconds."""
    length = HEADER_BYTES - RECORD_HEAD.size + len(payload)
    return MESSAGE_HEAD.pack(MESSAGE, length, topic.channel, 0, log_time, log_time) + payload


def lone_message(topic: Topic, log_time: int, payload: bytes) -> tuple[memoryview, Unsigned, Unsigned]:
    """Return the record of a message that has a chunk of its own, its time, and where it begins."""
    record = memoryview(message_record(topic, log_time, payload))
    return record, np.array([log_time], np.uint64), np.zeros(1, np.uint64)
