"""The hash of a file, by which archives, packs and uploads are known to be whole."""

from __future__ import annotations

import hashlib
from pathlib import Path

from blake3 import blake3

from runner.util.opening import open_regular


def hash_of(path: Path) -> tuple[int, str]:
    """Return size and BLAKE3 of a file; it is read, not mapped, so that little of it is in memory at a time.

    Raises:
        OSError: it cannot be read.
    """
    with open_regular(path) as stream:
        digest = hashlib.file_digest(stream, blake3)  # type: ignore[arg-type] # its update returns itself
        return stream.tell(), digest.hexdigest()
