"""Copies of recordings with other metadata; content digests and comparison of whole recordings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path

from runner.errors import RecordingError
from runner.recording.digest import ContentHash, combined_digest
from runner.recording.integrity import check_integrity
from runner.recording.reader import open_recording
from runner.recording.records import (
    MetadataRecord,
    RawRecord,
    ReadChunk,
    Record,
    read_record,
    walk,
)
from runner.recording.run_file import Summary
from runner.recording.schema import ALL_TOPICS, STEP_MESSAGES, Topic
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
    with open_recording(path) as recording:
        topics = recording.topics
    with RecordingFile(fresh, topics) as file:
        for record in whole_records(path):
            if isinstance(record, MetadataRecord):
                changed = change(*record)
                if record.name == "result":
                    result = changed
                elif changed is not None:
                    file.copy(record._replace(entries=changed))
            elif (record.topic if isinstance(record, ReadChunk) else record).name not in left_out:
                file.copy(record)
        add(file)
        for name, added in (more or {}).items():
            file.add_metadata(name, added)
        file.finish("" if result is None else "result", result)


def content_of(path: Path) -> str:
    """Return the content digest of a recording, after checking every checksum and every message.

    If the recording states a digest, it must be the same; of a killed run, it is that of the whole chunks.

    Raises:
        RecordingError: it is damaged, or states another digest than its messages have.
    """
    seen = ContentHash()
    for chunk in _chunks(path):
        seen.update(chunk.topic, chunk.records)
    with open_recording(path) as recording:
        result = recording.result
    if result.content_digest is not None and not _is_stated(result, seen.topics()):
        raise RecordingError(
            f"{path}: found messages of other content than the digest it states; it was altered."
        )
    return result.content_digest or seen.content()


def continues(path: Path, earlier: Path) -> bool:
    """Return whether a recording begins with all messages of another one of the same job.

    Only topics that the digest covers are compared, byte for byte.
    """
    with open_recording(path) as later, open_recording(earlier) as before:
        if later.run != before.run:
            return False
    counts: Counter[Topic] = Counter()
    expected, seen = ContentHash(), ContentHash()
    for chunk in _chunks(earlier):
        expected.update(chunk.topic, chunk.records)
        counts[chunk.topic] += len(chunk.offsets)
    for chunk in _chunks(path):
        shared = min(counts[chunk.topic], len(chunk.offsets))
        counts[chunk.topic] -= shared
        end = len(chunk.records) if shared == len(chunk.offsets) else int(chunk.offsets[shared])
        seen.update(chunk.topic, memoryview(chunk.records)[:end])
    return seen.topics() == expected.topics()


def _is_stated(result: Summary, seen: dict[str, str]) -> bool:
    """Return whether a result states these digests; those of steps that are not recorded are not compared."""
    if not result.steps_recorded:
        steps = {topic.name for topic in ALL_TOPICS if topic.message in STEP_MESSAGES}
        seen = seen | {name: digest for name, digest in result.topic_digests.items() if name in steps}
    return dict(result.topic_digests) == seen and combined_digest(seen) == result.content_digest


def _chunks(path: Path) -> Iterator[ReadChunk]:
    return (record for record in whole_records(path) if isinstance(record, ReadChunk))


def whole_records(path: Path) -> Iterator[Record]:
    """Yield the metadata, attachments and chunks of a recording, up to where the file may be cut off.

    Raises:
        RecordingError: it is damaged.
    """
    with open_recording(path) as recording:
        finished = recording.finished
    if finished:
        check_integrity(path)
    try:
        with open_regular(path) as stream:
            for raw in walk(stream, path.stat().st_size):
                if not isinstance(record := read_record(raw), RawRecord):
                    yield record
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}; `dualtaxi repair` mends it.") from error
