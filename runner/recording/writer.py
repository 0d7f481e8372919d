"""The MCAP file being written: records in order, and the entries of its summary.

The `mcap` library lays out the records that a recording has one of. Chunks and message indexes, nearly all
of a long recording, are encoded by `chunks`; the many small records of a short one, here.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import BinaryIO, Literal, Self

from isal.isal_zlib import crc32
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Header,
    McapRecord,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC

from runner.errors import StorageError
from runner.recording.blocks import RECORD_HEAD
from runner.recording.chunks import Chunk, ChunkSummary
from runner.recording.index import FOOTER_BODY_BYTES, FOOTER_HEAD, checksum
from runner.recording.messages import file_descriptor_set
from runner.recording.records import (
    AttachmentRecord,
    Contents,
    MetadataRecord,
    Record,
    asks_for_indexes,
    copied_chunk,
)
from runner.recording.schema import ALL_TOPICS, KINDS, MESSAGES, PROFILE, Topic
from runner.util import __version__

_LIBRARY = f"dualtaxi {__version__}"
_TWO = struct.Struct("<QQ")
_SUMMARY_OFFSET = struct.Struct("<BQBQQ")


class RecordingFile:
    """A recording that is written: append records, then `finish`. Not thread-safe."""

    def __init__(self, path: Path, topics: Sequence[Topic] = KINDS["job"]) -> None:
        """Create the file; one that exists is never overwritten.

        Raises:
            OSError: it exists, or cannot be created.
        """
        self._reset(path, path.open("xb", buffering=0), topics)
        try:
            self._append(
                b"".join(
                    (MCAP0_MAGIC, _bytes_of(Header(PROFILE, _LIBRARY)), *schemas_and_channels(tuple(topics)))
                )
            )
        except OSError:
            self._stream.close()
            path.unlink(missing_ok=True)
            raise

    def _reset(self, path: Path, stream: BinaryIO, topics: Sequence[Topic]) -> None:
        self.path = path
        self._stream = stream
        self._crc = 0
        self._offset = 0
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._chunks: list[ChunkIndex] = []
        self._counts = {topic.channel: 0 for topic in ALL_TOPICS}
        self._start_time: int | None = None
        self._end_time = 0
        self._indexed = True
        self.topics = tuple(topics)
        """The topics it has channels for."""

    @classmethod
    def reopen(cls, path: Path, contents: Contents) -> RecordingFile:
        """Open a recording to resume it: what follows its last whole chunk is cut off.

        Args:
            contents: its good records, as `integrity.survey` found them.

        Raises:
            OSError: it cannot be written.
        """
        file = cls._existing(path, "r+b", contents)
        file._stream.truncate(contents.end)
        return file

    @classmethod
    def inspect(cls, path: Path, contents: Contents) -> RecordingFile:
        """Open a recording for reading, to compute its `tail`."""
        return cls._existing(path, "rb", contents)

    @classmethod
    def _existing(cls, path: Path, mode: Literal["rb", "r+b"], contents: Contents) -> RecordingFile:
        """Open a recording as it was when the last of these records was written."""
        file = cls.__new__(cls)
        file._reset(path, path.open(mode, buffering=0), contents.topics)
        file._crc = checksum(file._stream, 0, contents.end)
        file._offset = file._stream.seek(contents.end)
        file._attachments = list(contents.attachments)
        file._metadata = list(contents.metadata)
        for chunk in contents.chunks:
            file._note_chunk(chunk)
        return file

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._offset

    def add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Append a metadata record."""
        data = metadata_record(name, entries)
        index = MetadataIndex(offset=self._offset, length=len(data), name=name)
        self._append(data)
        self._metadata.append(index)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Append an attachment; its times are 0, because times of day belong to the provenance."""
        record = _bytes_of(Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data))
        index = AttachmentIndex(
            offset=self._offset,
            length=len(record),
            log_time=0,
            create_time=0,
            data_size=len(data),
            name=name,
            media_type=media_type,
        )
        self._append(record)
        self._attachments.append(index)

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
        start = self._offset
        self._append(b"".join(part for chunk in chunks for part in (chunk.record, chunk.index)))
        for chunk in chunks:
            index_start = start + len(chunk.record)
            place = {
                "chunk_start_offset": start,
                "message_index_offsets": {chunk.summary.channel: index_start} if chunk.index else {},
                "message_index_length": len(chunk.index),
            }
            self._note_chunk(replace(chunk.summary, index=replace(chunk.summary.index, **place)))
            start = index_start + len(chunk.index)

    def add_chunk(self, chunk: Chunk) -> None:
        """Append a chunk of one topic and its message index."""
        self.add_chunks([chunk])

    def _note_chunk(self, chunk: ChunkSummary) -> None:
        self._chunks.append(chunk.index)
        self._counts[chunk.channel] += chunk.messages
        start = chunk.index.message_start_time
        self._start_time = start if self._start_time is None else min(start, self._start_time)
        self._end_time = max(chunk.index.message_end_time, self._end_time)

    def sync(self) -> None:
        """Have the system write everything to disk."""
        os.fsync(self._stream.fileno())

    def cut_back(self) -> None:
        """Remove the piece of a record that a failed write may have left at the end."""
        self._stream.truncate(self._offset)
        self._stream.seek(self._offset)

    def finish(
        self, name: str = "", entries: Mapping[str, str] | None = None, *, synced: bool = True
    ) -> None:
        """Write a last metadata record, if one is named, summary and footer, and sync the file.

        Args:
            name: of the record; empty for none.
            synced: False leaves syncing the file to the caller.

        Raises:
            OSError: it could not all be written; the file is then as it was before.
        """
        crc, offset, metadata = self._crc, self._offset, len(self._metadata)
        try:
            if name:
                self.add_metadata(name, entries or {})
            self._append(self.tail())
            if synced:
                self.sync()
        except OSError:
            self._crc, self._offset = crc, offset
            del self._metadata[metadata:]
            self.cut_back()
            raise

    def tail(self) -> bytes:
        """Return the end of a finished recording, after its data: data end, summary, footer, magic."""
        data_end = _bytes_of(DataEnd(self._crc))
        summary_start = self._offset + len(data_end)
        summary, offsets = self._summary(summary_start)
        offsets_start = summary_start + len(summary)
        footer = FOOTER_HEAD.pack(Opcode.FOOTER, FOOTER_BODY_BYTES, summary_start, offsets_start)
        crc = crc32(footer, crc32(summary + offsets))
        return b"".join((data_end, summary, offsets, footer, struct.pack("<I", crc), MCAP0_MAGIC))

    def close(self) -> None:
        """Close the file as it is."""
        self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _append(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            view = view[self._stream.write(view) :]
        self._crc = crc32(data, self._crc)
        self._offset += len(data)

    def _summary(self, start: int) -> tuple[bytes, bytes]:
        """Return the summary section, which begins at `start`, and the summary offset section."""
        schemas, channels = schemas_and_channels(self.topics)
        groups = [
            (Opcode.SCHEMA, schemas),
            (Opcode.CHANNEL, channels),
            (Opcode.STATISTICS, _bytes_of(self._statistics())),
            (Opcode.CHUNK_INDEX, _bytes_of(*self._chunks)),
            (Opcode.ATTACHMENT_INDEX, b"".join(map(_attachment_index, self._attachments))),
            (Opcode.METADATA_INDEX, b"".join(map(_metadata_index, self._metadata))),
        ]
        body, offsets = bytearray(), []
        for opcode, data in groups:
            if data:
                offset = Opcode.SUMMARY_OFFSET, 17, opcode, start + len(body), len(data)
                offsets.append(_SUMMARY_OFFSET.pack(*offset))
            body += data
        return bytes(body), b"".join(offsets)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self.topics),
            channel_message_counts={channel: n for channel, n in self._counts.items() if n},
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            metadata_count=len(self._metadata),
            message_start_time=self._start_time or 0,
            message_end_time=self._end_time,
            schema_count=len({topic.message for topic in self.topics}),
        )


def create_recording(path: Path, topics: Sequence[Topic] = KINDS["job"]) -> RecordingFile:
    """Return the file of a new recording with these topics.

    Raises:
        StorageError: it exists, or cannot be created.
    """
    try:
        return RecordingFile(path, topics)
    except OSError as error:
        raise StorageError(
            f"{path}: cannot be created ({error.strerror}); choose another --recordings."
        ) from error


@cache
def schemas_and_channels(topics: tuple[Topic, ...]) -> tuple[bytes, bytes]:
    """Return the schema and channel records of a recording with these topics, which follow its header."""
    used = {topic.message for topic in topics}
    schemas = [
        Schema(id=number, name=message.full_name, encoding="protobuf", data=file_descriptor_set(message))
        for number, message in enumerate(MESSAGES, start=1)
        if message in used
    ]
    channels = [
        Channel(
            id=topic.channel,
            topic=topic.name,
            message_encoding="protobuf",
            metadata={},
            schema_id=1 + MESSAGES.index(topic.message),
        )
        for topic in sorted(topics, key=lambda topic: topic.channel)
    ]
    return _bytes_of(*schemas), _bytes_of(*channels)


def metadata_record(name: str, entries: Mapping[str, str]) -> bytes:
    """Return a metadata record; the same as the library's, in a tenth of the time: there are many entries."""
    pairs = _pairs(tuple(entries.items()))
    body = _prefixed(name) + struct.pack("<I", len(pairs)) + pairs
    return RECORD_HEAD.pack(Opcode.METADATA, len(body)) + body


@lru_cache(16)
def _pairs(entries: tuple[tuple[str, str], ...]) -> bytes:
    """Return the entries of a metadata record; those that list packages are the same in the next run."""
    return b"".join(_prefixed(text) for pair in entries for text in pair)


def _metadata_index(index: MetadataIndex) -> bytes:
    body = _TWO.pack(index.offset, index.length) + _prefixed(index.name)
    return RECORD_HEAD.pack(Opcode.METADATA_INDEX, len(body)) + body


def _attachment_index(index: AttachmentIndex) -> bytes:
    numbers = index.offset, index.length, index.log_time, index.create_time, index.data_size
    body = struct.pack("<QQQQQ", *numbers) + _prefixed(index.name) + _prefixed(index.media_type)
    return RECORD_HEAD.pack(Opcode.ATTACHMENT_INDEX, len(body)) + body


def _prefixed(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def storage_error(file: RecordingFile, error: OSError) -> StorageError:
    """Return the error for a failed write, with what was kept and what to do."""
    reason = error.strerror or os.strerror(error.errno or 0)
    return StorageError(
        f"{file.path}: writing failed ({reason}) after {file.size:,} bytes. What was written is kept and "
        "can be read; free some disk, or choose another --recordings."
    )


def _bytes_of(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())
