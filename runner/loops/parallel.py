"""`runner.record_parallel`: the games of PettingZoo, in which several agents act at once."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from numbers import Integral
from typing import Any, Unpack

from runner.environments.games import (
    ByAgent,
    GameStepResult,
    Turns,
    game_spaces,
    is_game,
    is_in_turns,
)
from runner.environments.gym_types import Info, ResetOptions
from runner.environments.mdp import MAX_AGENTS
from runner.errors import ConfigError, EnvironmentNotUsable
from runner.loops.description import Described
from runner.loops.env import record
from runner.loops.generators import GeneratorWatch
from runner.loops.loop import Loop
from runner.loops.makers import checked_make, game_maker_of
from runner.loops.options import RecordOptions, options_of
from runner.loops.recorded import RecordedAlone, require_pictures
from runner.loops.values import as_given, check_phase
from runner.loops.vector import by_field
from runner.recording.spaces import Value


class RecordedParallel(RecordedAlone):
    """A PettingZoo parallel environment whose every reset and step is recorded; made by `record_parallel`.

    Its other attributes are those of the environment: `agents`, `action_space`, ...
    """

    def __init__(self, env: object, loop: Loop, phase: str = "train") -> None:
        self.env = env
        self._watch = GeneratorWatch([env])
        self._record_into(loop)
        self._enter(phase)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "env":
            raise AttributeError(name)
        return getattr(self.env, name)

    @property
    def unwrapped(self) -> Any:
        """The environment inside of all wrappers."""
        return self.env.unwrapped

    def step(
        self, actions: Mapping[str, object], extras: Mapping[str, Mapping[str, object]] | None = None
    ) -> GameStepResult:
        """Take a step of all agents, and record it, with values of your own by agent and name."""
        given = as_given(actions)
        result = self.env.step(actions)
        try:
            observations, rewards, terminated, truncated, infos = result
            with self._loop.lock:
                if not self._loop.activate(self._rows):
                    return result  # type: ignore[no-any-return]
                over = not self.env.agents
                self._rows.take_game(given, observations, rewards, terminated, truncated, over)
                if extras is not None:
                    self._take_extras(self._extras_by_name(extras))
            if self._options.info:
                self._messages.info(self._phase, self._info_by_field(infos))
            if self._options.frames_every:
                self._record_frame(is_over=over)
        except Exception as error:
            self._loop.fail(error)
        return result  # type: ignore[no-any-return]

    def is_over(self, terminated: object, truncated: object) -> bool:  # noqa: ARG002 - agents may leave
        """Return whether no agent is left."""
        return not self.env.agents

    def _extras_by_name(self, values: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return the values of agents as `agent/name`."""
        agents = self._loop.described.agents
        by_name = dict[str, Value]()
        for agent, named in values.items():
            if agent in agents and isinstance(named, Mapping):
                by_name |= {f"{agent}/{name}": value for name, value in named.items()}
                continue
            self._loop.leave_out(
                ConfigError(
                    f"extras: found {agent!r}: {type(named).__name__}, expected the values of each agent by "
                    f"name, such as {{{agents[0]!r}: {{'value': 0.5}}}}"
                )
            )
        return by_name

    def reset(self, seed: int | None = None, options: ResetOptions | None = None) -> tuple[ByAgent, ByAgent]:
        """Reset the environment, and record it."""
        return self._recorded_reset(seed, options)

    def _info_by_field(self, info: Info) -> Info:
        return by_field(info)


class RecordedAec(RecordedParallel):
    """A PettingZoo game in turns whose every reset and step is recorded; made by `record_aec`.

    Its other attributes are those of the game: `agent_iter`, `last`, `agents`, ...
    """

    env: Turns

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "env":
            raise AttributeError(name)
        return getattr(self.env.env, name)

    def step(  # type: ignore[override]
        self, action: object, extras: Mapping[str, Mapping[str, object]] | None = None
    ) -> None:
        """Take the step of the selected agent, and record it, with values of your own by agent.

        Args:
            extras: as `extras={agent: {"value": v}}`, of the selected agent or others.
        """
        agent = self.env.env.agent_selection
        if action is None:  # it only removes the agent
            self.env.env.step(None)
        else:
            super().step({agent: action}, extras)

    def reset(  # type: ignore[override]
        self, seed: int | None = None, options: ResetOptions | None = None
    ) -> None:
        """Reset the game, and record it."""
        self._recorded_reset(seed, options)


