"""Frames encoded into films by FFmpeg (PyAV), one after the other."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np

from runner.drawing.raster import Pixels, require_packages
from runner.errors import RunnerError
from runner.util.extras import require

if TYPE_CHECKING:
    from av import VideoFrame

LAST_SECONDS: Final = 2.5
"""Duration of the last frame of a GIF, which starts again by itself."""
_MAX_SIDE: Final = 16_000
"""The most pixels on a side that all formats allow."""


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
    counted, shown = (graph.add("movie", filename=str(film)) for _ in range(2))
    palette = graph.add("palettegen")
    coloured = graph.add("paletteuse", dither="none", diff_mode="rectangle")
    counted.link_to(palette)
    shown.link_to(coloured)
    palette.link_to(coloured, 0, 1)
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
