"""The recording format, stated once: topics, messages, fields, times and the version.

Every message is protobuf. Those that come by the million (`Step`, `Episode`) use fixed-width fields only
and write each of them, zeros too, so that a message has one size in a channel: a run of whole MCAP
message records is then a NumPy array of one dtype, the same in the kernel's output, in the file's chunks
and in the reader's hands, and a standard protobuf parser still reads each message.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, Final

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Pb
from numpy.typing import NDArray

FORMAT_VERSION: Final = 1
PROFILE: Final = "dualtaxi"
STEP_NANOSECONDS: Final = 100_000_000
"""Logical time of one environment step: 0.1 s, so that playback at 1x shows ten steps a second."""


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
_FIXED64 = Pb.TYPE_FIXED64

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
OPTIMALITY = MessageType(
    "Optimality",
    (
        Field(1, "step", _SFIXED64),
        Field(2, "episode", _SFIXED64),
        Field(3, "evaluation", _SFIXED64),
        Field(4, "starts", _SFIXED64),
        Field(5, "finish_percent", _DOUBLE),
        Field(6, "timeout_percent", _DOUBLE),
        Field(7, "mean_length", _DOUBLE),
        Field(8, "mean_penalties", _DOUBLE),
        Field(9, "mean_returns", _DOUBLE, repeated=True),
        Field(10, "values", _DOUBLE, repeated=True),
        Field(11, "best_responses", _DOUBLE, repeated=True),
        Field(12, "optimal_value", _DOUBLE),
        Field(13, "optimal_finish_percent", _DOUBLE),
        Field(14, "optimal_mean_length", _DOUBLE),
        Field(15, "cycle_states", _SFIXED64, repeated=True),
        Field(16, "cycle_lengths", _SFIXED64, repeated=True),
        Field(17, "cycle_percents", _DOUBLE, repeated=True),
    ),
)
"""Exact measures of the greedy policy over all start states; cycles by their lowest state."""
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

TRANSITION = MessageType(
    "Transition",
    (
        Field(1, "action", _BYTES),
        Field(2, "next_observation", _BYTES),
        Field(3, "rewards", _DOUBLE, repeated=True),
        Field(4, "step", _SFIXED64),
        Field(5, "episode", _SFIXED64),
        Field(6, "t", _FIXED32),
        Field(7, "terminated", _BOOL),
        Field(8, "truncated", _BOOL),
        Field(9, "acted", _FIXED32),
        Field(10, "agents_terminated", _FIXED32),
        Field(11, "agents_truncated", _FIXED32),
    ),
)
"""A step in spaces that are not both `Discrete`; bit i of the last three is agent i."""
RESET = MessageType(
    "Reset",
    (
        Field(1, "observation", _BYTES),
        Field(2, "reset", _SFIXED64),
        Field(3, "episode", _SFIXED64),
        Field(4, "step", _SFIXED64),
        Field(5, "environment", _FIXED32),
        Field(6, "seed", _FIXED64),
        Field(7, "seeded", _BOOL),
    ),
)
INFO = MessageType(
    "Info",
    (
        Field(1, "step", _SFIXED64),
        Field(2, "reset", _BOOL),
        Field(3, "json", _STRING),
    ),
)
SCALAR = MessageType(
    "Scalar",
    (
        Field(1, "name", _STRING),
        Field(2, "value", _DOUBLE),
        Field(3, "phase", _STRING),
        Field(4, "step", _SFIXED64),
        Field(5, "episode", _SFIXED64),
    ),
)
ARRAY = MessageType(
    "Array",
    (
        Field(1, "name", _STRING),
        Field(2, "phase", _STRING),
        Field(3, "step", _SFIXED64),
        Field(4, "episode", _SFIXED64),
        Field(5, "shape", _FIXED32, repeated=True),
        Field(6, "dtype", _STRING),
        Field(7, "data", _BYTES),
    ),
)
IMAGE = MessageType(
    "CompressedImage",
    (
        Field(1, "timestamp", Pb.TYPE_MESSAGE),
        Field(2, "data", _BYTES),
        Field(3, "format", _STRING),
        Field(4, "frame_id", _STRING),
    ),
    package="foxglove",
)
"""Foxglove's own image message, so that viewers show it as a picture."""

LOG_LEVELS: Final = ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")

