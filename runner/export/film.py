"""Films of episodes: their pictures with captions, encoded by FFmpeg (PyAV) while they are made.

Memory does not grow with the length of a film: each picture is captioned, encoded and dropped. The episodes
of a grid are first encoded without loss one after the other, then read side by side.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from runner.drawing import palette
from runner.drawing.raster import Pixels, font, shortened, wrapped
from runner.environments.naming import spoken
from runner.export.encoder import LOSSLESS, Encoder, encoder, frames_of
from runner.export.pictures import EpisodePicture, Pictures, PictureSource

if TYPE_CHECKING:
    from PIL import Image

USUAL_WIDTH: Final = 480
"""Smaller pictures are enlarged to about this width, in pixels."""
MAX_WIDTH: Final = 1280
"""Larger pictures, and grids, are reduced to this width."""
MAX_HEIGHT: Final = 2048
"""The largest height of a picture."""
_SCENE_FPS: Final = 4.0
"""Frames per second of a drawn scene, whose steps are large."""
_FPS: Final = 30.0
_LEAST_WIDTH: Final = 160
"""Frames are at least this wide, for their text."""
_MARGIN: Final = 12
_LINES: Final = 3
"""Lines of text below a picture that change."""


@dataclass(frozen=True, eq=False)
class Shot:
    """An episode in a film."""

    heading: str
    pictures: Pictures
    first: int = 0
    """The step at which the film begins."""


def usual_speed(source: PictureSource) -> float:
    """Return the frames per second of a film whose pictures are made from a source."""
    return _SCENE_FPS if source is PictureSource.SCENE else _FPS


def write_film(
    path: Path,
    shot: Shot,
    fps: float,
    width: int | None,
    progress: Callable[[int], None],
) -> Encoder:
    """Write the film of an episode; the ending of `path` chooses the format.

    `fps` are frames, and thus steps, per second; `width` is in pixels, None for about that of the pictures;
    `progress` is called with the number of frames that are done. The encoder is returned for its facts.
    """
    with contextlib.closing(shot.pictures), encoder(path, fps) as film:
        for frame in captioned(shot, width):
            film.add(frame)
            progress(film.frames)
    return film


def write_grid(
    path: Path,
    shots: Iterator[Shot],
    columns: int,
    fps: float,
    width: int | None,
    progress: Callable[[int], None],
    max_frames: int | None,
) -> Encoder:
    """Write a film of several episodes side by side; each stays at its last frame until all have ended.

    The arguments are those of `write_film`, of episodes row by row; `progress` counts the frames of single
    episodes, a `width` of None is at most `MAX_WIDTH`, and no episode has more than `max_frames`.
    """
    with tempfile.TemporaryDirectory(prefix="dualtaxi-film-") as folder, contextlib.ExitStack() as stack:
        films: list[Encoder] = []
        done = 0
        for number, shot in enumerate(shots):
            with contextlib.closing(shot.pictures), Encoder(Path(folder, f"{number}"), LOSSLESS, fps) as one:
                captions = captioned(shot, (width or MAX_WIDTH) // columns)
                for frame in islice(captions, max_frames):
                    one.add(frame)
                    done += 1
                    progress(done)
            films.append(one)
        height, each_width = max(film.size[1] for film in films), max(film.size[0] for film in films)
        rows = -(-len(films) // columns)
        canvas = np.full((rows * height, columns * each_width, 3), 255, np.uint8)
        decoded = [stack.enter_context(contextlib.closing(frames_of(film.path))) for film in films]
        film = stack.enter_context(encoder(path, fps))
        for _ in range(max(film.frames for film in films)):
            for place, frames in enumerate(decoded):
                top = place // columns * height
                left = place % columns * each_width
                for frame in islice(frames, 1):
                    canvas[top : top + frame.shape[0], left : left + frame.shape[1]] = frame
            film.add(canvas)
    return film


# --- captions ---------------------------------------------------------------------------------------------


def captioned(shot: Shot, width: int | None) -> Iterator[Pixels]:
    """Yield the frames of an episode: each picture with a heading above, and step, action and rewards below.

    `width` is that of a frame, None for about that of the pictures.
    """
    from PIL import Image

    ground: Image.Image | None = None
    for picture in shot.pictures:
        if picture.t < shot.first and not picture.note:
            continue
        if ground is None:
            size = _size(picture.pixels.shape[1], picture.pixels.shape[0], width)
            frame_width = max(size[0], _LEAST_WIDTH)
            text = 17 if frame_width >= 400 else 12
            line = round(1.4 * text)
            inner = frame_width - 2 * _MARGIN
            heading = wrapped(shot.heading, inner, text, 2, bold=True)
            top = line * len(heading) + _MARGIN
            height = top + size[1] + _LINES * line + _MARGIN
            ground = Image.new("RGB", (frame_width, height), palette.WHITE)
            _write(ground, heading, _MARGIN // 2, text, bold=True)
        frame = ground.copy()
        frame.paste(_resized(picture.pixels, size), (0, top))
        lines = wrapped(picture.note, inner, text, _LINES) or _lines(shot.pictures, picture)
        _write(frame, [shortened(words, inner, text) for words in lines], top + size[1] + _MARGIN // 2, text)
        yield np.asarray(frame)


def _write(image: Image.Image, lines: Sequence[str], top: int, text: int, bold: bool = False) -> None:
    """Write lines of text, of a size in pixels, from a height down."""
    from PIL import ImageDraw

    pen = ImageDraw.Draw(image)
    for number, words in enumerate(lines):
        pen.text((_MARGIN, top + number * round(1.4 * text)), words, palette.INK, font(text, bold))


def _size(width: int, height: int, wanted: int | None) -> tuple[int, int]:
    """Return the width and height at which a picture is shown."""
    if wanted is not None:
        factor = wanted / width
    elif width < MAX_WIDTH:
        factor = float(max(1, round(USUAL_WIDTH / width)))
    else:
        factor = MAX_WIDTH / width
    factor = min(factor, MAX_HEIGHT / height)
    return max(1, round(width * factor)), max(1, round(height * factor))


def _resized(pixels: Pixels, size: tuple[int, int]) -> Image.Image:
    from PIL import Image

    picture = Image.fromarray(pixels)
    if picture.size == size:
        return picture
    exact = size[0] % picture.width == size[1] % picture.height == 0
    return picture.resize(size, Image.Resampling.NEAREST if exact else Image.Resampling.LANCZOS)


def _lines(shown: Pictures, picture: EpisodePicture) -> list[str]:
    """Return the text below a picture without a note."""
    step = f"step {picture.t:,} of {shown.steps:,}"
    if not picture.t:
        return [step, "the episode begins"]
    total = sum(picture.returns)
    if len(picture.rewards) == 1:
        rewards = f"reward {picture.rewards[0]:+g}, sum {total:+g}"
    else:
        each = (
            f"{spoken(name)} {reward:+.3g}"
            for name, reward in zip(shown.learners, picture.rewards, strict=True)
        )
        rewards = f"sum {total:+.5g}; {', '.join(each)}"
    return [f"{step}: {picture.action}", rewards, ", ".join(filter(None, [picture.events, picture.ended]))]
