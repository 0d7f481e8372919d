"""Writes a recording as an archive: tables of Parquet, its metadata and attachments, and a manifest.

Memory does not grow with the run: blocks of records become batches of columns, which are packed and
written in groups of rows, beside the reading.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import pyarrow as pa
import pyarrow.parquet as pq
from blake3 import blake3

from runner.archive import layout
from runner.archive.columns import checked_batch, merged, record_bytes, shape_of
from runner.archive.descriptions import description_tables, run_table
from runner.archive.layout import Shape
from runner.archive.manifest import Entry, Manifest, entries_of, is_inside
from runner.archive.replay import Meetings, Tables
from runner.archive.rows import PlacedTable, message_payload, message_row, snapshot_row
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.messages import decode_q_table, encode_q_table
from runner.recording.reader import Recording
from runner.recording.schema import STEP_NANOSECONDS, Topic

ROWS_A_GROUP: Final = 1 << 18
BYTES_A_GROUP: Final = 32 << 20
PAGE_BYTES: Final = 1 << 18
LEVEL: Final = 9
"""Of zstd: beyond it a step takes a tenth of a byte less, and packing three times as long."""
_ROWS_AT_ONCE: Final = 1024
_STEPS: Final = (schema.TRAIN_STEP, schema.EVAL_STEP)
_EPISODES: Final = (schema.TRAIN_EPISODE, schema.EVAL_EPISODE)


def step_batches(recording: Recording, stop: int | None = None) -> Iterator[pa.RecordBatch]:
    """Yield the steps of a recording as Arrow columns, in the order taken, some thousands at a time.

    Args:
        recording: whose.
        stop: how many of training, and of evaluation, at most; None for all.

    Raises:
        RecordingError: a step is damaged.
    """
    shape = _shape(recording)
    for topic, records in merged(recording, _STEPS, stop):
        yield checked_batch(topic, records, shape, str(recording.path))


def episode_batches(recording: Recording, stop: int | None = None) -> Iterator[pa.RecordBatch]:
    """Yield the ends of episodes of a recording in the same way."""
    shape = _shape(recording)
    for topic, records in merged(recording, _EPISODES, stop):
        yield checked_batch(topic, records, shape, str(recording.path))


def write_archive(
    recording: Recording, folder: Path, report: Callable[[int], None] = lambda _: None
) -> Manifest:
    """Write a recording into a folder as an archive, the manifest last; return the manifest.

    Args:
        recording: finished or not; what is there is written.
        folder: an empty one, made for it.
        report: called with the steps written so far.

    Raises:
        RecordingError: the recording is damaged, or holds what no recorder writes.
        OSError: the folder cannot be written.
    """
    recording.require_job("an archive of tables", "`dualtaxi pack` puts it into one file.")
    manifest = _Writing(recording, folder, report).write()
    (folder / layout.MANIFEST).write_bytes(manifest.to_json())
    return manifest


def _shape(recording: Recording) -> Shape:
    recording.require_job(
        "a table of its steps", "`runner.open_recording` reads its steps, docs/record-your-own.md says how."
    )
    return shape_of(recording.run, recording.mdp, str(recording.path))


class TableWriter:
    """A Parquet file on its way to disk; batches are packed beside the caller, a group of rows at a time."""

    def __init__(self, path: Path, columns: pa.Schema, level: int = LEVEL) -> None:
        encodings = {name: layout.ENCODINGS[name] for name in columns.names if name in layout.ENCODINGS}
        flat = not any(pa.types.is_list(kind) for kind in columns.types)
        self._writer = pq.ParquetWriter(
            path,
            columns,
            compression="zstd",
            compression_level=level,
            data_page_size=PAGE_BYTES,
            use_dictionary=[name for name in columns.names if name not in encodings] if flat else True,
            column_encoding=encodings if flat else None,
        )
        self._waiting: list[pa.RecordBatch] = []
        self._rows = self._bytes = 0
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="parquet")
        self._under_way: Future[None] | None = None

    def add(self, batch: pa.RecordBatch) -> None:
        """Add rows."""
        self._waiting.append(batch)
        self._rows += batch.num_rows
        self._bytes += batch.nbytes
        if self._rows >= ROWS_A_GROUP or self._bytes >= BYTES_A_GROUP:
            self._send()

    def _send(self) -> None:
        if self._under_way is not None:
            self._under_way.result()
        table = pa.Table.from_batches(self._waiting)
        self._under_way = self._thread.submit(self._writer.write_table, table, table.num_rows)
        self._waiting, self._rows, self._bytes = [], 0, 0

    def close(self) -> None:
        """Write what is left, and the footer."""
        if self._waiting:
            self._send()
        if self._under_way is not None:
            self._under_way.result()
        self._thread.shutdown()
        self._writer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        else:
            self._thread.shutdown()
            self._writer.close()


class _Writing:
    """One recording being written as an archive."""

    def __init__(self, recording: Recording, folder: Path, report: Callable[[int], None]) -> None:
        self._recording = recording
        self._folder = folder
        self._report = report
        self._where = str(recording.path)
        self._shape = _shape(recording)
        self._hashes = {topic.name: blake3() for topic in schema.TOPICS}
        self._counts = dict.fromkeys(self._hashes, 0)

    def write(self) -> Manifest:
        """Write all but the manifest."""
        self._write_descriptions()
        self._write_steps()
        self._write_blocks(layout.EPISODES, _EPISODES, self._shape.episodes)
        for topic in layout.ROW_BY_ROW:
            self._write_messages(topic)
        topics = {
            name: Entry(count, self._hashes[name].hexdigest())
            for name, count in self._counts.items()
            if count
        }
        self._compare(topics)
        return self._manifest(topics)

    def _manifest(self, topics: dict[str, Entry]) -> Manifest:
        facts = self._recording.run_facts()
        run = {key: facts[key] for key in ("run_id", "name", "seed", "created", "status")}
        run |= {"content_digest": self._recording.result.get("content_digest"), "lost": self._recording.lost}
        return Manifest(run, topics, entries_of(self._folder))

    def _compare(self, topics: dict[str, Entry]) -> None:
        """Compare what was read with what the recording says it holds."""
        result = self._recording.result
        stated = result.get("topic_digests") or {}
        left_out = set() if result.get("steps_recorded", True) else {topic.name for topic in _STEPS}
        for name in (
            sorted((stated.keys() | topics.keys()) - left_out - {schema.LOG_TOPIC.name}) if stated else ()
        ):
            found = topics[name].blake3 if name in topics else "nothing"
            if found != stated.get(name):
                raise RecordingError(
                    f"{self._where}: {name}: found {found}, expected {stated.get(name, 'nothing')} "
                    "by its result: it is damaged."
                )

    def _note(self, topic: Topic, records: bytes | memoryview, count: int) -> None:
        self._hashes[topic.name].update(records)
        self._counts[topic.name] += count

    def _write_descriptions(self) -> None:
        recording, attachments = self._recording, []
        for name, media_type, data in recording.attachments():
            if not is_inside(name):
                raise RecordingError(
                    f"{self._where}: found an attachment {name!r}, whose name is no path within."
                )
            attachments.append([name, media_type])
            path = self._folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        metadata = [[name, recording.metadata(name)] for name in recording.metadata_names]
        said = {"metadata": metadata, "attachments": attachments}
        (self._folder / layout.METADATA).write_text(json.dumps(said, indent=1), encoding="utf-8")
        tables = {layout.RUN: run_table(recording), **description_tables(recording.mdp, self._shape)}
        for name, table in tables.items():
            pq.write_table(table, self._folder / name, compression="zstd", compression_level=LEVEL)

    def _write_steps(self) -> None:
        recording = self._recording
        tables = Tables(recording.config, recording.mdp, int(recording.run["seed"]), self._where)
        with (
            TableWriter(self._folder / layout.Q_TABLES, layout.SCHEMAS[layout.Q_TABLES]) as snapshots,
            TableWriter(self._folder / layout.STEPS, self._shape.steps) as steps,
        ):
            meetings = Meetings(
                tables, self._snapshots(), lambda table: snapshots.add(self._snapshot_row(tables, table))
            )
            for topic, records in merged(recording, _STEPS):
                steps.add(checked_batch(topic, records, self._shape, self._where))
                self._note(topic, record_bytes(records), len(records))
                if topic is schema.TRAIN_STEP:
                    meetings.take(records)
                self._report(sum(self._counts[topic.name] for topic in _STEPS))
            meetings.finish()

    def _write_blocks(self, name: str, topics: tuple[Topic, Topic], columns: pa.Schema) -> None:
        with TableWriter(self._folder / name, columns) as table:
            for topic, records in merged(self._recording, topics):
                table.add(checked_batch(topic, records, self._shape, self._where))
                self._note(topic, record_bytes(records), len(records))

    def _snapshots(self) -> Iterator[PlacedTable]:
        for position, payload in self._messages(schema.Q_TABLE_TOPIC):
            table = decode_q_table(payload)
            self._same(schema.Q_TABLE_TOPIC, position, encode_q_table(table), payload)
            yield PlacedTable(position, table)

    def _snapshot_row(self, tables: Tables, snapshot: PlacedTable) -> pa.RecordBatch:
        """Return the row of a snapshot: without its values if the steps before it tell them."""
        table = snapshot.table
        made = tables.at(table.step, table.table)
        told = made is not None and made.tobytes() == table.values.tobytes()
        if not told:
            tables.give(table.step, table.table, table.values)
        row = snapshot_row(self._shape.run_id, snapshot, with_values=not told)
        return pa.RecordBatch.from_pylist([row], layout.SCHEMAS[layout.Q_TABLES])

    def _write_messages(self, topic: Topic) -> None:
        columns = layout.SCHEMAS[layout.MESSAGES[topic]]
        with TableWriter(self._folder / layout.MESSAGES[topic], columns) as table:
            for rows in _batched(self._rows(topic), _ROWS_AT_ONCE):
                table.add(pa.RecordBatch.from_pylist(rows, columns))

    def _rows(self, topic: Topic) -> Iterator[dict[str, Any]]:
        for position, payload in self._messages(topic):
            row = message_row(topic, payload)
            self._same(topic, position, message_payload(topic, position, row), payload)
            yield row | {"run_id": self._shape.run_id, "position": position}

    def _messages(self, topic: Topic) -> Iterator[tuple[int, bytes]]:
        """Yield position and payload of a topic's messages."""
        for time, payload in self._recording.messages(topic):
            position, rest = divmod(time, STEP_NANOSECONDS)
            if rest:
                raise self._foreign(topic, f"at {time} ns")
            self._note(topic, schema.message_record(topic, time, payload), 1)
            yield position, payload

    def _same(self, topic: Topic, position: int, made: bytes, payload: bytes) -> None:
        if made != payload:
            raise self._foreign(topic, f"after {position} steps")

    def _foreign(self, topic: Topic, place: str) -> RecordingError:
        return RecordingError(
            f"{self._where}: {topic.name} {place}: found a message that no recorder writes, so that columns "
            "cannot hold it; `dualtaxi verify` tells more."
        )


def _batched(rows: Iterator[dict[str, Any]], n: int) -> Iterator[list[dict[str, Any]]]:
    """Yield the rows in lists of n; the last may be shorter."""
    while some := list(islice(rows, n)):
        yield some
