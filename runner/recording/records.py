"""The records in a recording's data: written, and read within bounds, as anyone may have written the file.

A chunk has the messages of one topic. Encoding it has no side effects and releases the interpreter lock for
checksum and compression, so that several threads can encode while another one learns.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from typing import BinaryIO, Final, NamedTuple, Self

import numpy as np
from isal.isal_zlib import crc32
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import McapRecord, Metadata
from numpy.lib.stride_tricks import sliding_window_view

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.layout import (
    HEADER,
    HEADER_BYTES,
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    constant_bytes,
    record_dtype,
)
from runner.util.arrays import Unsigned
from runner.util.packing import CODECS, MAX_CHUNK_BYTES, MAX_CHUNK_STEPS, MCAP_CODECS, UNPACK_ERRORS, Packing

MAX_METADATA_BYTES: Final = 4 << 20
"""The largest metadata record that is read, config and provenance among them."""
MAX_NAMED: Final = 4096
"""The most attachments, and the most metadata records; a resume adds one."""
MAX_NAME_BYTES: Final = 256
MAX_UNPACKED_RATIO: Final = 1000
"""How many bytes a byte of the file may declare to hold; files with more are made to exhaust memory."""
UNREADABLE: Final = (struct.error, ValueError, KeyError, McapError)
"""What parsing damaged records raises."""
_IN_DATA: Final = frozenset(
    {
        Opcode.HEADER,
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.CHUNK,
        Opcode.MESSAGE_INDEX,
        Opcode.METADATA,
        Opcode.ATTACHMENT,
    }
)
LARGE: Final = frozenset({Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.METADATA, Opcode.ATTACHMENT})
"""The kinds of records that may have more bytes than `MAX_RECORD_BYTES`."""
MAX_RECORD_BYTES: Final = 1 << 16
"""The largest record of a summary or channel; the recorder's are below 4 kB."""
_BEGINNING_BYTES: Final = 1 << 10
"""Bytes of a body in which a chunk's head is, or a name of `MAX_NAME_BYTES`."""
_CHUNK_TIMES: Final = struct.Struct("<QQ")
_PLAIN_BYTES: Final = 4 << 20
"""Chunks of up to this size are unpacked without checking their first message."""
CHUNK_HEAD: Final = struct.Struct("<QQQII")
"""Start time, end time, size unpacked, its CRC, and the length of the name of the compression."""
_DATA_LENGTH: Final = struct.Struct("<Q")
_MAX_CODEC_BYTES: Final = max(map(len, MCAP_CODECS))

Place = tuple[int, int]
"""Where a record begins in the file, and how many bytes it has, its head included."""
Report = Callable[[int, int], None]
"""Called with the bytes that were read, and the size of the file."""


class MetadataRecord(NamedTuple):
    """A metadata record."""

    name: str
    entries: dict[str, str]


class AttachmentRecord(NamedTuple):
    """An undamaged attachment."""

    name: str
    media_type: str
    data: bytes


class ChunkEntry(NamedTuple):
    """The place of a chunk, and what it declares."""

    offset: int
    length: int
    """Bytes of the record, its head included."""
    uncompressed_size: int
    start_time: int
    end_time: int
    channel: int
    """The channel of its messages; 0 if neither its message index nor its messages were read."""
    compression: bytes = b""
    messages: int = 0
    """The number of its messages; 0 if they were not read."""
    index_length: int = 0
    """Bytes of the message index record after it; 0 if it was not read."""


@dataclass(frozen=True)
class Chunk:
    """An encoded chunk: its MCAP records, and its entry, in which the places are still missing."""

    record: bytes
    index: bytes
    entry: ChunkEntry


