"""A short film of a recorded episode: the grid, with step, actions and rewards below it.

Everything that never moves, and each thing, is rendered once, from the SVG of `drawing.svg`, by resvg; Pillow
composes a frame of these pictures, trails and text. The font is the one that Matplotlib includes, so that a
film looks the same everywhere.
"""

from __future__ import annotations

import functools
import importlib.util
import math
import textwrap
from collections.abc import Callable, Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from runner.drawing import palette, svg
from runner.environments.mdp import Mdp
from runner.environments.naming import (
    deeds_in_words,
    events_in_words,
    exploration_in_words,
    spoken,
    states_in_words,
)
from runner.errors import RecordingError
from runner.export.reports.episode import Episode
from runner.recording.reader import Recording
from runner.util.extras import missing, require

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from PIL import Image
    from PIL.ImageFont import FreeTypeFont

WIDTH: Final = 480
"""Pixels."""
LAST_SECONDS: Final = 2.5
"""Duration of the last frame."""
_FONT: Final = 17
_LINE: Final = 24
_MARGIN: Final = 14
_LETTER: Final = 0.615
"""Width of an average letter of DejaVu Sans, rounded up, as a share of the font's size."""
_MAX_GRID_HEIGHT: Final = 480
_COLOURS: Final = 128
_SPRITE: Final = 130
"""Side of the square in which a thing is drawn, in hundredths of a cell."""
_FINE: Final = 4
"""Trails are drawn at this multiple of the resolution, for smooth edges."""


