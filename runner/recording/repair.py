"""Repair of a damaged recording: what is good is kept, and what was lost is counted.

A killed process leaves a file without index and summary, perhaps with a torn record at its end; a bad
disk may leave a hole in the middle. Every good chunk is copied into a new file, also those after a hole;
the file is read back and counted before it takes the place of the old one.
"""

from __future__ import annotations

import contextlib
import json
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np

from runner.errors import RecordingError, StorageError
from runner.recording import schema
from runner.recording.extras import ExtraNames
from runner.recording.integrity import check_integrity
from runner.recording.layout import HEADER_BYTES, MAGIC, RECORD_HEAD, record_dtype
from runner.recording.messages import decode
from runner.recording.metadata import REQUIRED_RECORDS, LostRanges, json_object, layout_of_run
from runner.recording.reader import Recording, open_recording
from runner.recording.records import (
    MetadataRecord,
    RawRecord,
    ReadChunk,
    Record,
    Report,
    chunk_head,
    read_record,
)
from runner.recording.run_file import Summary, parse_result
from runner.recording.writer import RecordingFile
from runner.util.files import open_regular
from runner.util.packing import MAX_CHUNK_BYTES, MCAP_CODECS

_CHUNK_TIMES_AND_SIZE: Final = struct.Struct("<QQQ")
_MAX_MESSAGES: Final = 2**62


@dataclass
class Repair:
    """What a repair found and did."""

    path: Path
    was_whole: bool = False
    """Whether there was nothing to do."""
    kept: dict[str, int] = field(default_factory=dict)
    """Messages kept, by topic."""
    lost: LostRanges = field(default_factory=dict)
    """Messages lost, now or in an earlier repair, by topic: ranges of numbers, the second not included."""
    torn_steps: int = 0
    """Steps in a chunk that was cut off at the end."""
    lost_bytes: int = 0
    """Bytes that belong to no good record."""
    original: Path | None = None
    """Where the damaged file is kept, if more was lost than a torn end."""

    @property
    def lossless(self) -> bool:
        """Whether nothing that was in the file was lost."""
        return not self.lost and not self.lost_bytes


def repair(path: Path, report: Report = lambda *_: None, stated: Summary | None = None) -> Repair:
    """Make a recording whole; the file is not touched until its successor is complete and read back.

    Args:
        path: the recording.
        report: called with the bytes read so far, and of how many.
        stated: the summary of the run, if it has one: what a file that was cut lacks of it counts as lost.

    Raises:
        RecordingError: it is not a dualtaxi recording, or its description is damaged.
        StorageError: there is no space for the new file, or the folder cannot be written.
    """
    counts = _recorded_counts(stated or Summary())
    with contextlib.suppress(RecordingError):
        check_integrity(path, report)
        done = Repair(path, was_whole=True)
        with contextlib.suppress(RecordingError), open_recording(path) as recording:
            done.lost = recording.lost or _missing(counts, _stated_counts(recording))
        return done
    fresh = path.with_suffix(".repairing")
    try:
        fresh.unlink(missing_ok=True)
        done = _salvage(path, fresh, report, counts)
        check_integrity(fresh, report)
        with open_recording(fresh) as recording:
            for name, found in _stated_counts(recording).items():
                if found != (expected := done.kept.get(name, 0)):
                    raise RecordingError(f"{fresh}: found {found} messages of {name}, expected {expected}.")
        if done.lost:
            number = 1
            while (free := path.with_name(f"{path.stem}.damaged-{number}{path.suffix}")).exists():
                number += 1
            done.original = path.rename(free)
        try:
            fresh.replace(path)
        except OSError:
            if done.original is not None:
                done.original.rename(path)
            raise
    except OSError as error:
        raise StorageError(f"{fresh}: cannot be written ({error.strerror}); {path} is as it was.") from error
    finally:
        with contextlib.suppress(OSError):
            fresh.unlink(missing_ok=True)
    return done


def can_be_repaired(path: Path) -> bool:
    """Return whether a damaged recording holds messages that a repair can keep."""
    with contextlib.suppress(RecordingError, OSError), open_regular(path) as stream:
        described, has_messages = _description(DamagedFile(stream, path))
        return has_messages and described.keys() >= REQUIRED_RECORDS
    return False


def _description(file: DamagedFile) -> tuple[dict[str, dict[str, str]], bool]:
    """Return the metadata before the first chunk by name, and whether there is a chunk."""
    described: dict[str, dict[str, str]] = {}
    for record in file.good_records():
        if isinstance(record, ReadChunk):
            return described, True
        if isinstance(record, MetadataRecord):
            described[record.name] = record.entries
    return described, False