class ReadChunk(NamedTuple):
    """An undamaged chunk and its messages."""

    body: bytes
    """The body of the record, as it is in the file."""
    entry: ChunkEntry
    """Its place; without its message index."""
    records: bytes
    """The message records."""
    times: Unsigned
    """Log times of the messages, in nanoseconds."""
    offsets: Unsigned
    """Where each message begins in `records`."""

    @property
    def offset(self) -> int:
        """Where the record is in the file."""
        return self.entry.offset

    @property
    def topic(self) -> schema.Topic:
        """The topic of its messages."""
        return schema.TOPIC_OF[self.entry.channel]

    @property
    def messages(self) -> list[bytes]:
        """The message records one by one."""
        edges = pairwise([*self.offsets.tolist(), len(self.records)])
        return [self.records[start:stop] for start, stop in edges]


class RawRecord(NamedTuple):
    """A record as it is in a file; its body may be left out, or read no further than its beginning."""

    kind: int
    """Its opcode."""
    length: int
    """Bytes of the whole body."""
    offset: int
    body: bytes = b""

    @classmethod
    def of(cls, head: bytes, offset: int, body: bytes = b"") -> Self:
        """Return the record at an offset that begins with these bytes."""
        kind, length = RECORD_HEAD.unpack_from(head)
        return cls(kind, length, offset, body)

    @property
    def end(self) -> int:
        """Where the next record begins."""
        return self.offset + RECORD_HEAD.size + self.length

    @property
    def place(self) -> Place:
        """Its place."""
        return self.offset, RECORD_HEAD.size + self.length

    @property
    def is_known(self) -> bool:
        """Whether MCAP has such records up to the end of the data section."""
        return bool(1 <= self.kind <= Opcode.DATA_END)

    @property
    def is_data(self) -> bool:
        """Whether recordings have such records in the data section; after any other, all is in doubt."""
        return self.kind in _IN_DATA

    @property
    def is_chunk(self) -> bool:
        """Whether it is a chunk."""
        return bool(self.kind == Opcode.CHUNK)

    @property
    def is_message_index(self) -> bool:
        """Whether it is the message index of a chunk."""
        return bool(self.kind == Opcode.MESSAGE_INDEX)

    @property
    def ends_data(self) -> bool:
        """Whether it is the end of the data section."""
        return (self.kind, self.length) == (Opcode.DATA_END, 4)


Record = MetadataRecord | AttachmentRecord | ReadChunk
"""A record that a copy of a recording takes over; the other kinds follow from these."""


def most_bytes(kind: int) -> int:
    """Return the most bytes of a record of a kind that is not `LARGE`; schemas name all parts of spaces."""
    return MAX_METADATA_BYTES if kind == Opcode.SCHEMA else MAX_RECORD_BYTES


def raw_records(stream: BinaryIO, start: int, end: int, whole: bool = False) -> Iterator[RawRecord]:
    """Yield the records in a part of a file, up to the last one that is not cut off.

    Args:
        whole: read also more of a body than `MAX_RECORD_BYTES`, and of large kinds more than the beginning.
    """
    while start + RECORD_HEAD.size <= end:
        stream.seek(start)
        kind, length = RECORD_HEAD.unpack(stream.read(RECORD_HEAD.size))
        if start + RECORD_HEAD.size + length > end:
            return
        of_kind = _BEGINNING_BYTES if kind in LARGE else most_bytes(kind)
        most = MAX_CHUNK_BYTES if whole else of_kind
        yield RawRecord(kind, length, start, stream.read(min(length, most)))
        start += RECORD_HEAD.size + length


def walk(stream: BinaryIO, size: int) -> Iterator[RawRecord]:
    """Yield the whole records of the data section and its end.

    Ends early at a record that is cut off or makes no sense.
    """
    for raw in raw_records(stream, len(MAGIC), size, whole=True):
        if raw.length > MAX_CHUNK_BYTES or not raw.is_known:
            return
        yield raw
        if raw.ends_data:
            return


# --- chunks -------------------------------------------------------------------------------------------


