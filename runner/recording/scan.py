"""What of a recording is good: a walk through all of its records, by which it is resumed or repaired.

Unlike the reader's index, this looks at every byte: each chunk is unpacked and its checksum compared.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, ChunkIndex, Metadata, MetadataIndex
from mcap.writer import MCAP0_MAGIC

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.blocks import HEADER_BYTES, RECORD_HEAD
from runner.recording.chunks import MAX_CHUNK_BYTES, chunk_head, unpack_chunk
from runner.recording.index import MAX_NAME_BYTES, MAX_NAMED, refuse_exhausting
from runner.util.files import open_regular

MAX_METADATA_BYTES: Final = 4 << 20
"""The largest metadata record that is read, config and provenance among them."""
_RESULT = "result"
_CHUNK_HEAD_BYTES: Final = 60
N = TypeVar("N", AttachmentIndex, MetadataIndex)
UNREADABLE: Final = (struct.error, ValueError, KeyError, McapError)
"""What parsing damaged records raises."""


@dataclass(frozen=True)
class Part:
    """A good chunk: its index entry, channel and number of messages."""

    index: ChunkIndex
    channel: int
    messages: int


@dataclass
class Contents:
    """The good records of a recording, up to `end`."""

    end: int = 0
    """Offset behind the last good record that a continued recording keeps."""
    size: int = 0
    """Bytes of the file."""
    reason: str = ""
    """Why the walk stopped before the end of the data section; empty if it did not."""
    chunks: list[Part] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    channels: list[int] = field(default_factory=list)

    @property
    def topics(self) -> list[schema.Topic]:
        """The topics of its channels."""
        return [topic for topic in schema.ALL_TOPICS if topic.channel in self.channels]


Check = Callable[[int, int, bytes, bytes], None]
"""Called with (opcode, offset, body, unpacked message records) of a good record; raises what it finds."""


Report = Callable[[int, int], None]
"""Called with the bytes that were read, and those of the file."""


def survey(
    path: Path,
    keep_result: bool = False,
    check: Check = lambda *_: None,
    report: Report = lambda *_: None,
) -> Contents:
    """Return what of a recording is good, from its beginning to the first record that is not.

    Args:
        path: the recording.
        keep_result: whether a `result` record counts; who goes on writing leaves it out and writes anew.
        check: looks at each record besides; what it raises ends the walk as damage does.
        report: called after each record.

    Raises:
        RecordingError: the file cannot be read, or its chunks would exhaust whoever reads them.
    """
    try:
        with open_regular(path) as stream:
            size = stream.seek(0, 2)
            refuse_exhausting(size, _declared(stream, size, str(path)), str(path))
            return _survey(stream, keep_result, check, report)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error


def _declared(stream: BinaryIO, size: int, path: str) -> int:
    """Return how many bytes the chunks of a file declare to hold, up to a record that makes no sense."""
    offset, declared = len(MCAP0_MAGIC), 0
    while offset + 9 <= size:
        stream.seek(offset)
        head = stream.read(9 + _CHUNK_HEAD_BYTES)
        opcode, length = RECORD_HEAD.unpack_from(head)
        if length > min(size - offset - 9, MAX_CHUNK_BYTES) or not 1 <= opcode < Opcode.DATA_END:
            break
        if opcode == Opcode.CHUNK:
            try:
                declared += chunk_head(head[9:], length, path).uncompressed_size
            except RecordingError:
                break
        offset += 9 + length
    return declared


def _survey(stream: BinaryIO, keep_result: bool, check: Check, report: Report) -> Contents:
    contents = Contents(size=stream.seek(0, 2))
    surveyor = _Surveyor(contents, keep_result, check)
    for opcode, at, body in walk(stream, contents.size):
        if opcode == Opcode.DATA_END:
            return contents
        report(at, contents.size)
        try:
            surveyor.take(opcode, at, body)
        except RecordingError as error:
            contents.reason = str(error)
            return contents
        except UNREADABLE:
            contents.reason = f"the record at {at} cannot be read"
            return contents
    contents.reason = f"the file ends at {contents.size}, in the middle of the data"
    return contents


class _Surveyor:
    """Takes the records of a data section in order and notes the good ones."""

    def __init__(self, contents: Contents, keep_result: bool, check: Check) -> None:
        self._contents = contents
        self._keep_result = keep_result
        self._check = check
        self._indexed = True
        """Whether every chunk is followed by its message index."""
        self._pending: Part | None = None

    def take(self, opcode: int, at: int, body: bytes) -> None:
        """Take one record; raises an error if it is damaged."""
        contents, end, records = self._contents, at + 9 + len(body), b""
        if opcode == Opcode.CHUNK:
            part, records = read_chunk(body, at)
            if self._indexed:
                self._check(opcode, at, body, records)
                self._pending = part
                return
            contents.chunks.append(part)
        elif opcode == Opcode.MESSAGE_INDEX and self._pending is not None:
            self._take_index(self._pending, at, body)
        elif opcode == Opcode.METADATA:
            name = _name(body, 0)
            if name == _RESULT and not self._keep_result:
                return
            if name == "config":
                self._indexed = asks_for_indexes(metadata_of(body)[1])
            self._note(contents.metadata, MetadataIndex(offset=at, length=9 + len(body), name=name))
        elif opcode == Opcode.ATTACHMENT:
            self._note(contents.attachments, _attachment_index(body, at))
        elif opcode == Opcode.CHANNEL:
            contents.channels.append(struct.unpack_from("<H", body)[0])
        elif opcode not in (Opcode.HEADER, Opcode.SCHEMA):
            raise RecordingError(f"found a record of kind {opcode} at {at}, expected none there")
        self._check(opcode, at, body, records)
        contents.end = end

    @staticmethod
    def _note(known: list[N], entry: N) -> None:
        if len(known) == MAX_NAMED or len(entry.name) > MAX_NAME_BYTES:
            raise RecordingError(f"found a record too many or with too long a name at {entry.offset}")
        known.append(entry)

    def _take_index(self, part: Part, at: int, body: bytes) -> None:
        (channel,) = struct.unpack_from("<H", body)
        part.index.message_index_offsets[channel] = at
        part.index.message_index_length = 9 + len(body)
        self._contents.chunks.append(part)
        self._pending = None


def walk(stream: BinaryIO, size: int) -> Iterator[tuple[int, int, bytes]]:
    """Yield (opcode, offset, body) of the whole records of a file, until one is cut off or absurd."""
    offset = len(MCAP0_MAGIC)
    while offset + 9 <= size:
        stream.seek(offset)
        opcode, length = RECORD_HEAD.unpack(stream.read(9))
        if length > min(size - offset - 9, MAX_CHUNK_BYTES) or not 1 <= opcode <= Opcode.DATA_END:
            return
        yield opcode, offset, stream.read(length)
        offset += 9 + length


def read_chunk(body: bytes, offset: int) -> tuple[Part, bytes]:
    """Return what the index says of a chunk record, and its message records, after comparing its checksum.

    Raises:
        RecordingError: it is damaged, or holds messages of no topic, or of several.
    """
    where = f"chunk at {offset}"
    head, records = unpack_chunk(body, where)
    channel, messages = _messages(records, where)
    index = ChunkIndex(
        chunk_length=9 + len(body),
        chunk_start_offset=offset,
        compression=head.compression,
        compressed_size=len(body) - head.data_at,
        message_end_time=head.end_time,
        message_index_length=0,
        message_index_offsets={},
        message_start_time=head.start_time,
        uncompressed_size=head.uncompressed_size,
    )
    return Part(index, channel, messages), records


def _messages(records: bytes, where: str) -> tuple[int, int]:
    """Return the channel of a chunk's messages and how many there are."""
    if len(records) < HEADER_BYTES:
        raise RecordingError(f"{where}: holds no whole message")
    opcode, length, channel = struct.unpack_from("<BQH", records)
    if opcode != Opcode.MESSAGE or channel not in schema.TOPIC_OF:
        raise RecordingError(f"{where}: holds no messages of ours")
    if schema.TOPIC_OF[channel] in schema.ALL_BLOCK_TOPICS:
        if len(records) % (9 + length) or 9 + length < HEADER_BYTES:
            raise RecordingError(f"{where}: its messages differ in size")
        return channel, len(records) // (9 + length)
    at = messages = 0
    while at + HEADER_BYTES <= len(records):
        at += 9 + max(struct.unpack_from("<Q", records, at + 1)[0], HEADER_BYTES - 9)
        messages += 1
    if at != len(records):
        raise RecordingError(f"{where}: its messages do not fill it")
    return channel, messages


