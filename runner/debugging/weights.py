"""The weights of one Q-value of a run: how much of each recorded reward and each initial value it has.

The recorded steps are replayed once, and what decides the weights of each update goes into a temporary file.
That file is then read from its end, which gives the weights: see `learning.ledger`. So memory does not grow
with the run.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from runner.errors import RecordingError, StorageError
from runner.execution.estimate import free_bytes
from runner.learning.ledger import SHARE, UPDATE, Ledger, spread
from runner.recording.reader import Recording
from runner.replay.tables import TableReplay
from runner.util.arrays import Floats, Records
from runner.util.files import storage_errors
from runner.util.humanize import size
from runner.util.processes import Report

STRETCHES: Final = 20
"""The most stretches of equally many episodes by which weights are counted."""
STEPS_AT_ONCE: Final = 1 << 18


class Cell(NamedTuple):
    """The place of a Q-value."""

    learner: int
    state: int
    action: int


@dataclass(frozen=True, eq=False)
class Weights:
    """The weights of a Q-value."""

    value: float
    """The Q-value in the replayed table."""
    initial_values: Floats
    """[tables, S * width]."""
    ledger: Ledger
    """The weights of the initial values, and of the rewards by outcome and by stretch of episodes."""
    stretch: int
    """Episodes of a stretch."""
    last_episode: int
    """The episode of the last step."""
    counted: int
    """Number of steps whose rewards have a weight."""
    largest: Records
    """[limit] of `SHARE`: the steps that add or take most, these first."""


def weights_of(recording: Recording, cell: Cell, stop: int, limit: int, report: Report) -> Weights:
    """Return the weights of a Q-value after a number of training steps of a job that learns.

    `limit` is the most steps in `Weights.largest`; `report` is called with the number of steps read so far.

    Raises:
        StorageError: the temporary file cannot be written.
    """
    replay = TableReplay(recording)
    learner = replay.learner
    model = replay.learner.model
    tables = learner.algorithm.tables if learner.algorithm.is_double else ("q",)
    initial_values = np.stack([replay.named_tables[cell.learner][name].reshape(-1) for name in tables])
    advice = "set TMPDIR to a folder with more space"
    free = free_bytes(Path(tempfile.gettempdir()))
    if stop * UPDATE.itemsize > free:
        raise StorageError(
            f"{tempfile.gettempdir()}: has {size(free)} free, and {size(stop * UPDATE.itemsize)} are needed "
            f"for a temporary file; {advice}."
        )
    with storage_errors("a temporary file", advice), tempfile.TemporaryFile() as spool:
        episode = 0
        for updates in _updates(recording, replay, cell.learner, stop):
            spool.write(updates.view(np.uint8).data)
            episode = int(updates["episode"][-1])
            report(replay.step)
        stretch = episode // STRETCHES + 1
        ledger = Ledger(
            np.zeros_like(initial_values),
            np.zeros_like(initial_values),
            np.zeros(len(model.next_state)),
            np.zeros((episode // stretch + 1, 2)),
        )
        ledger.weights[:, cell.state * model.width[cell.learner] + cell.action] = 1 / len(tables)
        counted = 0
        largest = np.empty(0, SHARE)
        shares = np.empty(min(stop, STEPS_AT_ONCE), SHARE)
        for start in reversed(range(0, stop, STEPS_AT_ONCE)):
            updates = np.empty(min(STEPS_AT_ONCE, stop - start), UPDATE)
            spool.seek(start * UPDATE.itemsize)
            spool.readinto(updates.view(np.uint8).data)
            end = start + len(updates)
            while end > start:  # from branch to branch: each changes the rules
                segment = learner.segment_at(end - 1)
                first = max(segment.start, start)
                filled = spread(
                    model,
                    segment.rules,
                    cell.learner,
                    first,
                    updates[first - start : end - start],
                    ledger,
                    stretch,
                    shares,
                )
                counted += filled
                added = shares[:filled]
                largest = np.concatenate([largest, added[added["contribution"] != 0]])
                order = np.lexsort((largest["step"], -np.abs(largest["contribution"])))
                largest = largest[order[:limit]]
                end = first
    return Weights(
        value=float(replay.tables[cell.learner][cell.state, cell.action]),
        initial_values=initial_values,
        ledger=ledger,
        stretch=stretch,
        last_episode=episode,
        counted=counted,
        largest=largest,
    )


def _updates(recording: Recording, replay: TableReplay, learner: int, stop: int) -> Iterator[Records]:
    """Yield what decides the weights of a learner's updates up to a step, in parts of `STEPS_AT_ONCE`.

    Raises:
        RecordingError: the numbers of the steps' episodes decrease; compiled code uses them as indices.
    """
    episode = 0
    while replay.step < stop:
        first = replay.step
        updates = replay.updates(min(first + STEPS_AT_ONCE, stop), learner)
        episodes = updates["episode"]
        if episodes[0] < episode or (episodes[1:] < episodes[:-1]).any():
            raise RecordingError(
                f"{recording.path}: found decreasing numbers of episodes from training step {first} on; "
                "`dualtaxi verify` checks the whole recording."
            )
        episode = episodes[-1]
        yield updates
