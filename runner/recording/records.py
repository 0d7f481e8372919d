"""The records of a recording's data section, parsed within bounds: anyone may have written the file."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from io import BytesIO
from itertools import pairwise
from typing import BinaryIO, Final, NamedTuple

import numpy as np
from isal.isal_zlib import crc32
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, ChunkIndex, Metadata, MetadataIndex
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.blocks import HEADER, HEADER_BYTES, MESSAGE_HEAD, RECORD_HEAD
from runner.recording.chunks import (
    CHUNK_HEAD,
    MAX_CHUNK_BYTES,
    Chunk,
    ChunkSummary,
    chunk_head,
    has_message_index,
    message_index,
    unpack_chunk,
)

MAX_METADATA_BYTES: Final = 4 << 20
"""The largest metadata record that is read, config and provenance among them."""
MAX_NAMED: Final = 4096
"""The most attachments, and the most metadata records; a resume adds one."""
MAX_NAME_BYTES: Final = 256
MAX_UNPACKED_RATIO: Final = 1000
"""How many bytes a byte of the file may declare to hold; files with more are made to exhaust memory."""
_ALWAYS_UNPACKED: Final = 1 << 30
"""Bytes that a file of any size may declare to hold."""
UNREADABLE: Final = (struct.error, ValueError, KeyError, McapError)
"""What parsing damaged records raises."""
IN_DATA: Final = frozenset(
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
"""The kinds of records in the data section; after any other, nothing can be relied on."""
_CHUNK_TIMES: Final = struct.Struct("<QQ")

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


class ReadChunk(NamedTuple):
    """An undamaged chunk and its messages."""

    body: bytes
    """The body of the record, as it is in the file."""
    summary: ChunkSummary
    records: bytes
    """The message records."""
    times: NDArray[np.uint64]
    """Log times of the messages, in nanoseconds."""
    offsets: NDArray[np.uint64]
    """Where each message begins in `records`."""

    @property
    def offset(self) -> int:
        """Where the record is in the file."""
        return int(self.summary.index.chunk_start_offset)

    @property
    def topic(self) -> schema.Topic:
        """The topic of its messages."""
        return schema.TOPIC_OF[self.summary.channel]

    @property
    def messages(self) -> list[bytes]:
        """The message records one by one."""
        edges = pairwise([*self.offsets.tolist(), len(self.records)])
        return [self.records[start:stop] for start, stop in edges]


Record = MetadataRecord | AttachmentRecord | ReadChunk
"""A record that a copy of a recording takes over; the other kinds follow from these."""


@dataclass
class Contents:
    """The good records of a recording, up to `end`."""

    end: int = 0
    """Offset after the last good record that a resumed recording keeps."""
    size: int = 0
    """Bytes of the file."""
    reason: str = ""
    """Why the survey stopped before the end of the data section; empty if it did not."""
    chunks: list[ChunkSummary] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    channels: list[int] = field(default_factory=list)

    @property
    def topics(self) -> list[schema.Topic]:
        """The topics of its channels."""
        return [topic for topic in schema.ALL_TOPICS if topic.channel in self.channels]


def record_heads(stream: BinaryIO, size: int) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, offset, body length) of the whole records of a file; the stream is at the body."""
    offset = len(MCAP0_MAGIC)
    while offset + RECORD_HEAD.size <= size:
        stream.seek(offset)
        opcode, length = RECORD_HEAD.unpack(stream.read(RECORD_HEAD.size))
        if offset + RECORD_HEAD.size + length > size:
            return
        yield opcode, offset, length
        offset += RECORD_HEAD.size + length


def walk(stream: BinaryIO, size: int) -> Iterator[tuple[int, int, bytes]]:
    """Yield (opcode, offset, body) of the whole records of the data section and its end.

    Ends early at a record that is cut off or makes no sense.
    """
    for opcode, offset, length in record_heads(stream, size):
        if length > MAX_CHUNK_BYTES or not 1 <= opcode <= Opcode.DATA_END:
            return
        yield opcode, offset, stream.read(length)
        if opcode == Opcode.DATA_END:
            return


def declared_bytes(stream: BinaryIO, size: int, path: str) -> int:
    """Return how many bytes the chunks of a file declare to hold, up to a record that makes no sense."""
    declared = 0
    for opcode, _, length in record_heads(stream, size):
        if length > MAX_CHUNK_BYTES or opcode not in IN_DATA:
            break
        if opcode == Opcode.CHUNK:
            try:
                body = stream.read(min(length, CHUNK_HEAD.size + 16))
                declared += chunk_head(body, length, path).uncompressed_size
            except RecordingError:
                break
    return declared


