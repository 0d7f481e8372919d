"""`runner.record`: any loop over one Gymnasium environment."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, Unpack

import gymnasium
from gymnasium.vector import VectorEnv

from runner.environments.gym_types import Env, ResetOptions, ResetResult, StepResult
from runner.environments.layers import class_name, layers_of
from runner.errors import ConfigError
from runner.loops.description import describe
from runner.loops.generators import GeneratorWatch
from runner.loops.loop import Loop
from runner.loops.makers import checked_make, maker_of
from runner.loops.options import PackingOptions, options_of
from runner.loops.recorded import RecordedAlone, require_pictures
from runner.loops.values import UNCHANGEABLE, check_phase
from runner.loops.wrappers import return_name
from runner.runs.run import Run


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
    loop: Loop = Loop(described, options_of(recordings, options), maker)
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
