"""Packed chunks that are used again where another recording has the same messages: packing takes long.

The other recording is made by its own job alone. Where its messages are, to the byte, those of a chunk that
was packed before, the packed data are taken over instead of packing them again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.reader import Recording
from runner.recording.records import ChunkEntry, chunk_head, decompress
from runner.recording.schema import Topic
from runner.recording.topic_chunks import ChunkSpan


@dataclass(frozen=True)
class PackedChunks:
    """The chunks of a recording that may be used again; safe to use from several threads."""

    recording: Recording
    """The recording; stays open while they are in use."""
    until: int
    """Log time in nanoseconds from which on messages may differ: later chunks are not used."""

    @classmethod
    def before(cls, recording: Recording, step: int) -> Self | None:
        """Return the chunks of a job before a training step; None if its steps cannot be read.

        They must be packed as the recording that they are used for. Damaged ones are not used.
        """
        try:
            steps = recording.train.steps.count()
            for topic in schema.BLOCK_TOPICS:
                recording.table(topic).holding(0)
            after = [block["log_time"][0] for block in recording.train.steps.blocks(step, step + 1)]
        except (RecordingError, OSError):
            return None
        return cls(recording, int(after[0]) if after else 2**64) if steps else None

    def span(self, topic: Topic, number: int) -> ChunkSpan | None:
        """Return the chunk that holds a message of a fixed-width topic; None if there is none to use."""
        span = self.recording.table(topic).holding(number)
        return None if span is None or span.entry.end_time >= self.until else span

    def data(self, entry: ChunkEntry, compression: str, records: bytes | memoryview) -> memoryview | None:
        """Return the packed data of a chunk if they are packed so, and unpack to these records.

        They are unpacked, whatever checksums the file has: its maker may have written any.
        """
        where = self.recording.file.where(entry)
        try:
            body = self.recording.file.chunk_body(entry)
            head = chunk_head(body, len(body), where)
            if (head.compression, head.uncompressed_size) != (compression, len(records)):
                return None
            data = body[head.data_at :]
            unpacked = decompress(data, compression, len(records), where)
        except RecordingError:
            return None
        return data if unpacked.startswith(records) else None  # of one size: equal, compared without a copy
