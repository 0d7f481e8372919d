"""The pictures of an episode as files: frames as they were recorded; others drawn, and encoded here.

    with contextlib.closing(encoded_pictures(path, "train", 12, start=100)) as pictures:
        for data in pictures:                 # of frame 100 and those after it; b"" for the same again
            ...

Where the environment must be made again, that is done in a child process, which ends with the iterator.
Reports contain some of them, made small.
Without making an environment, an episode is a small drawing: the way through its scene, or its return.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.drawing import palette, svg
from runner.drawing.raster import image_bytes
from runner.errors import CannotRedo, RunnerError
from runner.export.pictures import PictureSource, decoded, paint, source_of
from runner.recording import schema
from runner.recording.reader import Recording, open_recording
from runner.replay.steps import recorded_frames
from runner.util.extras import require
from runner.util.humanize import sentence

_SMALL: Final = 256 * 256
"""Pictures of at most this number of pixels are encoded as PNG, which is exact; larger ones as JPEG."""
MAX_PICTURES: Final = 300
"""Pictures of an episode in a report."""
_MAX_SIDE: Final = 320
"""Pixels of the longer side of a picture."""
_WEBP_QUALITY: Final = 75

DRAWING_WIDTH, DRAWING_HEIGHT = 160, 120
MAX_DRAWN_STEPS: Final = 100_000
"""Steps after which a picture says no more."""
_POINTS: Final = 200


def picture_note(recording: Recording, phase: str) -> tuple[bool, str]:
    """Return whether an episode has pictures besides those of a scene, and why not, or why no better ones."""
    source, reason = source_of(recording, phase)
    if source is PictureSource.VALUES:
        return False, f"There is no picture. {sentence(reason)}"
    if source is PictureSource.OBSERVATION:
        return True, f"These are the observations. {sentence(reason)}"
    return source is not PictureSource.SCENE, ""


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
        if source is PictureSource.VALUES:
            raise CannotRedo(f"There is no picture. {reason}")
        if has_failed:
            yield f"These are the {source}. {reason}"
        if source is PictureSource.RECORDED:
            last = None
            for frame in recorded_frames(recording, phase, episode, start):
                yield b"" if frame is last else frame["data"]
                last = frame
        elif source is not PictureSource.SCENE:
            with closing(painted):
                yield from map(encoded_picture, painted)


def encoded_picture(pixels: NDArray[np.uint8]) -> bytes:
    """Return a picture, [height, width, 3], as a file."""
    require("PIL", extra="plots", purpose="a picture")
    return image_bytes(pixels, "png" if pixels.shape[0] * pixels.shape[1] <= _SMALL else "jpeg")


# --- thumbnails ---------------------------------------------------------------------------------------


@dataclass
class Thumbnails:
    """Some pictures of an episode, and which of them each frame shows."""

    pictures: list[str] = field(default_factory=list)
    """Addresses that contain the pictures: `data:image/webp;base64,...`."""
    picture: list[int] = field(default_factory=list)
    """The index of each frame's picture: that of its own step, or of one before it."""
    picture_note: str = ""
    """Why there are none, or no further ones."""


def thumbnails(path: Path, phase: str, episode: int, frames: int) -> Thumbnails:
    """Return pictures of the first frames of an episode."""
    require("PIL.Image", extra="plots", purpose="the pictures of a report")
    result = Thumbnails()
    every = -(-frames // MAX_PICTURES)
    latest = b""
    try:
        with closing(encoded_pictures(path, phase, episode)) as pictures:
            for data in pictures:
                if isinstance(data, str):
                    result.picture_note = data
                    continue
                k = len(result.picture)
                if k == frames:
                    break
                latest = data or latest
                if k % every == 0 and latest:
                    result.pictures.append(_small(latest))
                    latest = b""
                result.picture.append(len(result.pictures) - 1)
    except RunnerError as error:
        result.picture_note = str(error)
    if result.pictures:
        result.picture += [len(result.pictures) - 1] * (frames - len(result.picture))
    return result


def _small(data: bytes) -> str:
    """Return a picture as an address that contains it, made small.

    Raises:
        RecordingError: it is no picture, or too large.
    """
    image = decoded(data, "A recorded frame")
    image.thumbnail((_MAX_SIDE, _MAX_SIDE))
    buffer = io.BytesIO()
    options: dict[str, object] = {"quality": _WEBP_QUALITY, "method": 2}
    image.save(buffer, "WEBP", **options)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def thumbnail(recording: Recording, phase: str, episode: int, title: str) -> str:
    """Return an episode as SVG: its last state with the ways of the movers, or its return over its steps.

    No environment is made: without recorded steps the picture says so.

    Raises:
        RecordingError: there is no such episode, or the recording is damaged.
    """
    tables = recording.phase(phase)
    is_empty = recording.leaves_out_steps or tables.steps.are_actions
    if is_empty:
        where = f'x="{DRAWING_WIDTH / 2}" y="{DRAWING_HEIGHT / 2}" text-anchor="middle"'
        return svg.picture(
            DRAWING_WIDTH,
            DRAWING_HEIGHT,
            title,
            f'<text {where} font-size="13" fill="#808080">no steps</text>',
        )
    drawing = svg.drawing_of(recording.mdp) if recording.tabular else None
    states = []
    rewards = [np.zeros(1)]
    count = 0
    for rows in tables.episode(episode).rows(0):
        rewards.append(rows["rewards"].sum(axis=1))
        if drawing is not None:
            recording.mdp.check_steps(rows, str(recording.path), schema.PHASE_NAMES[phase])
            states += [rows["state"], rows["next_state"][-1:]]
        count += len(rows)
        if count >= MAX_DRAWN_STEPS:
            break
    if drawing is not None and states:
        places = drawing.places(recording.mdp, np.concatenate(states).astype(np.int64))
        return drawing.frame(places[-1], title, places)
    returns = np.concatenate(rewards).cumsum()
    return _curve(returns[:: -(-len(returns) // _POINTS)].tolist(), title)


def _curve(values: Sequence[float], title: str) -> str:
    """Return a curve without axes."""
    finite = [value for value in values if np.isfinite(value)]
    low, high = min(finite, default=0.0), max(finite, default=0.0)
    across = DRAWING_WIDTH / max(1, len(values) - 1)
    up = (DRAWING_HEIGHT - 20) / ((high - low) or 1.0)
    points = " ".join(
        f"{k * across:.1f},{DRAWING_HEIGHT - 10 - (value - low) * up:.1f}"
        for k, value in enumerate(values)
        if np.isfinite(value)
    )
    line = f'<polyline fill="none" stroke="{palette.agent(0)}" stroke-width="2" points="{points}"/>'
    return svg.picture(DRAWING_WIDTH, DRAWING_HEIGHT, title, line)
