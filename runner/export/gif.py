"""A short film of a recorded episode: the grid with step, actions and rewards below it.

What does not move (title, cells, walls, landmarks) and each thing are rendered once, from the SVG of
`svg.Drawing`, by resvg; a frame is put together from these pictures, trails and text by Pillow. The font is
the one that Matplotlib brings along, so that a film looks the same everywhere.
"""

from __future__ import annotations

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
from runner.environments.naming import events_in_words, exploration_in_words, spoken, states_in_words
from runner.errors import RecordingError
from runner.export.reports.episode import Episode, deeds_in_words
from runner.recording.reader import Recording
from runner.util.extras import missing, require

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from PIL import Image
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont

WIDTH: Final = 480
"""Pixels across."""
MOST_STEPS: Final = 200
"""Steps that a film shows, unless told."""
LAST_SECONDS: Final = 2.5
"""For how long the last frame stays."""
_FONT: Final = 17
_LINE: Final = 24
_MARGIN: Final = 14
_LETTER: Final = 0.615
"""Width of a letter of DejaVu Sans, on average and generously, as a share of the font's size."""
_TALLEST: Final = 480
_COLOURS: Final = 128
_SPRITE: Final = 130
"""Side of the square in which a thing is drawn, in hundredths of a cell."""
_FINE: Final = 4
"""How much finer than the frame a trail is drawn, for smooth edges."""


