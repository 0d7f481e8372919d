"""Steps by episode, rerun where only their actions were recorded; no compiled code."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from runner.errors import NotInRecording, RecordingError
from runner.recording import schema
from runner.recording.messages import Message, frame_place
from runner.recording.reader import MAX_EPISODE_BYTES, Recording, open_recording
from runner.recording.spaces import Value, least_number
from runner.recording.topic_chunks import FOREVER
from runner.replay.recorded import RecordedReset, reset_before
from runner.util.arrays import Ints, Records

if TYPE_CHECKING:
    from runner.replay.engine import RerunSteps  # loads Gymnasium


def step_of_episode(recording: Recording, episode: int) -> int:
    """Return the number of training steps taken when `episode` episodes had ended.

    Raises:
        RecordingError: fewer episodes were recorded, or the last of them was lost.
    """
    ended = recording.train.episodes.count()
    if not 0 <= episode <= ended:
        raise NotInRecording(
            f"{recording.path}: found {ended:,} training episodes, expected at least {episode:,}."
        )
    if episode == 0:
        return 0
    record = recording.train.episodes.array(episode - 1, episode)
    if not len(record):
        raise RecordingError(f"{recording.path}: training episode {episode - 1} was lost.")
    return int(record[0]["last_step"]) + 1


def transitions_of(recording: Recording, phase: str, episode: int, first: int = 0) -> Iterator[Any]:
    """Yield an episode's steps from number `first` on, as `Phase.transitions` does; memory is bounded."""
    tables = recording.phase(phase)
    if tables.steps.dtype is not None:
        for block in episode_blocks(recording, phase, episode, first):
            yield from block
        return
    yield from islice(tables.transitions(episode), first, None)


def episode_blocks(recording: Recording, phase: str, episode: int, first: int = 0) -> Iterator[Records]:
    """Yield an episode's steps from number `first` on in blocks, where they have one size.

    Raises:
        RecordingError: the recording has no such episode, or steps of it were lost.
    """
    tables = recording.phase(phase)
    if tables.steps.are_actions:
        yield whole_steps(recording, phase, episode)[first:]
        return
    steps = tables.episode(episode)
    count = min(first, len(steps))
    for rows in steps.rows(first):
        count += len(rows)
        yield rows
    if count != len(steps):
        raise RecordingError(
            f"{recording.path}: {len(steps) - count:,} of the {len(steps):,} steps of "
            f"{tables.title} episode {episode} were lost."
        )


def steps_of(recording: Recording, phase: str, episode: int) -> Records:
    """Return an episode's steps as one array, where they have one size.

    Raises:
        CannotRedo: only its actions were recorded, and its environment cannot be had.
    """
    tables = recording.phase(phase)
    if tables.steps.are_actions:
        return whole_steps(recording, phase, episode)
    return tables.episode_steps(episode)


# --- of actions alone ---------------------------------------------------------------------------------


def whole_steps(recording: Recording, phase: str, episode: int) -> Records:
    """Return the steps of an episode as `Phase.episode_steps` does, from its recorded actions.

    The environment is made again in a child process with limits, from what is installed. The last episodes
    are kept for the next call.

    Raises:
        CannotRedo: the environment cannot be made, or is another one.
        RecordingError: actions of the episode were lost, or it is too long for an array.
    """
    steps = recording.phase(phase).episode(episode)
    if len(steps) * recording.layout.row_dtype(steps.table.topic).itemsize > MAX_EPISODE_BYTES:
        raise RecordingError(
            f"{recording.path}: {phase} episode {episode} has {len(steps):,} steps, too many to rerun for "
            f"an array; `dualtaxi rerecord {recording.run_id}` records them."
        )
    return _whole_steps(recording.path, recording.path.stat().st_mtime_ns, phase, episode)


@lru_cache(4)
def _whole_steps(path: Path, _changed: int, phase: str, episode: int) -> Records:
    from runner.replay.environment import rerun_in_child  # loads Gymnasium

    with open_recording(path) as recording:
        recorded = recording.phase(phase).episode(episode)
        if sum(map(len, recorded.rows())) != len(recorded):
            raise RecordingError(
                f"{path}: steps of {schema.PHASE_NAMES[phase]} episode {episode:,} were lost."
            )
        parts = [np.empty(0, recording.layout.row_dtype(recorded.table.topic))]
        states = np.zeros(1, np.int64)
        for steps in rerun_in_child(path, phase, [episode]):
            parts.append(whole_records(recording, steps))
            put_states(recording, parts[-1], states, [(start.row, start.reset) for start in steps.starts])
    whole = np.concatenate(parts)
    whole.setflags(write=False)
    return whole


