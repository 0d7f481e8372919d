"""The recorder: a learner fills message records in place, in buffers that are used again, and commits them.

When all buffers are in use the learner waits, so memory is bounded. What a recording already holds is
compared with what is committed, not written again: this is how a run is resumed, and verified.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final

import numpy as np

from runner.recording import schema
from runner.recording.digest import combined_digest
from runner.recording.index import beginning_of_extras
from runner.recording.layout import Layout, blank_records, lone_message, record_dtype, row_dtype, rows_of
from runner.recording.messages import encode, encode_rows
from runner.recording.observer import Observer
from runner.recording.pipeline import MAX_BATCH_MESSAGES, MessageBatches, Pipeline
from runner.recording.reference import Reference
from runner.recording.schema import STEP_NANOSECONDS, MessageType, Topic
from runner.recording.steps import EpisodeDigests, after_step, kept_dtype, packed, turns_of
from runner.recording.writer import RecordingFile
from runner.util.arrays import Array, RecordDType, Records, Unsigned
from runner.util.packing import Packing
from runner.util.values import Json

FLUSH_SECONDS: Final = 0.5
"""A block is written when it is this old, though it is not full; with the writing, well under a second."""
MAX_BLOCKS: Final = 8
"""The most buffers of a topic."""
EPISODES_A_BLOCK: Final = 2048
_FIRST_RECORDS: Final = 256
"""Records in the first block of a topic where recordings may be short: clearing more of them costs time."""
BLOCK_BYTES: Final = 8 << 20
"""The most bytes of a block, unless one record has more."""

Watcher = Callable[[Topic, Records], None]
"""Takes rows of a topic."""


@dataclass
class _Lane:
    """The buffers of one fixed-width topic, its blocks."""

    topic: Topic
    message: MessageType
    capacity: int
    """Records of a whole block."""
    write: bool
    """Whether its records go into the file, or into the digest alone."""
    open: Records | None = None
    """The block that is being filled."""
    filled: int = 0
    """Its records that were taken."""
    free: queue.SimpleQueue[Records] = field(default_factory=queue.SimpleQueue)
    """Blocks that were written and can be filled again."""
    made: int = 0
    """Number of whole blocks, at most `MAX_BLOCKS`."""
    has_started: bool = False
    """Whether it had its first block, which may be smaller."""


class Recorder:
    """Records one run; at its end call `drain`, or `abandon`.

    Args:
        file: the recording to write; None records nothing but the digest.
        layout: the messages of the run.
        record_steps: False keeps the steps' digest but not the steps.
        reference: what the recording already holds.
        beat: called about once a second while the recorder is in use, by the thread that writes.
        threads: False packs and writes in the thread that records.
        before: called once, before the first message is written. With it, threads are started and messages
            written only when some have gathered, or by `release`, so that a short recording costs little. The
            chunks of all topics are written together then, at each flush: whatever ends the process, the file
            has no steps without their resets. The caller calls `write_if_full`, and `flush`.
        observer: what it sees of the time, the machine and the output is recorded.
    """

    def __init__(
        self,
        file: RecordingFile | None,
        layout: Layout,
        packing: Packing | None = None,
        record_steps: bool = True,
        reference: Reference | None = None,
        beat: Callable[[], None] = lambda: None,
        threads: bool = True,
        before: Callable[[], None] | None = None,
        observer: Observer | None = None,
    ) -> None:
        packing = replace(packing or Packing(), values=not layout.has_states)
        self._file = file
        self._watchers: dict[MessageType, Watcher] = {}
        self._grouped = before is not None
        self._chunk_steps = packing.chunk_steps
        self._reference = reference or Reference()
        self._lanes = {
            topic: self._lane(topic, layout.message(topic), record_steps or topic.message is not schema.STEP)
            for topic in layout.topics
            if topic in schema.ROW_TOPICS
        }
        self.steps = {"train": 0, "eval": 0, "elsewhere": 0}
        """Steps committed so far, by phase; and training steps of other processes, where they are stated."""
        self.position = 0
        """The sum of these steps."""
        self.counts = {topic.name: 0 for topic in schema.ALL_TOPICS}
        """Messages committed so far, by topic."""
        self._last_flush = time.monotonic()
        self._pipeline = Pipeline(file, packing, beat, threads, before)
        self._batches = MessageBatches(self._pipeline.send)
        self.when_full: Callable[[], None] = self.flush
        """Writes everything, also what the caller holds; called when a block of steps was full."""
        self._is_full = False
        """Whether a block of steps was full since the last flush."""
        self._observer = observer
        self._record_machine()

    def _lane(self, topic: Topic, message: MessageType, write: bool) -> _Lane:
        return _Lane(topic, message, capacity_of(topic, message, self._chunk_steps), write)

    @property
    def bytes_written(self) -> int:
        """Bytes in the file so far."""
        return self._file.size if self._file is not None else 0

    def set_layout(self, layout: Layout) -> None:
        """Change the types of messages of which none was recorded yet."""
        for topic, lane in self._lanes.items():
            message = layout.message(topic)
            if lane.message.fields != message.fields:
                assert not self.counts[topic.name]
                self._lanes[topic] = self._lane(topic, message, lane.write)

    def begin_extras(self, number: int, message: MessageType) -> None:
        """Record extras in the channels of a layout from now on, as messages of its type."""
        self._batches.flush()
        for topic in [topic for topic in self._lanes if topic.message is schema.EXTRA]:
            self._send_block(self._lanes.pop(topic))
        for phase in schema.PHASES:
            topic = schema.extra_topic(phase, number)
            self._lanes[topic] = self._lane(topic, message, write=True)
        if self._file is not None:
            self._file.declare(beginning_of_extras(number, message))

    def advance(self, phase: str, steps: int) -> None:
        """Count further steps of a phase."""
        self.steps[phase] += steps
        self.position += steps

    def release(self) -> None:
        """Write what was held back, and hold nothing back from now on."""
        self._pipeline.release()

    def raise_failure(self) -> None:
        """Raise the error that stopped the writing, if there was one."""
        self._pipeline.raise_failure()

    def dtype(self, topic: Topic) -> RecordDType:
        """Return the dtype of the rows of a topic."""
        return row_dtype(self._lanes[topic].message)

    def watch(self, message: MessageType, watcher: Watcher) -> None:
        """Call a function with the rows of such messages as they are committed; their block is used again."""
        self._watchers[message] = watcher

    def block(self, topic: Topic) -> Records:
        """Return the free records of the topic's open block, to be filled from the first on."""
        lane = self._lanes[topic]
        if lane.open is None:
            lane.open = self._take_block(lane)
        free = lane.open[lane.filled :]
        limit = self._reference.remaining(topic)
        return free[:limit] if limit else free

    def fill(self, topic: Topic, positions: Unsigned) -> Iterator[tuple[Records, slice]]:
        """Yield blocks to fill with the records of a slice; `take` follows with `positions`, one a record."""
        done = 0
        n = len(positions)
        while done < n:
            block = self.block(topic)[: n - done]
            part = slice(done, done + len(block))
            yield block, part
            self.take(topic, positions[part])
            done = part.stop

    def put(self, topic: Topic, columns: Mapping[str, Array], positions: Array) -> None:
        """Record messages of a fixed-width topic, given by field; `positions` are as for `take`."""
        for block, part in self.fill(topic, positions.astype(np.uint64)):
            for name, values in columns.items():
                block[name] = values[part]

    def capacity(self, topic: Topic) -> int:
        """Return how many records a whole block of a fixed-width topic has."""
        return self._lanes[topic].capacity

    def commit(self, phase: str, steps: int, episodes: int) -> None:
        """Record the filled records of the phase's blocks; write blocks that are full or old.

        Raises:
            StorageError: the disk is full or failing; everything before is kept.
            Diverged: a record differs from the one that the recording already holds.
        """
        self._pipeline.raise_failure()
        topics = schema.topics_of(phase)
        other = self.position - self.steps[phase]
        if steps:
            first = self.position + 1
            self.take(topics.steps, np.arange(first, first + steps, dtype=np.uint64))
            self.advance(phase, steps)
        if episodes:
            last_steps = self._filled(topics.episodes, episodes)["last_step"]
            self.take(topics.episodes, last_steps.astype(np.uint64) + np.uint64(other + 1))
        if time.monotonic() - self._last_flush > FLUSH_SECONDS:
            self.flush()

    def write_if_full(self) -> None:
        """Write everything if a block of steps was full; call it when their resets and episodes are taken."""
        if self._is_full:
            self.when_full()

    def message(self, topic: Topic, payload: bytes) -> bool:
        """Record one message of variable size at the current logical time, in a chunk of its own.

        Returns whether it is new: not in the recording already.
        """
        self._pipeline.raise_failure()
        log_time = self.position * STEP_NANOSECONDS
        self.counts[topic.name] += 1
        is_recorded = self._reference.compare_message(topic, log_time, payload)
        self._pipeline.send(topic, *lone_message(topic, log_time, payload), write=not is_recorded)
        return not is_recorded

    def append(self, topic: Topic, payload: bytes, position: int) -> None:
        """Record one message of variable size; arguments and errors as for `extend`."""
        self.extend(topic, [payload], [position])

    def extend(self, topic: Topic, payloads: Sequence[bytes], positions: Sequence[int]) -> None:
        """Record messages of variable size, in a chunk with others of their topic.

        Args:
            positions: for each message the number of steps executed so far.
        """
        self._pipeline.raise_failure()
        self._batches.extend(topic, [position * STEP_NANOSECONDS for position in positions], payloads)
        self._is_full |= self._grouped and topic.message is schema.STEP
        if topic not in schema.MACHINE_TOPICS:  # of which a resumed run does not know the number
            self.counts[topic.name] += len(payloads)

    def submit(self, topic: Topic, make: Callable[[], bytes], position: int) -> None:
        """Record one message that is made by a thread of the recorder.

        Its topic must be one that the digest does not cover.
        """
        self._pipeline.raise_failure()
        self.counts[topic.name] += 1
        self._pipeline.submit(topic, make, position * STEP_NANOSECONDS)

    def flush(self) -> None:
        """Write every open block and batch now; records that were not taken must be put down again."""
        self._record_machine()
        self._send_open()

    def _send_open(self) -> None:
        """Send every open block and batch to the pipeline."""
        self._batches.flush()
        for lane in self._lanes.values():
            self._send_block(lane)
        self._pipeline.end_group()
        self._is_full = False
        self._last_flush = time.monotonic()

    def drain(self) -> dict[str, str]:
        """Write everything committed, stop the threads, and return the hash of each topic."""
        self._record_machine(is_last=True)
        self._send_open()
        self._pipeline.close()
        self._pipeline.raise_failure()
        return self._pipeline.hash.topics()

    def totals(self, topic_digests: Mapping[str, str]) -> Json:
        """Return the totals in a result; `topic_digests` is what `drain` returned."""
        return {
            "content_digest": combined_digest(topic_digests),
            "topic_digests": topic_digests,
            "train_steps": self.steps["train"],
            "eval_steps": self.steps["eval"],
            "messages": {name: count for name, count in self.counts.items() if count},
        }

    def abandon(self) -> None:
        """Write what was committed, unless writing failed, and stop the threads of a run that failed."""
        if self._file is not None and self._pipeline.is_open and self._pipeline.failure is None:
            self._record_machine(is_last=True)
            self._send_open()
        elif self._observer is not None:
            self._observer.take(is_last=True)
        self._pipeline.close()

    def _record_machine(self, is_last: bool = False) -> None:
        """Record what was seen of the time, the machine and the output.

        A resumed run has none of it before it has new steps.
        """
        if self._observer is not None and self._reference.exhausted:
            position = self.position * STEP_NANOSECONDS
            for topic, message in self._observer.take(is_last):
                self._batches.extend(topic, [position], [message])

    def take(self, topic: Topic, positions: Unsigned) -> None:
        """Take the next filled records of the topic's block: set their times, compare or keep them.

        Args:
            positions: for each record the number of steps executed so far, 0.1 s each.

        Raises:
            Diverged: a record differs from the one that the recording already holds.
        """
        lane = self._lanes[topic]
        fresh = self._filled(topic, len(positions))
        if fresh.dtype.hasobject:  # messages of varying size, and the block is filled again
            self.extend(topic, encode_rows(lane.message, fresh), positions.tolist())
            return
        has_reference = self._reference.remaining(topic) > 0
        times = positions * np.uint64(STEP_NANOSECONDS)
        fresh["log_time"] = times
        fresh["publish_time"] = times
        self._reference.compare_block(topic, fresh)
        lane.filled += len(positions)
        self.counts[topic.name] += len(positions)
        if topic.message in self._watchers:
            self._watchers[topic.message](topic, rows_of(lane.message, fresh))
        if has_reference:
            self._send_block(lane, write=False)
        elif lane.open is not None and lane.filled == len(lane.open):
            if self._grouped and topic.message is schema.STEP:
                self._is_full |= lane.filled == lane.capacity  # the first, smaller block can wait
            self._send_block(lane)

    def _filled(self, topic: Topic, count: int) -> Records:
        """Return the next records of the topic's open block."""
        lane = self._lanes[topic]
        assert lane.open is not None, "records were committed before `block` was called"
        records: Records = lane.open[lane.filled : lane.filled + count]
        return records

    def _take_block(self, lane: _Lane) -> Records:
        """Return a block to fill: one that was used before, or a new one while there may be more."""
        if self._grouped and not lane.has_started and record_dtype(lane.message):
            lane.has_started = True
            return blank_records(lane.topic, lane.message, min(_FIRST_RECORDS, lane.capacity))
        if lane.made < MAX_BLOCKS and lane.free.empty():
            lane.made += 1
            return blank_records(lane.topic, lane.message, lane.capacity)
        return lane.free.get()

    def _send_block(self, lane: _Lane, write: bool = True) -> None:
        """Send the records of the lane's open block to the pipeline; the block comes back when written."""
        if lane.open is None or not lane.filled:
            return
        block = lane.open
        filled = lane.open[: lane.filled]
        lane.open, lane.filled = None, 0
        is_whole = len(block) == lane.capacity  # the first, smaller one is not used again
        self._pipeline.send(
            lane.topic,
            filled.view(np.uint8).data.cast("B"),
            filled["log_time"],
            np.arange(len(filled), dtype=np.uint64) * np.uint64(filled.itemsize),
            write=write and lane.write,
            done=partial(lane.free.put, block) if is_whole else lambda: None,
        )


def capacity_of(topic: Topic, message: MessageType, chunk_steps: int) -> int:
    """Return how many records a block of a topic has; `message` is the type of its messages in the run."""
    dtype = record_dtype(message)
    limit = EPISODES_A_BLOCK if topic.message in (schema.EPISODE, schema.RESET) else chunk_steps
    if dtype is None:  # messages of varying size, which share chunks of fewer
        return min(limit, MAX_BATCH_MESSAGES)
    return max(1, min(limit, BLOCK_BYTES // dtype.itemsize))


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
