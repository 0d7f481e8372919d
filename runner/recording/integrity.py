"""Whether a recording's bytes are what its recorder must have written, every one of them.

Each record is read and each checksum compared; message indexes, the end of the data section, summary and
footer are made again from the data and compared byte by byte.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from runner.errors import CutOff, OtherVersion, RecordingError
from runner.recording import schema
from runner.recording.extras import ExtraNames
from runner.recording.index import Index, beginning_of, check_beginning, checksum
from runner.recording.layout import MAGIC, RECORD_HEAD, Layout
from runner.recording.metadata import layout_of_run
from runner.recording.records import (
    ChunkEntry,
    MetadataRecord,
    RawRecord,
    ReadChunk,
    Report,
    asks_for_indexes,
    check_constants,
    message_index,
    read_record,
    walk,
)
from runner.util.files import open_regular
from runner.util.packing import MAX_CHUNK_BYTES


def refuse_foreign(path: Path) -> None:
    """Refuse a file of another program, or that is no MCAP file.

    Raises:
        RecordingError: it is such a file, or cannot be read.
    """
    with _reading(path) as stream:
        try:
            check_beginning(stream)
        except CutOff:
            return
        except RecordingError as error:
            advice = "" if stream.seek(0, 2) else "; `dualtaxi resume` starts it"
            raise RecordingError(f"{path}: {error}{advice}.") from error


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
    with _reading(path) as stream:
        expected = contents.tail(checksum(stream, 0, contents.end))
        stream.seek(contents.end)
        found = stream.read(len(expected) + 1)
    if len(found) < len(expected) and expected.startswith(found):
        raise CutOff(f"{path}: the file ends at {contents.size}, in its summary; `dualtaxi repair` mends it.")
    if found != expected:
        pairs = enumerate(zip(found, expected, strict=False))
        at = next((k for k, (was, should) in pairs if was != should), len(expected))
        what = "the checksum of the data section" if at < RECORD_HEAD.size + 4 else "the summary or footer"
        if at >= len(expected):
            what = "the end of the file: there are bytes after it"
        raise RecordingError(f"{path}: found damage at {contents.end + at} in {what}.")


def check_up_to_cut(path: Path) -> None:
    """Check every byte of a recording up to its end, or to where it was cut off.

    Raises:
        RecordingError: something is wrong, or missing before the end.
    """
    with contextlib.suppress(CutOff):
        check_integrity(path)


def survey(path: Path, keep_result: bool = False, report: Report = lambda *_: None) -> Index:
    """Return what of a recording is good to the last byte, from its beginning to the first damaged record.

    Args:
        keep_result: whether a `result` record counts; when a recording is resumed, it is written again.
    """
    with _reading(path) as stream:
        contents = Index(size=stream.seek(0, 2))
        declared = Index(size=contents.size)
        with contextlib.suppress(RecordingError):
            declared.take_records(stream)
        declared.check_unpacked_size(str(path))
        try:
            contents.header_end = check_beginning(stream)
            _take_records(stream, contents, keep_result, report, str(path))
        except OtherVersion:
            raise
        except RecordingError as error:
            contents.reason = str(error).removeprefix(f"{path}: ").removesuffix(".")
    return contents


def may_be_cut(path: Path, contents: Index) -> bool:
    """Return whether nothing is missing among the good records, and nothing good comes after them.

    Args:
        contents: its good records, as `survey` found them.
    """
    if "repair" in contents.metadata:
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


def _check_beginning(raw: RawRecord, contents: Index, layout: Layout) -> None:
    """Compare what stands before the metadata record `run` of a recording with what belongs there.

    Raises:
        RecordingError: they differ.
    """
    beginning = beginning_of(layout)
    expected = beginning.schema_records, beginning.channel_records
    is_whole = (contents.schema_records, contents.channel_records) == expected
    if not is_whole or raw.offset != contents.header_end + sum(map(len, expected)):
        raise RecordingError(
            "found other schemas or channels than this version writes before its first message: "
            "the recording is of another version or program, or damaged there"
        )


def _take_records(stream: BinaryIO, contents: Index, keep_result: bool, report: Report, path: str) -> None:
    """Note the good records of the data section.

    Raises:
        OtherVersion: the recording has another version of the format.
        RecordingError: a record is damaged, or the file ends before the data section does.
    """
    indexed = True
    names = ExtraNames(path)
    layout: Layout | None = None
    chunk: ReadChunk | None = None
    """The record before, if it is a chunk."""
    for raw in walk(stream, contents.size):
        report(raw.offset, contents.size)
        if chunk is not None:
            contents.chunks.append(_with_index(chunk, raw, indexed))
            chunk = None
            contents.end = raw.end
            continue
        if raw.ends_data:
            return
        if not raw.is_data or raw.is_message_index:
            raise RecordingError(f"found a record of kind {raw.kind} at {raw.offset}, expected none there")
        record = read_record(raw)
        if isinstance(record, ReadChunk):
            _check_times(record)
            if record.topic is schema.EXTRA_COLUMNS_TOPIC:
                names.take(record)
            if record.topic.message is schema.EXTRA:
                names.check(record, contents)
            elif layout is not None and layout.spaces and record.topic in layout.topics:
                check_constants(record, layout.message(record.topic))
            chunk = record._replace(body=b"")
            del record  # memory that is free for the next record makes a survey a third quicker
            continue
        if isinstance(record, MetadataRecord) and record.name == "result" and not keep_result:
            continue
        contents.add(raw)
        if isinstance(record, MetadataRecord) and record.name == "run":
            try:
                layout = layout_of_run(record.entries, path)
            except RecordingError:
                contents.end = 0  # nothing can be read without it, and no repair mends it
                raise
            _check_beginning(raw, contents, layout)
        if isinstance(record, MetadataRecord) and record.name == "config":
            indexed = asks_for_indexes(record.entries)
        contents.end = raw.end
    raise RecordingError(f"the file ends at {contents.size}, in the middle of the data")


def _check_times(chunk: ReadChunk) -> None:
    """Compare the times that a chunk declares with the times of its messages."""
    found = chunk.entry.start_time, chunk.entry.end_time
    expected = int(chunk.times[0]), int(chunk.times[-1])
    if found != expected:
        raise RecordingError(
            f"chunk at {chunk.offset}: found times {found[0]} to {found[1]}, "
            f"expected {expected[0]} to {expected[1]}"
        )


def _with_index(chunk: ReadChunk, raw: RawRecord, indexed: bool) -> ChunkEntry:
    """Return the entry of a chunk after comparing the message index that follows it."""
    if not raw.is_message_index:
        raise RecordingError(f"chunk at {chunk.offset}: has no message index")
    expected = message_index(chunk.topic, chunk.times, chunk.offsets, indexed)
    if expected[RECORD_HEAD.size :] != raw.body:
        raise RecordingError(f"the message index at {raw.offset} does not lead to the chunk's messages")
    return chunk.entry._replace(index_length=len(expected))


def _ends_torn(stream: BinaryIO, contents: Index) -> bool:
    """Return whether a file ends with a record that was not written to its end, or with nothing but zeros.

    Before it may stand a good chunk without its index, which is written again.
    """
    offset = contents.end
    if contents.size > len(MAGIC):
        stream.seek(-len(MAGIC), os.SEEK_END)
        if stream.read() == MAGIC:
            return False  # it was closed: a damaged length may look like a cut
    if offset == 0:
        return contents.size == 0 or _only_zeros(stream, 0)
    for _ in range(2):
        stream.seek(offset)
        head = stream.read(RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            return True
        raw = RawRecord.of(head, offset)
        if raw.end > contents.size and raw.is_known:
            return raw.length <= MAX_CHUNK_BYTES
        try:
            if not raw.is_chunk or raw.length > MAX_CHUNK_BYTES:
                raise RecordingError("no chunk")
            read_record(raw._replace(body=stream.read(raw.length)))
        except RecordingError:
            return _only_zeros(stream, offset)
        offset = raw.end
    return False


def _only_zeros(stream: BinaryIO, offset: int) -> bool:
    stream.seek(offset)
    while piece := stream.read(1 << 20):
        if any(piece):
            return False
    return True
