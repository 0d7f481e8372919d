"""The steps of vector environments that come in batches: arrays of many steps at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.loops.description import Described
from runner.loops.values import require_reset
from runner.loops.vector_rows import ResetsBetween, VectorRows
from runner.recording.episode_log import Flags
from runner.recording.gym_values import fitted, put_unknown
from runner.recording.recorder import Recorder


class BatchRows(VectorRows):
    """The steps of one phase that are not committed yet, put down many at once.

    Args:
        mode: how the environments reset themselves.
    """

    def __init__(
        self,
        recorder: Recorder,
        described: Described,
        phase: str,
        first_action: Callable[[object], None],
        mode: AutoresetMode,
    ) -> None:
        super().__init__(recorder, described, phase, first_action, mode == AutoresetMode.NEXT_STEP)
        self._mode = mode

    @property
    def has_begun(self) -> bool:
        """Whether the phase has a reset."""
        return self._reset_count > 0

    def take_batch(
        self,
        observations: object,
        actions: object,
        rewards: NDArray[np.float64],
        terminated: Flags,
        truncated: Flags,
        finals: object = None,
    ) -> None:
        """Record T steps of all environments; all or nothing of them.

        Args:
            observations: [T, N, ...], nested as their space: what the steps returned.
            actions: [T, N, ...], nested as their space. `rewards`, `terminated` and `truncated`: [T, N].
            finals: [T, N, ...], the last observations of episodes that ended, where `observations` are
                already of the next ones; None if they are unknown.

        Raises:
            ResetNeeded: the phase has no reset yet.
        """
        require_reset(self._reset_count, self._phase)
        if not self._room:
            self._first_action(actions)
            self._make_room()
        steps, n = rewards.shape
        own = fitted(self._action_leaves, actions, (steps, n), self._action_dtype)
        seen = self._fitted(observations, steps, n)
        last = None if finals is None else self._fitted(finals, steps, n)
        if self._mode == AutoresetMode.DISABLED:
            over = np.vstack([self.over, (terminated | truncated)[:-1]])
            if over.any():
                step, environment = np.argwhere(over)[0]
                raise RecordingError(
                    f"found step {step} of a batch in environment {environment} after the end of an episode, "
                    'expected a reset; another autoreset_mode than "Disabled" states that there was one.'
                )
        done = 0
        while done < steps:
            row = self._filled
            if not row:
                self._abandon(np.flatnonzero(self._over))
            count = min(self._room - row, steps - done)
            rows, part = slice(row, row + count), slice(done, done + count)
            self._actions[rows], self._observations[rows] = own[part], seen[part]
            self._rewards[rows] = rewards[part]
            self._terminated[rows], self._truncated[rows] = terminated[part], truncated[part]
            if self._mode == AutoresetMode.SAME_STEP:
                at, which = np.nonzero(self._terminated[rows] | self._truncated[rows])
                if last is None:
                    final = np.empty(len(which), self._observation_dtype)
                    put_unknown(self._observation_leaves, final)
                else:
                    final = last[done + at, which]
                self._finals.append((row + at, which, final))
                none, after = [None] * len(which), self._observations[row + at, which]
                self._block_resets.append(ResetsBetween(row + at + 1, which, after, none, none))
            self._filled += count
            done += count
            if self._filled == self._room:
                self.commit()
                self._recorder.write_if_full()

    def continues_with(self, observations: object) -> bool:
        """Return whether these are the observations [N, ...] after the last step or reset of the phase."""
        given, now = self._fitted(observations, self._n), self._now()
        return bool((given == now).all()) if now.dtype.hasobject else given.tobytes() == now.tobytes()
