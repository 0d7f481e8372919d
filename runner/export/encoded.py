"""The pictures of an episode as files: frames as they were recorded; others drawn, and encoded here.

    with contextlib.closing(encoded_pictures(path, "train", 12, start=100)) as pictures:
        for data in pictures:                 # of frame 100 and those after it; b"" for the same again
            ...

Where the environment must be made again, that is done in a child process, which ends with the iterator.
"""

from __future__ import annotations

import io
from collections.abc import Generator, Iterator
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from runner.drawing import svg
from runner.errors import CannotRedo
from runner.export.values import Values
from runner.recording.reader import Recording, open_recording
from runner.replay.capabilities import capabilities
from runner.replay.environment import redo_in_child
from runner.replay.redone import RedoneSteps
from runner.replay.steps import reset_of
from runner.util.extras import require

SECONDS: Final = 20.0
"""How long an environment may take for a block of steps, or to be made, before it is given up."""
_END_OF_TIME: Final = 2**62
"""Later than any message, in nanoseconds."""
_SMALL: Final = 256 * 256
"""Pictures of at most this number of pixels are encoded as PNG, which is exact; larger ones as JPEG."""
_JPEG_QUALITY: Final = 88


def why_no_pictures(recording: Recording) -> str:
    """Return why an episode has no pictures, as a sentence; empty if there are some, or a scene is drawn."""
    if recording.is_job:
        return "" if recording.tabular and svg.drawing_of(recording.mdp) else "The environment has no scene."
    found = capabilities(recording)
    if found.picture != "values" or has_images(recording):
        return ""
    return found.reason


def has_images(recording: Recording) -> bool:
    """Return whether observations are images."""
    if recording.kind not in ("transition", "variable"):
        return False
    return Values(recording.spaces["observation"], "observation").image is not None


def encoded_pictures(path: Path, phase: str, episode: int, start: int = 0) -> Generator[bytes, None, None]:
    """Yield the pictures of an episode from the frame after `start` steps on.

    Args:
        path: the recording.
        phase: `train` or `eval`.
        episode: counted over the phase.
        start: steps before the first picture.

    Raises:
        RecordingError: there is no such episode, or the recording is damaged.
        CannotRedo: the environment cannot be made again, or is another one than was recorded.
    """
    with open_recording(path) as recording:
        source = capabilities(recording).picture
        if source == "recorded":
            yield from _recorded(recording, phase, episode, start)
        elif source == "values" and has_images(recording):
            yield from _observed(recording, phase, episode, start)
    if source == "redrawn":
        yield from _redrawn(path, phase, episode, start)


def _recorded(recording: Recording, phase: str, episode: int, start: int) -> Iterator[bytes]:
    """Yield the last frame at each step; a reset's is the last one before the first step."""
    every = _frames_every(recording)
    span = recording.episode_span(phase, episode)
    first = max(0, start - every)
    times = _times(recording, phase, span[max(0, first - 1) :])
    reset = reset_of(recording, phase, episode) if first == 0 else None
    time = times[0] if first else times[0] - 1 if reset is None else int(reset["log_time"])
    frames = recording.decoded(recording.topic(f"/{phase}/frame"), times=range(time, _END_OF_TIME))
    current, following = None, next(frames, None)
    for k in range(first, len(span) + 1):
        time, taken = (times[k - max(1, first)] if k else times[0]), current
        # A frame at the time of the episode's last step may be that of the next reset.
        own = k > 0 and (k % every == 0 or k == len(span))
        while following is not None and (
            following["log_time"] < time or (own and following["log_time"] == time and current is taken)
        ):
            current, following = following, next(frames, None)
        if k < start:
            continue
        if current is None:
            raise CannotRedo(f"No frame was recorded at the beginning of {phase} episode {episode}.")
        yield current["data"] if k == start or current is not taken else b""


def _times(recording: Recording, phase: str, span: range) -> list[int]:
    """Return the log times of steps in nanoseconds."""
    topic = recording.topic(f"/{phase}/step")
    if topic not in recording.dtypes:
        steps = recording.decoded(topic)
        return [step["log_time"] for step in steps if span.start <= step["step"] < span.stop]
    blocks = recording.blocks(topic, span.start, span.stop)
    return [time for block in blocks for time in block["log_time"].tolist()][:: span.step]


def _frames_every(recording: Recording) -> int:
    frames = recording.config.get("frames")
    every = frames.get("every") if isinstance(frames, dict) else None
    return every if isinstance(every, int) and every > 0 else 1


def _observed(recording: Recording, phase: str, episode: int, start: int) -> Iterator[bytes]:
    """Yield the image in each observation."""
    values = Values(recording.spaces["observation"], "observation")
    span = recording.episode_span(phase, episode)
    if start == 0:
        reset = reset_of(recording, phase, episode)
        if reset is None:
            raise CannotRedo(f"The first observation of {phase} episode {episode} was lost.")
        yield _encoded(values.pixels_in(reset["observation"]))
    for step in _steps(recording, phase, span[max(0, start - 1) :]):
        yield _encoded(values.pixels_in(step["next_observation"]))


def _steps(recording: Recording, phase: str, span: range) -> Iterator[Any]:
    topic = recording.topic(f"/{phase}/step")
    if topic not in recording.dtypes:
        yield from islice(recording.transitions(phase), span.start, span.stop)
        return
    for block in recording.blocks(topic, span.start, span.stop):
        yield from block[(span.start - int(block["step"][0])) % span.step :: span.step]


def _redrawn(path: Path, phase: str, episode: int, start: int) -> Iterator[bytes]:
    """Yield pictures that the environment draws when it does the recorded episode again."""
    k = 0
    redone = redo_in_child(path, phase, [episode], render=True, seconds=SECONDS)
    with closing(cast(Generator[RedoneSteps, None, None], redone)) as found:
        for steps in found:
            first = [begin.frame for begin in steps.starts if k == 0 and begin.frame is not None][:1]
            for frame in (*first, *steps.frames):
                if k >= start:
                    yield _encoded(frame)
                k += 1
            if steps.difference is not None:
                raise CannotRedo(
                    f"The environment here is not the recorded one, they differ at {steps.difference}"
                )


def _encoded(pixels: NDArray[np.uint8]) -> bytes:
    """Return a picture, [height, width, 3], as a file."""
    image = require("PIL.Image", extra="plots", purpose="a picture").fromarray(pixels)
    buffer = io.BytesIO()
    if image.width * image.height <= _SMALL:
        image.save(buffer, "PNG", compress_level=1)
    else:
        image.save(buffer, "JPEG", quality=_JPEG_QUALITY)
    return buffer.getvalue()
