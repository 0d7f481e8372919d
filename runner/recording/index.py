"""Where things stand in a recording: read from its summary, or found by walking its records.

A file declares sizes and offsets; none is believed before it is compared with the file's own size.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import BinaryIO, Final, NamedTuple, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    Footer,
    Header,
    MetadataIndex,
    Schema,
)
from mcap.writer import MCAP0_MAGIC

from runner.errors import RecordingError
from runner.recording.schema import PROFILE

K = TypeVar("K")
T = TypeVar("T")

MAX_RECORD_BYTES: Final = 64 << 20
_HEAD: Final = struct.Struct("<BQ")
_CHUNK_HEAD: Final = struct.Struct("<QQQII")
_CHUNK_INDEX_HEAD: Final = struct.Struct("<QQQQI")
_OFFSET_ENTRY: Final = struct.Struct("<HQ")
_EXPECTED: Final = frozenset(
    {
        *(Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK),
        *(Opcode.MESSAGE_INDEX, Opcode.METADATA, Opcode.ATTACHMENT),
    }
)
"""What the data section has: behind anything else nothing can be believed."""
_FOOTER_BYTES: Final = 9 + 20
_TAIL_BYTES: Final = _FOOTER_BYTES + len(MCAP0_MAGIC)


class ChunkEntry(NamedTuple):
    """A chunk: where it stands, and what it says of itself."""

    offset: int
    length: int
    """Bytes of the record, its head included."""
    start_time: int
    end_time: int
    uncompressed_size: int
    channels: tuple[int, ...]
    """Channels by its message index; empty if it has none."""


@dataclass
class Index:
    """The places of a recording's parts."""

    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    chunks: list[ChunkEntry] = field(default_factory=list)
    attachments: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Name to (offset, length) of the record."""
    metadata: dict[str, tuple[int, int]] = field(default_factory=dict)
    finished: bool = False
    end: int = 0
    """Offset behind the last whole record of the data section."""


def read_index(stream: BinaryIO, path: str) -> Index:
    """Return the index of a recording: by its summary if it is finished, else by walking its records.

    Raises:
        RecordingError: it is no recording of ours, or is damaged before its first chunk.
    """
    size = stream.seek(0, 2)
    _check_beginning(stream, path)
    footer = _footer(stream, size)
    if footer is not None:
        return _from_summary(stream, path, footer, size)
    index = _from_records(stream, path, size)
    if not index.channels:
        raise RecordingError(f"{path}: the recording was cut off before its first message.")
    return index


def _check_beginning(stream: BinaryIO, path: str) -> None:
    stream.seek(0)
    beginning = stream.read(len(MCAP0_MAGIC) + 9)
    if not beginning:
        raise RecordingError(f"{path}: found an empty file, expected a recording.")
    if not beginning.startswith(MCAP0_MAGIC):
        raise RecordingError(f"{path}: found {beginning[:8]!r} at its start, expected an MCAP file.")
    opcode, length = _HEAD.unpack(beginning[len(MCAP0_MAGIC) :].ljust(9, b"\0"))
    header = _parse(Header, stream.read(min(length, 4096)), path, len(MCAP0_MAGIC))
    if opcode != Opcode.HEADER or header.profile != PROFILE:
        raise RecordingError(
            f"{path}: found an MCAP file of profile {header.profile!r}, expected {PROFILE!r}: "
            "not a dualtaxi recording."
        )


def _footer(stream: BinaryIO, size: int) -> Footer | None:
    """Return the footer if the file ends as a finished one does."""
    if size < _TAIL_BYTES + len(MCAP0_MAGIC):
        return None
    stream.seek(size - _TAIL_BYTES)
    tail = stream.read(_TAIL_BYTES)
    if not tail.endswith(MCAP0_MAGIC) or _HEAD.unpack(tail[:9]) != (Opcode.FOOTER, 20):
        return None
    return Footer.read(ReadDataStream(BytesIO(tail[9:])))


def _from_summary(stream: BinaryIO, path: str, footer: Footer, size: int) -> Index:
    """Return the index in the summary section, after comparing its checksum."""
    start, end = footer.summary_start, size - _TAIL_BYTES
    if not len(MCAP0_MAGIC) < start <= footer.summary_offset_start <= end:
        raise RecordingError(
            f"{path}: the footer points to a summary at {start}, outside the file; try `repair`."
        )
    stream.seek(start)
    summary = stream.read(end - start)
    fields = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, footer.summary_offset_start)
    if zlib.crc32(fields, zlib.crc32(summary)) != footer.summary_crc:
        raise RecordingError(f"{path}: the summary at {start} does not match its checksum; try `repair`.")
    index = Index(finished=True, end=start)
    view = memoryview(summary)
    for opcode, offset, body in _records(view, start, path):
        if opcode == Opcode.SCHEMA:
            schema = _parse(Schema, body, path, offset)
            _put(index.schemas, schema.id, schema, path, "schema")
        elif opcode == Opcode.CHANNEL:
            channel = _parse(Channel, body, path, offset)
            _put(index.channels, channel.id, channel, path, "channel")
        elif opcode == Opcode.CHUNK_INDEX:
            chunk = _chunk_entry(body, path, offset)
            _within(path, "chunk", chunk.offset, chunk.length, start)
            if index.chunks and chunk.offset < index.chunks[-1].offset + index.chunks[-1].length:
                raise RecordingError(f"{path}: the index has chunks that overlap, at {chunk.offset}.")
            index.chunks.append(chunk)
        elif opcode == Opcode.ATTACHMENT_INDEX:
            attachment = _parse(AttachmentIndex, body, path, offset)
            _within(path, "attachment", attachment.offset, attachment.length, start)
            place = (attachment.offset, attachment.length)
            _put(index.attachments, attachment.name, place, path, "attachment")
        elif opcode == Opcode.METADATA_INDEX:
            metadata = _parse(MetadataIndex, body, path, offset)
            _within(path, "metadata", metadata.offset, metadata.length, start)
            _put(index.metadata, metadata.name, (metadata.offset, metadata.length), path, "metadata")
    return index


def _from_records(stream: BinaryIO, path: str, size: int) -> Index:
    """Return the index of an unfinished file, up to the last whole record."""
    index = Index()
    offset = len(MCAP0_MAGIC)
    while offset + 9 <= size:
        stream.seek(offset)
        opcode, length = _HEAD.unpack(stream.read(9))
        torn = offset + 9 + length > size
        if torn or opcode not in _EXPECTED or (opcode == Opcode.MESSAGE_INDEX and not index.chunks):
            break
        _note(index, stream, path, opcode, offset, length)
        offset += 9 + length
    index.end = offset
    return index


def _note(index: Index, stream: BinaryIO, path: str, opcode: int, offset: int, length: int) -> None:
    """Take one record of the data section into the index; the stream stands behind its head."""
    if opcode == Opcode.CHUNK:
        start, end, uncompressed, _, _ = _CHUNK_HEAD.unpack(
            stream.read(_CHUNK_HEAD.size).ljust(_CHUNK_HEAD.size, b"\0")
        )
        index.chunks.append(ChunkEntry(offset, 9 + length, start, end, uncompressed, ()))
    elif opcode == Opcode.MESSAGE_INDEX:
        (channel,) = struct.unpack("<H", stream.read(2).ljust(2, b"\0"))
        last = index.chunks[-1]
        index.chunks[-1] = ChunkEntry(
            last.offset,
            last.length,
            last.start_time,
            last.end_time,
            last.uncompressed_size,
            (*last.channels, channel),
        )
    elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT):
        body = stream.read(min(length, MAX_RECORD_BYTES))
        if opcode == Opcode.SCHEMA:
            schema = _parse(Schema, body, path, offset)
            _put(index.schemas, schema.id, schema, path, "schema")
        elif opcode == Opcode.CHANNEL:
            channel_record = _parse(Channel, body, path, offset)
            _put(index.channels, channel_record.id, channel_record, path, "channel")
        elif opcode == Opcode.METADATA:
            _put(index.metadata, _name(body, 0, path, offset), (offset, 9 + length), path, "metadata")
        else:
            _put(index.attachments, _name(body, 16, path, offset), (offset, 9 + length), path, "attachment")


def _records(view: memoryview, base: int, path: str) -> Iterator[tuple[int, int, bytes]]:
    """Yield (opcode, offset in the file, body) of the records in a piece of it."""
    at = 0
    while at < len(view):
        if at + 9 > len(view):
            raise RecordingError(
                f"{path}: found {len(view) - at} stray bytes at {base + at}, expected a record."
            )
        opcode, length = _HEAD.unpack(view[at : at + 9])
        if length > len(view) - at - 9:
            raise RecordingError(
                f"{path}: the record at {base + at} declares {length} bytes, {len(view) - at - 9} are there."
            )
        yield opcode, base + at, bytes(view[at + 9 : at + 9 + length])
        at += 9 + length


def _chunk_entry(body: bytes, path: str, offset: int) -> ChunkEntry:
    """Return the entry in a ChunkIndex record: there are thousands, so not by the library's reader."""
    try:
        start, end, chunk_offset, length, map_bytes = _CHUNK_INDEX_HEAD.unpack_from(body)
        channels = tuple(channel for channel, _ in _OFFSET_ENTRY.iter_unpack(body[36 : 36 + map_bytes]))
        at = 36 + map_bytes + 8
        (name_length,) = struct.unpack_from("<I", body, at)
        (uncompressed,) = struct.unpack_from("<Q", body, at + 4 + name_length + 8)
    except struct.error as error:
        raise RecordingError(f"{path}: the ChunkIndex record at {offset} cannot be read.") from error
    return ChunkEntry(chunk_offset, length, start, end, uncompressed, channels)


def _parse(kind: type[T], body: bytes, path: str, offset: int) -> T:
    """Return the record in these bytes."""
    try:
        return kind.read(ReadDataStream(BytesIO(body)))  # type: ignore[attr-defined, no-any-return]
    except (McapError, struct.error, UnicodeDecodeError, ValueError) as error:
        raise RecordingError(f"{path}: the {kind.__name__} record at {offset} cannot be read.") from error


def _name(body: bytes, at: int, path: str, offset: int) -> str:
    """Return the name that stands, with its length before it, at `at` in a record's body."""
    try:
        (length,) = struct.unpack_from("<I", body, at)
        return body[at + 4 : at + 4 + length].decode()
    except (struct.error, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: the record at {offset} has no readable name.") from error


def _put(known: dict[K, T], key: K, value: T, path: str, what: str) -> None:
    """Add what may stand in a file once."""
    if key in known:
        raise RecordingError(f"{path}: has {what} {key!r} twice.")
    known[key] = value


def _within(path: str, what: str, offset: int, length: int, end: int) -> None:
    if offset < len(MCAP0_MAGIC) or length < 9 or offset + length > end:
        raise RecordingError(
            f"{path}: the index points to {what} of {length} bytes at {offset}, outside the data."
        )
