"""The steps of one phase, in all their views.

A frame is one step: the state it was taken in, the values that the learners saw there, and the move that
was made from there. Rows are sent some thousands at a time.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import rerun as rr

from runner.environments.mdp import Mdp
from runner.environments.naming import spoken
from runner.export.rerun.classes import Vocabulary
from runner.export.rerun.columns import Batch, Sender, scalars
from runner.export.rerun.events import EventWriter
from runner.export.rerun.grid import GridWriter
from runner.export.rerun.lines import phase_colours, series_lines
from runner.export.rerun.maps import MapWriter
from runner.export.rerun.scene import Marks, Scene
from runner.export.rerun.values import ValueWriter


class StepWriter(Sender):
    """Sends the steps of one phase of a run."""

    def __init__(
        self,
        stream: rr.RecordingStream,
        path: str,
        phase: str,
        mdp: Mdp,
        scene: Scene | None,
        marks: Marks | None,
        words: Vocabulary,
        learners: tuple[str, ...],
    ) -> None:
        super().__init__(stream, path)
        self._phase = phase
        self._learners = learners
        self._values_shown = False
        self._values = ValueWriter(stream, path, mdp, words, len(learners))
        self._events = EventWriter(stream, path, phase, mdp)
        self._grid = GridWriter(stream, path, scene, marks, words) if scene and marks else None
        pictures = scene.placements if scene else None
        self._maps = MapWriter(stream, path, scene, pictures, words, learners) if scene and pictures else None

    def dress(self) -> None:
        """Log what never changes."""
        names = [f"reward {spoken(learner)}" for learner in self._learners]
        self.static("reward", series_lines(names, phase_colours(self._phase, len(names))))
        if not self._grid:
            for k, name in enumerate(("state", "action")):
                colours = phase_colours(self._phase, 2)[k : k + 1]
                self.static(name, series_lines([f"{name} ({self._phase})"], colours))
        self._values.dress()
        if self._grid:
            self._grid.dress()
        if self._maps:
            self._maps.dress()

    def write(self, batch: Batch) -> None:
        """Send a batch of steps."""
        records, times = batch.records, batch.times()
        self.send("reward", times, scalars(records["rewards"]))
        self._events.write(batch)
        if self._grid:
            self._grid.write(batch, self._phase)
        else:
            for name in ("state", "action"):
                self.send(name, times, scalars(records[name].astype(np.float64)[:, None]))
        self._write_values(batch)

    def _write_values(self, batch: Batch) -> None:
        """Send Q-values and maps; where they are unknown, clear what is shown of earlier steps."""
        if batch.values is not None:
            self._values.write(batch)
            if self._maps:
                self._maps.write(batch)
        elif self._values_shown:
            for part in ("q", "map"):
                self.clear(part, [int(batch.time[0])])
        self._values_shown = batch.values is not None

    def end(self, times: Iterable[int]) -> None:
        """Clear all views from these times on, until the next step that is exported."""
        moments = list(times)
        for part in ("grid", "q", "map"):
            self.clear(part, moments)
