"""The records of an open recording: read, unpacked, compared with their checksums; the last few are kept.

Reading is safe from several threads, so the chunks that come next are unpacked beside the one in use.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from typing import BinaryIO, Final

from runner.errors import RecordingError
from runner.recording.chunks import MAX_CHUNK_BYTES, first_channel, unpack_chunk
from runner.recording.index import ChunkEntry

_BYTES_KEPT: Final = 16 << 20
_THREADS: Final = 2
_AHEAD: Final = 4
"""So many chunks are unpacked ahead of the one in use, if they are small."""
_SMALL: Final = 8 << 20
_OPCODE: Final = 6


class RecordStore:
    """Gives the bytes of records by their place.

    Args:
        stream: the file; closed with the store.
        path: its path, for errors.
    """

    def __init__(self, stream: BinaryIO, path: str) -> None:
        self._stream = stream
        self._path = path
        self._lock = threading.Lock()
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        self._bytes_kept = 0

    def close(self) -> None:
        """Close the file."""
        if "_threads" in self.__dict__:
            self._threads.shutdown(cancel_futures=True)
        self._stream.close()

    def record(self, offset: int, length: int, most: int = MAX_CHUNK_BYTES) -> bytes:
        """Return the bytes of a record, its head included.

        Raises:
            RecordingError: it is cut off, larger than `most`, or the file cannot be read.
        """
        if length > most:
            raise RecordingError(
                f"{self._path}: the record at {offset} declares {length:,} bytes; too large to be ours."
            )
        try:
            with self._lock:
                self._stream.seek(offset)
                data = self._stream.read(length)
        except OSError as error:
            raise RecordingError(f"{self._path}: cannot be read at {offset} ({error.strerror}).") from error
        if len(data) != length:
            raise RecordingError(f"{self._path}: the record at {offset} is cut off.")
        return data

    def chunk(self, entry: ChunkEntry) -> bytes:
        """Return a chunk's message records, after comparing its checksum; keeps the last few.

        Raises:
            RecordingError: it is damaged.
        """
        if entry.offset in self._kept:
            self._kept.move_to_end(entry.offset)
            return self._kept[entry.offset]
        return self._keep(entry, self._unpacked(entry))

    def chunks(self, entries: Iterable[ChunkEntry]) -> Iterator[bytes]:
        """Yield the message records of chunks in order; the next ones are unpacked meanwhile.

        Raises:
            RecordingError: one is damaged.
        """
        under_way: deque[tuple[ChunkEntry, Future[bytes] | None]] = deque()
        for k, entry in enumerate(entries):
            small = entry.uncompressed_size + entry.length <= _SMALL
            ahead = k > 1 and small and entry.offset not in self._kept
            under_way.append((entry, self._threads.submit(self._unpacked, entry) if ahead else None))
            if len(under_way) > _AHEAD:
                yield self._taken(*under_way.popleft())
        while under_way:
            yield self._taken(*under_way.popleft())

    def first_channel(self, entry: ChunkEntry) -> int:
        """Return the channel of a chunk's first message, where no index says it.

        Raises:
            RecordingError: it is damaged.
        """
        return first_channel(self._body(entry), self._where(entry))

    @cached_property
    def _threads(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(_THREADS, thread_name_prefix="unpack")

    def _taken(self, entry: ChunkEntry, unpacked: Future[bytes] | None) -> bytes:
        return self.chunk(entry) if unpacked is None else self._keep(entry, unpacked.result())

    def _keep(self, entry: ChunkEntry, records: bytes) -> bytes:
        """Keep what was unpacked last; little of it, unless it is one large chunk."""
        self._bytes_kept += len(records) - len(self._kept.pop(entry.offset, b""))
        self._kept[entry.offset] = records
        while self._bytes_kept > _BYTES_KEPT and len(self._kept) > 1:
            self._bytes_kept -= len(self._kept.popitem(last=False)[1])
        return records

    def _unpacked(self, entry: ChunkEntry) -> bytes:
        where = self._where(entry)
        try:
            head, records = unpack_chunk(self._body(entry), where)
        except RecordingError as error:
            raise RecordingError(f"{error}; `dualtaxi repair` mends it.") from error
        if head.uncompressed_size != entry.uncompressed_size:
            raise RecordingError(
                f"{where}: declares {head.uncompressed_size} bytes, expected {entry.uncompressed_size}."
            )
        return records

    def _body(self, entry: ChunkEntry) -> memoryview:
        record = self.record(entry.offset, entry.length)
        if record[0] != _OPCODE or int.from_bytes(record[1:9], "little") != entry.length - 9:
            raise RecordingError(f"{self._where(entry)}: found no chunk of {entry.length} bytes there")
        return memoryview(record)[9:]

    def _where(self, entry: ChunkEntry) -> str:
        return f"{self._path}: chunk at {entry.offset}"