def write_gif(
    path: Path,
    recording: Recording,
    episode: Episode,
    steps_a_second: float = 2.0,
    width: int = WIDTH,
    progress: Callable[[int], None] = lambda _: None,
) -> int:
    """Write the film of an episode, and return how many frames it has.

    Args:
        path: where to.
        recording: the run.
        episode: of that run.
        steps_a_second: how fast it is shown.
        width: in pixels.
        progress: called with the number of frames that are done.

    Raises:
        MissingExtra: a package that draws it is not installed.
        OSError: the file cannot be written.
    """
    require_packages()
    from PIL import Image

    film = Film(recording, episode, width)
    palette = _palette([film.frame(number) for number in (0, len(film) // 2, len(film) - 1)])

    def indexed() -> Iterator[Image.Image]:
        for number in range(len(film)):
            yield film.frame(number).quantize(palette=palette, dither=Image.Dither.NONE)
            progress(number + 1)

    frames = indexed()
    durations = [round(1000 / steps_a_second)] * (len(film) - 1) + [round(1000 * LAST_SECONDS)]
    next(frames).save(
        path,
        format="GIF",
        save_all=True,
        append_images=frames,
        duration=durations,
        loop=0,
        optimize=True,
    )
    return len(film)


def require_packages() -> None:
    """Refuse to begin where a package is missing that a film needs.

    Raises:
        MissingExtra: it is.
    """
    require("resvg_py", "PIL", extra="plots", purpose="a film")
    _fonts()


def require_states(recording: Recording) -> None:
    """Refuse a loop over an environment whose states are not told, so that there is nothing to draw.

    Raises:
        RecordingError: it is one.
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
        episode: of that run.
        width: in pixels.
    """

    def __init__(self, recording: Recording, episode: Episode, width: int = WIDTH) -> None:
        mdp = recording.mdp
        title = f"{recording.title}: {episode.title}"
        has_scene = mdp.scene is not None and mdp.scene_cells is not None
        room = int((width - 2 * _MARGIN) / (_FONT * _LETTER))
        self._captions = [
            [line for text in caption for line in textwrap.wrap(text, room) or [""]]
            for caption in captions_of(mdp, recording.agents, episode, scene=has_scene)
        ]
        heads = textwrap.wrap(title, room)
        top = 10 + _LINE * len(heads)
        self._grid: _Grid | None = None
        if has_scene and mdp.scene is not None:
            drawing = svg.Drawing(mdp.scene)
            self._grid = _Grid(drawing, drawing.places(mdp, episode.states), top, width)
        self._text_top = top + (self._grid.height if self._grid else 0) + 8
        height = self._text_top + _LINE * max(map(len, self._captions)) + 8
        self._font = _font(bold=False)
        self._still = self._background(heads, width, height)

    def __len__(self) -> int:
        return len(self._captions)

    @property
    def grid_box(self) -> tuple[int, int, int, int]:
        """Where the grid is in each frame: left, top, right, bottom; nothing without a scene."""
        grid = self._grid
        return (grid.left, grid.top, grid.left + grid.width, grid.top + grid.height) if grid else (0, 0, 0, 0)

    def frame(self, number: int) -> Image.Image:
        """Return a frame, RGB: the state after so many steps."""
        from PIL import ImageDraw

        frame = self._still.copy()
        if self._grid:
            self._grid.draw(frame, number)
        _write(ImageDraw.Draw(frame), self._captions[number], self._text_top, self._font)
        return frame

    def _background(self, heads: list[str], width: int, height: int) -> Image.Image:
        """Return what all frames have in common."""
        from PIL import Image, ImageDraw

        still = Image.new("RGB", (width, height), palette.WHITE)
        _write(ImageDraw.Draw(still), heads, 4, _font(bold=True))
        if self._grid:
            grid = self._grid.still()
            still.paste(grid, (self._grid.left, self._grid.top), grid)
        return still


class _Grid:
    """The part of each frame that shows the grid.

    Args:
        drawing: of the scene.
        places: int16 [frames, things, 3], as `Drawing.places` returns them.
        top: pixels above the grid.
        width: of the frame, in pixels.
    """

    def __init__(self, drawing: svg.Drawing, places: NDArray[np.int16], top: int, width: int) -> None:
        self._drawing, self._places = drawing, places
        self._scale = min((width - 2 * _MARGIN) / drawing.width, _TALLEST / drawing.height)
        self.width, self.height = round(drawing.width * self._scale), round(drawing.height * self._scale)
        self.left, self.top = (width - self.width) // 2, top
        self._order = drawing.order()
        self._sprites: dict[tuple[int, int], Image.Image] = {}
        self._segments: dict[tuple[int, ...], tuple[int, int, NDArray[np.uint8]]] = {}

    def still(self) -> Image.Image:
        """Return cells, landmarks and walls."""
        drawing = self._drawing
        box = f"0 0 {drawing.width} {drawing.height}"
        return _rendered(drawing.still(), box, self.width, self.height)

    def draw(self, frame: Image.Image, number: int) -> None:
        """Draw the trails and the things of a frame."""
        trail = self._places[max(0, number + 1 - svg.TRAIL) : number + 1]
        for mover in self._drawing.movers:
            frame.paste(self._drawing.colour(mover), (self.left, self.top), self._trail(trail[:, mover, :2]))
        for thing in self._order:
            x, y, percent = self._places[number, thing].tolist()
            sprite = self._sprite(thing, percent)
            corner = (
                round(self.left + x * self._scale - sprite.width / 2),
                round(self.top + y * self._scale - sprite.height / 2),
            )
            frame.paste(sprite, corner, sprite)

    def _sprite(self, thing: int, percent: int) -> Image.Image:
        """Return the picture of a thing at a size, with a transparent ground around its middle."""
        key = (thing, percent)
        if key not in self._sprites:
            pixels = math.ceil(_SPRITE * self._scale)
            half = pixels / self._scale / 2
            shape = f'<g transform="scale({percent / 100:g})">{self._drawing.shape(thing)}</g>'
            box = f"{-half} {-half} {2 * half} {2 * half}"
            self._sprites[key] = _rendered(shape, box, pixels, pixels)
        return self._sprites[key]

    def _trail(self, points: NDArray[np.int16]) -> Image.Image:
        """Return how strongly each pixel is covered by a trail through points [frames, 2]."""
        from PIL import Image

        mask = np.zeros((self.height, self.width), np.uint8)
        ends = {tuple(pair) for pair in np.column_stack([points[:-1], points[1:]]).tolist()}
        for segment in ends:
            x, y, cover = self._segment(segment)
            part = mask[y : y + cover.shape[0], x : x + cover.shape[1]]
            np.maximum(part, cover[: part.shape[0], : part.shape[1]], out=part)
        return Image.fromarray(mask)

    def _segment(self, ends: tuple[int, ...]) -> tuple[int, int, NDArray[np.uint8]]:
        """Return the corner of a line with round ends, and how strongly it covers the pixels from there."""
        if ends not in self._segments:
            from PIL import Image, ImageDraw

            ax, ay, bx, by = (value * self._scale for value in ends)
            radius = svg.TRAIL_WIDTH * self._scale / 2
            x, y = (max(0, math.floor(min(pair) - radius)) for pair in ((ax, bx), (ay, by)))
            size = tuple(
                math.ceil(max(pair) + radius) - corner for pair, corner in (((ax, bx), x), ((ay, by), y))
            )
            large = Image.new("L", (size[0] * _FINE, size[1] * _FINE))
            points = [((px - x) * _FINE, (py - y) * _FINE) for px, py in ((ax, ay), (bx, by))]
            pen = ImageDraw.Draw(large)
            pen.line(points, fill=round(255 * svg.TRAIL_OPACITY), width=round(2 * radius * _FINE))
            for px, py in points:
                pen.circle((px, py), radius * _FINE, fill=round(255 * svg.TRAIL_OPACITY))
            self._segments[ends] = x, y, np.asarray(large.reduce(_FINE))
        return self._segments[ends]


def captions_of(mdp: Mdp, learners: Sequence[str], episode: Episode, scene: bool = True) -> list[list[str]]:
    """Return for each frame what is written below it: step, actions, rewards, events."""
    actions = deeds_in_words(mdp)
    totals = np.cumsum(episode.rewards, axis=0)
    captions = [[f"step 0 of {episode.length:,}", "the episode begins", ""]]
    for k in range(episode.steps):
        explorers = exploration_in_words(int(episode.explored[k]), learners)
        explored = f" ({explorers})" if explorers else ""
        rewards = _rewards(learners, episode.rewards[k].tolist(), totals[k].tolist())
        captions.append(
            [
                f"step {k + 1:,} of {episode.length:,}: {actions[episode.actions[k]]}{explored}",
                rewards,
                events_in_words(mdp, int(episode.events[k])),
            ]
        )
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
    """Return an SVG as an RGBA image of so many pixels."""
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
    """Return elements as an RGBA image of the part of the plane that `box` names."""
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}" width="{width}" height="{height}">'
    return render_svg(f"{head}<style>{svg.STYLE}</style>{content}</svg>", width, height)


def _fonts() -> tuple[Path, Path]:
    """Return the files of the regular and the bold font, found without loading Matplotlib.

    Raises:
        MissingExtra: Matplotlib is not installed.
    """
    found = importlib.util.find_spec("matplotlib")
    if found is None or found.origin is None:
        raise missing("matplotlib", "plots", "a film")
    folder = Path(found.origin).parent / "mpl-data" / "fonts" / "ttf"
    return folder / "DejaVuSans.ttf", folder / "DejaVuSans-Bold.ttf"


def _font(bold: bool) -> FreeTypeFont:
    from PIL import ImageFont

    return ImageFont.truetype(str(_fonts()[bold]), _FONT, layout_engine=ImageFont.Layout.BASIC)


def _write(pen: ImageDraw, lines: list[str], top: int, font: FreeTypeFont) -> None:
    for number, line in enumerate(lines):
        baseline = (_MARGIN, top + _LINE * (number + 1) - 7)
        pen.text(baseline, line, fill=palette.INK, font=font, anchor="ls")


def _palette(frames: list[Image.Image]) -> Image.Image:
    """Return one palette for all frames: the commonest colours of some of them."""
    from PIL import Image

    pixels = np.concatenate([np.asarray(frame).reshape(-1, 3) for frame in frames]).astype(np.uint32)
    packed, counts = np.unique(pixels @ np.array([1 << 16, 1 << 8, 1], np.uint32), return_counts=True)
    colours = packed[np.argsort(-counts), np.newaxis] >> np.array([16, 8, 0], np.uint32) & 255
    # Pillow looks colours up by their upper bits only: of those that are alike keep the commonest.
    _, first = np.unique(colours >> 3, axis=0, return_index=True)
    common = colours[np.sort(first)[:_COLOURS]]
    palette = Image.new("P", (1, 1))
    palette.putpalette(common.astype(np.uint8).tobytes())
    return palette