def encode_chunk(
    topic: schema.Topic,
    records: bytes | memoryview,
    log_times: Unsigned,
    offsets: Unsigned,
    packing: Packing,
) -> Chunk:
    """Return the chunk that holds these whole message records of one topic.

    Args:
        log_times: nanoseconds of each, ascending.
        offsets: where each begins in `records`.
    """
    codec = CODECS[packing.compression]
    name = codec.mcap_name.encode()
    width = len(records) // len(log_times) if topic.message is schema.STEP and packing.values else 0
    size, crc = len(records), crc32(records)
    data = codec.pack(records, packing.level, width)
    start, end = int(log_times[0]), int(log_times[-1])
    head = CHUNK_HEAD.pack(start, end, size, crc, len(name)) + name
    head += _DATA_LENGTH.pack(len(data))
    record = b"".join((RECORD_HEAD.pack(Opcode.CHUNK, len(head) + len(data)), head, data))
    index = message_index(topic, log_times, offsets, packing.index == "message")
    entry = ChunkEntry(0, len(record), size, start, end, topic.channel, name, len(log_times))
    return Chunk(record, index, entry)


def message_index(topic: schema.Topic, log_times: Unsigned, offsets: Unsigned, indexed: bool) -> bytes:
    """Return the MessageIndex record that follows a chunk, and names its channel.

    Args:
        indexed: whether it has an entry for each message, unless they are extras: it would be as large as
            they are.
    """
    count = len(log_times) if indexed and topic.message is not schema.EXTRA else 0
    entries = np.empty((count, 2), dtype="<u8")
    entries[:, 0], entries[:, 1] = log_times[:count], offsets[:count]
    head = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + entries.nbytes, topic.channel, entries.nbytes)
    return b"".join((head, entries.data))


def copied_chunk(chunk: ReadChunk, indexed: bool) -> Chunk:
    """Return a chunk to be written as it was read, with its times and its message index made again.

    Args:
        indexed: whether the message index has an entry for each message.
    """
    start, end = int(chunk.times[0]), int(chunk.times[-1])
    body = _CHUNK_TIMES.pack(start, end) + chunk.body[_CHUNK_TIMES.size :]  # no checksum covers them
    index = message_index(chunk.topic, chunk.times, chunk.offsets, indexed)
    entry = chunk.entry._replace(start_time=start, end_time=end)
    return Chunk(RECORD_HEAD.pack(Opcode.CHUNK, len(body)) + body, index, entry)


@dataclass(frozen=True)
class ChunkHead:
    """The fields of a chunk record before its data."""

    start_time: int
    end_time: int
    uncompressed_size: int
    crc: int
    compression: str
    data_at: int
    """Where the data begin in the record's body."""


def chunk_head(body: bytes | memoryview, length: int, where: str) -> ChunkHead:
    """Return the head of a chunk record.

    Args:
        body: the body of the record, or its first 60 bytes.
        length: bytes of the whole body.

    Raises:
        RecordingError: it contradicts itself, or declares more than `MAX_CHUNK_BYTES`.
    """
    try:
        start, end, size, crc, name_length = CHUNK_HEAD.unpack_from(body)
        at = CHUNK_HEAD.size + min(name_length, _MAX_CODEC_BYTES)
        name = bytes(body[CHUNK_HEAD.size : at])
        (packed,) = _DATA_LENGTH.unpack_from(body, at)
        data_at = at + _DATA_LENGTH.size
    except struct.error as error:
        raise RecordingError(f"{where}: the record cannot be read") from error
    if name_length > _MAX_CODEC_BYTES or name.decode("latin-1") not in MCAP_CODECS:
        raise RecordingError(f"{where}: found compression {name!r}, expected one of {', '.join(CODECS)}")
    if packed != length - data_at or size > MAX_CHUNK_BYTES:
        raise RecordingError(
            f"{where}: declares {packed:,} bytes packed and {size:,} unpacked, "
            f"expected {length - data_at:,} and at most {MAX_CHUNK_BYTES:,}"
        )
    return ChunkHead(start, end, size, crc, name.decode(), data_at)


