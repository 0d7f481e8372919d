"""The index of a recording: read from its summary, or found by walking its records; and its summary.

A file declares sizes and offsets; each is compared with the file's own size before it is used. What is kept
in memory is bounded whatever the file declares: 46 bytes a chunk, and few names.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from operator import attrgetter, itemgetter
from typing import BinaryIO, Final, NamedTuple, TypeVar

import numpy as np
from isal.isal_zlib import crc32
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    DataEnd,
    Header,
    MetadataIndex,
    Schema,
    Statistics,
)

from runner.errors import CutOff, RecordingError
from runner.recording.layout import MAGIC, MESSAGE_HEAD, RECORD_HEAD, Layout
from runner.recording.messages import file_descriptor_set
from runner.recording.records import (
    CHUNK_HEAD,
    LARGE,
    MAX_NAME_BYTES,
    MAX_NAMED,
    MAX_UNPACKED_RATIO,
    UNREADABLE,
    ChunkEntry,
    Place,
    RawRecord,
    bytes_of,
    most_bytes,
    raw_records,
)
from runner.recording.schema import (
    EXTRA,
    MAX_LAYOUTS,
    MESSAGES,
    PROFILE,
    TOPIC_OF,
    MessageType,
    Topic,
    extra_topic,
    schema_id,
)
from runner.util.arrays import Records
from runner.util.packing import MAX_CHUNK_BYTES

K = TypeVar("K")
T = TypeVar("T")

MAX_CHUNKS: Final = 1 << 21
"""The most chunks that a recording is read with: a chunk of steps holds 256 or more."""
_ALWAYS_UNPACKED: Final = 1 << 30
"""Bytes that a file of any size may declare to hold."""
_PIECE: Final = 1 << 20
_CHUNK_INDEX_HEAD: Final = struct.Struct("<QQQQI")
_OFFSET_ENTRY: Final = struct.Struct("<HQ")
_SUMMARY_OFFSET: Final = struct.Struct("<BQBQQ")
_FOOTER_HEAD: Final = struct.Struct("<BQQQ")
"""The part of the footer that its checksum covers: opcode, length, starts of summary and summary offsets."""
_FOOTER_BODY_BYTES: Final = 20
_TAIL: Final = struct.Struct("<BQQQI8s")
"""The footer, and the magic after it."""

_ENTRY: Final = struct.Struct("<QIIQQH4sII")
_ENTRY_COLUMNS: Final = np.dtype(
    list(zip(ChunkEntry._fields, ("<u8", "<u4", "<u4", "<u8", "<u8", "<u2", "S4", "<u4", "<u4"), strict=True))
)
_CHANNEL, _CHANNEL_AT = struct.Struct("<H"), _ENTRY_COLUMNS.fields["channel"][1]  # type: ignore[index]


class ChunkTable:
    """The chunks of a recording in the order of the file, 46 bytes each."""

    def __init__(self) -> None:
        self._packed = bytearray()
        self._end = 0

    def __len__(self) -> int:
        return len(self._packed) // _ENTRY.size

    def __getitem__(self, k: int) -> ChunkEntry:
        return ChunkEntry(*_ENTRY.unpack_from(self._packed, k * _ENTRY.size))

    def __iter__(self) -> Iterator[ChunkEntry]:
        return map(ChunkEntry._make, _ENTRY.iter_unpack(self._packed))

    def append(self, entry: ChunkEntry) -> None:
        """Add a chunk after the last one.

        Raises:
            RecordingError: no recorder writes a chunk of the size, or at the place, that it declares.
        """
        where = f"the chunk at {entry.offset}"
        if entry.length > MAX_CHUNK_BYTES or entry.uncompressed_size > MAX_CHUNK_BYTES:
            size = max(entry.length, entry.uncompressed_size)
            raise RecordingError(f"{where} declares {size:,} bytes, expected at most {MAX_CHUNK_BYTES:,}")
        if (
            entry.length < RECORD_HEAD.size + CHUNK_HEAD.size + 8
            or entry.uncompressed_size < MESSAGE_HEAD.size
        ):
            raise RecordingError(f"{where} declares fewer bytes than a chunk with a message has")
        if entry.offset < self._end:
            raise RecordingError(f"{where} overlaps the one before it in the index")
        if len(self._packed) == MAX_CHUNKS * _ENTRY.size:
            raise RecordingError(f"has more than {MAX_CHUNKS:,} chunks, the most that a recording may have")
        self._packed += _ENTRY.pack(*entry)
        self._end = entry.offset + entry.length

    def set_channel(self, channel: int) -> None:
        """Set the channel of the last chunk's messages.

        Raises:
            RecordingError: it was set before.
        """
        at = len(self._packed) - _ENTRY.size + _CHANNEL_AT
        (known,) = _CHANNEL.unpack_from(self._packed, at)
        if known:
            raise RecordingError(
                f"chunk at {self[len(self) - 1].offset}: found messages of the channels {known} and "
                f"{channel}, expected those of one topic"
            )
        _CHANNEL.pack_into(self._packed, at, channel)

    @property
    def columns(self) -> Records:
        """All chunks as a structured array with the fields of `ChunkEntry`: a view."""
        return np.frombuffer(self._packed, _ENTRY_COLUMNS)


class Beginning(NamedTuple):
    """The schemas and channels of a recording, and their records."""

    schemas: Sequence[Schema]
    channels: Sequence[Channel]
    schema_records: bytes
    channel_records: bytes


@dataclass
class Index:
    """The places of a recording's records, up to `end`."""

    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    chunks: ChunkTable = field(default_factory=ChunkTable)
    attachments: dict[str, Place] = field(default_factory=dict)
    """By name."""
    media_types: dict[str, str] = field(default_factory=dict)
    """Media type of each attachment, by name."""
    metadata: dict[str, Place] = field(default_factory=dict)
    message_counts: dict[int, int] = field(default_factory=dict)
    """Messages by channel, as the summary counts them; empty without one."""
    finished: bool = False
    header_end: int = 0
    """Offset after the header of the file, as `integrity.survey` finds it."""
    end: int = 0
    """Offset after the last whole record of the data section."""
    size: int = 0
    """Bytes of the file."""
    reason: str = ""
    """Why its records were not read to the end of the data section; empty if they were."""
    schema_records: bytes = b""
    channel_records: bytes = b""

    def check_unpacked_size(self, path: str) -> None:
        """Refuse a file whose chunks declare far more bytes than any recording of its size holds.

        Raises:
            RecordingError: they do.
        """
        unpacked = int(self.chunks.columns["uncompressed_size"].sum(dtype=np.uint64))
        if unpacked > self.size * MAX_UNPACKED_RATIO + _ALWAYS_UNPACKED:
            raise RecordingError(
                f"{path}: {self.size:,} bytes declare to hold {unpacked:,}; made to exhaust memory."
            )

    def add(self, raw: RawRecord) -> None:
        """Add a record of the data section, of which the beginning suffices, or of the summary.

        Raises:
            RecordingError: it cannot be read, or contradicts those before it.
        """
        if raw.length > most_bytes(raw.kind) and raw.kind not in LARGE:
            raise RecordingError(
                f"the record at {raw.offset} declares {raw.length:,} bytes, "
                f"expected at most {most_bytes(raw.kind):,}"
            )
        match raw.kind:
            case Opcode.CHUNK:
                head = raw.body[: CHUNK_HEAD.size].ljust(CHUNK_HEAD.size, b"\0")
                start, end, unpacked, _, _ = CHUNK_HEAD.unpack(head)
                self.chunks.append(ChunkEntry(*raw.place, unpacked, start, end, 0))
            case Opcode.MESSAGE_INDEX:
                self.chunks.set_channel(int.from_bytes(raw.body[:2], "little"))
            case Opcode.CHUNK_INDEX:
                entry = _chunk_entry(raw)
                self._place_in_data("chunk", entry)
                self.chunks.append(entry)
            case Opcode.METADATA:
                self.add_metadata(_text(raw, 0)[0], raw.place)
            case Opcode.METADATA_INDEX:
                metadata = _parse(MetadataIndex, raw)
                self.add_metadata(metadata.name, self._place_in_data("metadata", metadata))
            case Opcode.ATTACHMENT:
                name, at = _text(raw, 16)
                self.add_attachment(name, raw.place, _text(raw, at)[0])
            case Opcode.ATTACHMENT_INDEX:
                attachment = _parse(AttachmentIndex, raw)
                place = self._place_in_data("attachment", attachment)
                self.add_attachment(attachment.name, place, attachment.media_type)
            case Opcode.SCHEMA:
                schema = _parse(Schema, raw)
                _add_once(self.schemas, schema.id, schema, "schema")
                self.schema_records += RECORD_HEAD.pack(raw.kind, raw.length) + raw.body
            case Opcode.CHANNEL:
                channel = _parse(Channel, raw)
                _add_once(self.channels, channel.id, channel, "channel")
                self.channel_records += RECORD_HEAD.pack(raw.kind, raw.length) + raw.body
            case Opcode.STATISTICS:
                self.message_counts = dict(_parse(Statistics, raw).channel_message_counts)
            case Opcode.HEADER if raw.offset != len(MAGIC):
                raise RecordingError(f"found a second header at {raw.offset}")

    def add_metadata(self, name: str, place: Place) -> None:
        """Add a metadata record."""
        _add_once(self.metadata, name, place, "metadata")

    def add_attachment(self, name: str, place: Place, media_type: str) -> None:
        """Add an attachment."""
        _add_once(self.attachments, name, place, "attachment")
        self.media_types[name] = media_type

    def _place_in_data(self, what: str, entry: ChunkEntry | MetadataIndex | AttachmentIndex) -> Place:
        """Return the place that an entry of the index states, within the data."""
        offset, length = entry.offset, entry.length
        if offset < len(MAGIC) or length < RECORD_HEAD.size or offset + length > self.end:
            raise RecordingError(
                f"the index points to {what} of {length} bytes at {offset}, outside the data"
            )
        return offset, length

    def take_records(self, stream: BinaryIO) -> None:
        """Add the records of the data section, up to the last whole one, by their beginnings.

        Raises:
            RecordingError: one cannot be read, or contradicts those before it.
        """
        self.end = len(MAGIC)
        for raw in raw_records(stream, self.end, self.size):
            if not raw.is_data or (raw.is_message_index and not self.chunks):
                return
            self.add(raw)
            self.end = raw.end

    def take_summary(self, stream: BinaryIO) -> bool:
        """Add the records of the summary section, after comparing its checksum; return whether there is one.

        Raises:
            RecordingError: it is damaged.
        """
        end = self.size - _TAIL.size
        if end < len(MAGIC):
            return False
        stream.seek(end)
        opcode, length, start, offsets_start, crc, magic = _TAIL.unpack(stream.read(_TAIL.size))
        if (opcode, length, magic) != (Opcode.FOOTER, _FOOTER_BODY_BYTES, MAGIC):
            return False
        if not len(MAGIC) < start <= offsets_start <= end:
            raise RecordingError(f"the footer points to a summary at {start}, outside the file; try `repair`")
        fields = _FOOTER_HEAD.pack(Opcode.FOOTER, _FOOTER_BODY_BYTES, start, offsets_start)
        if crc32(fields, checksum(stream, start, end)) != crc:
            raise RecordingError(f"the summary at {start} does not match its checksum; try `repair`")
        self.finished = True
        self.end = start
        for raw in raw_records(stream, start, end):
            self.add(raw)
            start = raw.end
        if start != end:
            raise RecordingError(f"found {end - start} stray bytes at {start}, expected a record")
        return True

    def add_beginning(self, beginning: Beginning) -> None:
        """Add schemas and channels that are written."""
        self.schemas |= {schema.id: schema for schema in beginning.schemas}
        self.channels |= {channel.id: channel for channel in beginning.channels}
        self.schema_records += beginning.schema_records
        self.channel_records += beginning.channel_records

    def tail(self, crc: int) -> bytes:
        """Return the end of a finished recording, after its data: data end, summary, footer, magic.

        Args:
            crc: the checksum of the file up to `end`.
        """
        data_end = bytes_of(DataEnd(crc))
        start = self.end + len(data_end)
        metadata = (MetadataIndex(*place, name) for name, place in self.metadata.items())
        attachments = []
        for name, (offset, length) in self.attachments.items():
            kind = self.media_types[name]
            # All but its times, the lengths of its texts and data, and its checksum.
            size = length - RECORD_HEAD.size - 2 * 8 - 2 * 4 - len(f"{name}{kind}".encode()) - 8 - 4
            attachments.append(AttachmentIndex(offset, length, 0, 0, size, name, kind))
        chunks, counts = self.chunks.columns, self.count_messages()
        statistics = Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=counts,
            chunk_count=len(chunks),
            message_count=sum(counts.values()),
            metadata_count=len(self.metadata),
            message_start_time=int(chunks["start_time"].min()) if len(chunks) else 0,
            message_end_time=int(chunks["end_time"].max(initial=0)),
            schema_count=len(self.schemas),
        )
        groups = [
            (Opcode.SCHEMA, self.schema_records),
            (Opcode.CHANNEL, self.channel_records),
            (Opcode.STATISTICS, bytes_of(statistics)),
            (Opcode.CHUNK_INDEX, b"".join(map(_chunk_index, self.chunks))),
            (Opcode.ATTACHMENT_INDEX, bytes_of(*attachments)),
            (Opcode.METADATA_INDEX, bytes_of(*metadata)),
        ]
        summary, offsets = bytearray(), bytearray()
        for opcode, data in groups:
            if data:
                at = start + len(summary)
                offsets += _SUMMARY_OFFSET.pack(Opcode.SUMMARY_OFFSET, 17, opcode, at, len(data))
            summary += data
        footer = _FOOTER_HEAD.pack(Opcode.FOOTER, _FOOTER_BODY_BYTES, start, start + len(summary))
        crc = crc32(footer, crc32(summary + offsets))
        return b"".join((data_end, summary, offsets, footer, struct.pack("<I", crc), MAGIC))

    def count_messages(self) -> dict[int, int]:
        """Return the number of messages of each channel that has any, by the entries of the chunks."""
        chunks = self.chunks.columns
        return {
            channel: int(chunks["messages"][chunks["channel"] == channel].sum())
            for channel in np.unique(chunks["channel"]).tolist()
        }


