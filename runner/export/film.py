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

from runner.drawing import palette
from runner.drawing.raster import Pixels, font, require_packages, shortened, wrapped
from runner.environments.naming import spoken
from runner.errors import RunnerError
from runner.export.pictures import EpisodePicture, Pictures, PictureSource
from runner.util.extras import require

if TYPE_CHECKING:
    from av import VideoFrame
    from PIL import Image

LAST_SECONDS: Final = 2.5
"""Duration of the last frame of a GIF, which starts again by itself."""
_MAX_SIDE: Final = 16_000
"""The most pixels on a side that all formats allow."""

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


@dataclass(frozen=True)
class Format:
    """How films with one ending are encoded."""

    container: str
    codec: str
    pixels: str
    options: Mapping[str, str]
    container_options: Mapping[str, str] = field(default_factory=dict)


FORMATS: Final = {
    # Looking further ahead saves little space, and keeps more frames in memory.
    ".mp4": Format(
        "mp4",
        "h264",
        "yuv420p",
        {"preset": "veryfast", "crf": "18", "rc-lookahead": "5"},
        {"movflags": "+faststart"},
    ),
    ".webm": Format(
        "webm",
        "libvpx-vp9",
        "yuv420p",
        {"crf": "28", "b": "0", "deadline": "realtime", "cpu-used": "6", "lag-in-frames": "0"},
    ),
    ".gif": Format("gif", "gif", "pal8", {}, {"final_delay": str(round(100 * LAST_SECONDS))}),
    # What hardly changes is transparent. FFmpeg's other encoder, libwebp_anim, keeps every frame in memory.
    ".webp": Format(
        "webp",
        "libwebp",
        "yuva420p",
        {"quality": "90", "compression_level": "2", "cr_threshold": "100", "cr_size": "16"},
        {"loop": "0"},
    ),
}
"""By the ending of the file."""
LOSSLESS: Final = Format("mov", "qtrle", "rgb24", {})
"""For films that are read again."""


def format_of(path: Path) -> Format:
    """Return how a film is encoded in a file of this name.

    Raises:
        RunnerError: its ending stands for no format of films.
    """
    if path.suffix.lower() not in FORMATS:
        raise RunnerError(
            f"{path}: found the ending {path.suffix!r}, expected one of {', '.join(FORMATS)}: "
            "it chooses the format of the film."
        )
    require("av", extra="film", purpose="a film")
    require_packages()
    return FORMATS[path.suffix.lower()]


class Encoder:
    """Encodes frames of one size into a file; a context manager."""

    def __init__(self, path: Path, form: Format, fps: float) -> None:
        import av

        self.path = path
        self.frames = 0
        """Frames that were added."""
        self.size = 0, 0
        """Width and height in pixels, known after the first frame."""
        self._form = form
        self._rate = Fraction(fps).limit_denominator(1000)
        try:
            av.codec.Codec(form.codec, "w")
        except av.codec.codec.UnknownCodecError as error:
            raise RunnerError(
                f"{path.suffix}: PyAV has no encoder {form.codec} here; choose another ending, or install "
                "PyAV from its wheel."
            ) from error
        self._container = av.open(path, "w", format=form.container, options=dict(form.container_options))
        self._stream: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None and self._stream is not None:
                self._container.mux(self._stream.encode(None))
        finally:
            self._container.close()

    def add(self, pixels: Pixels) -> None:
        """Add a frame, uint8 [height, width, 3]; sides of odd length get a white line more."""
        import av

        height, width, _ = pixels.shape
        if height % 2 or width % 2:
            pixels = np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), constant_values=255)
        self.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24"))

    def encode(self, frame: VideoFrame) -> None:
        """Add a frame."""
        if self._stream is None:
            self._open(frame.width, frame.height)
        frame.pts = self.frames
        frame.time_base = 1 / self._rate
        self.frames += 1
        self._container.mux(self._stream.encode(frame))

    def _open(self, width: int, height: int) -> None:
        if max(width, height) > _MAX_SIDE:
            raise RunnerError(
                f"the film: found frames of {width}x{height} pixels, expected at most {_MAX_SIDE:,} on a "
                "side; choose a smaller width, or fewer episodes."
            )
        self.size = width, height
        self._stream = self._container.add_stream(self._form.codec, rate=self._rate)
        self._stream.width, self._stream.height = width, height
        self._stream.pix_fmt = self._form.pixels
        self._stream.options = dict(self._form.options)


@contextlib.contextmanager
def encoder(path: Path, fps: float) -> Iterator[Encoder]:
    """Yield an encoder into a file, in the format that its ending chooses.

    A GIF is encoded without loss first, as its colours are chosen for all frames together.
    """
    form = format_of(path)
    if form.codec != "gif":
        with Encoder(path, form, fps) as film:
            yield film
        return
    with tempfile.TemporaryDirectory(prefix="dualtaxi-film-") as folder:
        with Encoder(Path(folder, "film"), LOSSLESS, fps) as film:
            yield film
        with Encoder(path, form, fps) as gif:
            for frame in _with_palette(film.path):
                gif.encode(frame)


def _with_palette(film: Path) -> Iterator[VideoFrame]:
    """Yield the frames of a film in the 256 colours that suit it best; it is read twice."""
    import av

    graph = av.filter.Graph()
    counted, frames = (graph.add("movie", filename=str(film)) for _ in range(2))
    colours = graph.add("palettegen")
    coloured = graph.add("paletteuse", dither="none", diff_mode="rectangle")
    counted.link_to(colours)
    frames.link_to(coloured)
    colours.link_to(coloured, 0, 1)
    coloured.link_to(graph.add("buffersink"))
    graph.configure()
    with contextlib.suppress(av.EOFError):
        while True:
            yield graph.vpull()


def frames_of(path: Path) -> Generator[Pixels, None, None]:
    """Yield the frames of a film."""
    import av

    with av.open(path) as container:
        container.streams.video[0].thread_count = 1  # each thread would keep frames of its own
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="rgb24").astype(np.uint8, copy=False)


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
            with (
                contextlib.closing(shot.pictures),
                Encoder(Path(folder, f"{number}"), LOSSLESS, fps) as lossless,
            ):
                captions = captioned(shot, (width or MAX_WIDTH) // columns)
                for frame in islice(captions, max_frames):
                    lossless.add(frame)
                    done += 1
                    progress(done)
            films.append(lossless)
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


def _lines(pictures: Pictures, picture: EpisodePicture) -> list[str]:
    """Return the text below a picture without a note."""
    step = f"step {picture.t:,} of {pictures.steps:,}"
    if not picture.t:
        return [step, "the episode begins"]
    total = sum(picture.returns)
    if len(picture.rewards) == 1:
        rewards = f"reward {picture.rewards[0]:+g}, sum {total:+g}"
    else:
        by_agent = (
            f"{spoken(name)} {reward:+.3g}"
            for name, reward in zip(pictures.learners, picture.rewards, strict=True)
        )
        rewards = f"sum {total:+.5g}; {', '.join(by_agent)}"
    return [f"{step}: {picture.action}", rewards, ", ".join(filter(None, [picture.events, picture.ended]))]
