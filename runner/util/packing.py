"""The options by which a recording is packed, with their defaults and bounds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from runner.util.codecs import CODECS, Compression

Index = Literal["message", "chunk"]
MIN_CHUNK_STEPS: Final = 256
MAX_CHUNK_STEPS: Final = 1 << 16


@dataclass(frozen=True)
class Packing:
    """How a recording is packed."""

    compression: Compression = "zstd"
    level: int = CODECS["zstd"].default_level or 0
    """The level of the compression; codecs without levels ignore it."""
    index: Index = "message"
    """Whether each message is indexed, or only each chunk."""
    chunk_steps: int = 1 << 14
    """The most steps in a chunk."""
    values: bool = False
    """Whether steps hold values of spaces, such as arrays of floats, and not the numbers of states."""
