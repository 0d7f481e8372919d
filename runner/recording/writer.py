"""The MCAP file being written: records in order, and the entries of its summary; finished files are synced.

The `mcap` library lays out the records that a recording has one of. Chunks and message indexes, nearly all
of a long recording, are encoded by `records`.

The operating system has every byte of a closed file, so a killed process loses none of them. Syncing protects
them from a power failure; it takes milliseconds a file, and hardly more for many files at once. So finished
files are synced by several threads, off the thread that learns; the end of the interpreter waits for them.
"""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO, Final, Self

from isal.isal_zlib import crc32
from mcap.records import Attachment, Header, Metadata

from runner.errors import StorageError
from runner.recording.index import Beginning, Index, beginning_of, checksum
from runner.recording.layout import MAGIC, Layout
from runner.recording.records import (
    AttachmentRecord,
    Chunk,
    MetadataRecord,
    Place,
    Record,
    asks_for_indexes,
    bytes_of,
    copied_chunk,
)
from runner.recording.schema import PROFILE, TOPIC_OF
from runner.util import __version__
from runner.util.files import sync

_LIBRARY = f"dualtaxi {__version__}"
_SYNCING_THREADS: Final = 8
"""How many files are synced at once: a journal commits them together."""

Failed = Callable[[OSError], None]
"""Takes the error of a file that could not be synced; called from any thread."""


class RecordingFile:
    """A recording that is written: append records, then `finish`. Not thread-safe."""

    def __init__(self, path: Path, layout: Layout | None = None, contents: Index | None = None) -> None:
        """Create the file, which must not exist; with `contents`, open it to be continued.

        Args:
            layout: of a new run; None if `begin` follows, before anything else is written.
            contents: the good records of a recording, as `integrity.survey` found them; what follows the last
                whole chunk is cut off.

        Raises:
            OSError: it exists, or cannot be written.
        """
        self.path = path
        self._index = contents or Index()
        self._stream: BinaryIO = path.open("xb" if contents is None else "r+b", buffering=0)
        self._crc = 0
        self._indexed = True
        self._later: dict[int, Beginning] = {}
        """Schemas and channels that are written before the first chunk of a channel, by its id."""
        if contents is not None:
            self._crc = checksum(self._stream, 0, contents.end)
            self.cut_back()
            return
        try:
            self._append(MAGIC + bytes_of(Header(PROFILE, _LIBRARY)))
            if layout is not None:
                self.begin(beginning_of(layout))
        except OSError:
            self._stream.close()
            path.unlink(missing_ok=True)
            raise

    def begin(self, beginning: Beginning) -> None:
        """Append schemas and channels; the schemas and channels of the run come first."""
        self._append(beginning.schema_records + beginning.channel_records)
        self._index.add_beginning(beginning)

    def declare(self, beginning: Beginning) -> None:
        """State schemas and channels; they are written before the first chunk of one of the channels."""
        self._later |= {channel.id: beginning for channel in beginning.channels}

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._index.end

    @property
    def message_counts(self) -> dict[str, int]:
        """The number of messages of each topic that has any, by name."""
        counts = Counter[str]()
        for channel, n in self._index.count_messages().items():
            counts[TOPIC_OF[channel].name] += n
        return counts

    def add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Append a metadata record."""
        self._index.add_metadata(name, self._append(bytes_of(Metadata(name, dict(entries)))))

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Append an attachment; its times are 0, because times of day belong to the provenance."""
        record = Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data)
        self._index.add_attachment(name, self._append(bytes_of(record)), media_type)

    def copy(self, record: Record) -> None:
        """Append a record of another recording; the times and the message index of a chunk are made again."""
        if isinstance(record, MetadataRecord):
            if record.name == "config":
                self._indexed = asks_for_indexes(record.entries)
            self.add_metadata(*record)
        elif isinstance(record, AttachmentRecord):
            self.add_attachment(*record)
        else:
            self.add_chunk(copied_chunk(record, self._indexed))

    def add_chunks(self, chunks: Sequence[Chunk]) -> None:
        """Append chunks of one topic each with their message indexes: all of them, or none if that fails."""
        for channel in {chunk.entry.channel for chunk in chunks} - self._index.channels.keys():
            beginning = self._later.get(channel)
            if beginning is not None and channel not in self._index.channels:  # nor written with another one
                self.begin(beginning)
        start, _ = self._append(b"".join(part for chunk in chunks for part in (chunk.record, chunk.index)))
        for chunk in chunks:
            self._index.chunks.append(chunk.entry._replace(offset=start, index_length=len(chunk.index)))
            start += len(chunk.record) + len(chunk.index)

    def add_chunk(self, chunk: Chunk) -> None:
        """Append a chunk of one topic and its message index."""
        self.add_chunks([chunk])

    def sync(self) -> None:
        """Have the system write everything to disk."""
        os.fsync(self._stream.fileno())

    def cut_back(self) -> None:
        """Remove the piece of a record that a failed write may have left at the end."""
        self._stream.truncate(self.size)
        self._stream.seek(self.size)

    def finish(self, result: Mapping[str, str] | None = None, *, synced: bool = True) -> None:
        """Write the metadata record `result`, if it is given, summary and footer, and sync the file.

        Args:
            result: the entries of the record.
            synced: False leaves syncing the file to the caller.

        Raises:
            OSError: it could not all be written; the file is then as it was before.
        """
        crc = self._crc
        end = self.size
        metadata = dict(self._index.metadata)
        try:
            if result is not None:
                self.add_metadata("result", result)
            self._append(self._index.tail(self._crc))
            if synced:
                self.sync()
        except OSError:
            self._crc, self._index.end, self._index.metadata = crc, end, metadata
            self.cut_back()
            raise

    def close(self) -> None:
        """Close the file as it is."""
        self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _append(self, data: bytes) -> Place:
        """Append records; return their place."""
        view = memoryview(data)
        while view:
            view = view[self._stream.write(view) :]
        self._crc = crc32(data, self._crc)
        place = self.size, len(data)
        self._index.end += len(data)
        return place