TRAIN_STEP = Topic("/train/step", 1, STEP, "train")
EVAL_STEP = Topic("/eval/step", 2, STEP, "eval")
TRAIN_EPISODE = Topic("/train/episode", 3, EPISODE, "train")
EVAL_EPISODE = Topic("/eval/episode", 4, EPISODE, "eval")
TRAIN_METRICS_TOPIC = Topic("/train/metrics", 5, TRAIN_METRICS, "train")
EVAL_METRICS_TOPIC = Topic("/eval/metrics", 6, EVAL_METRICS, "eval")
Q_TABLE_TOPIC = Topic("/q_table", 7, Q_TABLE)
LOG_TOPIC = Topic("/log", 8, LOG, digested=False)
OPTIMALITY_TOPIC = Topic("/eval/optimality", 23, OPTIMALITY, "eval")
TOPICS: Final = (
    TRAIN_STEP,
    EVAL_STEP,
    TRAIN_EPISODE,
    EVAL_EPISODE,
    TRAIN_METRICS_TOPIC,
    EVAL_METRICS_TOPIC,
    Q_TABLE_TOPIC,
    LOG_TOPIC,
    OPTIMALITY_TOPIC,
)
"""The topics of a run that the runner itself learned."""

TRAIN_TRANSITION = Topic("/train/step", 9, TRANSITION, "train")
EVAL_TRANSITION = Topic("/eval/step", 10, TRANSITION, "eval")
TRAIN_TRANSITION_VARIABLE = Topic("/train/step", 11, TRANSITION, "train")
EVAL_TRANSITION_VARIABLE = Topic("/eval/step", 12, TRANSITION, "eval")
TRAIN_RESET = Topic("/train/reset", 13, RESET, "train")
EVAL_RESET = Topic("/eval/reset", 14, RESET, "eval")
TRAIN_RESET_VARIABLE = Topic("/train/reset", 15, RESET, "train")
EVAL_RESET_VARIABLE = Topic("/eval/reset", 16, RESET, "eval")
TRAIN_INFO = Topic("/train/info", 17, INFO, "train")
EVAL_INFO = Topic("/eval/info", 18, INFO, "eval")
SCALAR_TOPIC = Topic("/scalar", 19, SCALAR)
ARRAY_TOPIC = Topic("/array", 20, ARRAY)
TRAIN_FRAME = Topic("/train/frame", 21, IMAGE, "train", digested=False)
EVAL_FRAME = Topic("/eval/frame", 22, IMAGE, "eval", digested=False)

LOOP_TOPICS: Final = {
    "step": (TRAIN_STEP, EVAL_STEP, TRAIN_RESET, EVAL_RESET),
    "transition": (TRAIN_TRANSITION, EVAL_TRANSITION, TRAIN_RESET, EVAL_RESET),
    "variable": (
        TRAIN_TRANSITION_VARIABLE,
        EVAL_TRANSITION_VARIABLE,
        TRAIN_RESET_VARIABLE,
        EVAL_RESET_VARIABLE,
    ),
}
"""What a recording of somebody's own loop has in this place, by the kind of its spaces."""
_LOOP_ANYWAY: Final = (
    *(TRAIN_EPISODE, EVAL_EPISODE, TRAIN_INFO, EVAL_INFO),
    *(SCALAR_TOPIC, ARRAY_TOPIC, TRAIN_FRAME, EVAL_FRAME, LOG_TOPIC),
)
KINDS: Final = {
    "job": TOPICS,
    **{kind: (*topics, *_LOOP_ANYWAY) for kind, topics in LOOP_TOPICS.items()},
}
"""Kind of a recording, as its metadata record `run` says it, to its topics."""
ALL_TOPICS: Final = tuple(
    sorted({topic for topics in KINDS.values() for topic in topics}, key=lambda topic: topic.channel)
)
DIGESTED: Final = frozenset(topic.name for topic in ALL_TOPICS if topic.digested)
"""The names of the topics that the content digest covers."""
MESSAGES: Final = tuple(dict.fromkeys(topic.message for topic in ALL_TOPICS))
"""Every message; the id of a schema is its place here, from 1."""

BLOCK_TOPICS: Final = (TRAIN_STEP, EVAL_STEP, TRAIN_EPISODE, EVAL_EPISODE)
"""Topics of a job whose messages have one size: read and written as blocks."""
ALL_BLOCK_TOPICS: Final = (
    *BLOCK_TOPICS,
    *(TRAIN_TRANSITION, EVAL_TRANSITION, TRAIN_RESET, EVAL_RESET),
)

PHASES: Final = {"train": (TRAIN_STEP, TRAIN_EPISODE), "eval": (EVAL_STEP, EVAL_EPISODE)}
"""The step and the episode topic of each phase of a job."""

