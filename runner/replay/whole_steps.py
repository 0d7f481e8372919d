"""Whole steps of an episode of which only the actions were recorded: rerun, and proved by digests."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording.actions import after_step
from runner.recording.reader import MAX_EPISODE_BYTES, Recording, open_recording
from runner.recording.schema import PHASE_NAMES
from runner.recording.spaces import least_number
from runner.replay.redone import RedoneSteps


def whole_steps(recording: Recording, phase: str, episode: int) -> NDArray[np.void]:
    """Return the steps of an episode as `Phase.episode_steps` does, from its recorded actions.

    The environment is made again in a child process with limits, from what is installed. The last episodes
    are kept for the next call.

    Raises:
        CannotRedo: the environment cannot be made, or is another one.
        RecordingError: actions of the episode were lost, or it is too long for an array.
    """
    span, topic = recording.phase(phase).episode_span(episode), recording.phase(phase).steps.topic
    if len(span) * recording.layout.rows(topic).itemsize > MAX_EPISODE_BYTES:
        raise RecordingError(
            f"{recording.path}: {phase} episode {episode} has {len(span):,} steps, too many to rerun for "
            f"an array; `dualtaxi rerecord {recording.run_id}` records them."
        )
    return _whole_steps(recording.path, recording.file.size, phase, episode)


@lru_cache(4)
def _whole_steps(path: Path, _size: int, phase: str, episode: int) -> NDArray[np.void]:
    from runner.replay.environment import redo_in_child  # loads Gymnasium

    with open_recording(path) as recording:
        span = recording.phase(phase).episode_span(episode)
        own = list(recording.phase(phase).steps.numbered(span))
        if not own or not np.array_equal(np.concatenate([part["step"] for part in own]), span):
            raise RecordingError(f"{path}: steps of {PHASE_NAMES[phase]} episode {episode:,} were lost.")
        records = blank_steps(recording, phase, np.concatenate(own))
        is_state, start = recording.has_states, least_number(recording.spaces["observation"])
    for steps in redo_in_child(path, phase, [episode]):
        fill_in(records, (steps.step - span.start) // span.step, steps)
        for first in steps.starts if is_state else ():
            records["state"][0] = int(np.asarray(first.got).reshape(())) - start
    if is_state:
        records["state"][1:] = records["next_state"][:-1]
    records.setflags(write=False)
    return records


def blank_steps(recording: Recording, phase: str, rows: NDArray[np.void]) -> NDArray[np.void]:
    """Return whole records of recorded actions, without states, observations and rewards."""
    topic = recording.phase(phase).steps.topic
    records = np.zeros(len(rows), recording.layout.rows(topic))
    for name in rows.dtype.names or ():
        if name != "digest":
            records[name] = rows[name]
    return records


def fill_in(records: NDArray[np.void], at: NDArray[np.int64], steps: RedoneSteps) -> None:
    """Fill in what the environment returned for the records at these places.

    Raises:
        CannotRedo: it is not the recorded environment.
    """
    got = steps.require_equal().got
    records[after_step(records.dtype)][at], records["rewards"][at] = got.observations, got.rewards
