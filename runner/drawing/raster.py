"""Drawings as pixels: SVG by resvg, the grid of a scene composed of cached parts, and numbers as bars.

Everything that never moves, and each thing, is rendered once, from the SVG of `drawing.svg`; Pillow composes
a picture of these parts and of trails. The font is the one that Matplotlib includes, so that a picture looks
the same everywhere.
"""

from __future__ import annotations

import functools
import importlib.util
import math
from collections.abc import Iterable, Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from runner.drawing import palette, svg
from runner.util.arrays import Floats
from runner.util.extras import missing, require
from runner.util.humanize import UNKNOWN

if TYPE_CHECKING:
    from PIL import Image
    from PIL.ImageFont import FreeTypeFont

Pixels = NDArray[np.uint8]
"""A picture: [height, width, 3], red, green and blue."""
_SPRITE: Final = 130
"""Side of the square in which a thing is drawn, in hundredths of a cell."""
_FINE: Final = 3
"""Trails are drawn at this multiple of the resolution, for smooth edges."""
_JPEG_QUALITY: Final = 90
_PURPOSE: Final = "a picture"
MAX_BARS: Final = 24
"""The most values that a picture shows."""
BARS_WIDTH: Final = 480
"""Width of a picture in pixels."""
_LINE: Final = 20
_TEXT: Final = 13
_MARGIN: Final = 10
_BARS: Final = 160, 390
"""The columns of pixels between which bars are drawn; names are on their left, values on their right."""


class SceneRaster:
    """Draws states of a scene as pixels, in pictures of at most this width and height."""

    def __init__(self, drawing: svg.SvgDrawing, width: int, height: int) -> None:
        self._drawing = drawing
        self._scale = min(width / drawing.width, height / drawing.height)
        self._size = round(drawing.width * self._scale), round(drawing.height * self._scale)
        self._sprites: dict[tuple[int, int], Image.Image] = {}

    @functools.cached_property
    def _ground(self) -> Image.Image:
        """The cells, landmarks and walls on white."""
        from PIL import Image

        cells = _rendered(
            self._drawing.still(), f"0 0 {self._drawing.width} {self._drawing.height}", *self._size
        )
        ground = Image.new("RGB", self._size, palette.WHITE)
        ground.paste(cells, (0, 0), cells)
        return ground

    def draw(self, places: NDArray[np.int16]) -> Pixels:
        """Return the picture of the last of some states, and of the trail that leads there.

        The places are int16 [states, things, 3], as `Drawing.places` returns them: at least the last
        `svg.TRAIL`.
        """
        picture = self._ground.copy()
        trail = places[-svg.TRAIL :]
        for mover in self._drawing.movers:
            picture.paste(self._drawing.colour(mover), (0, 0), self._trail(trail[:, mover, :2]))
        for thing in self._drawing.order():
            x, y, percent = places[-1, thing].tolist()
            if (thing, percent) not in self._sprites:
                self._sprites[thing, percent] = self._sprite(thing, percent)
            sprite = self._sprites[thing, percent]
            left = round(x * self._scale - sprite.width / 2)
            top = round(y * self._scale - sprite.height / 2)
            picture.paste(sprite, (left, top), sprite)
        return np.asarray(picture)

    def _sprite(self, thing: int, percent: int) -> Image.Image:
        """Return the picture of a thing at a size, centred on a transparent ground."""
        pixels = math.ceil(_SPRITE * self._scale)
        half = pixels / self._scale / 2
        shape = f'<g transform="scale({percent / 100:g})">{self._drawing.shape(thing)}</g>'
        return _rendered(shape, f"{-half} {-half} {2 * half} {2 * half}", pixels, pixels)

    def _trail(self, points: NDArray[np.int16]) -> Image.Image:
        """Return the coverage of each pixel by a trail with round ends through points [states, 2]."""
        from PIL import Image, ImageDraw

        fine = Image.new("L", (self._size[0] * _FINE, self._size[1] * _FINE))
        pen = ImageDraw.Draw(fine)
        ink = round(255 * svg.TRAIL_OPACITY)
        scale = self._scale * _FINE
        ends = [(x * scale, y * scale) for x, y in points.tolist()]
        pen.line(ends, fill=ink, width=round(svg.TRAIL_WIDTH * scale))
        for end in {*ends}:
            pen.circle(end, svg.TRAIL_WIDTH * scale / 2, fill=ink)
        return fine.reduce(_FINE)


