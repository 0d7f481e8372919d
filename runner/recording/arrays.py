"""The arrays of an environment as attachments: `.npy` files, compressed with zstd."""

from __future__ import annotations

import math
import re
from io import BytesIO
from typing import Any, Final

import numpy as np
import zstandard
from numpy.typing import NDArray

from runner.environments.mdp import MAX_ARRAYS_BYTES
from runner.errors import RecordingError

_MAX_WINDOW: Final = 1 << 27
_HEAD_BYTES: Final = 1024
_HEAD: Final = re.compile(
    rb"\{'descr': '([<|][biuf][1248])', 'fortran_order': (False|True), "
    rb"'shape': \(((?:\d{1,10}, ?){0,7}(?:\d{1,10})?)\), \} *\n"
)


def pack_array(array: NDArray[Any]) -> bytes:
    """Return an array as a `.npy` file, compressed with zstd."""
    buffer = BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return zstandard.ZstdCompressor(level=9).compress(buffer.getvalue())


def unpack_array(data: bytes, most: int, where: str) -> NDArray[Any]:
    """Return the array in a compressed `.npy` file; never unpickles, never takes more memory than it says.

    Args:
        data: the compressed file.
        most: the most bytes that the array may have.
        where: named in errors.

    Raises:
        RecordingError: it holds no array, or a larger one.
    """
    try:
        with zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW).stream_reader(data) as stream:
            return _read_array(stream, most, where)
    except (zstandard.ZstdError, ValueError, TypeError) as error:
        raise RecordingError(f"{where}: holds no array ({error}).") from error


def _read_array(stream: Any, most: int, where: str) -> NDArray[Any]:
    """Return the array in a `.npy` file of version 1.0; its head is text in a fixed form."""
    beginning = stream.read(10)
    length = int.from_bytes(beginning[8:], "little")
    head = _HEAD.fullmatch(stream.read(min(length, _HEAD_BYTES)))
    if beginning[:8] != b"\x93NUMPY\x01\x00" or head is None:
        raise RecordingError(f"{where}: found no `.npy` file of numbers, version 1.0.")
    dtype, shape = np.dtype(head[1].decode()), tuple(int(n) for n in head[3].split(b",") if n.strip())
    size = math.prod(shape) * dtype.itemsize
    if size > most:
        raise RecordingError(
            f"{where}: found an array of {size:,} bytes, expected {most:,} at most: the arrays of an "
            f"environment may take {MAX_ARRAYS_BYTES:,}."
        )
    flat = np.empty(math.prod(shape), dtype)
    into, filled = flat.view(np.uint8).data, 0
    while filled < size and (more := stream.readinto(into[filled:])):
        filled += more
    if filled != size or stream.read(1):
        raise RecordingError(f"{where}: found an array of another size than the {size} bytes it declares.")
    return flat.reshape(shape, order="F" if head[2] == b"True" else "C")
