"""The index of a recording: read from its summary, or found by walking its records.

A file declares sizes and offsets; each is compared with the file's own size before it is used. What is kept
in memory is bounded whatever the file declares: 34 bytes a chunk, and few names.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import BinaryIO, Final, NamedTuple, TypeVar

import numpy as np
from isal.isal_zlib import crc32
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, Footer, Header, MetadataIndex, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

from runner.errors import RecordingError
from runner.recording.blocks import MESSAGE_HEAD, RECORD_HEAD
from runner.recording.chunks import CHUNK_HEAD, MAX_CHUNK_BYTES
from runner.recording.records import IN_DATA, MAX_NAME_BYTES, MAX_NAMED, check_unpacked_size, record_heads
from runner.recording.schema import ALL_TOPICS, MESSAGES, PROFILE, TOPIC_OF
from runner.util.arrays import Records

K = TypeVar("K")
T = TypeVar("T")

MAX_CHUNKS: Final = 1 << 21
"""The most chunks that a recording is read with: a chunk of steps holds 256 or more."""
MAX_RECORD_BYTES: Final = 1 << 16
"""The largest record of a summary, schema or channel; the recorder's are below 4 kB."""
_PIECE: Final = 1 << 20
_CHUNK_INDEX_HEAD: Final = struct.Struct("<QQQQI")
_OFFSET_ENTRY: Final = struct.Struct("<HQ")
FOOTER_HEAD: Final = struct.Struct("<BQQQ")
"""The part of the footer that its checksum covers: opcode, length, starts of summary and summary offsets."""
FOOTER_BODY_BYTES: Final = 20
_TAIL_BYTES: Final = RECORD_HEAD.size + FOOTER_BODY_BYTES + len(MCAP0_MAGIC)


class ChunkEntry(NamedTuple):
    """The place of a chunk, and what it declares."""

    offset: int
    length: int
    """Bytes of the record, its head included."""
    uncompressed_size: int
    start_time: int
    end_time: int
    channel: int
    """The channel of its messages, by its message index; 0 if it has none."""


_ENTRY: Final = struct.Struct("<QIIQQH")
_ENTRY_COLUMNS: Final = np.dtype(
    list(zip(ChunkEntry._fields, ("<u8", "<u4", "<u4", "<u8", "<u8", "<u2"), strict=True))
)


class ChunkTable:
    """The chunks of a recording in the order of the file, 34 bytes each."""

    def __init__(self) -> None:
        self._packed = bytearray()

    def __len__(self) -> int:
        return len(self._packed) // _ENTRY.size

    def __getitem__(self, k: int) -> ChunkEntry:
        return ChunkEntry(*_ENTRY.unpack_from(self._packed, k * _ENTRY.size))

    def append(self, entry: ChunkEntry) -> None:
        """Add a chunk after the last one.

        Raises:
            RecordingError: no recorder writes a chunk of the size, or at the place, that it declares.
        """
        where = f"the chunk at {entry.offset}"
        if entry.length > MAX_CHUNK_BYTES or entry.uncompressed_size > MAX_CHUNK_BYTES:
            size = max(entry.length, entry.uncompressed_size)
            raise RecordingError(f"{where} declares {size:,} bytes, expected at most {MAX_CHUNK_BYTES:,}.")
        if (
            entry.length < RECORD_HEAD.size + CHUNK_HEAD.size + 8
            or entry.uncompressed_size < MESSAGE_HEAD.size
        ):
            raise RecordingError(f"{where} declares fewer bytes than a chunk with a message has.")
        if len(self) and entry.offset < sum(self[len(self) - 1][:2]):
            raise RecordingError(f"{where} overlaps the one before it in the index.")
        if len(self) == MAX_CHUNKS:
            raise RecordingError(f"has more than {MAX_CHUNKS:,} chunks, the most that a recording may have.")
        self._packed += _ENTRY.pack(*entry)

    def set_channel(self, channel: int) -> None:
        """Set the channel of the last chunk's messages.

        Raises:
            RecordingError: it was set before, or no recording has such a channel.
        """
        last = self[len(self) - 1]
        if last.channel or channel not in TOPIC_OF:
            raise RecordingError(
                f"chunk at {last.offset}: found messages of channel {channel}"
                f"{f' and {last.channel}' if last.channel else ''}, expected those of one topic."
            )
        self._packed[-_ENTRY.size :] = _ENTRY.pack(*last._replace(channel=channel))

    @property
    def columns(self) -> Records:
        """All chunks as a structured array with the fields of `ChunkEntry`: a view."""
        return np.frombuffer(self._packed, _ENTRY_COLUMNS)


