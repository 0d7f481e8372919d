"""Stable-Baselines3 and sb3-contrib: `model.learn(100_000, callback=runner.integrations.sb3.Recording())`.

The library resets the environments before it calls a callback. `learn` of every model is therefore made to
announce itself to the callbacks of this module, when the module is imported; it is not changed otherwise.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, Self

import numpy as np

from runner.errors import ConfigError, EnvironmentNotUsable, RunnerError
from runner.integrations.libraries import Callback, as_setting, require_tested
from runner.loops.recorded import ending_of
from runner.loops.values import warn_user
from runner.loops.vector import RecordedVector
from runner.runs.run import Run

require_tested("stable_baselines3", "sb3", ("2.9", "2.9"))

from stable_baselines3.common.base_class import BaseAlgorithm  # noqa: E402
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback  # noqa: E402
from stable_baselines3.common.logger import KVWriter  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv  # noqa: E402

from runner.loops.recorded_vec_env import RecordedVecEnv  # noqa: E402

_CLOCKS: Final = ("time/fps", "time/time_elapsed")
"""What is not logged, because it differs between two runs that are otherwise the same."""
_NOT_SETTINGS: Final = ("self", "env", "verbose", "tensorboard_log", "_init_setup_model", "logger")


class Recording(Callback, BaseCallback):  # type: ignore[misc]
    """A callback that records what a model learns from, and what it logs.

        model = PPO("MlpPolicy", "CartPole-v1", seed=0)
        model.learn(100_000, callback=runner.integrations.sb3.Recording(name="ppo"))

    Every environment is recorded as it is inside of the wrappers of its `VecEnv`: actions, observations and
    rewards before `VecNormalize`, `VecFrameStack` and others change them, and the terminal observations of
    episodes. Training is not changed: the weights are the same with and without.

    Each `learn` is a run, which ends with it. `with Recording() as recording:` makes one run of all `learn`s
    in the block that take the same environments.

    Args:
        recordings: as for `runner.record`.
        checkpoint_every: keep the policy's parameters as the checkpoint `policy` after this many steps of
            environments, and at the end; 0 for none.
        options: the others of `runner.record`, except `join` and `shard`; and `frames_of`, as for
            `runner.record_vector`. The run has the environment's name and the model's seed unless given, and
            the model's settings with those of `config`. `make` makes one of the environments.

    Raises:
        ConfigError: an argument cannot be used.
    """

    _envs: RecordedVecEnv | None = None
    _is_own = False
    """Whether this callback recorded the environments, and not `runner.record` before it."""
    _stays_open = False
    _evaluations: tuple[RecordedVecEnv, ...] = ()
    """The environments of `EvalCallback`s, recorded into the run too."""

    @property
    def recorded(self) -> RecordedVector:
        """What `runner.record` returns for the environments: `recorded.log("name", 1.0)`.

        Raises:
            RunnerError: `learn` was not called yet.
        """
        if self._envs is None:
            raise RunnerError("found no run yet, expected one: it begins with model.learn(callback=...)")
        return self._envs.recorded

    @property
    def run(self) -> Run:
        """The run of the last `learn`; it has a `summary` once that is over."""
        return self.recorded.run

    def __enter__(self) -> Self:
        self._stays_open = True
        return self

    def __exit__(self, *raised: Any) -> None:
        self._stays_open = False
        self._end(raised[1])

    def _end(self, error: BaseException | None = None) -> None:
        """End the run, unless `runner.record` began it."""
        evaluations, self._evaluations = self._evaluations, ()
        for envs in evaluations:
            envs.end(*ending_of(error))
        if self._is_own and self._envs is not None:
            self._envs.end(*ending_of(error))

    def begin(self, model: BaseAlgorithm, is_continued: bool) -> None:
        """Record the environments of a model from now on; called by its `learn`.

        Args:
            model: the model.
            is_continued: whether it continues episodes in progress.

        Raises:
            ConfigError: its environments cannot be recorded with these arguments, or not from here.
            EnvironmentNotUsable: a space cannot be recorded.
            StorageError: the recordings folder cannot be written.
        """
        base = model.get_env().unwrapped
        if isinstance(base, RecordedVecEnv):
            if self._recordings is not None or self._options:
                raise ConfigError(
                    "found arguments of Recording for environments that runner.record records, expected "
                    "checkpoint_every at most: give the others to runner.record"
                )
            self._envs = base
            self._is_own = False
            return
        earlier = RecordedVecEnv.replacing(base)
        if earlier is not None:
            if earlier is self._envs and self._stays_open:
                return
            earlier.end("interrupted")  # an error ended the `learn` before
        observations = _observations_in_progress(model, base) if is_continued else None
        arguments = self._arguments(settings_of(model), model.seed)
        self._envs = RecordedVecEnv(base, {"recordings": self._recordings} | arguments)
        self._is_own = True
        self._envs.replace_methods()
        if is_continued:
            self.recorded.record_reset(observations, [])

    def _init_callback(self) -> None:
        if self._envs is None:
            raise RunnerError(
                f"found that {type(self.model).__name__}.learn does not call BaseAlgorithm._setup_learn, as "
                "others do. Record its environments instead, by runner.record(envs)."
            )
        self._write_into(self.recorded.log)

    def _write_into(self, log: Callable[[str, object], None]) -> None:
        """Let the model's logger write into a recording by this function."""
        formats = self.logger.output_formats
        formats[:] = [output for output in formats if not isinstance(output, _LogWriter)]
        self._writer = _LogWriter(log)
        formats.append(self._writer)

    def _on_training_start(self) -> None:
        self._next_checkpoint = self.num_timesteps + self._checkpoint_every
        self._updates = self.model._n_updates

    def _on_rollout_start(self) -> None:
        self._writer.write_update(self.logger.name_to_value)
        self._updates = self.model._n_updates

    def _on_step(self) -> bool:
        if self._checkpoint_every and self.num_timesteps >= self._next_checkpoint:
            if self.num_timesteps < self.model._total_timesteps:  # else there is one after the last update
                self._checkpoint()
            self._next_checkpoint = self.num_timesteps + self._checkpoint_every
        return self._envs is None or not self.recorded.should_stop

    def _on_training_end(self) -> None:
        if self.model._n_updates != self._updates:
            self._writer.log(self.logger.name_to_value)
        else:  # the numbers of updates are of an earlier one
            self._writer.write(self.logger.name_to_value, {})
        if self._writer in self.logger.output_formats:  # another callback may have set another logger
            self.logger.output_formats.remove(self._writer)
        if self._checkpoint_every:
            self._checkpoint()
        if not self._stays_open:
            self._end()

    def record_evaluations(self, envs: VecEnv) -> None:
        """Record the environments of an `EvalCallback` as the evaluation phase of the run.

        They become a shard of it, because there may be more or fewer of them than in training.
        """
        base = envs.unwrapped
        earlier = RecordedVecEnv.replacing(base)
        if isinstance(base, RecordedVecEnv) or (earlier and earlier in (self._envs, *self._evaluations)):
            return
        if earlier is not None:
            earlier.end("interrupted")
        try:
            evaluated = RecordedVecEnv(base, {"join": self.run, "phase": "eval", "shard": "evaluation"})
        except (ConfigError, EnvironmentNotUsable) as error:
            warn_user(f"The evaluations of EvalCallback are not recorded: {error}")
            return
        evaluated.training_steps = lambda: self.recorded._rows.progress[0]
        evaluated.replace_methods()
        self._evaluations += (evaluated,)

    def _checkpoint(self) -> None:
        self.recorded.checkpoint("policy", self.model.policy.state_dict())


