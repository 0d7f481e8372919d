"""Blocks of the pictures of episodes, made by streams: threads that are a little ahead of what is sent.

An environment that is made again for an episode only goes forward, and takes a while to start. So a stream
is kept for some seconds after a response, and the next request continues it; when nobody comes back, it is
closed, and with it the process of the environment.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable, Generator, Hashable
from contextlib import closing
from typing import Final, NamedTuple

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
BLOCK_SECONDS: Final = 1.0
"""A block has the pictures that are made this long after its first, so that slow ones are shown, too."""
_LOOK_SECONDS: Final = 0.2
"""How often a block that waits for a picture looks whether anybody still waits for the block."""
_BUSY: Final = "the pictures of too many episodes are being made at the moment; try again."

Make = Callable[[int], Generator[bytes | str, None, None]]
"""Returns the pictures of an episode from a step on, as `encoded_pictures` does."""
Gone = Callable[[], Awaitable[bool]]
"""Tells whether nobody waits for a response any more."""


class Block(NamedTuple):
    """Consecutive pictures."""

    pictures: list[bytes]
    """Without those that are the same as the one before."""
    shown: list[int]
    """The number of the picture at each step."""
    note: str
    """A sentence on all pictures; empty if they are of the best source."""
    problem: str
    """Why there are no further ones; empty if there are, or the episode is over."""


class PictureStream:
    """The pictures of an episode from a step on."""

    def __init__(self, key: Hashable, make: Make, start: int) -> None:
        self.key = key
        self.next = start
        """The step of the next picture."""
        self.idle_since: float | None = None
        """None while a response is being sent."""
        self._last = b""
        self._note = ""
        self._problem = ""
        """Why no pictures follow, unless the episode is over."""
        self._has_ended = False
        self.is_closed = False
        self._loop = asyncio.get_running_loop()
        self._made: deque[bytes | str | RunnerError | None] = deque()
        self._arrived = asyncio.Event()
        self._places = threading.Semaphore(AHEAD)
        self.thread = threading.Thread(target=self._work, args=(make, start), name="pictures", daemon=True)
        """Runs until the environment has returned, also after the stream was closed."""
        self.thread.start()

    @property
    def can_continue(self) -> bool:
        """Whether another response may continue it."""
        return not self.is_closed and self.idle_since is not None

    def close(self) -> None:
        """End the thread, and the process of an environment, as soon as possible."""
        self.is_closed = True
        self._places.release()

    async def block(self, start: int, stop: int, is_gone: Gone) -> Block:
        """Return the pictures from step `start` up to `stop`, as far as there are any.

        Those are left out that take long after the first, and all if nobody waits for them.
        """
        pictures: list[bytes] = []
        picture_numbers: list[int] = []
        end = math.inf
        while self.next < stop and not self._has_ended and time.monotonic() < end:
            self._arrived.clear()  # first, so that no picture arrives unnoticed meanwhile
            if self._made:
                number = self.next
                made = self._take()
                if number >= start and made is not None:
                    if made or not picture_numbers:
                        pictures.append(self._last)
                    picture_numbers.append(len(pictures) - 1)
                    end = min(end, time.monotonic() + BLOCK_SECONDS)
            elif await is_gone():
                break
            else:
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._arrived.wait(), _LOOK_SECONDS)
        return Block(pictures, picture_numbers, self._note, self._problem if self.next < stop else "")

    def _take(self) -> bytes | None:
        """Take what was made next; return a picture, empty if it is the one before; None if it is none."""
        made = self._made.popleft()
        if isinstance(made, bytes | str):
            self._places.release()
        if isinstance(made, bytes):
            self.next += 1
            is_same = made in (b"", self._last)
            self._last = made or self._last
            return b"" if is_same else made
        if isinstance(made, str):
            self._note = made
        else:
            self._has_ended = True
            self._problem = str(made or "")
        return None

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
        self._made.append(made)
        with contextlib.suppress(RuntimeError):  # the service has ended, and its loop is closed
            self._loop.call_soon_threadsafe(self._arrived.set)


class PictureStreams:
    """The streams of a service, at most `MAX_STREAMS`."""

    def __init__(self) -> None:
        self._streams: list[PictureStream] = []

    def close(self) -> None:
        """Close all streams, and wait a little for those that can end."""
        for stream in self._streams:
            stream.close()
        for stream in self._streams:
            stream.thread.join(_JOIN_SECONDS)

    def open(self, key: Hashable, make: Make, start: int) -> PictureStream:
        """Return a kept stream that comes to step `start` soon, or a new one.

        Raises:
            Busy: there are too many.
        """
        self._streams = [
            stream for stream in self._streams if stream.thread.is_alive() or stream.can_continue
        ]
        for stream in [stream for stream in self._streams if stream.key == key and stream.can_continue]:
            if stream.next <= start <= stream.next + AHEAD:
                stream.idle_since = None
                return stream
            self._close(stream)  # it would have to go back, or to draw much that nobody sees
        alive = [stream for stream in self._streams if stream.thread.is_alive()]
        if sum(not stream.is_closed for stream in alive) >= MAX_STREAMS:
            kept = [stream for stream in alive if stream.can_continue]
            if not kept:
                raise Busy(_BUSY)
            self._close(min(kept, key=lambda stream: stream.idle_since or 0.0))
        if len(alive) >= 2 * MAX_STREAMS:  # environments that hang
            raise Busy(_BUSY)
        stream = PictureStream(key, make, start)
        self._streams.append(stream)
        return stream

    async def block(self, key: Hashable, make: Make, start: int, stop: int, is_gone: Gone) -> Block:
        """Return a block of the pictures of an episode, and keep their stream for the next one.

        Raises:
            Busy: there are too many.
        """
        stream = self.open(key, make, start)
        try:
            return await stream.block(start, stop, is_gone)
        finally:
            self._keep(stream)

    def _keep(self, stream: PictureStream) -> None:
        stream.idle_since = time.monotonic()
        asyncio.get_running_loop().call_later(IDLE_SECONDS, self._close_idle)

    def _close_idle(self) -> None:
        for stream in list(self._streams):
            if stream.idle_since is not None and time.monotonic() - stream.idle_since >= IDLE_SECONDS - 0.1:
                self._close(stream)

    def _close(self, stream: PictureStream) -> None:
        stream.close()
        if not stream.thread.is_alive():
            self._streams.remove(stream)
