"""Read an archive in a local folder: nothing in it is used before it was compared with the manifest.

The manifest may be forged too, so what a table declares (columns, rows) is compared with what archives have
before any of it is decompressed. The memory limit of `places.restore_to` bounds the rest.

A recording is restored through the recorder's own pipeline, and checked by its hashes.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from blake3 import blake3

from runner.archive import layout
from runner.archive.batches import bytes_of, records_of
from runner.archive.columns import Shape, Table, numbers
from runner.archive.layout import MAX_MANIFEST_BYTES, Entry, Manifest, is_attachment, read_manifest
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.description import RunDescription
from runner.recording.extras import ExtraNames
from runner.recording.layout import message_record
from runner.recording.messages import QTable, encode_q_table
from runner.recording.metadata import check_run, json_object
from runner.recording.pipeline import MessageBatches, Pipeline
from runner.recording.reader import open_recording
from runner.recording.recorder import capacity_of
from runner.recording.records import MAX_UNPACKED_RATIO
from runner.recording.schema import MAX_LAYOUTS, STEP_NANOSECONDS, Topic
from runner.recording.writer import RecordingFile
from runner.util.arrays import Records, Unsigned
from runner.util.files import hash_of, open_regular, storage_errors
from runner.util.packing import MAX_CHUNK_BYTES
from runner.util.processes import Report
from runner.util.stored import stored_as
from runner.util.values import Json

if TYPE_CHECKING:
    from runner.replay.tables import DerivedTables

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
                size = path.stat().st_size
                found = Entry(*hash_of(path)) if size == expected.size else None
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
        if strange := [
            name for name, _ in named if not is_attachment(name) or name not in self.manifest.files
        ]:
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


# --- restoring a recording ----------------------------------------------------------------------------

_ROWS_AT_ONCE: Final = 1024
_EXTRAS_AT_ONCE: Final = 64
"""Of extras of varying size, which may take 1 MB a step."""
_MAX_PENDING: Final = 8
"""Blocks in the pipeline: as many as the recorder has of a topic."""


def restore(folder: Path, path: Path | None = None, report: Report = lambda _: None) -> Manifest:
    """Write the recording of an archive to a new file; return the archive's manifest.

    Args:
        path: the file, which does not exist yet; nor does it after an error. None restores in memory alone,
            which checks the archive.
    """
    archive = Archive(folder)
    archive.check_files()
    if path is None:
        _Restorer(archive, None, report).restore()
        return archive.manifest
    try:
        with storage_errors(path), RecordingFile(path, archive.layout) as file:
            _Restorer(archive, file, report).restore()
        with open_recording(path):  # raises if it cannot be read
            pass
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    return archive.manifest


class _Restorer:
    """Restores one archive into a file, or into hashes only."""

    def __init__(self, archive: Archive, file: RecordingFile | None, report: Report) -> None:
        from runner.config.loading import recorded_packing  # needs pydantic

        self._archive = archive
        self._file = file
        self._report = report
        self._where = str(archive.folder)
        self._shape = archive.shape
        packing = recorded_packing(archive.config)
        self._chunk_steps = packing.chunk_steps
        self._pipeline = Pipeline(file, packing, lambda: None)
        self._batches = MessageBatches(self._send_chunk)
        self._pending = threading.Semaphore(_MAX_PENDING)
        topics = archive.topics
        self._undigested = {topic: blake3() for topic in topics if not topic.digested}
        self._counts = {topic.name: 0 for topic in topics}

    def restore(self) -> None:
        """Restore everything, and compare its hashes with those of the manifest."""
        try:
            if self._file is not None:
                for extras in self._shape.extras:
                    self._file.declare(extras.beginning)
                for name in self._archive.metadata_names:
                    if name != "result":
                        self._file.add_metadata(name, self._archive.metadata(name))
                for name, media_type in self._archive.attachments:
                    self._file.add_attachment(name, media_type, self._archive.attachment(name))
            for table in self._shape.tables.values():
                if table.name in layout.LEFT_OUT_IF_EMPTY and not self._archive.count(*table.topics):
                    continue
                if table.gives_tables:
                    self._restore_learning(table)
                else:
                    for topic, records in self._records(table):
                        self._send(topic, records)
                self._batches.flush()
        finally:
            self._pipeline.close()
        self._pipeline.raise_failure()
        self._compare()
        if self._file is not None:
            names = self._archive.metadata_names
            self._file.finish(self._archive.metadata("result") if "result" in names else None)

    def _restore_learning(self, table: Table) -> None:
        """Restore the steps of a job, and the snapshots that they make."""
        seed = self._archive.seed or 0
        from runner.replay.tables import DerivedTables, StepReplay  # needs Numba

        replay = StepReplay(self._archive.config, self._archive.mdp, seed, self._where)
        tables = DerivedTables(replay, self._snapshots(), self._restore_snapshot)
        for topic, records in self._records(table):
            if topic is schema.TRAIN_STEP:
                tables.take(records)
            self._send(topic, records)
        tables.finish()

    def _records(self, table: Table) -> Iterator[tuple[Topic, Records]]:
        """Yield the rows of a table as records, at most as many as a chunk has."""
        archive, topics = self._archive, table.topics
        sources = self._shape.topics_of(table)
        rows = min(capacity_of(topic, self._shape.messages[topic], self._chunk_steps) for topic in sources)
        if any(self._shape.dtypes[topic].hasobject for topic in sources):
            has_bytes = any(map(pa.types.is_binary, table.columns.types))
            most = _EXTRAS_AT_ONCE if table.name == layout.EXTRAS else _ROWS_AT_ONCE
            rows = 1 if has_bytes else min(rows, most)
        for batch in archive.batches(table.name, table.columns, archive.count(*topics), rows):
            for topic, mine in self._by_topic(table, batch):
                try:
                    yield from records_of(table, topic, mine, self._shape)
                except (TypeError, ValueError, OverflowError) as error:
                    raise RecordingError(
                        f"{self._where}: {table.name}: {topic.name}: is invalid ({error})."
                    ) from error

    def _by_topic(self, table: Table, batch: pa.RecordBatch) -> Iterator[tuple[Topic, pa.RecordBatch]]:
        """Yield the rows of each topic.

        Raises:
            RecordingError: there is a phase that none of the topics has.
        """
        if len(table.topics) == 1:
            yield table.topics[0], batch
            return
        topics = {topic.phase: topic for topic in table.topics}
        phases = batch.column("phase")
        names = phases.dictionary.to_pylist()
        codes = numbers(phases.indices)
        for code in np.unique(codes).tolist():
            if names[code] not in topics:
                raise RecordingError(
                    f"{self._where}: {table.name}: found phases {names}, expected {list(topics)}."
                )
            mine = codes == code
            yield topics[names[code]], batch if mine.all() else batch.filter(pa.array(mine))

    def _send(self, topic: Topic, records: Records) -> None:
        """Send records to the file: as a chunk, or as messages that share chunks."""
        times = records["log_time"]
        if records.dtype.hasobject:
            self._send_messages(topic, times.tolist(), records["record"].tolist())
        else:
            offsets = np.arange(len(records), dtype=np.uint64) * np.uint64(records.itemsize)
            self._send_chunk(topic, bytes_of(records), times, offsets)

    def _send_messages(self, topic: Topic, times: list[int], messages: list[bytes]) -> None:
        for time, message in zip(times, messages, strict=True):
            if len(message) > MAX_CHUNK_BYTES:
                raise RecordingError(
                    f"{self._where}: {topic.name}: found a message of {len(message):,} bytes."
                )
            if not topic.digested:
                self._undigested[topic].update(message)
            self._batches.add(topic, [time], [message])
            if topic.message is schema.IMAGE:
                self._batches.flush()

    def _send_chunk(self, topic: Topic, records: memoryview, times: Unsigned, offsets: Unsigned) -> None:
        self._pipeline.raise_failure()
        self._counts[topic.name] += len(times)
        if topic.name in schema.STEP_TOPICS:
            self._report(sum(self._counts[name] for name in schema.STEP_TOPICS))
        self._pending.acquire()
        self._pipeline.send(topic, records, times, offsets, done=self._pending.release)

    def _snapshots(self) -> Iterator[tuple[int, Json]]:
        count = self._archive.count(schema.Q_TABLE_TOPIC)
        for batch in self._archive.batches(layout.Q_TABLES, layout.Q_TABLE_COLUMNS, count, 1):
            yield from ((row["step"], row) for row in batch.to_pylist())

    def _restore_snapshot(self, tables: DerivedTables[Json], row: Json) -> None:
        """Send a snapshot: its values, or those that the steps before it give."""
        where = f"{self._where}: the Q-table of {row['agent']!r} after {row['step']} steps"
        if row["data"] is None:
            values = tables.at(row["step"], row["table"])
            if values is None:
                raise RecordingError(f"{where}: found neither its values nor all steps before it.")
            if blake3(values.tobytes()).hexdigest() != row["blake3"]:
                raise RecordingError(
                    f"{where}: the steps before it give other values here than where it was archived: "
                    "another processor, or version of this software; `dualtaxi show` names the first."
                )
        else:
            shape = row["states"], row["actions"]
            if min(shape) < 1 or shape[0] * shape[1] * 8 != len(row["data"]):
                raise RecordingError(f"{where}: found {len(row['data']):,} bytes for {shape} values.")
            values = np.frombuffer(row["data"], "<f8").reshape(shape)
            tables.give(row["step"], row["table"], values)
        table = QTable(row["step"], row["episode"], row["agent"], row["table"], values)
        topic = schema.Q_TABLE_TOPIC
        time = row["position"] * STEP_NANOSECONDS
        self._send_messages(topic, [time], [message_record(topic, time, encode_q_table(table))])

    def _compare(self) -> None:
        """Compare what was restored with what was archived."""
        hashes = self._pipeline.hash.topics()
        hashes |= {topic.name: digest.hexdigest() for topic, digest in self._undigested.items()}
        found = {name: Entry(count, hashes[name]) for name, count in self._counts.items() if count}
        for name in sorted(found.keys() | self._archive.manifest.topics.keys()):
            restored = found.get(name)
            expected = self._archive.manifest.topics.get(name)
            if restored != expected:
                raise RecordingError(
                    f"{self._where}: {name}: restored {_count(restored)}, expected {_count(expected)}."
                )


def _count(entry: Entry | None) -> str:
    return "nothing" if entry is None else f"{entry.size:,} messages of BLAKE3 {entry.blake3[:16]}…"
