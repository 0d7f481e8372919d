"""From records to the file, off the thread that learns: threads that checksum, compress and write.

    send(records) -> encoder threads (checksum, compression) -> writer thread (digest, file)

Work reaches the digest and the file in the order in which it was sent; how much is pending is bounded. Chunks
of a group are written at once: whatever ends the process or fills the disk, the steps in the file have their
resets and episodes. On a single processor the sending thread does the work itself: handing it over would only
cost time.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Final

import numpy as np

from runner.recording.digest import ContentHash
from runner.recording.layout import HEADER_BYTES, MESSAGE, MESSAGE_HEAD, RECORD_HEAD, lone_message
from runner.recording.records import Chunk, encode_chunk
from runner.recording.schema import ACTIONS, RESET, RESET_OPTIONS, RESET_STATE, STEP, TOPIC_OF, Topic
from runner.recording.writer import RecordingFile, storage_error
from runner.util.arrays import Unsigned
from runner.util.packing import Packing

ENCODERS: Final = 2
"""Threads that compress."""
MAX_PENDING: Final = 32
"""Pieces of work that wait for the writer's thread before the sender waits."""
MAX_HELD: Final = 4
"""Pieces of work that are held before threads are started; fewer than a topic has buffers."""
SYNC_SECONDS: Final = 5.0
"""Interval at which what was written is synced to disk: what a power failure may cost. A sync takes
milliseconds, in which nothing is written."""
MAX_BATCH_BYTES: Final = 1 << 18
MAX_BATCH_MESSAGES: Final = 4096
"""A batch of messages is sent before it has more than either."""
_BEAT_SECONDS: Final = 1.0

Send = Callable[[Topic, memoryview, Unsigned, Unsigned], None]
"""Takes the records of a topic, their times in nanoseconds, and where each begins."""


@dataclass(frozen=True)
class _Work:
    """Records for the digest, the encoding of a chunk for the file if there is one, and a callback.

    Without a topic it is the end of a group of chunks.
    """

    topic: Topic | None = None
    records: bytes | memoryview = b""
    encode: Callable[[], Chunk] | None = None
    done: Callable[[], None] = lambda: None
    """Called when the records are not needed any more."""


class Pipeline:
    """Takes whole message records in order; `close` waits until all is written.

    Args:
        file: the file that chunks are written to; None for the digest alone.
        beat: called about once a second from the writer's thread, or when something is sent.
        threads: False makes the sender do the work.
        before: called once, before anything is written. With it, the pipeline holds up to `MAX_HELD` pieces
            of work until `release`; only then are threads started, so a recording that is closed earlier
            needs none. Chunks are held until `end_group`, and written then; else each is written by itself.
    """

    def __init__(
        self,
        file: RecordingFile | None,
        packing: Packing,
        beat: Callable[[], None],
        threads: bool = True,
        before: Callable[[], None] | None = None,
    ) -> None:
        self.hash = ContentHash()
        self._grouped = before is not None
        self._group: list[Chunk] = []
        self._is_empty = True
        """Whether no group was written yet."""
        self.failure: BaseException | None = None
        """The error that stopped the writing."""
        self._file = file
        self._packing = packing
        self._beat = beat
        self._closed = False
        self._last_sync = time.monotonic()
        self._last_beat = self._last_sync
        self._encoders: ThreadPoolExecutor | None = None
        self._writer: threading.Thread | None = None
        self._queue: queue.Queue[tuple[_Work, Future[Chunk] | None] | None]
        """Work in order, each with its chunk to come; None ends the writer's thread."""
        self._before = before
        self._held: list[_Work] | None = None if before is None else []
        if threads and before is None:
            self._start()

    def _start(self) -> None:
        self._queue = queue.Queue(MAX_PENDING)
        self._encoders = ThreadPoolExecutor(ENCODERS, thread_name_prefix="encoder")
        self._writer = threading.Thread(target=self._write_queue, name="recording-writer", daemon=True)
        self._writer.start()

    def send(
        self,
        topic: Topic,
        records: memoryview,
        log_times: Unsigned,
        offsets: Unsigned,
        write: bool = True,
        done: Callable[[], None] = lambda: None,
    ) -> None:
        """Send message records of one topic; waits while too much is pending.

        Args:
            records: their bytes; must not change until `done` is called.
            log_times: nanoseconds, one a record.
            write: False leaves them out of the file; the digest covers them all the same.
            done: called when they were written, by the thread that writes.
        """
        encode = None
        if write and self._file is not None:
            encode = partial(encode_chunk, topic, records, log_times, offsets, self._packing)
        self._enqueue(_Work(topic, records, encode, done))

    def submit(self, topic: Topic, make: Callable[[], bytes], log_time: int) -> None:
        """Send one message of a topic that an encoder thread makes; waits while too much is pending.

        Args:
            topic: its topic, which the digest must not cover.
        """
        assert not topic.digested

        def encode() -> Chunk:
            return encode_chunk(topic, *lone_message(topic, log_time, make()), self._packing)

        self._enqueue(_Work(topic, encode=encode if self._file is not None else None))

    def end_group(self) -> None:
        """Write what was sent since the last group: resets first, then steps, then all else."""
        self._enqueue(_Work())

    def release(self, threads: bool = True) -> None:
        """Write what is held, and hold nothing from now on; `threads` False does so without threads.

        Raises:
            BaseException: what `before` raised; nothing is written then, now or later.
        """
        held = self._held
        self._held = None
        before = self._before
        self._before = None
        if held is None or before is None:
            return
        try:
            before()
        except BaseException as error:
            self.failure = error
            raise
        if threads:
            self._start()
        for work in held:  # nothing else is sent meanwhile: the caller lets one thread send at a time
            self._enqueue(work)

    @property
    def is_open(self) -> bool:
        """Whether it takes more: it was not closed."""
        return not self._closed and (self._writer is None or self._writer.is_alive())

    def raise_failure(self) -> None:
        """Raise the error that stopped the writing, if there was one."""
        if isinstance(self.failure, OSError) and self._file is not None:
            raise storage_error(self._file, self.failure) from self.failure
        if self.failure is not None:
            raise self.failure

    def close(self) -> None:
        """Wait until everything sent is written, or was given up after a failure; stop the threads."""
        try:
            self.release(threads=False)
        finally:
            self._closed = True
            if self._writer is not None and self._writer.is_alive():
                self._queue.put(None)
                self._writer.join()
            if self._encoders is not None:
                self._encoders.shutdown(cancel_futures=True)

    def _enqueue(self, work: _Work) -> None:
        if self._held is not None:
            self._held.append(work)
            if sum(held.topic is not None for held in self._held) == MAX_HELD:
                self.release()
        elif self._writer is None:
            self._process(work, None)
        else:
            chunk = None
            if self._encoders is not None and work.encode is not None:
                with contextlib.suppress(RuntimeError):  # the interpreter is exiting: the writer encodes
                    chunk = self._encoders.submit(work.encode)
            self._queue.put((work, chunk))  # chunks are done in any order, and written in this one

    def _write_queue(self) -> None:
        while True:
            try:
                work = self._queue.get(timeout=_BEAT_SECONDS)
            except queue.Empty:
                self._beat_if_due()
                continue
            if work is None:
                return
            self._process(*work)

    def _process(self, work: _Work, chunk: Future[Chunk] | None) -> None:
        now = time.monotonic()
        try:
            if self.failure is None:
                self._write(work, chunk)
                if now - self._last_sync > SYNC_SECONDS and self._file is not None:
                    self._file.sync()
                    self._last_sync = now
        except BaseException as error:  # the recording thread raises it
            self.failure = error
        work.done()  # also after a failure, when nothing is written: the sender may wait for the block
        self._beat_if_due()

    def _beat_if_due(self) -> None:
        now = time.monotonic()
        if now - self._last_beat > _BEAT_SECONDS:
            self._last_beat = now
            try:
                self._beat()
            except BaseException as error:  # ends the writing, but not the thread: the sender may wait for it
                self.failure = self.failure or error

    def _write(self, work: _Work, encoded: Future[Chunk] | None) -> None:
        if work.topic is not None:
            self.hash.update(work.topic, work.records)
        if self._file is None:
            return
        if work.encode is not None:
            self._group.append(work.encode() if encoded is None else encoded.result())
        if self._group and (work.topic is None or not self._grouped):
            group, self._group = self._group, []
            try:
                self._file.add_chunks(sorted(group, key=_rank))
            except OSError:
                self._file.cut_back()
                if self._is_empty:  # a part of the first group is better than nothing
                    with contextlib.suppress(OSError):
                        for chunk in group:
                            self._file.add_chunk(chunk)
                    self._file.cut_back()
                raise
            self._is_empty = False


