"""The tables of an archive, stated once: columns, their types, and how each is encoded.

    <run id>/steps.parquet           every step, in the order taken
    <run id>/episodes.parquet        the ends of episodes
    <run id>/train_metrics.parquet   reports on training
    <run id>/eval_metrics.parquet    evaluations
    <run id>/optimality.parquet      exact measures of evaluated policies
    <run id>/q_tables.parquet        snapshots; those that a replay gives are there by position and hash
    <run id>/resets.parquet          of somebody's own loop: the resets,
    <run id>/infos.parquet           the chosen fields of infos,
    <run id>/scalars.parquet         the numbers that were logged,
    <run id>/arrays.parquet          the arrays that were recorded,
    <run id>/frames.parquet          the pictures
    <run id>/log.parquet             lines of text
    <run id>/run.parquet             one row: what the run is, its configuration and provenance
    <run id>/transitions.parquet     what the environment can do, with the events of each outcome
    <run id>/states.parquet          each state in words
    <run id>/actions.parquet         each joint action in words
    <run id>/metadata.json           the recording's metadata records
    <run id>/environment/...         the recording's attachments
    <run id>/manifest.json           written last: sizes and hashes of the others

A column is there for a reader, or to restore the recording; most are for both. What a table says can be
told from its columns alone, so that tables of many runs can be read as one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import pyarrow as pa
from google.protobuf.descriptor_pb2 import FieldDescriptorProto

from runner.archive.values import SpaceColumns
from runner.recording import schema
from runner.recording.blocks import Sizes
from runner.recording.schema import MessageType, Topic

FORMAT: Final = "dualtaxi archive"
VERSION: Final = 1

STEPS: Final = "steps.parquet"
EPISODES: Final = "episodes.parquet"
TRAIN_METRICS: Final = "train_metrics.parquet"
EVAL_METRICS: Final = "eval_metrics.parquet"
OPTIMALITY: Final = "optimality.parquet"
Q_TABLES: Final = "q_tables.parquet"
RESETS: Final = "resets.parquet"
INFOS: Final = "infos.parquet"
SCALARS: Final = "scalars.parquet"
ARRAYS: Final = "arrays.parquet"
FRAMES: Final = "frames.parquet"
LOG: Final = "log.parquet"
RUN: Final = "run.parquet"
TRANSITIONS: Final = "transitions.parquet"
STATES: Final = "states.parquet"
ACTIONS: Final = "actions.parquet"
METADATA: Final = "metadata.json"
MANIFEST: Final = "manifest.json"
ENVIRONMENT: Final = "environment.json"

PHASES: Final = ("train", "eval")
TEXT: Final = pa.dictionary(pa.int8(), pa.string())
"""A text that repeats: a category to pandas and Polars, a plain text to DuckDB."""


def _metrics(topic: Topic) -> pa.Schema:
    kinds = {"d": pa.float64(), "q": pa.int64()}
    fields = [("run_id", TEXT), ("position", pa.int64())]
    for one in topic.message.fields:
        kind = kinds["d" if one.kind == FieldDescriptorProto.TYPE_DOUBLE else "q"]
        fields.append((one.stored_name, pa.list_(kind) if one.repeated else kind))
    return pa.schema(fields)


_PLACED: Final = (("run_id", TEXT), ("position", pa.int64()))
_OF_A_PHASE: Final = (("run_id", TEXT), ("phase", TEXT), ("position", pa.int64()))
_LOGGED: Final = (("name", pa.string()), ("step", pa.int64()), ("episode", pa.int64()))
SCHEMAS: Final = {
    TRAIN_METRICS: _metrics(schema.TRAIN_METRICS_TOPIC),
    EVAL_METRICS: _metrics(schema.EVAL_METRICS_TOPIC),
    OPTIMALITY: _metrics(schema.OPTIMALITY_TOPIC),
    LOG: pa.schema([*_PLACED, *((name, pa.string()) for name in ("name", "level", "message"))]),
    Q_TABLES: pa.schema(
        [
            *_PLACED,
            *(("step", pa.int64()), ("episode", pa.int64()), ("agent", pa.string())),
            *((name, pa.int32()) for name in ("table", "states", "actions")),
            *(("blake3", pa.string()), ("data", pa.binary())),
        ]
    ),
    INFOS: pa.schema([*_OF_A_PHASE, ("step", pa.int64()), ("reset", pa.bool_()), ("json", pa.string())]),
    SCALARS: pa.schema([*_OF_A_PHASE, *_LOGGED, ("value", pa.float64())]),
    ARRAYS: pa.schema(
        [
            *(*_OF_A_PHASE, *_LOGGED),
            *(("shape", pa.list_(pa.int64())), ("dtype", pa.string()), ("data", pa.binary())),
        ]
    ),
    FRAMES: pa.schema([*_OF_A_PHASE, ("format", pa.string()), ("data", pa.binary())]),
}
"""The tables that have the same columns in every archive."""

MAY_BE_NULL: Final = frozenset({"data", "seed"})
"""The columns that may lack values: of a snapshot that a replay gives, of a reset without a seed."""

ENCODINGS: Final = {
    **dict.fromkeys(("position", "step", "episode", "last_step"), "DELTA_BINARY_PACKED"),
    **dict.fromkeys(("t", "state", "next_state", "action"), "BYTE_STREAM_SPLIT"),
    **dict.fromkeys(("explored", "terminated", "success"), "PLAIN"),
    "truncated": "RLE",
}
"""How the columns of steps and episodes are encoded; a dictionary holds the values of all others."""
VALUES: Final = ("action_", "observation", "next_observation")
"""What the names of columns that hold values of spaces begin with: those of floats are split by byte."""


@dataclass(frozen=True)
class Table:
    """A table of messages: its file, whose they are, and its columns."""

    name: str
    topics: tuple[Topic, ...]
    """One, or one of training and one of evaluation."""
    columns: pa.Schema


@dataclass(frozen=True)
class Shape:
    """What fixes the tables of a run and their columns."""

    run_id: str
    kind: str
    """One of `schema.KINDS`."""
    learners: tuple[str, ...]
    agents: tuple[str, ...]
    action_counts: tuple[int, ...]
    events: tuple[str, ...]
    sizes: Mapping[Topic, Sizes]
    """Of each fixed-width topic, as `record_dtype` wants them."""
    spaces: Mapping[str, SpaceColumns] = field(default_factory=dict)
    """Of a loop, by the field whose values they hold: `action`, `next_observation`, `observation`."""

    @cached_property
    def tables(self) -> tuple[Table, ...]:
        """The tables of messages, but those of Q-tables, in the order in which they are written."""
        own = {topic.name: topic for topic in schema.KINDS[self.kind]}

        def table(name: str, *topics: str) -> Table:
            columns = SCHEMAS[name] if name in SCHEMAS else self.columns_of(own[topics[0]].message)
            return Table(name, tuple(own[topic] for topic in topics), columns)

        steps = table(STEPS, "/train/step", "/eval/step")
        episodes = table(EPISODES, "/train/episode", "/eval/episode")
        log = table(LOG, schema.LOG_TOPIC.name)
        if self.kind == "job":
            metrics = table(TRAIN_METRICS, "/train/metrics"), table(EVAL_METRICS, "/eval/metrics")
            return steps, episodes, *metrics, table(OPTIMALITY, "/eval/optimality"), log
        return (
            *(steps, episodes, table(RESETS, "/train/reset", "/eval/reset")),
            *(table(INFOS, "/train/info", "/eval/info"), table(SCALARS, "/scalar")),
            *(table(ARRAYS, "/array"), table(FRAMES, "/train/frame", "/eval/frame"), log),
        )

    def columns_of(self, message: MessageType) -> pa.Schema:
        """Return the columns of a message whose columns differ from run to run."""
        if message is schema.TRANSITION:
            return self.transitions
        if message is schema.RESET:
            return self.resets
        return self.steps if message is schema.STEP else self.episodes

    @property
    def joint_actions(self) -> int:
        """Number of joint actions."""
        return math.prod(self.action_counts)

    def per_learner(self, name: str) -> list[str]:
        """Return the columns of what each learner has: `reward_taxi_1`; none if there is one learner."""
        return _columns(f"{name}_", self.learners) if len(self.learners) > 1 else []

    @cached_property
    def own_actions(self) -> list[str]:
        """The columns of the agents' own actions: `action_taxi_1`; none if there is one agent."""
        return _columns("action_", self.agents) if len(self.agents) > 1 else []

    @cached_property
    def event_columns(self) -> list[str]:
        """The columns that count events: `n_taxi_1_drop_off`."""
        return _columns("n_", self.events)

    @cached_property
    def steps(self) -> pa.Schema:
        """The columns of `steps.parquet` where states are numbers."""
        whole, real, flag = pa.int32(), pa.float64(), pa.bool_()
        return pa.schema(
            [
                *(("run_id", TEXT), ("phase", TEXT)),
                *((name, pa.int64()) for name in ("position", "step", "episode")),
                *((name, whole) for name in ("t", "state", "action", *self.own_actions, "next_state")),
                *((name, real) for name in ("reward", *self.per_learner("reward"))),
                *((name, flag) for name in ("explored", *self.per_learner("explored"))),
                *((name, flag) for name in ("terminated", "truncated")),
            ]
        )

    @cached_property
    def transitions(self) -> pa.Schema:
        """The columns of `steps.parquet` where they are values of a space."""
        return pa.schema(
            [
                *(*_OF_A_PHASE, ("step", pa.int64()), ("episode", pa.int64()), ("t", pa.int32())),
                *(*self.spaces["action"].fields, *self.spaces["next_observation"].fields),
                *((name, pa.float64()) for name in ("reward", *self.per_learner("reward"))),
                *(("terminated", pa.bool_()), ("truncated", pa.bool_())),
                *((name, pa.int32()) for name in ("acted", "agents_terminated", "agents_truncated")),
            ]
        )

    @cached_property
    def resets(self) -> pa.Schema:
        """The columns of `resets.parquet`."""
        return pa.schema(
            [
                *_OF_A_PHASE,
                *((name, pa.int64()) for name in ("reset", "episode", "step")),
                *(("environment", pa.int32()), ("seed", pa.uint64())),
                *self.spaces["observation"].fields,
            ]
        )

    @cached_property
    def episodes(self) -> pa.Schema:
        """The columns of `episodes.parquet`."""
        whole, real, flag = pa.int32(), pa.float64(), pa.bool_()
        return pa.schema(
            [
                *(("run_id", TEXT), ("phase", TEXT)),
                *((name, pa.int64()) for name in ("position", "episode", "last_step")),
                *((name, whole) for name in ("length", "penalties")),
                *((name, real) for name in ("return", *self.per_learner("return"))),
                *((name, flag) for name in ("success", "terminated", "truncated")),
                *((name, whole) for name in self.event_columns),
            ]
        )


