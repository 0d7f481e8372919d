"""`runner.record_batches`: environments that return their steps in batches, as JAX and EnvPool do."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Unpack

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv

from runner.environments.gym_types import AnyVectorEnv, Space
from runner.errors import ConfigError, RunnerError
from runner.loops.loop import Loop
from runner.loops.makers import NAME_MAKE, checked_make, vector_maker_of
from runner.loops.options import Arguments, Options, RunOptions, options_of
from runner.loops.recorded import Recorded
from runner.loops.values import as_array, check_phase
from runner.loops.vector import autoreset_mode_of, described_vector, first_of
from runner.recording.gym_values import element_of
from runner.util.arrays import Array, Flags


class NamedEnvironments(AnyVectorEnv):
    """Environments that exist only as arrays: what a recording says of them."""

    def __init__(
        self, env_id: str, mode: AutoresetMode, number: int, observation: Space, action: Space
    ) -> None:
        self.spec = SimpleNamespace(id=env_id, kwargs={})  # type: ignore[assignment]
        self.metadata = {"autoreset_mode": mode}
        self.num_envs = number
        self.observation_space = observation
        self.single_observation_space = observation
        self.action_space = action
        self.single_action_space = action


class RecordedBatches(Recorded):
    """The recording of environments that return their steps in batches; made by `record_batches`."""

    why_not_made = f"it was recorded in batches, and is known by its name alone; {NAME_MAKE}"
    """Why an environment cannot be made again that is known by its name alone."""
    _is_open = False
    """Whether the run has begun; one of named environments begins with the first batch."""

    def __init__(
        self,
        envs: AnyVectorEnv | str,
        mode: AutoresetMode,
        given_spaces: tuple[Space | None, Space | None],
        options: Options,
        make: str,
    ) -> None:
        self._envs = envs
        self._mode = mode
        self._spaces = given_spaces
        self._make = make
        self._options = options
        self._phase = "train"
        self._first: object = None
        """The observations of a reset before the first batch."""
        if isinstance(envs, VectorEnv):
            self._open(envs)

    @property
    def should_stop(self) -> bool:
        """As of every recording; False before the first batch of named environments."""
        return self._is_open and super().should_stop

    def __getattr__(self, name: str) -> object:
        if name in ("_loop", "_messages", "_rows"):
            raise RunnerError(
                "found no batch so far, expected one: it tells how many environments there are."
            )
        raise AttributeError(name)

    def _open(self, envs: AnyVectorEnv) -> None:
        """Begin the run, now that the environments and their spaces are known."""
        with first_of(envs) as first:
            described = described_vector(envs, first, self._mode)
            maker = vector_maker_of(envs, first, self._mode, self._make)
        if isinstance(envs, NamedEnvironments):
            maker = replace(maker, reason=self.why_not_made)
        self.env = envs
        self._record_into(Loop(described, self._options, maker, self._mode))
        self._is_open = True
        super()._enter(self._phase)

    def _enter(self, phase: str) -> None:
        check_phase(phase)
        self._phase = phase
        if self._is_open:
            super()._enter(phase)

    def reset(self, observations: object) -> None:
        """Record that all environments were reset, and these first observations, [N, ...].

        It ends episodes in progress. Episodes that ended are followed by resets without it, except with
        `autoreset_mode="Disabled"`.

        Raises:
            RecordingError: the observations are not of their space, or not [N, ...].
        """
        observations = _numpy(observations)
        if not self._is_open:
            self._first = observations  # until the actions are known too
            return
        try:
            with self._loop.lock:
                if self._loop.activate(self._rows):
                    self._put_reset(observations)
        except Exception as error:
            self._loop.fail(error)

    def _put_reset(self, observations: object) -> None:
        self._rows.reset(observations, (), range(self.env.num_envs))

    def batch(
        self,
        observations: object,
        actions: object,
        rewards: object,
        terminated: object,
        truncated: object = None,
        *,
        final_observations: object = None,
        extras: Mapping[str, object] | None = None,
    ) -> None:
        """Record T steps of all N environments, from arrays of NumPy, JAX or PyTorch.

        Either all of a batch is recorded, or none of it and an error is raised.

        Args:
            observations: what the steps returned, [T, N, ...], after `reset(first)`; or [T + 1, N, ...], with
                the observations before the first step at the front, which are the first reset, and after that
                the last observations of the batch before. Nested as their space.
            actions: [T, N, ...], nested as their space.
            rewards: [T, N].
            terminated: [T, N], boolean or 0 and 1.
            truncated: [T, N] likewise; nowhere unless given.
            final_observations: [T, N, ...], with `autoreset_mode="SameStep"`: the last observations of
                episodes that ended, wherever `observations` belong to the next episodes.
            extras: values of your own by name, [T, N, ...]; texts, and arrays of any length, in T lists of N.

        Raises:
            ConfigError: the arrays do not fit together, or extras cannot be recorded.
            RecordingError: an array has another shape than [T, N, ...], or values that are not of the space.
            ResetNeeded: the batch has no observations before its first step, and `reset` was not called.
        """
        try:
            self._record_batch(
                observations, actions, rewards, terminated, truncated, final_observations, extras or {}
            )
        except Exception as error:
            if not self._is_open:
                raise
            self._loop.fail(error)

    def _record_batch(
        self,
        observations: object,
        actions: object,
        rewards: object,
        terminated: object,
        truncated: object,
        finals: object,
        extras: Mapping[str, object],
    ) -> None:
        """Record T steps, from the arguments of `batch`."""
        paid = as_array(rewards)
        if paid.ndim != 2 or not paid.size or paid.dtype.kind not in "biuf":
            raise ConfigError(f"rewards: found {paid.dtype} of shape {paid.shape}, expected numbers [T, N]")
        steps, _ = paid.shape
        ends = _flags("terminated", terminated, paid.shape)
        cut = np.zeros_like(ends) if truncated is None else _flags("truncated", truncated, paid.shape)
        seen, done = _numpy(observations), _numpy(actions)
        before = None
        if {len(part) for part in _arrays(seen) if part.ndim} == {steps + 1}:
            before = element_of(seen, 0)
            seen = element_of(seen, slice(1, None))
        if not self._is_open:
            self._open_from(before, seen, done)
        self._check_finals(finals, ends | cut, seen)
        with self._loop.lock:
            if not self._loop.activate(self._rows):
                return
            if before is not None and not self._rows.resets:
                self._put_reset(before)
            elif before is not None and not self._rows.continues_with(before):
                raise ConfigError(
                    "observations: found T + 1, whose first are not the last observations that were "
                    "recorded; call reset(first) if the environments were reset in between"
                )
            final = None if finals is None else _numpy(finals)
            values = {}
            try:
                values = self._loop.extras.checked_batch(extras, paid.shape)
            except ConfigError as error:
                self._loop.leave_out(error)
            self._rows.take_batch(seen, done, paid.astype(np.float64, copy=False), ends, cut, final)
            if values:
                self._loop.extras.put_batch(self._phase, self._rows, values)

    def _open_from(self, before: object, observations: object, actions: object) -> None:
        """Begin the run of environments that are known from their first batch."""
        shape = next(_arrays(observations)).shape
        if len(shape) < 2:
            raise ConfigError(f"observations: found shape {shape}, expected [T, N, ...]")
        observation, action = (
            _derived(batch) if space is None else space
            for space, batch in zip(self._spaces, (observations, actions), strict=True)
        )
        self._open(NamedEnvironments(str(self._envs), self._mode, shape[1], observation, action))
        if self._first is not None and before is None:
            self.reset(self._first)
        self._first = None

    def _check_finals(self, finals: object, ends: Flags, observations: object) -> None:
        if finals is not None and self._mode != AutoresetMode.SAME_STEP:
            raise ConfigError(
                f'final_observations: found some with autoreset_mode="{self._mode.value}", expected none: '
                "the observations at the ends of episodes are the last ones already"
            )
        if finals is None and self._mode == AutoresetMode.SAME_STEP and ends.any():
            if any(part.dtype.kind != "f" for part in _arrays(observations)):
                raise ConfigError(
                    "final_observations: found none, expected the last observations of episodes, "
                    "[T, N, ...]: those of whole numbers or text cannot be recorded as unknown"
                )
            self._loop.warn_once(
                "The last observations of episodes are recorded as NaN, because the environments were reset "
                "within the step: pass final_observations to record them. This warning is given once."
            )

    def _end(self, arguments: Arguments, *ending: str) -> None:
        if self._is_open:
            super()._end(arguments, *ending)


def record_batches(
    envs: AnyVectorEnv | str,
    recordings: str | os.PathLike[str] | None = None,
    *,
    observation_space: object = None,
    action_space: object = None,
    autoreset_mode: AutoresetMode | str | None = None,
    make: str | Callable[[], object] | None = None,
    **options: Unpack[RunOptions],
) -> RecordedBatches:
    """Return a recording of N environments that takes their steps in batches, without an object a step.

        with runner.record_batches("gymnax/CartPole-v1", autoreset_mode="SameStep") as rec:
            ...
            rec.batch(observations, actions, rewards, terminated)  # [T + 1, N, ...], and [T, N, ...]

    It is for environments that step inside of a compiled function, as in gymnax and Brax, and for many quick
    environments, as in EnvPool. The run is the same as with `record_vector`.

    Args:
        envs: the name of the environment; or a vector environment, which is described but never called,
            except to close it.
        recordings: as for `record`.
        observation_space: the space of one environment, by default as the first batch has them: arrays, or
            mappings and tuples of arrays. Spaces of gymnax are accepted too.
        action_space: likewise; give `Discrete(n)` where actions are choices.
        autoreset_mode: what the steps after an episode are. "NextStep" (EnvPool): the next step ignores the
            action and returns the first observation of the next episode. "SameStep" (gymnax, Brax): the step
            that ends an episode returns the first observation of the next one. "Disabled": none, until
            `reset`. A vector environment may state it itself.
        make: as for `record`; the function makes the vector environment.
        options: the arguments that `record` has too, except those of infos and frames.

    Raises:
        EnvironmentNotUsable: a space cannot be recorded.
        ConfigError: an argument cannot be used.
        StorageError: the recordings folder cannot be written.
    """
    if not isinstance(envs, VectorEnv | str) or not envs:
        raise ConfigError(f"found {type(envs).__name__}, expected a name, or a vector environment")
    if isinstance(envs, VectorEnv) and not observation_space is action_space is None:
        raise ConfigError("found spaces next to a vector environment, which has its own")
    mode = autoreset_mode_of(None if isinstance(envs, str) else envs, autoreset_mode)
    given_spaces = _as_space(observation_space), _as_space(action_space)
    valid = options_of(recordings, options, valid=RunOptions.__annotations__)
    return RecordedBatches(envs, mode, given_spaces, valid, checked_make(make))


def _numpy(values: object) -> object:
    """Return arrays of any library as NumPy's, nested as they are."""
    if isinstance(values, Mapping):
        return {key: _numpy(part) for key, part in values.items()}
    if isinstance(values, tuple):
        return tuple(map(_numpy, values))
    array = as_array(values)
    # NumPy's own texts have no zeros at the end.
    return np.array(values, object) if array.dtype.kind in "US" and array is not values else array


