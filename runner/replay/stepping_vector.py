"""A vector environment that is stepped as a whole: of its own class, or with wrappers around the vector."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.environments.gym_types import Space
from runner.environments.layers import final_observations, spaces_of_one
from runner.errors import CannotRedo
from runner.recording.gym_values import element_of, filler, leaves_of
from runner.recording.reader import Recording
from runner.recording.spaces import Value
from runner.recording.turns import is_taken
from runner.replay.comparison import Returned, Start
from runner.replay.recorded import RecordedReset, calls
from runner.replay.stepping import Fill, Stepper, batched, values_in
from runner.util.arrays import Array


class VectorStepper(Stepper):
    """All environments of a vector; rows are those of all of them, in the order of the recording.

    Args:
        autoreset: `NextStep`, `SameStep` or `Disabled`; with `SameStep`, the picture after the last step of
            an episode shows the beginning of the next one.
        drawn: the environment that is drawn.
    """

    def __init__(self, env: Any, recording: Recording, autoreset: str, drawn: int = 0) -> None:
        super().__init__(env, recording)
        self.n = recording.environments
        if env.num_envs != self.n:
            raise CannotRedo(f"The vector has {env.num_envs} environments, and the recording {self.n}.")
        self._autoreset, self._drawn = autoreset, drawn
        self._leaves = leaves_of(self.observation_space, "observation")
        self._over = np.zeros(self.n, np.bool_)
        """The environments whose episode ended with the last step."""
        self._buffer = np.zeros((1, self.n), self._first_dtype)
        self._put = filler(self._leaves, self._buffer, (self.n,))
        self._last: Array = self._buffer[0]
        """What the vector returned last."""

    def _spaces(self) -> tuple[Space, Space]:
        return spaces_of_one(self.env)

    def _see(self, observations: Value) -> None:
        self._put(0, observations)
        self._last = self._buffer[0].copy()

    def _reset(self, step: int, resets: Sequence[RecordedReset], returned: Returned) -> None:
        are_steps, explicit, automatic = is_taken(returned.rows[step * self.n :][: self.n]), [], []

        def add(reset: RecordedReset) -> None:
            frame = self.draw() if self.draws and reset.environment == self._drawn else None
            returned.starts.append(Start(step, reset, self._last[reset.environment], frame))

        for reset in resets:
            environment = reset.environment
            if len(are_steps) and not are_steps[environment]:
                automatic.append(reset)  # the step does it
            elif self._autoreset == "SameStep" and self._over[environment]:
                self._over[environment] = False  # the step before did it
                add(reset)
            else:
                explicit.append(reset)
        for call in calls(explicit):
            self._see(self.env.reset(**self._arguments(call))[0])
            for reset in call:
                add(reset)
        if automatic:
            self._take(step + 1, returned)
            for reset in automatic:
                add(reset)

    def _base(self, environment: int) -> Any:
        base = self.env.unwrapped
        return base.envs[environment].unwrapped if hasattr(base, "envs") else base

    def _arguments(self, call: Sequence[RecordedReset]) -> dict[str, object]:
        """Return the arguments of a call of `reset`."""
        environments = [reset.environment for reset in call]
        mask = np.isin(np.arange(self.n), environments)
        options = dict(call[0].options or {}) | ({} if mask.all() else {"reset_mask": mask})
        seeds = {reset.environment: self._seed(reset) for reset in call}
        first = seeds[environments[0]]
        arguments: dict[str, object] = {"options": options} if options else {}
        if all(seed is None for seed in seeds.values()):
            return arguments
        # Not every vector takes a list
        is_counted = list(seeds.values()) == list(range(first or 0, (first or 0) + self.n))
        is_one = is_counted or not hasattr(self.env.unwrapped, "envs")
        return arguments | {"seed": first if is_one else [seeds.get(i) for i in range(self.n)]}

    def _filler(self, got: NDArray[np.void], ends: NDArray[np.void]) -> Fill:
        n, column, paid = self.n, got[self._after], ends["rewards"][:, 0]
        over = ends["terminated"], ends["truncated"]
        start = int(self.observation_space.start) if self._has_states else 0  # type: ignore[attr-defined]

        def fill(step: int, result: Any) -> None:
            observations, rewards, terminated, truncated, infos = result
            self._see(observations)
            after, rows = self._last, slice(step * n, step * n + n)
            self._over = np.asarray(terminated) | np.asarray(truncated)
            final = final_observations(infos) if self._autoreset == "SameStep" else None
            if final is not None and self._over.any():
                after = after.copy()
                put = filler(self._leaves, after)
                for i in np.flatnonzero(self._over).tolist():
                    put(i, element_of(final, i))
            column[rows] = after - start if start else after
            paid[rows], over[0][rows], over[1][rows] = rewards, terminated, truncated

        return fill

    def actions(self, rows: NDArray[np.void]) -> Sequence[Value]:
        """Return the actions of all environments as the vector takes them, for each of its steps."""
        space, n, column = self.action_space, self.n, np.array(rows["action"])
        if column.dtype.hasobject:
            values = super().actions(rows)
            return [batched(space, values[k : k + n]) for k in range(0, len(values), n)]
        if self._has_states:
            column = column.astype(np.int64) + int(space.start)  # type: ignore[attr-defined]
        return values_in(space, column.reshape(-1, n, *column.shape[1:]))

    def _render(self) -> Any:
        pictures = self.env.render()
        if pictures is None or len(pictures) != self.n:
            raise CannotRedo("The vector environment draws no pictures of its environments.")
        return pictures[self._drawn]
