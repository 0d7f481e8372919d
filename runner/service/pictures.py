"""Pictures of episodes for pages: streams of them, each made by a thread a little ahead of what is sent.

An environment that is made again for an episode only goes forward, and takes a while to start. So a stream
is kept for some seconds after a response, and the next request continues it; when nobody comes back, it is
closed, and with it the process of the environment.
"""

from __future__ import annotations

import asyncio
import contextlib
import struct
import threading
import time
from collections.abc import AsyncIterator, Callable, Generator, Hashable
from contextlib import closing
from typing import Final

from runner.errors import RunnerError
from runner.service.errors import Busy
from runner.service.logs import LOG

MAX_STREAMS: Final = 4
"""Episodes whose pictures are made at the same time, or kept; each may have a process."""
IDLE_SECONDS: Final = 8.0
"""How long a stream is kept after a response."""
AHEAD: Final = 32
"""Pictures that are made before they are requested."""
_JOIN_SECONDS: Final = 1.0
"""How long the end of the service waits for a stream: an environment may hang."""
_LENGTH: Final = struct.Struct(">I")
_FAILED: Final = _LENGTH.pack(2**32 - 1)
"""In place of a length: what follows is the reason why there are no further pictures."""

_NOTE: Final = _LENGTH.pack(2**32 - 2)
"""In place of a length: what follows is a note on all further pictures, after its length."""
_BUSY: Final = "the pictures of too many episodes are being made at the moment; try again."

Make = Callable[[int], Generator[bytes | str, None, None]]
"""Returns the pictures of an episode from a step on, as `encoded_pictures` does."""


class PictureStream:
    """The pictures of an episode from a step on."""

    def __init__(self, key: Hashable, make: Make, start: int) -> None:
        self.key = key
        self.next = start
        """The step of the next picture."""
        self.idle_since: float | None = None
        """None while a response is being sent."""
        self._last = b""
        self._end: RunnerError | None = None
        self._has_ended = False
        self.is_closed = False
        self._loop = asyncio.get_running_loop()
        self._made: asyncio.Queue[bytes | str | RunnerError | None] = asyncio.Queue()
        self._places = threading.Semaphore(AHEAD)
        self._thread = threading.Thread(target=self._work, args=(make, start), name="pictures", daemon=True)
        self._thread.start()

    @property
    def is_alive(self) -> bool:
        """Whether its thread runs: also a closed one, until the environment has returned."""
        return self._thread.is_alive()

    @property
    def can_continue(self) -> bool:
        """Whether another response may continue it."""
        return not self.is_closed and self.idle_since is not None

    def close(self) -> None:
        """End the thread, and the process of an environment, as soon as possible."""
        self.is_closed = True
        self._places.release()

    def join(self, seconds: float) -> None:
        """Wait for the thread to end, at most some seconds."""
        self._thread.join(seconds)

    async def records(self, start: int, stop: int) -> AsyncIterator[bytes]:
        """Yield the pictures from step `start` up to `stop`, as far as there are any, each after its length.

        One that is the same as the one before it has no bytes. `_FAILED` and the reason take the place of
        those that cannot be made.
        """
        while self.next < stop and not self._has_ended:
            made = await self._made.get()
            if isinstance(made, bytes):
                self._places.release()
                self._last = made or self._last
                number, self.next = self.next, self.next + 1
                if number >= start:
                    data = self._last if number == start else made
                    yield _LENGTH.pack(len(data)) + data
            elif isinstance(made, str):
                self._places.release()
                note = made.encode(errors="replace")
                yield _NOTE + _LENGTH.pack(len(note)) + note
            else:
                self._has_ended, self._end = True, made
        if self._end is not None:
            yield _FAILED + str(self._end).encode(errors="replace")

    def _work(self, make: Make, start: int) -> None:
        end: RunnerError | None = None
        try:
            with closing(make(start)) as pictures:
                for picture in pictures:
                    self._places.acquire()
                    if self.is_closed:
                        return
                    self._put(picture)
        except (RunnerError, OSError) as error:
            end = (
                error if isinstance(error, RunnerError) else RunnerError(f"cannot be read ({error.strerror})")
            )
        except Exception:  # an environment, or Pillow, may raise anything
            LOG.exception("pictures")
            end = RunnerError(
                "The pictures of this episode cannot be made; the service's log has the reason."
            )
        self._put(end)

    def _put(self, made: bytes | str | RunnerError | None) -> None:
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._made.put_nowait, made)


class PictureStreams:
    """The streams of a service, at most `MAX_STREAMS`."""

    def __init__(self) -> None:
        self._streams: list[PictureStream] = []

    def close(self) -> None:
        """Close all streams, and wait a little for those that can end."""
        for stream in self._streams:
            stream.close()
        for stream in self._streams:
            stream.join(_JOIN_SECONDS)

    def open(self, key: Hashable, make: Make, start: int) -> PictureStream:
        """Return a stream that has the picture at step `start` before it: one that was kept, or a new one.

        Raises:
            Busy: there are too many.
        """
        self._streams = [stream for stream in self._streams if stream.is_alive or stream.can_continue]
        own = [stream for stream in self._streams if stream.key == key and stream.can_continue]
        for stream in own:
            if stream.next <= start:
                stream.idle_since = None
                return stream
            self._close(stream)  # it would have to go back
        alive = [stream for stream in self._streams if stream.is_alive]
        if len([stream for stream in alive if not stream.is_closed]) >= MAX_STREAMS:
            continuing = [stream for stream in alive if stream.can_continue]
            if not continuing:
                raise Busy(_BUSY)
            self._close(min(continuing, key=lambda stream: stream.idle_since or 0.0))
        if len(alive) >= 2 * MAX_STREAMS:  # environments that hang
            raise Busy(_BUSY)
        stream = PictureStream(key, make, start)
        self._streams.append(stream)
        return stream

    async def send(self, stream: PictureStream, start: int, stop: int) -> AsyncIterator[bytes]:
        """Yield the records of a stream, and keep it for the next request."""
        try:
            async for record in stream.records(start, stop):
                yield record
        finally:
            self._keep(stream)

    def prepare(self, key: Hashable, make: Make, start: int) -> None:
        """Begin a stream that will be requested soon, if that is possible."""
        with contextlib.suppress(Busy):
            self._keep(self.open(key, make, start))

    def _keep(self, stream: PictureStream) -> None:
        stream.idle_since = time.monotonic()
        asyncio.get_running_loop().call_later(IDLE_SECONDS, self._close_idle)

    def _close_idle(self) -> None:
        for stream in list(self._streams):
            if stream.idle_since is not None and time.monotonic() - stream.idle_since >= IDLE_SECONDS - 0.1:
                self._close(stream)

    def _close(self, stream: PictureStream) -> None:
        stream.close()
        if not stream.is_alive:
            self._streams.remove(stream)
