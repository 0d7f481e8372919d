"""The sizes that a Parquet file's pages declare, read before anything is unpacked.

The footer does not tell them, and a library that unpacks a page takes as much memory as the page says.
Pages stand one behind the other in a column chunk; each begins with a struct in Thrift's compact protocol
whose fields 1 to 3 are the page's kind, its bytes unpacked and its bytes in the file
(https://github.com/apache/parquet-format/blob/master/src/main/thrift/parquet.thrift).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO, Final

import pyarrow.parquet as pq

from runner.errors import RecordingError
from runner.util.files import open_regular

_MAX_HEADER_BYTES: Final = 1 << 15
_MAX_DEPTH: Final = 8
_STOP, _TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _STRUCT = 0, 1, 2, 3, 7, 8, 9, 10, 12
_INTEGERS: Final = (4, 5, 6)
_UNPACKED, _PACKED = 2, 3


def largest_page(path: Path, about: pq.FileMetaData) -> int:
    """Return the most bytes that a page of a Parquet file declares to hold; 0 if it has none.

    Raises:
        RecordingError: the pages do not fill their column chunks.
    """
    largest = 0
    with open_regular(path) as stream:
        for k in range(about.num_row_groups):
            group = about.row_group(k)
            for i in range(group.num_columns):
                largest = max(largest, _largest_of(stream, group.column(i), path))
    return largest


def _largest_of(stream: BinaryIO, chunk: Any, path: Path) -> int:
    """Return the same of one column chunk."""
    at = chunk.data_page_offset
    if chunk.has_dictionary_page and chunk.dictionary_page_offset is not None:
        at = min(at, chunk.dictionary_page_offset)
    end, largest = at + chunk.total_compressed_size, 0
    while at < end:
        stream.seek(at)
        header = _Header(stream.read(_MAX_HEADER_BYTES))
        try:
            sizes = header.sizes()
            unpacked, packed = sizes[_UNPACKED], sizes[_PACKED]
        except (IndexError, KeyError, ValueError) as error:
            raise RecordingError(f"{path}: found no page of a Parquet file at {at}.") from error
        if packed < 0 or unpacked < 0 or at + header.at + packed > end:
            raise RecordingError(
                f"{path}: the page at {at} does not fit its column of {chunk.path_in_schema}."
            )
        largest = max(largest, unpacked)
        at += header.at + packed
    return largest


class _Header:
    """The header of a page; `at` is how far it was read."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.at = 0

    def sizes(self) -> dict[int, int]:
        """Return the integers of the header by their field; the rest is passed over."""
        return self._struct(0)

    def _struct(self, depth: int) -> dict[int, int]:
        if depth > _MAX_DEPTH:
            raise ValueError("nested too deeply")
        integers, field = {}, 0
        while (head := self._byte()) != _STOP:
            kind, step = head & 15, head >> 4
            field = field + step if step else self._integer()
            if kind in _INTEGERS:
                integers[field] = self._integer()
            else:
                self._pass(kind, depth)
        return integers

    def _pass(self, kind: int, depth: int, in_list: bool = False) -> None:
        if kind in _INTEGERS:
            self._integer()
        elif kind == _BINARY:
            self._skip(self._varint())
        elif kind == _STRUCT:
            self._struct(depth + 1)
        elif kind in (_BYTE, _DOUBLE):
            self._skip(1 if kind == _BYTE else 8)
        elif kind in (_LIST, _SET):
            self._pass_list(depth + 1)
        elif kind not in (_TRUE, _FALSE):
            raise ValueError(f"kind {kind}")
        elif in_list:
            self._skip(1)

    def _pass_list(self, depth: int) -> None:
        head = self._byte()
        count = head >> 4 if head >> 4 != 15 else self._varint()
        if depth > _MAX_DEPTH or count > _MAX_HEADER_BYTES:
            raise ValueError("too much")
        for _ in range(count):
            self._pass(head & 15, depth, in_list=True)

    def _byte(self) -> int:
        value = self._data[self.at]
        self.at += 1
        return value

    def _skip(self, n: int) -> None:
        self.at += n
        if self.at > len(self._data):
            raise ValueError("cut off")

    def _varint(self) -> int:
        value = shift = 0
        while True:
            byte = self._byte()
            value |= (byte & 127) << shift
            if byte < 128:
                return value
            shift += 7
            if shift > 63:
                raise ValueError("a number too long")

    def _integer(self) -> int:
        value = self._varint()
        return (value >> 1) ^ -(value & 1)
