"""The lazy reader of a recording: opens by the index, reads in blocks, keeps little in memory.

    with runner.open_recording("recordings/k3v9m2xq/recording.mcap") as recording:
        for block in recording.blocks(TRAIN_STEP):      # NumPy records, some thousands at a time
            print(block["rewards"].mean())

All other parts of the project read recordings through this module.
"""

from __future__ import annotations

import math
import os
from bisect import bisect_right
from collections.abc import Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import NotInRecording, RecordingError
from runner.recording import schema
from runner.recording.extras import ExtraLayout, Extras, read_layouts
from runner.recording.labels import read_labels
from runner.recording.liveness import is_owned
from runner.recording.messages import (
    Message,
    QTable,
    Snapshot,
    decode_array,
    decode_q_table,
    unknown_measures,
)
from runner.recording.metrics import RECENT_EPISODES, finite_mean
from runner.recording.reset_states import ResetState, decode_reset_state
from runner.recording.row_reader import RowReader
from runner.recording.run_file import RecentTraining, run_title
from runner.recording.schema import Topic
from runner.recording.spaces import decode as decode_value
from runner.recording.topic_chunks import TopicChunks

MAX_EPISODE_BYTES: Final = 128 << 20
"""The most that `episode_steps` returns as one array: some 1.5 million steps."""
MAX_METRICS: Final = 1 << 17
"""The most that `metrics` returns as one list."""
_METRICS_BYTES: Final = 1 << 20


def open_recording(path: str | os.PathLike[str]) -> Recording:
    """Open a recording, finished or not.

    Raises:
        RecordingError: it is missing, not a dualtaxi recording, of an unknown version, or damaged.
    """
    return Recording(Path(path))


