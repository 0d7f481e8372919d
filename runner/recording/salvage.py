"""The good records of a damaged file: read while they follow one another, then searched for.

The file is read in pieces, never mapped: a disk that fails while it is read causes an error, not a signal.
Data that looks like a chunk and is none costs work, which is bounded.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from runner.errors import RecordingError
from runner.recording.blocks import RECORD_HEAD
from runner.recording.chunks import MAX_CHUNK_BYTES, chunk_head
from runner.recording.records import IN_DATA, UNREADABLE, Report, attachment_of, metadata_of, read_chunk

_LIKE_A_CHUNK: Final = re.compile(
    rb"\x06(?=.{3}[\0-\x04]\0{4}"  # its length
    rb".{16}.{3}[\0-\x04]\0{4}"  # its times and its unpacked size
    rb".{4}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd))",  # its checksum and compression
    re.DOTALL,
)
_LIKE_BYTES: Final = 64
_PIECE: Final = 4 << 20
_MAX_WASTED_RATIO: Final = 4
"""How many times the file's size may be unpacked of what only looks like chunks."""
_ALWAYS_WASTED: Final = 256 << 20
"""Bytes of this kind that are unpacked of a file of any size."""


class DamagedFile:
    """A file of which any part may be damaged."""

    def __init__(self, stream: BinaryIO, path: Path) -> None:
        self._stream = stream
        self._path = path
        self.size = stream.seek(0, 2)
        self._allowance = self.size * _MAX_WASTED_RATIO + _ALWAYS_WASTED
        self.lost_bytes = 0
        """Bytes that belong to no good record, as far as the file was read."""
        self.torn_chunk: bytes | None = None
        """The beginning of a chunk that was cut off at the end of the file, after its head."""
        if not self.size:
            raise RecordingError(f"{path}: found an empty file, expected a recording.")
        if (magic := self._read(0, len(MCAP0_MAGIC))) != MCAP0_MAGIC:
            raise RecordingError(f"{path}: found {magic!r} at its start, expected an MCAP file.")

    def good_records(self, report: Report = lambda *_: None) -> Iterator[tuple[int, int, bytes]]:
        """Yield (opcode, offset, body) of the readable records, skipping all others."""
        offset = len(MCAP0_MAGIC)
        while offset + RECORD_HEAD.size <= self.size:
            report(offset, self.size)
            opcode, length = RECORD_HEAD.unpack(self._read(offset, RECORD_HEAD.size))
            if (opcode, length) == (Opcode.DATA_END, 4):
                return
            body = self._good_body(opcode, length, offset)
            if body is not None:
                yield opcode, offset, body
                offset += RECORD_HEAD.size + length
                continue
            found = self._next_chunk(offset + 1)
            if opcode == Opcode.CHUNK and found == self.size:
                self.torn_chunk = self._read(offset + RECORD_HEAD.size, _LIKE_BYTES)
            self.lost_bytes += found - offset
            offset = found
        self.lost_bytes += max(self.size - offset, 0)

    def _good_body(self, opcode: int, length: int, offset: int) -> bytes | None:
        """Return the body of the record at an offset; None if it is damaged."""
        start = offset + RECORD_HEAD.size
        if opcode not in IN_DATA or length > min(self.size - start, MAX_CHUNK_BYTES):
            return None
        try:
            if opcode == Opcode.CHUNK:
                chunk_head(self._read(start, min(length, _LIKE_BYTES)), length, "")
            body = self._read(start, length)
            if opcode == Opcode.CHUNK:
                read_chunk(body, offset)
            elif opcode == Opcode.ATTACHMENT:
                attachment_of(body, offset)
            elif opcode == Opcode.METADATA:
                metadata_of(body)
        except (RecordingError, *UNREADABLE):
            self._allowance -= length
            if self._allowance < 0:
                raise RecordingError(
                    f"{self._path}: too much of it only looks like chunks, last at {offset}: "
                    "it was made to exhaust its readers."
                ) from None
            return None
        return body

    def _next_chunk(self, offset: int) -> int:
        """Return the offset of the next good chunk, or the end of the file."""
        while offset < self.size:
            piece = self._read(offset, _PIECE + _LIKE_BYTES)
            for like in _LIKE_A_CHUNK.finditer(piece, 0, len(piece)):
                at = offset + like.start()
                _, length = RECORD_HEAD.unpack_from(piece, like.start())
                if like.start() < _PIECE and self._good_body(Opcode.CHUNK, length, at) is not None:
                    return at
            offset += _PIECE
        return self.size

    def _read(self, offset: int, length: int) -> bytes:
        try:
            self._stream.seek(offset)
            return self._stream.read(length)
        except OSError as error:
            raise RecordingError(f"{self._path}: cannot be read at {offset} ({error.strerror}).") from error
