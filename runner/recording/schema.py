"""The recording format, stated once: topics, messages, fields, times and the version.

Every message is protobuf. Those that come by the million (`Step`, `Episode`) use fixed-width fields only
and write each of them, zeros too, so that a message has one size in a channel: a run of whole MCAP
message records is then a NumPy array of one dtype, the same in the kernel's output, in the file's chunks
and in the reader's hands, and a standard protobuf parser still reads each message.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Pb
from numpy.typing import NDArray

FORMAT_VERSION: Final = 0
PROFILE: Final = "dualtaxi"
STEP_NANOSECONDS: Final = 100_000_000
"""Logical time of one environment step: 0.1 s, so that playback at 1x shows ten steps a second."""

MAX_LOG_STEPS: Final = 2**63 // STEP_NANOSECONDS - 1


@dataclass(frozen=True)
class Field:
    """One field of a message; `repeated` means packed."""

    number: int
    name: str
    kind: int
    repeated: bool = False


@dataclass(frozen=True, eq=False)
class MessageType:
    """A protobuf message, with its fields in the order they are written."""

    name: str
    fields: tuple[Field, ...]
    package: str = "dualtaxi"

    @property
    def full_name(self) -> str:
        """The fully qualified protobuf name."""
        return f"{self.package}.{self.name}"


@dataclass(frozen=True, eq=False)
class Topic:
    """A topic of the recording; its channel and schema ids are the same in every recording."""

    name: str
    channel: int
    message: MessageType
    phase: str = ""
    digested: bool = True
    """Whether the content digest covers it."""


_BOOL, _BYTES, _STRING = Pb.TYPE_BOOL, Pb.TYPE_BYTES, Pb.TYPE_STRING
_DOUBLE, _FIXED32, _SFIXED64 = Pb.TYPE_DOUBLE, Pb.TYPE_FIXED32, Pb.TYPE_SFIXED64

# The order of the fields is the one that compresses best: what changes together stands together.
STEP = MessageType(
    "Step",
    (
        Field(1, "state", _FIXED32),
        Field(2, "action", _FIXED32),
        Field(3, "next_state", _FIXED32),
        Field(4, "rewards", _DOUBLE, repeated=True),
        Field(5, "step", _SFIXED64),
        Field(6, "explored", _FIXED32),
        Field(7, "episode", _SFIXED64),
        Field(8, "t", _FIXED32),
        Field(9, "terminated", _BOOL),
        Field(10, "truncated", _BOOL),
    ),
)
EPISODE = MessageType(
    "Episode",
    (
        Field(1, "episode", _SFIXED64),
        Field(2, "last_step", _SFIXED64),
        Field(3, "length", _FIXED32),
        Field(4, "penalties", _FIXED32),
        Field(5, "returns", _DOUBLE, repeated=True),
        Field(6, "events", _FIXED32, repeated=True),
        Field(7, "success", _BOOL),
        Field(8, "terminated", _BOOL),
        Field(9, "truncated", _BOOL),
    ),
)
_TRAINING_SIDE = (
    Field(1, "step", _SFIXED64),
    Field(2, "episode", _SFIXED64),
    Field(3, "mean_length", _DOUBLE),
    Field(4, "rewards", _DOUBLE, repeated=True),
    Field(5, "reward_counts", _SFIXED64, repeated=True),
    Field(6, "zero_cells", _SFIXED64, repeated=True),
    Field(7, "percent_filled", _DOUBLE, repeated=True),
    Field(8, "epsilon", _DOUBLE),
    Field(9, "step_size", _DOUBLE),
    Field(10, "discount", _DOUBLE),
)
TRAIN_METRICS = MessageType("TrainMetrics", _TRAINING_SIDE)
EVAL_METRICS = MessageType(
    "EvalMetrics",
    (
        *_TRAINING_SIDE,
        Field(11, "evaluation", _SFIXED64),
        Field(12, "trials", _SFIXED64),
        Field(13, "successes", _SFIXED64),
        Field(14, "finish_percent", _DOUBLE),
        Field(15, "eval_mean_length", _DOUBLE),
        Field(16, "mean_penalties", _DOUBLE),
        Field(17, "terminations", _SFIXED64),
        Field(18, "mean_returns", _DOUBLE, repeated=True),
        Field(19, "events", _SFIXED64, repeated=True),
    ),
)
Q_TABLE = MessageType(
    "QTable",
    (
        Field(1, "step", _SFIXED64),
        Field(2, "episode", _SFIXED64),
        Field(3, "agent", _STRING),
        Field(4, "table", _FIXED32),
        Field(5, "shape", _FIXED32, repeated=True),
        Field(6, "dtype", _STRING),
        Field(7, "data", _BYTES),
    ),
)
LOG = MessageType(
    "Log",
    (
        Field(1, "timestamp", Pb.TYPE_MESSAGE),
        Field(2, "level", Pb.TYPE_ENUM),
        Field(3, "message", _STRING),
        Field(4, "name", _STRING),
        Field(5, "file", _STRING),
        Field(6, "line", _FIXED32),
    ),
    package="foxglove",
)
"""Foxglove's own log message, so that viewers show it as text."""

LOG_LEVELS: Final = ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")

