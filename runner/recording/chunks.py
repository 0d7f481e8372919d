"""A chunk of one topic: whole message records in, the bytes of an MCAP chunk and its index out, and back.

Encoding has no side effects and releases the interpreter lock for checksum and compression, so that several
threads can encode while another one learns.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from isal.isal_zlib import crc32
from mcap.opcode import Opcode

from runner.errors import RecordingError
from runner.recording.blocks import MESSAGE_HEAD, RECORD_HEAD
from runner.recording.schema import ACTIONS, EXTRA, ROW_TOPICS, STEP, TOPIC_OF, Topic
from runner.util.arrays import Unsigned
from runner.util.codecs import CODECS, MAX_CHUNK_BYTES, MCAP_CODECS, UNPACK_ERRORS
from runner.util.packing import MAX_CHUNK_STEPS, Packing

_PLAIN_BYTES: Final = 4 << 20
"""Chunks of up to this size are unpacked without checking their first message."""
CHUNK_HEAD: Final = struct.Struct("<QQQII")
"""Start time, end time, size unpacked, its CRC, and the length of the name of the compression."""
_MOSTLY_ZEROS: Final = 16
"""Blocks of actions that become this many times smaller are discrete: nearly all of their columns are 0."""
_DATA_LENGTH: Final = struct.Struct("<Q")
_MAX_NAME_BYTES: Final = max(map(len, MCAP_CODECS))

Packed = Callable[[str, bytes | memoryview], bytes | memoryview | None]
"""Returns records packed with a compression, if they were packed before."""


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
    """An encoded chunk: its MCAP records, and its entry without its place and that of its index."""

    record: bytes
    index: bytes
    entry: ChunkEntry


def encode_chunk(
    topic: Topic,
    records: bytes | memoryview,
    log_times: Unsigned,
    offsets: Unsigned,
    packing: Packing,
    packed: Packed | None = None,
) -> Chunk:
    """Return the chunk that holds these whole message records of one topic.

    Args:
        log_times: nanoseconds of each, ascending.
        offsets: where each begins in `records`.
        packed: may return the records packed; by default, and if it does not, they are packed here.
    """
    codec = CODECS[packing.compression]
    name = codec.mcap_name.encode()
    width = len(records) // len(log_times) if topic.message is STEP and packing.values else 0
    size, crc = len(records), crc32(records)
    data = (packed and packed(codec.mcap_name, records)) or codec.pack(records, packing.level, width)
    if topic.message is ACTIONS and len(data) * _MOSTLY_ZEROS < len(records):  # quick at any level
        data = codec.pack(records, max(codec.levels, default=0), width)
    start, end = int(log_times[0]), int(log_times[-1])
    head = CHUNK_HEAD.pack(start, end, size, crc, len(name)) + name
    head += _DATA_LENGTH.pack(len(data))
    record = b"".join((RECORD_HEAD.pack(Opcode.CHUNK, len(head) + len(data)), head, data))
    index = message_index(topic, log_times, offsets, packing.index == "message")
    entry = ChunkEntry(0, len(record), size, start, end, topic.channel, name, len(log_times))
    return Chunk(record, index, entry)


def message_index(topic: Topic, log_times: Unsigned, offsets: Unsigned, indexed: bool) -> bytes:
    """Return the MessageIndex record that follows a chunk, and names its channel.

    Args:
        indexed: whether it has an entry for each message, unless they are extras: it would be as large as
            they are.
    """
    count = len(log_times) if indexed and topic.message is not EXTRA else 0
    entries = np.empty((count, 2), dtype="<u8")
    entries[:, 0], entries[:, 1] = log_times[:count], offsets[:count]
    head = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + entries.nbytes, topic.channel, entries.nbytes)
    return b"".join((head, entries.data))


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
        at = CHUNK_HEAD.size + min(name_length, _MAX_NAME_BYTES)
        name = bytes(body[CHUNK_HEAD.size : at])
        (packed,) = _DATA_LENGTH.unpack_from(body, at)
        data_at = at + _DATA_LENGTH.size
    except struct.error as error:
        raise RecordingError(f"{where}: the record cannot be read") from error
    if name_length > _MAX_NAME_BYTES or name.decode("latin-1") not in MCAP_CODECS:
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
        _check_message_count(view, head, where)
    records = decompress(view[head.data_at :], head.compression, head.uncompressed_size, where)
    if crc32(records) != head.crc:
        raise RecordingError(f"{where}: its content does not match its checksum")
    return head, records


def _check_message_count(body: memoryview, head: ChunkHead, where: str) -> None:
    """Check that a chunk can hold no more messages than a recorder writes, by its first message alone.

    A few kilobytes can unpack to the largest chunk there is; thousands of them would keep a reader busy for
    minutes before their messages were found to make no sense.

    Raises:
        RecordingError: it declares more, or holds no message.
    """
    length, channel = _first_message(body, head, where)
    messages = head.uncompressed_size // (RECORD_HEAD.size + length)
    topic = TOPIC_OF.get(channel)
    is_row = topic in ROW_TOPICS or (topic is not None and topic.message is EXTRA)
    if is_row and messages > MAX_CHUNK_STEPS:
        raise RecordingError(f"{where}: declares {messages:,} messages, expected {MAX_CHUNK_STEPS:,} at most")


def first_channel(body: bytes | memoryview, where: str) -> int:
    """Return the channel of a chunk's first message; only that is unpacked."""
    view = memoryview(body)
    _, channel = _first_message(view, chunk_head(view, len(view), where), where)
    return channel


def _first_message(body: memoryview, head: ChunkHead, where: str) -> tuple[int, int]:
    """Return the record length and the channel of a chunk's first message."""
    beginning, _ = _unpack(body[head.data_at :], head.compression, MESSAGE_HEAD.size, where)
    if len(beginning) < MESSAGE_HEAD.size:
        raise RecordingError(f"{where}: holds no whole message")
    _, length, channel, *_ = MESSAGE_HEAD.unpack_from(beginning)
    return length, channel


def decompress(data: bytes | memoryview, compression: str, size: int, where: str) -> bytes:
    """Return the `size` bytes that a chunk's data hold; never allocates more than that.

    Raises:
        RecordingError: the data do not give exactly that many bytes, or it is more than any chunk has;
            `where` is named.
    """
    if size > MAX_CHUNK_BYTES:
        raise RecordingError(f"{where}: declares {size:,} bytes, expected at most {MAX_CHUNK_BYTES:,}")
    records, more = _unpack(data, compression, size, where)
    if len(records) != size or more:
        raise RecordingError(f"{where}: found a chunk of another size than the {size} bytes it declares")
    return records


def _unpack(data: bytes | memoryview, compression: str, size: int, where: str) -> tuple[bytes, bool]:
    """Return the first `size` bytes, or all if there are fewer, and whether there are more."""
    try:
        return MCAP_CODECS[compression].unpack(data, size)
    except UNPACK_ERRORS as error:
        raise RecordingError(f"{where}: the chunk cannot be decompressed ({error})") from error
