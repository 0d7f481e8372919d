"""Steps recorded by their actions alone: everything else comes again when the environment takes them.

A message has a block of consecutive steps in columns: the action, the place in the episode, the ends. The
observations and rewards are represented by digests: one for each episode up to its last step in the block.
Numbers are stored as differences from what the step before of the same environment lets expect: mostly 0.
Every column is stored byte by byte, as that compresses best.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import Any, Final

import numpy as np
from blake3 import blake3
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.messages import Message
from runner.recording.turns import is_taken
from runner.util.arrays import Array, Flags, Floats, RecordDType, Records

DIGEST_BYTES: Final = 16
COLUMNS: Final = (
    "action",
    "environment",
    "taken",
    "terminated",
    "truncated",
    "episode",
    "t",
    "acted",
    "agents_terminated",
    "agents_truncated",
    "log_time",
)
"""The fields of a step that are kept, in the order of a message."""
NUMBERS: Final = ("environment", "episode", "t", "log_time")
"""Those that are stored as differences."""
MARK: Final = np.dtype([("row", "<u4"), ("digest", f"V{DIGEST_BYTES}")])
_MAX_BLOCK_BYTES: Final = 64 << 20
_MAX_STEP: Final = 1 << 62


def kept_dtype(step: RecordDType) -> RecordDType:
    """Return the dtype of steps of which the actions were recorded.

    `digest` is that of the episode up to this step, or all zeros where none was recorded.

    Args:
        step: the dtype of whole records.
    """
    columns = [(name, step[name]) for name in COLUMNS if name in (step.names or ())]
    return np.dtype([("step", "<i8"), *columns, ("digest", f"V{DIGEST_BYTES}")])


def after_step(step: RecordDType) -> str:
    """Return the name of the field of whole records with the observation after the step."""
    return "next_state" if "next_state" in (step.names or ()) else "next_observation"


class EpisodeDigests:
    """The running digests of the episodes of some environments, over what their steps brought."""

    def __init__(self) -> None:
        self._running: dict[int, blake3] = {}

    def add(
        self,
        environment: int,
        t: NDArray[np.integer],
        observations: Array,
        rewards: Floats,
        terminated: Flags,
        truncated: Flags,
        at: Iterable[int] = (),
    ) -> Iterator[tuple[int, bytes]]:
        """Yield rows of consecutive steps of an environment, each with the digest of its episode so far.

        The rows are the last of each episode, and those in `at`. Episodes whose beginning was not among the
        steps so far are left out. A digest is BLAKE3 over the steps from the first on: observation, rewards
        (float64), terminated, truncated.
        """
        rows = len(t)
        dtype = [("o", observations.dtype, observations.shape[1:]), ("r", "<f8", rewards.shape[1:])]
        steps = np.empty(rows, np.dtype([*dtype, ("e", "?", (2,))]))
        steps["o"], steps["r"] = observations, rewards
        steps["e"][:, 0], steps["e"][:, 1] = terminated, truncated
        edges = sorted({0, *np.flatnonzero(t == 0).tolist(), *(row + 1 for row in at), rows})
        data = steps.view(np.uint8).data
        size = steps.itemsize
        for first, stop in pairwise(edges):
            if t[first] == 0:
                self._running[environment] = blake3()
            if (running := self._running.get(environment)) is not None:
                running.update(data[first * size : stop * size])
                yield stop - 1, running.digest(DIGEST_BYTES)


def packed(rows: Records, n: int) -> Message:
    """Return the fields of a message with a block of steps, as `unpacked` returns them.

    Of each episode only the last digest in the block is kept.
    """
    columns = []
    for name in rows.dtype.names or ():
        if name in COLUMNS:
            values = np.ascontiguousarray(rows[name])
            if name in NUMBERS:
                values[n:] -= _following(rows, name, n)
            columns.append(values.view(np.uint8).reshape(len(rows), -1).T.tobytes())
    last = np.zeros(len(rows), np.bool_)  # of an episode, in the block
    digests = rows["digest"].copy().view(np.uint8).reshape(len(rows), -1)
    marked = np.asarray(digests.any(axis=1))
    for environment in range(min(n, len(rows))):
        steps = np.arange(environment, len(rows), n)
        steps = steps[marked[steps]]
        if len(steps):
            episode = rows["episode"][steps]
            last[steps] = np.append(episode[1:] != episode[:-1], True)
    marks = np.zeros(int(last.sum()), MARK)
    marks["row"] = np.flatnonzero(last)
    marks["digest"] = rows["digest"][last]
    return {
        "step": int(rows["step"][0]),
        "count": len(rows),
        "data": b"".join(columns),
        "digests": marks.tobytes(),
    }


def unpacked(fields: Message, dtype: RecordDType, n: int, where: str) -> Records:
    """Return the steps in a message.

    Args:
        n: how many environments take turns.

    Raises:
        RecordingError: the message is damaged.
    """
    count, data = fields["count"], fields["data"]
    names = [name for name in dtype.names or () if name in COLUMNS]
    width = sum(dtype[name].itemsize for name in names)
    is_whole = 0 < count * dtype.itemsize <= _MAX_BLOCK_BYTES and len(data) == count * width
    if not (is_whole and 0 <= fields["step"] < _MAX_STEP):
        raise RecordingError(f"{where}: found {len(data):,} bytes for {count:,} steps of {width} bytes")
    if len(fields["digests"]) % MARK.itemsize:
        raise RecordingError(f"{where}: found digests of {len(fields['digests']):,} bytes")
    rows = np.zeros(count, dtype)
    rows["step"] = fields["step"] + np.arange(count)
    at = 0
    for name in names:
        size = dtype[name].itemsize
        planes = np.frombuffer(data, np.uint8, count * size, at).reshape(size, count)
        values = np.ascontiguousarray(planes.T).view(dtype[name].base).reshape(count, *dtype[name].shape)
        if name in NUMBERS:
            values = _summed(values, rows, name, n)
        rows[name] = values
        at += count * size
    marks = np.frombuffer(fields["digests"], MARK)
    if (marks["row"] >= count).any():
        raise RecordingError(f"{where}: found the digest of a step that it does not have")
    rows["digest"][marks["row"]] = marks["digest"]
    return rows


def _following(rows: Records, name: str, n: int) -> Array:
    """Return the numbers to expect of the rows from number n on, by what their environments did before."""
    now, later = rows[:-n], rows[n:]
    if name == "episode":
        return np.asarray(now["episode"] + _is_over(now))
    if name == "t":
        return np.where(now["episode"] == later["episode"], now["t"] + is_taken(now), 0)
    return np.array(now[name])


def _summed(values: Array, rows: Records, name: str, n: int) -> Array:
    """Return the numbers whose differences from `_following` these are; rows have the columns before them."""
    n = min(n, len(rows))
    turns, sums = _rounds(rows, n), _rounds(values, n)
    begins = turns["episode"][1:] != turns["episode"][:-1]
    if name == "episode":
        sums[1:] += _is_over(turns[:-1])
    if name == "t":
        sums[1:] += is_taken(turns[:-1]) & ~begins
    sums = sums.cumsum(axis=0, dtype=values.dtype)
    if name == "t":  # as it only grows, what was summed before an episode is the largest of all before
        sums[1:] -= np.maximum.accumulate(np.where(begins, sums[:-1], 0), axis=0)
    return sums.reshape(-1)[: len(rows)]


def _rounds(values: NDArray[Any], n: int) -> NDArray[Any]:
    """Return values as [rounds, n], the last round filled with zeros."""
    padded = np.zeros(-(-len(values) // n) * n, values.dtype)
    padded[: len(values)] = values
    return padded.reshape(-1, n)


def _is_over(rows: Records) -> Flags:
    return np.asarray(rows["terminated"] | rows["truncated"])


ACTION_TOPICS: Final = {"/train/step": schema.TRAIN_ACTIONS, "/eval/step": schema.EVAL_ACTIONS}
"""Where the actions of the steps of a topic are recorded."""
