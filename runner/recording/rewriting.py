"""A recording written anew with other metadata: every message byte for byte, its content digest the same."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording.blocks import RECORD_HEAD
from runner.recording.chunks import Chunk, message_index
from runner.recording.digest import ContentHash, combine
from runner.recording.integrity import check_integrity, places
from runner.recording.reader import open_recording
from runner.recording.run_file import Summary
from runner.recording.scan import (
    UNREADABLE,
    Part,
    asks_for_indexes,
    attachment_of,
    metadata_of,
    read_chunk,
    walk,
)
from runner.recording.schema import KINDS, STEP, TOPIC_OF, TOPICS, Topic
from runner.recording.writer import RecordingFile
from runner.util.files import open_regular

Times = NDArray[np.uint64]
Change = Callable[[str, dict[str, str]], dict[str, str] | None]
"""Takes the name and entries of a metadata record; returns its new entries, or None to leave it out."""

_CHUNK_TIMES: Final = struct.Struct("<QQ")


def rewrite(
    path: Path, fresh: Path, change: Change, more: Mapping[str, Mapping[str, str]] | None = None
) -> None:
    """Write a recording into a new file with its metadata changed.

    Of a recording that was cut off, everything up to its last whole chunk is written; the new file has
    an index and a summary, and no result either.

    Args:
        path: the recording.
        fresh: the new file.
        change: what becomes of each metadata record.
        more: metadata records to add, by name.

    Raises:
        RecordingError: the recording is damaged, not merely cut off.
        OSError: the new file exists or cannot be written.
    """
    indexed, result = True, None
    with open_recording(path) as recording:
        topics = KINDS[recording.kind]
    with RecordingFile(fresh, topics) as file:
        for opcode, offset, body in _whole_records(path):
            if opcode == Opcode.METADATA:
                name, entries = metadata_of(body)
                if name == "config":
                    indexed = asks_for_indexes(entries)
                changed = change(name, entries)
                if name == "result":
                    result = changed
                elif changed is not None:
                    file.add_metadata(name, changed)
            elif opcode == Opcode.ATTACHMENT:
                file.add_attachment(*attachment_of(body, offset))
            elif opcode == Opcode.CHUNK:
                part, records = read_chunk(body, offset)
                _, times, offsets = places(records, f"{path}: chunk at {offset}")
                file.add_chunk(TOPIC_OF[part.channel], copied_chunk(part, body, times, offsets, indexed))
        for name, added in (more or {}).items():
            file.add_metadata(name, added)
        file.finish("" if result is None else "result", result)


def copied_chunk(part: Part, body: bytes, times: Times, offsets: Times, indexed: bool) -> Chunk:
    """Return a chunk to be written as it was read, with its times and index made anew.

    Args:
        part: what is known of it.
        body: the chunk record behind its head.
        times: log times of its messages, in nanoseconds.
        offsets: where its messages begin.
        indexed: whether a message index shall follow it.
    """
    start, end = int(times[0]), int(times[-1])
    body = _CHUNK_TIMES.pack(start, end) + body[_CHUNK_TIMES.size :]  # no checksum covers them
    return Chunk(
        record=RECORD_HEAD.pack(Opcode.CHUNK, len(body)) + body,
        index=message_index(part.channel, times, offsets) if indexed else b"",
        compression=part.index.compression,
        compressed_size=part.index.compressed_size,
        uncompressed_size=part.index.uncompressed_size,
        start_time=start,
        end_time=end,
        messages=part.messages,
    )


def content_of(path: Path) -> str:
    """Return the content digest of a recording, after every checksum and every message were looked at.

    It is the one that the recording states, if it states one; of a run that was killed, that of its whole
    chunks.

    Raises:
        RecordingError: it is damaged, or states another digest than its messages have.
    """
    seen = ContentHash()
    for topic, records, _ in _messages(path):
        seen.update(topic, records)
    with open_recording(path) as recording:
        result = recording.result
    return seen.content() if result.content_digest is None else _stated(result, seen.topics(), path)


def continues(path: Path, earlier: Path) -> bool:
    """Return whether a recording holds all that another of the same job does, and goes on from there.

    Of every topic that the digest covers, the other's messages are the first ones, byte for byte.

    Raises:
        RecordingError: one of them is damaged.
    """
    with open_recording(path) as later, open_recording(earlier) as before:
        if later.run != before.run:
            return False
    counts: Counter[Topic] = Counter()
    expected, seen = ContentHash(), ContentHash()
    for topic, records, offsets in _messages(earlier):
        expected.update(topic, records)
        counts[topic] += len(offsets)
    for topic, records, offsets in _messages(path):
        shared = min(counts[topic], len(offsets))
        counts[topic] -= shared
        end = len(records) if shared == len(offsets) else int(offsets[shared])
        seen.update(topic, memoryview(records)[:end])
    return seen.topics() == expected.topics()


def _messages(path: Path) -> Iterator[tuple[Topic, bytes, Times]]:
    """Yield of each chunk its topic, its message records, and where in them the messages begin."""
    for opcode, offset, body in _whole_records(path):
        if opcode == Opcode.CHUNK:
            part, records = read_chunk(body, offset)
            _, _, offsets = places(records, f"{path}: chunk at {offset}")
            yield TOPIC_OF[part.channel], records, offsets


def _whole_records(path: Path) -> Iterator[tuple[int, int, bytes]]:
    """Yield (opcode, offset, body) of the data section's records, up to where the file may be cut off.

    Raises:
        RecordingError: it is damaged.
    """
    with open_recording(path) as recording:
        finished = recording.finished
    if finished:
        check_integrity(path)
    try:
        with open_regular(path) as stream:
            for opcode, offset, body in walk(stream, path.stat().st_size):
                if opcode == Opcode.DATA_END:
                    return
                yield opcode, offset, body
    except UNREADABLE as error:
        raise RecordingError(f"{path}: a record of it cannot be read; `dualtaxi repair` mends it.") from error


def _stated(result: Summary, seen: dict[str, str], path: Path) -> str:
    """Return the digest that a result states, if it is that of the messages."""
    stated = dict(result.topic_digests)
    if not result.steps_recorded:
        steps = {topic.name for topic in TOPICS if topic.message is STEP}
        seen = seen | {name: digest for name, digest in stated.items() if name in steps}
    if stated != seen or combine(seen) != result.content_digest:
        raise RecordingError(
            f"{path}: found messages of other content than the digest it states; it was altered."
        )
    return combine(seen)
