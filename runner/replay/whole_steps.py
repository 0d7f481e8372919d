"""Whole steps of an episode of which only the actions were recorded: rerun, and proved by digests."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording.reader import MAX_EPISODE_BYTES, Recording, open_recording
from runner.recording.schema import PHASE_NAMES
from runner.recording.spaces import least_number
from runner.replay.comparison import RerunSteps
from runner.replay.recorded import RecordedReset


def whole_steps(recording: Recording, phase: str, episode: int) -> NDArray[np.void]:
    """Return the steps of an episode as `Phase.episode_steps` does, from its recorded actions.

    The environment is made again in a child process with limits, from what is installed. The last episodes
    are kept for the next call.

    Raises:
        CannotRedo: the environment cannot be made, or is another one.
        RecordingError: actions of the episode were lost, or it is too long for an array.
    """
    steps = recording.phase(phase).episode(episode)
    if len(steps) * recording.layout.rows(steps.table.topic).itemsize > MAX_EPISODE_BYTES:
        raise RecordingError(
            f"{recording.path}: {phase} episode {episode} has {len(steps):,} steps, too many to rerun for "
            f"an array; `dualtaxi rerecord {recording.run_id}` records them."
        )
    return _whole_steps(recording.path, recording.file.size, phase, episode)


@lru_cache(4)
def _whole_steps(path: Path, _size: int, phase: str, episode: int) -> NDArray[np.void]:
    from runner.replay.environment import rerun_in_child  # loads Gymnasium

    with open_recording(path) as recording:
        recorded = recording.phase(phase).episode(episode)
        if sum(map(len, recorded.rows())) != len(recorded):
            raise RecordingError(f"{path}: steps of {PHASE_NAMES[phase]} episode {episode:,} were lost.")
        parts, state = [np.empty(0, recording.layout.rows(recording.phase(phase).steps.topic))], 0
        for steps in rerun_in_child(path, phase, [episode]):
            records, state = whole_records(recording, steps, state)
            parts.append(records)
    whole = np.concatenate(parts)
    whole.setflags(write=False)
    return whole


def whole_records(recording: Recording, steps: RerunSteps, state: int) -> tuple[NDArray[np.void], int]:
    """Return rerun steps as whole records, and the state after them; `state` is the one before.

    Raises:
        CannotRedo: the environment is not the recorded one.
    """
    records = blank_steps(recording, steps.phase, steps.recorded)
    for name in steps.require_equal().got.dtype.names or ():
        records[name] = steps.got[name]
    if recording.has_states:
        states = np.append(state, records["next_state"])
        for start in steps.starts:
            states[start.row] = state_of(recording, start.reset)
        records["state"], state = states[:-1], int(states[-1])
    return records, state


def state_of(recording: Recording, reset: RecordedReset) -> int:
    """Return the state, from 0, that a reset led to."""
    return int(reset.observation) - least_number(recording.spaces["observation"])


def blank_steps(recording: Recording, phase: str, rows: NDArray[np.void]) -> NDArray[np.void]:
    """Return whole records of recorded actions, without states, observations and rewards."""
    topic = recording.phase(phase).steps.topic
    records = np.zeros(len(rows), recording.layout.rows(topic))
    for name in rows.dtype.names or ():
        if name != "digest":
            records[name] = rows[name]
    return records