@dataclass
class Index:
    """The places of a recording's records."""

    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, bytes] = field(default_factory=dict)
    """Id to the schema as it is in the file."""
    chunks: ChunkTable = field(default_factory=ChunkTable)
    attachments: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Name to (offset, length) of the record."""
    metadata: dict[str, tuple[int, int]] = field(default_factory=dict)
    message_counts: dict[int, int] = field(default_factory=dict)
    """Messages by channel, as the summary counts them; empty without one."""
    finished: bool = False
    end: int = 0
    """Offset after the last whole record of the data section."""


def read_index(stream: BinaryIO, path: str) -> Index:
    """Return the index of a recording: by its summary if it is finished, else by walking its records.

    Raises:
        RecordingError: it is not a dualtaxi recording, or is damaged before its first chunk.
    """
    size = stream.seek(0, 2)
    try:
        _check_beginning(stream)
        footer = _footer(stream, size)
        index = _from_records(stream, size) if footer is None else _from_summary(stream, footer, size)
        if not index.channels:
            raise RecordingError("the recording was cut off before its first message.")
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error
    unpacked = int(index.chunks.columns["uncompressed_size"].sum(dtype=np.uint64)) if index.chunks else 0
    check_unpacked_size(size, unpacked, path)
    return index


def checksum(stream: BinaryIO, start: int, end: int) -> int:
    """Return the checksum of a part of the file, which need not fit into memory."""
    crc, at = 0, stream.seek(start)
    while at < end and (piece := stream.read(min(_PIECE, end - at))):
        crc = crc32(piece, crc)
        at += len(piece)
    return crc


def _check_beginning(stream: BinaryIO) -> None:
    stream.seek(0)
    beginning = stream.read(len(MCAP0_MAGIC) + RECORD_HEAD.size)
    if not beginning:
        raise RecordingError("found an empty file, expected a recording.")
    if not beginning.startswith(MCAP0_MAGIC):
        raise RecordingError(f"found {beginning[:8]!r} at its start, expected an MCAP file.")
    opcode, length = RECORD_HEAD.unpack(beginning[len(MCAP0_MAGIC) :].ljust(RECORD_HEAD.size, b"\0"))
    header = _parse(Header, stream.read(min(length, 4096)), len(MCAP0_MAGIC))
    if opcode != Opcode.HEADER or header.profile != PROFILE:
        raise RecordingError(
            f"found an MCAP file of profile {header.profile!r}, expected {PROFILE!r}: "
            "not a dualtaxi recording."
        )


def _footer(stream: BinaryIO, size: int) -> Footer | None:
    """Return the footer if the file ends as a finished one does."""
    if size < _TAIL_BYTES + len(MCAP0_MAGIC):
        return None
    stream.seek(size - _TAIL_BYTES)
    tail = stream.read(_TAIL_BYTES)
    head, body = tail[: RECORD_HEAD.size], tail[RECORD_HEAD.size :]
    if not tail.endswith(MCAP0_MAGIC) or RECORD_HEAD.unpack(head) != (Opcode.FOOTER, FOOTER_BODY_BYTES):
        return None
    return Footer.read(ReadDataStream(BytesIO(body)))


def _from_summary(stream: BinaryIO, footer: Footer, size: int) -> Index:
    """Return the index in the summary section, after comparing its checksum."""
    start, end = footer.summary_start, size - _TAIL_BYTES
    if not len(MCAP0_MAGIC) < start <= footer.summary_offset_start <= end:
        raise RecordingError(f"the footer points to a summary at {start}, outside the file; try `repair`.")
    fields = FOOTER_HEAD.pack(Opcode.FOOTER, FOOTER_BODY_BYTES, start, footer.summary_offset_start)
    if crc32(fields, checksum(stream, start, end)) != footer.summary_crc:
        raise RecordingError(f"the summary at {start} does not match its checksum; try `repair`.")
    index = Index(finished=True, end=start)
    for opcode, offset, body in _records(stream, start, end):
        _add_summary_record(index, opcode, offset, body, start)
    return index


def _add_summary_record(index: Index, opcode: int, offset: int, body: bytes, data_end: int) -> None:
    if opcode == Opcode.CHUNK_INDEX:
        chunk = _chunk_entry(body, offset)
        _check_place("chunk", chunk.offset, chunk.length, data_end)
        index.chunks.append(chunk._replace(channel=0))
        if chunk.channel:
            index.chunks.set_channel(chunk.channel)
    elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
        _add_schema_or_channel(index, opcode, offset, body)
    elif opcode == Opcode.STATISTICS:
        index.message_counts = dict(_parse(Statistics, body, offset).channel_message_counts)
    elif opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
        is_metadata = opcode == Opcode.METADATA_INDEX
        entry = _parse(MetadataIndex if is_metadata else AttachmentIndex, body, offset)
        what = "metadata" if is_metadata else "attachment"
        _check_place(what, entry.offset, entry.length, data_end)
        places = index.metadata if is_metadata else index.attachments
        _add_once(places, entry.name, (entry.offset, entry.length), what)


def _from_records(stream: BinaryIO, size: int) -> Index:
    """Return the index of an unfinished file, up to the last whole record."""
    index = Index(end=len(MCAP0_MAGIC))
    for opcode, offset, length in record_heads(stream, size):
        if opcode not in IN_DATA or (opcode == Opcode.MESSAGE_INDEX and not index.chunks):
            break
        _add_record(index, stream, opcode, offset, length)
        index.end = offset + RECORD_HEAD.size + length
    return index


def _add_record(index: Index, stream: BinaryIO, opcode: int, offset: int, length: int) -> None:
    """Add one record of the data section to the index; the stream is at its body."""
    if opcode == Opcode.CHUNK:
        head = stream.read(min(length, CHUNK_HEAD.size)).ljust(CHUNK_HEAD.size, b"\0")
        start, end, unpacked, _, _ = CHUNK_HEAD.unpack(head)
        index.chunks.append(ChunkEntry(offset, RECORD_HEAD.size + length, unpacked, start, end, 0))
    elif opcode == Opcode.MESSAGE_INDEX:
        (channel,) = struct.unpack("<H", stream.read(min(length, 2)).ljust(2, b"\0"))
        index.chunks.set_channel(channel)
    elif opcode == Opcode.METADATA:
        name = _name(stream.read(min(length, 4 + MAX_NAME_BYTES)), 0, offset)
        _add_once(index.metadata, name, (offset, RECORD_HEAD.size + length), "metadata")
    elif opcode == Opcode.ATTACHMENT:
        name = _name(stream.read(min(length, 20 + MAX_NAME_BYTES)), 16, offset)
        _add_once(index.attachments, name, (offset, RECORD_HEAD.size + length), "attachment")
    elif opcode != Opcode.HEADER:
        _check_length(length, offset)
        _add_schema_or_channel(index, opcode, offset, stream.read(length))
    elif offset != len(MCAP0_MAGIC):
        raise RecordingError(f"found a second header at {offset}.")


def _add_schema_or_channel(index: Index, opcode: int, offset: int, body: bytes) -> None:
    if opcode == Opcode.CHANNEL:
        channel = _parse(Channel, body, offset)
        _add_once(index.channels, channel.id, channel, "channel")
        return
    schema = _parse(Schema, body, offset)
    _add_once(index.schemas, schema.id, schema.data, "schema")


def _records(stream: BinaryIO, start: int, end: int) -> Iterator[tuple[int, int, bytes]]:
    at = stream.seek(start)
    while at < end:
        available = end - at - RECORD_HEAD.size
        if available < 0:
            raise RecordingError(f"found {end - at} stray bytes at {at}, expected a record.")
        opcode, length = RECORD_HEAD.unpack(stream.read(RECORD_HEAD.size))
        if length > available:
            raise RecordingError(f"the record at {at} declares {length} bytes, {available} are there.")
        _check_length(length, at)
        yield opcode, at, stream.read(length)
        at += RECORD_HEAD.size + length


def _check_length(length: int, offset: int) -> None:
    if length > MAX_RECORD_BYTES:
        raise RecordingError(
            f"the record at {offset} declares {length:,} bytes, expected at most {MAX_RECORD_BYTES:,}."
        )


def _chunk_entry(body: bytes, offset: int) -> ChunkEntry:
    """Return the entry in a ChunkIndex record: there are thousands, so not by the library's reader."""
    try:
        start, end, chunk_offset, length, map_bytes = _CHUNK_INDEX_HEAD.unpack_from(body)
        map_start, map_end = _CHUNK_INDEX_HEAD.size, _CHUNK_INDEX_HEAD.size + map_bytes
        channels = [channel for channel, _ in _OFFSET_ENTRY.iter_unpack(body[map_start:map_end])]
        at = map_end + 8
        (name_length,) = struct.unpack_from("<I", body, at)
        (uncompressed,) = struct.unpack_from("<Q", body, at + 4 + name_length + 8)
    except struct.error as error:
        raise RecordingError(f"the ChunkIndex record at {offset} cannot be read.") from error
    if len(channels) > 1 or channels == [0]:
        raise RecordingError(
            f"the ChunkIndex record at {offset} names {len(channels)} channels, expected that of one topic."
        )
    return ChunkEntry(chunk_offset, length, uncompressed, start, end, channels[0] if channels else 0)