def read_index(stream: BinaryIO, path: str) -> Index:
    """Return the index of a recording: by its summary if it is finished, else by walking its records.

    Raises:
        RecordingError: it is not a dualtaxi recording, or is damaged before its first chunk.
    """
    index = Index(size=stream.seek(0, 2))
    try:
        check_beginning(stream)
        if not index.take_summary(stream):
            index.take_records(stream)
        if not index.channels:
            raise RecordingError("the recording was cut off before its first message")
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}.") from error
    index.check_unpacked_size(path)
    return index


def check_beginning(stream: BinaryIO) -> int:
    """Refuse a file of another program, or that is no MCAP file; return where its header ends.

    Raises:
        CutOff: its header is cut off or damaged.
        RecordingError: it is such a file, or is empty.
    """
    stream.seek(0)
    magic = stream.read(len(MAGIC))
    if not magic:
        raise RecordingError("found an empty file, expected a recording")
    if magic != MAGIC:
        error = CutOff if MAGIC.startswith(magic) else RecordingError
        raise error("found another kind of file, expected an MCAP file: not a dualtaxi recording")
    header = next(raw_records(stream, len(MAGIC), stream.seek(0, 2)), None)
    if header is None or header.kind != Opcode.HEADER:
        raise CutOff(f"the Header record at {len(MAGIC)} cannot be read")
    try:
        profile = _parse(Header, header).profile
    except RecordingError as error:
        raise CutOff(str(error)) from error
    if profile != PROFILE:
        raise RecordingError(
            f"found an MCAP file of profile {profile!r}, expected {PROFILE!r}: not a dualtaxi recording"
        )
    return header.end