def _salvage(path: Path, fresh: Path, report: Report, stated: Mapping[str, int]) -> Repair:
    try:
        stream = open_regular(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error
    with stream:
        # What the new file begins with, and how messages are read, is looked for in a reading of its own.
        described, _ = _description(DamagedFile(stream, path))
        if missing := REQUIRED_RECORDS - described.keys():
            raise RecordingError(
                f"{path}: found no metadata {', '.join(sorted(missing))}, damaged or never written: its "
                "messages cannot be interpreted. `dualtaxi resume` retrains the run."
            )
        return _Salvage(path, DamagedFile(stream, path), described["run"], stated).write(fresh, report)


def _stated_counts(recording: Recording) -> dict[str, int]:
    """Return the number of messages of each topic, as the summary of a finished recording states it."""
    counts = dict.fromkeys((topic.name for topic in recording.topics), 0)
    for channel, count in recording.file.index.message_counts.items():
        if channel in schema.TOPIC_OF:
            counts[schema.TOPIC_OF[channel].name] += count
    return counts


class _Salvage:
    """Copies the good records of a damaged file into a new one.

    Args:
        run: its metadata record `run`.
        stated: messages of each topic, as the run states them; a result in the file replaces these numbers.
    """

    def __init__(
        self, path: Path, damaged: DamagedFile, run: Mapping[str, str], stated: Mapping[str, int]
    ) -> None:
        self._path = path
        self._damaged = damaged
        self._counts = stated
        self._layout = layout_of_run(run, str(path))
        self._done = Repair(path)
        self._next = {topic.name: 0 for topic in self._layout.topics}
        """The number of the next message expected of each topic, by name."""
        self._names = ExtraNames(str(path))
        self._result: dict[str, str] | None = None

    def write(self, fresh: Path, report: Report) -> Repair:
        """Write the new file."""
        with RecordingFile(fresh, self._layout) as file:
            for record in self._damaged.good_records(report):
                if isinstance(record, ReadChunk):
                    self._take_chunk(file, record)
                elif isinstance(record, MetadataRecord) and record.name == "result":
                    problems: list[str] = []
                    with contextlib.suppress(RecordingError):  # one without sense is worth as much as none
                        entry = json_object(record.entries.get("json"), "the metadata 'result'")
                        result = parse_result(entry, problems)
                        if not problems:
                            self._counts, self._result = _recorded_counts(result), record.entries
                elif record.name != "repair":
                    file.copy(record)
            self._finish(file)
        return self._done

    def _take_chunk(self, file: RecordingFile, chunk: ReadChunk) -> None:
        """Copy a good chunk; note a hole before it."""
        where = f"{self._path}: chunk at {chunk.offset}"
        topic = chunk.topic
        count = len(chunk.times)
        if topic.name not in self._next:
            raise RecordingError(f"{where}: found messages of another kind of run.")
        if topic is schema.EXTRA_COLUMNS_TOPIC:
            self._names.take(chunk)
            self._names.declare(file)
        message = self._layout.message(topic)
        if topic.message is schema.EXTRA:
            if (names := self._names.of(chunk)) is None:
                self._damaged.lost_bytes += len(chunk.body)  # their names are lost
                return
            message = names.message
        dtype = record_dtype(message)
        if dtype is not None and len(chunk.records) != count * dtype.itemsize:
            raise RecordingError(f"{where}: found messages of another size.")
        first = expected = self._next[topic.name]
        if topic.message in schema.NUMBERED_BY:
            first, last = self._numbers(chunk)
            if last - first + 1 != count or not 0 <= first <= last < _MAX_MESSAGES:
                raise RecordingError(f"{where}: found {count} messages, numbered {first} to {last}.")
        if first < expected:
            raise RecordingError(f"{self._path}: {topic.name} goes back from {expected} to {first}.")
        if first > expected:
            self._done.lost.setdefault(topic.name, []).append([expected, first])
        self._next[topic.name] = first + count
        file.copy(chunk)
        self._done.kept[topic.name] = self._done.kept.get(topic.name, 0) + count

    def _numbers(self, chunk: ReadChunk) -> tuple[int, int]:
        """Return the numbers of a chunk's first and last message."""
        topic = chunk.topic
        name = schema.NUMBERED_BY[chunk.topic.message]
        dtype, message = self._layout.dtype(topic), self._layout.message(topic)
        if dtype is not None:
            numbers = np.frombuffer(chunk.records, dtype)[name]
            return int(numbers[0]), int(numbers[-1])
        first, last = (decode(message, chunk.messages[k][HEADER_BYTES:])[name] for k in (0, -1))
        return first, last

    def _finish(self, file: RecordingFile) -> None:
        """Record what was lost, or else the result again, and finish the file."""
        done = self._done
        for name, holes in _missing(self._counts, self._next).items():
            done.lost.setdefault(name, []).extend(holes)
        done.lost_bytes = self._damaged.lost_bytes
        torn, dtype = self._damaged.torn_chunk, self._layout.dtype(schema.TRAIN_STEP)
        if len(torn) >= _CHUNK_TIMES_AND_SIZE.size and dtype is not None:
            start, end, size = _CHUNK_TIMES_AND_SIZE.unpack_from(torn)
            ticks = (end - start) // schema.STEP_NANOSECONDS + 1  # a step takes one
            done.torn_steps = ticks if size == ticks * dtype.itemsize else 0
        if done.lost:
            file.add_metadata("repair", {"json": json.dumps({"lost": done.lost}, sort_keys=True)})
        elif self._result is not None:
            file.add_metadata("result", self._result)
        file.finish()


def _missing(stated: Mapping[str, int], found: Mapping[str, int]) -> LostRanges:
    """Return the messages missing after those found of each topic, as `Repair.lost`."""
    return {name: [[found[name], n]] for name, n in stated.items() if name in found and found[name] < n}


def _recorded_counts(summary: Summary) -> dict[str, int]:
    """Return how many messages of each topic were recorded; steps may have been left out."""
    left_out = () if summary.steps_recorded else schema.STEP_TOPICS
    return {name: n for name, n in summary.messages.items() if name not in left_out}


_LIKE_A_CHUNK: Final = re.compile(
    rb"\x06(?=.{3}[\0-\x04]\0{4}"  # its length
    rb".{16}.{3}[\0-\x04]\0{4}"  # its times and its unpacked size
    rb".{4}(?:"
    + b"|".join(re.escape(len(name).to_bytes(4, "little") + name.encode()) for name in MCAP_CODECS)
    + rb"))",  # its checksum and compression
    re.DOTALL,
)
_LIKE_BYTES: Final = 64
_PIECE: Final = 4 << 20
_MAX_WASTED_RATIO: Final = 4
"""How many times the file's size may be unpacked of what only looks like chunks."""
_ALWAYS_WASTED: Final = 256 << 20
"""Bytes of this kind that are unpacked of a file of any size."""


class DamagedFile:
    """A file of which any part may be damaged: its good records follow one another, or are searched for.

    It is read in pieces, never mapped: a disk that fails meanwhile causes an error, not a signal. Data that
    looks like a chunk and is none costs work, which is bounded.
    """

    def __init__(self, stream: BinaryIO, path: Path) -> None:
        self._stream = stream
        self._path = path
        self.size = stream.seek(0, 2)
        self._allowance = self.size * _MAX_WASTED_RATIO + _ALWAYS_WASTED
        self.lost_bytes = 0
        """Bytes that belong to no good record, as far as the file was read."""
        self.torn_chunk = b""
        """The beginning of a chunk that was cut off at the end of the file, after its head; else empty."""
        if not self.size:
            raise RecordingError(f"{path}: found an empty file, expected a recording.")
        if self._read(0, len(MAGIC)) != MAGIC:
            raise RecordingError(f"{path}: found another kind of file, expected an MCAP file.")

    def good_records(self, report: Report = lambda *_: None) -> Iterator[Record]:
        """Yield the readable metadata, attachments and chunks, skipping all that is damaged."""
        offset = len(MAGIC)
        while offset + RECORD_HEAD.size <= self.size:
            report(offset, self.size)
            raw = RawRecord.of(self._read(offset, RECORD_HEAD.size), offset)
            if raw.ends_data:
                return
            if (record := self._good_record(raw)) is not None:
                if not isinstance(record, RawRecord):
                    yield record
                offset = raw.end
                continue
            next_chunk = self._next_chunk(offset + 1)
            if raw.is_chunk and next_chunk == self.size:
                self.torn_chunk = self._read(offset + RECORD_HEAD.size, _LIKE_BYTES)
            self.lost_bytes += next_chunk - offset
            offset = next_chunk
        self.lost_bytes += max(self.size - offset, 0)

    def _good_record(self, raw: RawRecord) -> Record | RawRecord | None:
        """Return a record read and checked; None if it is damaged."""
        start = raw.end - raw.length
        if not raw.is_data or raw.length > min(self.size - start, MAX_CHUNK_BYTES):
            return None
        try:
            if raw.is_chunk:
                chunk_head(self._read(start, min(raw.length, _LIKE_BYTES)), raw.length, "")
            return read_record(raw._replace(body=self._read(start, raw.length)))
        except RecordingError:
            self._allowance -= raw.length
            if self._allowance < 0:
                raise RecordingError(
                    f"{self._path}: too much of it only looks like chunks, last at {raw.offset}: "
                    "it was made to exhaust its readers."
                ) from None
            return None

    def _next_chunk(self, offset: int) -> int:
        """Return the offset of the next good chunk, or the end of the file."""
        while offset < self.size:
            piece = self._read(offset, _PIECE + _LIKE_BYTES)
            for like in _LIKE_A_CHUNK.finditer(piece):
                start = like.start()
                raw = RawRecord.of(piece[start : start + RECORD_HEAD.size], offset + start)
                if start < _PIECE and self._good_record(raw) is not None:
                    return raw.offset
            offset += _PIECE
        return self.size

    def _read(self, offset: int, length: int) -> bytes:
        try:
            self._stream.seek(offset)
            return self._stream.read(length)
        except OSError as error:
            raise RecordingError(f"{self._path}: cannot be read at {offset} ({error.strerror}).") from error
