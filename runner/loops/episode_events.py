"""Penalties and events of episodes, counted by an environment's arrays for a block of steps at once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp, step_counts


class Judge:
    """Counts the penalties and events of episodes, where the environment's arrays say what they are."""

    def __init__(self, mdp: Mdp | None) -> None:
        self._mdp = mdp
        self.off_table = 0
        """Steps whose reward the environment's table excludes: a wrapper changed it, or a rule of its own."""
        self._counts = np.zeros((1, 1), np.int64)
        """[rows + 1, events + 1]: events and penalties before each row, counted from the first."""
        self._carried = np.zeros(1 + (len(mdp.event_names) if mdp else 0), np.int64)
        """Those of the episode under way, before the first row."""

    def judge(
        self,
        rewards: NDArray[np.float64],
        state: NDArray[Any],
        action: NDArray[Any],
        next_state: NDArray[Any],
    ) -> None:
        """Look at rows."""
        mdp = self._mdp
        if mdp is None:
            return
        bits = np.zeros((len(rewards) + 1, len(self._carried)), np.int64)
        bits[1:], excluded = step_counts(mdp, rewards, state, action, next_state)
        self.off_table += int(np.count_nonzero(excluded))
        self._counts = bits.cumsum(axis=0)

    def fill(self, episodes: NDArray[np.void], first: NDArray[Any], last: NDArray[Any]) -> None:
        """Fill in the counts of episodes from their first and last rows; those before 0 are carried."""
        mdp = self._mdp
        if mdp is None:
            return
        counts = self._counts[last + 1] - self._counts[np.maximum(first, 0)]
        counts[first < 0] += self._carried
        episodes["penalties"] = counts[:, -1]
        episodes["events"] = counts[:, :-1]
        wanted = [mdp.event_names.index(name) for name in mdp.success_events]
        episodes["success"] = (counts[:, wanted] > 0).any(axis=1)

    def carry(self, start: int) -> None:
        """Keep what the episode that began at this row has counted, for the rows to come."""
        if self._mdp is not None:
            kept = self._carried if start < 0 else 0
            self._carried = self._counts[-1] - self._counts[max(start, 0)] + kept