def checksum(stream: BinaryIO, start: int, end: int) -> int:
    """Return the checksum of a part of the file, which need not fit into memory."""
    crc = 0
    at = stream.seek(start)
    while at < end and (piece := stream.read(min(_PIECE, end - at))):
        crc = crc32(piece, crc)
        at += len(piece)
    return crc


@lru_cache(64)
def beginning_of(layout: Layout) -> Beginning:
    """Return the schemas and channels of a recording, whose records follow its header.

    Those of extras come later, when their names are known.
    """
    return _beginning({topic: layout.message(topic) for topic in layout.topics if topic.message is not EXTRA})


@lru_cache(64)
def beginning_of_extras(number: int, message: MessageType) -> Beginning:
    """Return the schema and the channels of a layout of extras, whose records precede their first chunk."""
    return _beginning({extra_topic(phase, number): message for phase in ("train", "eval")})


def channel_of(topic: Topic) -> Channel:
    """Return the channel of a topic."""
    return Channel(topic.channel, topic.name, "protobuf", {}, schema_id(topic))


def _beginning(messages: Mapping[Topic, MessageType]) -> Beginning:
    numbered = {schema_id(topic): message for topic, message in messages.items()}
    schemas = [
        Schema(id=number, data=file_descriptor_set(message), encoding="protobuf", name=message.full_name)
        for number, message in sorted(numbered.items(), key=itemgetter(0))
    ]
    channels = [*map(channel_of, sorted(messages, key=attrgetter("channel")))]
    return Beginning(schemas, channels, bytes_of(*schemas), bytes_of(*channels))