def write_gif(
    path: Path,
    recording: Recording,
    episode: Episode,
    steps_a_second: float = 2.0,
    width: int = WIDTH,
    progress: Callable[[int], None] = lambda _: None,
) -> int:
    """Write the film of an episode, and return its number of frames.

    Args:
        path: the file to write.
        recording: the run.
        episode: an episode of the run.
        steps_a_second: the speed.
        width: in pixels.
        progress: called with the number of frames that are done.

    Raises:
        MissingExtra: a package that draws it is not installed.
        OSError: the file cannot be written.
    """
    require_packages()
    from PIL import Image

    film = Film(recording, episode, width)
    colours = _common_colours([film.frame(number) for number in (0, len(film) // 2, len(film) - 1)])

    def frames() -> Iterator[Image.Image]:
        for number in range(len(film)):
            yield film.frame(number).quantize(palette=colours, dither=Image.Dither.NONE)
            progress(number + 1)

    others = frames()
    durations = [round(1000 / steps_a_second)] * (len(film) - 1) + [round(1000 * LAST_SECONDS)]
    options: dict[str, Any] = {"duration": durations, "loop": 0, "optimize": True}
    next(others).save(path, format="GIF", save_all=True, append_images=others, **options)
    return len(film)


def require_packages() -> None:
    """Check that the packages that a film needs are installed.

    Raises:
        MissingExtra: one is not.
    """
    require("resvg_py", "PIL", extra="plots", purpose="a film")
    _fonts()


def require_states(recording: Recording) -> None:
    """Check that the recording knows the states of its environment, which are drawn.

    Raises:
        RecordingError: it is a loop over an environment whose states are unknown.
    """
    if not recording.tabular:
        raise RecordingError(
            f"{recording.path}: found a loop over {recording.environment.get('env_id')}, expected a tabular "
            "environment, whose states can be drawn; `dualtaxi view` shows the numbers and pictures that it "
            "recorded."
        )


class Film:
    """The frames of an episode of T steps, T + 1 of them, as images.

    Args:
        recording: the run.
        episode: an episode of the run.
        width: in pixels.
    """

    def __init__(self, recording: Recording, episode: Episode, width: int = WIDTH) -> None:
        from PIL import Image

        mdp, drawing = recording.mdp, svg.drawing_of(recording.mdp)
        letters = int((width - 2 * _MARGIN) / (_FONT * _LETTER))
        self._captions = [
            [line for text in caption for line in textwrap.wrap(text, letters) or [""]]
            for caption in captions_of(mdp, recording.agents, episode, scene=drawing is not None)
        ]
        heading = textwrap.wrap(f"{recording.title}: {episode.title}", letters)
        top = 10 + _LINE * len(heading)
        self._grid = (
            None if drawing is None else _Grid(drawing, drawing.places(mdp, episode.states), top, width)
        )
        self._text_top = top + (self._grid.height if self._grid else 0) + 8
        height = self._text_top + _LINE * max(map(len, self._captions)) + 8
        self._background = Image.new("RGB", (width, height), palette.WHITE)
        _write(self._background, heading, 4, bold=True)
        if self._grid:
            cells = self._grid.still()
            self._background.paste(cells, (self._grid.left, self._grid.top), cells)

    def __len__(self) -> int:
        return len(self._captions)

    @property
    def grid_box(self) -> tuple[int, int, int, int]:
        """The place of the grid in each frame: left, top, right, bottom; zeros without a scene."""
        grid = self._grid
        return (grid.left, grid.top, grid.left + grid.width, grid.top + grid.height) if grid else (0, 0, 0, 0)

    def frame(self, number: int) -> Image.Image:
        """Return a frame, RGB: the state after a number of steps."""
        frame = self._background.copy()
        if self._grid:
            self._grid.draw(frame, number)
        _write(frame, self._captions[number], self._text_top)
        return frame


class _Grid:
    """The part of each frame that shows the grid.

    Args:
        drawing: the drawing of the scene.
        places: int16 [frames, things, 3], as `Drawing.places` returns them.
        top: pixels above the grid.
        width: width of the frame in pixels.
    """

    def __init__(self, drawing: svg.Drawing, places: NDArray[np.int16], top: int, width: int) -> None:
        self._drawing, self._places = drawing, places
        self._scale = min((width - 2 * _MARGIN) / drawing.width, _MAX_GRID_HEIGHT / drawing.height)
        self.width, self.height = round(drawing.width * self._scale), round(drawing.height * self._scale)
        self.left, self.top = (width - self.width) // 2, top
        self._sprites: dict[tuple[int, int], Image.Image] = {}
        self._segments: dict[tuple[int, ...], tuple[int, int, NDArray[np.uint8]]] = {}

    def still(self) -> Image.Image:
        """Return the cells, landmarks and walls."""
        box = f"0 0 {self._drawing.width} {self._drawing.height}"
        return _rendered(self._drawing.still(), box, self.width, self.height)

    def draw(self, frame: Image.Image, number: int) -> None:
        """Draw the trails and the things of a frame."""
        trail = self._places[max(0, number + 1 - svg.TRAIL) : number + 1]
        for mover in self._drawing.movers:
            frame.paste(self._drawing.colour(mover), (self.left, self.top), self._trail(trail[:, mover, :2]))
        for thing in self._drawing.order():
            x, y, percent = self._places[number, thing].tolist()
            if (thing, percent) not in self._sprites:
                self._sprites[thing, percent] = self._sprite(thing, percent)
            sprite = self._sprites[thing, percent]
            left = round(self.left + x * self._scale - sprite.width / 2)
            top = round(self.top + y * self._scale - sprite.height / 2)
            frame.paste(sprite, (left, top), sprite)

    def _sprite(self, thing: int, percent: int) -> Image.Image:
        """Return the picture of a thing at a size, centred on a transparent ground."""
        pixels = math.ceil(_SPRITE * self._scale)
        half = pixels / self._scale / 2
        shape = f'<g transform="scale({percent / 100:g})">{self._drawing.shape(thing)}</g>'
        return _rendered(shape, f"{-half} {-half} {2 * half} {2 * half}", pixels, pixels)

    def _trail(self, points: NDArray[np.int16]) -> Image.Image:
        """Return the coverage of each pixel by a trail through points [frames, 2]."""
        from PIL import Image

        mask = np.zeros((self.height, self.width), np.uint8)
        for ends in {tuple(pair) for pair in np.column_stack([points[:-1], points[1:]]).tolist()}:
            if ends not in self._segments:
                self._segments[ends] = self._segment(ends)
            x, y, cover = self._segments[ends]
            part = mask[y : y + cover.shape[0], x : x + cover.shape[1]]
            np.maximum(part, cover[: part.shape[0], : part.shape[1]], out=part)
        return Image.fromarray(mask)

    def _segment(self, ends: tuple[int, ...]) -> tuple[int, int, NDArray[np.uint8]]:
        """Return the corner of a line with round ends, and the coverage of the pixels from there."""
        from PIL import Image, ImageDraw

        scaled = np.array(ends, np.float64).reshape(2, 2) * self._scale
        radius = svg.TRAIL_WIDTH * self._scale / 2
        corner = np.maximum(np.floor(scaled.min(axis=0) - radius), 0)
        width, height = np.ceil(scaled.max(axis=0) + radius - corner).astype(int).tolist()
        large = Image.new("L", (width * _FINE, height * _FINE))
        points = [tuple(point) for point in ((scaled - corner) * _FINE).tolist()]
        pen, ink = ImageDraw.Draw(large), round(255 * svg.TRAIL_OPACITY)
        pen.line(points, fill=ink, width=round(2 * radius * _FINE))
        for point in points:
            pen.circle(point, radius * _FINE, fill=ink)
        return int(corner[0]), int(corner[1]), np.asarray(large.reduce(_FINE))


def captions_of(mdp: Mdp, learners: Sequence[str], episode: Episode, scene: bool = True) -> list[list[str]]:
    """Return the caption of each frame: step, actions, rewards, events, and the state without a scene."""
    actions = deeds_in_words(mdp)
    totals = np.cumsum(episode.rewards, axis=0)
    captions = [[f"step 0 of {episode.length:,}", "the episode begins", ""]]
    for k in range(episode.steps):
        explorers = exploration_in_words(int(episode.explored[k]), learners)
        explored = f" ({explorers})" if explorers else ""
        step = f"step {k + 1:,} of {episode.length:,}: {actions[episode.actions[k]]}{explored}"
        rewards = _rewards(learners, episode.rewards[k].tolist(), totals[k].tolist())
        captions.append([step, rewards, events_in_words(mdp, int(episode.events[k]))])
    if episode.steps < episode.length:
        captions[-1].append(f"the film ends here, after {episode.steps:,} of {episode.length:,} steps")
    if not scene:
        words = states_in_words(mdp)[episode.states]
        captions = [[str(state), *caption] for state, caption in zip(words, captions, strict=True)]
    return captions


def _rewards(learners: Sequence[str], rewards: list[float], totals: list[float]) -> str:
    if len(rewards) == 1:
        return f"reward {rewards[0]:+g}, sum {totals[0]:+g}"
    each = [f"{spoken(name)} {own:+g}" for name, own in zip(learners, rewards, strict=True)]
    return f"reward {', '.join(each)}; sum {sum(totals):+g}"


def render_svg(picture: str, width: int, height: int) -> Image.Image:
    """Return an SVG as an RGBA image of a width and a height in pixels."""
    import resvg_py
    from PIL import Image

    files: list[Any] = [str(path) for path in _fonts()]
    png = resvg_py.svg_to_bytes(
        svg_string=picture,
        width=width,
        height=height,
        font_files=files,
        skip_system_fonts=True,
        font_family="DejaVu Sans",
    )
    return Image.open(BytesIO(bytes(png))).convert("RGBA")


def _rendered(content: str, box: str, width: int, height: int) -> Image.Image:
    """Return elements as an RGBA image of the part of the plane in a box."""
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}" width="{width}" height="{height}">'
    return render_svg(f"{head}<style>{svg.STYLE}</style>{content}</svg>", width, height)


def _fonts() -> tuple[Path, Path]:
    """Return the files of the regular and the bold font, without importing Matplotlib."""
    found = importlib.util.find_spec("matplotlib")
    if found is None or found.origin is None:
        raise missing("matplotlib", "plots", "a film")
    folder = Path(found.origin).parent / "mpl-data" / "fonts" / "ttf"
    return folder / "DejaVuSans.ttf", folder / "DejaVuSans-Bold.ttf"


@functools.cache
def _font(bold: bool) -> FreeTypeFont:
    from PIL import ImageFont

    return ImageFont.truetype(str(_fonts()[bold]), _FONT, layout_engine=ImageFont.Layout.BASIC)


def _write(image: Image.Image, lines: list[str], top: int, bold: bool = False) -> None:
    from PIL import ImageDraw

    pen = ImageDraw.Draw(image)
    for number, line in enumerate(lines):
        baseline = (_MARGIN, top + _LINE * (number + 1) - 7)
        pen.text(baseline, line, fill=palette.INK, font=_font(bold), anchor="ls")


def _common_colours(frames: list[Image.Image]) -> Image.Image:
    """Return a palette for all frames: the most common colours of some of them."""
    from PIL import Image

    pixels = np.concatenate([np.asarray(frame).reshape(-1, 3) for frame in frames]).astype(np.uint32)
    packed, counts = np.unique(pixels @ np.array([1 << 16, 1 << 8, 1], np.uint32), return_counts=True)
    colours = packed[np.argsort(-counts), np.newaxis] >> np.array([16, 8, 0], np.uint32) & 255
    # Pillow compares colours by their upper bits only: keep the most common of those that share them.
    _, first = np.unique(colours >> 3, axis=0, return_index=True)
    common = Image.new("P", (1, 1))
    common.putpalette(colours[np.sort(first)[:_COLOURS]].astype(np.uint8).tobytes())
    return common
