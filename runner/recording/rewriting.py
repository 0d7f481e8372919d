"""Copies of recordings with other metadata; content digests and comparison of whole recordings."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.digest import ContentHash, combined_digest
from runner.recording.extras import ExtraNames
from runner.recording.integrity import check_up_to_cut
from runner.recording.reader import Recording, open_recording
from runner.recording.records import (
    MetadataRecord,
    RawRecord,
    ReadChunk,
    Record,
    read_record,
    walk,
)
from runner.recording.writer import RecordingFile
from runner.util.files import open_regular

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
        file.finish("" if result is None else "result", result)


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

    If the recording states a digest, it must be the same; of a killed run, it is that of the whole chunks.

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
