"""Whether a recording's bytes are what its recorder must have written, every one of them.

Each record is walked and each checksum compared (one of zero counts as missing); message indexes, the
end of the data section, summary and footer are built anew from the data and compared byte by byte.
"""

from __future__ import annotations

import struct
import zlib
from functools import cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.blocks import HEADER, HEADER_BYTES, RECORD_HEAD
from runner.recording.chunks import MAX_CHUNK_BYTES, chunk_head, message_index
from runner.recording.scan import Contents, Report, read_chunk, survey
from runner.recording.writer import RecordingFile, schema_and_channel_bytes
from runner.util.files import open_regular

Times = NDArray[np.uint64]


@cache
def _beginnings() -> tuple[bytes, ...]:
    """Return what recordings have behind their header, a kind each."""
    return tuple(schema_and_channel_bytes(topics) for topics in schema.KINDS.values())


def check_integrity(path: Path, report: Report = lambda *_: None) -> None:
    """Check every byte of a finished recording.

    Args:
        path: the recording.
        report: called with the bytes that were checked, and those of the file.

    Raises:
        RecordingError: something is wrong; the first such thing is named with its offset.
    """
    try:
        with open_regular(path) as stream:
            _check_beginning(stream, path)
        contents = survey(path, keep_result=True, check=_IndexCheck(path).take, report=report)
        if contents.reason:
            raise RecordingError(
                f"{path}: {contents.reason.removeprefix(f'{path}: ')}; `dualtaxi repair` mends it."
            )
        found, expected = _tails(path, contents)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error
    if found != expected:
        _refuse_tail(path, contents.end, found, expected)


def is_merely_cut_off(path: Path) -> bool:
    """Return whether an unfinished recording is, as far as it goes, what its recorder wrote.

    Raises:
        RecordingError: the file cannot be read, or begins as none of ours does.
    """
    try:
        with open_regular(path) as stream:
            _check_beginning(stream, path)
        contents = survey(path, keep_result=True, check=_IndexCheck(path).take)
        if contents.reason:
            return may_be_cut(path, contents)
        found, expected = _tails(path, contents)
        return expected.startswith(found)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error


