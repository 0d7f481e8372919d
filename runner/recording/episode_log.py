"""The episodes of a phase of a loop, as they follow from what its environments did, block by block.

A step counts for the episode in progress of its environment. An episode ends with a step that terminates or
truncates it, or by a reset before the next one. Recording and verification number, measure and order episodes
by these rules, which stand here alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp
from runner.util.arrays import Array, Flags, Floats, Ints

Columns = dict[str, Array]
"""Fields of records, by name."""


class TurnBlock(NamedTuple):
    """Steps of N environments that take turns, [rows, N] each."""

    first: int
    """The number of the first step in its phase."""
    rewards: Floats
    """[rows, N, agents]."""
    terminated: Flags
    truncated: Flags
    was_reset: Flags
    """Whether the environment was reset before the step."""
    only_reset: Flags | bool = False
    """Where no step was taken: the environment ignored its action and was reset."""
    is_over: Flags | bool = False
    """Where a game is over though it is so for none of its agents."""
    counts: Ints | None = None
    """[rows, N, events + 1]: events and penalties, where the environment's arrays define them."""
    environment: Array | None = None
    """[rows, N]: the environments, where these follow one another; else they are in order."""


class Episodes(NamedTuple):
    """What follows from a block of steps."""

    t: Ints
    """[rows, N]: the steps before each in its episode; 0 where none was taken."""
    number: Ints
    """[rows, N]: the number of the step's episode, counted in its environment."""
    ended: Columns
    """The fields of the records of the episodes that ended, in their order."""


class EpisodeLog:
    """The episodes of N environments in a phase, and what is carried from block to block.

    Args:
        has_turns: whether environments take turns, so that the records of episodes name theirs.
        zero: what sums of rewards begin with: 0.0, or -0.0 where the sum of negative zeros is one.
    """

    def __init__(self, n: int, agents: int, mdp: Mdp | None, has_turns: bool, zero: float = 0.0) -> None:
        self._n = n
        self._agents = agents
        self._mdp = mdp
        self._has_turns = has_turns
        self._zero = zero
        self._environments = np.arange(n)
        """The environments of the last steps."""
        self.episode = np.zeros(n, np.int64)
        """The number of the episode in progress, or of the next one, in each environment."""
        self.length = np.zeros(n, np.int64)
        """Its steps so far."""
        self._sums = np.zeros((n, agents + (1 + len(mdp.event_names) if mdp else 0)))
        """Its rewards by agent, and its events and penalties, so far."""
        if np.signbit(zero):  # zeros take no memory, however many environments a file declares
            self._sums[:] = zero
        self.ended = 0
        """Episodes of all environments that have ended."""

    def take(self, steps: TurnBlock) -> Episodes:
        """Take the next steps of all environments."""
        (rows, n), was_reset = steps.terminated.shape, steps.was_reset
        taken = np.broadcast_to(np.logical_not(steps.only_reset), (rows, n))
        ends = (steps.terminated | steps.truncated | steps.is_over) & taken
        count = np.cumsum(taken, axis=0, dtype=np.int64)
        before = count - taken
        after_end = np.vstack([np.zeros(n, np.bool_), ends[:-1]])
        # What `before` was when the episode began; its steps before the block count as taken before it.
        began = np.where(after_end | was_reset, before, -self.length)
        np.maximum.accumulate(began, axis=0, out=began)
        length = count - began
        left = np.vstack([self.length, length[:-1]])
        cut = was_reset & (left > 0) & ~after_end  # the reset ends an episode in progress
        number = np.cumsum(cut | after_end, axis=0, dtype=np.int64)
        sums, sum_of = self._summed(steps, number, ends[-1])
        episode = self.episode + number
        total = number[-1] + ends[-1]

        at, column = (np.concatenate(pair) for pair in zip(np.nonzero(ends), np.nonzero(cut), strict=True))
        by_reset = np.arange(len(at)) >= np.count_nonzero(ends)
        order = np.lexsort([column, by_reset, at - by_reset])
        at, column, by_reset = at[order], column[order], by_reset[order]
        environment = column
        if steps.environment is not None:
            environments = np.vstack([self._environments, steps.environment])
            environment = environments[at - by_reset + 1, column]
            self._environments = environments[-1]
        ended = self._end(
            environment,
            steps.first + (at - by_reset) * n + column,
            np.where(by_reset, left[at, column], length[at, column]),
            sums[sum_of[at, column] - by_reset],
            steps.terminated[at, column] & ~by_reset,
            steps.truncated[at, column] & ~by_reset,
        )
        self.episode = self.episode + total
        self.length = np.where(ends[-1], 0, length[-1])
        self._sums = sums[sum_of[-1] + ends[-1]]
        return Episodes(np.where(taken, before - began, 0), episode, ended)

    def interrupt(self, steps: int, environments: NDArray[np.integer]) -> Columns:
        """End the episodes in progress of some environments by a reset after `steps` of the phase.

        Returns the fields of their records.
        """
        at = environments[self.length[environments] > 0]
        never = np.zeros(len(at), np.bool_)
        last = np.asarray(steps - self._n + at, np.int64)
        ended = self._end(self._environments[at], last, self.length[at], self._sums[at], never, never)
        self.episode[at] += 1
        self.length[at], self._sums[at] = 0, self._zero
        return ended

    def _summed(self, steps: TurnBlock, number: Ints, ends: Flags) -> tuple[Floats, Ints]:
        """Return the sums of each episode, and for each step, [rows, N], the row of its episode among them.

        The episodes of an environment follow one another, with room for the episode after the last step.
        """
        values = steps.rewards
        if steps.counts is not None:
            values = np.concatenate([values, steps.counts], axis=-1)
        if steps.only_reset is not False:
            values = np.where(np.asarray(steps.only_reset)[..., np.newaxis], -0.0, values)  # adds nothing
        sizes = number[-1] + ends + 1
        first = np.cumsum(sizes) - sizes
        row = first + number
        sums = np.full((values.shape[-1], int(sizes.sum())), self._zero)
        at = np.append(first, row)
        with np.errstate(invalid="ignore", over="ignore"):
            for k, column in enumerate(sums):  # added one after the other: other orders round otherwise
                np.add.at(column, at, np.append(self._sums[:, k], values[..., k]))
        return sums.T, row

    def _end(
        self,
        environment: NDArray[np.integer],
        last: Ints,
        length: Ints,
        sums: Floats,
        terminated: Flags,
        truncated: Flags,
    ) -> Columns:
        """Return the fields of the records of episodes that ended; `last` are their last steps."""
        ended: Columns = {
            "episode": self.ended + np.arange(len(last)),
            "first_step": last - (length - 1) * self._n,
            "last_step": last,
            "length": length,
            "returns": sums[:, : self._agents],
            "terminated": terminated,
            "truncated": truncated,
        }
        if self._has_turns:
            ended["environment"] = environment
        if self._mdp is not None:
            counts = sums[:, self._agents :].astype(np.int64)
            success = [self._mdp.event_names.index(name) for name in self._mdp.success_events]
            ended |= {"events": counts[:, :-1], "penalties": counts[:, -1]}
            ended["success"] = np.asarray((counts[:, success] > 0).any(axis=1))
        self.ended += len(last)
        return ended
