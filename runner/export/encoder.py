"""Frames encoded into films by FFmpeg (PyAV), one after the other."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from runner.drawing.raster import Pixels, require_packages
from runner.errors import RunnerError
from runner.util.arrays import Array
from runner.util.extras import require

LAST_SECONDS: Final = 2.5
"""Duration of the last frame of a GIF, which starts again by itself."""
_MAX_SIDE: Final = 16_000
"""The most pixels on a side that all formats allow."""
_COLOURS: Final = 256
_FAR: Final = 24
"""A colour is far from another if they are this far apart, of 255."""
_MORE: Final = 0.01
"""The share of a frame that may be far from the palette, in addition to what it was when it was chosen."""


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
LOSSLESS: Final = Format("matroska", "libx264rgb", "rgb24", {"preset": "ultrafast", "qp": "0"})
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
        self._palette = _Palette() if form.pixels == "pal8" else None

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
        if self._stream is None:
            self._open(pixels.shape[1], pixels.shape[0])
        coloured: Any = pixels if self._palette is None else self._palette.indexed(pixels)
        frame = av.VideoFrame.from_ndarray(coloured, format="pal8" if self._palette else "rgb24")
        frame.pts, frame.time_base = self.frames, 1 / self._rate
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


class _Palette:
    """The colours of a GIF: the most common ones of a frame, until too much of a later one is far from them.

    Frames that share a palette need little space, as only what changes is stored. Colours are compared by
    their upper five bits.
    """

    def __init__(self) -> None:
        self._colours = np.zeros((_COLOURS, 4), np.uint8)
        """Alpha, red, green, blue."""
        self._nearest = np.zeros(1 << 15, np.uint8)
        """The colour nearest to each that five bits of red, green and blue make."""
        self._is_far = np.ones(1 << 15, np.bool_)
        self._accepted = 0.0
        """The share of a frame that may be far from the palette."""

    def indexed(self, pixels: Pixels) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return the number of each pixel's colour, [height, width], and the colours, [256, 4]."""
        parts = pixels.astype(np.uint16) >> 3
        codes = parts[..., 0] << 10 | parts[..., 1] << 5 | parts[..., 2]
        if self._is_far[codes].mean() > self._accepted:
            self._choose(codes.ravel(), pixels.reshape(-1, 3))
        return self._nearest[codes], self._colours

    def _choose(self, codes: Array, pixels: NDArray[np.uint8]) -> None:
        """Set the palette to the most common colours of a frame, each the mean of those of one code."""
        counts = np.bincount(codes, minlength=1 << 15)
        common = np.argsort(-counts, kind="stable")[:_COLOURS]
        common = common[counts[common] > 0]
        sums = [np.bincount(codes, channel, 1 << 15)[common] for channel in pixels.T]
        chosen = (np.stack(sums, axis=1) / counts[common, np.newaxis]).round().astype(np.float32)
        self._colours = np.full((_COLOURS, 4), 255, np.uint8)
        self._colours[: len(chosen), 1:] = chosen
        middles = (
            np.stack(np.unravel_index(np.arange(1 << 15), (32, 32, 32)), axis=1).astype(np.float32) * 8 + 4
        )
        squares = (chosen**2).sum(
            axis=1
        ) - 2 * middles @ chosen.T  # without those of `middles`, equal in a row
        self._nearest = squares.argmin(axis=1).astype(np.uint8)
        self._nearest[common] = np.arange(len(common))
        self._is_far = np.abs(chosen[self._nearest] - middles).max(axis=1) > _FAR
        self._accepted = float(self._is_far[codes].mean()) + _MORE


def frames_of(path: Path) -> Generator[Pixels, None, None]:
    """Yield the frames of a film."""
    import av

    with av.open(path) as container:
        container.streams.video[0].thread_count = 1  # each thread would keep frames of its own
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="rgb24").astype(np.uint8, copy=False)
