"""The recording format, defined once: topics, messages, fields, times and the version.

Every message is protobuf; `layout` defines how the most frequent ones are laid out in the file.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Final

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Pb

from runner.recording.fields import Field
from runner.recording.metrics import METRICS, TABLE_METRICS

FORMAT_VERSION: Final = 2
PROFILE: Final = "dualtaxi"
STEP_NANOSECONDS: Final = 100_000_000
"""Logical time of one environment step: 0.1 s, so that playback at 1x shows ten steps a second."""


@dataclass(frozen=True, eq=False)
class MessageType:
    """A protobuf message, with its fields in the order they are written."""

    name: str
    fields: tuple[Field, ...]
    package: str = "dualtaxi"
    varies: bool = False
    """Whether its messages are encoded one by one: values of some message of the run vary in size."""

    @property
    def full_name(self) -> str:
        """The fully qualified protobuf name."""
        return f"{self.package}.{self.name}"

    @cached_property
    def values(self) -> tuple[Field, ...]:
        """The fields with values of the spaces of an environment."""
        return tuple(field for field in self.fields if field.is_value)


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
_FIXED64, _MESSAGE, _ENUM = Pb.TYPE_FIXED64, Pb.TYPE_MESSAGE, Pb.TYPE_ENUM


def _fields(first: int = 1, /, **kinds: int | list[int]) -> tuple[Field, ...]:
    """Return fields numbered from `first` on, in this order; a kind in a list makes a repeated field."""
    return tuple(
        Field(number, name, kind[0], repeated=True) if isinstance(kind, list) else Field(number, name, kind)
        for number, (name, kind) in enumerate(kinds.items(), first)
    )


# The order of the fields is the one that compresses best: fields that change together are adjacent.
STEP = MessageType(
    "Step",
    _fields(
        state=_FIXED32,
        action=_FIXED32,
        next_state=_FIXED32,
        rewards=[_DOUBLE],
        step=_SFIXED64,
        explored=_FIXED32,
        episode=_SFIXED64,
        t=_FIXED32,
        terminated=_BOOL,
        truncated=_BOOL,
    ),
)
"""A step of a job, or of a loop over states; `layout` adds the fields of other steps, numbered up to 15."""
AGENT_FIELDS: Final = _fields(11, acted=_FIXED32, agents_terminated=_FIXED32, agents_truncated=_FIXED32)
"""More fields of a step in a game of several agents: bit i is agent i."""
ENVIRONMENT_OF_STEP: Final = Field(14, "environment", _FIXED32)
TAKEN: Final = Field(15, "taken", _BOOL)
"""The first and the last field of a step where environments take turns."""
OF_STATES: Final = frozenset({"state", "action", "next_state", "explored"})
"""The fields of steps over states alone; `layout` puts values of other spaces in their place."""
STEP_COLUMNS: Final = (
    "step",
    "episode",
    "t",
    "environment",
    "taken",
    "state",
    "action",
    "next_state",
    "next_observation",
    "rewards",
    "explored",
    "terminated",
    "truncated",
    "acted",
    "agents_terminated",
    "agents_truncated",
)
"""The fields that steps may have, in the order in which people read them."""
EPISODE = MessageType(
    "Episode",
    (
        Field(1, "episode", _SFIXED64),
        Field(10, "first_step", _SFIXED64),
        *_fields(
            2,
            last_step=_SFIXED64,
            length=_FIXED32,
            penalties=_FIXED32,
            returns=[_DOUBLE],
            events=[_FIXED32],
            success=_BOOL,
            terminated=_BOOL,
            truncated=_BOOL,
        ),
    ),
)
ENVIRONMENT_OF_EPISODE: Final = Field(11, "environment", _FIXED32)
"""One more field of an episode where environments take turns."""
EPISODE_COLUMNS: Final = (
    "episode",
    "environment",
    "first_step",
    "last_step",
    "length",
    "penalties",
    "returns",
    "success",
    "terminated",
    "truncated",
    "events",
)
"""The fields that episodes may have, in the order in which people read them."""
_TRAINING_SIDE = (
    *_fields(
        step=_SFIXED64,
        episode=_SFIXED64,
        mean_length=_DOUBLE,
        rewards=[_DOUBLE],
        reward_counts=[_SFIXED64],
    ),
    *_fields(8, epsilon=_DOUBLE, step_size=_DOUBLE, discount=_DOUBLE),
    *(
        Field(metric.number, metric.field, _SFIXED64 if metric.is_count else _DOUBLE, repeated=True)
        for metric in TABLE_METRICS
    ),
)
_EVALUATION_SIDE = (
    *_fields(11, evaluation=_SFIXED64, trials=_SFIXED64, successes=_SFIXED64),
    Field(17, "terminations", _SFIXED64),
    Field(19, "events", _SFIXED64, repeated=True),
    *(Field(metric.number, metric.field, _DOUBLE, metric.per_agent) for metric in METRICS),
)
TRAIN_METRICS, EVAL_METRICS = (
    MessageType(name, tuple(sorted(fields, key=lambda field: field.number)))
    for name, fields in (
        ("TrainMetrics", _TRAINING_SIDE),
        ("EvalMetrics", (*_TRAINING_SIDE, *_EVALUATION_SIDE)),
    )
)
OPTIMALITY = MessageType(
    "Optimality",
    _fields(
        step=_SFIXED64,
        episode=_SFIXED64,
        evaluation=_SFIXED64,
        starts=_SFIXED64,
        success_percent=_DOUBLE,
        timeout_percent=_DOUBLE,
        mean_length=_DOUBLE,
        mean_penalties=_DOUBLE,
        mean_returns=[_DOUBLE],
        values=[_DOUBLE],
        best_responses=[_DOUBLE],
        optimal_value=_DOUBLE,
        optimal_success_percent=_DOUBLE,
        optimal_mean_length=_DOUBLE,
        cycle_states=[_SFIXED64],
        cycle_lengths=[_SFIXED64],
        cycle_percents=[_DOUBLE],
    ),
)
"""Exact measures of the greedy policy over all start states; cycles by their lowest state."""
Q_TABLE = MessageType(
    "QTable",
    _fields(
        step=_SFIXED64,
        episode=_SFIXED64,
        agent=_STRING,
        table=_FIXED32,
        shape=[_FIXED32],
        dtype=_STRING,
        data=_BYTES,
    ),
)
LOG = MessageType(
    "Log",
    _fields(timestamp=_MESSAGE, level=_ENUM, message=_STRING, name=_STRING, file=_STRING, line=_FIXED32),
    package="foxglove",
)
"""Foxglove's own log message, so that viewers show it as text."""

