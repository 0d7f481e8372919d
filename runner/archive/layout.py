"""The files of an archive, the columns of the tables that are the same in every archive, and encodings.

The files of a run are in the folder of its id: the tables and other files below, the attachments of the
recording by their names, and the manifest, which is written last.

A column is for readers, or for restoring the recording; most are for both. Run and phase are columns of each
table, so that tables of many runs can be read as one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import pyarrow as pa
from google.protobuf.descriptor_pb2 import FieldDescriptorProto
from numpy.typing import NDArray

from runner.recording import schema
from runner.recording.schema import Topic

Records = NDArray[np.void]

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
EXTRA_COLUMNS: Final = "extra_columns.parquet"
EXTRAS: Final = "extras.parquet"
RESET_STATES: Final = "reset_states.parquet"
CHECKPOINTS: Final = "checkpoints.parquet"
CONTENTS: Final = "checkpoints/"
"""The folder of the contents of checkpoints, named by their digests."""
LOG: Final = "log.parquet"
CLOCK: Final = "clock.parquet"
HOST: Final = "host.parquet"
CONSOLE: Final = "console.parquet"
FRAME_ID: Final = "frame_id"
"""A column that archives of earlier versions do not have."""
RUN: Final = "run.parquet"
TRANSITIONS: Final = "transitions.parquet"
STATES: Final = "states.parquet"
ACTIONS: Final = "actions.parquet"
METADATA: Final = "metadata.json"
MANIFEST: Final = "manifest.json"

PHASES: Final = ("train", "eval")
TEXT: Final = pa.dictionary(pa.int8(), pa.string())
"""Repeated text: a category in pandas and Polars, plain text in DuckDB."""


def _numbers(topic: Topic) -> pa.Schema:
    kinds = {"d": pa.float64(), "q": pa.int64()}
    fields = [("run_id", TEXT), ("position", pa.int64())]
    for one in topic.message.fields:
        kind = kinds["d" if one.kind == FieldDescriptorProto.TYPE_DOUBLE else "q"]
        fields.append((one.stored_name, pa.list_(kind) if one.repeated else kind))
    return pa.schema(fields)


_PLACED: Final = (("run_id", TEXT), ("position", pa.int64()))
PLACED_IN_PHASE: Final = (("run_id", TEXT), ("phase", TEXT), ("position", pa.int64()))
_LOGGED: Final = (("name", pa.string()), ("step", pa.int64()), ("episode", pa.int64()))
SCHEMAS: Final = {
    TRAIN_METRICS: _numbers(schema.TRAIN_METRICS_TOPIC),
    EVAL_METRICS: _numbers(schema.EVAL_METRICS_TOPIC),
    OPTIMALITY: _numbers(schema.OPTIMALITY_TOPIC),
    LOG: pa.schema([*_PLACED, *((name, pa.string()) for name in ("name", "level", "message"))]),
    CLOCK: _numbers(schema.CLOCK_TOPIC),
    HOST: _numbers(schema.HOST_TOPIC),
    CONSOLE: pa.schema(
        [
            *_PLACED,
            ("started", pa.float64()),
            ("seconds", pa.float64()),
            ("stream", pa.int64()),
            ("line", pa.int64()),
            ("text", pa.string()),
        ]
    ),
    Q_TABLES: pa.schema(
        [
            *_PLACED,
            ("step", pa.int64()),
            ("episode", pa.int64()),
            ("agent", pa.string()),
            *((name, pa.int32()) for name in ("table", "states", "actions")),
            ("blake3", pa.string()),
            ("data", pa.binary()),
        ]
    ),
    INFOS: pa.schema([*PLACED_IN_PHASE, ("step", pa.int64()), ("reset", pa.bool_()), ("json", pa.string())]),
    SCALARS: pa.schema([*PLACED_IN_PHASE, *_LOGGED, ("value", pa.float64())]),
    ARRAYS: pa.schema(
        [
            *PLACED_IN_PHASE,
            *_LOGGED,
            ("shape", pa.list_(pa.int64())),
            ("dtype", pa.string()),
            ("data", pa.binary()),
        ]
    ),
    CHECKPOINTS: pa.schema(
        [
            *PLACED_IN_PHASE,
            *_LOGGED,
            ("digest", pa.string()),
            ("size", pa.int64()),
            ("format", pa.string()),
        ]
    ),
    EXTRA_COLUMNS: pa.schema([*_PLACED, ("json", pa.string())]),
    RESET_STATES: pa.schema(
        [
            *PLACED_IN_PHASE,
            ("reset", pa.int64()),
            ("environment", pa.int32()),
            *((name, pa.binary()) for name in ("np_random_seed", "bit_generator", "ale_state")),
        ]
    ),
    FRAMES: pa.schema(
        [*PLACED_IN_PHASE, ("format", pa.string()), ("data", pa.binary()), (FRAME_ID, pa.string())]
    ),
}
"""The columns of the tables that are the same in every archive."""

LEFT_OUT_IF_EMPTY: Final = frozenset({EXTRA_COLUMNS, EXTRAS, RESET_STATES, CHECKPOINTS, CLOCK, HOST, CONSOLE})
"""The tables that an archive need not have."""
EXTRA_PREFIX: Final = "extra_"
_MAY_BE_NULL: Final = frozenset({"data", "seed"})


def may_be_null(column: str) -> bool:
    """Return whether a column is nullable.

    That is the data of a snapshot that a replay computes, the seed of a reset without one, and the extras of
    a step without them.
    """
    return column in _MAY_BE_NULL or column.startswith(EXTRA_PREFIX)


ENCODINGS: Final = {
    **dict.fromkeys(("position", "step", "episode", "last_step"), "DELTA_BINARY_PACKED"),
    **dict.fromkeys(("t", "state", "next_state", "action"), "BYTE_STREAM_SPLIT"),
    **dict.fromkeys(("explored", "terminated", "success"), "PLAIN"),
    "truncated": "RLE",
}
"""The encodings of columns of steps and episodes; all others have a dictionary."""
VALUES: Final = ("action_", "observation", "next_observation", EXTRA_PREFIX)
"""The prefixes of columns with values of spaces; floats are split by byte."""


@dataclass(frozen=True)
class Table:
    """A table of messages."""

    name: str
    """Its file."""
    topics: tuple[Topic, ...]
    """The topics of its messages: one, or one of training and one of evaluation."""
    columns: pa.Schema


@dataclass(frozen=True)
class Column:
    """A column of fixed-width messages: how it is read from message records, and written back."""

    name: str
    type: pa.DataType
    read: Callable[[Records], object]
    """Returns the column, [n], of records."""
    write: Callable[[Records, pa.Array], None] | None = None
    """Sets the records' field; None if other columns determine it."""


def encodings_of(columns: pa.Schema) -> dict[str, str]:
    """Return the encodings of the columns without a dictionary; none for a table with lists."""
    if any(pa.types.is_list(kind) for kind in columns.types):
        return {}
    values = {"value"} | {name for name in columns.names if name.startswith(VALUES)}
    split = {one.name for one in columns if one.name in values and pa.types.is_floating(one.type)}
    numbers = (one.name for one in columns if not pa.types.is_string(one.type))
    special = {name: ENCODINGS[name] for name in numbers if name in ENCODINGS}
    plain = {one.name for one in columns if pa.types.is_fixed_size_binary(one.type)}
    return special | dict.fromkeys(split, "BYTE_STREAM_SPLIT") | dict.fromkeys(plain, "PLAIN")


def row_bytes(columns: pa.Schema) -> int:
    """Return the approximate size of a row in memory; a text counts as a pointer."""
    return sum(kind.byte_width if pa.types.is_fixed_size_binary(kind) else 8 for kind in columns.types)