def check_unpacked_size(size: int, unpacked: int, path: str) -> None:
    """Refuse chunks that declare far more bytes than those of any recording of the file's size.

    Raises:
        RecordingError: they do.
    """
    if unpacked > size * MAX_UNPACKED_RATIO + _ALWAYS_UNPACKED:
        raise RecordingError(f"{path}: {size:,} bytes declare to hold {unpacked:,}; made to exhaust memory.")


def read_chunk(body: bytes, offset: int) -> ReadChunk:
    """Return the chunk in a record, after comparing its checksum and looking at each of its messages."""
    where = f"chunk at {offset}"
    head, records = unpack_chunk(body, where)
    channel, times, offsets = _checked_messages(records, where)
    index = ChunkIndex(
        chunk_length=RECORD_HEAD.size + len(body),
        chunk_start_offset=offset,
        compression=head.compression,
        compressed_size=len(body) - head.data_at,
        message_end_time=head.end_time,
        message_index_length=0,
        message_index_offsets={},
        message_start_time=head.start_time,
        uncompressed_size=head.uncompressed_size,
    )
    return ReadChunk(body, ChunkSummary(index, channel, len(times)), records, times, offsets)


def _checked_messages(records: bytes, where: str) -> tuple[int, NDArray[np.uint64], NDArray[np.uint64]]:
    """Return channel, times and offsets of a chunk's messages."""
    if len(records) < HEADER_BYTES:
        raise RecordingError(f"{where}: holds no whole message")
    _, length, channel, *_ = MESSAGE_HEAD.unpack_from(records)
    if channel not in schema.TOPIC_OF:
        raise RecordingError(f"{where}: found messages of channel {channel}, which no recording has")
    size = RECORD_HEAD.size + length
    if schema.TOPIC_OF[channel] in schema.UNIFORM_TOPICS:
        if size < HEADER_BYTES or len(records) % size:
            raise RecordingError(f"{where}: its messages differ in size")
        block = np.frombuffer(records, np.dtype([*HEADER, ("data", "u1", (size - HEADER_BYTES,))]))
        offsets = np.arange(len(block), dtype=np.uint64) * np.uint64(size)
        lengths: int | NDArray[np.uint64] = length
    else:
        starts, at = [], 0
        while at + HEADER_BYTES <= len(records):
            starts.append(at)
            at += RECORD_HEAD.size + max(
                RECORD_HEAD.unpack_from(records, at)[1], HEADER_BYTES - RECORD_HEAD.size
            )
        if at != len(records):
            raise RecordingError(f"{where}: its messages do not fill it")
        heads = b"".join(records[start : start + HEADER_BYTES] for start in starts)
        block = np.frombuffer(heads, np.dtype(HEADER))
        offsets = np.array(starts, dtype=np.uint64)
        lengths = np.diff(offsets, append=np.uint64(len(records))) - np.uint64(RECORD_HEAD.size)
    as_written = (
        (block["opcode"] == Opcode.MESSAGE)
        & (block["record_length"] == lengths)
        & (block["channel_id"] == channel)
        & (block["sequence"] == 0)
        & (block["publish_time"] == block["log_time"])
    )
    if not as_written.all():
        at = int(offsets[np.argmin(as_written)])
        raise RecordingError(f"{where}: found a message at {at} that no recorder writes")
    return channel, block["log_time"], offsets


def read_record(opcode: int, offset: int, body: bytes) -> Record | None:
    """Return the record with this body; None if it is of another kind.

    Raises:
        RecordingError: it is damaged, or no recorder writes it.
    """
    if opcode == Opcode.CHUNK:
        return read_chunk(body, offset)
    if opcode == Opcode.ATTACHMENT:
        return attachment_of(body, offset)
    return metadata_of(body) if opcode == Opcode.METADATA else None


def copied_chunk(chunk: ReadChunk, indexed: bool) -> Chunk:
    """Return a chunk to be written as it was read, with its times and its message index made again.

    Args:
        indexed: whether the recording has message indexes.
    """
    summary, start, end = chunk.summary, int(chunk.times[0]), int(chunk.times[-1])
    body = _CHUNK_TIMES.pack(start, end) + chunk.body[_CHUNK_TIMES.size :]  # no checksum covers them
    indexed = has_message_index(chunk.topic, indexed)
    index = message_index(summary.channel, chunk.times, chunk.offsets) if indexed else b""
    entry = replace(summary.index, message_start_time=start, message_end_time=end)
    return Chunk(RECORD_HEAD.pack(Opcode.CHUNK, len(body)) + body, index, replace(summary, index=entry))


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
