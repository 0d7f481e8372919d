"""Whether a recording's bytes are what its recorder must have written, every one of them.

Each record is read and each checksum compared; message indexes, the end of the data section, summary and
footer are made again from the data and compared byte by byte.
"""

from __future__ import annotations

import contextlib
import itertools
import operator
import os
import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import BinaryIO, TypeVar

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, MetadataIndex
from mcap.writer import MCAP0_MAGIC

from runner.errors import CutOff, RecordingError
from runner.recording import schema
from runner.recording.blocks import RECORD_HEAD
from runner.recording.chunks import MAX_CHUNK_BYTES, has_message_index, message_index
from runner.recording.records import (
    MAX_NAME_BYTES,
    MAX_NAMED,
    UNREADABLE,
    Contents,
    ReadChunk,
    Report,
    asks_for_indexes,
    attachment_of,
    check_unpacked_size,
    declared_bytes,
    metadata_of,
    read_chunk,
    walk,
)
from runner.recording.writer import RecordingFile, schemas_and_channels
from runner.util.files import open_regular

N = TypeVar("N", AttachmentIndex, MetadataIndex)


def refuse_foreign(path: Path) -> None:
    """Refuse a file of another program, or one that is not an MCAP file.

    Raises:
        RecordingError: it is such a file, or cannot be read.
    """
    try:
        with open_regular(path) as stream:
            start = stream.read(4096)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error
    if not start:
        raise RecordingError(
            f"{path}: found an empty file, expected a recording; `dualtaxi resume` starts it."
        )
    if not start.startswith(MCAP0_MAGIC[: len(start)]):
        raise RecordingError(
            f"{path}: found {start[:8]!r} at its start, expected an MCAP file: not a dualtaxi recording."
        )
    head = start[len(MCAP0_MAGIC) :]
    if len(head) < 13 or head[0] != Opcode.HEADER:
        return
    (length,) = struct.unpack_from("<I", head, 9)
    profile = head[13 : 13 + length]
    if length < len(head) and profile != schema.PROFILE.encode():
        raise RecordingError(
            f"{path}: found an MCAP file of profile {profile.decode(errors='replace')!r}, expected "
            f"{schema.PROFILE!r}: not a dualtaxi recording."
        )


def check_integrity(path: Path, report: Report = lambda *_: None) -> None:
    """Check every byte of a finished recording.

    Raises:
        CutOff: it ends in the middle, and is whole up to there.
        RecordingError: something is wrong; the first such thing is named with its offset.
    """
    contents = survey(path, keep_result=True, report=report)
    if contents.reason:
        advice = "; `dualtaxi repair` mends it" if contents.end else ""
        error = CutOff if may_be_cut(path, contents) else RecordingError
        raise error(f"{path}: {contents.reason}{advice}.")
    found, expected = _tails(path, contents)
    if len(found) < len(expected) and expected.startswith(found):
        raise CutOff(f"{path}: the file ends at {contents.size}, in its summary; `dualtaxi repair` mends it.")
    if found != expected:
        same = itertools.takewhile(bool, map(operator.eq, found, expected))
        at = sum(same)
        what = "the checksum of the data section" if at < RECORD_HEAD.size + 4 else "the summary or footer"
        if at >= len(expected):
            what = "the end of the file: there are bytes after it"
        raise RecordingError(f"{path}: found damage at {contents.end + at} in {what}.")


def is_merely_cut_off(path: Path) -> bool:
    """Return whether an unfinished recording is, as far as it goes, what its recorder wrote.

    Raises:
        RecordingError: the file cannot be read, or begins as no recording does.
    """
    contents = survey(path, keep_result=True)
    if contents.reason:
        if not contents.end:
            raise RecordingError(f"{path}: {contents.reason}.")
        return may_be_cut(path, contents)
    found, expected = _tails(path, contents)
    return expected.startswith(found)


