"""`runner.record`: any loop over one Gymnasium environment."""

from __future__ import annotations

import contextlib
import os
import sys
import weakref
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Generic, Literal, Self

import gymnasium
from gymnasium.vector import VectorEnv

from runner.errors import ConfigError
from runner.loops.loop import Loop, R
from runner.loops.options import plan_of
from runner.loops.spaces import describe
from runner.loops.step_buffer import ROWS, Rows
from runner.recording import schema
from runner.runs.run import Run


class Recorded(Generic[R]):
    """What every recorded environment offers beside the environment; a context manager."""

    env: Any
    _loop: Loop[R]
    _owner: Recorded[R] | None = None
    """Who closes the recording, if another one; kept alive as long as this is."""
    _phase: str
    _rows: R

    @property
    def run(self) -> Run:
        """The run that is recorded, in its folder; its `summary` is there once it is closed."""
        return self._loop.run

    def log(self, name: str | Mapping[str, Any], value: Any = None) -> None:
        """Record a number or a text under a name: `rec.log("loss", loss)`, `rec.log({"loss": loss})`.

        Raises:
            ConfigError: it is neither.
        """
        if isinstance(name, str):
            self._loop.log(self._phase, name, value)
            return
        if not isinstance(name, Mapping) or value is not None:
            raise ConfigError(f"log: found {name!r}, expected a name and a value, or a mapping of them")
        for key, own in name.items():
            if isinstance(own, Mapping):
                self.log({f"{key}/{inner}": part for inner, part in own.items()})
            else:
                self._loop.log(self._phase, key, own)

    def snapshot(self, name: str, array: Any) -> None:
        """Record an array of numbers, or each of a mapping of arrays, as it is now: `rec.snapshot("q", q)`.

        Tensors of PyTorch and JAX are taken too; their short floats, such as bfloat16, become float32. The
        arrays of a mapping, such as a `state_dict`, are named `name/key`.

        Raises:
            ConfigError: it holds something else, or an array is larger than 64 MB.
        """
        self._loop.snapshot(self._phase, name, array)

    @contextlib.contextmanager
    def phase(self, name: str) -> Iterator[Self]:
        """Record what happens inside as of this phase, `train` or `eval`: `with rec.phase("eval"):`.

        Each phase has episodes of its own, so begin and end it with `reset()`.

        Raises:
            ConfigError: there is no such phase.
        """
        before = self._phase
        self._enter(name)
        try:
            yield self
        finally:
            self._enter(before)

    def close(self, **kwargs: Any) -> None:
        """Close the environment and the recording, as finished; not that of another it is recorded into."""
        try:
            self.env.close(**kwargs)
        finally:
            if self._owner is None:
                self._loop.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: Any) -> Literal[False]:
        try:
            self.env.close()
        finally:
            if self._owner is None:
                self._leave(raised[1])
        return False

    def _enter(self, phase: str) -> None:
        self._phase = phase
        self._rows = self._loop.rows(phase)

    def _own(self, loop: Loop[R]) -> None:
        """Begin a recording; should it never be closed, it is when the process ends."""
        self._loop = loop
        loop.views.add(self)
        weakref.finalize(self, _close_abandoned, loop)

    def _detach(self) -> None:
        """Record nothing more: this process was forked from the one that records."""
        self._enter(self._phase)

    def _leave(self, error: BaseException | None) -> None:
        """Close the recording with how the loop ended."""
        self._loop.close(*_ending(error))


def _ending(error: BaseException | None) -> tuple[str, str]:
    """Return the status of a run that this error ended, and the text to keep."""
    if error is None:
        return "finished", ""
    if isinstance(error, KeyboardInterrupt) or (isinstance(error, SystemExit) and not error.code):
        return "interrupted", ""
    return "failed", f"{type(error).__name__}: {error}"


def _close_abandoned(loop: Loop[Any]) -> None:
    """Close a recording that nobody closed: as failed if an uncaught exception ends the process.

    Python keeps such an exception in `sys.last_value`; an interactive session keeps errors there that
    ended nothing.
    """
    error = getattr(sys, "last_value", None)
    is_interactive = bool(sys.flags.interactive) or hasattr(sys, "ps1")
    loop.close(*(("interrupted", "") if error is None or is_interactive else _ending(error)))


def given(**arguments: Any) -> dict[str, Any]:
    """Return the arguments that are not None: an environment's `reset` need not know the others."""
    return {name: value for name, value in arguments.items() if value is not None}


