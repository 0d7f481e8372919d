"""The chunks of one topic in an open recording: its messages by number or time, in blocks or one by one."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.blocks import HEADER_BYTES, RECORD_HEAD, record_dtype, row_dtype, rows_of
from runner.recording.chunks import MAX_CHUNK_BYTES, ChunkEntry
from runner.recording.index import ChunkTable, Index
from runner.recording.messages import Message, decode, decode_rows
from runner.recording.record_store import RecordStore
from runner.recording.records import checked_messages
from runner.recording.schema import TOPIC_OF, MessageType, Topic

M = TypeVar("M")
FOREVER: Final = 2**63 - 1
"""A time in nanoseconds that no message has."""
_ROWS: Final = 1024
_ROWS_BYTES: Final = 16 << 20
"""The most messages of varying size in a block of `rows`, and the bytes of values with which one ends."""


def channels_of(index: Index, store: RecordStore, path: str) -> NDArray[np.uint16]:
    """Return the channel of each chunk of a file."""
    table = index.chunks
    channels = table.columns["channel"].copy()
    for k in np.flatnonzero(channels == 0).tolist():  # the file was cut off before the chunk's index
        channels[k] = store.first_channel(table[k])
    for k in np.flatnonzero(~np.isin(channels, list(index.channels))).tolist():
        raise _damaged(
            path, table[k], f"messages of channel {channels[k]}, which the recording does not have"
        )
    return channels


class ChunkSpan(NamedTuple):
    """A chunk, and the messages of its topic that it holds, by number."""

    first: int
    stop: int
    """The number after that of its last message."""
    entry: ChunkEntry


@dataclass(frozen=True, eq=False)
class ChunkFile:
    """What the topics of a recording share."""

    path: str
    chunks: ChunkTable
    store: RecordStore
    environments: int
    """How many environments take turns."""


@dataclass(eq=False)
class TopicChunks:
    """The chunks of a topic, in order.

    Messages are numbered as recorded; where a repair lost some, the numbers continue after the gap.
    """

    file: ChunkFile
    topic: Topic
    places: NDArray[np.intp]
    """The chunks of the file that hold it, by number."""
    message: MessageType
    """The type of its messages in this run."""
    lost: Sequence[Sequence[int]] = ()
    """Ranges (first, stop) of the numbers of messages that a repair could not save."""
    max_bytes: int = MAX_CHUNK_BYTES
    """The largest message that is parsed unless another limit is given."""
    unknown: dict[str, float] = field(default_factory=dict)
    """Fields that the recording's version did not have, with what stands for them."""
    _last: tuple[int, NDArray[np.void]] = field(default=(-1, np.empty(0, np.void)), init=False)
    """The number of a chunk that was checked last, and its messages."""

    def __len__(self) -> int:
        return len(self.places)

    @cached_property
    def dtype(self) -> np.dtype[np.void] | None:
        """The dtype of a message record in the file; None if messages vary in size."""
        return record_dtype(self.message)

    @cached_property
    def row_dtype(self) -> np.dtype[np.void]:
        """The dtype of `rows`."""
        return row_dtype(self.message)

    def entry(self, k: int) -> ChunkEntry:
        """Return the entry of chunk number k in the file's table."""
        return self.file.chunks[int(self.places[k])]

    def count(self) -> int:
        """Return the number after that of the last message, or how many there are if they have none."""
        if self.dtype is None:
            if self.topic.message in schema.NUMBERED_BY:
                last = self.last()
                return 0 if last is None else int(last[self._number]) + 1
            return sum(len(self._checked(k)[1]) for k in range(len(self)))
        _, ends = self._numbers
        return int(ends[-1]) if len(ends) else 0

    def holding(self, number: int) -> ChunkSpan | None:
        """Return the chunk that holds a message of fixed width; None if there is none."""
        firsts, ends = self._numbers
        k = int(np.searchsorted(ends, number, side="right"))
        is_held = k < len(ends) and firsts[k] <= number
        return ChunkSpan(int(firsts[k]), int(ends[k]), self.entry(k)) if is_held else None

    def blocks(self, start: int = 0, stop: int | None = None) -> Iterator[NDArray[np.void]]:
        """Yield the messages number `start` up to `stop`, a chunk at a time; they must have one size."""
        return (self._rows_in(block) for block in self.stored(start, stop))

    def stored(self, start: int = 0, stop: int | None = None) -> Iterator[NDArray[np.void]]:
        """Yield what `blocks` does as it is stored: message records."""
        firsts, ends = self._numbers
        stop = int(ends[-1]) if stop is None and len(ends) else (stop or 0)
        begin, end = np.searchsorted(ends, start, side="right"), np.searchsorted(firsts, stop, side="left")
        for k, block in self._blocks_of(range(int(begin), int(end))):
            first = int(firsts[k])
            yield block[max(start - first, 0) : stop - first]

    def array(self, start: int = 0, stop: int | None = None) -> NDArray[np.void]:
        """Return the messages number `start` up to `stop` as one array; they must have one size."""
        blocks = list(self.blocks(start, stop))
        return np.concatenate(blocks) if blocks else np.empty(0, self.row_dtype)

    def records(self) -> Iterator[bytes]:
        """Yield the message records of each chunk, as they are in the file."""
        return self.file.store.chunks(map(self.entry, range(len(self))))

    def rows(self, times: range | None = None) -> Iterator[NDArray[np.void]]:
        """Yield the messages as records in blocks, also those that vary in size.

        Values of varying size are objects: the bytes that `spaces.decode` takes.

        Args:
            times: their `log_time` in ns, from the first to before the last; None for all.

        Raises:
            RecordingError: they are damaged.
        """
        if self.dtype is None:
            return self._decoded_rows(times=times)
        return self.blocks() if times is None else self._blocks_between(times)

    def numbered(self, numbers: range) -> Iterator[NDArray[np.void]]:
        """Yield the messages of these numbers in blocks, as `rows` does."""
        for block in self._blocks_from(numbers.start, numbers.stop) if numbers else ():
            first = int(block[self._number][0])
            if first >= numbers.stop:
                return
            rows = block[max(numbers.start - first, 0) : numbers.stop - first]
            if len(rows):
                yield rows

    def rows_between(self, field: str, start: int, stop: int | None) -> Iterator[NDArray[np.void]]:
        """Yield the messages with values from `start` to before `stop` in a field that never decreases.

        They come in blocks, as `rows` yields them; `stop` is None for all that follow.
        """
        for k in self.chunks_from(field, start):
            rows = self._rows_of(k)
            low = int(np.searchsorted(rows[field], start))
            high = len(rows) if stop is None else int(np.searchsorted(rows[field], stop))
            if low < high:
                yield rows[low:high]
            if high < len(rows):
                return

    def one(self, number: int) -> np.void:
        """Return a message by its number, as `rows` does.

        Raises:
            RecordingError: it was lost.
        """
        for rows in self.numbered(range(number, number + 1)):
            row: np.void = rows[0]
            return row
        raise RecordingError(f"{self.file.path}: {self.topic.name}: number {number:,} was lost.")

    def last(self) -> np.void | None:
        """Return the last message, as `rows` does; None if there is none."""
        if not self:
            return None
        number = len(self) - 1
        if self.dtype is not None:
            message: np.void = self._rows_of(number)[-1]
        else:  # decoding the whole chunk would take long
            data, times, offsets = self._checked(number)
            message = self._decoded([(int(times[-1]), data[int(offsets[-1]) + HEADER_BYTES :])])[0]
        return message

    def _blocks_from(self, start: int, stop: int) -> Iterator[NDArray[np.void]]:
        """Yield blocks as `rows` does, the first of which begins with message number `start` or before it."""
        if self.dtype is not None:
            return self.blocks(start, stop)
        return map(self._rows_of, self.chunks_from(self._number, start))  # none is missing within a chunk

    def chunks_from(self, field: str, value: int) -> range:
        """Return the chunks from the last that begins below a value of a field that never decreases."""
        k = bisect_left(range(len(self)), value, key=lambda k: self._first_of(k)[field])
        return range(max(k - 1, 0), len(self))

    def _first_of(self, k: int) -> Any:
        """Return the first message of chunk number k."""
        if self.dtype is None:
            return next(self.decoded(chunks=[k]))
        return self._rows_of(k)[0]

    def _rows_of(self, k: int) -> NDArray[np.void]:
        """Return the messages of chunk number k as records."""
        if self.dtype is not None:
            return self._rows_in(next(self._blocks_of([k]))[1])
        number, rows = self._last
        if number != k:
            rows = np.concatenate(list(self._decoded_rows(chunks=[k])))
            self._last = k, rows
        return rows

    @property
    def _number(self) -> str:
        """The field that numbers the messages."""
        return schema.NUMBERED_BY[self.topic.message]

    def _decoded_rows(
        self, times: range | None = None, chunks: Sequence[int] | None = None
    ) -> Iterator[NDArray[np.void]]:
        size = 0
        messages: list[tuple[int, bytes]] = []
        for message in self.messages(times, chunks):
            messages.append(message)
            size += len(message[1])
            if len(messages) == _ROWS or size > _ROWS_BYTES:
                yield self._decoded(messages)
                messages, size = [], 0
        if messages:
            yield self._decoded(messages)

    def _decoded(self, messages: Sequence[tuple[int, bytes]]) -> NDArray[np.void]:
        """Return messages of varying size as rows.

        Raises:
            RecordingError: one cannot be read; it is named.
        """
        try:
            return decode_rows(self.message, messages)
        except RecordingError as error:
            if len(messages) == 1:
                raise self._unreadable(messages[0][0], error) from error
            for message in messages:
                self._decoded([message])
            raise

    def _unreadable(self, time: int, error: RecordingError) -> RecordingError:
        return RecordingError(f"{self.file.path}: {self.topic.name} at {time} ns: {error}")

    def _rows_in(self, block: NDArray[np.void]) -> NDArray[np.void]:
        """Return message records of one size as rows.

        Raises:
            RecordingError: they have a value that its space does not have.
        """
        try:
            return rows_of(self.message, block)
        except RecordingError as error:
            raise self._unreadable(int(block["log_time"][0]), error) from error

    def _blocks_between(self, times: range) -> Iterator[NDArray[np.void]]:
        start, stop = _log_times(times)
        for _, block in self._blocks_of(self._overlapping(times)):
            low, high = (int(np.searchsorted(block["log_time"], time)) for time in (start, stop))
            if low < high:
                yield self._rows_in(block[low:high])

    def _overlapping(self, times: range, chunks: Sequence[int] | None = None) -> list[int]:
        """Return those of some chunks, by default of all, that may have messages of these times."""
        numbers = np.array(range(len(self)) if chunks is None else chunks, np.intp)
        start, stop = _log_times(times)
        spans = self.file.chunks.columns[self.places[numbers]]
        overlapping: list[int] = numbers[(spans["end_time"] >= start) & (spans["start_time"] < stop)].tolist()
        return overlapping

    def first_from(self, field: str, value: int) -> int:
        """Return the number of the first message of that value or more in a field that never decreases."""
        for place in self.chunks_from(field, value)[:2]:
            rows = self._rows_of(place)
            at = int(np.searchsorted(rows[field], value))
            if at < len(rows):
                return int(rows[self._number][at] if self.dtype is None else self._numbers[0][place] + at)
        return self.count()

    def messages(
        self, times: range | None = None, chunks: Sequence[int] | None = None
    ) -> Iterator[tuple[int, bytes]]:
        """Yield (log time in nanoseconds, payload) of the messages.

        Args:
            times: of the log times, from the first to before the last; None for all.
            chunks: the numbers of the chunks to read; None for all.
        """
        if times is not None:
            chunks = self._overlapping(times, chunks)
        for k in range(len(self)) if chunks is None else chunks:
            data, log_times, offsets = self._checked(k)
            edges = pairwise([*offsets.tolist(), len(data)])
            for log_time, (start, stop) in zip(log_times.tolist(), edges, strict=True):
                if times is None or log_time in times:
                    yield log_time, data[start + HEADER_BYTES : stop]

    def _checked(self, k: int) -> tuple[bytes, NDArray[np.uint64], NDArray[np.uint64]]:
        """Return the message records of chunk number k, their log times, and where each begins."""
        entry = self.entry(k)
        data = self.file.store.chunk(entry)
        channel, log_times, offsets = checked_messages(data, f"{self.file.path}: chunk at {entry.offset}")
        if channel != (entry.channel or channel) or TOPIC_OF[channel].name != self.topic.name:
            raise self._damaged(k, f"other messages than of {self.topic.name}")
        return data, log_times, offsets

    def decoded(
        self,
        max_bytes: int | None = None,
        times: range | None = None,
        chunks: Sequence[int] | None = None,
    ) -> Iterator[Message]:
        """Yield the messages of a topic of variable size: `log_time` and the fields, by name.

        Args:
            max_bytes: the largest message that is accepted.
            times: in ns, from the first to before the last; None for all.
            chunks: the numbers of the chunks to read; None for all.

        Raises:
            RecordingError: one cannot be read, or has more than `max_bytes` bytes.
        """
        parse = partial(decode, self.message)
        for time, fields in self.parsed(parse, max_bytes, times, chunks):
            yield {"log_time": time} | fields | self.unknown

    def parsed(
        self,
        parse: Callable[[bytes], M],
        max_bytes: int | None = None,
        times: range | None = None,
        chunks: Sequence[int] | None = None,
    ) -> Iterator[tuple[int, M]]:
        """Yield (log time in nanoseconds, parsed message) of the messages, in order.

        Raises:
            RecordingError: one cannot be parsed, or has more than `max_bytes` bytes; it is named.
        """
        max_bytes = max_bytes or self.max_bytes
        for time, payload in self.messages(times, chunks):
            try:
                if len(payload) > max_bytes:
                    raise RecordingError(f"found {len(payload):,} bytes, expected at most {max_bytes:,}.")
                message = parse(payload)
            except RecordingError as error:
                raise self._unreadable(time, error) from error
            yield time, message

    @cached_property
    def _numbers(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The number of each chunk's first message, and the number after its last."""
        if self.dtype is None and self:
            raise RecordingError(
                f"{self.file.path}: the messages of {self.topic.name} vary in size; read them one by one."
            )
        width = 1 if self.dtype is None else self.dtype.itemsize
        sizes = self.file.chunks.columns["uncompressed_size"][self.places].astype(np.int64)
        if (odd := np.flatnonzero(sizes % width)).size:
            k = int(odd[0])
            raise self._damaged(k, f"{sizes[k]} bytes, not a multiple of {width}")
        counts = sizes // width
        ends = np.cumsum(counts)
        firsts = ends - counts
        for start, stop in self.lost:
            after = firsts >= start
            firsts[after] += stop - start
            ends[after] += stop - start
        return firsts, ends

    def _blocks_of(self, chunks: Sequence[int]) -> Iterator[tuple[int, NDArray[np.void]]]:
        """Yield the number of each of these chunks and its messages, after checking their constant bytes."""
        assert self.dtype is not None
        self._numbers  # noqa: B018 - refuses chunks that are no multiple of the records' size
        for k, data in zip(chunks, self.file.store.chunks(map(self.entry, chunks)), strict=True):
            number, block = self._last
            if number != k:
                block = np.frombuffer(data, dtype=self.dtype)
                is_foreign = block["channel_id"] != self.topic.channel
                if (is_foreign | (block["record_length"] != self.dtype.itemsize - RECORD_HEAD.size)).any():
                    raise self._damaged(k, f"other messages than of {self.topic.name}")
                self._last = k, block
            yield k, block

    def _damaged(self, k: int, found: str) -> RecordingError:
        return _damaged(self.file.path, self.entry(k), found)


def _log_times(times: range) -> tuple[np.uint64, np.uint64]:
    """Return the ends of a range of times as NumPy compares them with those of messages."""
    return np.uint64(max(times.start, 0)), np.uint64(max(times.stop, 0))


def _damaged(path: str, entry: ChunkEntry, found: str) -> RecordingError:
    return RecordingError(f"{path}: chunk at {entry.offset}: found {found}.")