def unpack_chunk(body: bytes | memoryview, where: str) -> tuple[ChunkHead, bytes]:
    """Return the head of a chunk and its message records, after comparing their checksum.

    Raises:
        RecordingError: it is damaged, or larger than any that a recorder writes.
    """
    view = memoryview(body)
    head = chunk_head(view, len(view), where)
    if head.uncompressed_size > _PLAIN_BYTES:
        # A few kilobytes can unpack to the largest chunk there is; thousands of them would keep a reader busy
        # for minutes before their messages were found to make no sense.
        length, channel = first_message(view, head, where)
        messages = head.uncompressed_size // (RECORD_HEAD.size + length)
        topic = schema.TOPIC_OF.get(channel)
        is_row = topic in schema.ROW_TOPICS or (topic is not None and topic.message is schema.EXTRA)
        if is_row and messages > MAX_CHUNK_STEPS:
            raise RecordingError(
                f"{where}: declares {messages:,} messages, expected {MAX_CHUNK_STEPS:,} at most"
            )
    size = head.uncompressed_size
    records, more = _unpack(view[head.data_at :], head.compression, size, where)
    if len(records) != size or more:
        raise RecordingError(f"{where}: found a chunk of another size than the {size} bytes it declares")
    if crc32(records) != head.crc:
        raise RecordingError(f"{where}: its content does not match its checksum")
    return head, records


def first_message(body: memoryview, head: ChunkHead, where: str) -> tuple[int, int]:
    """Return the record length and the channel of a chunk's first message; only that is unpacked."""
    beginning, _ = _unpack(body[head.data_at :], head.compression, MESSAGE_HEAD.size, where)
    if len(beginning) < MESSAGE_HEAD.size:
        raise RecordingError(f"{where}: holds no whole message")
    _, length, channel, *_ = MESSAGE_HEAD.unpack_from(beginning)
    return length, channel


def _unpack(data: bytes | memoryview, compression: str, size: int, where: str) -> tuple[bytes, bool]:
    """Return the first `size` bytes, or all if there are fewer, and whether there are more.

    Never allocates more than that.
    """
    try:
        return MCAP_CODECS[compression].unpack(data, size)
    except UNPACK_ERRORS as error:
        raise RecordingError(f"{where}: the chunk cannot be decompressed ({error})") from error


def checked_messages(records: bytes, where: str) -> tuple[int, Unsigned, Unsigned]:
    """Return channel, times and offsets of a chunk's messages.

    Raises:
        RecordingError: no recorder writes such messages.
    """
    if len(records) < HEADER_BYTES:
        raise RecordingError(f"{where}: holds no whole message")
    _, length, channel, *_ = MESSAGE_HEAD.unpack_from(records)
    if channel not in schema.TOPIC_OF:
        raise RecordingError(f"{where}: found messages of channel {channel}, which no recording has")
    size = RECORD_HEAD.size + length
    data = np.frombuffer(records, np.uint8)
    rows = data.reshape(-1, size) if size >= HEADER_BYTES and not len(records) % size else None
    if rows is not None and (rows[:, : RECORD_HEAD.size] == rows[0, : RECORD_HEAD.size]).all():
        offsets = np.arange(0, len(records), size, dtype=np.uint64)
        heads = rows[:, :HEADER_BYTES]
    else:
        starts = []
        at = 0
        unpack_head = RECORD_HEAD.unpack_from
        while at + HEADER_BYTES <= len(records):
            starts.append(at)
            at += RECORD_HEAD.size + unpack_head(records, at)[1]
        if at != len(records):
            raise RecordingError(f"{where}: its messages do not fill it")
        offsets = np.array(starts, dtype=np.uint64)
        heads = sliding_window_view(data, HEADER_BYTES)[starts]
    block = heads.view(np.dtype(HEADER))[:, 0]
    lengths = np.diff(offsets, append=np.uint64(len(records))) - np.uint64(RECORD_HEAD.size)
    as_written = (
        (block["opcode"] == Opcode.MESSAGE)
        & (block["record_length"] == lengths)
        & (lengths >= HEADER_BYTES - RECORD_HEAD.size)
        & (block["channel_id"] == channel)
        & (block["sequence"] == 0)
        & (block["publish_time"] == block["log_time"])
    )
    if not as_written.all():
        at = int(offsets[np.argmin(as_written)])
        raise RecordingError(f"{where}: found a message at {at} that no recorder writes")
    return channel, block["log_time"], offsets


