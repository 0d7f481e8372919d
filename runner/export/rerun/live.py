"""A run shown while it trains: its metrics, and the steps of one episode in N.

What is shown is handed to a process of its own, which sends it to the viewer. What that process does not
accept in time is dropped and counted, so that a viewer that is slow or closed does not delay training.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import queue
import signal
from collections.abc import Iterator, Sequence
from time import sleep
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp
from runner.recording import schema
from runner.recording.messages import Message
from runner.util.processes import starting_processes

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

    from runner.export.rerun.live_stream import LiveStream

MAX_QUEUED: Final = 256
"""Pieces that may wait to be sent."""
BATCH_SECONDS: Final = 0.5
"""Pieces that arrive within this time are sent together."""
END_SECONDS: Final = 10.0
"""How long the end of a run may wait for the viewer to accept the rest."""


class Piece(NamedTuple):
    """Steps or metrics to show, of one phase."""

    phase: str
    time: int
    """Steps of both phases executed by the first of these steps; for metrics, all until then."""
    episode: int
    """The training episode at that time."""
    content: NDArray[np.void] | dict[str, object]
    """Records of steps, or metrics."""


class LiveView:
    """Shows a run in a viewer while it trains: an observer for `run_job`, and a context manager.

    It shows every Nth training episode and trial, in the viewer at an address such as
    `rerun+http://127.0.0.1:9876/proxy`.
    """

    def __init__(self, title: str, run_id: str, every: int, url: str) -> None:
        self._every = every
        self._episode = 0
        self.dropped = 0
        """Pieces that were not shown because the viewer was too slow, or gone."""
        self.failure = ""
        """Why nothing more was shown; empty if everything was. Set at the end."""
        context = multiprocessing.get_context("spawn")
        with starting_processes():  # a queue starts one that tracks it
            self._queue = context.Queue(MAX_QUEUED)
        self._errors, errors = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_send_all, args=(self._queue, errors, title, run_id, url), name="live view", daemon=True
        )

    def __enter__(self) -> LiveView:
        with starting_processes():
            self._process.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._put(None)
        self._process.join(END_SECONDS)
        if self._process.is_alive():
            self.failure = "the viewer takes too long"
        with contextlib.suppress(EOFError):  # it ended without an error
            while self._errors.poll():
                self.failure = self._errors.recv()
        self._process.kill()
        self._queue.cancel_join_thread()  # nothing reads the queue any more

    def begin(self, mdp: Mdp, learners: tuple[str, ...]) -> None:
        """Set the environment and the learners of the run."""
        self._put((mdp, learners))

    def steps(self, phase: str, before: int, steps: NDArray[np.void]) -> None:
        """Show those of these steps that belong to one episode in N; `before` steps were executed before."""
        if not len(steps):
            return
        first, last = int(steps["episode"][0]), int(steps["episode"][-1])
        if phase == "train":
            self._episode = last
        for episode in range(-(-first // self._every) * self._every, last + 1, self._every):
            start = int(np.searchsorted(steps["episode"], episode))
            stop = int(np.searchsorted(steps["episode"], episode, side="right"))
            self._put(Piece(phase, before + start + 1, self._episode, steps[start:stop].copy()))

    def metrics(self, phase: str, time: int, metrics: Message) -> None:
        """Show metrics."""
        self._put(Piece(phase, time, 0, metrics))

    def _put(self, piece: object) -> None:
        try:
            self._queue.put_nowait(piece)
        except queue.Full:
            self.dropped += 1


def _send_all(pieces: Any, errors: Connection, title: str, run_id: str, url: str) -> None:
    """Send pieces until there are no more, in a process of its own; an error does not end the run."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the run, which ends this process
    if hasattr(os, "SCHED_IDLE"):  # training has priority
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    elif hasattr(os, "nice"):
        os.nice(19)
    try:
        from runner.export.rerun.live_stream import LiveStream  # training does not load Rerun

        if (begun := pieces.get()) is not None:
            mdp, learners = begun
            stream = LiveStream(title, run_id, mdp, learners, url)
            for batch in _batches(pieces):
                _send(stream, batch)
            stream.close()
    except Exception as error:  # the transport raises various exceptions
        errors.send(str(error))


def _batches(pieces: Any) -> Iterator[list[Piece]]:
    """Yield the pieces that arrive within a short time, until the end of them."""
    while (piece := pieces.get()) is not None:
        batch = [piece]
        sleep(BATCH_SECONDS)
        while not pieces.empty():
            if (piece := pieces.get()) is None:
                yield batch
                return
            batch.append(piece)
        yield batch


def _send(stream: LiveStream, pieces: Sequence[Piece]) -> None:
    """Send pieces, those of one kind and phase as one."""
    for phase in schema.PHASES:
        rows = [
            piece.content | {"log_time": piece.time * schema.STEP_NANOSECONDS}
            for piece in pieces
            if piece.phase == phase and isinstance(piece.content, dict)
        ]
        stream.send_metrics(phase, rows)
    shown = [(piece, piece.content) for piece in pieces if not isinstance(piece.content, dict)]
    for piece, _ in shown:
        stream.show_phase(piece.phase, piece.time)
    for phase in schema.PHASES:
        if parts := [(piece, steps) for piece, steps in shown if piece.phase == phase]:
            steps = np.concatenate([part for _, part in parts])
            time = np.concatenate([np.arange(len(part)) + piece.time for piece, part in parts])
            episode = np.repeat([piece.episode for piece, _ in parts], [len(part) for _, part in parts])
            if phase == "train":
                episode = steps["episode"].astype(np.int64)
            stream.send_steps(phase, steps, time, episode)