def _rank(chunk: Chunk) -> int:
    """Return the rank of a chunk in its group: if only a part of it is written, steps have their resets."""
    message = TOPIC_OF[chunk.entry.channel].message
    if message in (RESET, RESET_OPTIONS, RESET_STATE):
        return 0
    return 1 if message in (STEP, ACTIONS) else 2


@dataclass
class _Batch:
    """Message records of one topic that wait for a chunk."""

    records: list[bytes] = field(default_factory=list)
    times: list[int] = field(default_factory=list)
    size: int = 0
    """Bytes of the records."""


class MessageBatches:
    """Messages of variable size that share chunks: some thousands of a topic, or some hundred kilobytes."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self._batches: defaultdict[Topic, _Batch] = defaultdict(_Batch)

    def extend(self, topic: Topic, log_times: Sequence[int], payloads: Sequence[bytes]) -> None:
        """Add messages to their topic's batch."""
        # As `message_record` does, without a call for each: a loop may log many values at each step.
        pack = MESSAGE_HEAD.pack
        channel = topic.channel
        head = HEADER_BYTES - RECORD_HEAD.size
        records = [
            pack(MESSAGE, head + len(payload), channel, 0, time, time) + payload
            for time, payload in zip(log_times, payloads, strict=True)
        ]
        self.add(topic, log_times, records)

    def add(self, topic: Topic, log_times: Sequence[int], records: Sequence[bytes]) -> None:
        """Add whole message records to their topic's batch, or to as many as they fill."""
        for log_time, record in zip(log_times, records, strict=True):
            batch = self._batches[topic]
            if batch.times and (
                batch.size + len(record) > MAX_BATCH_BYTES or len(batch.times) == MAX_BATCH_MESSAGES
            ):
                self.flush_topic(topic)
                batch = self._batches[topic]
            batch.records.append(record)
            batch.times.append(log_time)
            batch.size += len(record)

    def flush(self) -> None:
        """Send every batch."""
        for topic in list(self._batches):
            self.flush_topic(topic)

    def flush_topic(self, topic: Topic) -> None:
        """Send the batch of a topic, if it has one."""
        if (batch := self._batches.pop(topic, None)) is None:
            return
        sizes = np.array([len(record) for record in batch.records], np.uint64)
        times = np.array(batch.times, np.uint64)
        self._send(topic, memoryview(b"".join(batch.records)), times, np.cumsum(sizes) - sizes)
