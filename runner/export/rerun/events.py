"""The text log: beginnings and ends of episodes, pickups, collisions, and results of evaluations."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from runner.analysis.outcomes import events_of
from runner.environments.mdp import Mdp
from runner.environments.naming import events_in_words, states_in_words
from runner.export.rerun.columns import Batch, Sender, instances, texts

_OVER: Final = 1
_TIME_OUT: Final = 2


class EventWriter(Sender):
    """Sends the events of one phase's steps."""

    def __init__(self, stream: rr.RecordingStream, path: str, phase: str, mdp: Mdp) -> None:
        super().__init__(stream, path)
        self._phase = phase
        self._mdp = mdp
        self._states = states_in_words(mdp)
        quiet = [bit for bit, name in enumerate(mdp.event_names) if ".illegal" in name]
        self._told = np.uint32((1 << len(mdp.event_names)) - 1 - sum(1 << bit for bit in quiet))
        self._words: dict[int, tuple[str, str]] = {}

    def write(self, batch: Batch) -> None:
        """Send the events of a batch; an illegal action is none, there are too many at first."""
        records = batch.records
        masks = events_of(self._mdp, records) & self._told
        begins = np.flatnonzero(records["t"] == 0)
        happens = np.flatnonzero((masks != 0) | records["truncated"] | records["terminated"])
        rows = np.concatenate((begins, happens))
        if not len(rows):
            return
        text = self._beginnings(batch, begins)
        levels = ["INFO"] * len(begins)
        ends = np.where(records["terminated"], _OVER, np.where(records["truncated"], _TIME_OUT, 0))
        lengths = np.where(ends, records["t"] + 1, 0)
        for happening in zip(*(part[happens].tolist() for part in (masks, ends, lengths)), strict=True):
            said, level = self._happening(*happening)
            text.append(said)
            levels.append(level)
        order = np.argsort(rows, kind="stable")
        rows = rows[order]
        columns = instances(
            rr.TextLog,
            len(rows),
            text=texts([text[i] for i in order]),
            level=texts([levels[i] for i in order]),
        )
        self.send("events", batch.times(rows), columns)

    def _beginnings(self, batch: Batch, rows: NDArray[np.int64]) -> list[str]:
        kind = "episode" if self._phase == "train" else "trial"
        states = batch.records["state"][rows].tolist()
        return [
            f"{kind} {number:,} begins: {self._states[state]}"
            for number, state in zip(batch.number(rows).tolist(), states, strict=True)
        ]

    def _happening(self, mask: int, end: int, length: int) -> tuple[str, str]:
        """Return what is said of a step, and the level of that."""
        if mask not in self._words:
            words = events_in_words(self._mdp, mask)
            bad = "collision" in words and not mask & self._mdp.success_mask
            self._words[mask] = words, "WARN" if bad else "INFO"
        words, level = self._words[mask]
        if not end:
            return words, level
        ending = f"{'episode over' if end == _OVER else 'time-out'} after {length} steps"
        return f"{words}, {ending}" if mask else ending, level


def evaluation_texts(metrics: list[dict[str, Any]]) -> list[str]:
    """Return the result of each evaluation in words."""
    return [
        f"evaluation after {one['episode']:,} episodes: "
        + (f"{one['success_percent']:.1f} % success, " if one["successes"] >= 0 else "")
        + f"{one['eval_mean_length']:.1f} steps and {one['mean_penalties']:.1f} penalties a trial"
        for one in metrics
    ]


def send_text(
    stream: rr.RecordingStream,
    path: str,
    steps: NDArray[np.int64],
    episodes: NDArray[np.int64],
    text: list[str],
) -> None:
    """Send lines of text."""
    if text:
        times = [rr.TimeColumn("step", sequence=steps), rr.TimeColumn("episode", sequence=episodes)]
        stream.send_columns(path, times, rr.TextLog.columns(text=text, level=["INFO"] * len(text)))
