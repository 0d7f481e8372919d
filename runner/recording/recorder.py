"""The recorder: blocks of records in, a recording on disk out, beside the thread that learns.

    learner fills a block -> commit -> encoder threads (checksum, compression) -> writer thread -> file

The learner fills message records in place, in buffers that go round; when all of them are under way it
waits, so memory is bounded. Blocks reach the file, and the digest, in the order they were committed.
"""

from __future__ import annotations

import os
import queue
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import StorageError
from runner.recording import schema
from runner.recording.chunks import Chunk, Packing, encode_chunk
from runner.recording.digest import ContentHash
from runner.recording.schema import STEP_NANOSECONDS, Topic
from runner.recording.writer import RecordingFile

FLUSH_SECONDS: Final = 0.5
"""An open block is closed when it is this old; with the time to write it, well under a second."""
SYNC_SECONDS: Final = 5.0
"""How often the system is asked to put on disk what was written."""
BLOCKS_UNDER_WAY: Final = 8
EPISODES_A_BLOCK: Final = 2048
ENCODERS: Final = 2


@dataclass
class _Block:
    """A buffer of records of one topic, and how far it is filled."""

    topic: Topic
    records: NDArray[np.void]
    filled: int = 0


@dataclass(frozen=True)
class _Work:
    """What the writer thread gets: records for the digest, perhaps a chunk for the file."""

    topic: Topic
    records: memoryview
    chunk: Future[Chunk] | None
    block: _Block | None = None


@dataclass
class _Lane:
    """The buffers of one fixed-width topic."""

    topic: Topic
    counts: tuple[int, ...]
    capacity: int
    open: _Block | None = None
    free: queue.SimpleQueue[_Block] = field(default_factory=queue.SimpleQueue)
    made: int = 0