def _chunk_entry(raw: RawRecord) -> ChunkEntry:
    """Return the entry in a ChunkIndex record: there are thousands, so not by the library's reader."""
    body = raw.body
    try:
        start, end, offset, length, map_bytes = _CHUNK_INDEX_HEAD.unpack_from(body)
        map_start, map_end = _CHUNK_INDEX_HEAD.size, _CHUNK_INDEX_HEAD.size + map_bytes
        channels = [channel for channel, _ in _OFFSET_ENTRY.iter_unpack(body[map_start:map_end])]
        (name_length,) = struct.unpack_from("<I", body, map_end + 8)
        (uncompressed,) = struct.unpack_from("<Q", body, map_end + 12 + name_length + 8)
    except struct.error as error:
        raise RecordingError(f"the ChunkIndex record at {raw.offset} cannot be read") from error
    if len(channels) > 1:
        raise RecordingError(
            f"the ChunkIndex record at {raw.offset} names {len(channels)} channels, "
            "expected that of one topic"
        )
    return ChunkEntry(offset, length, uncompressed, start, end, channels[0] if channels else 0)


def _chunk_index(entry: ChunkEntry) -> bytes:
    """Return the ChunkIndex record of a chunk."""
    name = entry.compression.rstrip(b"\0")
    after = entry.offset + entry.length
    indexed = _OFFSET_ENTRY.pack(entry.channel, after) if entry.index_length else b""
    place = entry.start_time, entry.end_time, entry.offset, entry.length
    packed = entry.length - RECORD_HEAD.size - CHUNK_HEAD.size - len(name) - 8
    body = (
        _CHUNK_INDEX_HEAD.pack(*place, len(indexed)),
        indexed,
        struct.pack("<QI", entry.index_length, len(name)),
        name,
        struct.pack("<QQ", packed, entry.uncompressed_size),
    )
    return b"".join((RECORD_HEAD.pack(Opcode.CHUNK_INDEX, sum(map(len, body))), *body))


