"""A recording of actions alone, written again in few chunks when it is complete.

While a loop runs, each topic gets a chunk twice a second, so that a kill loses less than a second. Of actions
alone these hold a few hundred bytes, and their heads and index entries take as much again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.actions import packed
from runner.recording.blocks import lone_message
from runner.recording.messages import encode
from runner.recording.pipeline import MessageBatches
from runner.recording.reader import open_recording
from runner.recording.recorder import BLOCK_BYTES
from runner.recording.records import ReadChunk, Record, encode_chunk
from runner.recording.rewriting import copy
from runner.recording.schema import Topic
from runner.recording.writer import RecordingFile
from runner.util.arrays import Unsigned, in_blocks
from runner.util.files import replacing
from runner.util.packing import Packing

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