def survey(path: Path, keep_result: bool = False, report: Report = lambda *_: None) -> Contents:
    """Return what of a recording is good to the last byte, from its beginning to the first damaged record.

    Args:
        keep_result: whether a `result` record counts; when a recording is resumed, it is written again.
    """
    with _reading(path) as stream:
        contents = Contents(size=stream.seek(0, 2))
        check_unpacked_size(contents.size, declared_bytes(stream, contents.size, str(path)), str(path))
        try:
            _check_beginning(stream)
            _take_records(stream, contents, keep_result, report)
        except RecordingError as error:
            contents.reason = str(error)
    return contents


def may_be_cut(path: Path, contents: Contents) -> bool:
    """Return whether nothing is missing among the good records, and nothing good comes after them.

    Args:
        contents: its good records, as `survey` found them.
    """
    if any(entry.name == "repair" for entry in contents.metadata):
        return False
    if not contents.reason:
        return True
    with _reading(path) as stream:
        return _ends_torn(stream, contents)


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[BinaryIO]:
    try:
        with open_regular(path) as stream:
            yield stream
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error


@cache
def _beginnings() -> tuple[bytes, ...]:
    """Return what may follow the header: the schemas and channels of each kind, as every version wrote them.

    A topic that is added gets the highest channel, so earlier versions wrote those up to some channel.
    """
    newest = max(topic.channel for topic in schema.ALL_TOPICS)
    return tuple(
        b"".join(schemas_and_channels(tuple(topic for topic in topics if topic.channel <= last)))
        for topics in schema.KINDS.values()
        for last in range(schema.FIRST_VERSION_CHANNELS, newest + 1)
    )


def _check_beginning(stream: BinaryIO) -> None:
    """Compare magic, header, schemas and channels; only the library's version may differ."""
    stream.seek(0)
    start = stream.read(len(MCAP0_MAGIC) + RECORD_HEAD.size)
    if start[: len(MCAP0_MAGIC)] != MCAP0_MAGIC:
        raise RecordingError(f"found {start[:8]!r} at 0, expected the MCAP magic")
    opcode, length = RECORD_HEAD.unpack(start[len(MCAP0_MAGIC) :].ljust(RECORD_HEAD.size, b"\0"))
    stream.seek(len(MCAP0_MAGIC) + RECORD_HEAD.size + min(length, 4096))
    if opcode != Opcode.HEADER or not stream.read(max(map(len, _beginnings()))).startswith(_beginnings()):
        raise RecordingError("found other schemas or channels than every recording begins with")


def _take_records(stream: BinaryIO, contents: Contents, keep_result: bool, report: Report) -> None:
    """Note the good records of the data section.

    Raises:
        RecordingError: one is damaged, or the file ends before the data section does.
    """
    indexed, is_taken = True, False
    chunk: ReadChunk | None = None
    """The last chunk, if an index may follow; `is_taken` if it need not."""
    for opcode, at, body in walk(stream, contents.size):
        if opcode == Opcode.DATA_END:
            return
        report(at, contents.size)
        try:
            if chunk is not None and (opcode == Opcode.MESSAGE_INDEX or not is_taken):
                _take_index(contents, chunk, opcode, at, body)
                chunk = None
            elif opcode == Opcode.CHUNK:
                chunk = _checked_chunk(body, at)
                is_taken = not has_message_index(schema.TOPIC_OF[chunk.summary.channel], indexed)
                if not is_taken:
                    continue
                contents.chunks.append(chunk.summary)
                chunk = chunk if indexed else None  # earlier versions wrote an index of extras too
            elif opcode == Opcode.METADATA:
                name, entries = metadata_of(body)
                if name == "result" and not keep_result:
                    continue
                if name == "config":
                    indexed = asks_for_indexes(entries)
                _note(
                    contents.metadata,
                    MetadataIndex(offset=at, length=RECORD_HEAD.size + len(body), name=name),
                )
            elif opcode == Opcode.ATTACHMENT:
                name, media_type, data = attachment_of(body, at)
                entry = AttachmentIndex(at, RECORD_HEAD.size + len(body), 0, 0, len(data), name, media_type)
                _note(contents.attachments, entry)
            elif opcode == Opcode.CHANNEL:
                contents.channels.append(struct.unpack_from("<H", body)[0])
            elif opcode not in (Opcode.HEADER, Opcode.SCHEMA):
                raise RecordingError(f"found a record of kind {opcode} at {at}, expected none there")
        except UNREADABLE as error:
            raise RecordingError(f"the record at {at} cannot be read") from error
        contents.end = at + RECORD_HEAD.size + len(body)
    raise RecordingError(f"the file ends at {contents.size}, in the middle of the data")


