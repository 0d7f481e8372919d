"""Files that an attacker would make of a recording: changed in a record's meaning, sums and offsets mended.

A changed byte is mostly caught by a checksum. What is behind the checksums is reached by taking a file
apart into its records, changing one by its meaning, and putting them together again as if it had been
written so: sizes, checksums, the index and the summary fit what is there now.
"""

from __future__ import annotations

import json
import random
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import lz4.frame
import zstandard
from mcap.writer import MCAP0_MAGIC

from runner.errors import RunnerError
from runner.recording.records import UNREADABLE, attachment_of, metadata_of, unpack_chunk

HEADER, SCHEMA, CHANNEL, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = 1, 3, 4, 6, 7, 8
ATTACHMENT, ATTACHMENT_INDEX, METADATA, METADATA_INDEX, DATA_END, FOOTER = 9, 10, 12, 13, 15, 2

_MOST_CONTENT = 4 << 20
Bytes = Callable[[bytes], bytes]
"""Changes some bytes, somehow."""

NUMBERS = [0, 1, 2, 7, 127, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1, 2**64 - 1]
VALUES: list[Any] = [
    *(None, True, -1, 0, 1, 2**31, 2**63, 10**30, 1e308, -0.5, float("nan"), float("inf")),
    *("", "x", "../../etc/passwd", "\0", "9" * 5000, "\ud800", "1" * 20),
    *([], {}, [[]], [1, 2, 3], [None] * 40, {"a": {}}, [0] * 1000),
]


@dataclass
class Record:
    """A record: what kind it is, and its body."""

    opcode: int
    body: bytes


def split(data: bytes) -> list[Record]:
    """Return the records of a file's data section, as far as they are whole."""
    records, at = [], len(MCAP0_MAGIC)
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if opcode in (0, DATA_END) or length > len(data) - at - 9:
            break
        records.append(Record(opcode, data[at + 9 : at + 9 + length]))
        at += 9 + length
    return records


def join(records: list[Record], finished: bool = True) -> bytes:
    """Return the file of these records; with an index, a summary and checksums that fit."""
    file = bytearray(MCAP0_MAGIC)
    offsets = []
    for record in records:
        offsets.append(len(file))
        file += struct.pack("<BQ", record.opcode, len(record.body)) + record.body
    if not finished:
        return bytes(file)
    file += struct.pack("<BQI", DATA_END, 4, zlib.crc32(file))
    start = len(file)
    for k, (record, offset) in enumerate(zip(records, offsets, strict=True)):
        body = record.body if record.opcode in (SCHEMA, CHANNEL) else index_entry(records, offsets, k, offset)
        opcode = {CHUNK: CHUNK_INDEX, METADATA: METADATA_INDEX, ATTACHMENT: ATTACHMENT_INDEX}
        if body:
            file += struct.pack("<BQ", opcode.get(record.opcode, record.opcode), len(body)) + body
    end = len(file)
    footer = struct.pack("<BQQQ", FOOTER, 20, start, end)
    crc = zlib.crc32(footer, zlib.crc32(memoryview(file)[start:]))
    return bytes(file) + footer + struct.pack("<I", crc) + MCAP0_MAGIC


def index_entry(records: list[Record], offsets: list[int], k: int, offset: int) -> bytes:
    """Return the entry of a record in the summary; nothing if the record is too damaged."""
    opcode, body = records[k].opcode, records[k].body
    length = 9 + len(body)
    try:
        if opcode == CHUNK:
            start, end, size, _, name = struct.unpack_from("<QQQII", body)
            following = records[k + 1] if k + 1 < len(records) else Record(0, b"")
            indexed = following.opcode == MESSAGE_INDEX and len(following.body) >= 2
            places = following.body[:2] + struct.pack("<Q", offsets[k + 1]) if indexed else b""
            head = struct.pack("<QQQQI", start, end, offset, length, len(places)) + places
            head += struct.pack("<QI", 9 + len(following.body) if indexed else 0, name)
            return head + body[32 : 32 + name] + struct.pack("<QQ", len(body) - 40 - name, size)
        at = {METADATA: 0, ATTACHMENT: 16}.get(opcode)
        if at is None:
            return b""
        (size,) = struct.unpack_from("<I", body, at)
        name = body[at : at + 4 + size]
    except (struct.error, IndexError):
        return b""
    place = struct.pack("<QQ", offset, length)
    return place + name if opcode == METADATA else place + bytes(24) + name + struct.pack("<I", 0)