class _LogWriter(KVWriter):  # type: ignore[misc]
    """Records what the library's logger writes: numbers and texts.

    A model writes the numbers of an update late, with the numbers of the next rollout or episode. Recorded
    are the first update after each time that it writes, and the last one, each at its own step.
    """

    def __init__(self, log: Callable[[str, object], None]) -> None:
        self._log = log
        self._of_updates: set[str] = set()
        """The names of the numbers of updates."""
        self._is_update_due = False
        """Whether the library wrote, so that the next update is recorded."""

    def write(self, key_values: Mapping[str, object], key_excluded: object, step: int = 0) -> None:  # noqa: ARG002
        """Record what the library writes, without the numbers of an update that is recorded already."""
        self.log({name: value for name, value in key_values.items() if name not in self._of_updates})
        self._is_update_due = True

    def write_update(self, key_values: Mapping[str, object]) -> None:
        """Record the numbers of the update that was just done, if the library wrote since the last one."""
        if not self._of_updates:
            self._of_updates = {name for name in key_values if name.startswith("train/")}
        if self._is_update_due and not self._of_updates.isdisjoint(key_values):
            self.log({name: value for name, value in key_values.items() if name in self._of_updates})
            self._is_update_due = False

    def log(self, key_values: Mapping[str, Any]) -> None:
        """Record numbers and texts by name; figures, pictures, films and histograms are left out."""
        for name, value in key_values.items():
            is_array_of_one = hasattr(value, "item") and np.size(value) == 1
            if (is_array_of_one or isinstance(value, int | float | str)) and name not in _CLOCKS:
                self._log(name, value)

    def close(self) -> None:
        """Do nothing: the run is closed by the callback."""


