"""Records the actions of a loop alone; `actions` describes the messages."""

from __future__ import annotations

import numpy as np

from runner.recording import schema
from runner.recording.actions import EpisodeDigests, after_step, kept_dtype, packed
from runner.recording.messages import encode
from runner.recording.recorder import BLOCK_BYTES, Recorder
from runner.recording.schema import Topic
from runner.recording.turns import turns_of
from runner.util.arrays import Records


class ActionRecorder:
    """Records the actions of the steps that a recorder gets and leaves out of the file.

    Args:
        block_steps: how many steps a message has, but for those that are flushed by time.
    """

    def __init__(self, recorder: Recorder, environments: int, block_steps: int) -> None:
        self._recorder = recorder
        self._n = environments
        self._block_steps = block_steps
        self._digests = {phase: EpisodeDigests() for phase in schema.PHASES}
        self._rows: list[Records] = []
        self._phase = ""
        recorder.watch(schema.STEP, self.take_steps)

    def take_steps(self, topic: Topic, records: Records) -> None:
        """Take steps that the recorder gets."""
        if topic.phase != self._phase:
            self.commit()
            self._phase = topic.phase
        rows = np.zeros(len(records), kept_dtype(records.dtype))
        for name in rows.dtype.names or ():
            if name != "digest":
                rows[name] = records[name]
        names = "t", after_step(records.dtype), "rewards", "terminated", "truncated"
        if len(rows):
            for environment, places in turns_of(records):
                columns = (records[name][places] for name in names)
                for row, digest in self._digests[topic.phase].add(environment, *columns):
                    rows["digest"][places[row]] = np.void(digest)
        self._rows.append(rows)
        is_large = sum(part.nbytes for part in self._rows) >= BLOCK_BYTES
        if is_large or sum(map(len, self._rows)) >= self._block_steps:
            self.commit()

    def commit(self) -> None:
        """Hand what was taken to the recorder."""
        if self._rows:
            rows = np.concatenate(self._rows)
            self._rows = []
            position = int(rows["log_time"][-1]) // schema.STEP_NANOSECONDS
            topic = schema.topics_of(self._phase).actions
            self._recorder.append(topic, encode(schema.ACTIONS, packed(rows, self._n)), position)