def _attachment_index(body: bytes, offset: int) -> AttachmentIndex:
    """Return an attachment's index entry, after comparing its checksum."""
    name, media_type, data = attachment_of(body, offset)
    return AttachmentIndex(
        offset=offset,
        length=9 + len(body),
        log_time=0,
        create_time=0,
        data_size=len(data),
        name=name,
        media_type=media_type,
    )


def attachment_of(body: bytes, offset: int) -> tuple[str, str, bytes]:
    """Return the name, media type and data of an attachment record.

    Raises:
        RecordingError: its checksum does not match, or it has times, which no recorder writes.
    """
    stream = ReadDataStream(BytesIO(body))
    times = stream.read8(), stream.read8()
    name, media_type = stream.read_prefixed_string(), stream.read_prefixed_string()
    size = stream.read8()
    data = body[stream.count : -4]
    if len(data) != size or times != (0, 0) or zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
        raise RecordingError(f"attachment at {offset}: its content does not match its checksum")
    return name, media_type, data


def metadata_of(body: bytes) -> tuple[str, dict[str, str]]:
    """Return the name and entries of a metadata record.

    Raises:
        RecordingError: it is larger than any of ours.
    """
    if len(body) > MAX_METADATA_BYTES:
        raise RecordingError(f"metadata of {len(body):,} bytes, expected {MAX_METADATA_BYTES:,} at most")
    record = Metadata.read(ReadDataStream(BytesIO(body)))
    return record.name, dict(record.metadata)


def asks_for_indexes(config: dict[str, str]) -> bool:
    """Return whether a recording's configuration asks for message indexes.

    Raises:
        RecordingError: it does not say.
    """
    try:
        return bool(json.loads(config["json"])["recording"]["index"] == "message")
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise RecordingError("the configuration does not say what it was recorded with") from error


def _name(body: bytes, at: int) -> str:
    (length,) = struct.unpack_from("<I", body, at)
    if length > min(MAX_NAME_BYTES, len(body) - at - 4):
        raise RecordingError(f"found a name of {length:,} bytes")
    return body[at + 4 : at + 4 + length].decode()