def encodings_of(columns: pa.Schema) -> dict[str, str]:
    """Return how the columns of a table are encoded that hold no dictionary; none of one with lists."""
    if any(pa.types.is_list(kind) for kind in columns.types):
        return {}
    values = {"value"} | {name for name in columns.names if name.startswith(VALUES)}
    split = {one.name for one in columns if one.name in values and pa.types.is_floating(one.type)}
    known = {name: ENCODINGS[name] for name in columns.names if name in ENCODINGS}
    plain = {one.name for one in columns if pa.types.is_fixed_size_binary(one.type)}
    return known | dict.fromkeys(split, "BYTE_STREAM_SPLIT") | dict.fromkeys(plain, "PLAIN")


def row_bytes(columns: pa.Schema) -> int:
    """Return about how many bytes a row takes when it is unpacked; a text is taken for a pointer."""
    return sum(kind.byte_width if pa.types.is_fixed_size_binary(kind) else 8 for kind in columns.types)


def _columns(prefix: str, names: tuple[str, ...]) -> list[str]:
    """Return a column name for each name, numbered where they would not differ."""
    made = [prefix + name.replace(".", "_") for name in names]
    if len(set(made)) < len(made):
        made = [f"{prefix}{number}" for number in range(1, len(made) + 1)]
    return made