def blank_steps(recording: Recording, phase: str, rows: Records) -> Records:
    """Return whole records of recorded actions, without states, observations and rewards."""
    topic = recording.phase(phase).steps.topic
    records = np.zeros(len(rows), recording.layout.row_dtype(topic))
    for name in rows.dtype.names or ():
        if name != "digest":
            records[name] = rows[name]
    return records


def whole_records(recording: Recording, steps: RerunSteps) -> Records:
    """Return rerun steps as whole records, but for the states before them.

    Raises:
        CannotRedo: the environment is not the recorded one.
    """
    records = blank_steps(recording, steps.phase, steps.recorded)
    for name in steps.require_equal().got.dtype.names or ():
        records[name] = steps.got[name]
    return records


def put_states(
    recording: Recording,
    records: Records,
    states: Ints,
    resets: Iterable[tuple[int, RecordedReset]],
) -> None:
    """Put the state before each step into whole records, where they have states.

    Args:
        states: the states after the last step of each environment; becomes that after these.
        resets: the row before which each reset was.
    """
    if recording.has_states:
        before = np.concatenate([states, records["next_state"]])
        for row, reset in resets:
            before[row] = first_of(recording, reset)
        records["state"], states[:] = before[: len(records)], before[len(records) :]


def first_of(recording: Recording, reset: RecordedReset) -> Value:
    """Return the first observation of a reset as steps have it: the state, counted from 0."""
    if not recording.has_states:
        return reset.observation
    return int(reset.observation) - least_number(recording.spaces["observation"])


# --- next to the steps -----------------------------------------------------------------------------------


def recorded_frames(recording: Recording, phase: str, episode: int, start: int = 0) -> Iterator[Message]:
    """Yield the last frame that was recorded up to each step of an episode, as a decoded message.

    Args:
        recording: the run.
        phase: `train` or `eval`.
        episode: its number in the phase.
        start: steps before the first frame; 0 for the frame after the reset.

    Raises:
        RecordingError: the recording has no such episode, steps of it were lost, or its first frame.
    """
    recorded = recording.phase(phase).episode(episode)
    first = max(0, start - frames_every(recording))
    steps = transitions_of(recording, phase, episode, max(0, first - 1))
    times = (int(step["log_time"]) for step in steps)
    # The frames of a vector come at the end of a round.
    turns = recorded.table.round_of(recorded.first)
    later = (turns[-1] - recorded.first) * schema.STEP_NANOSECONDS
    reset = reset_before(recording, phase, episode) if first == 0 else None
    if (earliest := next(times, None)) is None:
        return
    begin = earliest - len(turns) * schema.STEP_NANOSECONDS if reset is None else reset.time
    frames = (
        (int(frame["log_time"]), frame_place(frame)[1], frame)
        for frame in recording.phase(phase).frames.decoded(times=range(max(0, begin), FOREVER))
        if frame_place(frame)[0] == recorded.place
    )
    frame = None
    following = next(frames, None)
    after_steps = (time + later for time in chain([earliest], times))
    for t, time in enumerate(after_steps if first else chain([earliest], after_steps), first):
        # After the reset there may be several frames, the last one shows the state; after a step one.
        while following is not None and following[0] < time:
            frame = following[2]
            following = next(frames, None)
        if t and following is not None and following[0] == time and not following[1]:
            frame = following[2]
            following = next(frames, None)
        if frame is None:
            raise RecordingError(f"{recording.path}: the first frame of {phase} episode {episode} is lost.")
        if t >= start:
            yield frame


def frames_every(recording: Recording) -> int:
    """Return after how many steps a frame was recorded, as its configuration says."""
    frames = recording.config.get("frames")
    every = frames.get("every") if isinstance(frames, Mapping) else None
    return every if isinstance(every, int) and every > 0 else 1


def environments_with_frames(recording: Recording, phase: str) -> Sequence[int]:
    """Return the environments that have frames in a phase; a job has none."""
    if not recording.phase(phase).frames:
        return ()
    frames = recording.config.get("frames")
    environments = frames.get("environments") if isinstance(frames, Mapping) else None
    return environments if isinstance(environments, list) else range(recording.environments)


def last_step(recording: Recording) -> int:
    """Return the last training step at which the tables can be had."""
    snapshots = max((snapshot.step for snapshot in recording.snapshots()), default=0)
    return max(snapshots, recording.train.steps.count())
