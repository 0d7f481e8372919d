"""How the chunks of a recording are packed: options and codecs. A new codec is a row of `CODECS`."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Final, Literal

import lz4.frame
import zstandard

MAX_CHUNK_BYTES: Final = 64 << 20
"""The largest chunk that is read, packed or unpacked; the recorder's are below 17 MB."""
UNPACK_ERRORS: Final = (zstandard.ZstdError, RuntimeError, EOFError, ValueError)
"""What the codecs raise for data that they did not pack."""
_PICTURE_BYTES: Final = 1 << 13
"""Steps of more bytes have pictures in their observations, or are as rare."""
_MAX_QUICK_LEVEL: Final = 4
"""At higher levels a compressor takes megabytes, and is not kept."""


@dataclass(frozen=True)
class Codec:
    """A compression of chunks."""

    mcap_name: str
    """Its name in MCAP; empty for chunks that are not compressed."""
    pack: Callable[[bytes | memoryview, int, int], bytes]
    """Compresses records at a level. The last argument is the size of a step in bytes if it holds values of
    spaces, such as arrays, else 0."""
    unpack: Callable[[bytes | memoryview, int], tuple[bytes, bool]]
    """Returns the first bytes, up to a number, and whether there are more. Allocates no more than that, and
    raises one of `UNPACK_ERRORS` for other data."""
    bytes_per_step: int
    """Measured bytes of a step of a job, without the message index."""
    levels: range = range(0)
    default_level: int | None = None


def _zstd_pack(records: bytes | memoryview, level: int, step_bytes: int) -> bytes:
    parameters = _zstd_parameters(level, bool(step_bytes), step_bytes > _PICTURE_BYTES)
    if level > _MAX_QUICK_LEVEL:
        return zstandard.ZstdCompressor(compression_params=parameters).compress(records)
    return _zstd_compressor(parameters, threading.get_ident()).compress(records)


@lru_cache(8)
def _zstd_compressor(
    parameters: zstandard.ZstdCompressionParameters, _thread: int
) -> zstandard.ZstdCompressor:
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


def _zstd_unpack(data: bytes | memoryview, size: int) -> tuple[bytes, bool]:
    decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
    if zstandard.frame_content_size(data) == size:  # in one go: the caller has compared the size
        return decompressor.decompress(data), False
    with decompressor.stream_reader(data) as stream:
        return stream.read(size), bool(stream.read(1))


def _lz4_pack(records: bytes | memoryview, _level: int, _step_bytes: int) -> bytes:
    return bytes(lz4.frame.compress(records))


def _lz4_unpack(data: bytes | memoryview, size: int) -> tuple[bytes, bool]:
    with lz4.frame.LZ4FrameDecompressor() as stream:
        return stream.decompress(bytes(data), max_length=size), not stream.eof


def _plain_pack(records: bytes | memoryview, _level: int, _step_bytes: int) -> bytes:
    return bytes(records)


def _plain_unpack(data: bytes | memoryview, size: int) -> tuple[bytes, bool]:
    return bytes(data[:size]), len(data) > size


Compression = Literal["zstd", "lz4", "none"]
CODECS: Final[dict[Compression, Codec]] = {
    "zstd": Codec("zstd", _zstd_pack, _zstd_unpack, 15, range(-7, 20), 3),
    "lz4": Codec("lz4", _lz4_pack, _lz4_unpack, 30),
    "none": Codec("", _plain_pack, _plain_unpack, 100),
}
MCAP_CODECS: Final = {codec.mcap_name: codec for codec in CODECS.values()}


Index = Literal["message", "chunk"]
MIN_CHUNK_STEPS: Final = 256
MAX_CHUNK_STEPS: Final = 1 << 16


@dataclass(frozen=True)
class Packing:
    """How a recording is packed."""

    compression: Compression = "zstd"
    level: int = CODECS["zstd"].default_level or 0
    """The level of the compression; codecs without levels ignore it."""
    index: Index = "message"
    """Whether each message is indexed, or only each chunk."""
    chunk_steps: int = 1 << 14
    """The most steps in a chunk."""
    values: bool = False
    """Whether steps hold values of spaces, such as arrays of floats, and not the numbers of states."""
