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
from numpy.typing import NDArray

from runner.environments.gym_types import AnyVectorEnv, Info, ResetOptions, ResetResult, VectorStepResult
from runner.environments.layers import class_name, layers_of, spaces_of_one
from runner.errors import ConfigError, EnvironmentNotUsable
from runner.loops.description import Described, describe
from runner.loops.generators import States, VectorWatch
from runner.loops.loop import Loop
from runner.loops.makers import checked_make, vector_maker_of
from runner.loops.options import RecordOptions, options_of
from runner.loops.recorded import Recorded, require_pictures, without_none
from runner.loops.values import as_given, check_phase
from runner.loops.wrappers import return_name
from runner.recording.spaces import Value
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
        watch: VectorWatch,
        phase: str = "train",
    ) -> None:
        VectorWrapper.__init__(self, env)
        self._mode, self._resets_within = mode, mode == AutoresetMode.SAME_STEP
        self._watch = watch
        first = next(iter(getattr(env.unwrapped, "envs", ())), None)  # none where they are in other processes
        layers = [*layers_of(env), *layers_of(first)]
        self._return_name = return_name(list(map(class_name, layers)))
        self._has_messages = bool(loop.options.info or loop.options.frames_every or self._return_name)
        self._record_into(loop)
        Recorded._enter(self, phase)

    def _enter(self, phase: str) -> None:
        with self._loop.lock:
            over = self._rows.over
            super()._enter(phase)
            self._rows.over = over  # the environments are the same ones
            self._watch.phase_began()

    def step(self, actions: object, extras: Mapping[str, object] | None = None) -> VectorStepResult:
        """Take a step in every environment, and record it, with values of your own by name.

        Args:
            extras: arrays [N, ...], or lists of N texts or arrays of any lengths.
        """
        watch, frames_every = self._watch, self._options.frames_every
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
                    try:
                        self._take_extras(extras)
                    except ConfigError as error:
                        loop.leave_out(error)
            if self._has_messages:
                self._record_messages(infos, np.logical_or(terminated, truncated), over)
        except Exception as error:
            self._loop.fail(error)

    def _record_messages(self, infos: Info | Sequence[Info], ended: Flags, over: Flags | None) -> None:
        """Record the chosen fields of infos, and the pictures that are due, of a step."""
        if self._options.info:
            self._messages.info(self._phase, _by_environment(infos))
        if self._return_name and ended.any() and isinstance(infos, Mapping):
            self._log_return(infos, ended)
        if self._options.frames_every:
            self._until_frame -= 1
            if self._resets_within:
                self._record_frames(resets=ended)
            elif self._mode == AutoresetMode.NEXT_STEP:
                self._record_frames(resets=over, ends=ended)
            else:
                self._record_frames(ends=ended)

    def _record_frames(self, resets: Any = False, ends: Flags | bool = False) -> None:
        """Record pictures of the environments that were reset or whose episode ended, now and then of all."""
        n, every = self.env.num_envs, self._options.frames_every
        resets, is_due = np.broadcast_to(resets, n), np.broadcast_to(resets | np.asarray(ends), n)
        if self._until_frame <= 0 or resets.all():
            self._until_frame, is_due = every, np.ones(n, np.bool_)
        chosen = range(n) if self._options.frames_of is None else self._options.frames_of
        which = [i for i in chosen if is_due[i]]
        if not which:
            return
        inside = getattr(self.env.unwrapped, "envs", None)
        images = {i: inside[i].render() for i in which} if inside else self.env.render()
        if images is None or len(images) < len(which):
            raise ConfigError(f"frames: found {type(images).__name__} from render(), expected {n} pictures.")
        for i in which:
            self._messages.frame(self._phase, images[i], bool(resets[i]), i)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: ResetOptions | None = None
    ) -> ResetResult:
        """Reset all environments, or those of `options["reset_mask"]`, and record it."""
        n, mask = self.env.num_envs, (options or {}).get("reset_mask")
        text = self._messages.options_text(
            {key: own for key, own in (options or {}).items() if key != "reset_mask"}
        )
        which = np.ones(n, np.bool_) if mask is None else np.array(mask, np.bool_)
        seeds = [seed + i for i in range(n)] if isinstance(seed, int) else list(seed or ())
        states = self._watch.before_reset(which, seeds)
        result = self.env.reset(**without_none(seed=seed, options=options))
        states = self._watch.after_reset(states, which, seeds)
        try:
            self.record_reset(*result, seeds, which, states, text)
        except Exception as error:
            self._loop.fail(error)
        return result

    def record_reset(
        self,
        observations: object,
        infos: Info | Sequence[Info],
        seeds: Sequence[int | None] = (),
        which: NDArray[np.bool_] | None = None,
        states: States | None = None,
        options: str = "",
    ) -> None:
        """Record a reset of some environments, or of all, that was just done.

        Args:
            seeds: of all environments; empty for none.
            which: [N], the environments; all unless given.
            states: what the reset depended on, as far as it is to be recorded.
            options: those of the reset as JSON; empty for none.
        """
        which = np.ones(self.env.num_envs, np.bool_) if which is None else which
        with self._loop.lock:
            if not self._loop.activate(self._rows):
                return
            environments = np.flatnonzero(which).tolist()
            self._rows.reset(observations, seeds, environments, states or {}, options)
        if self._options.info:
            self._messages.info(self._phase, _by_environment(infos), is_reset=True)
        if self._options.frames_every:
            self._record_frames(resets=which)


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

    All environments are recorded into one run, whose step number n was taken in environment n modulo their
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
        watch = VectorWatch(envs, first, mode, sparse=options.get("steps") == "actions")
    frames_every = options.get("frames_every", 0)
    if frames_every:
        require_pictures(envs)
    chosen = None if frames_of is None else tuple(sorted(set(np.atleast_1d(frames_of).tolist())))
    if chosen is not None and not (frames_every and set(chosen) <= set(range(envs.num_envs))):
        raise ConfigError(
            f"frames_of: found {frames_of!r} with frames_every={frames_every}, expected numbers from 0 to "
            f"{envs.num_envs - 1}, and frames_every"
        )
    loop = Loop(described, options_of(recordings, options, chosen), maker, mode)
    return RecordedVector(envs, loop, mode, watch, phase)


def autoreset_mode_of(envs: AnyVectorEnv | None, chosen: AutoresetMode | str | None) -> AutoresetMode:
    """Return how environments reset themselves: as chosen, else as their metadata states.

    Raises:
        ConfigError: there is no such mode.
        EnvironmentNotUsable: none is chosen and none is stated.
    """
    if chosen is not None or envs is None:
        try:
            return AutoresetMode(chosen)
        except ValueError as error:
            modes = ", ".join(repr(mode.value) for mode in AutoresetMode)
            raise ConfigError(f"autoreset_mode: found {chosen!r}, expected one of {modes}") from error
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
            with contextlib.closing(unwrapped.env_fns[0]()) as own:
                yield own
        finally:
            random.setstate(states[0])
            np.random.set_state(states[1])
    else:
        yield envs


def _by_environment(infos: Info | Sequence[Info]) -> Mapping[str, Value]:
    """Return infos by field; SuperSuit returns a list of them, one for each environment."""
    if isinstance(infos, Mapping):
        return infos
    return by_field({str(i): info for i, info in enumerate(infos)})


def by_field(infos: Mapping[str, Info]) -> dict[str, Info]:
    """Return the infos of agents by field, then by agent."""
    fields: dict[str, Info] = {}
    for agent, info in infos.items():
        for key, value in info.items():
            fields.setdefault(key, {})[agent] = value
    return fields