class RecordedEnv(Recorded[Rows], gymnasium.Wrapper[Any, Any, Any, Any]):
    """A Gymnasium environment whose every reset and step is recorded; made by `record`."""

    env: gymnasium.Env[Any, Any]

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        loop: Loop[Rows],
        phase: str = "train",
        owner: RecordedEnv | None = None,
    ) -> None:
        gymnasium.Wrapper.__init__(self, env)
        self._owner = owner
        self._env_step = env.step
        self._watched = bool(loop.plan.info or loop.plan.frames_every)
        self._until_frame = 0
        self._loop = loop
        loop.views.add(self)
        self._enter(phase)

    def _enter(self, phase: str) -> None:
        super()._enter(phase)
        self._take = self._rows.take
        self._lock = self._loop.lock

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step, and record it."""
        result = self._env_step(action)
        observation, reward, terminated, truncated, info = result
        with self._lock:
            if self._loop.active is not self._rows:
                self._loop.activate(self._rows)
            self._take(action, observation, reward, terminated, truncated)
        if self._watched:
            self._watch(info, terminated or truncated)
        return result

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment, and record it: the seed, the options, the observation."""
        asked = dict(options) if options else None
        result = self.env.reset(**given(seed=seed, options=options))
        observation, info = result
        with self._lock:
            self._loop.activate(self._rows)
            self._rows.reset(observation, seed)
        self._loop.reset_info(self._phase, info, asked, seed)
        if self._loop.plan.frames_every:
            self._until_frame = self._loop.plan.frames_every
            self._loop.frame(self._phase, self.env.render())
        return result

    def _watch(self, info: Mapping[str, Any], over: bool) -> None:
        """Record what else is asked for of the step that was just put down."""
        if self._loop.plan.info:
            self._loop.info(self._phase, info)
        if self._loop.plan.frames_every:
            self._until_frame -= 1
            if over or self._until_frame <= 0:
                self._until_frame = self._loop.plan.frames_every
                self._loop.frame(self._phase, self.env.render())


def record(
    env: gymnasium.Env[Any, Any],
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
    **packing: Any,
) -> RecordedEnv:
    """Return the environment, recording whatever any loop does with it.

        with runner.record(gymnasium.make("CartPole-v1"), name="mine", config={"lr": 3e-4}) as env:
            observation, info = env.reset(seed=0)
            ...
            env.log("loss", loss)

    The environment behaves as before: what goes in and comes out is not touched, nor is its randomness.
    Each reset and step is recorded; closing the environment, or leaving the `with`, closes the recording.

    Args:
        env: a Gymnasium environment, wrapped or not; recorded is what passes here.
        recordings: the recordings folder: $DUALTAXI_RECORDINGS, or ./recordings, unless given; or a server
            (`http://localhost:8000`), to which the run is pushed while it is recorded and at its end.
        name: what the run is called; the environment's name unless given.
        seed: the seed that the run is listed with, if any; the seeds of resets are recorded anyway.
        config: your own settings, to be shown, compared and searched by: a mapping, a dataclass, a namespace
            such as argparse gives, or OmegaConf's.
        info: fields of `info` to record, of steps and resets, where they occur; `["*"]` for all.
        frames_every: render a frame at each reset, every so many steps and at the end of each episode; the
            environment must be made with render_mode="rgb_array".
        frame_format: `png`, exact, or `jpeg`.
        into: another recorded environment of the same spaces, to record into the same run.
        phase: `train`, or `eval`; of the environment recorded `into` another, the other one.
        packing: `compression`, `level`, `index`, `chunk_steps`, as the configuration's `recording` has them.

    Raises:
        EnvironmentNotUsable: a space cannot be recorded.
        ConfigError: an argument cannot be used.
        StorageError: the recordings folder cannot be written.
    """
    if not isinstance(env, gymnasium.Env) or issubclass(type(env), VectorEnv):  # EnvPool's are both
        raise ConfigError(
            f"found {type(env).__name__}, expected a Gymnasium environment, such as gymnasium.make gives; "
            "record_vector is for vector environments, record_parallel for PettingZoo's."
        )
    if phase not in schema.PHASES:
        raise ConfigError(f"phase: found {phase!r}, expected one of {', '.join(schema.PHASES)}")
    if into is not None:
        if recordings is not None or name is not None or config or info or frames_every or packing:
            raise ConfigError(
                "into: found more arguments than phase, expected none: the run has them already"
            )
        return _beside(env, into, phase)
    described = describe(env, env.observation_space, env.action_space)
    plan = plan_of(recordings, name, seed, config, info, frames_every, frame_format, packing)
    if frames_every:
        _require_pictures(env)
    loop: Loop[Rows] = Loop(described, plan, ROWS[described.kind])
    recorded = RecordedEnv(env, loop, phase)
    recorded._own(loop)
    return recorded


def _beside(env: gymnasium.Env[Any, Any], into: RecordedEnv, phase: str) -> RecordedEnv:
    """Return an environment recorded into the run of another one."""
    if not isinstance(into, RecordedEnv):
        raise ConfigError(f"into: found {type(into).__name__}, expected what runner.record returned")
    loop = into._loop
    spaces = loop.described.observation, loop.described.action
    if (env.observation_space, env.action_space) != spaces:
        raise ConfigError("into: found an environment of other spaces than the run's, expected the same")
    if phase == into._phase:
        raise ConfigError(f"phase: found {phase!r} for both environments of a run, expected one each")
    if loop.plan.frames_every:
        _require_pictures(env)
    return RecordedEnv(env, loop, phase, into)


def _require_pictures(env: gymnasium.Env[Any, Any]) -> None:
    """Refuse an environment that renders no pictures, in a run with frames.

    Raises:
        ConfigError: it is one.
    """
    if env.render_mode != "rgb_array":
        raise ConfigError(
            f"frames_every: found an environment with render_mode={env.render_mode!r}, expected "
            "'rgb_array': make it with render_mode=\"rgb_array\"."
        )
