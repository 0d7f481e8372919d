"""The files of an archive, the columns of the tables that are the same in every archive, and encodings.

The files of a run are in the folder of its id: the tables and other files below, the attachments of the
recording by their names, and the manifest, which is written last.

A column is for readers, or for restoring the recording; most are for both. Run and phase are columns of each
table, so that tables of many runs can be read as one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import pyarrow as pa

from runner.recording import schema
from runner.recording.schema import MessageType

FORMAT: Final = "dualtaxi archive"
VERSION: Final = 1

STEPS: Final = "steps.parquet"
EPISODES: Final = "episodes.parquet"
Q_TABLES: Final = "q_tables.parquet"
RESETS: Final = "resets.parquet"
RESET_OPTIONS: Final = "reset_options.parquet"
INFOS: Final = "infos.parquet"
SCALARS: Final = "scalars.parquet"
ARRAYS: Final = "arrays.parquet"
FRAMES: Final = "frames.parquet"
EXTRA_COLUMNS: Final = "extra_columns.parquet"
EXTRAS: Final = "extras.parquet"
CONTENTS: Final = "checkpoints/"
"""The folder of the contents of checkpoints, named by their digests."""
LOG: Final = "log.parquet"
RUN: Final = "run.parquet"
TRANSITIONS: Final = "transitions.parquet"
STATES: Final = "states.parquet"
ACTIONS: Final = "actions.parquet"
METADATA: Final = "metadata.json"
MANIFEST: Final = "manifest.json"

PHASES: Final = ("train", "eval")
TEXT: Final = pa.dictionary(pa.int8(), pa.string())
"""Repeated text: a category in pandas and Polars, plain text in DuckDB."""


TOPICS: Final = {
    STEPS: ("/train/step", "/eval/step"),
    EPISODES: ("/train/episode", "/eval/episode"),
    "train_metrics.parquet": ("/train/metrics",),
    "eval_metrics.parquet": ("/eval/metrics",),
    "optimality.parquet": ("/eval/optimality",),
    RESETS: ("/train/reset", "/eval/reset"),
    INFOS: ("/train/info", "/eval/info"),
    SCALARS: ("/scalar",),
    ARRAYS: ("/array",),
    FRAMES: ("/train/frame", "/eval/frame", "/image"),
    LOG: ("/log",),
    "clock.parquet": ("/clock",),
    "host.parquet": ("/host",),
    "console.parquet": ("/console",),
    "checkpoints.parquet": ("/checkpoint",),
    EXTRA_COLUMNS: ("/extra",),
    EXTRAS: ("/train/extra", "/eval/extra"),
    RESET_OPTIONS: ("/train/reset_options", "/eval/reset_options"),
    "reset_states.parquet": ("/train/reset_state", "/eval/reset_state"),
}
"""The tables of messages in the order in which they are written, without Q-tables, and their topics."""
FIELDS: Final[Mapping[MessageType, tuple[str, ...]]] = {
    schema.STEP: schema.STEP_COLUMNS,
    schema.EPISODE: schema.EPISODE_COLUMNS,
    schema.RESET: ("reset", "episode", "step", "environment", "seed", "observation"),
    schema.LOG: ("name", "level", "message"),
    schema.SCALAR: ("phase", "name", "step", "episode", "value"),
    schema.IMAGE: ("format", "data", "frame_id"),
}
"""The fields that messages may have, in the order of their columns; other messages keep their own order."""
Q_TABLE_COLUMNS: Final = pa.schema(
    [
        ("run_id", TEXT),
        ("position", pa.int64()),
        ("step", pa.int64()),
        ("episode", pa.int64()),
        ("agent", pa.string()),
        *((name, pa.int32()) for name in ("table", "states", "actions")),
        ("blake3", pa.string()),
        ("data", pa.binary()),
    ]
)

LEFT_OUT_IF_EMPTY: Final = {
    "clock.parquet",
    "host.parquet",
    "console.parquet",
    "checkpoints.parquet",
    RESET_OPTIONS,
    "reset_states.parquet",
    EXTRA_COLUMNS,
    EXTRAS,
}
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
    **dict.fromkeys(("position", "step", "episode", "first_step", "last_step"), "DELTA_BINARY_PACKED"),
    **dict.fromkeys(("t", "state", "next_state", "action"), "BYTE_STREAM_SPLIT"),
    **dict.fromkeys(("explored", "terminated", "success"), "PLAIN"),
    **dict.fromkeys(("taken", "truncated"), "RLE"),
}
"""The encodings of columns of steps and episodes; all others have a dictionary."""
VALUES: Final = ("action_", "observation", "next_observation", EXTRA_PREFIX)
"""The prefixes of columns with values of spaces; floats are split by byte."""


def encodings_of(columns: pa.Schema) -> dict[str, str]:
    """Return the encodings of the columns without a dictionary; none for a table with lists."""
    if any(pa.types.is_list(kind) for kind in columns.types):
        return {}
    values = {"value"} | {name for name in columns.names if name.startswith(VALUES)}
    split = {column.name for column in columns if column.name in values and pa.types.is_floating(column.type)}
    numbers = (column.name for column in columns if not pa.types.is_string(column.type))
    special = {name: ENCODINGS[name] for name in numbers if name in ENCODINGS}
    plain = {column.name for column in columns if pa.types.is_fixed_size_binary(column.type)}
    return special | dict.fromkeys(split, "BYTE_STREAM_SPLIT") | dict.fromkeys(plain, "PLAIN")


def row_bytes(columns: pa.Schema) -> int:
    """Return the approximate size of a row in memory; a text counts as a pointer."""
    return sum(kind.byte_width if pa.types.is_fixed_size_binary(kind) else 8 for kind in columns.types)