RESET = MessageType(
    "Reset",
    _fields(
        observation=_BYTES,
        reset=_SFIXED64,
        episode=_SFIXED64,
        step=_SFIXED64,
        environment=_FIXED32,
        seed=_FIXED64,
        seeded=_BOOL,
    ),
)
RESET_STATE = MessageType(
    "ResetState",
    _fields(
        reset=_SFIXED64, environment=_FIXED32, np_random_seed=_BYTES, bit_generator=_BYTES, ale_state=_BYTES
    ),
)
"""What a reset without a seed depends on; `messages.ResetState` describes its fields."""
RESET_OPTIONS = MessageType(
    "ResetOptions", _fields(reset=_SFIXED64, json=_STRING, large_seed=_STRING, resets=_FIXED32)
)
"""What a reset was called with, if there is more than a seed; see `messages.ResetOptions`."""
INFO = MessageType("Info", _fields(step=_SFIXED64, reset=_BOOL, json=_STRING))
SCALAR = MessageType(
    "Scalar",
    _fields(name=_STRING, value=_DOUBLE, phase=_STRING, step=_SFIXED64, episode=_SFIXED64),
)
ARRAY = MessageType(
    "Array",
    _fields(
        name=_STRING,
        phase=_STRING,
        step=_SFIXED64,
        episode=_SFIXED64,
        shape=[_FIXED32],
        dtype=_STRING,
        data=_BYTES,
    ),
)
IMAGE = MessageType(
    "CompressedImage",
    _fields(timestamp=_MESSAGE, data=_BYTES, format=_STRING, frame_id=_STRING),
    package="foxglove",
)
"""Foxglove's own image message, so that viewers show it as a picture."""

