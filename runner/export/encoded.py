"""The pictures of an episode as files: frames as they were recorded; others drawn, and encoded here.

    with contextlib.closing(encoded_pictures(path, "train", 12, start=100)) as pictures:
        for data in pictures:                 # of frame 100 and those after it; b"" for the same again
            ...

Where the environment must be made again, that is done in a child process, which ends with the iterator.
"""

from __future__ import annotations

import io
from collections.abc import Generator
from contextlib import closing
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import CannotRedo
from runner.export.pictures import Source, paint, source_of
from runner.export.reports.rendering import sentence
from runner.recording.reader import Recording, open_recording
from runner.replay.steps import recorded_frames
from runner.util.extras import require

_SMALL: Final = 256 * 256
"""Pictures of at most this number of pixels are encoded as PNG, which is exact; larger ones as JPEG."""
_JPEG_QUALITY: Final = 88


def picture_note(recording: Recording, phase: str) -> tuple[bool, str]:
    """Return whether an episode has pictures besides those of a scene, and why not, or why no better ones."""
    source, reason = source_of(recording, phase)
    if source is Source.VALUES:
        return False, f"There is no picture. {sentence(reason)}"
    if source is Source.OBSERVATION:
        return True, f"These are the observations. {sentence(reason)}"
    return source is not Source.SCENE, ""


def encoded_pictures(
    path: Path, phase: str, episode: int, start: int = 0
) -> Generator[bytes | str, None, None]:
    """Yield the pictures of an episode from the frame after `start` steps on; none of a scene.

    Before the first one there may be a note, a text: why they are not drawn by the environment, although it
    could be made again.

    Raises:
        RecordingError: there is no such episode, or the recording is damaged.
        CannotRedo: the environment cannot be made again, or is another one than was recorded, and the
            recording has no pictures of its own.
    """
    with open_recording(path) as recording:
        source, reason, has_failed, painted = paint(recording, phase, episode, first=start)
        if source is Source.VALUES:
            raise CannotRedo(f"There is no picture. {reason}")
        if has_failed:
            yield f"These are the {source}. {reason}"
        if source is Source.RECORDED:
            last = None
            for frame in recorded_frames(recording, phase, episode, start):
                yield b"" if frame is last else frame["data"]
                last = frame
        elif source is not Source.SCENE:
            with closing(painted):
                yield from map(encoded_picture, painted)


def encoded_picture(pixels: NDArray[np.uint8]) -> bytes:
    """Return a picture, [height, width, 3], as a file."""
    image = require("PIL.Image", extra="plots", purpose="a picture").fromarray(pixels)
    buffer = io.BytesIO()
    if image.width * image.height <= _SMALL:
        image.save(buffer, "PNG", compress_level=1)
    else:
        image.save(buffer, "JPEG", quality=_JPEG_QUALITY)
    return buffer.getvalue()
