"""The files of an archive: its tables, the encodings of their columns, and the manifest.

The files of a run are in the folder of its id: the tables and other files below, the attachments of the
recording by their names, and the manifest with size and hash of every file, which is written last.

A column is for readers, or for restoring the recording; most are for both. Run and phase are columns of each
table, so that tables of many runs can be read as one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePosixPath
from typing import Annotated, Final

import pyarrow as pa
from blake3 import blake3
from msgspec import Meta

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.digest import combined_digest
from runner.recording.marks import MARKS_FILE
from runner.recording.schema import MessageType
from runner.util.files import hash_of
from runner.util.stored import stored_as
from runner.util.values import JsonView

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

TEXT: Final = pa.dictionary(pa.int8(), pa.string())
"""Repeated text: a category in pandas and Polars, plain text in DuckDB."""


TOPICS: Final = {
    STEPS: schema.STEP_TOPICS,
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
_OWN_FILES: Final = frozenset(
    {*TOPICS, Q_TABLES, RUN, TRANSITIONS, STATES, ACTIONS, METADATA, MANIFEST, MARKS_FILE}
)
"""The files of archives whose names no attachment can have."""
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
"""The prefix of the columns of extras, which are null at a step without them."""
NULLABLE: Final = frozenset({"data", "seed"})
"""The other nullable columns: the data of a snapshot that a replay computes, and the seed of a reset."""


def encodings_of(columns: pa.Schema) -> dict[str, str]:
    """Return the encodings of the columns without a dictionary; none for a table with lists."""
    if any(map(pa.types.is_list, columns.types)):
        return {}
    encodings = {}
    for column in columns:
        if pa.types.is_integer(column.type):
            encodings[column.name] = "DELTA_BINARY_PACKED"
        elif pa.types.is_floating(column.type):
            encodings[column.name] = "BYTE_STREAM_SPLIT"
        elif pa.types.is_fixed_size_binary(column.type):
            encodings[column.name] = "PLAIN"
    return encodings


MAX_MANIFEST_BYTES: Final = 1 << 20


@dataclass(frozen=True)
class Entry:
    """A file of an archive, or the messages of a topic: size or number, and BLAKE3."""

    size: Annotated[int, Meta(ge=0, le=2**53)]
    blake3: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]


@dataclass(frozen=True)
class Manifest:
    """The description of an archive."""

    run: JsonView
    """Id, name, seed, creation and status of the run, and the content digest that its result states."""
    topics: Mapping[str, Entry]
    """The messages in the archive, by topic."""
    files: Mapping[str, Entry] = field(default_factory=dict)
    """Every other file, by its path in the archive's folder."""
    format: str = FORMAT
    version: int = VERSION

    @property
    def run_id(self) -> str:
        """The run's id."""
        return str(self.run["run_id"])

    @property
    def digest(self) -> str:
        """The content digest of the messages in the archive; without steps, it is not that of the run."""
        digested = self.topics.keys() & schema.DIGESTED
        return combined_digest({name: self.topics[name].blake3 for name in digested})

    @property
    def size(self) -> int:
        """Bytes of all files but this one."""
        return sum(entry.size for entry in self.files.values())

    def to_json(self) -> bytes:
        """Return the manifest as a file: JSON with a seal, the BLAKE3 of the rest."""
        values = asdict(self)
        return _json(values | {"seal": blake3(_json(values)).hexdigest()})


def _json(values: Mapping[str, object]) -> bytes:
    return json.dumps(values, indent=1, sort_keys=True).encode() + b"\n"


def read_manifest(data: bytes, where: str) -> Manifest:
    """Return the manifest in a file's bytes.

    Raises:
        RecordingError: they are not a manifest of a dualtaxi archive.
    """
    try:
        values = json.loads(data[:MAX_MANIFEST_BYTES])
        if values["format"] != FORMAT:
            raise ValueError(f"found format {values['format']!r}")
        if values["version"] != VERSION:
            raise RecordingError(
                f"{where}: found an archive of version {values['version']!r}, expected {VERSION}: it takes "
                "another version of dualtaxi to restore it; its tables can be read all the same."
            )
        manifest = stored_as(Manifest, values, f"{where}: is not the manifest of an archive")
        if strange := [name for name in manifest.files if not is_inside(name)]:
            raise ValueError(f"the file {strange[0]!r} would leave the archive")
        for name in ("run_id", "name", "created", "status"):
            if not isinstance(manifest.run[name], str):
                raise ValueError(f"the {name} of its run is {manifest.run[name]!r}")
        if unknown := manifest.topics.keys() - {topic.name for topic in schema.ALL_TOPICS}:
            raise ValueError(f"it has topics {sorted(unknown)}")
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise RecordingError(f"{where}: is not the manifest of an archive ({error}).") from error
    if manifest.to_json() != data:
        raise RecordingError(f"{where}: does not match its seal: it was changed, and the archive is damaged.")
    return manifest


def is_attachment(name: str) -> bool:
    """Return whether an archive can have an attachment of this name: it is not that of another file."""
    folded = name.casefold()  # some systems take names that differ in case for one file
    return is_inside(name) and folded not in _OWN_FILES and not folded.startswith(CONTENTS)


def is_inside(name: str) -> bool:
    """Return whether a name is a plain path that stays in the folder it is looked up in, on any system."""
    path = PurePosixPath(name)
    plain = bool(name) and name.isprintable() and not set(name) & set('\\:*?"<>|') and len(name) < 200
    return plain and str(path) == name and not path.is_absolute() and ".." not in path.parts and name != "."


def entries_of(folder: Path) -> dict[str, Entry]:
    """Return size and hash of every file of an archive but its manifest, by name.

    Raises:
        OSError: one cannot be read.
    """
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / MANIFEST)
    return {path.relative_to(folder).as_posix(): Entry(*hash_of(path)) for path in files}
