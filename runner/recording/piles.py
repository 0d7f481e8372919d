"""Messages of variable size that share chunks: some thousands of a topic, or some hundred kilobytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.recording.blocks import message_record
from runner.recording.schema import Topic

MOST_BYTES: Final = 1 << 18
MOST_MESSAGES: Final = 4096

Send = Callable[[Topic, memoryview, NDArray[np.uint64], NDArray[np.uint64]], None]
"""Takes the records of a topic, their times in nanoseconds, and where each begins."""


@dataclass
class _Pile:
    records: bytearray = field(default_factory=bytearray)
    times: list[int] = field(default_factory=list)
    offsets: list[int] = field(default_factory=list)


class Piles:
    """Messages that wait to be a chunk together, a pile a topic.

    Args:
        send: given each pile that is full, or flushed.
    """

    def __init__(self, send: Send) -> None:
        self._send = send
        self._piles: dict[Topic, _Pile] = {}

    def add(self, topic: Topic, log_time: int, payload: bytes) -> None:
        """Put a message on its topic's pile."""
        pile = self._piles.get(topic)
        if pile is None:
            pile = self._piles[topic] = _Pile()
        elif pile.records and len(pile.records) + len(payload) > MOST_BYTES:
            self._close(topic)
            pile = self._piles[topic] = _Pile()
        pile.offsets.append(len(pile.records))
        pile.times.append(log_time)
        pile.records += message_record(topic, log_time, payload)
        if len(pile.times) == MOST_MESSAGES:
            self._close(topic)

    def flush(self) -> None:
        """Send every pile."""
        for topic in list(self._piles):
            self._close(topic)

    def _close(self, topic: Topic) -> None:
        pile = self._piles.pop(topic)
        times, offsets = (np.array(numbers, np.uint64) for numbers in (pile.times, pile.offsets))
        self._send(topic, memoryview(pile.records), times, offsets)
