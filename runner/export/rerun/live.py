"""A run shown while it trains: its metrics, and the steps of one episode in every so many.

What is shown is copied in the training thread and sent by another, which drops episodes, and says so,
rather than let them pile up. Values of the tables are not shown: they would have to be replayed.
"""

from __future__ import annotations

import queue
import threading
from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from runner.export.rerun.classes import vocabulary_of
from runner.export.rerun.columns import Batch, Sender
from runner.export.rerun.events import EventWriter
from runner.export.rerun.grid import GridWriter
from runner.export.rerun.layout import Shown, blueprint, draw_background
from runner.export.rerun.metrics import MetricWriter
from runner.export.rerun.scene import TRAIL_STEPS, marks_of, scene_of
from runner.export.rerun.thoughts import no_thoughts
from runner.export.rerun.writing import new_stream
from runner.mdp import Mdp
from runner.recording import schema

WAITING: Final = 64
"""Pieces that may wait to be sent."""


class LiveView:
    """Shows a run in a viewer while it trains: an observer for `run_job`, and a context manager.

    Args:
        title: what the run is called.
        run_id: its id.
        mdp: its environment.
        learners: whose tables it learns.
        every: one training episode, and one trial, in so many is shown.
        url: of the viewer, such as `rerun+http://127.0.0.1:9876/proxy`.
    """

    def __init__(
        self, title: str, run_id: str, mdp: Mdp, learners: tuple[str, ...], every: int, url: str
    ) -> None:
        self._every = every
        self._mdp = mdp
        self._learners = learners
        scene = scene_of(mdp)
        shown = Shown("", title, mdp, scene, learners, True, 0, None, values=False)
        self._stream = new_stream(run_id)
        self._stream.connect_grpc(url, default_blueprint=blueprint([shown]))
        self._stream.send_recording_name(title)
        marks = marks_of(scene) if scene else None
        words = vocabulary_of(mdp, scene, marks, learners, (0.0, 0.0))
        self._stream.log("/", rr.AnnotationContext(words.classes.context()), static=True)
        draw_background(self._stream, shown)
        self._metrics = MetricWriter(self._stream, "", learners, mdp.event_names)
        self._grids: dict[str, GridWriter] = {}
        self._events: dict[str, EventWriter] = {}
        for phase in ("train", "eval"):
            self._events[phase] = EventWriter(self._stream, f"/{phase}", phase, mdp)
            if scene and marks:
                self._grids[phase] = GridWriter(self._stream, f"/{phase}", scene, marks, words)
                self._grids[phase].dress()
        self._rewards = set(np.unique(mdp.rewards_of(len(learners))).tolist())
        self._rewards |= set(np.unique(mdp.summed_rewards).tolist())
        self._before: dict[str, NDArray[np.void]] = {}
        self._episode = 0
        self._last_phase = "train"
        self.dropped = 0
        """Pieces that were not shown because the viewer was too slow."""
        self._queue: queue.Queue[Any] = queue.Queue(WAITING)
        self._thread = threading.Thread(target=self._work, name="live view", daemon=True)

    def __enter__(self) -> LiveView:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._queue.put(None)
        self._thread.join()
        self._stream.flush()
        self._stream.disconnect()

    # --- the observer: in the training thread --------------------------------------------------------

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
            self._put(("steps", phase, before + start + 1, self._episode, steps[start:stop].copy()))

    def metrics(self, phase: str, time: int, metrics: dict[str, Any]) -> None:
        """Take down metrics."""
        self._put(("metrics", phase, time, 0, metrics))

    def _put(self, piece: Any) -> None:
        try:
            self._queue.put_nowait(piece)
        except queue.Full:
            self.dropped += 1

    # --- sending: in a thread of its own ---------------------------------------------------------------

    def _work(self) -> None:
        while (piece := self._queue.get()) is not None:
            kind, phase, time, episode, content = piece
            if kind == "metrics":
                self._send_metrics(phase, time, content)
            else:
                self._send_steps(phase, time, episode, content)

    def _send_metrics(self, phase: str, time: int, metrics: dict[str, Any]) -> None:
        rows = [metrics | {"log_time": time * schema.STEP_NANOSECONDS}]
        if phase == "eval":
            self._metrics.evaluations(rows)
        self._metrics.training(rows)
        self._metrics.rewards(rows, sorted(self._rewards | set(metrics["rewards"])))

    def _send_steps(self, phase: str, time: int, episode: int, steps: NDArray[np.void]) -> None:
        n = len(steps)
        if phase != self._last_phase:
            Sender(self._stream, f"/{self._last_phase}").clear("grid", [time])
            self._last_phase = phase
        trained = steps["episode"].astype(np.int64) if phase == "train" else np.full(n, episode, np.int64)
        before = self._before.get(phase, steps[:0])
        batch = Batch(steps, no_thoughts(), trained, before, np.arange(time, time + n))
        self._before[phase] = steps[-TRAIL_STEPS:]
        self._events[phase].write(batch)
        if phase in self._grids:
            self._grids[phase].write(batch, phase)
