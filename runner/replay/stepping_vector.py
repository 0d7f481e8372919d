"""A vector environment that is stepped as a whole: of its own class, or with wrappers around the vector."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.environments.gym_types import AnyVectorEnv, Space
from runner.errors import CannotRedo
from runner.recording import schema
from runner.recording.gym_values import element_of, filler, leaves_of
from runner.recording.reader import Recording
from runner.recording.spaces import Value
from runner.replay.recorded import RecordedReset, calls
from runner.replay.redone import Frame
from runner.replay.stepping import Results, Stepper, batched, keyed, values_in
from runner.util.processes import raise_if_out_of_memory

_Numbered = tuple[int, RecordedReset]
"""The place of a reset among those of a block, and the reset."""


class VectorStepper(Stepper):
    """All environments of a vector; rows are those of all of them, in the order of the recording.

    Args:
        autoreset: `NextStep`, `SameStep` or `Disabled`; with `SameStep`, the picture after the last step of
            an episode shows the beginning of the next one.
        drawn: the environment that is drawn.
    """

    def __init__(self, env: Any, recording: Recording, autoreset: str, drawn: int = 0) -> None:
        super().__init__(env, recording)
        self._drawn = drawn
        self._autoreset, self._n = autoreset, recording.environments
        if env.num_envs != self._n:
            raise CannotRedo(f"The vector has {env.num_envs} environments, and the recording {self._n}.")
        self._leaves = leaves_of(self.observation_space, "observation")
        self._over = np.zeros(self._n, np.bool_)
        """The environments whose episode ended with the last step."""
        self._last = np.zeros(self._n, self.dtypes.reset)
        """What the vector returned last."""
        self._put = filler(self._leaves, self._last[np.newaxis], (self._n,))

    def _spaces(self) -> tuple[Space, Space]:
        return spaces_of_one(self.env)

    def run(self, rows: NDArray[np.void], resets: Sequence[tuple[int, RecordedReset]]) -> Results:
        """Do recorded steps again, until the environment raises an error.

        Args:
            rows: the recorded steps, as many of each environment.
            resets: step of each environment, and reset, in order; each comes before its step.
        """
        n, times = self._n, len(rows) // self._n
        results = Results(len(rows), len(resets), self.dtypes, 1, self._drawn)
        by_time: dict[int, list[_Numbered]] = {}
        for number, (time, reset) in enumerate(resets):
            by_time.setdefault(time, []).append((number, reset))
        actions = self._actions(rows, times)
        only_reset = (rows["t"] == schema.RESET_ONLY).reshape(times, n)
        try:
            for time in range(times):
                here = by_time.get(time, [])
                automatic = only_reset[time]
                self._reset_before(here, automatic, results)
                first = self._first_frame(here, automatic)
                self._step(time, actions[time], results)
                if self.draws:
                    results.frames.append(self.draw())
                    results.first_frames += first or ([results.frames[-1]] if automatic[self._drawn] else [])
                for number, reset in here:
                    if automatic[reset.environment]:
                        results.first_observations[number] = self._last[reset.environment]
                results.done += n
                results.resets_done += len(here)
            left, none = by_time.get(times, []), np.zeros(n, np.bool_)
            self._reset_before(left, none, results)
            results.first_frames += self._first_frame(left, none)
            results.resets_done = len(resets)
        except (MemoryError, CannotRedo):
            raise
        except Exception as error:  # foreign code raises anything
            raise_if_out_of_memory()
            results.error = error
        return results

    def _first_frame(self, resets: Sequence[_Numbered], automatic: NDArray[np.bool_]) -> list[Frame]:
        """Return a picture for each reset of the environment that is drawn, but those that a step does."""
        own = [reset for _, reset in resets if reset.environment == self._drawn]
        return [self.draw() for _ in own] if self.draws and not automatic[self._drawn] else []

    def _render(self) -> Any:
        pictures = self.env.render()
        if pictures is None or len(pictures) != self._n:
            raise CannotRedo("The vector environment draws no pictures of its environments.")
        return pictures[self._drawn]

    def _actions(self, rows: NDArray[np.void], times: int) -> Sequence[Value]:
        """Return the actions of all environments as the vector takes them, for each of its steps."""
        space, n = self.action_space, self._n
        if self._recording.train.steps.dtype is None:
            values = [keyed(space, action) for action in self._decoded_actions(rows)]
            return [batched(space, values[time * n : time * n + n]) for time in range(times)]
        column = np.array(rows["action"])
        if self._recording.has_states:
            column = column.astype(np.int64) + int(space.start)  # type: ignore[attr-defined]
        return values_in(space, column.reshape(times, n, *column.shape[1:]))

    def _reset_before(
        self, resets: Sequence[_Numbered], automatic: NDArray[np.bool_], results: Results
    ) -> None:
        """Do the resets before a step, but those that the step itself does."""
        explicit = []
        for number, reset in resets:
            own = reset.environment
            if automatic[own]:
                continue
            if self._autoreset == "SameStep" and self._over[own]:
                self._over[own] = False  # the step before did it
                results.first_observations[number] = self._last[own]
            else:
                explicit.append((number, reset))
        for call in calls(explicit, lambda numbered: numbered[1].environment):
            which = np.zeros(self._n, np.bool_)
            which[[reset.environment for _, reset in call]] = True
            options = dict(call[0][1].options or {}) | ({} if which.all() else {"reset_mask": which})
            seeds = [self._seed(reset) for _, reset in call]
            arguments: dict[str, object] = {"options": options} if options else {}
            if seeds == list(range(seeds[0] or 0, (seeds[0] or 0) + self._n)):
                arguments["seed"] = seeds[0]  # not every vector takes a list
            elif any(seed is not None for seed in seeds):
                own_seeds: list[int | None] = [None] * self._n
                for (_, reset), seed in zip(call, seeds, strict=True):
                    own_seeds[reset.environment] = seed
                arguments["seed"] = own_seeds if hasattr(self.env.unwrapped, "envs") else seeds[0]
            self._put(0, self.env.reset(**arguments)[0])
            for number, reset in call:
                results.first_observations[number] = self._last[reset.environment]

    def _step(self, time: int, action: Value, results: Results) -> None:
        """Take a step of all environments, and fill in its row."""
        observations, rewards, terminated, truncated, infos = self.env.step(action)
        self._put(0, observations)
        rows = slice(time * self._n, (time + 1) * self._n)
        after = self._last.copy()
        self._over = np.asarray(terminated) | np.asarray(truncated)
        final = final_observations(infos) if self._autoreset == "SameStep" else None
        if final is not None and self._over.any():
            put = filler(self._leaves, after)
            for i in np.flatnonzero(self._over).tolist():
                put(i, element_of(final, i))
        if self._recording.has_states:
            after = after - int(self.observation_space.start)  # type: ignore[attr-defined]
        results.observations[rows] = after
        results.rewards[rows, 0] = rewards
        results.terminated[rows] = terminated
        results.truncated[rows] = truncated

    def _seed(self, reset: RecordedReset) -> int | None:
        """Return the seed of a reset, after restoring the state that it depends on."""
        if reset.seed is not None or reset.state is None:
            return reset.seed
        base = self.env.unwrapped
        if hasattr(base, "envs"):
            base = base.envs[reset.environment].unwrapped
        return self._restore(reset.state, base)


def spaces_of_one(envs: AnyVectorEnv) -> tuple[Space, Space]:
    """Return the spaces of observation and action of one environment of a vector.

    Older vectors, such as SuperSuit's, have no `single_` spaces: their spaces are those of one environment.
    """
    observation = getattr(envs, "single_observation_space", None) or envs.observation_space
    return observation, getattr(envs, "single_action_space", None) or envs.action_space


def final_observations(infos: Any) -> Value:
    """Return the last observations of the episodes that ended in a step, by environment; None if none did."""
    if isinstance(infos, Mapping):
        return infos.get("final_obs")
    last = [info.get("terminal_observation") for info in infos]  # as SuperSuit's vectors return them
    return last if any(value is not None for value in last) else None
