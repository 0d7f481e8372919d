"""A chunk of one topic: whole message records in, the bytes of an MCAP chunk and its index out, and back.

Encoding is pure and releases the interpreter lock where it counts (checksum, compression), so that
several threads can do it beside the one that learns.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from functools import cache
from typing import Final

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording.schema import Topic

MAX_CHUNK_BYTES: Final = 64 << 20
"""The largest chunk that is read, packed or unpacked; the recorder's are below 16 MiB."""
_MAX_WINDOW: Final = 1 << 27


@dataclass(frozen=True)
class Packing:
    """How chunks are packed: `compression` is zstd, lz4 or none; `index` is message or chunk."""

    compression: str = "zstd"
    level: int = 3
    index: str = "message"


@dataclass(frozen=True)
class Chunk:
    """An encoded chunk: its MCAP records, and what the summary says of them."""

    record: bytes
    index: bytes
    compression: str
    compressed_size: int
    uncompressed_size: int
    start_time: int
    end_time: int
    messages: int


def encode_chunk(
    topic: Topic,
    records: bytes | memoryview,
    log_times: NDArray[np.uint64],
    offsets: NDArray[np.uint64],
    packing: Packing,
) -> Chunk:
    """Return the chunk that holds these whole message records of one topic.

    Args:
        topic: the topic all of them belong to.
        records: their bytes.
        log_times: nanoseconds of each, ascending.
        offsets: where each begins in `records`.
        packing: how to pack it.
    """
    name = "" if packing.compression == "none" else packing.compression
    data = _compress(records, packing)
    start, end, size = int(log_times[0]), int(log_times[-1]), len(records)
    encoded_name = name.encode()
    body = struct.pack(
        f"<QQQII{len(encoded_name)}sQ",
        start,
        end,
        size,
        zlib.crc32(records),
        len(encoded_name),
        encoded_name,
        len(data),
    )
    record = b"".join((struct.pack("<BQ", Opcode.CHUNK, len(body) + len(data)), body, data))
    index = message_index(topic.channel, log_times, offsets) if packing.index == "message" else b""
    return Chunk(record, index, name, len(data), size, start, end, len(log_times))


def message_index(channel: int, log_times: NDArray[np.uint64], offsets: NDArray[np.uint64]) -> bytes:
    """Return the MessageIndex record of one channel."""
    entries = np.empty((len(log_times), 2), dtype="<u8")
    entries[:, 0] = log_times
    entries[:, 1] = offsets
    return (
        struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + entries.nbytes, channel, entries.nbytes)
        + entries.tobytes()
    )


def _compress(records: bytes | memoryview, packing: Packing) -> bytes:
    if packing.compression == "zstd":
        return zstandard.ZstdCompressor(compression_params=_zstd_parameters(packing.level)).compress(records)
    if packing.compression == "lz4":
        return bytes(lz4.frame.compress(records))
    return bytes(records)


@cache
def _zstd_parameters(level: int) -> zstandard.ZstdCompressionParameters:
    """Return the level's parameters; for the quick ones with tables that suit fixed-width records.

    What matches is nearly always the record before: a table of 2**12 entries finds it, stays in the
    first-level cache, and is not cleared in vain for each chunk. Matches of 4 bytes are worth having.
    """
    if level in (3, 4):
        return zstandard.ZstdCompressionParameters.from_level(level, hash_log=12, chain_log=12, min_match=4)
    return zstandard.ZstdCompressionParameters.from_level(level)


def decompress(data: bytes | memoryview, compression: str, size: int, where: str) -> bytes:
    """Return the `size` bytes that a chunk's data hold; never allocates more than that.

    Raises:
        RecordingError: the data do not give exactly that many bytes, or it is more than any chunk has;
            `where` is named.
    """
    if size > MAX_CHUNK_BYTES:
        raise RecordingError(f"{where}: declares {size:,} bytes, expected at most {MAX_CHUNK_BYTES:,}")
    try:
        if compression == "zstd":
            records, more = _unpack_zstd(data, size)
        elif compression == "lz4":
            with lz4.frame.LZ4FrameDecompressor() as stream:
                records = stream.decompress(bytes(data), max_length=size)
                more = b"" if stream.eof else b"?"
        elif compression == "":
            records, more = bytes(data), b""
        else:
            raise RecordingError(f"{where}: found compression {compression!r}, expected zstd, lz4 or none")
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise RecordingError(f"{where}: the chunk cannot be decompressed ({error})") from error
    if len(records) != size or more:
        raise RecordingError(f"{where}: found a chunk of another size than the {size} bytes it declares")
    return records


def _unpack_zstd(data: bytes | memoryview, size: int) -> tuple[bytes, bytes]:
    """Return at most `size` unpacked bytes, and a byte if there are more.

    A frame that declares its size is unpacked in one go: the size was compared first.
    """
    declared = zstandard.frame_content_size(data)
    if declared == size:
        return zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW).decompress(data), b""
    with zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW).stream_reader(data) as stream:
        return stream.read(size), stream.read(1)
