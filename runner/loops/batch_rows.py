"""The steps of vector environments that come in batches: arrays of many steps at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.loops.description import Described
from runner.loops.generators import States
from runner.loops.vector_rows import VectorRows
from runner.recording.episode_log import Flags
from runner.recording.gym_values import fitted, put_unknown
from runner.recording.recorder import Recorder
from runner.util.arrays import Array


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
        self._current: Array = np.zeros(0, self._resets.dtype["observation"])
        """The observations after the last step or reset."""

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
        if not self._room:
            self._begin(actions)
        steps, n = rewards.shape
        of_one = np.dtype((self._actions.dtype, self._actions.shape[2:]))
        own = fitted(self._leaves[1], actions, (steps, n), of_one)
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
            row, count = self._filled, min(self._room - self._filled, steps - done)
            rows, part = slice(row, row + count), slice(done, done + count)
            self._actions[rows], self._observations[rows] = own[part], seen[part]
            self._paid[rows] = rewards[part]
            self._ends[rows, 0], self._ends[rows, 1] = terminated[part], truncated[part]
            if self._mode == AutoresetMode.SAME_STEP:
                at, which = np.nonzero(self._ends[rows].any(axis=1))
                self._add_resets(row + at + 1, which, self._observations[row + at, which])
                if last is not None:
                    self._observations[row + at, which] = last[done + at, which]
                elif len(at):
                    unknown = np.empty(len(at), self._resets.dtype["observation"])
                    put_unknown(self._leaves[0], unknown)
                    self._observations[row + at, which] = unknown
            if self._are_bytes:
                self._hold(*own[part].ravel(), *seen[part].ravel())
            self._filled += count
            done += count
            if self._filled >= self._room:
                self.commit()
                self._recorder.write_if_full()
        self._current = seen[-1].copy()

    def reset(
        self,
        observation: object,
        seeds: Sequence[int | None],
        which: Flags,
        states: States,
        options: str = "",
    ) -> None:
        """Record a reset of all environments; arguments as for a vector."""
        super().reset(observation, seeds, which, states, options)
        self._current = self._fitted(observation, self._n)

    def continues_with(self, observations: object) -> bool:
        """Return whether these are the observations [N, ...] after the last step or reset of the phase."""
        given, now = self._fitted(observations, self._n), self._current
        return bool((given == now).all()) if now.dtype.hasobject else given.tobytes() == now.tobytes()
