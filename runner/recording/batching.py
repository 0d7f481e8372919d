"""Messages of variable size that share chunks: some thousands of a topic, or some hundred kilobytes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.recording.blocks import HEADER_BYTES, MESSAGE_HEAD, RECORD_HEAD, message_record
from runner.recording.schema import Topic

MOST_BYTES: Final = 1 << 18
MOST_MESSAGES: Final = 4096

Send = Callable[[Topic, memoryview, NDArray[np.uint64], NDArray[np.uint64]], None]
"""Takes the records of a topic, their times in nanoseconds, and where each begins."""


@dataclass
class _Pile:
    topic: Topic
    records: list[bytes] = field(default_factory=list)
    times: list[int] = field(default_factory=list)
    size: int = 0
    """Bytes of the records."""


class Piles:
    """Messages that wait to be a chunk together, a pile a topic.

    Args:
        send: given each pile that is full, or flushed.
    """

    def __init__(self, send: Send) -> None:
        self._send = send
        self._piles: dict[int, _Pile] = {}
        """By channel."""

    def add(self, topic: Topic, log_time: int, payload: bytes) -> None:
        """Put a message on its topic's pile."""
        self._put(topic, [log_time], [message_record(topic, log_time, payload)])

    def extend(self, topic: Topic, log_times: Sequence[int], payloads: Sequence[bytes]) -> None:
        """Put messages on their topic's pile."""
        pack, channel, head = MESSAGE_HEAD.pack, topic.channel, HEADER_BYTES - RECORD_HEAD.size
        records = [
            pack(5, head + len(payload), channel, 0, time, time) + payload
            for time, payload in zip(log_times, payloads, strict=True)
        ]
        self._put(topic, log_times, records)

    def flush(self) -> None:
        """Send every pile."""
        for pile in list(self._piles.values()):
            self._close(pile)

    def _put(self, topic: Topic, times: Sequence[int], records: Sequence[bytes]) -> None:
        size = sum(map(len, records))
        pile = self._piles.get(topic.channel)
        if pile is not None and (
            pile.size + size > MOST_BYTES or len(pile.times) + len(records) > MOST_MESSAGES
        ):
            self._close(pile)
            pile = None
        if pile is None:
            pile = self._piles[topic.channel] = _Pile(topic)
        pile.records += records
        pile.times += times
        pile.size += size

    def _close(self, pile: _Pile) -> None:
        del self._piles[pile.topic.channel]
        sizes = np.array([len(record) for record in pile.records], np.uint64)
        times = np.array(pile.times, np.uint64)
        self._send(pile.topic, memoryview(b"".join(pile.records)), times, np.cumsum(sizes) - sizes)
