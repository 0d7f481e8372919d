"""Copies of recordings: with other metadata, or in fewer chunks; comparison and digests of whole recordings.

While a loop runs, each topic gets a chunk twice a second, so that a kill loses less than a second. Of actions
alone these hold a few hundred bytes, and their heads and index entries take as much again: such a recording
is written again in few chunks when it is complete.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.digest import ContentHash, combined_digest
from runner.recording.extras import ExtraNames
from runner.recording.integrity import check_up_to_cut
from runner.recording.layout import lone_message
from runner.recording.messages import encode
from runner.recording.pipeline import MessageBatches
from runner.recording.reader import Recording, open_recording
from runner.recording.recorder import BLOCK_BYTES
from runner.recording.records import (
    MetadataRecord,
    RawRecord,
    ReadChunk,
    Record,
    encode_chunk,
    read_record,
    walk,
)
from runner.recording.schema import Topic
from runner.recording.steps import packed
from runner.recording.writer import RecordingFile
from runner.util.arrays import Unsigned, in_blocks
from runner.util.files import open_regular, replacing
from runner.util.packing import Packing

Change = Callable[[str, dict[str, str]], dict[str, str] | None]
"""Takes the name and entries of a metadata record; returns its new entries, or None to leave it out."""


def rewrite(
    path: Path,
    fresh: Path,
    change: Change,
    more: Mapping[str, Mapping[str, str]] | None = None,
    left_out: Collection[str] = (),
    add: Callable[[RecordingFile], None] = lambda _: None,
) -> None:
    """Write a recording into a new file with its metadata changed.

    A recording that was cut off is written up to its last whole chunk; the new file has an index and a
    summary, but no result either.

    Args:
        change: what becomes of each metadata record.
        more: metadata records to add, by name.
        left_out: the names of attachments and topics to leave out.

    Raises:
        OSError: the new file exists or cannot be written.
    """
    result = None

    def transform(record: Record) -> Record | None:
        nonlocal result
        if isinstance(record, MetadataRecord):
            changed = change(*record)
            if record.name == "result":
                result, changed = changed, None
            return None if changed is None else record._replace(entries=changed)
        name = record.topic.name if isinstance(record, ReadChunk) else record.name
        return None if name in left_out else record

    check_up_to_cut(path)
    with open_recording(path) as recording:
        layout = recording.layout
    with RecordingFile(fresh, layout) as file:
        copy(path, transform, file)
        add(file)
        for name, added in (more or {}).items():
            file.add_metadata(name, added)
        file.finish(result)


def copy(path: Path, transform: Callable[[Record], Record | None], into: RecordingFile) -> None:
    """Append the records of a recording to another one, as they are transformed; None leaves one out."""
    names = ExtraNames(str(path))
    for record in whole_records(path):
        if isinstance(record, ReadChunk) and record.topic is schema.EXTRA_COLUMNS_TOPIC:
            names.take(record)
            names.declare(into)
        if (transformed := transform(record)) is not None:
            into.copy(transformed)


def content_of(path: Path) -> str:
    """Return the content digest of a recording, after checking every checksum and every message.

    If the recording states a digest, it must be the same. The digest of a killed run covers its whole chunks.

    Raises:
        RecordingError: it is damaged, or states another digest than its messages have.
    """
    check_up_to_cut(path)
    with open_recording(path) as recording:
        found = content_hash(recording).topics()
        result = recording.result
    if result.content_digest is None:
        return combined_digest(found)
    stated = dict(result.topic_digests)
    if not result.steps_recorded:  # of these only the digests are there
        found |= {name: stated[name] for name in schema.STEP_TOPICS if name in stated}
    if found != stated or combined_digest(found) != result.content_digest:
        raise RecordingError(
            f"{path}: found messages of other content than the digest it states; it was altered."
        )
    return result.content_digest


def content_hash(recording: Recording) -> ContentHash:
    """Return the digests of a recording's messages."""
    seen = ContentHash()
    for topic in recording.topics:
        if topic.digested:
            for records in recording.table(topic).records():
                seen.update(topic, records)
    return seen


