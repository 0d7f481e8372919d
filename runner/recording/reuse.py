"""Packed chunks that are used again where another recording has the same messages: packing takes long.

The other recording is made by its own job alone. Where its messages are, to the byte, those of a chunk that
was packed before, the packed data are taken over instead of packing them again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.index import ChunkEntry
from runner.recording.reader import Recording
from runner.recording.schema import Topic
from runner.recording.topic_chunks import ChunkSpan

_LARGE_SHARE: Final = 0.2
"""The share of all steps from which on one checksum of the whole file is quicker than those of its chunks."""


@dataclass(frozen=True)
class PackedChunks:
    """The chunks of a recording that may be used again; safe to use from several threads."""

    recording: Recording
    """The recording; stays open while they are in use."""
    until: int
    """Log time in nanoseconds from which on messages may differ: later chunks are not used."""
    is_unaltered: bool
    """Whether the file matches its checksum; if not, each chunk is unpacked to compare its own."""

    @classmethod
    def before(cls, recording: Recording, step: int) -> Self | None:
        """Return the chunks of a job before a training step; None if its steps cannot be read.

        They must be packed as the recording that they are used for. Damaged ones are not used.
        """
        try:
            steps = recording.count(schema.TRAIN_STEP)
            for topic in schema.BLOCK_TOPICS:
                recording.chunk_holding(topic, 0)
            after = [block["log_time"][0] for block in recording.blocks(schema.TRAIN_STEP, step, step + 1)]
            is_unaltered = step >= steps * _LARGE_SHARE and recording.has_its_checksum()
        except (RecordingError, OSError):
            return None
        return cls(recording, int(after[0]) if after else 2**64, is_unaltered) if steps else None

    def span(self, topic: Topic, number: int) -> ChunkSpan | None:
        """Return the chunk that holds a message of a fixed-width topic; None if there is none to use."""
        found = self.recording.chunk_holding(topic, number)
        return None if found is None or found.entry.end_time >= self.until else found

    def data(self, entry: ChunkEntry, compression: str, size: int, crc: int) -> memoryview | None:
        """Return the packed data of an undamaged chunk, if its records have this size and checksum."""
        try:
            head, data = self.recording.packed_chunk(entry, unpacked=not self.is_unaltered)
        except RecordingError:
            return None
        found = (head.compression, head.uncompressed_size, head.crc)
        return data if found == (compression, size, crc) else None
