"""Pictures, films and histograms as scripts give them to a logger, as a recording holds them."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.drawing.raster import image_bytes
from runner.errors import ConfigError
from runner.loops.options import pillow
from runner.loops.values import as_array, numbers_of
from runner.util.arrays import Array
from runner.util.extras import require

_MAX_PIXELS: Final = 1 << 28
"""The most pixels of a film, of all frames together."""


@dataclass(frozen=True)
class Picture:
    """A picture, or a film."""

    frames: NDArray[np.uint8]
    """[frames, height, width, 3]."""
    fps: float = 4.0
    """Frames per second of a film."""

    def __post_init__(self) -> None:
        shape = self.frames.shape
        if self.frames.dtype != np.uint8 or len(shape) != 4 or shape[3] != 3 or not self.frames.size:
            raise ConfigError(
                f"picture: found {self.frames.dtype} of shape {list(shape)}, expected uint8 of "
                "[frames, height, width, 3]"
            )
        if self.frames.size > 3 * _MAX_PIXELS or max(shape[1:3]) >= 1 << 14:
            raise ConfigError(
                f"picture: found {shape[0]:,} frames of {shape[1]:,} x {shape[2]:,} pixels, expected at most "
                f"{_MAX_PIXELS:,} pixels, and 16,383 a side: take fewer frames, or make them smaller"
            )
        if not isinstance(self.fps, int | float | np.number) or not self.fps > 0:
            raise ConfigError(f"picture: found {self.fps!r} frames per second, expected a number above 0")

    @property
    def nbytes(self) -> int:
        """The size of its pixels."""
        return self.frames.nbytes

    @property
    def format(self) -> str:
        """`png`, or `webp` for a film."""
        return "png" if len(self.frames) == 1 else "webp"

    def encoded(self) -> bytes:
        """Return the picture as PNG, the film as animated WebP."""
        if len(self.frames) == 1:
            return image_bytes(self.frames[0], "png")
        buffer = io.BytesIO()
        images = map(pillow().fromarray, self.frames)
        duration = max(1, round(1000 / self.fps))
        next(images).save(
            buffer, "webp", save_all=True, append_images=images, duration=duration, loop=0, method=0
        )
        return buffer.getvalue()


BINS: Final = 64


def picture_of(value: Any, dataformats: str = "HWC", fps: float = 4.0) -> Picture:
    """Return an array, tensor, Pillow image, Matplotlib figure or image file as a picture or film.

    Floats are taken as 0 to 1, whole numbers as 0 to 255, booleans as black and white. Gray becomes RGB, and
    the alpha channel of RGBA is dropped.

    Args:
        value: the picture.
        dataformats: what the axes of an array are, in TensorBoard's letters: N or T (frames), C, H, W.
        fps: frames per second of a film.

    Raises:
        ConfigError: it is no picture.
        MissingExtra: Pillow is not installed.
    """
    if isinstance(value, str | os.PathLike):
        try:
            value = pillow().open(value)
        except OSError as error:
            raise ConfigError(f"picture: {os.fspath(value)} cannot be read as one ({error})") from error
    if callable(save := getattr(value, "savefig", None)):
        save(drawn := io.BytesIO(), format="png")
        value = pillow().open(drawn)
    if callable(convert := getattr(value, "convert", None)):
        value = np.asarray(convert("RGB"))
        dataformats = "HWC"
    return Picture(_pixels(_numbers(value), dataformats), fps)


def film_of(value: object, dataformats: str, fps: float | None) -> Picture:
    """Return a film: an array or tensor, or the path of a video file.

    Raises:
        ConfigError: it is no film.
        MissingExtra: PyAV, which reads video files, is not installed.
    """
    if not isinstance(value, str | os.PathLike):
        return picture_of(value, dataformats, fps or 4.0)
    av = require("av", extra="film", purpose="reading a video file")
    try:
        with av.open(os.fspath(value)) as file:
            frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
            own_fps = float(file.streams.video[0].average_rate or 30)
    except (OSError, IndexError, av.FFmpegError) as error:
        raise ConfigError(f"film: {os.fspath(value)} cannot be read as one ({error})") from error
    if not frames:
        raise ConfigError(f"film: {os.fspath(value)} has no frames")
    return Picture(np.stack(frames), fps or own_fps)


def histogram_of(values: object) -> dict[str, Array]:
    """Return counts [bins] and edges [bins + 1] of numbers; numbers that are not finite are left out."""
    array = _numbers(values).astype(np.float64).ravel()
    finite = array[np.isfinite(array)]
    counts, edges = np.histogram(finite, bins=BINS)
    return {"counts": counts, "edges": edges}


def array_of(values: object) -> Array:
    """Return a copy of an array, a tensor or a list of numbers.

    Raises:
        ConfigError: it holds something else.
    """
    return _numbers(values).copy()


def _numbers(value: object) -> Array:
    return numbers_of(value, "media", "as data", "an array of numbers")


def _tiled(images: NDArray[Any]) -> NDArray[Any]:
    """Return pictures [n, ..., height, width, channels] as a grid [..., rows, columns, channels]."""
    n = len(images)
    columns = int(np.ceil(np.sqrt(n)))
    rows = -(-n // columns)
    empty = np.zeros((rows * columns - n, *images.shape[1:]), images.dtype)
    cells = np.concatenate([images, empty]).reshape(rows, columns, *images.shape[1:])
    return np.concatenate([np.concatenate(list(row), axis=-2) for row in cells], axis=-3)


def _pixels(array: NDArray[Any], layout: str) -> NDArray[np.uint8]:
    """Return an array as [frames, height, width, 3] of uint8."""
    layout = "HW" if layout == "HWC" and array.ndim == 2 else layout.upper()
    if (
        len(layout) != array.ndim
        or len(set(layout)) != len(layout)
        or not set("HW") <= set(layout) <= set("NTCHW")
    ):
        raise ConfigError(f"picture: found shape {list(array.shape)}, expected the axes {layout}")
    for axis in "TNC":  # T before N: the films of a batch are tiled
        if axis not in layout:
            array = array[np.newaxis]
            layout = axis + layout
    array = _tiled(array.transpose([layout.index(axis) for axis in "NTHWC"]))
    if array.shape[-1] not in (1, 3, 4):
        raise ConfigError(f"picture: found {array.shape[-1]} channels, expected 1, 3 or 4")
    if array.dtype.kind == "f":
        array = np.nan_to_num(array, nan=0.0, posinf=1.0, neginf=0.0) * 255
    elif array.dtype.kind == "b":
        array = array * np.uint8(255)
    array = array.clip(0, 255).astype(np.uint8)[..., :3]
    return np.broadcast_to(array, (*array.shape[:-1], 3))


def media_of(value: Any) -> Any:
    """Return a `Picture`, an array, or arrays by name, as a value is recorded; None for anything else.

    Raises:
        ConfigError: it is a picture or a histogram that cannot be recorded.
        MissingExtra: Pillow, which pictures need, is not installed.
    """
    if isinstance(value, Media):
        return value.content
    if callable(getattr(value, "savefig", None)) or callable(getattr(value, "convert", None)):
        return picture_of(value)
    if isinstance(value, list | tuple):
        return value if len(value) != 1 else None
    array = as_array(value)
    return value if array.ndim and array.size != 1 else None


# --- as wandb names them ------------------------------------------------------------------------------


class Media:
    """What was made of a script's data; if nothing could be, the error comes when it is logged."""

    def __init__(self, convert: Callable[..., Any], *arguments: object, **layout: object) -> None:
        self._error: Exception | None = None
        try:
            self._content = convert(*arguments, **layout)
        except Exception as error:
            self._error = error

    @property
    def content(self) -> Any:
        """A `Picture`, an array, or arrays by name.

        Raises:
            ConfigError: the data cannot be recorded.
        """
        if self._error is not None:
            raise self._error
        return self._content

    @property
    def nbytes(self) -> int:
        """The size of the content; raises what it raises."""
        content = self.content
        parts = content.values() if isinstance(content, dict) else (content,)
        return sum(part.nbytes for part in parts)


