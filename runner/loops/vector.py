"""`runner.record_vector`: several environments that step at once."""

from __future__ import annotations

import contextlib
import os
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, VectorEnv, VectorWrapper

from runner.environments.gym_types import AnyVectorEnv, Info, ResetOptions, ResetResult, VectorStepResult
from runner.environments.interfaces import class_name, layers_of, spaces_of_one
from runner.errors import ConfigError, EnvironmentNotUsable
from runner.loops.description import Described, describe
from runner.loops.generators import GeneratorWatch, States, vector_watch
from runner.loops.loop import Loop
from runner.loops.makers import checked_make, vector_maker_of
from runner.loops.options import RecordOptions, options_of
from runner.loops.recorded import Recorded, require_pictures, return_name
from runner.loops.values import as_given, check_phase
from runner.util.arrays import Flags

if TYPE_CHECKING:
    _Wrapper = VectorWrapper[object, object, object, object, object]
else:
    _Wrapper = VectorWrapper  # it takes no parameters before Gymnasium 1.3


class RecordedVector(Recorded, _Wrapper):
    """A vector environment whose every reset and step is recorded; made by `record_vector`."""

    env: AnyVectorEnv

    def __init__(
        self,
        env: AnyVectorEnv,
        loop: Loop,
        mode: AutoresetMode,
        watch: GeneratorWatch,
        phase: str = "train",
    ) -> None:
        VectorWrapper.__init__(self, env)
        self._mode = mode
        self._resets_within = mode == AutoresetMode.SAME_STEP
        self._watch = watch
        first = next(iter(getattr(env.unwrapped, "envs", ())), None)  # none where they are in other processes
        layers = [*layers_of(env), *layers_of(first)]
        self._return_name = return_name(list(map(class_name, layers)))
        self._has_messages = bool(loop.options.info or loop.options.frames_every or self._return_name)
        self._record_into(loop)
        base = env.unwrapped
        self._is_reset_twice = isinstance(base, AsyncVectorEnv) and not base.shared_memory
        """Without shared memory, Gymnasium's workers do not forget the end of an episode at a reset."""
        Recorded._enter(self, phase)
        self._rows.is_reset_twice = self._is_reset_twice

    def _enter(self, phase: str) -> None:
        with self._loop.lock:
            over = self._rows.over
            super()._enter(phase)
            self._rows.is_reset_twice = self._is_reset_twice
            self._rows.over = over  # the environments are the same ones
            self._watch.begin_phase()

    def step(self, actions: object, extras: Mapping[str, object] | None = None) -> VectorStepResult:
        """Take a step in every environment, and record it, with values of your own by name.

        Args:
            extras: arrays [N, ...], or lists of N texts or arrays of any lengths.
        """
        watch = self._watch
        frames_every = self._options.frames_every
        watch.steps += 1
        over = None
        states = None
        if frames_every or (watch.steps > watch.due and self._rows.is_any_over):
            with self._loop.lock:  # the rows are committed by another thread
                over = self._rows.over
            if watch.steps > watch.due:
                states = watch.before_step(over)
        given = as_given(actions)
        result = self.env.step(actions)
        self.record_step(given, result, extras, over, states)
        return result

    def record_step(
        self,
        actions: object,
        result: VectorStepResult,
        extras: Mapping[str, object] | None = None,
        over: Flags | None = None,
        states: States | None = None,
    ) -> None:
        """Record a step of all environments that was just taken.

        Args:
            actions: as they were before the step.
            result: what the step returned.
            extras: arrays [N, ...] by name.
            over: [N], whether their episodes were over before; None where that does not matter.
            states: what resets within the step depended on.
        """
        try:
            observations, rewards, terminated, truncated, infos = result
            loop, rows = self._loop, self._rows
            with loop.lock:
                if loop.active is not rows and not loop.activate(rows):
                    return
                finals = infos if self._resets_within else None
                rows.take_vector(actions, observations, rewards, terminated, truncated, finals, states)
                if extras is not None:
                    self._take_extras(extras)
            if self._has_messages:
                self._record_messages(infos, np.logical_or(terminated, truncated), over)
        except Exception as error:
            self._loop.fail(error)

    def _record_messages(self, infos: Info | Sequence[Info], ended: Flags, over: Flags | None) -> None:
        """Record the chosen fields of infos, and the pictures that are due, of a step."""
        if self._options.info:
            self._messages.info(self._phase, self._info_by_field(infos))
        if self._return_name and ended.any() and isinstance(infos, Mapping):
            self._log_return(infos, ended)
        if self._options.frames_every:
            self._until_frame -= 1
            resets = {AutoresetMode.SAME_STEP: ended, AutoresetMode.NEXT_STEP: over}
            self._record_frames(resets.get(self._mode, False), ended)

    def _pictures(self, due: Sequence[int]) -> Any:
        inside = getattr(self.env.unwrapped, "envs", None)
        return {i: inside[i].render() for i in due} if inside else self.env.render()

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: ResetOptions | None = None
    ) -> ResetResult:
        """Reset all environments, or those of `options["reset_mask"]`, and record it."""
        n = self.env.num_envs
        mask = None
        given = options
        if isinstance(options, Mapping) and "reset_mask" in options:
            mask = options["reset_mask"]
            given = {key: value for key, value in options.items() if key != "reset_mask"} or None
        environments = np.flatnonzero(np.ones(n) if mask is None else mask).tolist()
        seeds: list[int | None] = []
        if isinstance(seed, int | np.integer):
            seeds = [seed + i for i in range(n)]
        elif seed is not None:
            seeds = list(seed)
        return self._reset(seeds, environments, given, {"seed": seed, "options": options})

    def record_reset(self, observations: object, infos: Info | Sequence[Info]) -> None:
        """Record a reset of all environments that was just done, without seeds and options."""
        self._record_reset(observations, infos, (), range(self.env.num_envs), {}, "")

    def _info_by_field(self, info: Info | Sequence[Info]) -> Info:
        """Return infos by field; SuperSuit returns a list of them, one for each environment."""
        if isinstance(info, Mapping):
            return info
        return by_field({str(i): part for i, part in enumerate(info)})


