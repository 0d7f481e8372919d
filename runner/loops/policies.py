"""A checkpoint of a loop at work: played in the recorded environment, or along an episode of the past.

    # agent.py
    def policy(weights, observation_space, action_space):
        return lambda observation: int((observation @ weights["w"]).argmax())

`weights` is what `Checkpoint.load` returns: arrays by name of safetensors, else bytes. Nothing is imported
but what the user names, and the environment, as `runner.replay.makers` allows.
"""

from __future__ import annotations

import contextlib
import importlib
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from runner.environments.interfaces import game_spaces, is_game
from runner.errors import CannotRedo, ConfigError, RecordingError, RunnerError
from runner.export.minari import episodes_in
from runner.loops.env import record_alone
from runner.loops.values import as_array
from runner.recording.gym_spaces import restore_space
from runner.recording.gym_values import element_of
from runner.recording.reader import Recording, open_recording
from runner.replay.makers import make_environment, why_not_alone, why_not_made
from runner.replay.trust import trusting
from runner.runs.checkpoints import Checkpoint
from runner.runs.run import Run
from runner.runs.trust_marks import marking_nothing
from runner.util.arrays import Array, Floats
from runner.util.processes import Report, importing_from

MAX_NUMBERS: Final = 256
"""The most numbers in one of the values that a policy returns along an episode."""
Policy = Callable[[object], object]
"""Takes an observation; returns an action, or what is to be shown of it."""


def policy_named(name: str) -> Callable[..., Any]:
    """Return the function `module:function`; the module is imported, also from the current folder.

    Raises:
        ConfigError: there is none of that name, or importing the module fails.
    """
    module_name, _, function_name = name.partition(":")
    if not module_name or not function_name:
        raise ConfigError(f"policy: found {name!r}, expected module:function")
    try:
        with importing_from([str(Path.cwd())]):
            function = getattr(importlib.import_module(module_name), function_name)
    except Exception as error:  # a module of the user's may raise anything
        raise ConfigError(
            f"policy: {name!r} cannot be imported ({type(error).__name__}: {error}); it is looked for on "
            "Python's path and in the current folder"
        ) from error
    if not callable(function):
        raise ConfigError(f"policy: found {type(function).__name__} at {name!r}, expected a function")
    return function  # type: ignore[no-any-return]


def play_checkpoint(
    run: Run,
    checkpoint: Checkpoint,
    policy: str,
    recordings: Path,
    episodes: int,
    seed: int = 0,
    trust: bool = False,
    report: Report = lambda _: None,
) -> Run:
    """Play a checkpoint in the recorded environment; return the run that it was recorded in.

    Args:
        recordings: the recordings folder of the new run; its settings name the run, step and digest.
        seed: of the first reset; the following ones have the next numbers.
        trust: whether to import what the recording names, and to load a pickle.

    Raises:
        CannotRedo: the environment cannot be made again.
    """
    with open_recording(run.recording) as recording:
        maker = recording.eval.maker_of()
    if maker is None:
        raise CannotRedo(why_not_made(None, trust))
    if reason := why_not_alone(maker):
        raise CannotRedo(reason)
    with trusting(run.recording, maker, trust) as is_trusted:
        if reason := why_not_made(maker, is_trusted):
            raise CannotRedo(reason)
        make, weights = policy_named(policy), checkpoint.load(trust)
        env = make_environment(maker, is_trusted)
    origin = {"run": run.run_id, "checkpoint": checkpoint.name, "step": checkpoint.step}
    settings = {"origin": origin | {"digest": checkpoint.digest}, "policy": policy}
    env_spaces = game_spaces(env) if is_game(env) else (env.observation_space, env.action_space)
    try:
        with from_policy(policy):
            act = make(weights, *env_spaces)
    except BaseException:
        env.close()
        raise
    name = f"{run.name[:90]}.evaluated"
    with marking_nothing(not is_trusted):
        recorded = record_alone(env, recordings, name=name, seed=seed, config=settings)
    with recorded as rec, rec.phase("eval"):
        for number in range(episodes):
            observation, _ = rec.reset(seed=seed + number)
            over = False
            while not over:
                with from_policy(policy):
                    action = act(observation)
                observation, _, terminated, truncated, _ = rec.step(action)
                over = rec.is_over(terminated, truncated)
            report(number + 1)
    played: Run = rec.run
    return played


@dataclass(frozen=True)
class ValuesAlong:
    """What a policy returned along a recorded episode of T steps."""

    actions: object
    """The T recorded actions, nested as their space."""
    rewards: Floats
    """[T, agents]."""
    values: Mapping[str, Array]
    """What the policy returned for the observation before each step, by name: [T, ...]."""


def values_along(
    recording: Recording, phase: str, episode: int, checkpoint: Checkpoint, policy: str, trust: bool = False
) -> ValuesAlong:
    """Return what a checkpoint's agent returns along a recorded episode.

    The policy is called with each recorded observation before a step. It may return a number, an array, or a
    mapping of names to these; without names, the name is `value`.

    Args:
        checkpoint: of this run, or of another one with the same spaces.
        trust: whether to load a pickle.

    Raises:
        ConfigError: the policy cannot be imported, or returns something else.
        RecordingError: there is no such episode, or the content of the checkpoint is not here.
    """
    recording.phase(phase).episode(episode)  # with its message, if there is none
    steps_of_episode = next(episodes_in(recording, phase, ((episode, episode + 1),)), None)
    if steps_of_episode is None:
        raise RecordingError(
            f"{recording.path}: the observations of {phase} episode {episode} are not all there: it has not "
            "ended, or a part of it was lost."
        )
    recorded_spaces = (restore_space(recording.spaces[name]) for name in ("observation", "action"))
    make, weights = policy_named(policy), checkpoint.load(trust)
    with from_policy(policy):
        act = make(weights, *recorded_spaces)
    rows: dict[str, list[Array]] = {}
    steps = len(steps_of_episode.rewards)
    for t in range(steps):
        with from_policy(policy):
            returned = act(element_of(steps_of_episode.observations, t))
        for name, value in _named(returned).items():
            rows.setdefault(name, []).append(value)
    try:
        values = {name: np.stack(arrays) for name, arrays in rows.items()}
    except ValueError as error:
        raise ConfigError(f"policy: {policy!r} returned arrays of different shapes ({error})") from error
    if any(len(array) != steps for array in values.values()):
        raise ConfigError(f"policy: {policy!r} returned other names at some steps, expected the same ones")
    return ValuesAlong(steps_of_episode.actions, steps_of_episode.rewards, values)


def _named(value: object) -> dict[str, Array]:
    """Return what a policy returned, by name.

    Raises:
        ConfigError: it is no number, array, or mapping of these.
    """
    pieces = value if isinstance(value, Mapping) else {"value": value}
    named = {}
    for name, piece in pieces.items():
        try:
            array = as_array(piece)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ConfigError(f"policy: found no numbers for {name!r} ({error})") from error
        if array.dtype.kind not in "biuf" or not 0 < array.size <= MAX_NUMBERS:
            raise ConfigError(
                f"policy: found {array.dtype} of shape {array.shape} for {name!r}, expected 1 to "
                f"{MAX_NUMBERS} numbers"
            )
        named[str(name)] = array
    return named


@contextlib.contextmanager
def from_policy(name: str) -> Iterator[None]:
    """Raise what the user's policy raises as an error with its place."""
    try:
        yield
    except RunnerError:
        raise
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        raise RunnerError(
            f"the policy {name} failed at {last.filename}:{last.lineno}: {type(error).__name__}: {error}"
        ) from error
