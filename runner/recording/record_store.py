"""The records of an open recording: read, unpacked, compared with their checksums; the last few are cached.

Reading is safe from several threads, so the next chunks are unpacked while one is in use.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from typing import BinaryIO, Final, TypeVar

from runner.errors import RecordingError
from runner.recording.blocks import RECORD_HEAD
from runner.recording.chunks import MAX_CHUNK_BYTES, ChunkEntry, first_channel, unpack_chunk
from runner.recording.records import (
    MAX_METADATA_BYTES,
    AttachmentRecord,
    MetadataRecord,
    RawRecord,
    read_record,
)

N = TypeVar("N", MetadataRecord, AttachmentRecord)

_MAX_CACHED_BYTES: Final = 16 << 20
_THREADS: Final = 2
_AHEAD: Final = 4
"""The number of chunks that are unpacked before they are needed, if they are small."""
_SMALL: Final = 8 << 20


class RecordStore:
    """Reads records by their places.

    Args:
        stream: the file; closed with the store.
    """

    def __init__(self, stream: BinaryIO, path: str) -> None:
        self._stream = stream
        self._path = path
        self._lock = threading.Lock()
        self._cached: OrderedDict[int, bytes] = OrderedDict()
        self._cached_bytes = 0

    def close(self) -> None:
        """Close the file."""
        if "_threads" in self.__dict__:
            self._threads.shutdown(cancel_futures=True)
        self._stream.close()

    def named(self, kind: type[N], name: str, offset: int, length: int) -> N:
        """Return a metadata record or an attachment, whose checksum is compared.

        Raises:
            RecordingError: it cannot be read, is damaged, or has another name.
        """
        raw = self._raw(offset, length, MAX_METADATA_BYTES if kind is MetadataRecord else MAX_CHUNK_BYTES)
        try:
            record = read_record(raw)
        except RecordingError as error:
            raise RecordingError(f"{self._path}: {error}.") from error
        if not isinstance(record, kind):
            raise self._another(raw)
        if record.name != name:
            what = "metadata" if kind is MetadataRecord else "attachment"
            raise RecordingError(
                f"{self._path}: found {what} {record.name!r} at {offset}, expected {name!r}."
            )
        return record

    def chunk_body(self, entry: ChunkEntry) -> memoryview:
        """Return the body of a chunk's record, still packed.

        Raises:
            RecordingError: there is no chunk, or it cannot be read.
        """
        raw = self._raw(entry.offset, entry.length)
        if not raw.is_chunk:
            raise self._another(raw)
        return memoryview(raw.body)

    def chunk(self, entry: ChunkEntry) -> bytes:
        """Return a chunk's message records, after comparing its checksum; the last few are cached."""
        if entry.offset in self._cached:
            self._cached.move_to_end(entry.offset)
            return self._cached[entry.offset]
        return self._cache(entry, self._unpacked(entry))

    def chunks(self, entries: Iterable[ChunkEntry]) -> Iterator[bytes]:
        """Yield the message records of chunks in order; the next ones are unpacked meanwhile."""
        pending: deque[tuple[ChunkEntry, Future[bytes] | None]] = deque()
        for k, entry in enumerate(entries):
            small = entry.uncompressed_size + entry.length <= _SMALL
            ahead = k > 1 and small and entry.offset not in self._cached
            pending.append((entry, self._threads.submit(self._unpacked, entry) if ahead else None))
            if len(pending) > _AHEAD:
                yield self._result(*pending.popleft())
        while pending:
            yield self._result(*pending.popleft())

    def first_channel(self, entry: ChunkEntry) -> int:
        """Return the channel of a chunk's first message, where no index states it."""
        return first_channel(self.chunk_body(entry), self._where(entry))

    @cached_property
    def _threads(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(_THREADS, thread_name_prefix="unpack")

    def _result(self, entry: ChunkEntry, unpacked: Future[bytes] | None) -> bytes:
        return self.chunk(entry) if unpacked is None else self._cache(entry, unpacked.result())

    def _cache(self, entry: ChunkEntry, records: bytes) -> bytes:
        """Cache a chunk and drop the oldest beyond the limit, but keep one that is larger."""
        self._cached_bytes += len(records) - len(self._cached.pop(entry.offset, b""))
        self._cached[entry.offset] = records
        while self._cached_bytes > _MAX_CACHED_BYTES and len(self._cached) > 1:
            self._cached_bytes -= len(self._cached.popitem(last=False)[1])
        return records

    def _unpacked(self, entry: ChunkEntry) -> bytes:
        where = self._where(entry)
        body = self.chunk_body(entry)
        try:
            head, records = unpack_chunk(body, where)
        except RecordingError as error:
            raise RecordingError(f"{error}; `dualtaxi repair` mends it.") from error
        if head.uncompressed_size != entry.uncompressed_size:
            raise RecordingError(
                f"{where}: declares {head.uncompressed_size} bytes, expected {entry.uncompressed_size}."
            )
        return records

    def _where(self, entry: ChunkEntry) -> str:
        return f"{self._path}: chunk at {entry.offset}"

    def _raw(self, offset: int, length: int, max_bytes: int = MAX_CHUNK_BYTES) -> RawRecord:
        """Return a record whose length, with its head, is known."""
        if length > max_bytes:
            raise RecordingError(
                f"{self._path}: the record at {offset} declares {length:,} bytes, "
                f"expected at most {max_bytes:,}."
            )
        try:
            with self._lock:
                self._stream.seek(offset)
                head, body = self._stream.read(RECORD_HEAD.size), self._stream.read(length - RECORD_HEAD.size)
        except OSError as error:
            raise RecordingError(f"{self._path}: cannot be read at {offset} ({error.strerror}).") from error
        if len(head) + len(body) != length:
            raise RecordingError(f"{self._path}: the record at {offset} is cut off.")
        raw = RawRecord.of(head, offset, body)
        if raw.length != len(body):
            raise self._another(raw)
        return raw

    def _another(self, raw: RawRecord) -> RecordingError:
        return RecordingError(f"{self._path}: found another record at {raw.offset} than the index says.")
