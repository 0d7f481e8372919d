"""From records to the file, beside the thread that learns: threads that checksum, compress and write.

    send(records) -> encoder threads (checksum, compression) -> writer thread (digest, file)

Work reaches the digest and the file in the order it was sent; how much can be under way is bounded. Where
there is one processor for all, whoever sends does it: handing it over would only cost.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.recording.blocks import message_record
from runner.recording.chunks import Chunk, encode_chunk
from runner.recording.digest import ContentHash
from runner.recording.schema import Topic
from runner.recording.writer import RecordingFile, storage_error
from runner.util.packing import Packing

ENCODERS: Final = 2
WORK_UNDER_WAY: Final = 32
MOST_HELD: Final = 4
"""Pieces of work that are held before threads are started; fewer than a topic has buffers."""
SYNC_SECONDS: Final = 5.0
"""How often the system is asked to put on disk what was written."""
_BEAT_SECONDS: Final = 1.0


@dataclass(frozen=True)
class _Work:
    """Records for the digest, perhaps a chunk of them for the file, and whom to tell when they are used."""

    topic: Topic
    records: memoryview
    encode: Callable[[], Chunk] | None
    used: Callable[[], None]


class Pipeline:
    """Takes whole message records in order; `close` waits until all is written.

    Args:
        file: where chunks go; None for the digest alone.
        packing: how chunks are packed.
        beat: called about once a second from the writer's thread, or when something is sent.
        threads: False has the sender do the work.
        before: called once, before anything is written. Given it, the pipeline holds what it is sent, up to
            `MOST_HELD` pieces, until `release`; threads are started only then, and a recording that is
            closed before does without them.
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
        self.failure: BaseException | None = None
        """What went wrong while writing; from then on nothing more is written."""
        self._file = file
        self._packing = packing
        self._beat = beat
        self._closed = False
        self._last_beat = self._last_sync = time.monotonic()
        self._encoders: ThreadPoolExecutor | None = None
        self._writer: threading.Thread | None = None
        self._work: queue.Queue[tuple[_Work, Future[Chunk] | None] | None] = queue.Queue(WORK_UNDER_WAY)
        self._before = before
        self._held: list[_Work] | None = None if before is None else []
        if threads and before is None:
            self._start()

    def _start(self) -> None:
        self._encoders = ThreadPoolExecutor(ENCODERS, thread_name_prefix="encoder")
        self._writer = threading.Thread(target=self._run, name="recording-writer", daemon=True)
        self._writer.start()

    def send(
        self,
        topic: Topic,
        records: memoryview,
        log_times: NDArray[np.uint64],
        offsets: NDArray[np.uint64],
        write: bool = True,
        used: Callable[[], None] = lambda: None,
    ) -> None:
        """Send message records of one topic on their way; waits while too many are.

        Args:
            topic: the topic of all of them.
            records: their bytes; must not change until `used` is called.
            log_times: nanoseconds, one a record.
            offsets: where each begins.
            write: False leaves them out of the file; the digest covers them all the same.
            used: called when they were written, by who writes.
        """
        encode = None
        if write and self._file is not None:
            encode = partial(encode_chunk, topic, records, log_times, offsets, self._packing)
        self._hand_over(_Work(topic, records, encode, used))

    def submit(self, topic: Topic, make: Callable[[], bytes], log_time: int) -> None:
        """Send one message of a topic on its way that is yet to be made; waits while too many are.

        Args:
            topic: its topic; the digest must not cover it.
            make: returns the message; called by who encodes.
            log_time: nanoseconds.
        """
        assert not topic.digested

        def encoded() -> Chunk:
            record = message_record(topic, log_time, make())
            times = np.array([log_time], np.uint64)
            return encode_chunk(topic, record, times, np.zeros(1, np.uint64), self._packing)

        encode = encoded if self._file is not None else None
        self._hand_over(_Work(topic, memoryview(b""), encode, lambda: None))

    def release(self, threads: bool = True) -> None:
        """Write what is held, and hold nothing from now on; `threads` False does so without threads.

        Raises:
            BaseException: what `before` raised; nothing is written then, now or later.
        """
        held, self._held, before, self._before = self._held, None, self._before, None
        if held is None or before is None:
            return
        try:
            before()
        except BaseException as error:
            self.failure = error
            raise
        if threads:
            self._start()
        for work in held:
            self._hand_over(work)

    @property
    def open(self) -> bool:
        """Whether it takes more: it was not closed."""
        return not self._closed and (self._writer is None or self._writer.is_alive())

    def raise_failure(self) -> None:
        """Raise what went wrong while writing, if something did.

        Raises:
            StorageError: the disk is full or failing.
        """
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
                self._work.put(None)
                self._writer.join()
            if self._encoders is not None:
                self._encoders.shutdown(cancel_futures=True)

    def _hand_over(self, work: _Work) -> None:
        if self._held is not None:
            self._held.append(work)
            if len(self._held) == MOST_HELD:
                self.release()
        elif self._writer is None:
            self._do(work, None)
        else:
            self._work.put((work, self._encode(work.encode)))

    def _encode(self, encode: Callable[[], Chunk] | None) -> Future[Chunk] | None:
        """Give work to an encoder thread; None if there is none, also when the interpreter is exiting."""
        if self._encoders is not None and encode is not None:
            with contextlib.suppress(RuntimeError):
                return self._encoders.submit(encode)
        return None

    def _run(self) -> None:
        while True:
            try:
                work = self._work.get(timeout=_BEAT_SECONDS)
            except queue.Empty:
                self._beat()
                continue
            if work is None:
                return
            self._do(*work)

    def _do(self, work: _Work, chunk: Future[Chunk] | None) -> None:
        now = time.monotonic()
        try:
            if self.failure is None:
                self._write(work, chunk)
                if now - self._last_sync > SYNC_SECONDS and self._file is not None:
                    self._file.sync()
                    self._last_sync = now
        except BaseException as error:  # handed to who records
            self.failure = error
        work.used()
        if now - self._last_beat > _BEAT_SECONDS:
            self._beat()
            self._last_beat = now

    def _write(self, work: _Work, encoded: Future[Chunk] | None) -> None:
        self.hash.update(work.topic, work.records)
        if work.encode is None or self._file is None:
            return
        chunk = work.encode() if encoded is None else encoded.result()
        try:
            self._file.add_chunk(work.topic, chunk)
        except OSError:
            self._file.cut_back()
            raise
