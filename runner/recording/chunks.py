"""A chunk of one topic: whole message records in, the bytes of an MCAP chunk and its index out, and back.

Encoding has no side effects and releases the interpreter lock for checksum and compression, so that several
threads can encode while another one learns.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Final, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from isal.isal_zlib import crc32
from mcap.opcode import Opcode

from runner.errors import RecordingError
from runner.recording.blocks import MESSAGE_HEAD, RECORD_HEAD
from runner.recording.schema import ACTIONS, EXTRA, ROW_TOPICS, STEP, TOPIC_OF, Topic
from runner.util.arrays import Unsigned
from runner.util.packing import MAX_CHUNK_STEPS, MAX_LEVEL, Packing

MAX_CHUNK_BYTES: Final = 64 << 20
"""The largest chunk that is read, packed or unpacked; the recorder's are below 17 MB."""
_PLAIN_BYTES: Final = 4 << 20
"""Chunks of up to this size are unpacked without checking their first message."""
CHUNK_HEAD: Final = struct.Struct("<QQQII")
"""Start time, end time, size unpacked, its CRC, and the length of the name of the compression."""
_PICTURE_BYTES: Final = 1 << 13
"""Steps of more bytes have pictures in their observations, or are as rare."""
_MOSTLY_ZEROS: Final = 16
"""Blocks of actions that become this many times smaller are discrete: nearly all of their columns are 0."""
_MAX_QUICK_LEVEL: Final = 4
"""At higher levels a compressor takes megabytes, and is not kept."""
_DATA_LENGTH: Final = struct.Struct("<Q")
_MAX_NAME_BYTES: Final = 4
"""The length of the longest name of a compression, `zstd`."""

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
    name = "" if packing.compression == "none" else packing.compression
    width = len(records) // len(log_times) if topic.message is STEP and packing.values else 0
    size, crc = len(records), crc32(records)
    data = (packed and packed(name, records)) or _compress(records, packing, width)
    if topic.message is ACTIONS and len(data) * _MOSTLY_ZEROS < len(records):  # quick at any level
        data = _compress(records, replace(packing, level=MAX_LEVEL), width)
    start, end = int(log_times[0]), int(log_times[-1])
    head = CHUNK_HEAD.pack(start, end, size, crc, len(name)) + name.encode()
    head += _DATA_LENGTH.pack(len(data))
    record = b"".join((RECORD_HEAD.pack(Opcode.CHUNK, len(head) + len(data)), head, data))
    index = message_index(topic, log_times, offsets, packing.index == "message")
    entry = ChunkEntry(0, len(record), size, start, end, topic.channel, name.encode(), len(log_times))
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


def _compress(records: bytes | memoryview, packing: Packing, width: int) -> bytes:
    if packing.compression == "zstd":
        parameters = _zstd_parameters(packing.level, bool(width), width > _PICTURE_BYTES)
        if packing.level > _MAX_QUICK_LEVEL:
            return zstandard.ZstdCompressor(compression_params=parameters).compress(records)
        return _compressor(parameters, threading.get_ident()).compress(records)
    if packing.compression == "lz4":
        return bytes(lz4.frame.compress(records))
    return bytes(records)


@lru_cache(8)
def _compressor(parameters: zstandard.ZstdCompressionParameters, _thread: int) -> zstandard.ZstdCompressor:
    """Return the compressor of a thread; making one takes longer than compressing a small chunk."""
    return zstandard.ZstdCompressor(compression_params=parameters)


@cache
def _zstd_parameters(level: int, has_arrays: bool, has_pictures: bool) -> zstandard.ZstdCompressionParameters:
    """Return the level's parameters; for the quick ones with tables that suit fixed-width records.

    The match is nearly always the record before: a table of 2**12 entries finds it, stays in the first-level
    cache, and costs little to clear for each chunk. Matches of 4 bytes are worth having; but among arrays of
    floats the quickest search finds as much. A stack of frames shares all but one with the record before,
    which a longer search finds: a quarter less, in a tenth of the time that an emulator takes for a step.
    """
    if level not in (3, _MAX_QUICK_LEVEL):
        return zstandard.ZstdCompressionParameters.from_level(level)
    tables = {"hash_log": 12, "chain_log": 12, "min_match": 4}
    if has_pictures:
        tables |= {"strategy": zstandard.STRATEGY_LAZY, "search_log": 3, "min_match": 7}
    elif has_arrays:
        tables |= {"strategy": zstandard.STRATEGY_FAST, "min_match": 5}
    return zstandard.ZstdCompressionParameters.from_level(level, **tables)


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
    if name_length > _MAX_NAME_BYTES or name not in (b"zstd", b"lz4", b""):
        raise RecordingError(f"{where}: found compression {name!r}, expected zstd, lz4 or none")
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
        if compression == "zstd":
            return _unpack_zstd(data, size)
        if compression == "lz4":
            with lz4.frame.LZ4FrameDecompressor() as stream:
                return stream.decompress(bytes(data), max_length=size), not stream.eof
        return bytes(data[:size]), len(data) > size
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError) as error:
        raise RecordingError(f"{where}: the chunk cannot be decompressed ({error})") from error


def _unpack_zstd(data: bytes | memoryview, size: int) -> tuple[bytes, bool]:
    """Unpack a zstd frame.

    One that declares its size is unpacked in one go: the size was compared first.
    """
    decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
    if zstandard.frame_content_size(data) == size:
        return decompressor.decompress(data), False
    with decompressor.stream_reader(data) as stream:
        return stream.read(size), bool(stream.read(1))
