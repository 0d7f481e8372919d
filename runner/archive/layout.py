"""The tables of an archive, stated once: columns, their types, and how each is encoded.

    <run id>/steps.parquet           every step, in the order taken
    <run id>/episodes.parquet        the ends of episodes
    <run id>/train_metrics.parquet   reports on training
    <run id>/eval_metrics.parquet    evaluations
    <run id>/optimality.parquet      exact measures of evaluated policies
    <run id>/q_tables.parquet        snapshots; those that a replay gives are there by position and hash
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
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import pyarrow as pa
from google.protobuf.descriptor_pb2 import FieldDescriptorProto

from runner.recording import schema
from runner.recording.schema import Topic

FORMAT: Final = "dualtaxi archive"
VERSION: Final = 1

STEPS: Final = "steps.parquet"
EPISODES: Final = "episodes.parquet"
TRAIN_METRICS: Final = "train_metrics.parquet"
EVAL_METRICS: Final = "eval_metrics.parquet"
OPTIMALITY: Final = "optimality.parquet"
Q_TABLES: Final = "q_tables.parquet"
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
    for field in topic.message.fields:
        kind = kinds["d" if field.kind == FieldDescriptorProto.TYPE_DOUBLE else "q"]
        fields.append((field.name, pa.list_(kind) if field.repeated else kind))
    return pa.schema(fields)


MESSAGES: Final = {
    schema.TRAIN_METRICS_TOPIC: TRAIN_METRICS,
    schema.EVAL_METRICS_TOPIC: EVAL_METRICS,
    schema.OPTIMALITY_TOPIC: OPTIMALITY,
    schema.LOG_TOPIC: LOG,
    schema.Q_TABLE_TOPIC: Q_TABLES,
}
"""The table of each topic of variable size."""
ROW_BY_ROW: Final = tuple(topic for topic in MESSAGES if topic is not schema.Q_TABLE_TOPIC)
"""Those whose messages are a row each, with all that is in them."""

SCHEMAS: Final = {
    TRAIN_METRICS: _metrics(schema.TRAIN_METRICS_TOPIC),
    EVAL_METRICS: _metrics(schema.EVAL_METRICS_TOPIC),
    OPTIMALITY: _metrics(schema.OPTIMALITY_TOPIC),
    LOG: pa.schema(
        [("run_id", TEXT), ("position", pa.int64()), ("level", pa.string()), ("message", pa.string())]
    ),
    Q_TABLES: pa.schema(
        [
            ("run_id", TEXT),
            ("position", pa.int64()),
            ("step", pa.int64()),
            ("episode", pa.int64()),
            ("agent", pa.string()),
            ("table", pa.int32()),
            ("states", pa.int32()),
            ("actions", pa.int32()),
            ("blake3", pa.string()),
            ("data", pa.binary()),
        ]
    ),
}
"""The tables that have the same columns in every archive."""

ENCODINGS: Final = {
    **dict.fromkeys(("position", "step", "episode", "last_step"), "DELTA_BINARY_PACKED"),
    **dict.fromkeys(("t", "state", "next_state", "action"), "BYTE_STREAM_SPLIT"),
    **dict.fromkeys(("explored", "terminated", "success"), "PLAIN"),
    "truncated": "RLE",
}
"""How the columns of steps and episodes are encoded; a dictionary holds the values of all others."""


@dataclass(frozen=True)
class Shape:
    """What fixes the columns of a run's steps and episodes."""

    run_id: str
    learners: tuple[str, ...]
    agents: tuple[str, ...]
    action_counts: tuple[int, ...]
    events: tuple[str, ...]

    @property
    def counts(self) -> dict[Topic, schema.Sizes]:
        """Elements of each repeated field of the fixed-width topics, as `schema.record_dtype` wants them."""
        sizes = len(self.learners), len(self.events)
        return {topic: schema.block_counts(topic, *sizes) for topic in schema.BLOCK_TOPICS}

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
        """The columns of `steps.parquet`."""
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


def _columns(prefix: str, names: tuple[str, ...]) -> list[str]:
    """Return a column name for each name, numbered where they would not differ."""
    made = [prefix + name.replace(".", "_") for name in names]
    if len(set(made)) < len(made):
        made = [f"{prefix}{number}" for number in range(1, len(made) + 1)]
    return made