def record_vector(
    envs: AnyVectorEnv,
    recordings: str | os.PathLike[str] | None = None,
    *,
    frames_of: int | Sequence[int] | None = None,
    autoreset_mode: AutoresetMode | str | None = None,
    phase: str = "train",
    make: str | Callable[[], object] | None = None,
    **options: Unpack[RecordOptions],
) -> RecordedVector:
    """Return a vector environment, with everything that a loop does with it recorded.

        with runner.record_vector(gymnasium.make_vec("CartPole-v1", 8), config={"lr": 3e-4}) as envs:
            observations, infos = envs.reset(seed=0)

    All environments are recorded into one run: its step number n was taken in environment n modulo their
    number. Resets that the environments do by themselves (`AutoresetMode`) are recorded as resets.

    Args:
        envs: a vector environment.
        recordings: as for `record`.
        frames_of: the number of the environment to render, or several; all unless given.
        autoreset_mode: how the environments reset themselves, if their metadata does not state it:
            "NextStep", "SameStep" or "Disabled"; "SameStep" for SuperSuit.
        phase: `train` or `eval`.
        make: as for `record`; the function makes the vector environment.
        options: the arguments that `record` has too. Frames are of each environment; "SameStep" environments
            show the next episode at the ends of episodes.

    Raises:
        EnvironmentNotUsable: a space cannot be recorded.
        ConfigError: an argument cannot be used.
        StorageError: the recordings folder cannot be written.
    """
    if not isinstance(envs, VectorEnv):
        raise ConfigError(
            f"found {type(envs).__name__}, expected a vector environment, such as gymnasium.make_vec gives"
        )
    check_phase(phase)
    mode = autoreset_mode_of(envs, autoreset_mode)
    with first_of(envs) as first:
        described = described_vector(envs, first, mode)
        maker = vector_maker_of(envs, first, mode, checked_make(make))
        watch = vector_watch(envs, first, mode, sparse=options.get("steps") == "actions")
    frames_every = options.get("frames_every", 0)
    if frames_every:
        require_pictures(envs)
    drawn = None if frames_of is None else tuple(sorted(set(np.atleast_1d(frames_of).tolist())))
    if drawn is not None and not (frames_every and set(drawn) <= set(range(envs.num_envs))):
        raise ConfigError(
            f"frames_of: found {frames_of!r} with frames_every={frames_every}, expected numbers from 0 to "
            f"{envs.num_envs - 1}, and frames_every"
        )
    loop = Loop(described, options_of(recordings, options, drawn), maker, mode)
    return RecordedVector(envs, loop, mode, watch, phase)


def autoreset_mode_of(envs: AnyVectorEnv | None, mode: AutoresetMode | str | None) -> AutoresetMode:
    """Return how environments reset themselves: in this mode, else as their metadata states.

    Raises:
        ConfigError: there is no such mode.
        EnvironmentNotUsable: there is no mode and none is stated.
    """
    if mode is not None or envs is None:
        try:
            return AutoresetMode(mode)
        except ValueError as error:
            modes = ", ".join(repr(known.value) for known in AutoresetMode)
            raise ConfigError(f"autoreset_mode: found {mode!r}, expected one of {modes}") from error
    stated = (getattr(envs, "metadata", None) or {}).get("autoreset_mode")
    if not isinstance(stated, AutoresetMode):
        raise EnvironmentNotUsable(
            f'found metadata["autoreset_mode"] {stated!r}, expected one of gymnasium.vector.AutoresetMode: '
            "without it, resets cannot be distinguished from steps. State it: record_vector(envs, "
            'autoreset_mode="NextStep"), or "SameStep" (SuperSuit) or "Disabled".'
        )
    return stated


def described_vector(envs: AnyVectorEnv, first: object, mode: AutoresetMode) -> Described:
    """Return the description of a vector environment; `first` is its first environment."""
    has_turns = envs.num_envs > 1 or mode == AutoresetMode.NEXT_STEP
    registered = first if getattr(envs, "spec", None) is None else envs
    described = describe(registered, *spaces_of_one(envs))
    return replace(described, environments=envs.num_envs, has_turns=has_turns, mdp=None, agents=("agent",))


@contextlib.contextmanager
def first_of(envs: AnyVectorEnv) -> Iterator[object]:
    """Yield the first environment of a vector, or the vector if it has none of its own.

    Those of an AsyncVectorEnv are in other processes, which end if a registration cannot be sent; so one is
    made here, as AsyncVectorEnv itself does, without changing the state of the global random generators.
    """
    unwrapped = envs.unwrapped
    if inside := getattr(unwrapped, "envs", None):
        yield inside[0]
    elif isinstance(unwrapped, AsyncVectorEnv):
        states = random.getstate(), np.random.get_state()
        try:
            with contextlib.closing(unwrapped.env_fns[0]()) as env:
                yield env
        finally:
            random.setstate(states[0])
            np.random.set_state(states[1])
    else:
        yield envs


def by_field(infos: Mapping[str, Info]) -> dict[str, Info]:
    """Return the infos of agents by field, then by agent."""
    fields: dict[str, Info] = {}
    for agent, info in infos.items():
        for key, value in info.items():
            fields.setdefault(key, {})[agent] = value
    return fields
