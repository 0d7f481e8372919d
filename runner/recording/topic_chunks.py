"""The chunks of one topic in an open recording: its messages by number or time, as blocks or one by one."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording.blocks import HEADER_BYTES, MESSAGE_HEAD
from runner.recording.chunk_cache import RecordStore
from runner.recording.index import ChunkEntry, ChunkTable, Index
from runner.recording.schema import ALL_TOPICS, Topic

_MESSAGE: Final = int(Opcode.MESSAGE)


def chunks_by_topic(index: Index, store: RecordStore, path: str) -> dict[Topic, NDArray[np.intp]]:
    """Return which chunks of a file hold each topic's messages, in order.

    Raises:
        RecordingError: one holds messages of a channel that the file does not have.
    """
    table = index.chunks
    channels = table.columns["channel"].copy() if table else np.empty(0, np.uint16)
    for k in np.flatnonzero(channels == 0).tolist():
        channel = store.first_channel(table[k])
        channels[k] = channel
    for k in np.flatnonzero(~np.isin(channels, list(index.channels))).tolist():
        raise _damaged(path, table[k], f"messages of channel {channels[k]}, expected one of ours")
    return {topic: np.flatnonzero(channels == topic.channel) for topic in ALL_TOPICS}


class TopicChunks:
    """The chunks of a topic, in order.

    Messages are numbered as recorded; where a repair lost some, the numbers go on behind the gap.

    Args:
        topic: whose they are.
        places: which chunks of the file they are.
        table: all chunks of the file.
        store: gives what they hold.
        dtype: of a message record; None if messages vary in size.
        lost: [first, behind the last] numbers of the messages that a repair could not save.
        path: of the recording, for errors.
    """

    def __init__(
        self,
        topic: Topic,
        places: NDArray[np.intp],
        table: ChunkTable,
        store: RecordStore,
        dtype: np.dtype[np.void] | None,
        lost: Sequence[Sequence[int]],
        path: str,
    ) -> None:
        self._topic = topic
        self._places = places
        self._table = table
        self._store = store
        self._dtype = dtype
        self._lost = lost
        self._path = path

    def __len__(self) -> int:
        return len(self._places)

    def entry(self, k: int) -> ChunkEntry:
        """Return where chunk number k stands, and what it says of itself."""
        return self._table[int(self._places[k])]

    def count(self) -> int:
        """Return the number behind the last message; where messages vary in size, by reading them."""
        if self._dtype is None:
            return sum(1 for _ in self.messages())
        _, ends = self._numbers
        return int(ends[-1]) if len(ends) else 0

    def blocks(self, start: int, stop: int | None) -> Iterator[NDArray[np.void]]:
        """Yield the messages number `start` up to `stop`, a chunk at a time; they must have one size."""
        firsts, ends = self._numbers
        stop = int(ends[-1]) if stop is None and len(ends) else (stop or 0)
        chunks = range(
            int(np.searchsorted(ends, start, side="right")), int(np.searchsorted(firsts, stop, side="left"))
        )
        for k, data in zip(chunks, self._store.chunks(map(self.entry, chunks)), strict=True):
            first = int(firsts[k])
            yield self._block(k, data)[max(start - first, 0) : stop - first]

    def blocks_between(self, start_time: int, stop_time: int) -> Iterator[NDArray[np.void]]:
        """Yield the messages logged from `start_time` up to `stop_time`, in ns; they must have one size."""
        firsts, ends = self._numbers
        if not len(firsts):
            return
        start, stop = np.uint64(max(start_time, 0)), np.uint64(max(stop_time, 0))
        times = self._table.columns[self._places]
        first, behind = np.searchsorted(times["end_time"], start), np.searchsorted(times["start_time"], stop)
        for block in self.blocks(int(firsts[first]), int(ends[behind - 1])) if first < behind else ():
            low, high = (int(np.searchsorted(block["log_time"], time)) for time in (start, stop))
            if low < high:
                yield block[low:high]

    def first_from(self, field: str, value: int) -> int:
        """Return the number of the first message of that value or more in a field that never decreases."""
        firsts, ends = (numbers.tolist() for numbers in self._numbers)
        k = bisect_left(ends, value, key=lambda end: next(self.blocks(end - 1, end))[field][0])
        if k == len(ends):
            return self.count()
        block = next(self.blocks(firsts[k], ends[k]))
        return int(firsts[k]) + int(np.searchsorted(block[field], value))

    def messages(self, first_chunk: int = 0) -> Iterator[tuple[int, bytes]]:
        """Yield (log time in nanoseconds, payload) of the messages from a chunk on."""
        for k in range(first_chunk, len(self)):
            data = self._store.chunk(self.entry(k))
            at = 0
            while at < len(data):
                if at + HEADER_BYTES > len(data):
                    raise self._damaged(k, f"stray bytes at {at}")
                opcode, length, channel, _, log_time, _ = MESSAGE_HEAD.unpack_from(data, at)
                end = at + 9 + length
                whole = at + HEADER_BYTES <= end <= len(data)
                if opcode != _MESSAGE or not whole or channel != self._topic.channel:
                    raise self._damaged(k, f"no message of {self._topic.name} at {at}")
                yield log_time, data[at + HEADER_BYTES : end]
                at = end

    @cached_property
    def _numbers(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """For each chunk the number of its first message, and behind its last."""
        if self._dtype is None:
            raise RecordingError(
                f"{self._path}: the messages of {self._topic.name} vary in size; read them one by one."
            )
        size = self._dtype.itemsize
        sizes = np.empty(0, np.int64)
        if len(self):
            sizes = self._table.columns["uncompressed_size"][self._places].astype(np.int64)
        if (odd := np.flatnonzero(sizes % size)).size:
            k = int(odd[0])
            raise self._damaged(k, f"{self.entry(k).uncompressed_size} bytes, not a multiple of {size}")
        ends = np.cumsum(sizes // size)
        firsts = ends - sizes // size
        for start, stop in self._lost:
            behind = firsts >= start
            firsts[behind] += stop - start
            ends[behind] += stop - start
        return firsts, ends

    def _block(self, k: int, data: bytes) -> NDArray[np.void]:
        """Return chunk number k as an array, after looking at its constant bytes."""
        assert self._dtype is not None
        block = np.frombuffer(data, dtype=self._dtype)
        if (block["channel_id"] != self._topic.channel).any() or (
            block["record_length"] != self._dtype.itemsize - 9
        ).any():
            raise self._damaged(k, f"other messages than of {self._topic.name}")
        return block

    def _damaged(self, k: int, found: str) -> RecordingError:
        return _damaged(self._path, self.entry(k), found)


def _damaged(path: str, entry: ChunkEntry, found: str) -> RecordingError:
    return RecordingError(f"{path}: chunk at {entry.offset}: found {found}.")