TRAIN_STEP = Topic("/train/step", 1, STEP, "train")
EVAL_STEP = Topic("/eval/step", 2, STEP, "eval")
TRAIN_EPISODE = Topic("/train/episode", 3, EPISODE, "train")
EVAL_EPISODE = Topic("/eval/episode", 4, EPISODE, "eval")
TRAIN_METRICS_TOPIC = Topic("/train/metrics", 5, TRAIN_METRICS, "train")
EVAL_METRICS_TOPIC = Topic("/eval/metrics", 6, EVAL_METRICS, "eval")
Q_TABLE_TOPIC = Topic("/q_table", 7, Q_TABLE)
LOG_TOPIC = Topic("/log", 8, LOG, digested=False)
TOPICS: Final = (
    TRAIN_STEP,
    EVAL_STEP,
    TRAIN_EPISODE,
    EVAL_EPISODE,
    TRAIN_METRICS_TOPIC,
    EVAL_METRICS_TOPIC,
    Q_TABLE_TOPIC,
    LOG_TOPIC,
)
BLOCK_TOPICS: Final = (TRAIN_STEP, EVAL_STEP, TRAIN_EPISODE, EVAL_EPISODE)
"""Topics whose messages have one size: read and written as blocks."""

PHASES: Final = {"train": (TRAIN_STEP, TRAIN_EPISODE), "eval": (EVAL_STEP, EVAL_EPISODE)}
"""The step and the episode topic of each phase."""

NUMBERED_BY: Final = {STEP: "step", EPISODE: "episode"}
"""The field that numbers the messages of a fixed-width topic, from 0."""

_WIDTH: dict[int, str] = {_DOUBLE: "<f8", _FIXED32: "<u4", _SFIXED64: "<i8", _BOOL: "?"}
_WIRE: dict[int, int] = {_DOUBLE: 1, _SFIXED64: 1, _FIXED32: 5, _BOOL: 0, _STRING: 2, _BYTES: 2}

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


@cache
def record_dtype(message: MessageType, counts: tuple[int, ...]) -> np.dtype[np.void]:
    """Return the dtype of a whole MCAP message record of a fixed-width message.

    Args:
        message: its fields must all be of fixed width.
        counts: number of elements of each repeated field, in order.

    Fields named `tag…` hold protobuf's constant bytes (see `blank_records`).
    """
    remaining = iter(counts)
    layout: list[Any] = list(HEADER)
    for field in message.fields:
        count = next(remaining) if field.repeated else 1
        layout.append((f"tag_{field.name}", "u1", (len(_tag(field, count)),)))
        width = _WIDTH[field.kind]
        layout.append((field.name, width, (count,)) if field.repeated else (field.name, width))
    return np.dtype(layout)


def _tag(field: Field, count: int) -> bytes:
    """Return the constant bytes before a field's value: tag, and the length if it is packed."""
    if not field.repeated:
        return bytes([field.number << 3 | _WIRE[field.kind]])
    size = count * np.dtype(_WIDTH[field.kind]).itemsize
    length = [size] if size < 128 else [size & 0x7F | 0x80, size >> 7]
    return bytes([field.number << 3 | 2, *length])


def blank_records(topic: Topic, counts: tuple[int, ...], n: int) -> NDArray[np.void]:
    """Return n message records of the topic with every constant byte set and every value 0."""
    dtype = record_dtype(topic.message, counts)
    one = np.zeros((), dtype=dtype)
    one["opcode"] = 5
    one["record_length"] = dtype.itemsize - 9
    one["channel_id"] = topic.channel
    remaining = iter(counts)
    for field in topic.message.fields:
        count = next(remaining) if field.repeated else 1
        one[f"tag_{field.name}"] = list(_tag(field, count))
    return np.full(n, one)


def message_record(topic: Topic, log_time: int, payload: bytes) -> bytes:
    """Return the whole message record of one message, logged at a time in nanoseconds."""
    header = np.zeros((), dtype=HEADER)
    header["opcode"], header["channel_id"] = 5, topic.channel
    header["record_length"] = HEADER_BYTES - 9 + len(payload)
    header["log_time"] = header["publish_time"] = log_time
    return header.tobytes() + payload


def block_counts(topic: Topic, learners: int, events: int) -> tuple[int, ...]:
    """Return the number of elements of the topic's repeated fields in a run."""
    return (learners,) if topic.message is STEP else (learners, events)


def file_descriptor_set(message: MessageType) -> bytes:
    """Return the schema of a message as MCAP wants it: a serialized FileDescriptorSet with its imports."""
    return descriptor_pb2.FileDescriptorSet(file=_files(message)).SerializeToString(deterministic=True)


@cache
def message_class(message: MessageType) -> Any:
    """Return the protobuf class of a message."""
    pool = descriptor_pool.DescriptorPool()
    for file in _files(message):
        pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(message.full_name))


def _files(message: MessageType) -> list[descriptor_pb2.FileDescriptorProto]:
    """Return the file that describes the message, after the files it imports."""
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{message.package}/{message.name}.proto", package=message.package, syntax="proto3"
    )
    described = file.message_type.add(name=message.name)
    imports = []
    for field in message.fields:
        added = described.field.add(
            name=field.name,
            number=field.number,
            type=field.kind,
            label=Pb.LABEL_REPEATED if field.repeated else Pb.LABEL_OPTIONAL,
        )
        if field.kind == Pb.TYPE_MESSAGE:
            added.type_name = ".google.protobuf.Timestamp"
            imports.append(_timestamp_file())
            file.dependency.append(imports[-1].name)
        elif field.kind == Pb.TYPE_ENUM:
            added.type_name = f".{message.full_name}.Level"
            levels = described.enum_type.add(name="Level")
            for number, name in enumerate(LOG_LEVELS):
                levels.value.add(name=name, number=number)
    return [*imports, file]


def _timestamp_file() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(file)
    return file