EXTRA_COLUMNS = MessageType("ExtraColumns", _fields(json=_STRING, layout=_FIXED32))
"""The names of extras, with dtypes and shapes: the description of a `Dict` space, and its number."""
EXTRA = MessageType("Extra", (Field(3, "step", _SFIXED64, dtype=np.dtype("<i8")),), varies=True)
"""The values that a loop recorded with a step; `extras` adds the fields of a layout's names."""
CHECKPOINT = MessageType(
    "Checkpoint",
    _fields(
        name=_STRING,
        phase=_STRING,
        step=_SFIXED64,
        episode=_SFIXED64,
        digest=_STRING,
        size=_SFIXED64,
        format=_STRING,
    ),
)
"""A reference to content in the store next to the recordings, by its BLAKE3."""
CLOCK = MessageType("Clock", _fields(started=_DOUBLE, seconds=_DOUBLE))
"""How much time had passed at its position; `machine` describes its fields."""
HOST = MessageType(
    "Host",
    _fields(
        started=_DOUBLE,
        seconds=_DOUBLE,
        cpu_percent=_DOUBLE,
        memory_bytes=_DOUBLE,
        host_cpu_percent=_DOUBLE,
        host_memory_bytes=_DOUBLE,
        host_memory_total=_DOUBLE,
        disk_read_bytes=_DOUBLE,
        disk_written_bytes=_DOUBLE,
        disk_free_bytes=_DOUBLE,
        network_received_bytes=_DOUBLE,
        network_sent_bytes=_DOUBLE,
        gpu_percent=[_DOUBLE],
        gpu_memory_bytes=[_DOUBLE],
        gpu_memory_total=[_DOUBLE],
    ),
)
"""What the process and its host used at a moment; NaN is unknown. `machine` describes its fields."""
CONSOLE = MessageType(
    "Console",
    _fields(started=_DOUBLE, seconds=_DOUBLE, stream=_FIXED32, line=_SFIXED64, text=_STRING),
)
"""A line of the process's output; a later line of the same number, stream and session replaces it."""

ACTIONS = MessageType("Actions", _fields(step=_SFIXED64, count=_FIXED32, data=_BYTES, digests=_BYTES))
"""A block of steps of which only the actions were recorded; `steps` describes its columns."""

LOG_LEVELS: Final = ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")


def _both(name: str, channel: int, message: MessageType, digested: bool = True) -> tuple[Topic, Topic]:
    """Return the topics of training and evaluation, whose channels follow each other."""
    train, evaluation = f"/train/{name}", f"/eval/{name}"
    return (
        Topic(train, channel, message, "train", digested),
        Topic(evaluation, channel + 1, message, "eval", digested),
    )


