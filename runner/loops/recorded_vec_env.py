"""`runner.record` for a `VecEnv` of Stable-Baselines3. Importing this module imports the library."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from runner.errors import ConfigError
from runner.loops.options import Arguments
from runner.loops.recorded import Recorded
from runner.loops.values import as_given
from runner.loops.vec_env import VecEnvVector
from runner.loops.vector import record_vector
from runner.util.jsonable import exact_json

_METHODS = ("reset", "step_async", "step_wait")


def _passed_on(name: str) -> Callable[..., object]:
    """Return a method that calls the one of this name of the `VecEnv` inside."""

    def method(self: RecordedVecEnv, *args: object, **keywords: object) -> object:
        return getattr(self.base, name)(*args, **keywords)

    return method


class RecordedVecEnv(VecEnv):  # type: ignore[misc]
    """A `VecEnv` whose every reset and step is recorded.

    It has the attributes of the `VecEnv`, and `run`, `log`, `checkpoint` and the other ones of what
    `runner.record` returns. It is no `VecEnvWrapper`, because `EvalCallback` expects as many of those around
    the environments of training as of evaluation.

    Args:
        base: a `VecEnv` without wrappers.
        options: the arguments of `record_vector`.
    """

    def __init__(self, base: VecEnv, options: Arguments) -> None:
        self.base = base
        self._vector = VecEnvVector(base)
        try:
            self.recorded = record_vector(self._vector, **options)
        except BaseException:
            self._vector.release()
            raise
        super().__init__(base.num_envs, base.observation_space, base.action_space)
        self.metadata = base.metadata
        self._given: object = None
        self._watch = self.recorded._watch
        self._record_step = self.recorded.record_step
        self.training_steps: Callable[[], int] | None = None
        """Returns after how many training steps the environments evaluate; called at their resets."""

    def __getattr__(self, name: str) -> Any:
        if name in ("base", "recorded"):  # not made yet
            raise AttributeError(name)
        return getattr(self.recorded if hasattr(Recorded, name) else self.base, name)

    def replace_methods(self) -> None:
        """Record what is done with the `VecEnv` itself, until `end` is called."""
        for name in _METHODS:
            setattr(self.base, name, getattr(self, name))

    def end(self, status: str, error: str = "") -> None:
        """Leave the `VecEnv` as it was, and close the recording."""
        for name in _METHODS:
            vars(self.base).pop(name, None)
        self._vector.release()
        self.recorded._loop.close(status, error)

    @staticmethod
    def replacing(base: VecEnv) -> RecordedVecEnv | None:
        """Return what has replaced the methods of a `VecEnv`, if anything."""
        owner = getattr(vars(base).get("step_wait"), "__self__", None)
        return owner if isinstance(owner, RecordedVecEnv) else None

    def reset(self) -> object:
        """Reset all environments, and record it."""
        if self.training_steps is not None:
            self.recorded.at_step(self.training_steps())
        seeds, options = self.base._seeds, self.base._options
        are_alike = all(exact_json(env_options) == exact_json(options[0]) for env_options in options)
        given: Any = options[0] or None if are_alike else options  # a list is not recorded, with a warning
        is_seeded = any(seed is not None for seed in seeds)
        self.recorded.reset(seed=list(seeds) if is_seeded else None, options=given)
        self.reset_infos = self.base.reset_infos
        return self._vector.native

    def step_async(self, actions: object) -> None:
        """Begin a step in each environment."""
        self._given = as_given(actions)
        self._vector.step_async(actions)

    def step_wait(self) -> object:
        """Wait for the steps, and record them."""
        result = self._vector.step(self._given)
        self._watch.steps += 1
        self._record_step(self._given, result)
        self.reset_infos = self.base.reset_infos
        return self._vector.native

    def close(self) -> None:
        """Close the environments, and the recording as finished."""
        self.recorded.close()

    # What a VecEnv must have besides goes to the recorded one as it is.
    seed, set_options = _passed_on("seed"), _passed_on("set_options")
    render, get_images = _passed_on("render"), _passed_on("get_images")
    get_attr, set_attr, has_attr = _passed_on("get_attr"), _passed_on("set_attr"), _passed_on("has_attr")
    env_method, env_is_wrapped = _passed_on("env_method"), _passed_on("env_is_wrapped")


def record_vec_env(env: VecEnv, options: Arguments) -> VecEnv:
    """Return a `VecEnv` whose environments are recorded, as they are inside of all wrappers.

    Args:
        env: the `VecEnv`; of one with wrappers, the innermost wrapper gets the recorded environments.

    Raises:
        ConfigError: it is recorded already, or an argument cannot be used.
    """
    base = env.unwrapped
    if isinstance(base, RecordedVecEnv):
        raise ConfigError("found a VecEnv that is recorded already, expected one that is not")
    recorded = RecordedVecEnv(base, options)
    if env is base:
        return recorded
    innermost = env
    while isinstance(innermost.venv, VecEnvWrapper):
        innermost = innermost.venv
    innermost.venv = recorded
    return env