def draw_bars(names: Sequence[str], low: Floats, high: Floats, rows: Iterable[Floats]) -> Iterator[Pixels]:
    """Draw the values of each row as horizontal bars from zero; one that is not finite has no bar.

    A bar lies between the lowest and the highest that its value gets. Values after the first `MAX_BARS` are
    counted in a line, and not drawn.
    """
    from PIL import Image, ImageDraw

    bars = min(len(names), MAX_BARS)
    low, high = np.minimum(low[:bars], 0), np.maximum(high[:bars], 0)
    left, right = _BARS
    scale = (right - left) / np.where(high > low, high - low, 1)  # pixels of a unit
    zeros = (left - low * scale).tolist()
    lines = bars + (len(names) > MAX_BARS)
    ground = Image.new("RGB", (BARS_WIDTH, lines * _LINE + 2 * _MARGIN), palette.WHITE)
    pen = ImageDraw.Draw(ground)
    for k, name in enumerate(names[:bars]):
        text = shortened(name, left - 2 * _MARGIN, _TEXT)
        pen.text((_MARGIN, _middle(k)), text, palette.INK, font(_TEXT), anchor="lm")
        zero = round(zeros[k])
        pen.line((zero, _middle(k) - _LINE // 2, zero, _middle(k) + _LINE // 2), palette.GREY)
    if lines > bars:
        text = f"and {len(names) - bars:,} more values"
        pen.text((_MARGIN, _middle(bars)), text, palette.GREY, font(_TEXT), anchor="lm")
    for values in rows:
        picture = ground.copy()
        pen = ImageDraw.Draw(picture)
        for k, value in enumerate(values[:bars].tolist()):
            if np.isfinite(value):
                start, end = sorted((zeros[k], zeros[k] + value * float(scale[k])))
                colour = palette.BLUE if value > 0 else palette.ORANGE
                pen.rectangle((start, _middle(k) - 6, end, _middle(k) + 6), colour)
            text = UNKNOWN if np.isnan(value) else f"{value:.4g}"
            pen.text((right + _MARGIN, _middle(k)), text, palette.INK, font(_TEXT), anchor="lm")
        yield np.asarray(picture)


def _middle(row: int) -> int:
    return _MARGIN + row * _LINE + _LINE // 2


def render_svg(picture: str, width: int, height: int) -> Image.Image:
    """Return an SVG as an RGBA image of a width and a height in pixels."""
    import resvg_py
    from PIL import Image

    files: list[str] = [str(path) for path in _fonts()]
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


def image_bytes(pixels: Pixels, kind: str) -> bytes:
    """Return a picture as the bytes of a `png` (exact) or `jpeg` (smaller, and not exact)."""
    from PIL import Image

    buffer = BytesIO()
    options: dict[str, int] = {"compress_level": 1} if kind == "png" else {"quality": _JPEG_QUALITY}
    Image.fromarray(pixels).save(buffer, kind, **options)
    return buffer.getvalue()


# --- text ---------------------------------------------------------------------------------------------


@functools.cache
def font(size: int, bold: bool = False) -> FreeTypeFont:
    """Return DejaVu Sans of a size in pixels."""
    from PIL import ImageFont

    return ImageFont.truetype(str(_fonts()[bold]), size, layout_engine=ImageFont.Layout.BASIC)


def shortened(text: str, width: float, size: int, bold: bool = False) -> str:
    """Return a text that is at most `width` pixels wide, its end replaced by an ellipsis if it is longer."""
    drawn = font(size, bold)
    text = text[: int(width)]
    if drawn.getlength(text) <= width:
        return text
    while text and drawn.getlength(f"{text}…") > width:
        text = text[:-1]
    return f"{text}…"


def wrapped(text: str, width: float, size: int, lines: int, bold: bool = False) -> list[str]:
    """Return a text in at most `lines` lines that are at most `width` pixels wide."""
    words = text[: lines * int(width)].split()
    result: list[str] = []
    while words and len(result) < lines - 1:
        count = 1
        while count < len(words) and font(size, bold).getlength(" ".join(words[: count + 1])) <= width:
            count += 1
        result.append(shortened(" ".join(words[:count]), width, size, bold))
        words = words[count:]
    return [*result, shortened(" ".join(words), width, size, bold)] if words else result


# --- packages -----------------------------------------------------------------------------------------


def require_packages() -> None:
    """Check that the packages that draw pictures are installed."""
    require("resvg_py", "PIL", extra="plots", purpose=_PURPOSE)
    _fonts()


def _fonts() -> tuple[Path, Path]:
    """Return the files of the regular and the bold font, without importing Matplotlib."""
    spec = importlib.util.find_spec("matplotlib")
    if spec is None or spec.origin is None:
        raise missing("matplotlib", "plots", _PURPOSE)
    folder = Path(spec.origin).parent / "mpl-data" / "fonts" / "ttf"
    return folder / "DejaVuSans.ttf", folder / "DejaVuSans-Bold.ttf"
