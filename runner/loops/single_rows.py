"""The rows of one environment, by the kind of its spaces, and of a game of several agents."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, Final, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.loops.description import Described
from runner.loops.rows import Rows
from runner.loops.values import lone_number, require_reset, warn_user, whole_number
from runner.recording.episode_log import Flags
from runner.recording.gym_values import filler, filler_by_agent, leaves_by_agent
from runner.util.arrays import Ints

_DISCRETE: Final = struct.Struct("<qqd??")
_DISCRETE_DTYPE: Final = np.dtype(
    [("action", "<i8"), ("next_state", "<i8"), ("rewards", "<f8"), ("terminated", "?"), ("truncated", "?")]
)
_ENDING: Final = struct.Struct("<d??")
_ENDING_DTYPE: Final = np.dtype([("rewards", "<f8"), ("terminated", "?"), ("truncated", "?")])
_MAX_STATE: Final = 2**32 - 1


class DiscreteRows(Rows):
    """Rows of `dualtaxi.Step`: both spaces are `Discrete`."""

    _scratch_dtype = _DISCRETE_DTYPE
    _state: int | None = None
    """The state before the first row; None before any reset."""

    def _set_leaves(self, described: Described) -> None:
        self._state_start = int(described.observation.start)  # type: ignore[attr-defined]
        self._action_start = int(described.action.start)  # type: ignore[attr-defined]

    def _open_steps(self) -> tuple[int, int]:
        rooms = super()._open_steps()
        self._reset_column = self._reset_block["observation"]
        return rooms

    def take(
        self,
        action: object,
        observation: object,
        reward: SupportsFloat,
        terminated: object,
        truncated: object,
    ) -> None:
        """Put down a step."""
        if self._state is None:
            require_reset(len(self._reset_rows), self._phase)
        try:
            reward = float(reward)
        except (TypeError, ValueError):
            reward = lone_number(reward, "reward")
        at = self.filled * 26
        try:
            _DISCRETE.pack_into(self._bytes, at, action, observation, reward, terminated, truncated)
        except (struct.error, TypeError):
            action, observation = whole_number(action, "action"), whole_number(observation, "observation")
            _DISCRETE.pack_into(self._bytes, at, action, observation, reward, terminated, truncated)
        self._count(terminated or truncated)

    def _put_reset(self, observation: object, seed: int | None) -> None:  # noqa: ARG002
        self._reset_column[len(self._reset_rows)] = whole_number(observation, "observation")

    def _transitions(self, n: int) -> tuple[Ints, Ints, Ints]:
        rows = self._scratch[:n]
        next_state = rows["next_state"] - self._state_start
        state = np.empty(n + 1, np.int64)
        state[0] = -1 if self._state is None else self._state
        state[1:] = next_state
        if self._reset_rows:
            state[self._reset_rows] = self._reset_column[: len(self._reset_rows)] - self._state_start
        self._state = int(state[n])
        self._columns = {
            "state": state[:n],
            "action": rows["action"] - self._action_start,
            "next_state": next_state,
        }
        return self._columns["state"], self._columns["action"], next_state

    def _finish_steps(self, n: int, episode: Ints, t: Ints, before: int) -> None:
        for name, values in self._columns.items():
            if not 0 <= values.min() <= values.max() <= _MAX_STATE:
                raise RecordingError(
                    f"found {name} {values.min()} to {values.max()}, outside of its Discrete space."
                )
            self._block[name][:n] = values
        super()._finish_steps(n, episode, t, before)


class ArrayRows(Rows):
    """Rows of `dualtaxi.Transition`, in spaces of fixed width or not."""

    _scratch_dtype = _ENDING_DTYPE
    _is_settled = False
    """Whether the dtype of actions is known: an action was put down."""

    def _open_steps(self) -> tuple[int, int]:
        rooms = super()._open_steps()
        put_action = filler(self._action_leaves, self._block["action"])
        self._action = put_action if self._is_settled else self._settle
        self._next = filler(self._observation_leaves, self._block["next_observation"])
        self._first = filler(self._observation_leaves, self._reset_block["observation"])
        return rooms

    def _settle(self, row: int, action: object) -> None:
        """Put down the first action, whose dtype is the one that all are recorded in."""
        self._is_settled = True
        self._first_action(action)
        self._action = filler(self._action_leaves, self._block["action"])
        self._action(row, action)

    def take(
        self,
        action: object,
        observation: object,
        reward: SupportsFloat,
        terminated: object,
        truncated: object,
    ) -> None:
        """Put down a step."""
        row = self.filled
        if not row:
            require_reset(self.resets, self._phase)
        try:
            reward = float(reward)
        except (TypeError, ValueError):
            reward = lone_number(reward, "reward")
        self._action(row, action)
        self._next(row, observation)
        _ENDING.pack_into(self._bytes, row * 10, reward, terminated, truncated)
        if self._are_bytes:
            self._hold(self._block["action"][row], self._block["next_observation"][row])
        self._count(terminated or truncated)

    def _put_reset(self, observation: object, seed: int | None) -> None:  # noqa: ARG002
        self._first(len(self._reset_rows), observation)
        if self._are_bytes:
            self._hold(self._reset_block["observation"][len(self._reset_rows)])

    def _finish_steps(self, n: int, episode: Ints, t: Ints, before: int) -> None:
        block, rows = self._block[:n], self._scratch[:n]
        block["acted"] = 1
        block["agents_terminated"], block["agents_truncated"] = rows["terminated"], rows["truncated"]
        super()._finish_steps(n, episode, t, before)


class AgentRows(Rows):
    """Rows of `dualtaxi.Transition` of all agents of a PettingZoo parallel environment."""

    _is_settled = False

    @property
    def place(self) -> tuple[int, int]:
        """The steps of the phase so far, and the number of episodes that have ended."""
        return super().place[0], self._begun - (not self._fresh)

    def _set_leaves(self, described: Described) -> None:
        self._agents = described.agents
        self._scratch_dtype = np.dtype(
            [
                ("rewards", "<f8", (len(self._agents),)),
                *((name, "?") for name in ("terminated", "truncated", "over")),
            ]
        )
        self._own_observations = leaves_by_agent(described.observation, "observation", warn_user)
        self._own_actions = leaves_by_agent(described.recorded_action, "action", warn_user)

    def _open_steps(self) -> tuple[int, int]:
        rooms = super()._open_steps()
        self._action = filler_by_agent(self._own_actions, self._block["action"])
        self._next = filler_by_agent(self._own_observations, self._block["next_observation"])
        self._first = filler_by_agent(self._own_observations, self._reset_block["observation"])
        return rooms

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
        require_reset(self.resets, self._phase)
        if not self._is_settled:
            self._is_settled = True
            self._first_action(actions)
        row = self.filled
        self._action(row, actions)
        self._next(row, observations)
        self._block["acted"][row] = self._mask(dict.fromkeys(actions, True))
        self._block["agents_terminated"][row] = self._mask(terminated)
        self._block["agents_truncated"][row] = self._mask(truncated)
        paid = np.array([float(rewards.get(agent, 0.0)) for agent in self._agents])
        endings = [over and any(flags.values()) for flags in (terminated, truncated)]
        self._scratch[row] = (paid, *endings, over)
        if self._are_bytes:
            self._hold(self._block["action"][row], self._block["next_observation"][row])
        self._count(over)

    def _outcomes(self, n: int) -> tuple[NDArray[np.void], Flags | bool]:
        return self._scratch[:n], self._scratch["over"][:n, np.newaxis]

    def _put_reset(self, observation: Any, seed: int | None) -> None:  # noqa: ARG002
        self._first(len(self._reset_rows), observation)
        if self._are_bytes:
            self._hold(self._reset_block["observation"][len(self._reset_rows)])

    def _mask(self, flags: Mapping[str, bool]) -> int:
        return sum(bool(flags.get(agent)) << i for i, agent in enumerate(self._agents))


ROWS: Final[dict[str, type[Rows]]] = {"step": DiscreteRows, "transition": ArrayRows, "variable": ArrayRows}
"""The rows of one environment by the kind of recording."""
