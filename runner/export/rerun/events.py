"""The text log: beginnings and ends of episodes, pickups, collisions, and results of evaluations."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from runner.export.rerun.columns import Batch, Sender
from runner.export.rerun.scene import event_words, events_of_steps
from runner.mdp import Mdp
from runner.words import states_in_words


class EventWriter(Sender):
    """Sends the events of one phase's steps."""

    def __init__(self, stream: rr.RecordingStream, path: str, phase: str, mdp: Mdp) -> None:
        super().__init__(stream, path)
        self._phase = phase
        self._mdp = mdp
        self._states = states_in_words(mdp)
        quiet = [bit for bit, name in enumerate(mdp.event_names) if ".illegal" in name]
        self._told = np.uint32((1 << len(mdp.event_names)) - 1 - sum(1 << bit for bit in quiet))
        self._words: dict[int, str] = {}

    def write(self, batch: Batch) -> None:
        """Send the events of a batch; an illegal action is none, there are too many at first."""
        records = batch.records
        masks = events_of_steps(self._mdp, records) & self._told
        begins = np.flatnonzero(records["t"] == 0)
        happens = np.flatnonzero((masks != 0) | records["truncated"] | records["terminated"])
        rows = np.concatenate((begins, happens))
        if not len(rows):
            return
        text = [self._beginning(batch, row) for row in begins.tolist()]
        text += [self._happening(records[row], int(masks[row])) for row in happens]
        levels = ["INFO"] * len(begins) + [self._level(mask) for mask in masks[happens].tolist()]
        order = np.argsort(rows, kind="stable")
        rows = rows[order]
        columns = rr.TextLog.columns(text=[text[i] for i in order], level=[levels[i] for i in order])
        self.send("events", batch.times(rows), columns)

    def _beginning(self, batch: Batch, row: int) -> str:
        record = batch.records[row]
        kind = "episode" if self._phase == "train" else "trial"
        named = f"{kind} {batch.number([row])[0]:,}"
        return f"{named} begins: {self._states[record['state']]}"

    def _happening(self, record: np.void, mask: int) -> str:
        words = [self._in_words(mask)] if mask else []
        if record["terminated"]:
            words.append(f"episode over after {int(record['t']) + 1} steps")
        elif record["truncated"]:
            words.append(f"time-out after {int(record['t']) + 1} steps")
        return ", ".join(words)

    def _level(self, mask: int) -> str:
        good = mask & self._mdp.success_mask
        return "WARN" if not good and "collision" in self._in_words(mask) else "INFO"

    def _in_words(self, mask: int) -> str:
        if mask not in self._words:
            self._words[mask] = event_words(self._mdp, mask)
        return self._words[mask]


def evaluation_texts(metrics: list[dict[str, Any]]) -> list[str]:
    """Return the result of each evaluation in words."""
    return [
        f"evaluation after {one['episode']:,} episodes: "
        + (f"{one['finish_percent']:.1f} % finished, " if one["successes"] >= 0 else "")
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