def continues(path: Path, earlier: Path) -> bool:
    """Return whether a recording begins with all messages of another one of the same job.

    Only topics that the digest covers are compared, byte for byte.
    """
    for checked in (path, earlier):
        check_up_to_cut(checked)
    with open_recording(path) as later, open_recording(earlier) as before:
        if later.run != before.run:
            return False
        expected = content_hash(before)
        seen = ContentHash()
        for topic in before.topics:
            table = before.table(topic)
            left = sum(table.entry(k).uncompressed_size for k in range(len(table)))
            if left and topic.digested:
                for records in later.table(topic).records():
                    seen.update(topic, memoryview(records)[:left])
                    left -= min(left, len(records))
                    if not left:
                        break
    return seen.topics() == expected.topics()


def whole_records(path: Path) -> Iterator[Record]:
    """Yield the metadata, attachments and chunks of a recording, up to where the file may be cut off.

    Raises:
        RecordingError: one is damaged.
    """
    with open_regular(path) as stream:
        for raw in walk(stream, path.stat().st_size):
            if not isinstance(record := read_record(raw), RawRecord):
                yield record


_SMALL: Final = 1 << 16
"""Chunks of more bytes, unpacked, are not put together with others."""


def compacted(file: RecordingFile, packing: Packing) -> tuple[RecordingFile, dict[str, int]]:
    """Return a recording in place of one that is complete but for its result, and its messages with actions.

    Metadata, attachments and all messages are the same, but that more actions share a message.

    Args:
        file: the recording; it is closed.
        packing: how chunks are packed, and the most steps whose actions share a message.

    Raises:
        OSError: the new recording cannot be written; the old one is as before.
        RecordingError: the old one was damaged meanwhile, so the new one would lack messages; it stays.
    """
    with open_recording(file.path) as recording:
        layout = recording.layout
    packing = replace(packing, values=not layout.has_states)
    with replacing(file.path) as path:
        fresh = RecordingFile(path, layout)
        try:
            messages = _compact(file, fresh, packing)
        except BaseException:
            fresh.close()
            raise
    fresh.path = file.path
    file.close()
    return fresh, messages


def _compact(file: RecordingFile, fresh: RecordingFile, packing: Packing) -> dict[str, int]:
    """Write a recording into a new file; return how many messages with actions it has, by topic."""

    def write(topic: Topic, records: bytes | memoryview, times: Unsigned, offsets: Unsigned) -> None:
        fresh.add_chunk(encode_chunk(topic, records, times, offsets, packing))

    batches = MessageBatches(write)
    messages = {}
    read = Counter[str]()

    def in_batches(record: Record) -> Record | None:
        if not isinstance(record, ReadChunk):
            return record
        read[record.topic.name] += len(record.times)
        if record.topic.message is schema.ACTIONS:
            return None
        if record.topic is schema.EXTRA_COLUMNS_TOPIC:  # before the extras that have these names
            return record
        if len(record.records) > _SMALL:
            batches.flush_topic(record.topic)
            return record
        batches.add(record.topic, record.times.tolist(), record.messages)
        return None

    copy(file.path, in_batches, fresh)
    batches.flush()
    _require_same(file.path, read, file.message_counts)
    with open_recording(file.path) as recording:
        for phase in recording.phases:
            topic = phase.steps.actions.topic
            steps = 0
            messages[topic.name] = 0
            most = min(packing.chunk_steps, max(1, BLOCK_BYTES // phase.steps.row_dtype.itemsize))
            for rows in in_blocks(phase.steps.rows() if phase.steps.are_actions else (), most):
                payload = encode(schema.ACTIONS, packed(rows, recording.environments))
                write(topic, *lone_message(topic, int(rows["log_time"][-1]), payload))
                messages[topic.name] += 1
                steps += len(rows)
            _require_same(file.path, {topic.name: steps}, {topic.name: phase.steps.total()})
    _require_same(file.path, fresh.message_counts, file.message_counts | messages)
    return messages


def _require_same(path: Path, found: Mapping[str, int], expected: Mapping[str, int]) -> None:
    """Compare how many messages, or steps, of each topic a copy has with how many its original has."""
    for name, count in expected.items():
        if found.get(name, 0) != count:
            raise RecordingError(
                f"{path}: {name}: found {found.get(name, 0):,} to copy, expected {count:,}; it was altered "
                "while it was recorded, and stays as it is."
            )