def _checked_chunk(body: bytes, at: int) -> ReadChunk:
    """Return a chunk whose times are those of its messages."""
    chunk = read_chunk(body, at)
    found = chunk.summary.index.message_start_time, chunk.summary.index.message_end_time
    expected = int(chunk.times[0]), int(chunk.times[-1])
    if found != expected:
        raise RecordingError(
            f"chunk at {at}: found times {found[0]} to {found[1]}, expected {expected[0]} to {expected[1]}"
        )
    return chunk._replace(body=b"")  # memory that is free for the next record makes a survey a third quicker


def _take_index(contents: Contents, chunk: ReadChunk, opcode: int, at: int, body: bytes) -> None:
    """Compare a message index with the chunk before it, and note both."""
    index = chunk.summary.index
    if opcode != Opcode.MESSAGE_INDEX:
        raise RecordingError(f"chunk at {index.chunk_start_offset}: has no message index")
    if message_index(chunk.summary.channel, chunk.times, chunk.offsets)[RECORD_HEAD.size :] != body:
        raise RecordingError(f"the message index at {at} does not lead to the chunk's messages")
    index.message_index_offsets[chunk.summary.channel] = at
    index.message_index_length = RECORD_HEAD.size + len(body)
    if not contents.chunks or contents.chunks[-1] is not chunk.summary:
        contents.chunks.append(chunk.summary)


def _note(entries: list[N], entry: N) -> None:
    if len(entries) == MAX_NAMED or len(entry.name) > MAX_NAME_BYTES:
        raise RecordingError(f"found a record too many or with too long a name at {entry.offset}")
    entries.append(entry)


def _tails(path: Path, contents: Contents) -> tuple[bytes, bytes]:
    """Return what follows the data of a recording, and what should follow it."""
    with _reading(path) as stream, RecordingFile.inspect(path, contents) as file:
        expected = file.tail()
        stream.seek(contents.end)
        return stream.read(len(expected) + 1), expected


def _ends_torn(stream: BinaryIO, contents: Contents) -> bool:
    """Return whether a file ends with a record that was not written to its end, or with nothing but zeros.

    Before it may stand a good chunk without its index, which is written again.
    """
    offset = contents.end
    if contents.size > len(MCAP0_MAGIC):
        stream.seek(-len(MCAP0_MAGIC), os.SEEK_END)
        if stream.read() == MCAP0_MAGIC:
            return False  # it was closed: a damaged length may look like a cut
    if offset == 0:
        return contents.size == 0 or _only_zeros(stream, 0)
    for _ in range(2):
        stream.seek(offset)
        head = stream.read(RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            return True
        opcode, length = RECORD_HEAD.unpack(head)
        if offset + RECORD_HEAD.size + length > contents.size and 0 < opcode <= Opcode.DATA_END:
            return bool(length <= MAX_CHUNK_BYTES)
        try:
            if opcode != Opcode.CHUNK:
                raise RecordingError("no chunk")
            read_chunk(stream.read(length), offset)
        except (RecordingError, *UNREADABLE):
            return _only_zeros(stream, offset)
        offset += RECORD_HEAD.size + length
    return False


def _only_zeros(stream: BinaryIO, offset: int) -> bool:
    stream.seek(offset)
    while piece := stream.read(1 << 20):
        if any(piece):
            return False
    return True