def create_recording(path: Path, layout: Layout | None = None) -> RecordingFile:
    """Return the file of a new recording; arguments as for `RecordingFile`.

    Raises:
        StorageError: it exists, or cannot be created.
    """
    try:
        return RecordingFile(path, layout)
    except OSError as error:
        raise StorageError(
            f"{path}: cannot be created ({error.strerror}); choose another --recordings."
        ) from error


def storage_error(file: RecordingFile, error: OSError) -> StorageError:
    """Return the error for a failed write, with what was kept and what to do."""
    reason = error.strerror or os.strerror(error.errno or 0)
    return StorageError(
        f"{file.path}: writing failed ({reason}) after {file.size:,} bytes. What was written is kept and "
        "can be read; free some disk, or choose another --recordings."
    )


@contextlib.contextmanager
def writing(file: RecordingFile) -> Iterator[None]:
    """Raise an `OSError` of the block as a `StorageError`; no piece of a record stays.

    Raises:
        StorageError: there was one.
    """
    try:
        yield
    except OSError as error:
        file.cut_back()
        raise storage_error(file, error) from error


# --- finished files -----------------------------------------------------------------------------------


class Syncer:
    """Threads that sync the finished files of this process; the end of the interpreter waits for them."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all files, as in a forked process: they belong to the other one."""
        self._threads = ThreadPoolExecutor(_SYNCING_THREADS, thread_name_prefix="recording-sync")

    def add(self, path: Path, failed: Failed) -> None:
        """Sync a finished file soon; at once if the interpreter is ending."""
        path = path.absolute()
        try:
            self._threads.submit(_sync, path, failed)
        except RuntimeError:  # no thread can be started
            _sync(path, failed)

    def sync(self) -> None:
        """Return when every file that was added is on disk."""
        self._threads.shutdown()
        self.clear()


def _sync(path: Path, failed: Failed) -> None:
    try:
        sync(path)
    except FileNotFoundError:
        pass  # it was removed since
    except OSError as error:
        failed(error)


SYNCER: Final = Syncer()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=SYNCER.clear)
