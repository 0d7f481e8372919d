"""Games with the interface of PettingZoo's parallel ones: those in turns (`AECEnv`), and those of RLlib."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gymnasium import spaces

    from runner.environments.gym_types import Space

ByAgent = dict[Any, Any]
"""Values of a game by agent."""
GameStepResult = tuple[ByAgent, ByAgent, ByAgent, ByAgent, ByAgent]


def as_parallel(env: Any) -> Any:
    """Return a game with the interface of PettingZoo's parallel ones: itself, unless it has another."""
    if is_in_turns(env):
        return Turns(env)
    return MultiAgent(env) if is_multi_agent(env) else env


def is_multi_agent(env: object) -> bool:
    """Return whether an environment has the interface of RLlib's `MultiAgentEnv`."""
    own = getattr(env, "unwrapped", env)
    parts = ("get_observation_space", "possible_agents")
    return not isinstance(env, MultiAgent) and all(hasattr(own, part) for part in parts)


def is_in_turns(env: object) -> bool:
    """Return whether an environment has the interface of an `AECEnv`."""
    return all(hasattr(env, part) for part in ("agent_iter", "last", "observe"))


def is_game(env: object) -> bool:
    """Return whether an environment steps several agents, and not one as Gymnasium's do."""
    import gymnasium  # slow to import

    return is_multi_agent(env) or not isinstance(env, gymnasium.Env)  # RLlib's games are both


def game_spaces(env: Any) -> tuple[spaces.Dict, spaces.Dict]:
    """Return the spaces of the observations and actions of all agents of a game."""
    from gymnasium import spaces  # slow to import

    agents = env.possible_agents
    observations = spaces.Dict({agent: env.observation_space(agent) for agent in agents})
    return observations, spaces.Dict({agent: env.action_space(agent) for agent in agents})


class Turns:
    """A game in turns as a parallel game: a step is that of the selected agent, with what all agents got.

    The steps by which PettingZoo removes an agent that is terminated or truncated are not steps of it.

    Args:
        removes: whether agents that are over are removed after each step; else the caller does it.
    """

    def __init__(self, env: Any, removes: bool = True) -> None:
        self.env = env
        self.removes = removes
        self.possible_agents = env.possible_agents
        self.metadata = getattr(env, "metadata", None)
        self.render_mode = getattr(env, "render_mode", None)
        self.unwrapped = env.unwrapped

    def observation_space(self, agent: object) -> Space:
        """Return the space of an agent's observations."""
        space: Space = self.env.observation_space(agent)
        return space

    def action_space(self, agent: object) -> Space:
        """Return the space of an agent's actions."""
        space: Space = self.env.action_space(agent)
        return space

    @property
    def agents(self) -> list[object]:
        """The agent that acts next; none if the game is over."""
        return [] if all(map(self._is_over, self.env.agents)) else [self.env.agent_selection]

    def reset(self, **arguments: object) -> tuple[ByAgent, ByAgent]:
        """Begin a game; return the observations and infos of all agents."""
        self.env.reset(**arguments)
        return self._observations(), dict(self.env.infos)

    def step(self, actions: ByAgent) -> GameStepResult:
        """Take the step of the selected agent; return what a parallel game returns, of all agents.

        Raises:
            ValueError: the actions are not of the agent whose turn it is.
        """
        env = self.env
        if list(actions) != [env.agent_selection]:
            raise ValueError(
                f"found actions of {', '.join(map(str, actions))}: it is the turn of {env.agent_selection}"
            )
        env.step(actions[env.agent_selection])
        result = (
            self._observations(),
            dict(env.rewards),
            dict(env.terminations),
            dict(env.truncations),
            dict(env.infos),
        )
        while self.removes and env.agents and self._is_over(env.agent_selection):
            env.step(None)
        return result

    def render(self) -> object:
        """Return a picture of the game."""
        return self.env.render()

    def close(self) -> None:
        """Close the game."""
        self.env.close()

    def _observations(self) -> ByAgent:
        return {agent: self.env.observe(agent) for agent in self.env.agents}

    def _is_over(self, agent: object) -> bool:
        return bool(self.env.terminations.get(agent) or self.env.truncations.get(agent))


class MultiAgent:
    """An environment of RLlib as a parallel game, which is over when it states so for `__all__`.

    Its agents have an order of their own, because those of RLlib may come from a set, whose order differs
    between processes.

    Args:
        env: a `MultiAgentEnv`, which may have wrappers of Gymnasium.
        name: its name; that of its class unless given.
        creator: the class or function that made it, if it is known.
        arguments: with which that was called.
    """

    def __init__(
        self,
        env: Any,
        name: str | None = None,
        creator: Callable[..., object] | None = None,
        arguments: Mapping[str, object] | None = None,
    ) -> None:
        self.env = env
        self.creator = creator
        self.arguments = arguments
        self.unwrapped = env.unwrapped
        agents = self.unwrapped.possible_agents
        self.possible_agents = sorted(agents, key=lambda agent: (isinstance(agent, str), agent))
        self.agents: list[object] = []
        """The agents that act next; none if the game is over."""
        self.metadata = {"name": name or type(self.unwrapped).__name__}
        self.render_mode = getattr(env, "render_mode", None)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "env":
            raise AttributeError(name)
        return getattr(self.env, name)

    def observation_space(self, agent: object) -> Space:
        """Return the space of an agent's observations."""
        space: Space = self.unwrapped.get_observation_space(agent)
        return space

    def action_space(self, agent: object) -> Space:
        """Return the space of an agent's actions."""
        space: Space = self.unwrapped.get_action_space(agent)
        return space

    def reset(self, **arguments: object) -> tuple[ByAgent, ByAgent]:
        """Begin a game; return the observations and infos of the agents that act next."""
        observations, infos = self.env.reset(**arguments)
        self.agents = list(observations)
        return observations, infos

    def step(self, actions: ByAgent) -> GameStepResult:
        """Take a step; return what the environment returns, with its flags for `__all__`."""
        result: GameStepResult = self.env.step(actions)
        observations, _, terminated, truncated, _ = result
        is_over = terminated.get("__all__") or truncated.get("__all__")
        self.agents = [] if is_over else list(observations)
        return result
