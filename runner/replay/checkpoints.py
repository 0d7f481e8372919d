"""Q-tables in the user's cache, one set every million steps of a replay, from which later replays start.

A recording has snapshots by episodes, which may lie a hundred million steps apart. The first replay
over such a stretch saves checkpoints; from then on the tables at any step are a short replay away.
They can be removed at any time: everything in them follows from the recording.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
import zstandard
from blake3 import blake3

import runner.learning
from runner.recording.reader import Recording
from runner.util.arrays import Floats
from runner.util.files import TABLES, cache_folder, replacing

CHECKPOINT_STEPS: Final = 1 << 20
"""Training steps between checkpoints: replayed in well under half a second."""
MAX_CACHE_BYTES: Final = 2 * 10**9
"""The most that all checkpoints of all runs take; beyond it the least recently used are removed."""


class Checkpoints:
    """The checkpoints of one recording.

    Args:
        recording: the run; unless it is finished, there are no checkpoints, as it may still change.
    """

    def __init__(self, recording: Recording) -> None:
        self._folder = cache_folder() / TABLES
        run_id = re.sub(r"[^\w-]", "_", recording.run_id)[:80]  # whatever the file says, a plain name
        self._prefix = f"{run_id}-{_key(recording)}" if recording.file.finished else ""
        self._saved = False

    def nearest(self, step: int, shapes: Sequence[tuple[int, ...]]) -> tuple[int, list[Floats]]:
        """Return the last checkpoint at or before a step, and its tables; step -1 if there is none.

        Args:
            shapes: of the tables, in the order of a snapshot.
        """
        for at in sorted((at for at in self._steps() if at <= step), reverse=True):
            tables = self._load(at, shapes)
            if tables is not None:
                return at, tables
        return -1, []

    def save(self, step: int, tables: Sequence[Floats]) -> None:
        """Save the tables at a step, unless they are there."""
        path = self._path(step)
        if not self._prefix or path.exists():
            return
        data = b"".join(np.ascontiguousarray(table, "<f8").tobytes() for table in tables)
        with contextlib.suppress(OSError):  # a cache that cannot be written costs time only
            self._folder.mkdir(parents=True, exist_ok=True)
            with replacing(path) as fresh:
                fresh.write_bytes(zstandard.ZstdCompressor(level=1, write_checksum=True).compress(data))
            self._saved = True

    def prune(self) -> None:
        """Remove the least recently used checkpoints, of any run, if they take too much space."""
        if not self._saved:
            return
        self._saved = False
        with contextlib.suppress(OSError):
            files = sorted((f.stat().st_mtime, f.stat().st_size, f) for f in self._folder.iterdir())
            excess = sum(size for _, size, _ in files) - MAX_CACHE_BYTES
            for _, size, file in files:
                if excess <= 0:
                    return
                file.unlink(missing_ok=True)
                excess -= size

    def _steps(self) -> list[int]:
        if not self._prefix or not self._folder.is_dir():
            return []
        names = [path.name for path in self._folder.iterdir() if path.name.startswith(self._prefix)]
        steps = [name.removeprefix(self._prefix).removesuffix(".zst") for name in names]
        return [int(step) for step in steps if step.isdecimal()]

    def _load(self, step: int, shapes: Sequence[tuple[int, ...]]) -> list[Floats] | None:
        """Return the tables of a checkpoint; None if it is damaged, and then it is removed."""
        path = self._path(step)
        sizes = [math.prod(shape) for shape in shapes]
        try:
            data = path.read_bytes()
            if zstandard.frame_content_size(data) != 8 * sum(sizes):
                raise ValueError
            values = np.frombuffer(zstandard.ZstdDecompressor().decompress(data), "<f8")
            os.utime(path)
        except (OSError, ValueError, zstandard.ZstdError):
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
            return None
        parts = np.split(values, np.cumsum(sizes)[:-1])
        return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]

    def _path(self, step: int) -> Path:
        return self._folder / f"{self._prefix}{step:015}.zst"


def _key(recording: Recording) -> str:
    """Return a key of the tables of this file as replayed by this code."""
    facts = recording.path.stat()
    parts = [str(recording.path.absolute()), str(facts.st_size), str(facts.st_mtime_ns)]
    parts += [str(recording.result.get("content_digest")), _code()]
    return blake3("\n".join(parts).encode()).hexdigest()[:16]


@cache
def _code() -> str:
    """Return a hash of the code that learns: other code may compute other tables."""
    digest = blake3()
    for file in sorted(Path(next(iter(runner.learning.__path__))).glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()
