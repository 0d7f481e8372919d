"""A phase of a recording, training or evaluation: its steps, episodes, resets and what else it has."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import NotInRecording, RecordingError
from runner.recording import schema
from runner.recording.extras import Extras
from runner.recording.reset_states import ResetState, decode_reset_state
from runner.recording.spaces import decode as decode_value
from runner.recording.steps import Steps
from runner.recording.topic_chunks import FOREVER, TopicChunks
from runner.recording.topic_reader import TopicReader

MAX_EPISODE_BYTES: Final = 128 << 20
"""The most that `episode_steps` returns as one array: some 1.5 million steps."""


class Phase:
    """A phase of an open recording; each of its tables has the messages of a topic."""

    def __init__(self, file: TopicReader, name: str) -> None:
        topics = schema.topics_of(file.kind, name)
        self.name, self.title = name, schema.PHASE_NAMES[name]
        steps = file.table(topics.steps)
        assert isinstance(steps, Steps)
        self.steps = steps
        self.episodes, self.resets = file.table(topics.episodes), file.table(topics.resets)
        self.infos, self.frames, self.metrics = map(file.table, (topics.infos, topics.frames, topics.metrics))
        self._file, self._topics = file, topics

    def steps_of_episodes(self, start: int, stop: int | None) -> Iterator[NDArray[np.void]]:
        """Yield the steps of the episodes number `start` up to `stop`; None for all that follow."""
        end = None if stop is None else self.steps.first_from("episode", stop)
        return self.steps.blocks(self.steps.first_from("episode", start), end)

    def episode_span(self, episode: int) -> range:
        """Return the numbers of the steps of one episode, also of one that never ended.

        Where several environments take turns, episodes are numbered as they ended, and only ended ones have
        a span; its step is the number of environments.

        Raises:
            RecordingError: the recording has no such episode, or no steps.
        """
        stride = self._file.environments
        total, ended = self.steps.total(), self.episodes.count()
        if not total:
            raise RecordingError(f"{self._file.path}: has no {self.title} steps.")
        start = 0
        stop = 0
        if 0 <= episode < ended and len(records := self.episodes.array(episode, episode + 1)):
            stop = int(records[0]["last_step"]) + 1
            start = stop - (int(records[0]["length"]) - 1) * stride - 1
        elif episode == ended and stride == 1:
            last = self.episodes.array(ended - 1, ended)
            start, stop = int(last[0]["last_step"]) + 1 if len(last) else 0, total
            for first in self.steps.numbered(range(start, start + 1)):
                # A vector of one environment may have only reset it at first.
                start += int(np.count_nonzero(first["t"] == schema.RESET_ONLY))
        if not 0 <= start < stop <= total:
            raise NotInRecording(
                f"{self._file.path}: has no {self.title} episode {episode:,}; there are {ended:,}, from 0."
            )
        return range(start, stop, stride)

    def episode_steps(self, episode: int) -> NDArray[np.void]:
        """Return the steps of one episode, as `episode_span` finds them.

        Raises:
            RecordingError: the recording has no such episode or steps, or they are too large for an array.
        """
        span, path = self.episode_span(episode), self._file.path
        if (span.stop - span.start) * self._file.dtypes[self.steps.topic].itemsize > MAX_EPISODE_BYTES:
            raise RecordingError(
                f"{path}: {self.title} episode {episode} has {span.stop - span.start:,} steps, too many "
                f"for an array; read them in blocks, from {span.start}."
            )
        steps = self.steps.array(span.start, span.stop)
        if not len(steps):
            raise RecordingError(f"{path}: the steps of {self.title} episode {episode} were lost.")
        return steps[:: span.step]

    def transitions(self) -> Iterator[Any]:
        """Yield the steps of a loop one by one, with `action` and `next_observation` as values.

        Those of the kind `step` have `state`, `action` and `next_state`, counted from 0. They are NumPy
        records where values have one size (`steps.blocks` yields many at once), else dictionaries.
        """
        return self._values(self.steps, action="action", next_observation="observation")

    def reset_values(self) -> Iterator[Any]:
        """Yield the resets one by one, as `transitions` yields steps."""
        return self._values(self.resets, observation="observation")

    def reset_states(self, times: range | None = None) -> Iterator[ResetState]:
        """Yield what resets of a loop without a seed depend on, in the order of the resets.

        Not every reset has one; jobs have none. `times` as for `TopicChunks.rows`.

        Raises:
            RecordingError: one is damaged.
        """
        states = self._file.table(self._topics.reset_states)
        return (state for _, state in states.parsed(decode_reset_state, times=times))

    def _values(self, table: TopicChunks, **spaces: str) -> Iterator[Any]:
        """Yield messages one by one; `spaces` names the space of each field that is a value."""
        if table.dtype is not None:
            for block in table.blocks():
                yield from block
            return
        for fields in table.decoded():
            where = f"{self._file.path}: {table.topic.name} at {fields['log_time']} ns"
            for name, space in spaces.items():
                fields[name] = decode_value(self._file.spaces[space], fields[name], where)
            if "rewards" in fields:
                fields["rewards"] = np.array(fields["rewards"])
            yield fields

    def whole_steps(self) -> int:
        """Return how many steps of a loop are known to have their resets.

        In a recording that was cut off these are the steps up to the first end of an episode after its last
        reset: what comes later may lack its reset, since topics are written one after the other.
        """
        n, total = self._file.environments, self.steps.total()
        if "content_digest" in self._file.result:
            return total
        if (last := self.resets.last()) is None:
            return 0
        for block in self.steps.rows(range(int(last["log_time"]), FOREVER)):
            over = (block["terminated"] | block["truncated"]) & (block["step"] >= last["step"])
            if over.any():
                return min(int(block["step"][np.argmax(over)]) // n * n + n, total // n * n)
        return total // n * n

    @cached_property
    def extras(self) -> Extras:
        """The values that a loop recorded with the steps: names with dtypes, and values; empty for a job.

        Raises:
            RecordingError: they are damaged.
        """
        table, where = self._file.table(self._topics.extras), str(self._file.path)
        layouts = self._file.extra_layouts if table else []
        # As Python's numbers: a forged chunk may begin at any time
        starts = [layout.start_time for layout in layouts]
        times = table.file.chunks.columns["start_time"][table.places].tolist()
        chosen = np.array([bisect_right(starts, time) - 1 for time in times], np.intp)
        if (chosen < 0).any():
            raise RecordingError(f"{where}: {table.topic.name} has values before their names.")
        parts = [
            (layout, TopicChunks(table.file, table.topic, table.places[chosen == k], layout.record))
            for k, layout in enumerate(layouts)
            if (chosen == k).any()
        ]
        return Extras(parts, self.episode_span, where)
