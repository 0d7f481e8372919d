"""The interfaces of Gymnasium, PettingZoo, RLlib and SuperSuit, evened out.

Layers are an environment's wrappers, and the environment inside of them. A game has several agents: those in
turns (`AECEnv`) and those of RLlib get the interface of PettingZoo's parallel games.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from runner.util.values import MAX_TEXT

if TYPE_CHECKING:
    from gymnasium import spaces
    from gymnasium.envs.registration import EnvSpec

    from runner.environments.gym_types import AnyVectorEnv, Space

ByAgent = dict[Any, Any]
"""Values of a game by agent."""
GameStepResult = tuple[ByAgent, ByAgent, ByAgent, ByAgent, ByAgent]


# --- layers and names ---------------------------------------------------------------------------------


def layers_of(env: object) -> Iterator[Any]:
    """Yield an environment's wrappers from the outermost in, and the environment inside of them."""
    innermost = getattr(env, "unwrapped", env)
    while env is not innermost and env is not None:
        yield env
        # PettingZoo's wrappers look up what they do not have inside: `env` comes first.
        env = getattr(env, "env", None) or getattr(env, "aec_env", None)
    yield innermost


def class_name(instance: object) -> str:
    """Return `module:class` of an instance, cut at the length that a recording holds."""
    return f"{type(instance).__module__}:{type(instance).__qualname__}"[:MAX_TEXT]


def name_of(entry_point: Any) -> str:
    """Return `module:name` of an entry point, of the function in a partial; empty if there is none."""
    if entry_point is None or isinstance(entry_point, str):
        return entry_point or ""
    while isinstance(entry_point, functools.partial):
        entry_point = entry_point.func
    return f"{getattr(entry_point, '__module__', '')}:{getattr(entry_point, '__qualname__', '')}"


def top_package(module: str) -> str:
    """Return the top package of a module, or of `module:class`."""
    return module.partition(":")[0].partition(".")[0]


def creator_of(spec: EnvSpec) -> object:
    """Return the class or function that makes the environment of a specification."""
    from gymnasium.envs.registration import load_env_creator

    return load_env_creator(spec.entry_point) if isinstance(spec.entry_point, str) else spec.entry_point


# --- vectors ------------------------------------------------------------------------------------------


def spaces_of_one(envs: AnyVectorEnv) -> tuple[Space, Space]:
    """Return the spaces of observation and action of one environment of a vector.

    Older vectors, such as SuperSuit's, have no `single_` spaces: their spaces are those of one environment.
    """
    observation = getattr(envs, "single_observation_space", None) or envs.observation_space
    return observation, getattr(envs, "single_action_space", None) or envs.action_space


def final_observations(infos: Any) -> Any:
    """Return the last observations of the episodes that ended in a step, by environment; None if none did."""
    if isinstance(infos, Mapping):
        return infos.get("final_obs")
    last = [info.get("terminal_observation") for info in infos]  # as SuperSuit's vectors return them
    return last if any(value is not None for value in last) else None


# --- games --------------------------------------------------------------------------------------------


def as_parallel(env: Any) -> Any:
    """Return a game with the interface of PettingZoo's parallel ones: itself, unless it has another."""
    if is_in_turns(env):
        return Turns(env)
    return MultiAgent(env) if is_multi_agent(env) else env


def is_multi_agent(env: object) -> bool:
    """Return whether an environment has the interface of RLlib's `MultiAgentEnv`."""
    base = getattr(env, "unwrapped", env)
    parts = ("get_observation_space", "possible_agents")
    return not isinstance(env, MultiAgent) and all(hasattr(base, part) for part in parts)


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