def _parse(kind: type[T], raw: RawRecord) -> T:
    try:
        return kind.read(ReadDataStream(BytesIO(raw.body)))  # type: ignore[attr-defined, no-any-return]
    except UNREADABLE as error:
        raise RecordingError(f"the {kind.__name__} record at {raw.offset} cannot be read") from error


def _text(raw: RawRecord, at: int) -> tuple[str, int]:
    """Return the text at `at` in a record's body, which its length precedes, and where it ends."""
    try:
        (length,) = struct.unpack_from("<I", raw.body, at)
        end = at + 4 + length
        if end <= len(raw.body):
            return raw.body[at + 4 : end].decode(), end
    except (struct.error, UnicodeDecodeError) as error:
        raise RecordingError(f"the record at {raw.offset} has no readable name") from error
    raise RecordingError(f"the record at {raw.offset} declares a name of {length:,} bytes")


def _add_once(known: dict[K, T], key: K, value: T, what: str) -> None:
    """Add an entry; a file may have one of each key, and not too many."""
    if key in known:
        raise RecordingError(f"has {what} {key!r} twice")
    most = {"channel": len(TOPIC_OF), "schema": len(MESSAGES) + MAX_LAYOUTS}.get(what, MAX_NAMED)
    if len(known) == most:
        raise RecordingError(
            f"has more than {len(known):,} {what} records, the most that a recording may have"
        )
    if isinstance(key, str) and len(key) > MAX_NAME_BYTES:
        raise RecordingError(f"has {what} with a name of {len(key):,} letters")
    known[key] = value