def record_parallel(
    env: object,
    recordings: str | os.PathLike[str] | None = None,
    *,
    phase: str = "train",
    make: str | Callable[[], object] | None = None,
    **options: Unpack[RecordOptions],
) -> RecordedParallel:
    """Return a PettingZoo parallel environment, with everything that a loop does with it recorded.

    Each agent of `possible_agents` has its own reward column and its own part of observation and action. A
    step records which agents acted and for which it was the last.

    Args:
        env: a `pettingzoo.ParallelEnv`.
        recordings: as for `record`.
        phase: `train` or `eval`.
        make: as for `record`.
        options: the arguments that `record` has too; a frame shows the whole game, and `info` names fields
            of the agents' infos.

    Raises:
        EnvironmentNotUsable: a space cannot be recorded, or there are more than 31 agents.
        ConfigError: an argument cannot be used.
        StorageError: the recordings folder cannot be written.
    """
    if is_in_turns(env):
        raise ConfigError(
            f"found {type(env).__name__}, a game in turns (AECEnv), expected a PettingZoo ParallelEnv: "
            "record_aec records games in turns."
        )
    if not all(hasattr(env, part) for part in ("possible_agents", "observation_space", "action_space")):
        raise ConfigError(
            f"found {type(env).__name__}, expected a PettingZoo ParallelEnv with possible_agents"
        )
    check_phase(phase)
    described = described_game(env)
    if options.get("frames_every"):
        require_pictures(env)
    maker = game_maker_of(env, checked_make(make))
    kind = RecordedAec if isinstance(env, Turns) and not env.removes else RecordedParallel
    return kind(env, Loop(described, options_of(recordings, options), maker), phase)


def record_aec(env: object, recordings: str | os.PathLike[str] | None = None, **options: Any) -> RecordedAec:
    """Return a PettingZoo game in turns, with everything that a loop does with it recorded.

        with runner.record_aec(tictactoe_v3.env(), name="mine") as env:
            env.reset(seed=0)
            for agent in env.agent_iter():
                observation, reward, terminated, truncated, info = env.last()
                env.step(None if terminated or truncated else choose(observation))

    A recorded step is the step of one agent, with the rewards of all agents for this step alone and what
    each can observe after it; steps with None, which only remove an agent, are not recorded.

    Args:
        env: a `pettingzoo.AECEnv`.
        recordings: as for `record`.
        options: the other arguments of `record_parallel`.

    Raises:
        As for `record_parallel`.
    """
    if not is_in_turns(env):
        raise ConfigError(
            f"found {type(env).__name__}, expected a game in turns, PettingZoo's AECEnv; record_parallel is "
            "for its parallel games."
        )
    recorded = record_parallel(Turns(env, removes=False), recordings, **options)
    assert isinstance(recorded, RecordedAec)
    return recorded


def record_alone(env: Any, recordings: str | os.PathLike[str] | None, **options: Any) -> Any:
    """Return one environment of Gymnasium, or one game of PettingZoo, with everything recorded."""
    begin: Any = record_parallel if is_game(env) else record
    return begin(env, recordings, **options)


def described_game(env: Any) -> Described:
    """Return the description of an environment with PettingZoo's parallel interface.

    Raises:
        EnvironmentNotUsable: a space cannot be recorded, or there are more than 31 agents.
    """
    agents = tuple(env.possible_agents)
    if not 1 <= len(agents) <= MAX_AGENTS:
        raise EnvironmentNotUsable(f"found {len(agents)} possible agents, expected 1 to {MAX_AGENTS}.")
    for agent in agents:
        if not isinstance(agent, str | Integral):
            raise EnvironmentNotUsable(f"found the agent {agent!r}, expected a name or a number for each.")
    observation, action = game_spaces(env)
    name = env.metadata.get("name") if isinstance(getattr(env, "metadata", None), Mapping) else None
    return Described(
        kind="game",
        observation=observation,
        action=action,
        env_id=str(name or type(env).__name__),
        agents=agents,
    )
