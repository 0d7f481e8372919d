"""The chunks of one topic in an open recording: its messages by number or time, in blocks or one by one."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.layout import HEADER_BYTES, RECORD_HEAD, record_dtype, row_dtype, rows_of
from runner.recording.messages import Logged, Message, decode, decode_rows
from runner.recording.record_store import RecordStore
from runner.recording.records import ChunkEntry, checked_messages
from runner.recording.schema import TOPIC_OF, MessageType, Topic
from runner.util.arrays import Ints, RecordDType, Records
from runner.util.packing import MAX_CHUNK_BYTES

M = TypeVar("M")
FOREVER: Final = 2**63 - 1
"""A time in nanoseconds, and a number, that no message has."""


@dataclass(eq=False)
class TopicChunks:
    """The chunks of a topic, in order.

    Messages are numbered as recorded; where a repair lost some, the numbers continue after the gap.
    """

    file: RecordStore
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
    _last: tuple[int, Records] = field(default=(-1, np.empty(0, np.void)), init=False)
    """The number of the chunk that was read last, and its messages as rows."""

    def __len__(self) -> int:
        return len(self.places)

    @cached_property
    def dtype(self) -> RecordDType | None:
        """The dtype of a message record in the file; None if messages vary in size."""
        return record_dtype(self.message)

    @cached_property
    def row_dtype(self) -> RecordDType:
        """The dtype of `rows`."""
        return row_dtype(self.message)

    @property
    def _number(self) -> str:
        """The field that numbers the messages."""
        return schema.NUMBERED_BY[self.topic.message]

    def entry(self, k: int) -> ChunkEntry:
        """Return the entry of chunk number k in the file's table."""
        return self.file.index.chunks[int(self.places[k])]

    def count(self) -> int:
        """Return how many messages there are; lost messages before the last count if they are numbered."""
        if self.dtype is not None:
            _, ends = self.chunk_numbers
            return int(ends[-1]) if len(ends) else 0
        if self.topic.message not in schema.NUMBERED_BY:
            return sum(1 for _ in self.messages())
        last = self.last()
        return 0 if last is None else int(last[self._number]) + 1

    # --- rows -----------------------------------------------------------------------------------------

    def rows(self, times: range | None = None) -> Iterator[Records]:
        """Yield the messages as records in blocks, also those that vary in size.

        Values of varying size are objects: the bytes that `spaces.decode` takes.

        Args:
            times: their `log_time` in ns, from the first to before the last; None for all.

        Raises:
            RecordingError: they are damaged.
        """
        if times is None:
            return (rows for _, rows in self._read(range(len(self))))
        blocks = (rows for _, rows in self._read(self._overlapping(times)))
        return within(blocks, "log_time", max(times.start, 0), max(times.stop, 0))

    def blocks(self, start: int = 0, stop: int | None = None) -> Iterator[Records]:
        """Yield the messages number `start` up to `stop`, a chunk at a time; they must have one size."""
        firsts, ends = self.chunk_numbers
        stop = int(ends[-1]) if stop is None and len(ends) else (stop or 0)
        begin, end = np.searchsorted(ends, start, side="right"), np.searchsorted(firsts, stop, side="left")
        for k, rows in self._read(range(int(begin), int(end))):
            first = int(firsts[k])
            yield rows[max(start - first, 0) : stop - first]

    def array(self, start: int = 0, stop: int | None = None) -> Records:
        """Return the messages number `start` up to `stop` as one array; they must have one size."""
        blocks = list(self.blocks(start, stop))
        return np.concatenate(blocks) if blocks else np.empty(0, self.row_dtype)

    def selected(self, numbers: Ints) -> Records:
        """Return the messages of these numbers, in their order; they must be there, and have one size."""
        ascending, order = np.unique(numbers, return_inverse=True)
        firsts, ends = self.chunk_numbers
        chunks = np.unique(np.searchsorted(ends, ascending, side="right")).tolist()
        blocks = (block for k in chunks for block in self.blocks(int(firsts[k]), int(ends[k])))
        kept = [block[np.isin(block[self._number], ascending)] for block in blocks]
        return np.concatenate([np.empty(0, self.row_dtype), *kept])[order]

    def numbered(self, numbers: range) -> Iterator[Records]:
        """Yield the messages of these numbers in blocks, as `rows` does."""
        if not numbers:
            return iter(())
        if self.dtype is not None:  # which chunk holds a number follows from their sizes
            return self.blocks(numbers.start, numbers.stop)
        return self.rows_between(self._number, numbers.start, numbers.stop)

    def rows_between(self, field: str, start: int, stop: int = FOREVER) -> Iterator[Records]:
        """Yield the messages with values from `start` to before `stop` in a field that never decreases.

        They come in blocks, as `rows` yields them.
        """
        return within(map(self._rows_of, self.chunks_from(field, start)), field, start, stop)

    def first_from(self, field: str, value: int) -> int:
        """Return the number of the first message of that value or more in a field that never decreases."""
        for rows in self.rows_between(field, value):
            return int(rows[self._number][0])
        return self.count()

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
        if self.dtype is None:  # decoding the whole chunk would take long
            row: np.void = self._decoded([*self.messages(chunks=[number])][-1:])[0]
        else:
            row = self._rows_of(number)[-1]
        return row

    def chunks_from(self, field: str, value: int) -> range:
        """Return the chunks from the last that begins below a value of a field that never decreases."""

        def first(k: int) -> Any:
            return next(self.decoded(chunks=[k]))[field] if self.dtype is None else self._rows_of(k)[field][0]

        return range(max(bisect_left(range(len(self)), value, key=first) - 1, 0), len(self))

    @cached_property
    def chunk_numbers(self) -> tuple[Ints, Ints]:
        """The number of each chunk's first message, and the number after its last."""
        if self.dtype is None and self:
            raise RecordingError(
                f"{self.file.path}: the messages of {self.topic.name} vary in size; read them one by one."
            )
        width = 1 if self.dtype is None else self.dtype.itemsize
        sizes = self.file.index.chunks.columns["uncompressed_size"][self.places].astype(np.int64)
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

    def _or_all(self, chunks: Sequence[int] | None) -> Sequence[int]:
        """Return the numbers of these chunks, or of all."""
        return range(len(self)) if chunks is None else chunks

    def _overlapping(self, times: range, chunks: Sequence[int] | None = None) -> list[int]:
        """Return the chunks, of these or of all, that may have messages of these times."""
        numbers = np.array(self._or_all(chunks), np.intp)
        start, stop = (np.uint64(max(time, 0)) for time in (times.start, times.stop))
        spans = self.file.index.chunks.columns[self.places[numbers]]
        overlapping: list[int] = numbers[(spans["end_time"] >= start) & (spans["start_time"] < stop)].tolist()
        return overlapping

    def _read(self, chunks: Sequence[int]) -> Iterator[tuple[int, Records]]:
        """Yield the number of each of these chunks and its rows; the next ones are unpacked meanwhile."""
        for k, data in zip(chunks, self.file.chunks(map(self.entry, chunks)), strict=True):
            yield k, self._rows_of(k, data)

    def _rows_of(self, k: int, data: bytes | None = None) -> Records:
        """Return the messages of chunk number k as rows; `data` are its message records, if they were read.

        Raises:
            RecordingError: it has messages of another topic, or a value that its space does not have.
        """
        if self._last[0] != k:
            if self.dtype is None:
                rows = self._decoded([*self.messages(chunks=[k])])
            else:
                block = self._stored(k, self.file.chunk(self.entry(k)) if data is None else data)
                try:
                    rows = rows_of(self.message, block)
                except RecordingError as error:
                    raise self._unreadable(int(block["log_time"][0]), error) from error
            self._last = k, rows
        return self._last[1]

    def _decoded(self, messages: Sequence[Logged]) -> Records:
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

    # --- records and messages -------------------------------------------------------------------------

    def records(self, chunks: Sequence[int] | None = None) -> Iterator[bytes]:
        """Yield the message records of each of these chunks, by default of all, as they are in the file."""
        return self.file.chunks(map(self.entry, self._or_all(chunks)))

    def stored(self, chunks: Sequence[int] | None = None) -> Iterator[Records]:
        """Yield the messages of each chunk as they are stored: message records, which must have one size."""
        return map(self._stored, self._or_all(chunks), self.records(chunks))

    def _stored(self, k: int, data: bytes) -> Records:
        self.chunk_numbers  # noqa: B018 - refuses chunks that are no multiple of the records' size
        block: Records = np.frombuffer(data, self.dtype)
        is_foreign = block["channel_id"] != self.topic.channel
        if (is_foreign | (block["record_length"] != block.itemsize - RECORD_HEAD.size)).any():
            raise self._damaged(k, f"other messages than of {self.topic.name}")
        return block

    def messages(self, times: range | None = None, chunks: Sequence[int] | None = None) -> Iterator[Logged]:
        """Yield (log time in nanoseconds, payload) of the messages.

        Args:
            times: of the log times, from the first to before the last; None for all.
            chunks: the numbers of the chunks to read; None for all.
        """
        if times is not None:
            chunks = self._overlapping(times, chunks)
        for k in self._or_all(chunks):
            entry = self.entry(k)
            data = self.file.chunk(entry)
            channel, log_times, offsets = checked_messages(data, self.file.where(entry))
            if channel != (entry.channel or channel) or TOPIC_OF[channel].name != self.topic.name:
                raise self._damaged(k, f"other messages than of {self.topic.name}")
            edges = pairwise([*offsets.tolist(), len(data)])
            for log_time, (start, stop) in zip(log_times.tolist(), edges, strict=True):
                if times is None or log_time in times:
                    yield log_time, data[start + HEADER_BYTES : stop]

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

    def newest(self) -> Iterator[Message]:
        """Yield the messages of a topic of variable size as `decoded` does, the last one first.

        Raises:
            RecordingError: one cannot be read.
        """
        for k in reversed(range(len(self))):
            yield from reversed([*self.decoded(chunks=[k])])

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

    def _unreadable(self, time: int, error: RecordingError) -> RecordingError:
        return RecordingError(f"{self.file.path}: {self.topic.name} at {time} ns: {error}")

    def _damaged(self, k: int, found: str) -> RecordingError:
        return RecordingError(f"{self.file.where(self.entry(k))}: found {found}.")


def within(blocks: Iterable[Records], field: str, start: int, stop: int) -> Iterator[Records]:
    """Yield the rows with values from `start` to before `stop` in a field that never decreases.

    The blocks follow one another, and no more of them are read than needed.
    """
    for rows in blocks:
        values = rows[field]
        low, high = np.searchsorted(values, np.array([start, stop], values.dtype)).tolist()
        if low < high:
            yield rows[low:high]
        if high < len(rows):
            return
