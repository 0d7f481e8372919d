"""Restores a recording from an archive, written by the recorder's own pipeline and proven by its hashes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from blake3 import blake3

from runner.archive import layout
from runner.archive.columns import Records, of_phase, record_bytes, records_of
from runner.archive.manifest import Entry, Manifest
from runner.archive.reading import Archive
from runner.archive.replay import Meetings, Tables
from runner.archive.rows import message_payload
from runner.config import from_mapping
from runner.errors import RecordingError, StorageError
from runner.recording import schema
from runner.recording.chunks import MAX_CHUNK_BYTES, Packing
from runner.recording.messages import QTable, encode_q_table
from runner.recording.pipeline import Pipeline
from runner.recording.reader import open_recording
from runner.recording.recorder import EPISODES_A_BLOCK, storage_error
from runner.recording.schema import STEP_NANOSECONDS, Topic
from runner.recording.writer import RecordingFile

_ROWS_AT_ONCE: Final = 1024
_MOST_STEPS: Final = 2**63 // STEP_NANOSECONDS
_UNDER_WAY: Final = 8
"""Blocks on their way to the file: as many as the recorder has of a topic."""


def restore(folder: Path, path: Path, report: Callable[[int], None] = lambda _: None) -> Manifest:
    """Write the recording of an archive to a new file; return the archive's manifest.

    Args:
        folder: the archive.
        path: the file; there is none yet. What goes wrong leaves none.
        report: called with the steps restored so far.

    Raises:
        RecordingError: the archive is damaged, or does not give the content it is said to hold.
        StorageError: the file cannot be written.
    """
    archive = Archive(folder)
    archive.check_files()
    try:
        with RecordingFile(path) as file:
            _Restoring(archive, file, report).restore()
        with open_recording(path):  # what cannot be read is not restored
            pass
    except OSError as error:
        path.unlink(missing_ok=True)
        raise StorageError(f"{path}: cannot be written ({error.strerror}).") from error
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    return archive.manifest


def check(folder: Path, report: Callable[[int], None] = lambda _: None) -> Manifest:
    """Restore an archive in memory alone, and return its manifest; errors as for `restore`."""
    archive = Archive(folder)
    archive.check_files()
    _Restoring(archive, None, report).restore()
    return archive.manifest


@dataclass(frozen=True)
class _Row:
    """A row of snapshots, and its step."""

    step: int
    row: dict[str, Any]


class _Restoring:
    """One archive on its way into a file, or into hashes alone."""

    def __init__(self, archive: Archive, file: RecordingFile | None, report: Callable[[int], None]) -> None:
        self._archive = archive
        self._file = file
        self._report = report
        self._where = str(archive.folder)
        self._config = from_mapping(archive.config)
        plan = self._config.recording
        self._chunk_steps = plan.chunk_steps
        self._pipeline = Pipeline(file, Packing(plan.compression, plan.level or 0, plan.index), lambda: None)
        self._room = threading.Semaphore(_UNDER_WAY)
        self._log = blake3()
        self._counts = {topic.name: 0 for topic in schema.TOPICS}
        self._steps_done = 0

    def restore(self) -> None:
        """Restore everything, and compare its hashes with those in the manifest."""
        try:
            self._describe()
            self._restore_steps()
            self._restore_blocks(
                layout.EPISODES, (schema.TRAIN_EPISODE, schema.EVAL_EPISODE), self._send_episodes
            )
            for topic in layout.ROW_BY_ROW:
                for row in self._rows(topic):
                    self._send_message(topic, row["position"], self._payload(topic, row))
        finally:
            self._pipeline.close()
        self._raise_failure()
        self._compare()
        if self._file is not None:
            result = self._archive.metadata.get("result")
            self._file.finish("" if result is None else "result", result)

    def _describe(self) -> None:
        if self._file is None:
            return
        for name, entries in self._archive.metadata.items():
            if name != "result":
                self._file.add_metadata(name, entries)
        for name, media_type in self._archive.attachments:
            self._file.add_attachment(name, media_type, self._archive.attachment(name))

    def _restore_steps(self) -> None:
        seed = int(self._archive.metadata["run"]["seed"])
        tables = Tables(self._archive.config, self._archive.mdp, seed, self._where)
        meetings = Meetings(tables, self._snapshots(), partial(self._restore_snapshot, tables))

        def send(topic: Topic, records: Records) -> None:
            if topic is schema.TRAIN_STEP:
                meetings.take(records)
            self._send_block(topic, records, self._chunk_steps)
            self._steps_done += len(records)
            self._report(self._steps_done)

        self._restore_blocks(layout.STEPS, (schema.TRAIN_STEP, schema.EVAL_STEP), send)
        meetings.finish()

    def _restore_blocks(
        self, name: str, topics: tuple[Topic, Topic], send: Callable[[Topic, Records], None]
    ) -> None:
        """Send on the rows of a table of training and evaluation, as records."""
        archive = self._archive
        columns = archive.shape.steps if name == layout.STEPS else archive.shape.episodes
        for batch in archive.batches(name, columns, archive.count(*topics), self._chunk_steps):
            for topic in topics:
                mine = of_phase(batch, topic.phase, f"{self._where}: {name}")
                if mine.num_rows:
                    send(topic, records_of(topic, mine, archive.shape))

    def _send_episodes(self, topic: Topic, records: Records) -> None:
        self._send_block(topic, records, EPISODES_A_BLOCK)

    def _send_block(self, topic: Topic, records: Records, most: int) -> None:
        """Send records to the file, at most so many a chunk."""
        for start in range(0, len(records), most):
            some = records[start : start + most]
            offsets = np.arange(len(some), dtype=np.uint64) * np.uint64(some.itemsize)
            self._send(topic, record_bytes(some), some["log_time"], offsets)

    def _send_message(self, topic: Topic, position: int, payload: bytes) -> None:
        time = position * STEP_NANOSECONDS
        if not 0 <= position < _MOST_STEPS or len(payload) > MAX_CHUNK_BYTES - schema.HEADER_BYTES:
            raise RecordingError(
                f"{self._where}: {topic.name}: found {len(payload):,} bytes after {position} steps."
            )
        record = memoryview(schema.message_record(topic, time, payload))
        if topic is schema.LOG_TOPIC:
            self._log.update(record)
        self._send(topic, record, np.array([time], np.uint64), np.zeros(1, np.uint64))

    def _send(self, topic: Topic, records: memoryview, times: Any, offsets: Any) -> None:
        self._raise_failure()
        self._counts[topic.name] += len(times)
        self._room.acquire()
        self._pipeline.send(topic, records, times, offsets, used=self._room.release)

    def _raise_failure(self) -> None:
        failure = self._pipeline.failure
        if isinstance(failure, OSError) and self._file is not None:
            raise storage_error(self._file, failure) from failure
        if failure is not None:
            raise failure

    def _rows(self, topic: Topic) -> Iterator[dict[str, Any]]:
        """Yield the rows of a topic's own table."""
        name = layout.MESSAGES[topic]
        n = 1 if topic is schema.Q_TABLE_TOPIC else _ROWS_AT_ONCE
        for batch in self._archive.batches(name, layout.SCHEMAS[name], self._archive.count(topic), n):
            yield from batch.to_pylist()

    def _payload(self, topic: Topic, row: dict[str, Any]) -> bytes:
        try:
            return message_payload(topic, row["position"], row)
        except (TypeError, ValueError, OverflowError) as error:
            raise RecordingError(
                f"{self._where}: {topic.name} after {row['position']} steps: makes no sense ({error})."
            ) from error

    def _snapshots(self) -> Iterator[_Row]:
        return (_Row(row["step"], row) for row in self._rows(schema.Q_TABLE_TOPIC))

    def _restore_snapshot(self, tables: Tables, snapshot: _Row) -> None:
        """Send a snapshot, from its values or as the steps before it make it."""
        row = snapshot.row
        where = f"{self._where}: the Q-table of {row['agent']!r} after {row['step']} steps"
        if row["data"] is None:
            values = tables.at(row["step"], row["table"])
            if values is None:
                raise RecordingError(f"{where}: neither its values are there, nor all steps before it.")
            if blake3(values.tobytes()).hexdigest() != row["blake3"]:
                raise RecordingError(
                    f"{where}: the steps before it make other values here than where it was archived: "
                    "another processor, or version of this software; `dualtaxi show` tells which made it."
                )
        else:
            shape = row["states"], row["actions"]
            if min(shape) < 1 or shape[0] * shape[1] * 8 != len(row["data"]):
                raise RecordingError(f"{where}: found {len(row['data']):,} bytes for {shape} values.")
            values = np.frombuffer(row["data"], "<f8").reshape(shape)
            tables.give(row["step"], row["table"], values)
        table = QTable(row["step"], row["episode"], row["agent"], row["table"], values)
        self._send_message(schema.Q_TABLE_TOPIC, row["position"], encode_q_table(table))

    def _compare(self) -> None:
        """Compare what was restored with what was archived."""
        hashes = self._pipeline.hash.topics() | {schema.LOG_TOPIC.name: self._log.hexdigest()}
        found = {name: Entry(count, hashes[name]) for name, count in self._counts.items() if count}
        for name in sorted(found.keys() | self._archive.manifest.topics.keys()):
            told, expected = found.get(name), self._archive.manifest.topics.get(name)
            if told != expected:
                raise RecordingError(
                    f"{self._where}: {name}: restored {_in_words(told)}, expected {_in_words(expected)}."
                )


def _in_words(entry: Entry | None) -> str:
    return "nothing" if entry is None else f"{entry.size:,} messages of BLAKE3 {entry.blake3[:16]}…"