class Recording(RowReader):
    """A recording, opened; a context manager."""

    @property
    def status(self) -> str:
        """The status of the run: `finished`, `failed`, `running`, or else `interrupted`."""
        if self.result.status is None and self._is_in_run_folder and is_owned(self.path.parent):
            return "running"
        return self.result.status or "interrupted"

    @property
    def name(self) -> str:
        """The current name of the run: that in its labels if it was renamed, else the first one."""
        renamed = read_labels(self.path.parent).name if self._is_in_run_folder else ""
        return renamed or self.run["name"]

    @property
    def title(self) -> str:
        """The current name of the run, and its seed if it has one: `patient, seed 3`."""
        return run_title(self.name, self.seed)

    @property
    def _is_in_run_folder(self) -> bool:
        return self.path.name == "recording.mcap"

    def done(self) -> dict[str, int]:
        """Return the number of training episodes and steps of each phase: as written, else counted."""
        counts = {
            "episodes": partial(self.count, schema.TRAIN_EPISODE),
            "train_steps": partial(self.step_count, "train"),
            "eval_steps": partial(self.step_count, "eval"),
        }
        recorded = {key: getattr(self.result, key) for key in counts}
        return {key: count() if recorded[key] is None else recorded[key] for key, count in counts.items()}

    def recent_episodes(self) -> NDArray[np.void]:
        """Return the records of the last `RECENT_EPISODES` training episodes."""
        total = self.count(schema.TRAIN_EPISODE)
        return self.episodes("train", max(0, total - RECENT_EPISODES), total)

    def recent_training(self) -> RecentTraining:
        """Return the means of the last training episodes; None where no value is finite."""
        recent = self.recent_episodes()
        length, total = finite_mean(recent["length"]), finite_mean(recent["returns"].sum(axis=1))
        return RecentTraining(len(recent), length, total)

    def count(self, topic: Topic) -> int:
        """Return the number after that of a topic's last message: how many there are, if none was lost.

        For a topic of variable size it reads them.
        """
        if topic.message is schema.EXTRA:
            return self.extras(topic.phase).count
        return self.table(topic).count()

    def blocks_of_episodes(self, phase: str, start: int, stop: int | None) -> Iterator[NDArray[np.void]]:
        """Yield the steps of the episodes number `start` up to `stop`; None for all that follow."""
        steps = self.phase(phase).steps
        end = None if stop is None else steps.first_from("episode", stop)
        return steps.blocks(steps.first_from("episode", start), end)

    def episodes(self, phase: str, start: int = 0, stop: int | None = None) -> NDArray[np.void]:
        """Return the episode records of a phase (`train` or `eval`) as one array."""
        episodes = self.phase(phase).episodes
        blocks = list(episodes.blocks(start, stop))
        return np.concatenate(blocks) if blocks else np.empty(0, episodes.dtype)

    def episode_span(self, phase: str, episode: int) -> range:
        """Return the numbers of the steps of one episode, also of one that never ended.

        Where several environments take turns, episodes are numbered as they ended, and only ended ones have
        a span; its step is the number of environments.

        Raises:
            RecordingError: the recording has no such episode, or no steps.
        """
        own, stride = self.phase(phase), self.environments
        total, ended = self.step_count(phase), own.episodes.count()
        if not total:
            raise RecordingError(f"{self.path}: has no {own.title} steps.")
        start = 0
        stop = 0
        if 0 <= episode < ended and len(records := self.episodes(phase, episode, episode + 1)):
            stop = int(records[0]["last_step"]) + 1
            start = stop - (int(records[0]["length"]) - 1) * stride - 1
        elif episode == ended and stride == 1:
            last = self.episodes(phase, ended - 1, ended)
            start, stop = int(last[0]["last_step"]) + 1 if len(last) else 0, total
            for first in own.steps.blocks(start, start + 1) if own.steps.dtype is not None else ():
                # A vector of one environment may have only reset it at first.
                start += int(np.count_nonzero(first["t"] == schema.RESET_ONLY))
        if not 0 <= start < stop <= total:
            raise NotInRecording(
                f"{self.path}: has no {own.title} episode {episode:,}; there are {ended:,}, from 0."
            )
        return range(start, stop, stride)

    def episode_steps(self, phase: str, episode: int) -> NDArray[np.void]:
        """Return the steps of one episode, as `episode_span` finds them.

        Raises:
            RecordingError: the recording has no such episode or steps, or they are too large for an array.
        """
        span, own = self.episode_span(phase, episode), self.phase(phase)
        if (span.stop - span.start) * self.dtypes[own.steps.topic].itemsize > MAX_EPISODE_BYTES:
            raise RecordingError(
                f"{self.path}: {own.title} episode {episode} has {span.stop - span.start:,} steps, too many "
                f"for an array; read them in blocks, from {span.start}."
            )
        blocks = list(own.steps.blocks(span.start, span.stop))
        if not blocks:
            raise RecordingError(f"{self.path}: the steps of {own.title} episode {episode} were lost.")
        return np.concatenate(blocks)[:: span.step]

    def extras(self, phase: str) -> Extras:
        """Return the values that a loop recorded with the steps of a phase: names with dtypes, and values.

        It is empty without any, as for a job.

        Raises:
            RecordingError: they are damaged.
        """
        start_times = np.empty(0, np.uint64)
        topic = schema.topics_of(self.kind, phase).extras
        layouts: list[ExtraLayout] = []
        if len(places := self._chunk_numbers[topic]):
            layouts = self.extra_layouts
            start_times = self._index.chunks.columns["start_time"][places]
        # As Python's numbers: a forged chunk may begin at any time
        starts = [layout.start_time for layout in layouts]
        chosen = np.array([bisect_right(starts, time) - 1 for time in start_times.tolist()], np.intp)
        if (chosen < 0).any():
            raise RecordingError(f"{self.path}: {topic.name} has values before their names.")
        parts = [
            (
                layout,
                TopicChunks(
                    topic,
                    places[chosen == k],
                    self._index.chunks,
                    self._store,
                    layout.record,
                    [],
                    str(self.path),
                ),
            )
            for k, layout in enumerate(layouts)
            if (chosen == k).any()
        ]
        return Extras(parts, partial(self.episode_span, phase), str(self.path))

    @cached_property
    def extra_layouts(self) -> list[ExtraLayout]:
        """The names of extras, from when on; each entry has those of the one before it."""
        columns = (
            (fields["log_time"], fields["json"]) for fields in self.decoded(schema.EXTRA_COLUMNS_TOPIC)
        )
        return read_layouts(columns, str(self.path))

    def transitions(self, phase: str) -> Iterator[Any]:
        """Yield the steps of a loop's phase one by one, with `action` and `next_observation` as values.

        Those of the kind `step` have `state`, `action` and `next_state`, counted from 0. They are NumPy
        records where values have one size (`blocks` yields many at once), else dictionaries.
        """
        yield from self._values(self.phase(phase).steps, action="action", next_observation="observation")

    def resets(self, phase: str) -> Iterator[Any]:
        """Yield the resets of a phase one by one, as `transitions` yields steps."""
        yield from self._values(self.phase(phase).resets, observation="observation")

    def reset_states(self, phase: str, times: range | None = None) -> Iterator[ResetState]:
        """Yield what resets of a loop's phase without a seed depend on, in the order of the resets.

        Not every reset has one; recordings of earlier versions and jobs have none. `times` as for `decoded`.

        Raises:
            RecordingError: one is damaged.
        """
        for _, state in self.phase(phase).reset_states.parsed(decode_reset_state, times=times):
            yield state

    def _values(self, table: TopicChunks, **spaces: str) -> Iterator[Any]:
        """Yield messages one by one; `spaces` names the space of each field that is a value."""
        if table.dtype is not None:
            for block in table.blocks():
                yield from block
            return
        for fields in table.decoded():
            where = f"{self.path}: {table.topic.name} at {fields['log_time']} ns"
            for name, space in spaces.items():
                fields[name] = decode_value(self.spaces[space], fields[name], where)
            if "rewards" in fields:
                fields["rewards"] = np.array(fields["rewards"])
            yield fields

    def arrays(self) -> Iterator[Snapshot]:
        """Yield the arrays that a loop recorded by `snapshot`, in order."""
        return (array for _, array in self.table(schema.ARRAY_TOPIC).parsed(decode_array))

    def metrics(self, phase: str) -> list[Message]:
        """Return the metrics of a phase, in order.

        Raises:
            RecordingError: they are damaged, or more than 131,072; `iter_metrics` yields them one by one.
            ValueError: there is no such phase.
        """
        metrics: list[Message] = []
        for one in self.iter_metrics(phase):
            if len(metrics) == MAX_METRICS:
                raise RecordingError(f"{self.path}: has more than {MAX_METRICS:,} {phase} metrics.")
            metrics.append(one)
        return metrics

    def iter_metrics(self, phase: str) -> Iterator[Message]:
        """Yield the metrics of a phase (`train` or `eval`), in order.

        Raises:
            RecordingError: they are damaged.
            ValueError: there is no such phase.
        """
        if phase not in schema.PHASES:
            raise ValueError(f"found phase {phase!r}, expected one of: {', '.join(schema.PHASES)}.")
        yield from self._measures(self.phase(phase).metrics.topic)

    def optimality(self) -> Iterator[Message]:
        """Yield the exact measures of the evaluations, in order; none unless `evaluation.exact` was set."""
        yield from self._measures(schema.OPTIMALITY_TOPIC)

    def _measures(self, topic: Topic) -> Iterator[dict[str, object]]:
        """Yield metrics; one that the recording's version did not have is NaN, as unknown ones are."""
        channel = self._index.channels.get(topic.channel)
        recorded = self._index.schemas.get(channel.schema_id, b"") if channel else b""
        unknown = dict.fromkeys(unknown_measures(topic.message, recorded), math.nan)
        for fields in self.decoded(topic, _METRICS_BYTES):
            yield fields | unknown

    def snapshots(self, step: int = 0, tables: int = 0) -> Iterator[QTable]:
        """Yield the snapshots in order, without those that are older than needed for `step`.

        All tables of the last moment at or before `step` are included, and of the moment before it.

        Args:
            step: a training step.
            tables: how many tables each moment has; by default only the learners' Q-tables are yielded, not
                what else their algorithm keeps.
        """
        learners = len(self.agents)
        first, chunks = 0, range(len(self.table(schema.Q_TABLE_TOPIC)))
        if step:
            after = bisect_right(chunks, step, key=lambda k: next(self._snapshots(k)).step)
            first = max(0, after - 2 * (tables or learners))
        for snapshot in self._snapshots(first):
            if tables or snapshot.table < learners:
                yield snapshot

    def _snapshots(self, first_chunk: int) -> Iterator[QTable]:
        return (table for _, table in self.table(schema.Q_TABLE_TOPIC).parsed(decode_q_table, first_chunk))
