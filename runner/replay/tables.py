"""Q-tables at any step: the nearest snapshot before it, moved forward by the recorded steps.

with runner.open_recording(path) as recording:
    tables = tables_at(recording, step=1_000_000)      # one float64 [states, actions] per learner

A recording has snapshots by episodes, which may lie a hundred million steps apart. The first replay over such
a stretch saves checkpoints in the user's cache, one every million steps; from then on the tables at any step
are a short replay away. They can be removed at any time: everything in them follows from the recording.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
import zstandard
from blake3 import blake3

import runner.learning
from runner.config import from_mapping
from runner.errors import NotInRecording, RecordingError
from runner.learning.learner import NamedTables, kinds_of, name_tables
from runner.learning.ledger import UNKNOWN_OUTCOME, UPDATE
from runner.recording import schema
from runner.recording.messages import QTable
from runner.recording.reader import Recording
from runner.replay.step_replay import NO_ROWS, NO_TRACE, StepReplay, Trace
from runner.util.arrays import Flags, Floats, Ints, Records
from runner.util.files import TABLES, cache_folder, replacing

# --- checkpoints in the cache -------------------------------------------------------------------------

CHECKPOINT_STEPS: Final = 1 << 20
"""Training steps between checkpoints: replayed in well under half a second."""
MAX_CACHE_BYTES: Final = 2 * 10**9
"""The most that all checkpoints of all runs take; beyond it the least recently used are removed."""


class Checkpoints:
    """The checkpoints of one recording.

    Args:
        recording: the run; unless it is finished, there are no checkpoints, as it may still change.
    """

    def __init__(self, recording: Recording) -> None:
        self._folder = cache_folder() / TABLES
        run_id = re.sub(r"[^\w-]", "_", recording.run_id)[:80]  # whatever the file says, a plain name
        self._prefix = f"{run_id}-{_key(recording)}" if recording.file.finished else ""
        self._saved = False

    def nearest(self, step: int, shapes: Sequence[tuple[int, ...]]) -> tuple[int, list[Floats]]:
        """Return the last checkpoint at or before a step, and its tables; step -1 if there is none.

        Args:
            shapes: of the tables, in the order of a snapshot.
        """
        for at in sorted((at for at in self._steps() if at <= step), reverse=True):
            tables = self._load(at, shapes)
            if tables is not None:
                return at, tables
        return -1, []

    def save(self, step: int, tables: Sequence[Floats]) -> None:
        """Save the tables at a step, unless they are there."""
        path = self._path(step)
        if not self._prefix or path.exists():
            return
        data = b"".join(np.ascontiguousarray(table, "<f8").tobytes() for table in tables)
        with contextlib.suppress(OSError):  # a cache that cannot be written costs time only
            self._folder.mkdir(parents=True, exist_ok=True)
            with replacing(path) as fresh:
                fresh.write_bytes(zstandard.ZstdCompressor(level=1, write_checksum=True).compress(data))
            self._saved = True

    def prune(self) -> None:
        """Remove the least recently used checkpoints, of any run, if they take too much space."""
        if not self._saved:
            return
        self._saved = False
        with contextlib.suppress(OSError):
            files = sorted((f.stat().st_mtime, f.stat().st_size, f) for f in self._folder.iterdir())
            excess = sum(size for _, size, _ in files) - MAX_CACHE_BYTES
            for _, size, file in files:
                if excess <= 0:
                    return
                file.unlink(missing_ok=True)
                excess -= size

    def _steps(self) -> list[int]:
        if not self._prefix or not self._folder.is_dir():
            return []
        names = [path.name for path in self._folder.iterdir() if path.name.startswith(self._prefix)]
        steps = [name.removeprefix(self._prefix).removesuffix(".zst") for name in names]
        return [int(step) for step in steps if step.isdecimal()]

    def _load(self, step: int, shapes: Sequence[tuple[int, ...]]) -> list[Floats] | None:
        """Return the tables of a checkpoint; None if it is damaged, and then it is removed."""
        path = self._path(step)
        sizes = [math.prod(shape) for shape in shapes]
        try:
            data = path.read_bytes()
            if zstandard.frame_content_size(data) != 8 * sum(sizes):
                raise ValueError
            values = np.frombuffer(zstandard.ZstdDecompressor().decompress(data), "<f8")
            os.utime(path)
        except (OSError, ValueError, zstandard.ZstdError):
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
            return None
        parts = np.split(values, np.cumsum(sizes)[:-1])
        return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]

    def _path(self, step: int) -> Path:
        return self._folder / f"{self._prefix}{step:015}.zst"


def _key(recording: Recording) -> str:
    """Return a key of the tables of this file as replayed by this code."""
    facts = recording.path.stat()
    parts = [str(recording.path.absolute()), str(facts.st_size), str(facts.st_mtime_ns)]
    parts += [str(recording.result.get("content_digest")), _code()]
    return blake3("\n".join(parts).encode()).hexdigest()[:16]


@cache
def _code() -> str:
    """Return a hash of the code that learns: other code may compute other tables."""
    digest = blake3()
    for file in sorted(Path(next(iter(runner.learning.__path__))).glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


# --- the replay ---------------------------------------------------------------------------------------

NEAR_STEPS: Final = 200_000
"""`TableReplay.seek` replays this many steps rather than load a snapshot on the way."""


class TableReplay(StepReplay):
    """The tables of a recorded run, moved forward by its recording."""

    def __init__(self, recording: Recording, step: int = 0) -> None:
        super().__init__(recording.config, recording.mdp, recording.seed or 0, str(recording.path))
        self._recording = recording
        self._recorded = recording.train.steps.count()
        self._checkpoints = Checkpoints(recording)
        self._origin: int | None = None
        """The step from which the recording alone moved the tables; None if they were set by hand."""
        self._load(*self._nearest(step))
        self.advance(step)

    def rows(self, stop: int) -> Floats:
        """Replay up to a step, and return the values that the learners saw on the way.

        Returns:
            float64 [steps, learners, most actions]: the values of each step's state before its update; nan
            beyond a learner's own actions.
        """
        seen = self.empty_rows(max(stop - self.step, 0))
        self.advance(stop, rows=seen)
        return seen

    def updates(self, stop: int, learner: int) -> Records:
        """Replay up to a step, and return what decides the weights of a learner's updates on the way.

        Returns:
            [steps] of `UPDATE`.

        Raises:
            RecordingError: the step is earlier, or not recorded; or the environment cannot have such steps.
        """
        trace = Trace(np.empty(max(stop - self.step, 0), UPDATE), learner)
        first = self.step
        self.advance(stop, trace=trace)
        unknown = np.flatnonzero(trace.updates["outcome"] == UNKNOWN_OUTCOME)
        if len(unknown):
            raise RecordingError(
                f"{self._recording.path}: training step {first + int(unknown[0])} leads where the "
                "environment does not, or has another reward; `dualtaxi verify` checks the whole recording."
            )
        return trace.updates

    def seek(self, step: int) -> None:
        """Go to any step, from here or from the nearest snapshot before it, whichever is shorter."""
        lost = self._recording.lost.get(schema.TRAIN_STEP.name, [])
        gap = any(start < step and stop > self.step for start, stop in lost)
        if gap or not self.step <= step <= self.step + NEAR_STEPS:
            nearest, tables = self._nearest(step)
            if not self.step <= step or nearest > self.step:
                self._load(nearest, tables)
        self.advance(step)

    def rewind(self, step: int, tables: list[NamedTables]) -> None:
        """Set all tables to the tables of a step; from there on no checkpoints are saved."""
        super().rewind(step, tables)
        self._origin = None

    def _load(self, step: int, tables: list[NamedTables]) -> None:
        super().rewind(step, tables)
        self._origin = step

    def _nearest(self, step: int) -> tuple[int, list[NamedTables]]:
        """Return the last snapshot at or before a step, or a checkpoint between them; and its step."""
        nearest = _snapshot_before(self._recording, step, self.learner.kinds)
        if nearest is None:
            raise RecordingError(f"{self._recording.path}: has no Q-table at or before step {step}.")
        shapes, expected = (
            [table.shape for named in tables for table in named.values()]
            for tables in (nearest[1], self.named_tables)
        )
        if shapes != expected:
            raise RecordingError(f"{self._where}: found Q-tables of shape {shapes}, expected {expected}.")
        if step - nearest[0] <= CHECKPOINT_STEPS:
            return nearest
        at, tables = self._checkpoints.nearest(step, [table.shape for table in self.learner.snapshot()])
        return (at, name_tables(tables, self.learner.kinds)) if at > nearest[0] else nearest

    def advance(self, stop: int, rows: Floats = NO_ROWS, trace: Trace = NO_TRACE) -> None:
        """Replay up to a later step; `rows` and `trace` are filled as `apply` fills them.

        Raises:
            RecordingError: the step is earlier, or not recorded.
        """
        first = self.step
        for part in self.blocks(stop):
            filled = slice(self.step - first, self.step - first + len(part))
            self.apply(part, rows[filled], trace=Trace(trace.updates[filled], trace.learner))

    def blocks(self, stop: int) -> Iterator[Records]:
        """Yield the recorded steps from here to a later one; each block must be applied before the next.

        Raises:
            RecordingError: the step is earlier, or not recorded.
        """
        first = self.step
        if stop < first:
            raise RecordingError(f"a replay at step {first} cannot go back to {stop}; start another.")
        if stop > max(self._recorded, first):
            raise self._missing(stop)
        if stop > first:
            for block in self._recording.train.steps.blocks(first, stop):
                for part in np.split(block, [-self.step % CHECKPOINT_STEPS] if len(block) else []):
                    yield part
                    is_far = self._origin is not None and self.step - self._origin >= CHECKPOINT_STEPS
                    if is_far and self.step % CHECKPOINT_STEPS == 0:  # no snapshot is near before it
                        self._checkpoints.save(self.step, self.learner.snapshot())
        self._checkpoints.prune()
        if self.step < stop:
            raise self._lost(stop)

    def _recall(self, t: int) -> None:
        first = max(self.step - t, 0)
        self.recall(self._recording.train.steps.blocks(first, self.step), first)

    def _missing(self, stop: int) -> RecordingError:
        recording = self._recording
        taken = recording.result.get("train_steps", stop) if recording.leaves_out_steps else self._recorded
        if not recording.leaves_out_steps or taken < stop:
            return NotInRecording(
                f"{recording.path}: found {taken:,} training steps, expected at least {stop:,}."
            )
        later = next((snapshot.step for snapshot in recording.snapshots() if snapshot.step >= stop), None)
        return RecordingError(
            f"{recording.path}: was recorded without steps (recording.steps: none), and this needs the first "
            f"{stop:,}; `dualtaxi rerecord` records them. The nearest Q-tables are those after {self.step:,}"
            + (f" and {later:,} steps." if later is not None else " steps.")
        )


def tables_at(recording: Recording, step: int) -> list[Floats]:
    """Return the tables after `step` training steps, one float64 [states, actions] per learner."""
    return TableReplay(recording, step).tables


def named_tables_at(recording: Recording, step: int) -> list[NamedTables]:
    """Return all tables of the learners after `step` training steps, by name; `q` are the Q-tables."""
    return TableReplay(recording, step).named_tables


def known_steps(recording: Recording) -> list[tuple[int, int]]:
    """Return the steps at which the tables are known, as ascending ranges (first, last) without overlap.

    They are known from each snapshot up to the first step that was lost in a repair, or not recorded.
    """
    lost = sorted((start, stop) for start, stop in recording.lost.get(schema.TRAIN_STEP.name, []))
    recorded = recording.train.steps.count()
    spans: list[tuple[int, int]] = []
    tables = len(recording.agents) * len(kinds_of(from_mapping(recording.config)))
    counts = Counter(snapshot.step for snapshot in recording.snapshots(0, tables))
    for first in sorted(step for step, count in counts.items() if count == tables):
        reach = next((start for start, stop in lost if stop > first), recorded)
        last = max(first, min(reach, recorded))
        if spans and first <= spans[-1][1] + 1:
            spans[-1] = spans[-1][0], max(spans[-1][1], last)
        else:
            spans.append((first, last))
    return spans


def are_within(spans: Sequence[tuple[int, int]], steps: Ints) -> Flags:
    """Return which steps are within ranges such as those of `known_steps`."""
    edges = [edge for first, last in spans for edge in (first, last + 1)]
    is_inside: Flags = np.searchsorted(edges, steps, side="right") % 2 == 1
    return is_inside


def tables_before_training(recording: Recording) -> list[NamedTables] | None:
    """Return the learners' tables before training, from the first snapshot; None if that is missing."""
    nearest = _snapshot_before(recording, 0, kinds_of(from_mapping(recording.config)))
    return nearest and nearest[1]


def _snapshot_before(
    recording: Recording, step: int, kinds: tuple[str, ...]
) -> tuple[int, list[NamedTables]] | None:
    """Return the last complete snapshot at or before a step, and its step; None if there is none."""
    tables = len(recording.agents) * len(kinds)
    nearest: list[QTable] = []
    group: list[QTable] = []
    for snapshot in recording.snapshots(step, tables):
        if snapshot.step > step:
            break
        group = [*group, snapshot] if group and group[0].step == snapshot.step else [snapshot]
        if len(group) == tables:
            nearest = group
    if not nearest:
        return None
    return nearest[0].step, name_tables([table.values for table in nearest], kinds)
