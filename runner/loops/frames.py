"""Pictures of an environment, encoded by Pillow."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.util.extras import require

JPEG_QUALITY = 90


def image_bytes(pixels: NDArray[np.uint8], kind: str) -> bytes:
    """Return a picture, [height, width, 3], as `png` (exact) or `jpeg` (smaller, and not exact)."""
    buffer = io.BytesIO()
    options: dict[str, Any] = {"compress_level": 1} if kind == "png" else {"quality": JPEG_QUALITY}
    pillow().fromarray(pixels).save(buffer, kind, **options)
    return buffer.getvalue()


def pillow() -> Any:
    """Return the module `PIL.Image`.

    Raises:
        MissingExtra: Pillow is not installed.
    """
    return require("PIL.Image", extra="plots", purpose="recording frames")