def mutate(data: bytes, rng: random.Random, change: Bytes) -> bytes:
    """Return the file changed in one or a few places."""
    if rng.random() < 0.2:
        return change(data)
    records = split(data)
    if not records:
        return change(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        _change_records(records, rng, change)
    whole = join(records, finished=rng.random() < 0.7)
    if rng.random() < 0.1:
        return whole[: rng.randrange(len(whole))]
    return change(whole) if rng.random() < 0.05 else whole


def _change_records(records: list[Record], rng: random.Random, change: Bytes) -> None:
    """Change one record, or the order of records."""
    k = _choose(records, rng)
    record = records[k]
    way = rng.random()
    if way < 0.08:
        del records[k]
    elif way < 0.14:
        records.insert(rng.randrange(len(records) + 1), Record(record.opcode, record.body))
    elif way < 0.18:
        other = rng.randrange(len(records))
        records[k], records[other] = records[other], record
    elif way < 0.22:
        record.opcode = rng.randrange(16)
    elif way < 0.35:
        record.body = with_number(record.body, rng)
    elif way < 0.45:
        record.body = change(record.body)
    else:
        record.body = _changed_by_meaning(record, rng, change)
    if not records:
        records.append(record)


def _choose(records: list[Record], rng: random.Random) -> int:
    """Return the place of a record; each kind is as likely, there are many chunks and one header."""
    kinds = sorted({record.opcode for record in records})
    kind = rng.choice(kinds + [kind for kind in kinds if kind in (CHUNK, METADATA, ATTACHMENT)] * 2)
    return rng.choice([k for k, record in enumerate(records) if record.opcode == kind])


def _changed_by_meaning(record: Record, rng: random.Random, change: Bytes) -> bytes:
    ways = {CHUNK: _chunk, METADATA: _metadata, ATTACHMENT: _attachment}
    if record.opcode not in ways:
        return with_number(record.body, rng)
    try:
        return ways[record.opcode](record.body, rng, change)
    except (RunnerError, RecursionError, zstandard.ZstdError, *UNREADABLE):
        return change(record.body)  # it was changed before and has no meaning any more


def with_number(data: bytes, rng: random.Random) -> bytes:
    """Return the bytes with a boundary value of 1 to 8 bytes somewhere in them."""
    if not data:
        return b"\0"
    width = rng.choice((1, 2, 4, 4, 8, 8))
    at = rng.randrange(len(data))
    if rng.random() < 0.5:
        at = min(at, rng.randrange(80))
    number = rng.choice([*NUMBERS, len(data), len(data) + 1, rng.randrange(2**16)]) % 256**width
    return data[:at] + number.to_bytes(width, "little") + data[at + width :]


def chunk_body(content: bytes, compression: str, times: bytes = bytes(16), size: int | None = None) -> bytes:
    """Return the body of a chunk with this content and a checksum that fits."""
    packed = content
    if compression == "zstd":
        packed = zstandard.ZstdCompressor(level=1).compress(content)
    elif compression == "lz4":
        packed = lz4.frame.compress(content)
    name = compression.encode()
    head = struct.pack("<QII", len(content) if size is None else size, zlib.crc32(content), len(name))
    return times + head + name + struct.pack("<Q", len(packed)) + packed


def _chunk(body: bytes, rng: random.Random, change: Bytes) -> bytes:
    """Change the messages in a chunk, a field at a time more often than anywhere."""
    head, content = unpack_chunk(body, "chunk")
    way = rng.random()
    if way < 0.35:
        content = change(content)
    elif way < 0.7 and len(content) > 31:
        first = 9 + min(struct.unpack_from("<Q", content, 1)[0], len(content))
        at = rng.randrange(0, len(content), max(first, 31))
        content = content[:at] + with_number(content[at:], rng)
    elif way < 0.8:
        content = content[: rng.randrange(len(content) + 1)]
    elif way < 0.9:
        content *= rng.choice((2, 3, 100))
    else:
        content = bytes(rng.choice((1, 31, 1000, 1 << 20)))
    content = content[:_MOST_CONTENT]  # who makes it is measured as well as who reads it
    compression = head.compression if rng.random() < 0.5 else rng.choice(("zstd", "lz4", ""))
    return chunk_body(content, compression, body[:16])


def metadata_body(name: str, entries: dict[str, str]) -> bytes:
    """Return the body of a metadata record."""
    mapping = b"".join(_text(key) + _text(value) for key, value in entries.items())
    return _text(name) + struct.pack("<I", len(mapping)) + mapping


def _text(text: str) -> bytes:
    encoded = text.encode("utf-8", "surrogatepass")
    return struct.pack("<I", len(encoded)) + encoded


def _metadata(body: bytes, rng: random.Random, change: Bytes) -> bytes:
    name, entries = metadata_of(body)
    key = rng.choice(sorted(entries) or ["json"])
    if key == "json" and rng.random() < 0.8:
        entries[key] = json.dumps(with_value(json.loads(entries[key]), rng))
    elif rng.random() < 0.2:
        entries.pop(key, None)
    else:
        entries[key] = str(rng.choice([*VALUES, *NUMBERS]))
    return metadata_body(name, entries)


def attachment_body(name: str, data: bytes) -> bytes:
    """Return the body of an attachment with a checksum that fits."""
    body = bytes(16) + _text(name) + _text("application/octet-stream") + struct.pack("<Q", len(data)) + data
    return body + struct.pack("<I", zlib.crc32(body))


def _attachment(body: bytes, rng: random.Random, change: Bytes) -> bytes:
    name, _, data = attachment_of(body, 0)
    if name.endswith(".json"):
        description = json.loads(data)
        return attachment_body(name, json.dumps(with_value(description, rng)).encode())
    if rng.random() < 0.9 and name.endswith(".zst"):
        array = zstandard.ZstdDecompressor(max_window_size=1 << 23).stream_reader(data).read(1 << 20)
        array = with_number(array, rng) if rng.random() < 0.5 else change(array)
        return attachment_body(name, zstandard.ZstdCompressor().compress(array))
    return attachment_body(name, change(data))


def with_value(value: Any, rng: random.Random) -> Any:
    """Return the JSON value with another one somewhere in it."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(sorted(value))
        if rng.random() < 0.1:
            return {k: v for k, v in value.items() if k != key}
        return value | {key: with_value(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.8:
        k = rng.randrange(len(value))
        return [*value[:k], with_value(value[k], rng), *value[k + 1 :]]
    return rng.choice(VALUES)
