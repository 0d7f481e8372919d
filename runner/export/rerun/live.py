"""A run shown while it trains: its metrics, and the steps of one episode in every so many.

What is shown is handed to a process of its own, which sends it to the viewer; what that one does not take in
time is dropped, and counted: a viewer that is slow, or closed, costs training nothing.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import queue
import signal
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp
from runner.export.rerun.live_pieces import Piece

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

WAITING: Final = 256
"""Pieces that may wait to be sent."""
TOGETHER_SECONDS: Final = 0.5
"""What comes within this time is sent together."""
END_SECONDS: Final = 10.0
"""How long the end of a run may wait for the viewer to take what is left."""


class LiveView:
    """Shows a run in a viewer while it trains: an observer for `run_job`, and a context manager.

    Args:
        title: what the run is called.
        run_id: its id.
        every: one training episode, and one trial, in so many is shown.
        url: of the viewer, such as `rerun+http://127.0.0.1:9876/proxy`.
    """

    def __init__(self, title: str, run_id: str, every: int, url: str) -> None:
        self._every = every
        self._episode = 0
        self.dropped = 0
        """Pieces that were not shown because the viewer was too slow, or gone."""
        self.failure = ""
        """Why nothing more was shown, if so; known at the end."""
        own = multiprocessing.get_context("spawn")
        self._queue = own.Queue(WAITING)
        self._said, said = own.Pipe(duplex=False)
        self._process = own.Process(
            target=_send_all, args=(self._queue, said, title, run_id, url), name="live view", daemon=True
        )

    def __enter__(self) -> LiveView:
        self._process.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._put(None)
        self._process.join(END_SECONDS)
        if self._process.is_alive():
            self.failure = "the viewer takes too long"
        with contextlib.suppress(EOFError):  # it had nothing to say
            while self._said.poll():
                self.failure = self._said.recv()
        self._process.kill()
        self._queue.cancel_join_thread()  # who is gone takes nothing any more

    def begin(self, mdp: Mdp, learners: tuple[str, ...]) -> None:
        """Take down what is run."""
        self._put((mdp, learners))

    def steps(self, phase: str, before: int, steps: NDArray[np.void]) -> None:
        """Take down the steps of one episode in every so many."""
        if not len(steps):
            return
        first, last = int(steps["episode"][0]), int(steps["episode"][-1])
        if phase == "train":
            self._episode = last
        for episode in range(-(-first // self._every) * self._every, last + 1, self._every):
            start = int(np.searchsorted(steps["episode"], episode))
            stop = int(np.searchsorted(steps["episode"], episode, side="right"))
            self._put(Piece("steps", phase, before + start + 1, self._episode, steps[start:stop].copy()))

    def metrics(self, phase: str, time: int, metrics: dict[str, Any]) -> None:
        """Take down metrics."""
        self._put(Piece("metrics", phase, time, 0, metrics))

    def _put(self, piece: Any) -> None:
        try:
            self._queue.put_nowait(piece)
        except queue.Full:
            self.dropped += 1


def _send_all(pieces: Any, said: Connection, title: str, run_id: str, url: str) -> None:
    """Send pieces until there are no more; say what went wrong: the run goes on without."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the run, and thereby this
    _give_way()
    try:
        from runner.export.rerun.live_stream import LiveStream

        begun = pieces.get()
        if begun is not None:
            mdp, learners = begun
            stream = LiveStream(title, run_id, mdp, learners, url)
            for together in _together(pieces):
                stream.send(together)
            stream.close()
    except Exception as error:  # whatever the transport raises
        said.send(str(error))


def _give_way() -> None:
    """Run only when nothing else wants the processor: training goes first."""
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    elif hasattr(os, "nice"):
        os.nice(19)


def _together(pieces: Any) -> Iterator[list[Piece]]:
    """Yield the pieces that come within a short time, until the end of them."""
    while (piece := pieces.get()) is not None:
        together = [piece]
        time.sleep(TOGETHER_SECONDS)
        while not pieces.empty():
            piece = pieces.get()
            if piece is None:
                yield together
                return
            together.append(piece)
        yield together
