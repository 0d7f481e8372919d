"""The lazy reader of a recording: opens by the index, reads in blocks, keeps little in memory.

    with runner.open_recording("recordings/k3v9m2xq/recording.mcap") as recording:
        for block in recording.train.steps.blocks():      # NumPy records, some thousands at a time
            print(block["rewards"].mean())

All other parts of the project read recordings through this module.
"""

from __future__ import annotations

import math
import os
from bisect import bisect_right
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording import schema
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
from runner.recording.phases import Phase
from runner.recording.run_file import RecentTraining, run_title
from runner.recording.topic_chunks import FOREVER, TopicChunks
from runner.recording.topic_reader import TopicReader

MAX_METRICS: Final = 1 << 17
"""The most that `metrics` returns as one list."""
_METRICS_BYTES: Final = 1 << 20


def open_recording(path: str | os.PathLike[str]) -> Recording:
    """Open a recording, finished or not.

    Raises:
        RecordingError: it is missing, not a dualtaxi recording, of an unknown version, or damaged.
    """
    return Recording(Path(path))


class Recording(TopicReader):
    """A recording, opened; a context manager."""

    @cached_property
    def train(self) -> Phase:
        """What was recorded of training."""
        return Phase(self, "train")

    @cached_property
    def eval(self) -> Phase:
        """What was recorded of evaluations; their episodes are trials."""
        return Phase(self, "eval")

    def phase(self, name: str) -> Phase:
        """Return a phase, `train` or `eval`.

        Raises:
            ValueError: there is no such phase.
        """
        if name not in schema.PHASES:
            raise ValueError(f"found phase {name!r}, expected one of: {', '.join(schema.PHASES)}.")
        return self.train if name == "train" else self.eval

    @property
    def phases(self) -> tuple[Phase, Phase]:
        """Training and evaluation."""
        return self.train, self.eval

    @property
    def has_steps(self) -> bool:
        """Whether any whole step was recorded."""
        return any(phase.steps for phase in self.phases)

    @property
    def has_actions(self) -> bool:
        """Whether any action was recorded, with its step or alone."""
        return any(phase.steps.are_known for phase in self.phases)

    @property
    def last_step_time(self) -> int:
        """The `log_time` of the last step in a recording that was cut: later resets lost their steps."""
        steps = [phase.steps for phase in self.phases]
        if "content_digest" in self.result or any(each.are_actions for each in steps):
            return FOREVER
        return max((each.entry(len(each) - 1).end_time for each in steps if each), default=0)

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
            "episodes": self.train.episodes.count,
            "train_steps": self.train.steps.total,
            "eval_steps": self.eval.steps.total,
        }
        recorded = {key: getattr(self.result, key) for key in counts}
        return {key: count() if recorded[key] is None else recorded[key] for key, count in counts.items()}

    def recent_episodes(self) -> NDArray[np.void]:
        """Return the records of the last `RECENT_EPISODES` training episodes."""
        return self.train.episodes.array(max(0, self.train.episodes.count() - RECENT_EPISODES))

    def recent_training(self) -> RecentTraining:
        """Return the means of the last training episodes; None where no value is finite."""
        recent = self.recent_episodes()
        length, total = finite_mean(recent["length"]), finite_mean(recent["returns"].sum(axis=1))
        return RecentTraining(len(recent), length, total)

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
        return self._measures(self.phase(phase).metrics)

    def optimality(self) -> Iterator[Message]:
        """Yield the exact measures of the evaluations, in order; none unless `evaluation.exact` was set."""
        return self._measures(self.table(schema.OPTIMALITY_TOPIC))

    def _measures(self, table: TopicChunks) -> Iterator[dict[str, object]]:
        """Yield metrics; one that the recording's version did not have is NaN, as unknown ones are."""
        channel = self._index.channels.get(table.topic.channel)
        recorded = self._index.schemas.get(channel.schema_id, b"") if channel else b""
        unknown = dict.fromkeys(unknown_measures(table.topic.message, recorded), math.nan)
        for fields in table.decoded(_METRICS_BYTES):
            yield fields | unknown

    def snapshots(self, step: int = 0, tables: int = 0) -> Iterator[QTable]:
        """Yield the snapshots in order, without those that are older than needed for `step`.

        All tables of the last moment at or before `step` are included, and of the moment before it.

        Args:
            step: a training step.
            tables: how many tables each moment has; by default only the learners' Q-tables are yielded, not
                what else their algorithm keeps.
        """
        learners, table = len(self.agents), self.table(schema.Q_TABLE_TOPIC)
        chunks = range(len(table))

        def read(part: range) -> Iterator[QTable]:
            return (snapshot for _, snapshot in table.parsed(decode_q_table, chunks=part))

        if step:
            after = bisect_right(chunks, step, key=lambda k: next(read(chunks[k:])).step)
            chunks = chunks[max(0, after - 2 * (tables or learners)) :]
        for snapshot in read(chunks):
            if tables or snapshot.table < learners:
                yield snapshot
