"""Read an archive in a local folder: nothing in it is used before it was compared with the manifest.

The manifest may be forged too, so what a table declares (columns, rows) is compared with what archives have
before any of it is decompressed. The memory limit of `places.restore_to` bounds the rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import pyarrow as pa
import pyarrow.parquet as pq

from runner.archive import layout
from runner.archive.columns import Shape
from runner.archive.layout import MAX_MANIFEST_BYTES, Entry, Manifest, is_inside, read_manifest
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.description import RunDescription
from runner.recording.extras import ExtraNames
from runner.recording.metadata import check_run, json_object
from runner.recording.records import MAX_UNPACKED_RATIO
from runner.recording.schema import MAX_LAYOUTS, STEP_NANOSECONDS, Topic
from runner.util.files import hash_of, open_regular
from runner.util.stored import stored_as

MAX_DESCRIPTION_BYTES: Final = 64 << 20
MAX_ROWS_A_GROUP: Final = 1 << 21
_UNPACKED_ANYWAY: Final = 1 << 30
_ROW_BYTES: Final = 88
"""The size of a step in a recording."""


@dataclass(frozen=True)
class _Description:
    """The contents of `metadata.json`: metadata records by name, and name and media type of attachments."""

    metadata: list[tuple[str, dict[str, str]]]
    attachments: list[tuple[str, str]]


class Archive(RunDescription):
    """An archive in a folder."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, self)
        self.folder = folder
        path = folder / layout.MANIFEST
        try:
            with open_regular(path) as stream:
                data = stream.read(MAX_MANIFEST_BYTES + 1)
        except OSError as error:
            raise RecordingError(
                f"{folder}: is no archive: {layout.MANIFEST} cannot be read ({error.strerror})."
            ) from error
        self.manifest: Manifest = read_manifest(data, str(path))

    def check_files(self) -> None:
        """Compare size and hash of every file with what the manifest says.

        Raises:
            RecordingError: one is missing or changed; it is named.
        """
        for name, expected in self.manifest.files.items():
            path = self.folder / name
            try:
                found = Entry(*hash_of(path)) if path.stat().st_size == expected.size else None
                size = path.stat().st_size
            except OSError as error:
                raise RecordingError(
                    f"{path}: cannot be read ({error.strerror}); the archive is damaged."
                ) from error
            if found != expected:
                sizes = f"found {size:,} bytes, expected {expected.size:,}"
                hashes = found and f"found BLAKE3 {found.blake3[:16]}…, expected {expected.blake3[:16]}…"
                raise RecordingError(f"{path}: {hashes or sizes}: the archive is damaged there.")

    @cached_property
    def _description(self) -> _Description:
        where = str(self.folder / layout.METADATA)
        return stored_as(_Description, json_object(self._bytes(layout.METADATA), where), where)

    @cached_property
    def _metadata(self) -> dict[str, dict[str, str]]:
        records = dict(self._description.metadata)
        check_run(records.get("run", {}), str(self.folder))
        return records

    @cached_property
    def attachments(self) -> list[tuple[str, str]]:
        """Name and media type of the recording's attachments, in order."""
        named = self._description.attachments
        if strange := [name for name, _ in named if not is_inside(name) or name not in self.manifest.files]:
            raise RecordingError(f"{self.folder}: has no attachment {strange[0]!r}.")
        return named

    def metadata(self, name: str) -> dict[str, str]:
        """Return a metadata record's entries.

        Raises:
            RecordingError: there is none of that name.
        """
        if name not in self._metadata:
            raise RecordingError(f"{self.folder}: has no metadata {name!r}.")
        return self._metadata[name]

    @property
    def attachment_names(self) -> list[str]:
        """The names of the attachments, in order."""
        return [name for name, _ in self.attachments]

    @property
    def metadata_names(self) -> list[str]:
        """The names of the metadata records, in order."""
        return list(self._metadata)

    @cached_property
    def shape(self) -> Shape:
        """The shape of the run, which determines its tables."""
        shape, count = Shape(self), self.count(schema.EXTRA_COLUMNS_TOPIC)
        if not count or (table := shape.tables.get(layout.EXTRA_COLUMNS)) is None:
            return shape
        columns = [
            (row["position"] * STEP_NANOSECONDS, row)
            for batch in self.batches(table.name, table.columns, count, MAX_LAYOUTS)
            for row in batch.to_pylist()
        ]
        names = ExtraNames(str(self.folder / table.name), columns)
        return Shape(self, list(names.layouts.values()))

    def attachment(self, name: str) -> bytes:
        """Return the data of an attachment.

        Raises:
            RecordingError: there is no such attachment.
        """
        if name not in dict(self.attachments):
            raise RecordingError(f"{self.folder}: has no attachment {name!r}.")
        return self._bytes(name)

    def _bytes(self, name: str) -> bytes:
        path = self.folder / name
        try:
            with open_regular(path) as stream:
                data = stream.read(MAX_DESCRIPTION_BYTES + 1)
            if len(data) > MAX_DESCRIPTION_BYTES:
                raise RecordingError(f"{path}: is larger than {MAX_DESCRIPTION_BYTES:,} bytes.")
            return data
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error

    def count(self, *topics: Topic) -> int:
        """Return the number of messages of these topics."""
        return sum(self.manifest.topics.get(topic.name, Entry(0, "")).size for topic in topics)

    def batches(self, name: str, columns: pa.Schema, rows: int, n: int) -> Iterator[pa.RecordBatch]:
        """Yield the rows of a table in batches.

        Raises:
            RecordingError: it is not such a table.
        """
        path = self.folder / name
        try:
            # pre_buffer would keep everything that was read until the file is closed
            open_regular(path).close()  # opening a pipe would block
            with pq.ParquetFile(path, buffer_size=1 << 16, pre_buffer=False) as file:
                check_table(file, str(path), path.stat().st_size, columns, rows)
                for batch in file.iter_batches(n):
                    for column, values in zip(batch.schema.names, batch.columns, strict=True):
                        is_nullable = column in layout.NULLABLE or column.startswith(layout.EXTRA_PREFIX)
                        if values.null_count and not is_nullable:
                            raise RecordingError(
                                f"{path}: found {values.null_count} rows without {column}, expected none."
                            )
                    yield batch
        except (pa.ArrowException, OSError, OverflowError, MemoryError) as error:
            raise RecordingError(f"{path}: cannot be read as a table ({error}).") from error


def check_table(file: pq.ParquetFile, where: str, size: int, columns: pa.Schema, rows: int) -> None:
    """Check what a table declares, before any of it is unpacked; its file has `size` bytes.

    Raises:
        RecordingError: it has other columns or rows, or is made to exhaust the disk.
    """
    about = file.metadata
    found = file.schema_arrow.remove_metadata()
    if not found.equals(columns):
        raise RecordingError(f"{where}: found columns\n{found}\nexpected\n{columns}")
    if about.num_rows != rows:
        raise RecordingError(f"{where}: found {about.num_rows:,} rows, expected {rows:,}.")
    groups = [about.row_group(k) for k in range(about.num_row_groups)]
    if any(group.num_rows > MAX_ROWS_A_GROUP for group in groups):
        raise RecordingError(f"{where}: has a group of more than {MAX_ROWS_A_GROUP:,} rows.")
    widths = [kind.byte_width if pa.types.is_fixed_size_binary(kind) else 8 for kind in columns.types]
    if rows * max(_ROW_BYTES, sum(widths)) > size * MAX_UNPACKED_RATIO + _UNPACKED_ANYWAY:
        raise RecordingError(f"{where}: {size:,} bytes declare {rows:,} rows; made to exhaust the disk.")
