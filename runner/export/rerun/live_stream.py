"""What a live view sends to a viewer. Values of the tables are not sent: they would have to be replayed."""

from __future__ import annotations

import collections
from collections.abc import Sequence
from typing import Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from runner.environments.mdp import Mdp
from runner.export.rerun.classes import vocabulary_of
from runner.export.rerun.columns import Batch, Sender, new_stream
from runner.export.rerun.events import EventWriter
from runner.export.rerun.grid import GridWriter
from runner.export.rerun.layout import Shown, blueprint, draw_background
from runner.export.rerun.live_pieces import Piece
from runner.export.rerun.metrics import MetricWriter
from runner.export.rerun.scene import TRAIL_STEPS, marks_of, scene_of
from runner.recording import schema

LAST_SECONDS: Final = 5.0
"""How long the end of a run may wait for its viewer."""


class LiveStream:
    """Sends a run to a viewer as it goes.

    Args:
        title: what the run is called.
        run_id: its id.
        mdp: its environment.
        learners: whose tables it learns.
        url: of the viewer.
    """

    def __init__(self, title: str, run_id: str, mdp: Mdp, learners: tuple[str, ...], url: str) -> None:
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
        self._last_phase = "train"

    def send(self, pieces: Sequence[Piece]) -> None:
        """Send pieces; those of one kind and phase as one, since each says when it was."""
        kinds = collections.defaultdict(list)
        for piece in pieces:
            kinds[piece.kind, piece.phase].append(piece)
        self._clear_the_other_grid(pieces)
        for (kind, phase), alike in kinds.items():
            if kind == "metrics":
                self._send_metrics(phase, alike)
            else:
                self._send_steps(phase, alike)

    def close(self) -> None:
        """Send what is left; raise what the transport does if the viewer does not take it."""
        try:
            self._stream.flush(timeout_sec=LAST_SECONDS)
        finally:
            self._stream.disconnect()

    def _send_metrics(self, phase: str, pieces: Sequence[Piece]) -> None:
        rows = [piece.content | {"log_time": piece.time * schema.STEP_NANOSECONDS} for piece in pieces]
        if phase == "eval":
            self._metrics.evaluations(rows)
        self._metrics.training(rows)
        self._metrics.rewards(rows, sorted(self._rewards.union(*(row["rewards"] for row in rows))))

    def _send_steps(self, phase: str, pieces: Sequence[Piece]) -> None:
        steps = np.concatenate([piece.content for piece in pieces])
        time = np.concatenate([np.arange(len(piece.content)) + piece.time for piece in pieces])
        trained = np.repeat([piece.episode for piece in pieces], [len(piece.content) for piece in pieces])
        if phase == "train":
            trained = steps["episode"].astype(np.int64)
        batch = Batch(steps, None, trained, self._before.get(phase, steps[:0]), time)
        self._before[phase] = steps[-TRAIL_STEPS:]
        self._events[phase].write(batch)
        if phase in self._grids:
            self._grids[phase].write(batch, phase)

    def _clear_the_other_grid(self, pieces: Sequence[Piece]) -> None:
        """Take away the grid of a phase when steps of the other one come."""
        for piece in pieces:
            if piece.kind == "steps" and piece.phase != self._last_phase:
                Sender(self._stream, f"/{self._last_phase}").clear("grid", [piece.time])
                self._last_phase = piece.phase
