"""The rows of one environment, by the kind of its spaces, and of a game of several agents."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import Any, Final, SupportsFloat

import numpy as np

from runner.loops.description import Described
from runner.loops.rows import Rows
from runner.loops.values import lone_number, warn_user, whole_number
from runner.recording.episode_log import Columns, Flags
from runner.recording.gym_values import Put, filler, filler_by_agent, leaves_by_agent
from runner.recording.recorder import Recorder
from runner.recording.reset_states import ResetState
from runner.util.arrays import Array, Records

_DISCRETE: Final = struct.Struct("<qqd??")
_ENDING: Final = struct.Struct("<d??")


class SingleRows(Rows):
    """Rows of one environment."""

    def __init__(
        self, recorder: Recorder, described: Described, phase: str, first_action: Callable[[object], None]
    ) -> None:
        super().__init__(recorder, described, phase, first_action)
        self._put_first = self._filler(self._leaves[0], self._resets["observation"][:, np.newaxis])
        self._fresh = True
        """Whether the next step begins an episode."""
        self._begun = 0
        """Episodes that have begun."""

    @property
    def place(self) -> tuple[int, int]:
        """The steps of the phase so far, and the number of the episode that began last; 0 before any."""
        return self._recorder.steps[self._phase] + self._filled, max(self._begun - 1, 0)

    def reset(
        self, observation: object, seed: int | None, options: str = "", state: ResetState | None = None
    ) -> None:
        """Put down a reset; it ends an episode in progress, neither terminated nor truncated.

        Args:
            options: those of the reset as JSON; empty for none.
            state: what the reset depended on, if it is to be recorded.
        """
        k = self._waiting
        self._put_first(k, observation)
        if self._are_bytes:
            self._hold(self._resets["observation"][k])
        self._resets["row"][k] = self._filled
        self._put_seed(k, seed, options)
        if state is not None:
            self._attached[k].append(state)
        self._fresh = True
        self.resets += 1
        self._waiting = k + 1
        if self._waiting >= self._reset_room:
            self.commit()

    def take(
        self,
        action: object,
        observation: object,
        reward: SupportsFloat,
        terminated: object,
        truncated: object,
    ) -> None:
        """Put down a step."""
        if not self._room:
            self._begin(action)
        row = self._filled
        try:
            reward = float(reward)
        except (TypeError, ValueError):
            reward = lone_number(reward, "reward")
        self._put_action(row, action)
        self._put_observation(row, observation)
        _ENDING.pack_into(self._bytes, row * 10, reward, terminated, truncated)
        if self._are_bytes:
            self._hold(self._actions[row, 0], self._observations[row, 0])
        self._count(terminated or truncated)

    def _count(self, is_over: object) -> None:
        """Count the row that was just put down; `is_over` is whether the episode ended with it."""
        self._begun += self._fresh
        self._fresh = bool(is_over)
        self._filled += 1
        if self._filled == self._room:
            self.commit()
            self._recorder.write_if_full()

    def _allocate(self) -> None:
        super()._allocate()
        self._bytes = self._scratch.view(np.uint8).data

    def _filler(self, leaves: Any, column: Array) -> Put:
        return filler(leaves, column[:, 0])


class DiscreteRows(SingleRows):
    """Rows over states: both spaces are `Discrete`."""

    def _allocate(self) -> None:
        values = [(name, "<i8", (1,)) for name in ("action", "observation")]
        self._scratch = np.zeros(0, [*values, *self._scratch.dtype.descr])
        super()._allocate()
        self._actions, self._observations = self._scratch["action"], self._scratch["observation"]

    def _filler(self, leaves: Any, column: Array) -> Put:  # noqa: ARG002
        def put(row: int, value: object) -> None:
            column[row] = whole_number(value, "observation")

        return put

    def take(
        self,
        action: object,
        observation: object,
        reward: SupportsFloat,
        terminated: object,
        truncated: object,
    ) -> None:
        """Put down a step."""
        if not self._room:
            self._begin(action)
        try:
            reward = float(reward)
        except (TypeError, ValueError):
            reward = lone_number(reward, "reward")
        at = self._filled * 26
        try:
            _DISCRETE.pack_into(self._bytes, at, action, observation, reward, terminated, truncated)
        except (struct.error, TypeError):
            action, observation = whole_number(action, "action"), whole_number(observation, "observation")
            _DISCRETE.pack_into(self._bytes, at, action, observation, reward, terminated, truncated)
        self._count(terminated or truncated)


class AgentRows(SingleRows):
    """Rows of all agents of a PettingZoo parallel environment."""

    @property
    def place(self) -> tuple[int, int]:
        """The steps of the phase so far, and the number of episodes that have ended."""
        return super().place[0], self._begun - (not self._fresh)

    def reshape(self, described: Described) -> None:
        """Prepare for actions of another dtype, before the first step."""
        self._agents = described.agents
        self._leaves = (
            leaves_by_agent(described.observation, "observation", warn_user),
            leaves_by_agent(described.recorded_action, "action", warn_user),
        )

    def _allocate(self) -> None:
        super()._allocate()
        masks = [(name, "<u4") for name in ("acted", "agents_terminated", "agents_truncated")]
        self._of_game = np.zeros(self._room, [*masks, ("over", "?")])

    def _filler(self, leaves: Any, column: Array) -> Put:
        return filler_by_agent(leaves, column[:, 0])

    def take_game(
        self,
        actions: Mapping[str, object],
        observations: Mapping[str, object],
        rewards: Mapping[str, float],
        terminated: Mapping[str, bool],
        truncated: Mapping[str, bool],
        over: bool,
    ) -> None:
        """Put down a step; agents that are missing took no part in it."""
        if not self._room:
            self._begin(actions)
        row = self._filled
        self._put_action(row, actions)
        self._put_observation(row, observations)
        paid = [float(rewards.get(agent, 0.0)) for agent in self._agents]
        masks = map(self._mask, (dict.fromkeys(actions, True), terminated, truncated))
        self._of_game[row] = (*masks, over)
        self._scratch[row] = [paid], [[over and any(ends.values())] for ends in (terminated, truncated)]
        if self._are_bytes:
            self._hold(self._actions[row, 0], self._observations[row, 0])
        self._count(over)

    def _turns(self, was_reset: Flags) -> tuple[Flags, Flags | bool, Flags | bool]:
        return was_reset, False, self._of_game["over"][: len(was_reset), np.newaxis]

    def _values(self, rows: int, resets: Records, only_reset: Flags | bool) -> Columns:
        masks = ("acted", "agents_terminated", "agents_truncated")
        return super()._values(rows, resets, only_reset) | {
            name: self._of_game[name][:rows, np.newaxis] for name in masks
        }

    def _mask(self, flags: Mapping[str, bool]) -> int:
        return sum(bool(flags.get(agent)) << i for i, agent in enumerate(self._agents))


def single_rows(described: Described) -> type[SingleRows]:
    """Return the class of the rows of one environment."""
    return DiscreteRows if described.layout.has_states else SingleRows