def _parse(kind: type[T], body: bytes, offset: int) -> T:
    try:
        return kind.read(ReadDataStream(BytesIO(body)))  # type: ignore[attr-defined, no-any-return]
    except (McapError, struct.error, UnicodeDecodeError, ValueError) as error:
        raise RecordingError(f"the {kind.__name__} record at {offset} cannot be read.") from error


def _name(body: bytes, at: int, offset: int) -> str:
    """Return the text at `at` in a record's body, which its length precedes."""
    try:
        (length,) = struct.unpack_from("<I", body, at)
        name = body[at + 4 : at + 4 + length]
        if len(name) == length:
            return name.decode()
    except (struct.error, UnicodeDecodeError) as error:
        raise RecordingError(f"the record at {offset} has no readable name.") from error
    raise RecordingError(f"the record at {offset} declares a name of {length:,} bytes.")


def _add_once(known: dict[K, T], key: K, value: T, what: str) -> None:
    """Add an entry; a file may have one of each key, and not too many."""
    if key in known:
        raise RecordingError(f"has {what} {key!r} twice.")
    if len(known) == {"channel": len(ALL_TOPICS), "schema": len(MESSAGES)}.get(what, MAX_NAMED):
        raise RecordingError(
            f"has more than {len(known):,} {what} records, the most that a recording may have."
        )
    if isinstance(key, str) and len(key) > MAX_NAME_BYTES:
        raise RecordingError(f"has {what} with a name of {len(key):,} letters.")
    known[key] = value


def _check_place(what: str, offset: int, length: int, end: int) -> None:
    if offset < len(MCAP0_MAGIC) or length < RECORD_HEAD.size or offset + length > end:
        raise RecordingError(f"the index points to {what} of {length} bytes at {offset}, outside the data.")