NUMBERED_BY: Final = {STEP: "step", EPISODE: "episode", TRANSITION: "step", RESET: "reset"}
"""The field that numbers the messages of a fixed-width topic, from 0."""
NEVER: Final = 2**32 - 1
"""The `t` of a step in which a vector environment only reset one of its environments."""

_WIDTH: dict[int, str] = {_DOUBLE: "<f8", _FIXED32: "<u4", _SFIXED64: "<i8", _FIXED64: "<u8", _BOOL: "?"}
_WIRE: dict[int, int] = {_DOUBLE: 1, _SFIXED64: 1, _FIXED64: 1, _FIXED32: 5, _BOOL: 0, _STRING: 2, _BYTES: 2}

Sizes = tuple[int | np.dtype[Any], ...]
"""What is not fixed by the format: the elements of each repeated field, the dtype of each bytes field."""

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
MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")
"""The same, for one message: opcode, length, channel, sequence, log time, publish time."""


@lru_cache(64)
def record_dtype(message: MessageType, sizes: Sizes) -> np.dtype[np.void]:
    """Return the dtype of a whole MCAP message record of a fixed-width message.

    Args:
        message: its fields must all be of fixed width.
        sizes: of each repeated field the number of elements, of each bytes field its dtype, in order.

    Fields named `tag…` hold protobuf's constant bytes (see `blank_records`).
    """
    layout: list[Any] = list(HEADER)
    for field, value in zip(message.fields, _values(message, sizes), strict=True):
        layout.append((f"tag_{field.name}", "u1", (len(_tag(field, value)),)))
        layout.append((field.name, value))
    return np.dtype(layout)


def _values(message: MessageType, sizes: Sizes) -> list[np.dtype[Any]]:
    """Return the dtype of each field's value."""
    remaining = iter(sizes)
    values = []
    for field in message.fields:
        if field.kind == _BYTES:
            values.append(np.dtype(next(remaining)))  # type: ignore[arg-type]
        elif field.repeated:
            values.append(np.dtype((_WIDTH[field.kind], (next(remaining),))))
        else:
            values.append(np.dtype(_WIDTH[field.kind]))
    return values


def _tag(field: Field, value: np.dtype[Any]) -> bytes:
    """Return the constant bytes before a field's value: tag, and its length if it is bytes or packed."""
    if not field.repeated and field.kind != _BYTES:
        return bytes([field.number << 3 | _WIRE[field.kind]])
    return bytes([field.number << 3 | 2]) + varint(value.itemsize)


def varint(number: int) -> bytes:
    """Return a number as protobuf writes lengths: seven bits a byte, the lowest first."""
    low = []
    while number >= 128:
        low.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*low, number])


def blank_records(topic: Topic, sizes: Sizes, n: int) -> NDArray[np.void]:
    """Return n message records of the topic with every constant byte set and every value 0."""
    dtype = record_dtype(topic.message, sizes)
    one = np.zeros((), dtype=dtype)
    one["opcode"] = 5
    one["record_length"] = dtype.itemsize - 9
    one["channel_id"] = topic.channel
    for field, value in zip(topic.message.fields, _values(topic.message, sizes), strict=True):
        one[f"tag_{field.name}"] = list(_tag(field, value))
    return np.full(n, one)


def message_record(topic: Topic, log_time: int, payload: bytes) -> bytes:
    """Return the whole message record of one message, logged at a time in nanoseconds."""
    length = HEADER_BYTES - 9 + len(payload)
    return MESSAGE_HEAD.pack(5, length, topic.channel, 0, log_time, log_time) + payload


def block_counts(
    topic: Topic,
    learners: int,
    events: int,
    action: np.dtype[Any] | None = None,
    observation: np.dtype[Any] | None = None,
) -> Sizes:
    """Return what `record_dtype` must know of a topic in a run.

    Args:
        topic: one of `ALL_BLOCK_TOPICS`.
        learners: number of reward columns.
        events: number of event counters.
        action: dtype of an action, for `Transition`.
        observation: dtype of an observation, for `Transition` and `Reset`.
    """
    known: dict[MessageType, tuple[int | np.dtype[Any] | None, ...]] = {
        STEP: (learners,),
        EPISODE: (learners, events),
        TRANSITION: (action, observation, learners),
        RESET: (observation,),
    }
    sizes = known[topic.message]
    assert None not in sizes, f"{topic.message.name} needs the dtypes of its spaces"
    return sizes  # type: ignore[return-value]


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