class Recorder:
    """Records one run. Use as a context manager, or call `finish` or `abandon` in the end.

    Args:
        path: the file to create; must not exist.
        learners: number of reward columns.
        events: number of event counters.
        packing: how chunks are packed.
        chunk_steps: the most steps in a chunk.
        record_steps: False keeps the steps' digest but not the steps.
        beat: called about once a second while the recorder lives, from its own thread.
    """

    def __init__(
        self,
        path: Path,
        learners: int,
        events: int,
        packing: Packing | None = None,
        chunk_steps: int = 16_384,
        record_steps: bool = True,
        beat: Callable[[], None] = lambda: None,
    ) -> None:
        self._packing = packing or Packing()
        self._record_steps = record_steps
        self._beat = beat
        self._hash = ContentHash()
        self._lanes = {
            topic: _Lane(
                topic,
                schema.block_counts(topic, learners, events),
                chunk_steps if topic.message is schema.STEP else EPISODES_A_BLOCK,
            )
            for topic in schema.BLOCK_TOPICS
        }
        self.steps = {"train": 0, "eval": 0}
        """Steps recorded so far, a phase."""
        self.counts = {topic.name: 0 for topic in schema.TOPICS}
        """Messages recorded so far, a topic."""
        self._failure: BaseException | None = None
        self._last_flush = time.monotonic()
        try:
            self._file = RecordingFile(path)
        except OSError as error:
            raise StorageError(
                f"{path}: cannot be created ({error.strerror}); choose another --recordings."
            ) from error
        self._encoders = ThreadPoolExecutor(ENCODERS, thread_name_prefix="encoder")
        self._work: queue.Queue[_Work | None] = queue.Queue(maxsize=4 * BLOCKS_UNDER_WAY)
        self._writer = threading.Thread(target=self._write_all, name="recording-writer", daemon=True)
        self._writer.start()

    # --- what a learner does -------------------------------------------------------------------------

    def block(self, topic: Topic) -> NDArray[np.void]:
        """Return the free records of the topic's open block, to be filled from the first on."""
        lane = self._lanes[topic]
        if lane.open is None:
            lane.open = self._take_block(lane)
        return lane.open.records[lane.open.filled :]

    def commit(self, phase: str, steps: int, episodes: int) -> None:
        """Say how many records of the phase's blocks were filled; closes what is full or old.

        Raises:
            StorageError: the disk is full or failing; everything before is kept.
        """
        self._raise_failure()
        step_topic, episode_topic = schema.PHASES[phase]
        other = self.steps["eval" if phase == "train" else "train"]
        step_block, episode_block = self._lanes[step_topic].open, self._lanes[episode_topic].open
        if steps and step_block is not None:
            first = self.steps[phase] + other + 1
            _stamp(step_block, np.arange(first, first + steps, dtype=np.uint64))
            self.steps[phase] += steps
            self.counts[step_topic.name] += steps
        if episodes and episode_block is not None:
            fresh = episode_block.records[episode_block.filled : episode_block.filled + episodes]
            _stamp(episode_block, fresh["last_step"].astype(np.uint64) + np.uint64(other + 1))
            self.counts[episode_topic.name] += episodes
        for topic in (step_topic, episode_topic):
            block = self._lanes[topic].open
            if block is not None and block.filled == len(block.records):
                self._close_block(topic)
        if time.monotonic() - self._last_flush > FLUSH_SECONDS:
            self.flush()

    def message(self, topic: Topic, payload: bytes) -> None:
        """Record one message of a topic of variable size, at the present logical time."""
        self._raise_failure()
        log_time = (self.steps["train"] + self.steps["eval"]) * STEP_NANOSECONDS
        header = np.zeros((), dtype=schema.HEADER)
        header["opcode"], header["channel_id"] = 5, topic.channel
        header["record_length"] = schema.HEADER_BYTES - 9 + len(payload)
        header["log_time"] = header["publish_time"] = log_time
        records = memoryview(header.tobytes() + payload)
        times = np.array([log_time], dtype=np.uint64)
        chunk = self._encoders.submit(
            encode_chunk, topic, records, times, np.zeros(1, np.uint64), self._packing
        )
        self.counts[topic.name] += 1
        self._put(_Work(topic, records, chunk))

    def flush(self) -> None:
        """Close every open block, so that it is written now."""
        for topic, lane in self._lanes.items():
            if lane.open is not None and lane.open.filled:
                self._close_block(topic)
        self._last_flush = time.monotonic()

    # --- what stands beside the messages -------------------------------------------------------------

    def metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Write a metadata record; only before the first message or through `finish`."""
        self._file.add_metadata(name, entries)

    def attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment; only before the first message."""
        self._file.add_attachment(name, media_type, data)

    @property
    def bytes_written(self) -> int:
        """Bytes in the file so far."""
        return self._file.size

    # --- the end -------------------------------------------------------------------------------------

    def drain(self) -> dict[str, str]:
        """Write everything committed, stop the threads, and return the hash of each topic."""
        self.flush()
        self._put(None)
        self._writer.join()
        self._encoders.shutdown()
        self._raise_failure()
        return self._hash.topics()

    def finish(self, name: str, entries: Mapping[str, str]) -> None:
        """After `drain`: write a last metadata record, the index and the summary; close the file."""
        try:
            self._file.add_metadata(name, entries)
            self._file.finish()
        except OSError as error:
            self._file.cut_back()
            raise self._storage_error(error) from error
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Stop the threads and close the file as it is: what was written stays readable."""
        if self._writer.is_alive():
            self._put(None)
            self._writer.join()
        self._encoders.shutdown(cancel_futures=True)
        self._file.close()

    # --- inside --------------------------------------------------------------------------------------

    def _take_block(self, lane: _Lane) -> _Block:
        """Return a block to fill: a used one that came back, or a new one while there may be more."""
        if lane.made < BLOCKS_UNDER_WAY and lane.free.empty():
            lane.made += 1
            records = schema.blank_records(lane.topic, lane.counts, lane.capacity)
            return _Block(lane.topic, records.view(np.recarray))
        while True:
            try:
                block = lane.free.get(timeout=1.0)
            except queue.Empty:
                self._raise_failure()
                continue
            block.filled = 0
            return block

    def _close_block(self, topic: Topic) -> None:
        """Send the topic's open block on its way."""
        lane = self._lanes[topic]
        block, lane.open = lane.open, None
        if block is None:
            return
        filled = block.records[: block.filled]
        view = filled.view(np.uint8).data.cast("B")
        chunk = None
        if self._record_steps or topic.message is not schema.STEP:
            offsets = np.arange(block.filled, dtype=np.uint64) * np.uint64(filled.itemsize)
            chunk = self._encoders.submit(
                encode_chunk, topic, view, filled["log_time"], offsets, self._packing
            )
        self._put(_Work(topic, view, chunk, block))

    def _put(self, work: _Work | None) -> None:
        self._work.put(work)

    def _write_all(self) -> None:
        """Take work in order: into the digest, into the file. After a failure only give blocks back."""
        last_beat = last_sync = time.monotonic()
        while True:
            try:
                work = self._work.get(timeout=1.0)
            except queue.Empty:
                self._beat()
                continue
            if work is None:
                return
            try:
                if self._failure is None:
                    self._write(work)
            except BaseException as error:  # handed to the learner's thread
                self._failure = error
            if work.block is not None:
                self._lanes[work.topic].free.put(work.block)
            now = time.monotonic()
            if now - last_beat > 1.0:
                self._beat()
                last_beat = now
            if now - last_sync > SYNC_SECONDS and self._failure is None:
                self._file.sync()
                last_sync = now

    def _write(self, work: _Work) -> None:
        self._hash.update(work.topic, work.records)
        if work.chunk is None:
            return
        try:
            self._file.add_chunk(work.topic, work.chunk.result())
        except OSError:
            self._file.cut_back()
            raise

    def _raise_failure(self) -> None:
        if isinstance(self._failure, OSError):
            raise self._storage_error(self._failure) from self._failure
        if self._failure is not None:
            raise self._failure

    def _storage_error(self, error: OSError) -> StorageError:
        return StorageError(
            f"{self._file.path}: writing failed ({error.strerror or os.strerror(error.errno or 0)}) after "
            f"{self._file.size:,} bytes. What was written is kept and can be read; free some disk, or choose "
            "another --recordings."
        )


def _stamp(block: _Block, positions: NDArray[np.uint64]) -> None:
    """Set the logical time of the next records of a block: steps executed so far, 0.1 s each."""
    fresh: Any = block.records[block.filled : block.filled + len(positions)]
    times = positions * np.uint64(STEP_NANOSECONDS)
    fresh["log_time"] = times
    fresh["publish_time"] = times
    block.filled += len(positions)
