"""The steps of a vector environment: whole batches are copied as they come."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from runner.environments.layers import final_observations
from runner.loops.description import Described
from runner.loops.generators import States
from runner.loops.rows import Rows
from runner.recording.episode_log import Flags
from runner.recording.gym_values import Put, element_of, filler, fitted
from runner.recording.recorder import Recorder
from runner.util.arrays import Array, Ints

_TRUE: Final = b"\1"


class VectorRows(Rows):
    """The steps of one phase of a vector environment that are not committed yet.

    Args:
        next_step: whether an environment whose episode is over ignores its next action and is reset.
    """

    def __init__(
        self,
        recorder: Recorder,
        described: Described,
        phase: str,
        first_action: Callable[[object], None],
        next_step: bool,
    ) -> None:
        super().__init__(recorder, described, phase, first_action)
        self._over: Flags = np.zeros(self._n, np.bool_)
        """[N]: the environments whose episodes were over before the block."""
        self._next_step = next_step
        self._autoreset_states: dict[int, States] = {}
        """Rows with resets in place of steps, and what those depended on."""
        self._counted, self._ended_here = 0, 0
        """Rows of the block of which `place` has counted the ends of episodes, and those ends."""

    @property
    def place(self) -> tuple[int, int]:
        """The steps of the phase so far, and the number of episodes that have ended."""
        if self._counted < self._filled:
            self._ended_here += int(np.count_nonzero(self._ends[self._counted : self._filled].any(axis=1)))
            self._counted = self._filled
        return self._recorder.steps[self._phase] + self.filled, self._log.ended + self._ended_here

    @property
    def is_any_over(self) -> bool:
        """Whether `over` may be true of an environment; this takes less time."""
        if not self._filled:
            return bool(self._over.any())
        return _TRUE in self._ends[self._filled - 1].tobytes()

    @property
    def over(self) -> Flags:
        """[N]: the environments whose episode ended with the last step and that were not reset since."""
        over: Flags = self._ends[self._filled - 1].any(axis=0) if self._filled else self._over.copy()
        resets = self._resets[: self._waiting]
        over[resets["environment"][resets["row"] == self._filled]] = False
        return over

    @over.setter
    def over(self, over: Flags) -> None:
        self.commit()
        self._over = over

    def take(
        self,
        actions: object,
        observations: object,
        rewards: object,
        terminated: object,
        truncated: object,
        infos: object,
        states: States | None = None,
    ) -> None:
        """Record a step of all environments.

        `rewards`, `terminated` and `truncated`: [N].

        Args:
            infos: what has the last observations of episodes that ended, where `observations` are already of
                the next ones; None where they are not.
            states: what the resets in place of steps depended on, if it is to be recorded.
        """
        if not self._room:
            self._begin(actions)
        row = self._filled
        self._put_action(row, actions)
        self._put_observation(row, observations)
        if rewards.__class__ is not np.ndarray or rewards.shape != (self._n,):
            rewards = np.asarray(rewards, np.float64).reshape(self._n)
        self._paid[row] = rewards
        ends = self._ends[row]
        ends[0], ends[1] = terminated, truncated
        if infos is not None and _TRUE in ends.tobytes() and (final := final_observations(infos)) is not None:
            which = ends.any(axis=0).nonzero()[0]
            self._add_resets(row + 1, which, self._observations[row, which])
            for i in which.tolist():
                self._put_last(row * self._n + i, element_of(final, i))
        if states:
            self._autoreset_states[row] = states
        if self._are_bytes:
            self._hold(*self._actions[row], *self._observations[row])
        self._filled = row + 1
        if self._filled == self._room:
            self.commit()
            self._recorder.write_if_full()

    def _allocate(self) -> None:
        super()._allocate()
        self._paid, self._ends = self._scratch["rewards"][:, :, 0], self._scratch["ends"]
        places = self._observations.reshape(-1, *self._observations.shape[2:])
        self._put_last = filler(self._leaves[0], places)

    def _filler(self, leaves: Any, column: Array) -> Put:
        return filler(leaves, column, (self._n,))

    def _fitted(self, observations: object, *batch: int) -> Array:
        """Return a batch of observations as they are recorded."""
        return fitted(self._leaves[0], observations, batch, self._resets.dtype["observation"])

    def reset(
        self,
        observation: object,
        seeds: Sequence[int | None],
        which: Flags,
        states: States,
        options: str = "",
    ) -> None:
        """Record a reset of some environments; it ends episodes in progress in them.

        Args:
            seeds: of all environments; empty for none.
            which: [N], the environments.
            states: what the reset depended on, if it is to be recorded.
            options: those of the reset as JSON; empty for none.
        """
        chosen, over, start = np.flatnonzero(which), self.over, self._waiting
        self._add_resets(self._filled, chosen, self._fitted(observation, self._n)[chosen])
        for k, i in enumerate(chosen.tolist(), start):
            self._put_seed(k, seeds[i] if len(seeds) else None, options)
            if i in states:
                self._attached[k].append(states[i])
        if not over[chosen].all() or self._waiting >= self._reset_room:
            self.commit()

    def _add_resets(self, rows: Ints | int, which: Ints, observations: Array) -> None:
        """Put down resets of environments before these rows, without seeds."""
        if self._are_bytes:
            self._hold(*observations)
        start, self._waiting = self._waiting, self._waiting + len(which)
        while self._waiting > len(self._resets):
            self._resets = np.concatenate([self._resets, np.zeros_like(self._resets)])
        added = self._resets[start : self._waiting]
        added["row"], added["environment"], added["observation"] = rows, which, observations
        self.resets += len(which)

    def commit(self) -> None:
        """Make the records of what was put down and hand them to the recorder."""
        over, self._last_position = self.over, self._recorder.position
        super().commit()
        self._over, self._autoreset_states = over, {}
        self._counted = self._ended_here = 0

    def _turns(self, was_reset: Flags) -> tuple[Flags, Flags | bool, Flags | bool]:
        over = np.vstack([self._over, self._ends[: self._filled - 1].any(axis=1)])
        only_reset: Flags = over & ~was_reset & self._next_step
        # They come after those that the user called before the step.
        rows, which = np.nonzero(only_reset)
        start = self._waiting
        self._add_resets(rows, which, self._observations[rows, which])
        for row, states in self._autoreset_states.items():
            for k in np.flatnonzero(rows == row).tolist():
                if (i := int(which[k])) in states:
                    self._attached[start + k].append(states[i])
        begins = was_reset | only_reset
        begins[0] |= self._over  # they ended among the steps of another phase, and were not reset since
        return begins, only_reset, False
