"""A damaged recording made whole again: what is good is kept, and what was lost is said, in numbers.

A killed process leaves a file without index and summary, perhaps with a torn record at its end; a bad
disk may leave a hole in the middle. Every good chunk is copied into a new file, also those behind a hole;
the file is read back and counted before it takes the place of the old one.
"""

from __future__ import annotations

import contextlib
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from mcap.opcode import Opcode

from runner.errors import RecordingError, StorageError
from runner.recording import schema
from runner.recording.blocks import record_dtype
from runner.recording.integrity import check_integrity, places
from runner.recording.metadata import NEEDED, check_run, json_object, kind_of, sizes_of
from runner.recording.reader import open_recording
from runner.recording.rewriting import copied_chunk
from runner.recording.salvage import DamagedFile
from runner.recording.scan import Report, asks_for_indexes, attachment_of, metadata_of, read_chunk
from runner.recording.schema import Topic
from runner.recording.writer import RecordingFile
from runner.util.files import open_regular
from runner.util.values import is_whole

_CHUNK_TIMES_AND_SIZE: Final = struct.Struct("<QQQ")
_MOST_MESSAGES: Final = 2**62


@dataclass
class Repair:
    """What a repair found and did."""

    path: Path
    was_whole: bool = False
    """Whether there was nothing to do."""
    kept: dict[str, int] = field(default_factory=dict)
    """Messages kept, by topic."""
    lost: dict[str, list[list[int]]] = field(default_factory=dict)
    """Messages lost, now or in an earlier repair, by topic: [first, behind the last] numbers of each hole."""
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


def repair(path: Path, report: Report = lambda *_: None) -> Repair:
    """Make a recording whole; the file is not touched until its successor is complete and read back.

    Args:
        path: the recording.
        report: called with the bytes that were read, and those of the file; it is read twice or thrice.

    Raises:
        RecordingError: it is no recording of ours, or what describes it is damaged.
        StorageError: there is no room for the new file, or the folder cannot be written.
    """
    with contextlib.suppress(RecordingError):
        check_integrity(path, report)
        return Repair(path, was_whole=True, lost=_lost_before(path))
    fresh = path.with_suffix(".repairing")
    try:
        fresh.unlink(missing_ok=True)
        done = _salvaged(path, fresh, report)
        _read_back(fresh, done, report)
        if done.lost:
            done.original = _free_name(path)
            path.rename(done.original)
        fresh.replace(path)
    except OSError as error:
        _remove(fresh)
        raise StorageError(f"{fresh}: cannot be written ({error.strerror}); {path} is as it was.") from error
    except BaseException:
        _remove(fresh)
        raise
    return done


def _lost_before(path: Path) -> dict[str, list[list[int]]]:
    """Return what an earlier repair of a file could not save."""
    with contextlib.suppress(RecordingError), open_recording(path) as recording:
        return recording.lost
    return {}


