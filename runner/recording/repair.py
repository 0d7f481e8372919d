"""A damaged recording made whole again: what is good is kept, and what was lost is said, in numbers.

A killed process leaves a file without index and summary, perhaps with a torn record at its end; a bad
disk may leave a hole in the middle. Every good chunk is copied into a new file, also those behind a hole;
the file is read back and counted before it takes the place of the old one.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.chunks import MAX_CHUNK_BYTES, Chunk, message_index
from runner.recording.contents import asks_for_indexes, attachment_of, metadata_of, read_chunk
from runner.recording.integrity import check_integrity, places
from runner.recording.reader import open_recording
from runner.recording.schema import BLOCK_TOPICS, TOPICS, Topic
from runner.recording.writer import RecordingFile

_HEAD: Final = struct.Struct("<BQ")
_CHUNK_TIMES: Final = struct.Struct("<QQ")
_CHUNK_TIMES_AND_SIZE: Final = struct.Struct("<QQQ")
_NEEDED: Final = {"run", "config", "provenance"}
_EXPECTED: Final = {
    *(Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK),
    *(Opcode.MESSAGE_INDEX, Opcode.METADATA, Opcode.ATTACHMENT),
}


@dataclass
class Repair:
    """What a repair found and did."""

    path: Path
    was_whole: bool = False
    """Whether there was nothing to do."""
    kept: dict[str, int] = field(default_factory=dict)
    """Messages kept, by topic."""
    lost: dict[str, list[list[int]]] = field(default_factory=dict)
    """Messages lost, by topic: [first, behind the last] numbers of each hole."""
    torn_steps: int = 0
    """Steps in a chunk that was cut off at the end."""
    lost_bytes: int = 0
    """Bytes that belong to no good record."""
    original: Path | None = None
    """Where the damaged file is kept, if something was lost but a torn end."""

    @property
    def lossless(self) -> bool:
        """Whether nothing that was in the file was lost."""
        return not self.lost and not self.lost_bytes


def repair(path: Path) -> Repair:
    """Make a recording whole; the file is not touched until its successor is complete and read back.

    Raises:
        RecordingError: it is no recording of ours, or what describes it is damaged.
    """
    with contextlib.suppress(RecordingError):
        check_integrity(path)
        return Repair(path, was_whole=True)
    fresh = path.with_suffix(".repairing")
    fresh.unlink(missing_ok=True)
    try:
        with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            done = _Salvage(path, data).write(fresh)
        _read_back(fresh, done)
    except ValueError as error:  # an empty file cannot be mapped
        raise RecordingError(f"{path}: found an empty file, expected a recording.") from error
    except BaseException:
        fresh.unlink(missing_ok=True)
        raise
    if done.lost:
        done.original = _free_name(path)
        path.rename(done.original)
    fresh.replace(path)
    return done


def _read_back(fresh: Path, done: Repair) -> None:
    """Compare every byte of the new file with what it should be, and count its messages.

    Raises:
        RecordingError: it is not what it should be; the old file stays.
    """
    check_integrity(fresh)
    with open_recording(fresh) as recording:
        for topic in TOPICS:
            if topic in BLOCK_TOPICS:
                found = sum(len(block) for block in recording.blocks(topic))
            else:
                found = recording.count(topic)
            expected = done.kept.get(topic.name, 0)
            if found != expected:
                raise RecordingError(f"{fresh}: found {found} messages of {topic.name}, expected {expected}.")


def _free_name(path: Path) -> Path:
    """Return a name beside `path` that no file has: damaged-1, ..."""
    number = 1
    while (free := path.with_name(f"{path.stem}.damaged-{number}{path.suffix}")).exists():
        number += 1
    return free


class _Salvage:
    """Takes the good records out of a damaged file's bytes."""

    def __init__(self, path: Path, data: mmap.mmap) -> None:
        if data[: len(MCAP0_MAGIC)] != MCAP0_MAGIC:
            raise RecordingError(f"{path}: found {data[:8]!r} at its start, expected an MCAP file.")
        self._path = path
        self._data = data
        self._done = Repair(path)
        self._indexed = True
        self._dtypes: dict[Topic, np.dtype[np.void]] = {}
        self._next = dict.fromkeys(TOPICS, 0)
        """Number of the message expected next, a topic."""
        self._result: dict[str, str] | None = None

    def write(self, fresh: Path) -> Repair:
        """Write a new file of what is good."""
        described = set()
        with RecordingFile(fresh) as file:
            for opcode, offset, body in self._good_records():
                if opcode == Opcode.METADATA:
                    name, entries = metadata_of(body)
                    described.add(name)
                    self._take_metadata(file, name, entries)
                elif opcode == Opcode.ATTACHMENT:
                    file.add_attachment(*attachment_of(body, offset))
                elif opcode == Opcode.CHUNK:
                    self._check_described(described)
                    self._take_chunk(file, offset, body)
            self._check_described(described)
            self._close(file)
        return self._done

    def _check_described(self, described: set[str]) -> None:
        if missing := _NEEDED - described:
            raise RecordingError(
                f"{self._path}: its metadata {', '.join(sorted(missing))} is damaged or was never written: "
                "the messages cannot be told apart. `dualtaxi resume` does the run anew."
            )

    def _take_metadata(self, file: RecordingFile, name: str, entries: dict[str, str]) -> None:
        if name == "result":
            self._result = entries
            return
        if name == "repair":
            return
        if name == "config":
            self._indexed = asks_for_indexes(entries)
        if name == "run":
            learners, events = int(entries["learners"]), int(entries["events"])
            self._dtypes = {
                topic: schema.record_dtype(topic.message, schema.block_counts(topic, learners, events))
                for topic in BLOCK_TOPICS
            }
        file.add_metadata(name, entries)

    def _take_chunk(self, file: RecordingFile, offset: int, body: bytes) -> None:
        """Copy a good chunk, with its index made anew; note a hole before it."""
        part, records = read_chunk(body, offset)
        topic = next(topic for topic in TOPICS if topic.channel == part.channel)
        _, times, offsets = places(records, f"{self._path}: chunk at {offset}")
        if topic in self._dtypes:
            numbers = np.frombuffer(records, self._dtypes[topic])[schema.NUMBERED_BY[topic.message]]
            self._note_hole(topic, int(numbers[0]))
            self._next[topic] = int(numbers[-1]) + 1
        else:
            self._next[topic] += part.messages
        start, end = int(times[0]), int(times[-1])
        body = _CHUNK_TIMES.pack(start, end) + body[_CHUNK_TIMES.size :]  # no checksum covers them
        chunk = Chunk(
            record=_HEAD.pack(Opcode.CHUNK, len(body)) + body,
            index=message_index(part.channel, times, offsets) if self._indexed else b"",
            compression=part.index.compression,
            compressed_size=part.index.compressed_size,
            uncompressed_size=part.index.uncompressed_size,
            start_time=start,
            end_time=end,
            messages=part.messages,
        )
        file.add_chunk(topic, chunk)
        self._done.kept[topic.name] = self._done.kept.get(topic.name, 0) + part.messages

    def _note_hole(self, topic: Topic, number: int) -> None:
        expected = self._next[topic]
        if number < expected:
            raise RecordingError(f"{self._path}: {topic.name} goes back from {expected} to {number}.")
        if number > expected:
            self._done.lost.setdefault(topic.name, []).append([expected, number])

    def _close(self, file: RecordingFile) -> None:
        """Say what was lost, or give the result back; finish the file."""
        result = json.loads(self._result["json"]) if self._result else {}
        without_steps = not result.get("steps_recorded", True)
        for topic in TOPICS:
            count = result.get("messages", {}).get(topic.name, 0)
            if self._next[topic] < count and not (without_steps and topic.message is schema.STEP):
                self._done.lost.setdefault(topic.name, []).append([self._next[topic], count])
        if self._done.lost:
            file.add_metadata("repair", {"json": json.dumps({"lost": self._done.lost}, sort_keys=True)})
        elif self._result is not None:
            file.add_metadata("result", self._result)
        file.finish()

    def _good_records(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield (opcode, offset, body) of the records that can be read, past those that cannot."""
        offset, size = len(MCAP0_MAGIC), len(self._data)
        while offset + 9 <= size:
            opcode, length = _HEAD.unpack(self._data[offset : offset + 9])
            if (opcode, length) == (Opcode.DATA_END, 4):
                return
            if self._is_good(opcode, length, offset):
                yield opcode, offset, self._data[offset + 9 : offset + 9 + length]
                offset += 9 + length
                continue
            found = self._next_good(offset + 1)
            if opcode == Opcode.CHUNK and found == size:
                self._done.torn_steps = self._steps_in_torn_chunk(offset)
            self._done.lost_bytes += found - offset
            offset = found
        self._done.lost_bytes += size - offset

    def _is_good(self, opcode: int, length: int, offset: int) -> bool:
        """Return whether a whole, sound record begins here."""
        if opcode not in _EXPECTED or length > min(len(self._data) - offset - 9, MAX_CHUNK_BYTES):
            return False
        body = self._data[offset + 9 : offset + 9 + length]
        try:
            if opcode == Opcode.CHUNK:
                read_chunk(body, offset)
            elif opcode == Opcode.ATTACHMENT:
                attachment_of(body, offset)
            elif opcode == Opcode.METADATA:
                metadata_of(body)
        except (RecordingError, struct.error, ValueError, EndOfFile):
            return False
        return True

    def _next_good(self, offset: int) -> int:
        """Return where the next good chunk begins, or the end of the file."""
        chunk = bytes([Opcode.CHUNK])
        while 0 <= (offset := self._data.find(chunk, offset)) <= len(self._data) - 9:
            if self._is_good(Opcode.CHUNK, _HEAD.unpack(self._data[offset : offset + 9])[1], offset):
                return offset
            offset += 1
        return len(self._data)

    def _steps_in_torn_chunk(self, offset: int) -> int:
        """Return how many steps a chunk that was cut off held, by its head: a step spans one tick."""
        head = self._data[offset + 9 : offset + 9 + _CHUNK_TIMES_AND_SIZE.size]
        if len(head) < _CHUNK_TIMES_AND_SIZE.size or not self._dtypes:
            return 0
        start, end, size = _CHUNK_TIMES_AND_SIZE.unpack(head)
        ticks = (end - start) // schema.STEP_NANOSECONDS + 1
        return ticks if size == ticks * self._dtypes[schema.TRAIN_STEP].itemsize else 0
