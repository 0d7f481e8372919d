"""The good records of a damaged file: walked as long as they follow one another, then searched for.

The file is read in pieces, never mapped: a disk that fails while it is read ends in an error, not in a
signal. What looks like a chunk and is none costs work; how much of that is done is bounded.
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
from runner.recording.index import IN_DATA
from runner.recording.scan import UNREADABLE, Report, attachment_of, metadata_of, read_chunk

_LIKE_A_CHUNK: Final = re.compile(
    rb"\x06(?=.{3}[\0-\x04]\0{4}"  # its length
    rb".{16}.{3}[\0-\x04]\0{4}"  # its times and its size unpacked
    rb".{4}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd))",  # its checksum and compression
    re.DOTALL,
)
_LIKE_BYTES: Final = 64
_PIECE: Final = 4 << 20
_IN_VAIN: Final = 4
"""So many times the file's size, what looks like chunks may be unpacked in vain."""
_IN_VAIN_ANYWAY: Final = 256 << 20


class DamagedFile:
    """A file of which any part may be damaged.

    Args:
        stream: it, open for reading.
        path: its path, for errors.

    Raises:
        RecordingError: it is empty, does not begin as a recording does, or cannot be read.
    """

    def __init__(self, stream: BinaryIO, path: Path) -> None:
        self._stream = stream
        self._path = path
        self.size = stream.seek(0, 2)
        self._allowance = self.size * _IN_VAIN + _IN_VAIN_ANYWAY
        self.lost_bytes = 0
        """Bytes that belong to no good record, of what was walked."""
        self.torn_chunk: bytes | None = None
        """The beginning of a chunk that was cut off at the end, behind its head."""
        if not self.size:
            raise RecordingError(f"{path}: found an empty file, expected a recording.")
        if (magic := self._read(0, len(MCAP0_MAGIC))) != MCAP0_MAGIC:
            raise RecordingError(f"{path}: found {magic!r} at its start, expected an MCAP file.")

    def good_records(self, report: Report = lambda *_: None) -> Iterator[tuple[int, int, bytes]]:
        """Yield (opcode, offset, body) of the records that can be read, past those that cannot.

        Args:
            report: called with the bytes that were read, and those of the file.

        Raises:
            RecordingError: too much looks like chunks and is none.
        """
        offset = len(MCAP0_MAGIC)
        while offset + 9 <= self.size:
            report(offset, self.size)
            opcode, length = RECORD_HEAD.unpack(self._read(offset, 9))
            if (opcode, length) == (Opcode.DATA_END, 4):
                return
            body = self._good_body(opcode, length, offset)
            if body is None:
                offset = self._skip(opcode, offset)
                continue
            yield opcode, offset, body
            offset += 9 + length
        self.lost_bytes += max(self.size - offset, 0)

    def _skip(self, opcode: int, offset: int) -> int:
        """Return where the next good chunk begins, and note what lies between as lost."""
        found = self._next_chunk(offset + 1)
        if opcode == Opcode.CHUNK and found == self.size:
            self.torn_chunk = self._read(offset + 9, _LIKE_BYTES)
        self.lost_bytes += found - offset
        return found

    def _good_body(self, opcode: int, length: int, offset: int) -> bytes | None:
        """Return the body of the record here if it is whole and sound."""
        if opcode not in IN_DATA or length > min(self.size - offset - 9, MAX_CHUNK_BYTES):
            return None
        try:
            if opcode == Opcode.CHUNK:
                chunk_head(self._read(offset + 9, min(length, _LIKE_BYTES)), length, "")
            body = self._read(offset + 9, length)
            if opcode == Opcode.CHUNK:
                read_chunk(body, offset)
            elif opcode == Opcode.ATTACHMENT:
                attachment_of(body, offset)
            elif opcode == Opcode.METADATA:
                metadata_of(body)
        except (RecordingError, *UNREADABLE):
            self._spend(length, offset)
            return None
        return body

    def _spend(self, length: int, offset: int) -> None:
        self._allowance -= length
        if self._allowance < 0:
            raise RecordingError(
                f"{self._path}: too much of it looks like chunks and is none, at {offset} again: "
                "it was made to exhaust whoever reads it."
            )

    def _next_chunk(self, offset: int) -> int:
        """Return where the next good chunk begins, or the end of the file."""
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
