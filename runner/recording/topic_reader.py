"""The topics of a recording: its blocks and messages, read lazily, and its metadata and attachments."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording.chunks import ChunkEntry
from runner.recording.description import RunDescription
from runner.recording.extras import ExtraLayout, read_layouts
from runner.recording.index import read_index
from runner.recording.messages import Scalars, decode_scalars
from runner.recording.metadata import check_file, dtypes_of
from runner.recording.record_store import RecordStore
from runner.recording.records import AttachmentRecord, MetadataRecord
from runner.recording.schema import EXTRA_COLUMNS_TOPIC, SCALAR_TOPIC, STEP_MESSAGES, Topic, topics_of
from runner.recording.steps import Steps
from runner.recording.topic_chunks import ChunkFile, TopicChunks, chunks_by_topic
from runner.util.files import open_regular

_MAX_SCALARS: Final = 8_192


class TopicReader(RunDescription):
    """The file of a recording, opened; a context manager.

    A block is the file's own bytes seen through the dtype of `record_dtype`: no message is parsed by itself.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            self._stream = open_regular(path)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise RecordingError(f"{path}: cannot be read ({reason}).") from error
        self._store = RecordStore(self._stream, str(path))
        try:
            self._index = read_index(self._stream, str(path))
            check_file(self.run, self._index, str(path))
        except OSError as error:
            self.close()
            raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error
        except BaseException:
            self.close()
            raise
        self._tables: dict[Topic, TopicChunks] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._store.close()

    @property
    def finished(self) -> bool:
        """Whether the file was closed properly: it has its index and summary."""
        return self._index.finished

    @property
    def message_counts(self) -> dict[str, int]:
        """The number of messages of each topic, as the summary of a finished recording counts them."""
        return {topic.name: self._index.message_counts.get(topic.channel, 0) for topic in self.topics}

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return os.fstat(self._stream.fileno()).st_size

    def metadata(self, name: str) -> dict[str, str]:
        """Return a metadata record's entries.

        Raises:
            RecordingError: there is none of that name, or it cannot be read.
        """
        place = self._position("metadata", self._index.metadata, name)
        return self._store.named(MetadataRecord, name, *place).entries

    @property
    def metadata_names(self) -> list[str]:
        """The names of the metadata records, in the order of the file."""
        return sorted(self._index.metadata, key=self._index.metadata.__getitem__)

    @property
    def attachment_names(self) -> list[str]:
        """The names of the attachments, in the order of the file."""
        return sorted(self._index.attachments, key=self._index.attachments.__getitem__)

    def attachments(self) -> Iterator[tuple[str, str, bytes]]:
        """Yield name, media type and data of each attachment, in the order of the file."""
        for name in self.attachment_names:
            yield self._store.named(AttachmentRecord, name, *self._index.attachments[name])

    def attachment(self, name: str) -> bytes:
        """Return an attachment's data, after comparing its checksum.

        Raises:
            RecordingError: there is none of that name, or it is damaged.
        """
        place = self._position("attachment", self._index.attachments, name)
        return self._store.named(AttachmentRecord, name, *place).data

    def _position(self, kind: str, places: Mapping[str, tuple[int, int]], name: str) -> tuple[int, int]:
        if name not in places:
            raise RecordingError(
                f"{self.path}: has no {kind} {name!r}; it was cut off, or not written by dualtaxi."
            )
        return places[name]

    @cached_property
    def dtypes(self) -> dict[Topic, np.dtype[np.void]]:
        """The dtype of each fixed-width topic's message records in this recording."""
        return dtypes_of(self.run, str(self.path))

    def topic(self, name: str) -> Topic:
        """Return the topic of that name, such as `/train/step`.

        Raises:
            RecordingError: a recording of its kind has none.
        """
        if name not in self._topics_by_name:
            raise RecordingError(f"{self.path}: has no topic {name!r}: it is of the kind {self.kind!r}.")
        return self._topics_by_name[name]

    def chunk_body(self, entry: ChunkEntry) -> memoryview:
        """Return the body of a chunk's record, still packed; safe to call from several threads.

        Raises:
            RecordingError: there is no such chunk.
        """
        return self._store.chunk_body(entry)

    def scalars(self) -> Iterator[Scalars]:
        """Yield the values that a loop logged, thousands at a time, as columns.

        Raises:
            RecordingError: a message cannot be read.
        """
        scalars = self.table(SCALAR_TOPIC)
        messages = scalars.parsed(bytes)
        while batch := list(islice(messages, _MAX_SCALARS)):
            try:
                yield decode_scalars(batch)
            except RecordingError:
                for _ in scalars.decoded():  # names the message
                    pass
                raise

    def table(self, topic: Topic | str) -> TopicChunks:
        """Return the messages of a topic, or of this recording's own topic of that name: the kinds differ.

        Raises:
            RecordingError: a recording of its kind has no topic of that name.
        """
        own = self.topic(topic) if isinstance(topic, str) else self._topics_by_name.get(topic.name, topic)
        if own not in self._tables:
            lost = self.lost.get(own.name, [])
            dtype = self.dtypes.get(own)
            chunks = self._file, own, self._places[own], dtype, lost
            if own.message in STEP_MESSAGES:
                actions = self.table(topics_of(self.kind, own.phase).actions)
                self._tables[own] = Steps(*chunks, actions=actions)
            else:
                self._tables[own] = TopicChunks(*chunks)
        return self._tables[own]

    @cached_property
    def extra_layouts(self) -> list[ExtraLayout]:
        """The names of extras, from when on; each entry has those of the one before it."""
        columns = self.table(EXTRA_COLUMNS_TOPIC).decoded()
        return read_layouts(((fields["log_time"], fields["json"]) for fields in columns), str(self.path))

    @cached_property
    def _file(self) -> ChunkFile:
        return ChunkFile(str(self.path), self._index.chunks, self._store, len(self.agents), self.environments)

    @cached_property
    def _places(self) -> Mapping[Topic, NDArray[np.intp]]:
        """The numbers of the chunks of the file that hold each topic."""
        return chunks_by_topic(self._index, self._store, str(self.path))

    @cached_property
    def _topics_by_name(self) -> Mapping[str, Topic]:
        """The topics that a recording of its kind has, by name."""
        return {topic.name: topic for topic in self.topics}
