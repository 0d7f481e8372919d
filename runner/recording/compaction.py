"""A recording of actions alone, written again in few chunks when it is complete.

While a loop runs, each topic gets a chunk twice a second, so that a kill loses less than a second. Of actions
alone these hold a few hundred bytes, and their heads and index entries take as much again.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.recording import schema
from runner.recording.actions import Rows, kept_dtype, packed, unpacked
from runner.recording.blocks import HEADER_BYTES, message_record
from runner.recording.chunks import encode_chunk
from runner.recording.messages import decode, encode
from runner.recording.pipeline import MessageBatches
from runner.recording.recorder import BLOCK_BYTES
from runner.recording.records import ReadChunk
from runner.recording.rewriting import whole_records
from runner.recording.schema import Topic
from runner.recording.writer import RecordingFile
from runner.util.files import replacing
from runner.util.packing import Packing

_SMALL: Final = 1 << 16
"""Chunks of more bytes, unpacked, are not put together with others."""


class _Compaction:
    """Writes the chunks of one recording into another.

    Args:
        packing: how chunks are packed, and the most steps whose actions share a message.
        steps: the dtype of whole steps, by the topic of their actions.
    """

    def __init__(
        self,
        file: RecordingFile,
        packing: Packing,
        steps: Mapping[Topic, np.dtype[np.void]],
        environments: int,
    ) -> None:
        self._file, self._packing, self._n = file, packing, environments
        self._kept = {topic: kept_dtype(dtype) for topic, dtype in steps.items()}
        self._rows: dict[Topic, list[Rows]] = defaultdict(list)
        self._batches = MessageBatches(self._write)
        self.messages: dict[str, int] = {topic.name: 0 for topic in steps}
        """Messages with actions written so far, by topic."""

    def take(self, chunk: ReadChunk) -> None:
        """Take a chunk of the old recording."""
        topic = chunk.topic
        if topic not in self._kept and len(chunk.records) > _SMALL:
            self._batches.flush_topic(topic)
            self._write(topic, chunk.records, chunk.times, chunk.offsets)
            return
        if topic not in self._kept:
            self._batches.add(topic, chunk.times.tolist(), chunk.messages)
            return
        for record in chunk.messages:
            fields = decode(topic.message, record[HEADER_BYTES:])
            self._rows[topic].append(unpacked(fields, self._kept[topic], self._n, topic.name))
        limit = min(self._packing.chunk_steps, max(1, BLOCK_BYTES // self._kept[topic].itemsize))
        if sum(map(len, self._rows[topic])) >= limit:
            rows = np.concatenate(self._rows[topic])
            whole = len(rows) // limit * limit
            for start in range(0, whole, limit):
                self._write_actions(topic, rows[start : start + limit])
            self._rows[topic] = [rows[whole:]]

    def finish(self) -> None:
        """Write what is still waiting."""
        for topic, rows in self._rows.items():
            if sum(map(len, rows)):
                self._write_actions(topic, np.concatenate(rows))
        self._batches.flush()

    def _write_actions(self, topic: Topic, rows: Rows) -> None:
        log_time = rows["log_time"][-1:].astype(np.uint64)
        record = message_record(topic, int(log_time[0]), encode(schema.ACTIONS, packed(rows, self._n)))
        self._write(topic, record, log_time, np.zeros(1, np.uint64))
        self.messages[topic.name] += 1

    def _write(
        self,
        topic: Topic,
        records: bytes | memoryview,
        times: NDArray[np.uint64],
        offsets: NDArray[np.uint64],
    ) -> None:
        self._file.add_chunk(encode_chunk(topic, records, times, offsets, self._packing))


def compacted(
    file: RecordingFile, packing: Packing, steps: Mapping[Topic, np.dtype[np.void]], environments: int
) -> tuple[RecordingFile, dict[str, int]]:
    """Return a recording in place of one that is complete but for its result, and its messages with actions.

    Metadata, attachments and all messages are the same, but that more actions share a message.

    Args:
        file: the recording; it is closed.
        steps: the dtype of whole steps, by the topic of their actions.

    Raises:
        OSError: the new recording cannot be written; the old one is as before.
    """
    with replacing(file.path) as path:
        fresh = RecordingFile(path, file.topics)
        try:
            writing = _Compaction(fresh, packing, steps, environments)
            for record in whole_records(file.path):
                if isinstance(record, ReadChunk):
                    writing.take(record)
                else:
                    fresh.copy(record)
            writing.finish()
        except BaseException:
            fresh.close()
            raise
    fresh.path = file.path
    file.close()
    return fresh, writing.messages
