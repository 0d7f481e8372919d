"""Steps by episode, and checks of steps; a module of its own, as it needs no compiled code."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.reader import Recording


def step_of_episode(recording: Recording, episode: int) -> int:
    """Return the number of training steps taken when `episode` episodes had ended.

    Raises:
        RecordingError: fewer episodes were recorded, or the last of them was lost.
    """
    ended = recording.count(schema.TRAIN_EPISODE)
    if not 0 <= episode <= ended:
        raise RecordingError(
            f"{recording.path}: found {ended} training episodes, expected at least {episode}."
        )
    if episode == 0:
        return 0
    record = recording.episodes("train", episode - 1, episode)
    if not len(record):
        raise RecordingError(f"{recording.path}: training episode {episode - 1} was lost.")
    return int(record[0]["last_step"]) + 1


def transitions_of(recording: Recording, phase: str, episode: int) -> Iterator[Any]:
    """Yield an episode's steps one by one, as `Recording.transitions` yields them; memory is bounded.

    Raises:
        RecordingError: the recording has no such episode, or steps of it were lost.
    """
    topic, numbers = recording.topic(f"/{phase}/step"), recording.episode_span(phase, episode)
    if topic not in recording.dtypes:
        yield from islice(recording.transitions(phase), numbers.start, numbers.stop)
        return
    found = 0
    for block in recording.blocks(topic, numbers.start, numbers.stop):
        steps = block[(numbers.start - int(block["step"][0])) % numbers.step :: numbers.step]
        found += len(steps)
        yield from steps
    if found != len(numbers):
        raise RecordingError(
            f"{recording.path}: {len(numbers) - found:,} of the {len(numbers):,} steps of "
            f"{schema.PHASE_NAMES[phase]} episode {episode} were lost."
        )


def reset_of(recording: Recording, phase: str, episode: int) -> Any | None:
    """Return the reset that an episode of a loop began with, as `Recording.resets` yields it.

    It is the last one of the episode's environment at or before its first step. None if it was lost.

    Raises:
        RecordingError: the recording has no such episode.
    """
    topic, numbers = recording.topic(f"/{phase}/reset"), recording.episode_span(phase, episode)
    if topic not in recording.dtypes:
        last = None
        for reset in recording.resets(phase):
            if reset["step"] > numbers.start:
                break
            last = reset
        return last
    first, stop = (
        recording.first_from(topic, "step", number)
        for number in (numbers.start - 2 * numbers.step, numbers.start + 1)
    )
    found = None
    for block in recording.blocks(topic, first, stop):
        own = block[block["environment"] == numbers.start % numbers.step]
        found = own[-1] if len(own) else found
    return found


def last_step(recording: Recording) -> int:
    """Return the last training step at which the tables can be had."""
    snapshots = max((snapshot.step for snapshot in recording.snapshots()), default=0)
    return max(snapshots, recording.count(schema.TRAIN_STEP))


def check_steps(block: NDArray[np.void], mdp: Mdp, where: str, phase: str = "training") -> None:
    """Refuse steps with a state or an action that the environment does not have: they are used as indices.

    Args:
        block: the steps; not empty.
        mdp: the environment.
        where: the recording or archive, for the error.
        phase: of the steps, for the error.

    Raises:
        RecordingError: there is such a step.
    """
    bounds = {"state": mdp.states, "next_state": mdp.states, "action": mdp.joint_actions}
    for name, bound in bounds.items():
        if (found := int(block[name].max())) >= bound:
            step = int(block["step"][int(block[name].argmax())])
            raise RecordingError(
                f"{where}: found {name} {found} in {phase} step {step}, expected less than {bound}; "
                "`dualtaxi verify` checks the whole recording."
            )