def _salvaged(path: Path, fresh: Path, report: Report) -> Repair:
    """Write what is good of a file into a new one."""
    try:
        stream = open_regular(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error
    with stream:
        topics = schema.KINDS[_kind(DamagedFile(stream, path), path)]
        return _Salvage(path, DamagedFile(stream, path), topics).write(fresh, report)


def _kind(file: DamagedFile, path: Path) -> str:
    """Return of which kind a damaged recording is."""
    for opcode, _, body in file.good_records():
        if opcode == Opcode.METADATA:
            name, entries = metadata_of(body)
            if name == "run":
                check_run(entries, str(path))
                return kind_of(entries)
        if opcode == Opcode.CHUNK:
            break
    return "job"


def _remove(fresh: Path) -> None:
    with contextlib.suppress(OSError):
        fresh.unlink(missing_ok=True)


def _read_back(fresh: Path, done: Repair, report: Report) -> None:
    """Compare every byte of the new file with what it should be, and count its messages.

    Raises:
        RecordingError: it is not what it should be; the old file stays.
    """
    check_integrity(fresh, report)
    with open_recording(fresh) as recording:
        for topic in recording.topics:
            if topic in recording.dtypes:
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

    def __init__(self, path: Path, file: DamagedFile, topics: Sequence[Topic]) -> None:
        self._path = path
        self._topics = topics
        self._damaged = file
        self._done = Repair(path)
        self._indexed = True
        self._dtypes: dict[Topic, np.dtype[np.void]] = {}
        self._next = dict.fromkeys(topics, 0)
        """Number of the message expected next, a topic."""
        self._result: dict[str, str] | None = None
        self._counts: dict[str, int] = {}
        """Messages of each topic, as the result says."""

    def write(self, fresh: Path, report: Report) -> Repair:
        """Write a new file of what is good."""
        described = set()
        with RecordingFile(fresh, self._topics) as file:
            for opcode, offset, body in self._damaged.good_records(report):
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
        if missing := NEEDED - described:
            raise RecordingError(
                f"{self._path}: its metadata {', '.join(sorted(missing))} is damaged or was never written: "
                "the messages cannot be told apart. `dualtaxi resume` does the run anew."
            )

    def _take_metadata(self, file: RecordingFile, name: str, entries: dict[str, str]) -> None:
        if name == "result":
            with contextlib.suppress(RecordingError):  # a senseless one is as good as none
                self._counts, self._result = _recorded_counts(entries), entries
            return
        if name == "repair":
            return
        if name == "config":
            self._indexed = asks_for_indexes(entries)
        if name == "run":
            check_run(entries, str(self._path))
            self._dtypes = {
                topic: record_dtype(topic.message, sizes)
                for topic, sizes in sizes_of(entries, str(self._path)).items()
            }
        file.add_metadata(name, entries)

    def _take_chunk(self, file: RecordingFile, offset: int, body: bytes) -> None:
        """Copy a good chunk, with its index made anew; note a hole before it."""
        part, records = read_chunk(body, offset)
        topic = schema.TOPIC_OF[part.channel]
        if topic not in self._topics:
            raise RecordingError(f"{self._path}: chunk at {offset}: found messages of another kind of run.")
        _, times, offsets = places(records, f"{self._path}: chunk at {offset}")
        if topic in self._dtypes:
            first, stop = self._numbers(topic, offset, records)
            self._note_hole(topic, first)
            self._next[topic] = stop
        else:
            self._next[topic] += part.messages
        chunk = copied_chunk(part, body, times, offsets, self._indexed)
        file.add_chunk(topic, chunk)
        self._done.kept[topic.name] = self._done.kept.get(topic.name, 0) + part.messages

    def _numbers(self, topic: Topic, offset: int, records: bytes) -> tuple[int, int]:
        """Return the number of a chunk's first message, and behind its last."""
        dtype = self._dtypes[topic]
        if len(records) % dtype.itemsize:
            raise RecordingError(f"{self._path}: chunk at {offset}: found messages of another size.")
        numbers = np.frombuffer(records, dtype)[schema.NUMBERED_BY[topic.message]]
        first, last = int(numbers[0]), int(numbers[-1])
        if last - first + 1 != len(numbers) or not 0 <= first <= last < _MOST_MESSAGES:
            raise RecordingError(
                f"{self._path}: chunk at {offset}: found {len(numbers)} messages, numbered {first} to {last}."
            )
        return first, last + 1

    def _note_hole(self, topic: Topic, number: int) -> None:
        expected = self._next[topic]
        if number < expected:
            raise RecordingError(f"{self._path}: {topic.name} goes back from {expected} to {number}.")
        if number > expected:
            self._done.lost.setdefault(topic.name, []).append([expected, number])

    def _close(self, file: RecordingFile) -> None:
        """Say what was lost, or give the result back; finish the file."""
        if self._result is not None:
            for topic in self._topics:
                if self._next[topic] < (count := self._counts.get(topic.name, 0)):
                    self._done.lost.setdefault(topic.name, []).append([self._next[topic], count])
        self._done.lost_bytes = self._damaged.lost_bytes
        if self._damaged.torn_chunk is not None:
            self._done.torn_steps = self._steps_in(self._damaged.torn_chunk)
        if self._done.lost:
            file.add_metadata("repair", {"json": json.dumps({"lost": self._done.lost}, sort_keys=True)})
        elif self._result is not None:
            file.add_metadata("result", self._result)
        file.finish()

    def _steps_in(self, torn: bytes) -> int:
        """Return how many steps a chunk that was cut off held, by its head: a step spans one tick."""
        if len(torn) < _CHUNK_TIMES_AND_SIZE.size or not self._dtypes:
            return 0
        start, end, size = _CHUNK_TIMES_AND_SIZE.unpack_from(torn)
        ticks = (end - start) // schema.STEP_NANOSECONDS + 1
        widths = [dtype.itemsize for topic, dtype in self._dtypes.items() if topic.name == "/train/step"]
        return ticks if [size] == [ticks * width for width in widths] else 0


def _recorded_counts(result: dict[str, str]) -> dict[str, int]:
    """Return how many messages of each topic a result says were recorded.

    Raises:
        RecordingError: it does not say it.
    """
    said = json_object(result.get("json"), "the metadata 'result'")
    counts = said.get("messages", {})
    if not isinstance(counts, dict) or not all(is_whole(n, 0, _MOST_MESSAGES) for n in counts.values()):
        raise RecordingError("the metadata 'result' does not say how many messages there were")
    steps = {topic.name for topic in schema.TOPICS if topic.message is schema.STEP}
    left_out = set() if said.get("steps_recorded", True) else steps
    return {name: count for name, count in counts.items() if name not in left_out}