def settings_of(model: BaseAlgorithm) -> dict[str, object]:
    """Return a model's hyperparameters: the arguments of its class, as far as the model still has them.

    A schedule that is constant is its number; another one is its first and last value.
    """
    names: dict[str, None] = {}
    for kind in type(model).__mro__:
        if "__init__" in vars(kind):
            names |= dict.fromkeys(inspect.signature(kind.__init__).parameters)  # type: ignore[misc]
    settings = {
        "algorithm": type(model).__name__,
        "policy": getattr(model, "policy_class", type(model.policy)).__name__,
    }
    for name in names:
        if name not in {*_NOT_SETTINGS, *settings} and hasattr(model, name):
            value = getattr(model, name)
            settings[name] = as_setting(value)
            if callable(value) and not isinstance(value, type):
                with contextlib.suppress(Exception):  # it is no schedule, but any function
                    first, last = float(value(1.0)), float(value(0.0))
                    settings[name] = first if first == last else {"first": first, "last": last}
    return settings


def _observations_in_progress(model: BaseAlgorithm, base: object) -> object:
    """Return the last observations of environments whose episodes are in progress.

    Raises:
        ConfigError: only their wrappers have them.
    """
    warn_user(
        "learn(reset_num_timesteps=False) continues episodes that were not recorded from their beginning: "
        "they are recorded from here, and cannot be reproduced. To record several learn() as one run: "
        "with Recording(...) as recording."
    )
    if isinstance(base, DummyVecEnv):
        return base._obs_from_buf()
    if model.get_env() is base:
        return model._last_obs
    raise ConfigError(
        f"found episodes in progress in a {type(base).__name__} with wrappers, expected to record from the "
        "first learn(): with Recording(...) as recording."
    )


def _callbacks_in(callback: object) -> Iterator[BaseCallback]:
    """Yield the single callbacks in what `learn` takes."""
    if isinstance(callback, CallbackList):
        callback = callback.callbacks
    if isinstance(callback, list | tuple):
        for part in callback:
            yield from _callbacks_in(part)
    elif isinstance(callback, BaseCallback):
        yield callback
        yield from _callbacks_in(getattr(callback, "callback", None))  # of an EventCallback


def _announce(setup_learn: Callable[..., object]) -> Callable[..., object]:
    """Return a function that begins recordings, and then does what `setup_learn` does."""

    @functools.wraps(setup_learn)
    def setup(
        model: BaseAlgorithm,
        total_timesteps: int,
        callback: object = None,
        reset_num_timesteps: bool = True,
        *arguments: object,
        **named: object,
    ) -> object:
        callbacks = list(_callbacks_in(callback))
        recordings = [part for part in callbacks if isinstance(part, Recording)]
        if len(recordings) > 1:
            raise ConfigError(f"found {len(recordings)} callbacks Recording, expected one")
        for recording in recordings:
            recording.begin(model, is_continued=not reset_num_timesteps and model._last_obs is not None)
            for evaluation in (part for part in callbacks if isinstance(part, EvalCallback)):
                recording.record_evaluations(evaluation.eval_env)
        return setup_learn(model, total_timesteps, callback, reset_num_timesteps, *arguments, **named)

    return setup


BaseAlgorithm._setup_learn = _announce(BaseAlgorithm._setup_learn)
