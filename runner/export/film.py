"""Films of episodes: their pictures with captions, encoded by FFmpeg (PyAV) while they are made.

Memory does not grow with the length of a film: each picture is captioned, encoded and dropped. The episodes
of a grid are first encoded without loss one after the other, then read side by side.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np

from runner.drawing import palette, raster
from runner.drawing.raster import Pixels, font, shortened, wrapped
from runner.environments.naming import spoken
from runner.errors import RunnerError
from runner.export.pictures import Picture, Pictures
from runner.util.extras import require

if TYPE_CHECKING:
    import av
    from PIL import Image

USUAL_WIDTH: Final = 480
"""Smaller pictures are enlarged to about this width, in pixels."""
MAX_WIDTH: Final = 1280
"""Larger pictures, and grids, are reduced to this width."""
LAST_SECONDS: Final = 2.5
"""Duration of the last frame of a film that starts again by itself."""
_MARGIN: Final = 12
_LINES: Final = 3
"""Lines of text below a picture that change."""


@dataclass(frozen=True)
class Format:
    """How films with one ending are encoded."""

    container: str
    codec: str
    pixels: str
    options: Mapping[str, str]
    container_options: Mapping[str, str] = field(default_factory=dict)


FORMATS: Final = {
    ".mp4": Format("mp4", "h264", "yuv420p", {"preset": "veryfast", "crf": "18"}, {"movflags": "+faststart"}),
    ".webm": Format(
        "webm", "libvpx-vp9", "yuv420p", {"crf": "28", "b": "0", "deadline": "good", "cpu-used": "5"}
    ),
    ".gif": Format("gif", "gif", "pal8", {}, {"final_delay": str(round(100 * LAST_SECONDS))}),
    ".webp": Format(
        "webp", "libwebp_anim", "yuv420p", {"quality": "90", "compression_level": "2"}, {"loop": "0"}
    ),
}
"""By the ending of the file."""
_LOSSLESS: Final = Format("matroska", "libx264rgb", "rgb24", {"preset": "ultrafast", "qp": "0"})


@dataclass(frozen=True, eq=False)
class Shot:
    """An episode in a film."""

    heading: str
    pictures: Pictures


@dataclass(frozen=True)
class Film:
    """What was written."""

    frames: int
    width: int
    height: int
    notes: tuple[str, ...]
    """Why episodes are not shown to their end, one text for each such episode."""


def format_of(path: Path) -> Format:
    """Return how a film is encoded in a file of this name.

    Raises:
        RunnerError: its ending stands for no format of films.
        MissingExtra: PyAV is not installed.
    """
    if path.suffix.lower() not in FORMATS:
        raise RunnerError(
            f"{path}: found the ending {path.suffix!r}, expected one of {', '.join(FORMATS)}: "
            "it chooses the format of the film."
        )
    require("av", extra="film", purpose="a film")
    raster.require_packages()
    return FORMATS[path.suffix.lower()]


def write_film(
    path: Path,
    shot: Shot,
    fps: float,
    width: int | None = None,
    progress: Callable[[int], None] = lambda _: None,
) -> Film:
    """Write the film of an episode.

    Args:
        path: the file to write; its ending chooses the format.
        shot: the episode.
        fps: frames, and thus steps, per second.
        width: of the film in pixels; None for about that of the pictures.
        progress: called with the number of frames that are done.

    Raises:
        RunnerError: the format is unknown, or has no encoder here.
        RecordingError: a picture cannot be made.
        MissingExtra: a package is not installed.
        OSError: the file cannot be written.
    """
    notes: list[str] = []
    with contextlib.closing(shot.pictures), Encoder(path, format_of(path), fps) as film:
        for frame in captioned(shot, width, notes):
            film.add(frame)
            progress(film.frames)
    return Film(film.frames, *film.size, tuple(notes))


def write_grid(
    path: Path,
    shots: Iterator[Shot],
    columns: int,
    fps: float,
    width: int | None = None,
    progress: Callable[[int], None] = lambda _: None,
) -> Film:
    """Write a film of several episodes side by side; each stays at its last frame until all have ended.

    Args:
        path: as for `write_film`.
        shots: the episodes, row by row.
        columns: of the grid.
        fps: as for `write_film`.
        width: of the film in pixels; None for at most `MAX_WIDTH`.
        progress: called with the number of frames of single episodes that are done.

    Raises:
        As for `write_film`.
    """
    form = format_of(path)
    notes: list[str] = []
    with tempfile.TemporaryDirectory(prefix="dualtaxi-film-") as folder, contextlib.ExitStack() as stack:
        films: list[Encoder] = []
        done = 0
        for number, shot in enumerate(shots):
            with contextlib.closing(shot.pictures), Encoder(Path(folder, f"{number}"), _LOSSLESS, fps) as one:
                for frame in captioned(shot, (width or MAX_WIDTH) // columns, notes):
                    one.add(frame)
                    done += 1
                    progress(done)
            films.append(one)
        height, each_width = max(one.size[1] for one in films), max(one.size[0] for one in films)
        rows = -(-len(films) // columns)
        canvas = np.full((rows * height, columns * each_width, 3), 255, np.uint8)
        decoded = [stack.enter_context(contextlib.closing(_frames_of(one.path))) for one in films]
        film = stack.enter_context(Encoder(path, form, fps))
        for _ in range(max(one.frames for one in films)):
            for place, frames in enumerate(decoded):
                top, left = place // columns * height, place % columns * each_width
                for frame in islice(frames, 1):
                    canvas[top : top + frame.shape[0], left : left + frame.shape[1]] = frame
            film.add(canvas)
    return Film(film.frames, *film.size, tuple(notes))


def _frames_of(path: Path) -> Generator[Pixels, None, None]:
    import av

    with av.open(path) as container:
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="rgb24").astype(np.uint8, copy=False)


# --- captions ---------------------------------------------------------------------------------------------


def captioned(shot: Shot, width: int | None, notes: list[str]) -> Iterator[Pixels]:
    """Yield the frames of an episode: each picture with a heading above, and step, action and rewards below.

    Args:
        shot: the episode.
        width: of a frame; None for about that of the pictures.
        notes: gets the note of the last picture, if it has one.
    """
    from PIL import Image

    ground: Image.Image | None = None
    for picture in shot.pictures:
        if ground is None:
            size = _size(picture.pixels.shape[1], picture.pixels.shape[0], width)
            text = 17 if size[0] >= 400 else 12
            line, inner = round(1.4 * text), size[0] - 2 * _MARGIN
            heading = wrapped(shot.heading, inner, text, 2, bold=True)
            top = line * len(heading) + _MARGIN
            ground = Image.new("RGB", (size[0], top + size[1] + _LINES * line + _MARGIN), palette.WHITE)
            _write(ground, heading, _MARGIN // 2, text, bold=True)
        frame = ground.copy()
        frame.paste(_resized(picture.pixels, size), (0, top))
        lines = wrapped(picture.note, inner, text, _LINES) or _lines(shot.pictures, picture)
        _write(frame, [shortened(words, inner, text) for words in lines], top + size[1] + _MARGIN // 2, text)
        notes += [picture.note] if picture.note else []
        yield np.asarray(frame)


def _write(image: Image.Image, lines: Sequence[str], top: int, text: int, bold: bool = False) -> None:
    """Write lines of text, of a size in pixels, from a height down."""
    from PIL import ImageDraw

    pen = ImageDraw.Draw(image)
    for number, words in enumerate(lines):
        pen.text((_MARGIN, top + number * round(1.4 * text)), words, palette.INK, font(text, bold))


def _size(width: int, height: int, wanted: int | None) -> tuple[int, int]:
    """Return the width and height at which a picture is shown."""
    if wanted is None:
        factor = float(max(1, round(USUAL_WIDTH / width))) if width < MAX_WIDTH else MAX_WIDTH / width
    else:
        factor = wanted / width
    return round(width * factor), max(1, round(height * factor))


def _resized(pixels: Pixels, size: tuple[int, int]) -> Image.Image:
    from PIL import Image

    picture = Image.fromarray(pixels)
    if picture.size == size:
        return picture
    exact = size[0] % picture.width == size[1] % picture.height == 0
    return picture.resize(size, Image.Resampling.NEAREST if exact else Image.Resampling.LANCZOS)


def _lines(shown: Pictures, picture: Picture) -> list[str]:
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
    return [
        f"{step}: {picture.action}",
        rewards,
        ", ".join(filter(None, [picture.events, picture.ended])),
    ]


# --- encoding ---------------------------------------------------------------------------------------------


class Encoder:
    """Encodes frames of one size into a file; a context manager.

    Args:
        path: the file to write.
        form: how.
        fps: frames per second.

    Raises:
        RunnerError: there is no encoder for it.
    """

    def __init__(self, path: Path, form: Format, fps: float) -> None:
        import av

        self.path = path
        self.frames = 0
        """Frames that were added."""
        self.size = 0, 0
        """Width and height in pixels, known after the first frame."""
        self._form, self._rate = form, Fraction(fps).limit_denominator(1000)
        try:
            av.codec.Codec(form.codec, "w")
        except av.codec.codec.UnknownCodecError as error:
            raise RunnerError(
                f"{path.suffix}: PyAV has no encoder {form.codec} here; choose another ending, or install "
                "PyAV from its wheel."
            ) from error
        self._container = av.open(path, "w", format=form.container, options=dict(form.container_options))
        self._stream: Any = None
        self._palettes: av.filter.Graph | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None and self._stream is not None:
                if self._palettes is not None:
                    self._encode_indexed(None)
                self._container.mux(self._stream.encode(None))
        finally:
            self._container.close()

    def add(self, pixels: Pixels) -> None:
        """Add a frame, uint8 [height, width, 3]; sides of odd length get a white line more."""
        import av

        height, width, _ = pixels.shape
        if height % 2 or width % 2:
            pixels = np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), constant_values=255)
        if self._stream is None:
            self._open(pixels.shape[1], pixels.shape[0])
        frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
        frame.pts, frame.time_base = self.frames, 1 / self._rate
        self.frames += 1
        if self._palettes is not None:
            self._encode_indexed(frame)
        else:
            self._container.mux(self._stream.encode(frame))

    def _open(self, width: int, height: int) -> None:
        self.size = width, height
        self._stream = self._container.add_stream(self._form.codec, rate=self._rate)
        self._stream.width, self._stream.height = width, height
        self._stream.pix_fmt = self._form.pixels
        self._stream.options = dict(self._form.options)
        if self._form.pixels == "pal8":
            self._palettes = _palette_graph(width, height, 1 / self._rate)

    def _encode_indexed(self, frame: av.VideoFrame | None) -> None:
        """Encode what the graph makes of a frame, or of its end."""
        import av

        assert self._palettes is not None
        self._palettes.vpush(frame)
        with contextlib.suppress(BlockingIOError, av.error.EOFError):
            while True:
                self._container.mux(self._stream.encode(self._palettes.vpull()))


def _palette_graph(width: int, height: int, time_base: Fraction) -> av.filter.Graph:
    """Return a graph that gives each frame the palette of its own 256 best colours."""
    import av.filter

    graph = av.filter.Graph()
    source = graph.add_buffer(width=width, height=height, format=av.VideoFormat("rgb24"), time_base=time_base)
    split = graph.add("split")
    generate = graph.add("palettegen", "stats_mode=single")
    use = graph.add("paletteuse", "new=1:dither=none")
    source.link_to(split)
    split.link_to(generate, 0, 0)
    split.link_to(use, 1, 0)
    generate.link_to(use, 0, 1)
    use.link_to(graph.add("buffersink"))
    graph.configure()
    return graph
