"""The competitive game as a PettingZoo environment: each taxi a learner with its own reward."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from dualtaxi.env import DualTaxiEnv
from dualtaxi.grid import ACTIONS, AGENTS
from dualtaxi.transitions import Rewards

try:
    from pettingzoo import ParallelEnv
except ImportError as error:
    raise ImportError(
        "dualtaxi.parallel needs pettingzoo, which is not installed: pip install 'pettingzoo>=1.25'"
    ) from error


class DualTaxiParallelEnv(ParallelEnv, RecordConstructorArgs):  # type: ignore[misc]
    """Two taxis, each for itself; the rules are those of the competitive `dualtaxi.DualTaxiEnv`.

    Both agents, `taxi_1` and `taxi_2`, see the whole state (`Discrete(6144)`, see `DualTaxiEnv`), choose
    one of 6 actions at the same time and get their own reward. The episode ends for both at once:
    terminated as in `DualTaxiEnv`, truncated after `max_steps` steps. An agent's info holds `prob` and its
    own `action_mask`, int8 [6].

    ## Arguments
    - `max_steps=1500`: steps until truncation.
    - `render_mode`, `rewards`, `map`, `slip`: as in `DualTaxiEnv`.
    """

    metadata = {  # noqa: RUF012 - as the base class has it
        **DualTaxiEnv.metadata,
        "name": "dualtaxi_v1",
        "is_parallelizable": True,
    }

    def __init__(
        self,
        render_mode: str | None = None,
        *,
        max_steps: int = 1500,
        rewards: Rewards | Mapping[str, float] | None = None,
        map: Sequence[str] | None = None,  # noqa: A002 - as in DualTaxiEnv
        slip: float = 0.0,
    ) -> None:
        if isinstance(max_steps, bool) or not isinstance(max_steps, int) or max_steps < 1:
            raise ValueError(f"max_steps is {max_steps!r}, expected a whole number of at least 1")
        self.game = DualTaxiEnv(render_mode, competitive=True, rewards=rewards, map=map, slip=slip)
        named = asdict(rewards) if isinstance(rewards, Rewards) else rewards and dict(rewards)
        RecordConstructorArgs.__init__(self, max_steps=max_steps, rewards=named, map=map, slip=slip)
        self.render_mode = render_mode
        self.max_steps = max_steps
        self.possible_agents = list(AGENTS)
        self.agents: list[str] = []
        self._taken = 0
        self._observation_spaces = {agent: spaces.Discrete(self.game.grid.states) for agent in AGENTS}
        self._action_spaces = {agent: spaces.Discrete(len(ACTIONS)) for agent in AGENTS}

    def observation_space(self, agent: str) -> spaces.Discrete:
        """Return the space of an agent's observations: the number of the state."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Discrete:
        """Return the space of an agent's actions."""
        return self._action_spaces[agent]

    def get_action_meanings(self) -> list[str]:
        """Return the names of an agent's actions, by their numbers."""
        return list(ACTIONS)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, int], dict[str, dict[str, Any]]]:
        """Start an episode; return observation and info of each agent."""
        state, info = self.game.reset(seed=seed, options=options)
        self.agents = list(AGENTS)
        self._taken = 0
        return dict.fromkeys(AGENTS, state), self._infos(state, info["prob"])

    def step(
        self, actions: Mapping[str, int]
    ) -> tuple[dict[str, int], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Take the actions of both agents; return observations, rewards, terminated, truncated and infos.

        Raises:
            ResetNeeded: No episode is under way.
            ValueError: An agent's action is missing or unknown, or there are others' besides.
        """
        if not self.agents:
            raise ResetNeeded("step() with no episode under way; call reset() first")
        if set(actions) != set(AGENTS):
            raise ValueError(f"actions are for {sorted(actions)}, expected one for each of {list(AGENTS)}")
        joint = self.game.encode_action(*(actions[agent] for agent in AGENTS))
        state, _, terminated, _, info = self.game.step(joint)
        self._taken += 1
        truncated = self._taken >= self.max_steps
        if terminated or truncated:
            self.agents = []
        return (
            dict.fromkeys(AGENTS, state),
            dict(zip(AGENTS, info["rewards"].tolist(), strict=True)),
            dict.fromkeys(AGENTS, terminated),
            dict.fromkeys(AGENTS, truncated),
            self._infos(state, info["prob"]),
        )

    def state(self) -> NDArray[np.int64]:
        """Return the number of the state, int64 [1]."""
        if self.game.s is None:
            raise ResetNeeded("state() before an episode has begun; call reset() first")
        return np.array([self.game.s], dtype=np.int64)

    def render(self) -> Any:
        """Return the current state as text (`ansi`) or as a picture (`rgb_array`)."""
        return self.game.render()

    def _infos(self, state: int, probability: float) -> dict[str, dict[str, Any]]:
        return {
            agent: {"prob": probability, "action_mask": self.game.agent_action_mask(state, agent)}
            for agent in AGENTS
        }