class Image(Media):
    """A picture: an array [height, width] or [height, width, channels], Pillow's, Matplotlib's, or a file."""

    def __init__(self, data_or_path: Any, *_: object, caption: str | None = None, **__: object) -> None:
        is_tensor = hasattr(data_or_path, "detach") and np.ndim(data_or_path) == 3
        super().__init__(picture_of, data_or_path, "CHW" if is_tensor else "HWC")
        self.caption = caption


class Video(Media):
    """A film: an array [frames, channels, height, width], or a batch of them; or a file."""

    def __init__(
        self,
        data_or_path: Any,
        caption: str | None = None,
        fps: float | None = None,
        *_: object,
        **__: object,
    ) -> None:
        super().__init__(film_of, data_or_path, "NTCHW" if np.ndim(data_or_path) == 5 else "TCHW", fps)
        self.caption = caption


def _histogram_as_given(counts_and_edges: Any) -> dict[str, Array]:
    if len(counts_and_edges) != 2:
        raise ConfigError(f"histogram: found {len(counts_and_edges)} arrays, expected counts and edges")
    return dict(zip(("counts", "edges"), map(np.asarray, counts_and_edges), strict=True))


class Histogram(Media):
    """A histogram: of numbers, or counts and edges as `numpy.histogram` returns them."""

    def __init__(self, sequence: Any = None, np_histogram: Any = None, num_bins: int = 64) -> None:  # noqa: ARG002
        if np_histogram is None:
            super().__init__(histogram_of, sequence)
        else:
            super().__init__(_histogram_as_given, np_histogram)