def check_constants(chunk: ReadChunk, message: schema.MessageType) -> None:
    """Check the bytes of messages of one size that are the same in each, such as tags.

    Raises:
        RecordingError: other readers would find other values there.
    """
    dtype = record_dtype(message)
    if dtype is not None and len(chunk.records) == len(chunk.times) * dtype.itemsize:
        blank, is_constant = constant_bytes(chunk.topic, message)
        rows = np.frombuffer(chunk.records, np.uint8).reshape(-1, dtype.itemsize)
        if (rows[:, is_constant] != blank[is_constant]).any():
            raise RecordingError(f"chunk at {chunk.offset}: found tags that no recorder writes")


# --- all records --------------------------------------------------------------------------------------


def read_record(raw: RawRecord) -> Record | RawRecord:
    """Return a record with its whole body read and checked; it comes back as it is if it is of another kind.

    Raises:
        RecordingError: it is damaged, or no recorder writes it.
    """
    try:
        if raw.kind == Opcode.CHUNK:
            where = f"chunk at {raw.offset}"
            head, records = unpack_chunk(raw.body, where)
            channel, times, offsets = checked_messages(records, where)
            size, span = head.uncompressed_size, (head.start_time, head.end_time)
            entry = ChunkEntry(*raw.place, size, *span, channel, head.compression.encode(), len(times))
            return ReadChunk(raw.body, entry, records, times, offsets)
        if raw.kind == Opcode.ATTACHMENT:
            return attachment_of(raw.body, raw.offset)
        return metadata_of(raw.body) if raw.kind == Opcode.METADATA else raw
    except UNREADABLE as error:
        raise RecordingError(f"the record at {raw.offset} cannot be read") from error


def attachment_of(body: bytes, offset: int) -> AttachmentRecord:
    """Return the attachment in a record.

    Raises:
        RecordingError: its checksum does not match, or it has times, which no recorder writes.
    """
    stream = ReadDataStream(BytesIO(body))
    times = stream.read8(), stream.read8()
    name, media_type = stream.read_prefixed_string(), stream.read_prefixed_string()
    size = stream.read8()
    data = body[stream.count : -4]
    if len(data) != size or times != (0, 0) or crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
        raise RecordingError(f"attachment at {offset}: its content does not match its checksum")
    return AttachmentRecord(name, media_type, data)


def bytes_of(*records: McapRecord) -> bytes:
    """Return records as they are in a file."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())


def metadata_of(body: bytes) -> MetadataRecord:
    """Return the metadata in a record.

    Raises:
        RecordingError: it is larger than `MAX_METADATA_BYTES`.
    """
    if len(body) > MAX_METADATA_BYTES:
        raise RecordingError(f"metadata of {len(body):,} bytes, expected {MAX_METADATA_BYTES:,} at most")
    record = Metadata.read(ReadDataStream(BytesIO(body)))
    return MetadataRecord(record.name, dict(record.metadata))


def asks_for_indexes(config: dict[str, str]) -> bool:
    """Return whether a recording's configuration asks for message indexes.

    Raises:
        RecordingError: the entries do not say.
    """
    try:
        return bool(json.loads(config["json"])["recording"]["index"] == "message")
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise RecordingError("the configuration does not say what it was recorded with") from error
