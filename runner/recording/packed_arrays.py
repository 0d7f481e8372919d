"""An environment's arrays as compressed `.npy` files in a recording, which anyone may have written."""

from __future__ import annotations

import math
import re
from io import BytesIO
from typing import Final

import numpy as np
import zstandard

from runner.environments.mdp import MAX_ARRAYS_BYTES
from runner.errors import RecordingError
from runner.util.arrays import Array

_MAX_WINDOW: Final = 1 << 27
"""The most memory that zstd may take for its window."""
_PREFIX: Final = b"\x93NUMPY\x01\x00"
"""Magic and version, before the length of the header in two bytes."""
_MAX_HEADER_BYTES: Final = 1024
_HEADER: Final = re.compile(
    rb"\{'descr': '([<|][biuf][1248])', 'fortran_order': (False|True), "
    rb"'shape': \(((?:\d{1,10}, ?){0,7}(?:\d{1,10})?)\), \} *\n"
)


def pack_array(array: Array) -> bytes:
    """Return an array as a `.npy` file, compressed with zstd."""
    buffer = BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return zstandard.ZstdCompressor(level=9).compress(buffer.getvalue())


def unpack_array(data: bytes, max_bytes: int, where: str) -> Array:
    """Return the array in a compressed `.npy` file; never unpickles or takes more memory than it declares.

    Raises:
        RecordingError: it holds no array, or one of more than `max_bytes`.
    """
    try:
        with zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW).stream_reader(data) as stream:
            return _read_array(stream, max_bytes, where)
    except (zstandard.ZstdError, ValueError, TypeError) as error:
        raise RecordingError(f"{where}: holds no array ({error}).") from error


def _read_array(stream: zstandard.ZstdDecompressionReader, max_bytes: int, where: str) -> Array:
    """Return the array in a `.npy` file of version 1.0, whose header is text in a fixed form.

    NumPy's own reader parses the header as Python, which a hostile one makes fail in many ways.
    """
    prefix = stream.read(len(_PREFIX))
    length = int.from_bytes(stream.read(2), "little")
    header = _HEADER.fullmatch(stream.read(min(length, _MAX_HEADER_BYTES)))
    if prefix != _PREFIX or header is None:
        raise RecordingError(f"{where}: found no `.npy` file of numbers, version 1.0.")
    dtype = np.dtype(header[1].decode())
    shape = tuple(int(n) for n in header[3].split(b",") if n.strip())
    size = math.prod(shape) * dtype.itemsize
    if size > max_bytes:
        raise RecordingError(
            f"{where}: found an array of {size:,} bytes, expected {max_bytes:,} at most: the arrays of an "
            f"environment may take {MAX_ARRAYS_BYTES:,}."
        )
    flat = np.empty(math.prod(shape), dtype)
    target = flat.view(np.uint8).data
    filled = 0
    while filled < size and (more := stream.readinto(target[filled:])):
        filled += more
    if filled != size or stream.read(1):
        raise RecordingError(f"{where}: found an array of another size than the {size} bytes it declares.")
    return flat.reshape(shape, order="F" if header[2] == b"True" else "C")
