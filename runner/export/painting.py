"""The pictures of an episode's states, by what they are made from: T + 1 of them for an episode of T steps.

Each function is a generator of pictures, uint8 [height, width, 3] of one size; close it to free what it uses.
`seen` are the steps of the episode as `observations_of` yields them, one for each picture.
"""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.drawing import svg
from runner.drawing.bars import BarRaster
from runner.drawing.raster import Pixels, SceneRaster
from runner.errors import CannotRedo, RecordingError
from runner.export.values import Seen, Values, observations_of
from runner.recording.messages import Message
from runner.recording.reader import Recording
from runner.recording.spaces import least_number
from runner.replay.steps import recorded_frames
from runner.util.arrays import Floats

if TYPE_CHECKING:
    from PIL import Image

SCENE_SIZE: Final = 480
"""The largest width and height of the picture of a scene."""
MAX_PIXELS: Final = 4096 * 4096
"""The most pixels of a recorded frame."""

Painted = Generator[Pixels, None, None]


def paint_scene(recording: Recording, seen: Iterator[Seen]) -> Painted:
    """Draw the scene in each state, with the way that led there."""
    mdp = recording.mdp
    drawing = svg.drawing_of(mdp)
    assert drawing is not None
    raster = SceneRaster(drawing, SCENE_SIZE, SCENE_SIZE)
    places: deque[NDArray[np.int16]] = deque(maxlen=svg.TRAIL)
    first = least_number(recording.spaces["observation"])
    for observation, _ in seen:
        places.append(drawing.places(mdp, np.array([observation]) - first)[0])
        yield raster.draw(np.stack(places))


def paint_recorded(recording: Recording, phase: str, episode: int, seen: Iterator[Seen]) -> Painted:
    """Show the last frame that was recorded up to each step."""
    last: Message = {}
    shown: Pixels | None = None
    steps = (step for _, step in seen if step is not None)
    for frame in recorded_frames(recording, phase, episode, steps=steps):
        if shown is None or frame is not last:
            where = f"{recording.path}: the frame at {frame['log_time']} ns"
            last = frame
            shown = _like(np.asarray(decoded(frame["data"], where)), shown)
        yield shown


def decoded(data: bytes, where: str, formats: tuple[str, ...] = ("PNG", "JPEG")) -> Image.Image:
    """Return a recorded picture as an RGB image; of a film the first frame.

    Raises:
        RecordingError: it is no picture, or too large; `where` names it.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(data), formats=formats) as image:
            if image.width * image.height > MAX_PIXELS:
                raise RecordingError(f"{where} has {image.width}x{image.height} pixels, too many to show.")
            return image.convert("RGB")
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, ValueError, SyntaxError) as error:
        raise RecordingError(f"{where} cannot be shown ({error}).") from error


def _like(pixels: Pixels, before: Pixels | None) -> Pixels:
    """Return a picture in the size of the one before it, if there is one."""
    from PIL import Image

    if before is None or pixels.shape == before.shape:
        return pixels
    return np.asarray(Image.fromarray(pixels).resize(before.shape[1::-1]))


def paint_redrawn(recording: Recording, phase: str, episode: int, trust: bool, first: int) -> Painted:
    """Draw each state by the environment, from the one after `first` steps on; see `redrawn`."""
    shown: Pixels | None = None
    with closing(redrawn(recording, phase, [episode], trust, first)) as pictures:
        for _, _, frame in pictures:
            shown = _like(frame, shown)
            yield shown


def redrawn(
    recording: Recording, phase: str, episodes: Sequence[int], trust: bool, draw_from: int = 0
) -> Generator[tuple[int, int, Pixels], None, None]:
    """Draw episodes by the environment, made again in a child process and compared with the recording.

    With `draw_from`, the first steps of the only episode are taken without pictures.

    Yields:
        the number of an episode, how many of its steps were taken, and the picture after them.

    Raises:
        CannotRedo: the environment cannot be made again, draws no pictures, or differs from the recording, of
            which no picture comes after that step.
    """
    from runner.replay.environment import rerun_in_child  # loads Gymnasium

    blocks: Any = rerun_in_child(
        recording.path, phase, episodes, render=True, trust=trust, draw_from=draw_from
    )
    waiting = iter(episodes)
    episode = episodes[0]
    t = draw_from
    with closing(blocks):
        for steps in blocks:
            differs = steps.difference
            first = [start.frame for start in steps.starts if start.frame is not None and not draw_from]
            if first:
                episode = next(waiting)
                t = 0
            frames = [*first, *steps.frames]
            if differs is not None:  # the last of them is not a picture of what was recorded
                frames = frames[:-1]
            for frame in frames:
                yield episode, t, frame
                t += 1
            if differs is not None and (differs.phase, differs.episode) != (phase, episode):
                raise CannotRedo(f"The environment differs from the recording before, at {differs}.")
            if differs is not None:
                raise CannotRedo(
                    f"At step {differs.t + 1:,} the environment differs from the recording: {differs.field}: "
                    f"recorded {differs.recorded}, got {differs.got}."
                )


def paint_observation(recording: Recording, seen: Iterator[Seen]) -> Painted:
    """Show the image in each observation; if the first was lost, the second in its place."""
    values = Values(recording)
    lost = 0
    for observation, _ in seen:
        if observation is None:
            lost = 1
            continue
        for _ in range(1 + lost):
            yield values.pixels_in(observation)
        lost = 0


def paint_values(recording: Recording, phase: str, episode: int, seen: Iterator[Seen]) -> Painted:
    """Draw the numbers of each observation and the rewards as bars, each on a scale of its own.

    The steps are read once more before, for the scales.
    """
    learners = recording.agents
    values = Values(recording, "state" if recording.has_states else "observation")
    names = [*values.names, *([f"reward {agent}" for agent in learners] if len(learners) > 1 else ["reward"])]
    unknown, unpaid = np.full(len(values.names), np.nan), np.full(len(learners), np.nan)

    def numbers(steps: Iterator[Seen]) -> Iterator[Floats]:
        for observation, step in steps:
            own = unknown if observation is None else values.numbers_in(observation)
            yield np.append(own, unpaid if step is None else step["rewards"])

    low = np.zeros(len(names))
    high = low
    for now in numbers(observations_of(recording, phase, episode)):
        finite = np.where(np.isfinite(now), now, np.nan)
        low, high = np.fmin(low, finite), np.fmax(high, finite)
    raster = BarRaster(names, low, high)
    for now in numbers(seen):
        yield raster.draw(now)