def _arrays(values: object) -> Iterator[Array]:
    if isinstance(values, Mapping | tuple):
        for part in values.values() if isinstance(values, Mapping) else values:
            yield from _arrays(part)
    else:
        yield np.asarray(values)


def _flags(what: str, values: object, shape: tuple[int, ...]) -> Flags:
    """Return an array of booleans, which may come as 0 and 1.

    Raises:
        ConfigError: it holds something else, or has another shape.
    """
    flags: Array = as_array(values)
    if flags.shape != shape or (flags.dtype.kind != "b" and not np.isin(flags, (0, 1)).all()):
        raise ConfigError(
            f"{what}: found {flags.dtype} of shape {flags.shape}, expected booleans of the shape {shape}, as "
            "rewards"
        )
    return flags.astype(np.bool_, copy=False)


def _derived(batch: object) -> Space:
    """Return a space for what the values of a batch, [T, N, ...], are to each environment."""
    if isinstance(batch, Mapping):
        return spaces.Dict({str(key): _derived(part) for key, part in batch.items()})
    if isinstance(batch, tuple):
        return spaces.Tuple([_derived(part) for part in batch])
    array = np.asarray(batch)
    kind = array.dtype
    shape = array.shape[2:]
    if kind.kind not in "biuf":
        raise ConfigError(
            f"found a batch of {kind}, whose space is unknown: pass observation_space and action_space"
        )
    if kind.kind == "b":
        return spaces.Box(0, 1, shape, np.uint8)
    if kind.kind in "iu":
        return spaces.Box(np.iinfo(kind).min, np.iinfo(kind).max, shape, kind.type)
    return spaces.Box(-np.inf, np.inf, shape, kind.type)


def _as_space(space: Any) -> Space | None:
    """Return a space of Gymnasium's for one of gymnax, which has the same attributes."""
    if space is None or isinstance(space, spaces.Space):
        return space
    if hasattr(space, "n"):
        return spaces.Discrete(int(space.n))
    try:
        low, high = (np.broadcast_to(np.asarray(bound), space.shape) for bound in (space.low, space.high))
        return spaces.Box(low, high, dtype=np.dtype(space.dtype).type)
    except (AttributeError, TypeError, ValueError) as error:
        raise ConfigError(f"found {type(space).__name__}, expected a space of Gymnasium or gymnax") from error
