"""Sending a run to a viewer while it trains: no Q-values, since the tables would have to be replayed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp
from runner.export.rerun.columns import Batch, new_stream
from runner.export.rerun.labels import Labels
from runner.export.rerun.layout import RunView, arranged, runs_view
from runner.export.rerun.metrics import MetricWriter
from runner.export.rerun.scene import scene_of
from runner.export.rerun.steps import StepWriter
from runner.recording import schema
from runner.recording.messages import Message

FLUSH_SECONDS: Final = 5.0
"""How long the end of a run may wait for its viewer."""


class LiveStream:
    """Sends a run to a viewer while it trains."""

    def __init__(self, title: str, run_id: str, mdp: Mdp, learners: tuple[str, ...], url: str) -> None:
        view = RunView("", title, mdp, scene_of(mdp), learners)
        stream = self._stream = new_stream(run_id)
        stream.connect_grpc(url, default_blueprint=arranged([runs_view([view], None)], "following"))
        stream.send_recording_name(title)
        labels = Labels(mdp, view.scene, learners)
        labels.log(stream, "")
        view.draw_background(stream)
        self._metrics = MetricWriter(stream, "", learners, mdp.event_names)
        self._steps = {phase: StepWriter(stream, view, phase, labels) for phase in schema.PHASES}
        self._rewards = set(np.unique(mdp.rewards_of(len(learners))).tolist())
        self._rewards |= set(np.unique(mdp.summed_rewards).tolist())
        self._phase = "train"

    def send_metrics(self, phase: str, rows: Sequence[Message]) -> None:
        """Send metrics of a phase."""
        if phase == "eval":
            self._metrics.send_evaluations(rows)
        self._metrics.send_training(rows)
        rewards = self._rewards.union(*(row["rewards"] for row in rows))
        self._metrics.send_reward_shares(rows, sorted(rewards))

    def send_steps(
        self, phase: str, steps: NDArray[np.void], time: NDArray[np.int64], episode: NDArray[np.int64]
    ) -> None:
        """Send steps of a phase; `time` and `episode` are those of `Batch`."""
        self._steps[phase].write(Batch(steps, episode, time))

    def show_phase(self, phase: str, time: int) -> None:
        """Show the grid of a phase from a time on, and clear that of the other one."""
        if phase != self._phase:
            self._steps[self._phase].clear("grid", [time])
            self._phase = phase

    def close(self) -> None:
        """Send the rest; raise what the transport raises if the viewer does not accept it."""
        try:
            self._stream.flush(timeout_sec=FLUSH_SECONDS)
        finally:
            self._stream.disconnect()
