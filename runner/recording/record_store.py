"""The records of an open recording: read, unpacked, compared with their checksums; the last few are cached.

Threads of its own unpack the next chunks while one is in use; otherwise it is for one thread at a time.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording.index import read_index
from runner.recording.layout import RECORD_HEAD
from runner.recording.records import (
    MAX_METADATA_BYTES,
    AttachmentRecord,
    ChunkEntry,
    MetadataRecord,
    Place,
    RawRecord,
    chunk_head,
    first_message,
    read_record,
    unpack_chunk,
)
from runner.util.files import open_regular
from runner.util.packing import MAX_CHUNK_BYTES

N = TypeVar("N", MetadataRecord, AttachmentRecord)

_MAX_CACHED_BYTES: Final = 16 << 20
_THREADS: Final = 2
_AHEAD: Final = 4
"""The number of chunks that are unpacked before they are needed, if they are small."""
_SMALL: Final = 8 << 20


class RecordStore:
    """The file of an open recording: its index, its records by name, its chunks by their entries.

    Raises:
        RecordingError: it cannot be read, or has no index of a recording.
    """

    def __init__(self, path: Path) -> None:
        self.path = str(path)
        try:
            self._stream = open_regular(path)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise RecordingError(f"{path}: cannot be read ({reason}).") from error
        try:
            self.index = read_index(self._stream, self.path)
        except BaseException as error:
            self._stream.close()
            if isinstance(error, OSError):
                raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error
            raise
        self._lock = threading.Lock()
        self._cached: OrderedDict[int, bytes] = OrderedDict()
        self._cached_bytes = 0

    def close(self) -> None:
        """Close the file."""
        if "_threads" in self.__dict__:
            self._threads.shutdown(cancel_futures=True)
        self._stream.close()

    @property
    def finished(self) -> bool:
        """Whether the file was closed properly: it has its index and summary."""
        return self.index.finished

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return os.fstat(self._stream.fileno()).st_size

    @property
    def metadata_names(self) -> list[str]:
        """The names of the metadata records, in the order of the file."""
        return sorted(self.index.metadata, key=self.index.metadata.__getitem__)

    @property
    def attachment_names(self) -> list[str]:
        """The names of the attachments, in the order of the file."""
        return sorted(self.index.attachments, key=self.index.attachments.__getitem__)

    def metadata(self, name: str) -> dict[str, str]:
        """Return a metadata record's entries.

        Raises:
            RecordingError: there is none of that name, or it cannot be read.
        """
        return self._named(MetadataRecord, "metadata", self.index.metadata, name).entries

    def attachment(self, name: str) -> bytes:
        """Return an attachment's data, after comparing its checksum.

        Raises:
            RecordingError: there is none of that name, or it is damaged.
        """
        return self._named(AttachmentRecord, "attachment", self.index.attachments, name).data

    def attachments(self) -> Iterator[tuple[str, str, bytes]]:
        """Yield name, media type and data of each attachment, in the order of the file."""
        for name in self.attachment_names:
            yield self._named(AttachmentRecord, "attachment", self.index.attachments, name)

    def _named(self, kind: type[N], what: str, places: Mapping[str, Place], name: str) -> N:
        """Return a metadata record or an attachment, whose checksum is compared."""
        if name not in places:
            raise RecordingError(
                f"{self.path}: has no {what} {name!r}; it was cut off, or not written by dualtaxi."
            )
        offset, length = places[name]
        raw = self._raw(offset, length, MAX_METADATA_BYTES if kind is MetadataRecord else MAX_CHUNK_BYTES)
        try:
            record = read_record(raw)
        except RecordingError as error:
            raise RecordingError(f"{self.path}: {error}.") from error
        if not isinstance(record, kind):
            raise self._another(raw)
        if record.name != name:
            raise RecordingError(f"{self.path}: found {what} {record.name!r} at {offset}, expected {name!r}.")
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

    @cached_property
    def channels(self) -> NDArray[np.uint16]:
        """The channel of each chunk.

        Raises:
            RecordingError: the recording has no such channel.
        """
        chunks = self.index.chunks
        channels: NDArray[np.uint16] = chunks.columns["channel"].copy()
        for k in np.flatnonzero(channels == 0).tolist():  # the file was cut off before the chunk's index
            body, where = self.chunk_body(chunks[k]), self.where(chunks[k])
            _, channels[k] = first_message(body, chunk_head(body, len(body), where), where)
        for k in np.flatnonzero(~np.isin(channels, list(self.index.channels))).tolist():
            raise RecordingError(
                f"{self.where(chunks[k])}: found messages of channel {channels[k]}, which the recording "
                "does not have."
            )
        return channels

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
        where = self.where(entry)
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

    def where(self, entry: ChunkEntry) -> str:
        """Return how errors name a chunk."""
        return f"{self.path}: chunk at {entry.offset}"

    def _raw(self, offset: int, length: int, max_bytes: int = MAX_CHUNK_BYTES) -> RawRecord:
        """Return a record whose length, with its head, is known."""
        if length > max_bytes:
            raise RecordingError(
                f"{self.path}: the record at {offset} declares {length:,} bytes, "
                f"expected at most {max_bytes:,}."
            )
        try:
            with self._lock:
                self._stream.seek(offset)
                head = self._stream.read(RECORD_HEAD.size)
                body = self._stream.read(length - RECORD_HEAD.size)
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be read at {offset} ({error.strerror}).") from error
        if len(head) + len(body) != length:
            raise RecordingError(f"{self.path}: the record at {offset} is cut off.")
        raw = RawRecord.of(head, offset, body)
        if raw.length != len(body):
            raise self._another(raw)
        return raw

    def _another(self, raw: RawRecord) -> RecordingError:
        return RecordingError(f"{self.path}: found another record at {raw.offset} than the index says.")