def checked_survey(path: Path) -> Contents:
    """Return what of a recording is good to the last byte, from its beginning on; its result left out.

    Raises:
        RecordingError: the file cannot be read.
    """
    try:
        with open_regular(path) as stream:
            _check_beginning(stream, path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error
    except RecordingError as error:
        return Contents(size=path.stat().st_size, reason=str(error))
    return survey(path, check=_IndexCheck(path).take)


def may_be_cut(path: Path, contents: Contents) -> bool:
    """Return whether nothing is missing in what is good, and nothing good stands behind it.

    Args:
        path: a recording.
        contents: what of it is good, as `checked_survey` found.

    Raises:
        RecordingError: the file cannot be read.
    """
    if any(entry.name == "repair" for entry in contents.metadata):
        return False
    if not contents.reason:
        return True
    try:
        with open_regular(path) as stream:
            return _ends_torn(stream, contents)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error


def _tails(path: Path, contents: Contents) -> tuple[bytes, bytes]:
    """Return what stands behind the data of a recording, and what should stand there."""
    with RecordingFile.inspect(path, contents) as file:
        expected = file.tail()
    with open_regular(path) as stream:
        stream.seek(contents.end)
        return stream.read(len(expected) + 1), expected


def _ends_torn(stream: BinaryIO, contents: Contents) -> bool:
    """Return whether a file ends with a record that was not written to its end, or with nothing but zeros.

    Before it may stand a good chunk without its index, which comes again.
    """
    offset = contents.end
    if offset == 0:
        return contents.size == 0 or _only_zeros(stream, 0)
    for _ in range(2):
        stream.seek(offset)
        head = stream.read(RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            return True
        opcode, length = RECORD_HEAD.unpack(head)
        if offset + 9 + length > contents.size and 0 < opcode <= Opcode.DATA_END:
            return bool(length <= MAX_CHUNK_BYTES)
        if opcode != Opcode.CHUNK or not _is_good_chunk(stream.read(length), offset):
            return _only_zeros(stream, offset)
        offset += 9 + length
    return False


def _is_good_chunk(body: bytes, offset: int) -> bool:
    try:
        read_chunk(body, offset)
    except (RecordingError, struct.error, ValueError):
        return False
    return True


def _only_zeros(stream: BinaryIO, offset: int) -> bool:
    stream.seek(offset)
    while piece := stream.read(1 << 20):
        if any(piece):
            return False
    return True


def _check_beginning(stream: BinaryIO, path: Path) -> None:
    """Compare magic, header, schemas and channels; only the library's version may differ."""
    start = stream.read(len(MCAP0_MAGIC) + 9)
    if start[: len(MCAP0_MAGIC)] != MCAP0_MAGIC:
        raise RecordingError(f"{path}: found {start[:8]!r} at 0, expected the MCAP magic.")
    opcode, length = RECORD_HEAD.unpack(start[len(MCAP0_MAGIC) :].ljust(9, b"\0"))
    stream.seek(len(MCAP0_MAGIC) + 9 + min(length, 4096))
    if opcode != Opcode.HEADER or not _begins(stream):
        raise RecordingError(f"{path}: found other schemas or channels than every recording begins with.")


def _begins(stream: BinaryIO) -> bool:
    """Return whether the schemas and channels of a kind stand here."""
    found = stream.read(max(map(len, _beginnings())))
    return found.startswith(_beginnings())


class _IndexCheck:
    """Checks records beyond what `survey` does; the index of a chunk against the chunk before it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._expected = b""
        """The message index that belongs behind the last chunk."""

    def take(self, opcode: int, offset: int, body: bytes, records: bytes) -> None:
        """Check one record."""
        where = f"{self._path}: the record at {offset}"
        if opcode == Opcode.CHUNK:
            self._expected = self._check_chunk(offset, body, records)
        elif opcode == Opcode.MESSAGE_INDEX and self._expected[9:] != body:
            raise RecordingError(f"{where} is a message index that does not lead to the chunk's messages")
        elif opcode == Opcode.ATTACHMENT and body[-4:] == b"\0\0\0\0":
            raise RecordingError(f"{where} is an attachment without a checksum")

    def _check_chunk(self, offset: int, body: bytes, records: bytes) -> bytes:
        """Compare a chunk's times with its messages; return the index that belongs to them."""
        where = f"{self._path}: chunk at {offset}"
        head = chunk_head(body, len(body), where)
        if not head.crc:
            raise RecordingError(f"{where}: has no checksum")
        channel, times, offsets = places(records, where)
        if (head.start_time, head.end_time) != (int(times[0]), int(times[-1])):
            raise RecordingError(
                f"{where}: found times {head.start_time} to {head.end_time}, "
                f"expected {times[0]} to {times[-1]}"
            )
        return message_index(channel, times, offsets)


def places(records: bytes, where: str) -> tuple[int, Times, Times]:
    """Return channel, times and offsets of a chunk's messages; checks what every message must have."""
    times, offsets, channels = [], [], set()
    at = 0
    if len(records) >= HEADER_BYTES:
        _, length, channel = struct.unpack_from("<BQH", records)
        of_one_size = schema.TOPIC_OF.get(channel) in schema.ALL_BLOCK_TOPICS
        if of_one_size and length and len(records) % (9 + length) == 0:
            return _block_places(records, 9 + length, channel, where)
    while at + HEADER_BYTES <= len(records):
        opcode, length, channel, sequence, log_time, publish_time = struct.unpack_from("<BQHIQQ", records, at)
        if opcode != Opcode.MESSAGE or sequence or publish_time != log_time:
            raise RecordingError(f"{where}: found a message at {at} that no recorder writes.")
        times.append(log_time)
        offsets.append(at)
        channels.add(channel)
        at += 9 + length
    if at != len(records) or len(channels) != 1:
        raise RecordingError(f"{where}: found {len(channels)} channels and {len(records) - at} stray bytes.")
    return channels.pop(), np.array(times, dtype=np.uint64), np.array(offsets, dtype=np.uint64)


def _block_places(records: bytes, size: int, channel: int, where: str) -> tuple[int, Times, Times]:
    layout = np.dtype([*HEADER, ("data", "u1", (size - HEADER_BYTES,))])
    block = np.frombuffer(records, layout)
    times = block["log_time"]
    constant = (
        (block["opcode"] == Opcode.MESSAGE)
        & (block["record_length"] == size - 9)
        & (block["channel_id"] == channel)
        & (block["sequence"] == 0)
        & (block["publish_time"] == times)
    )
    if not constant.all():
        raise RecordingError(
            f"{where}: found a message at {int(np.argmin(constant)) * size} that no recorder writes."
        )
    return channel, times, np.arange(len(block), dtype=np.uint64) * np.uint64(size)


def _refuse_tail(path: Path, end: int, found: bytes, expected: bytes) -> None:
    pairs = enumerate(zip(found, expected, strict=False))
    at = next((k for k, (left, right) in pairs if left != right), min(len(found), len(expected)))
    if at < len(expected) and at < 13:
        what = "the checksum of the data section"
    elif at < len(expected):
        what = "the summary or footer"
    else:
        what = "the end of the file: there are bytes behind it"
    crc = zlib.crc32(found)
    raise RecordingError(
        f"{path}: found damage at {end + at} in {what} (read {len(found)} bytes, CRC {crc:08x})."
    )
