"""The ends of episodes and the resets in some steps of a vector environment, and what follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.recording import schema
from runner.recording.reset_states import ResetState
from runner.util.arrays import Array

Flags = NDArray[np.bool_]


class ResetsBetween(NamedTuple):
    """Resets of environments whose episodes had ended, by the user or within a step (`SAME_STEP`)."""

    row: NDArray[np.intp]
    """The row of the block that comes after each."""
    which: NDArray[np.intp]
    observation: Array
    seeds: Sequence[int | None]
    states: Sequence[ResetState | None]
    """What each depended on, where that is to be recorded."""


class EpisodeCounts(NamedTuple):
    """Numbers, lengths and returns of episodes along the rows of a block, [rows, N] if not stated."""

    over: Flags
    only_reset: Flags
    """Where no step was taken: the environment ignored its action and was reset."""
    ended_before: NDArray[np.int64]
    """[rows + 1, N]: episodes that ended in the block before each row, and before its end."""
    t: NDArray[np.int64]
    length: NDArray[np.int64]
    """Steps of the episode up to and including each row."""
    returns: NDArray[np.float64]
    """The returns of the episodes that ended, in the order of `np.nonzero(over)`."""
    carried: NDArray[np.float64]
    """[N]: the sums of the rewards of the episodes in progress after the block."""


def counts_of(
    over: Flags,
    only_reset: Flags,
    rewards: NDArray[np.float64],
    length: NDArray[np.int64],
    carried: NDArray[np.float64],
) -> EpisodeCounts:
    """Return the counts of a block.

    Args:
        over: [rows, N], whether the episode ended with the step.
        only_reset: [rows, N], where no step was taken.
        rewards: [rows, N].
        length: [N], the steps before the block of the episode in progress.
        carried: [N], its return before the block.
    """
    rows, n = over.shape
    ended_before, taken = np.zeros((2, rows + 1, n), np.int64)
    np.cumsum(over, axis=0, out=ended_before[1:])
    np.cumsum(~only_reset, axis=0, out=taken[1:])
    # What `taken` was when the episode began; its steps before the block count as taken before it.
    began = np.where(np.vstack([np.zeros(n, np.bool_), over]), taken, -length)
    np.maximum.accumulate(began, axis=0, out=began)
    t = np.where(only_reset, schema.RESET_ONLY, taken[:-1] - began[:-1])
    # An episode's rewards are added one after the other, as `bincount` does: other orders round otherwise.
    first = np.append(0, np.cumsum(ended_before[-1] + 1)[:-1])
    segment = first + ended_before
    sums = np.bincount(
        np.append(first, segment[:-1]),
        np.append(carried, np.where(only_reset, 0.0, rewards)),
        minlength=int(segment[-1, -1]) + 1,
    )
    returns, left = sums[segment[:-1][over]], sums[segment[-1]]
    return EpisodeCounts(over, only_reset, ended_before, t, taken[1:] - began[:-1], returns, left)
