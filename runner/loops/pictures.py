"""Pictures and films as a recording holds them: PNG, JPEG, animated WebP."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.drawing.raster import image_bytes
from runner.errors import ConfigError
from runner.loops.options import pillow

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

    @property
    def format(self) -> str:
        """`png`, or `webp` for a film."""
        return "png" if len(self.frames) == 1 else "webp"

    def encoded(self) -> bytes:
        """Return the picture as PNG, the film as animated WebP."""
        if len(self.frames) == 1:
            return image_bytes(self.frames[0], "png")
        buffer, images = io.BytesIO(), map(pillow().fromarray, self.frames)
        duration = max(1, round(1000 / self.fps))
        next(images).save(
            buffer, "webp", save_all=True, append_images=images, duration=duration, loop=0, method=0
        )
        return buffer.getvalue()
