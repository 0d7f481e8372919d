"""Pictures of an episode that a report contains: some of them, made small."""

from __future__ import annotations

import base64
import io
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from runner.errors import RunnerError
from runner.export.encoded import encoded_pictures
from runner.util.extras import require

MAX_PICTURES: Final = 300
"""Pictures of an episode in a report."""
_MAX_SIDE: Final = 320
"""Pixels of the longer side of a picture."""
_QUALITY: Final = 75


@dataclass
class Thumbnails:
    """Some pictures of an episode, and which of them each frame shows."""

    pictures: list[str] = field(default_factory=list)
    """Addresses that contain the pictures: `data:image/webp;base64,...`."""
    picture: list[int] = field(default_factory=list)
    """The index of each frame's picture: that of its own step, or of one before it."""
    picture_note: str = ""
    """Why there are none, or no further ones."""


def thumbnails(path: Path, phase: str, episode: int, frames: int) -> Thumbnails:
    """Return pictures of the first frames of an episode."""
    require("PIL.Image", extra="plots", purpose="the pictures of a report")
    found, every = Thumbnails(), -(-frames // MAX_PICTURES)
    latest = b""
    try:
        with closing(encoded_pictures(path, phase, episode)) as pictures:
            for data in pictures:
                if isinstance(data, str):
                    found.picture_note = data
                    continue
                k = len(found.picture)
                if k == frames:
                    break
                latest = data or latest
                if k % every == 0 and latest:
                    found.pictures.append(_small(latest))
                    latest = b""
                found.picture.append(len(found.pictures) - 1)
    except RunnerError as error:
        found.picture_note = str(error)
    if found.pictures:
        found.picture += [len(found.pictures) - 1] * (frames - len(found.picture))
    return found


def _small(data: bytes) -> str:
    """Return a picture as an address that contains it, made small.

    Raises:
        RunnerError: it is no picture, or too large.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as opened:
            if opened.width * opened.height > 1 << 24:
                raise RunnerError(f"A recorded frame has {opened.width} x {opened.height} pixels, too many.")
            image = opened.convert("RGB")
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, ValueError, SyntaxError) as error:
        raise RunnerError(f"A recorded frame cannot be shown: {error}.") from error
    image.thumbnail((_MAX_SIDE, _MAX_SIDE))
    buffer = io.BytesIO()
    options: dict[str, object] = {"quality": _QUALITY, "method": 2}
    image.save(buffer, "WEBP", **options)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}"