TRAIN_STEP, EVAL_STEP = _both("step", 1, STEP)
TRAIN_EPISODE, EVAL_EPISODE = _both("episode", 3, EPISODE)
TRAIN_METRICS_TOPIC = Topic("/train/metrics", 5, TRAIN_METRICS, "train")
EVAL_METRICS_TOPIC = Topic("/eval/metrics", 6, EVAL_METRICS, "eval")
Q_TABLE_TOPIC = Topic("/q_table", 7, Q_TABLE)
LOG_TOPIC = Topic("/log", 8, LOG, digested=False)
OPTIMALITY_TOPIC = Topic("/eval/optimality", 23, OPTIMALITY, "eval")
JOB_TOPICS: Final = (
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
"""The topics of a job, without the topics of its machine."""

TRAIN_RESET, EVAL_RESET = _both("reset", 13, RESET)
TRAIN_INFO, EVAL_INFO = _both("info", 17, INFO)
SCALAR_TOPIC = Topic("/scalar", 19, SCALAR)
ARRAY_TOPIC = Topic("/array", 20, ARRAY)
TRAIN_FRAME, EVAL_FRAME = _both("frame", 21, IMAGE, digested=False)
TRAIN_RESET_STATE, EVAL_RESET_STATE = _both("reset_state", 24, RESET_STATE, digested=False)
EXTRA_COLUMNS_TOPIC = Topic("/extra", 26, EXTRA_COLUMNS)
TRAIN_EXTRA, EVAL_EXTRA = _both("extra", 27, EXTRA)
CHECKPOINT_TOPIC = Topic("/checkpoint", 29, CHECKPOINT)
CLOCK_TOPIC = Topic("/clock", 30, CLOCK, digested=False)
HOST_TOPIC = Topic("/host", 31, HOST, digested=False)
CONSOLE_TOPIC = Topic("/console", 32, CONSOLE, digested=False)
MACHINE_TOPICS: Final = (CLOCK_TOPIC, HOST_TOPIC, CONSOLE_TOPIC)
"""The topics of how the recording went on its machine: other messages each time a job is run."""
IMAGE_TOPIC = Topic("/image", 50, IMAGE, digested=False)
"""Pictures that were logged under a name, which is their `frame_id`; a film is an animated WebP."""
TRAIN_RESET_OPTIONS, EVAL_RESET_OPTIONS = _both("reset_options", 33, RESET_OPTIONS)
TRAIN_ACTIONS, EVAL_ACTIONS = _both("actions", 40, ACTIONS, digested=False)

_LOOP_TOPICS: Final = (
    TRAIN_STEP,
    EVAL_STEP,
    TRAIN_RESET,
    EVAL_RESET,
    TRAIN_RESET_OPTIONS,
    EVAL_RESET_OPTIONS,
    TRAIN_EPISODE,
    EVAL_EPISODE,
    TRAIN_INFO,
    EVAL_INFO,
    SCALAR_TOPIC,
    ARRAY_TOPIC,
    TRAIN_FRAME,
    EVAL_FRAME,
    LOG_TOPIC,
    TRAIN_RESET_STATE,
    EVAL_RESET_STATE,
    EXTRA_COLUMNS_TOPIC,
    TRAIN_EXTRA,
    EVAL_EXTRA,
    CHECKPOINT_TOPIC,
    TRAIN_ACTIONS,
    EVAL_ACTIONS,
    IMAGE_TOPIC,
)
KINDS: Final = {
    "job": (*JOB_TOPICS, *MACHINE_TOPICS),
    "loop": (*_LOOP_TOPICS, *MACHINE_TOPICS),
    "game": (*_LOOP_TOPICS, *MACHINE_TOPICS),
}
"""The topics of each kind of recording, as the metadata record `run` names it."""
ALL_TOPICS: Final = tuple(
    sorted({topic for topics in KINDS.values() for topic in topics}, key=lambda topic: topic.channel)
)
MAX_LAYOUTS: Final = 256
"""The most layouts of extras in a recording."""
LAYOUT_STRIDE: Final = 100
"""The distance between the ids of channels and schemas of two consecutive layouts of extras."""
TOPIC_OF: Final = {topic.channel: topic for topic in ALL_TOPICS}
"""Channel -> its topic; topics of extras have a channel for each layout."""
TOPIC_OF.update(
    (channel, replace(topic, channel=channel))
    for topic in (TRAIN_EXTRA, EVAL_EXTRA)
    for channel in range(topic.channel + LAYOUT_STRIDE, LAYOUT_STRIDE * MAX_LAYOUTS, LAYOUT_STRIDE)
)
DIGESTED: Final = frozenset(topic.name for topic in ALL_TOPICS if topic.digested)
"""The names of the topics that the content digest covers."""
MESSAGES: Final = tuple(dict.fromkeys(topic.message for topic in ALL_TOPICS))
"""Every message; the id of a schema is its place here, from 1."""


def extra_topic(phase: str, layout: int) -> Topic:
    """Return the topic of a phase's extras, with the channel of a layout."""
    return TOPIC_OF[topics_of(phase).extras.channel + LAYOUT_STRIDE * layout]


def schema_id(topic: Topic) -> int:
    """Return the id of the schema of a topic's channel."""
    return MESSAGES.index(topic.message) + 1 + topic.channel // LAYOUT_STRIDE * LAYOUT_STRIDE


BLOCK_TOPICS: Final = (TRAIN_STEP, EVAL_STEP, TRAIN_EPISODE, EVAL_EPISODE)
"""The topics of a job whose messages have one size: read and written as blocks."""
ROW_TOPICS: Final = (*BLOCK_TOPICS, TRAIN_RESET, EVAL_RESET)
"""The topics that are put down as rows: their messages have one size unless values of the spaces vary."""

STEP_TOPICS: Final = (TRAIN_STEP.name, EVAL_STEP.name)
"""The names of the topics that a run may leave out."""
PHASES: Final = ("train", "eval")
PHASE_NAMES: Final = {"train": "training", "eval": "evaluation"}
"""The phases as texts name them."""


@dataclass(frozen=True, eq=False)
class PhaseTopics:
    """The topics of a phase; those that a kind of recording does not have are empty there."""

    steps: Topic
    actions: Topic
    episodes: Topic
    resets: Topic
    reset_options: Topic
    reset_states: Topic
    infos: Topic
    frames: Topic
    extras: Topic
    metrics: Topic


@cache
def topics_of(phase: str) -> PhaseTopics:
    """Return the topics of a phase."""
    topics = {topic.name.rpartition("/")[2]: topic for topic in ALL_TOPICS if topic.phase == phase}
    return PhaseTopics(
        steps=topics["step"],
        actions=topics["actions"],
        episodes=topics["episode"],
        resets=topics["reset"],
        reset_options=topics["reset_options"],
        reset_states=topics["reset_state"],
        infos=topics["info"],
        frames=topics["frame"],
        extras=topics["extra"],
        metrics=topics["metrics"],
    )


NUMBERED_BY: Final = {STEP: "step", EPISODE: "episode", RESET: "reset"}
"""The field that numbers the messages of a fixed-width topic, from 0."""
