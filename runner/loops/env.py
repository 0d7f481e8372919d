"""`runner.record` and `record_parallel`: loops over one Gymnasium environment, or one game of PettingZoo."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral
from typing import Any, Literal, Unpack

import gymnasium
from gymnasium.vector import VectorEnv

from runner.environments.gym_types import Env, Info, ResetOptions, ResetResult, StepResult
from runner.environments.interfaces import (
    ByAgent,
    GameStepResult,
    Turns,
    class_name,
    game_spaces,
    is_game,
    is_in_turns,
    layers_of,
)
from runner.environments.mdp import MAX_AGENTS
from runner.errors import ConfigError, EnvironmentNotUsable
from runner.loops.description import Described, describe
from runner.loops.generators import GeneratorWatch
from runner.loops.loop import Loop
from runner.loops.makers import checked_make, game_maker_of, maker_of
from runner.loops.options import PackingOptions, RecordOptions, options_of
from runner.loops.recorded import Recorded, require_pictures, return_name
from runner.loops.values import UNCHANGEABLE, as_given, check_phase
from runner.loops.vector import by_field
from runner.recording.spaces import Value
from runner.runs.run import Run


class RecordedAlone(Recorded):
    """What a recorded environment has that steps alone, not in a vector: an environment or a game."""

    def _enter(self, phase: str) -> None:
        super()._enter(phase)
        self._watch.begin_phase()

    def is_over(self, terminated: object, truncated: object) -> bool:
        """Return whether a step ended the episode, from what it returned."""
        return bool(terminated or truncated)

    def _record_frame(self, is_over: bool) -> None:
        """Record a picture of the last step, if it is due."""
        self._until_frame -= 1
        if is_over or self._until_frame <= 0:
            self._record_frames(ends=is_over)

    def _recorded_reset(self, seed: int | None, options: ResetOptions | None) -> ResetResult:
        with self._loop.lock:  # another thread may be committing steps
            self._watch.steps = self._rows.progress[0]
        seeds = () if seed is None else (seed,)
        return self._reset(seeds, (0,), options, {"seed": seed, "options": options})


class RecordedEnv(RecordedAlone, gymnasium.Wrapper[object, object, object, object]):
    """A Gymnasium environment whose every reset and step is recorded; made by `record`."""

    env: Env

    def __init__(self, env: Env, loop: Loop, phase: str = "train", owner: RecordedEnv | None = None) -> None:
        gymnasium.Wrapper.__init__(self, env)
        self._owner = owner
        self._env_step = env.step
        self._return_name = return_name([class_name(layer) for layer in layers_of(env)])
        self._has_messages = bool(loop.options.info or loop.options.frames_every or self._return_name)
        self._watch = GeneratorWatch([env], sparse=loop.options.steps == "actions")
        self._record_into(loop, is_owner=owner is None)
        self._enter(phase)

    def step(self, action: object, extras: Mapping[str, object] | None = None) -> StepResult:
        """Take a step, and record it, with values of your own: `extras={"value": v, "logits": logits}`.

        A name keeps the dtype and the shape of its first value, but the first axis may have another length in
        a later step, as with token ids. Texts are recorded too. A step need not have all names.
        """
        rows = self._rows
        given = action if action.__class__ in UNCHANGEABLE else rows.keep(action)
        result = self._env_step(action)
        try:
            observation, reward, terminated, truncated, info = result
            loop = self._loop
            loop.lock.acquire()  # `with` takes a tenth of a microsecond longer
            try:
                if loop.active is not rows and not loop.activate(rows):
                    return result
                rows.take(given, observation, reward, terminated, truncated)
                if extras is not None:
                    self._take_extras(extras)
            finally:
                loop.lock.release()
            if self._has_messages:
                if self._options.info:
                    self._messages.info(self._phase, info)
                if self._return_name and (terminated or truncated):
                    self._log_return(info)
                if self._options.frames_every:
                    self._record_frame(is_over=terminated or truncated)
        except Exception as error:
            self._loop.fail(error)
        return result

    def reset(self, *, seed: int | None = None, options: ResetOptions | None = None) -> ResetResult:
        """Reset the environment, and record it: the seed, the options, the observation."""
        return self._recorded_reset(seed, options)


def record(
    env: Env,
    recordings: str | os.PathLike[str] | None = None,
    *,
    name: str | None = None,
    seed: int | None = None,
    config: object = None,
    info: Sequence[str] = (),
    frames_every: int = 0,
    frame_format: str = "png",
    into: RecordedEnv | None = None,
    phase: str = "train",
    make: str | Callable[[], object] | None = None,
    join: Run | str | os.PathLike[str] | Literal[True] | None = None,
    shard: str | None = None,
    on_error: Literal["raise", "warn"] = "raise",
    **packing: Unpack[PackingOptions],
) -> RecordedEnv:
    """Return the environment, with everything that a loop does with it recorded.

        with runner.record(gymnasium.make("CartPole-v1"), name="mine", config={"lr": 3e-4}) as env:
            observation, info = env.reset(seed=0)
            ...
            env.log("loss", loss)

    The environment behaves as before: its arguments, results and random numbers are not changed. Each reset
    and step is recorded; closing the environment, or leaving the `with`, closes the recording.

    Args:
        env: a Gymnasium environment, wrapped or not; its arguments and results at this level are recorded.
            Or a `VecEnv` of Stable-Baselines3: another is returned, whose environments are recorded.
        recordings: the recordings folder, by default $DUALTAXI_RECORDINGS or ./recordings; or the address of
            a server (`http://localhost:8000`), to which the run is pushed while it is recorded.
        name: the name of the run; the environment's name unless given.
        seed: the seed that the run is listed with, if any; the seeds of resets are recorded anyway.
        config: your own settings, to show, compare and search: a mapping, a dataclass, a namespace such as
            argparse returns, or OmegaConf's.
        info: names of fields of `info` to record, of steps and resets, where they occur; `["*"]` for all.
        frames_every: render a frame at each reset, after this many steps and at the end of each episode; the
            environment must be made with render_mode="rgb_array".
        frame_format: `png`, exact, or `jpeg`.
        into: another recorded environment of the same spaces, to record into the same run.
        phase: `train` or `eval`; an environment recorded `into` another needs the other phase.
        make: a function without arguments that makes this environment, at the top of a module, or its name
            ("train:make_env"). It is recorded, and called to repeat the run where wrappers or arguments
            cannot be recorded; `environment_maker` in the recording says where that is.
        join: a run that is being recorded, by a `Run`, its id or its folder, or True for the run of the
            process that started this one: this process records a shard of it. It has no name, seed and
            config then.
        shard: the name of this process in that run, which determines the order of processes in it; by default
            the name that `multiprocessing` gave it.
        on_error: what happens if recording fails while the loop runs, because the disk is full or a value
            cannot be recorded: `raise` the error, or `warn` once and go on without recording; the run then
            has the status failed and says so. A value of `log`, `extras` and the like that cannot be recorded
            is left out. Mistakes in these arguments are always raised.
        packing: `compression`, `level`, `index`, `chunk_steps` and `code`, as in the section `recording` of a
            file; `code=False` records neither the script nor the state of its git repository. `steps` is
            what is recorded of a step: `all`, `actions`, from which the rest comes again, or `none`.

    Raises:
        EnvironmentNotUsable: a space cannot be recorded.
        ConfigError: an argument cannot be used.
        RunnerError: the run to join is over, or a job, or there is none.
        StorageError: the recordings folder cannot be written.
    """
    options = {"name": name, "seed": seed, "config": config, "info": info, "frames_every": frames_every}
    options |= {"frame_format": frame_format, "join": join, "shard": shard, "on_error": on_error, **packing}
    sb3 = sys.modules.get("stable_baselines3.common.vec_env")  # is not imported for this
    if sb3 is not None and isinstance(env, sb3.VecEnv):
        if into is not None:
            raise ConfigError("into: found it with a VecEnv, expected join=RUN")
        from runner.loops.recorded_vec_env import record_vec_env  # imports Stable-Baselines3

        given = {"recordings": recordings, "phase": phase, "make": make, **options}
        recorded: RecordedEnv = record_vec_env(env, given)  # a VecEnv, whose type is not known here
        return recorded
    if not isinstance(env, gymnasium.Env) or issubclass(type(env), VectorEnv):  # EnvPool's are both
        raise ConfigError(
            f"found {type(env).__name__}, expected a Gymnasium environment, such as gymnasium.make gives; "
            "record_vector is for vector environments, record_parallel for PettingZoo's."
        )
    check_phase(phase)
    if into is not None:
        others = recordings, name, join, shard
        if others != (None,) * 4 or config or info or frames_every or packing:
            raise ConfigError(
                "into: found more arguments than phase, expected none: the run has them already"
            )
        return _record_into_run(env, into, phase, checked_make(make))
    described = describe(env, env.observation_space, env.action_space)
    if frames_every:
        require_pictures(env)
    maker = maker_of(env, checked_make(make))
    loop = Loop(described, options_of(recordings, options), maker)
    return RecordedEnv(env, loop, phase)


def _record_into_run(env: Env, into: RecordedEnv, phase: str, make: str) -> RecordedEnv:
    if not isinstance(into, RecordedEnv):
        raise ConfigError(f"into: found {type(into).__name__}, expected what runner.record returned")
    loop = into._loop
    spaces = loop.described.observation, loop.described.action
    if (env.observation_space, env.action_space) != spaces:
        raise ConfigError("into: found an environment of other spaces than the run's, expected the same")
    if phase == into._phase:
        raise ConfigError(f"phase: found {phase!r} for both environments of a run, expected one each")
    if loop.options.frames_every:
        require_pictures(env)
    loop.add_maker(phase, maker_of(env, make))
    return RecordedEnv(env, loop, phase, into)


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

    def step(
        self, actions: Mapping[str, object], extras: Mapping[str, Mapping[str, object]] | None = None
    ) -> GameStepResult:
        """Take a step of all agents, and record it, with values of your own by agent and name."""
        given = as_given(actions)
        result: GameStepResult = self.env.step(actions)
        try:
            observations, rewards, terminated, truncated, infos = result
            with self._loop.lock:
                if not self._loop.activate(self._rows):
                    return result
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
        return result

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
