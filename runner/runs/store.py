"""The content of checkpoints, in a store next to the runs of a recordings folder.

recordings/.store/objects/3f/3f9a...    a content, named by its BLAKE3 in hexadecimal, and written once
recordings/.store/runs/k3v9m2xq         the digests that a run refers to, a line each

Runs with the same content share it. It is removed with the last run that refers to it.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import time
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Final

from blake3 import blake3
from filelock import FileLock

from runner.errors import RecordingError, StorageError
from runner.util.files import open_regular, storage_errors

FOLDER: Final = ".store"
DIGEST: Final = re.compile(r"[0-9a-f]{64}")
_PIECE: Final = 1 << 20
_LEFT_OVER_SECONDS: Final = 3600
"""What changed later may belong to an import, or to a process that is storing a content."""
_ADVICE: Final = "free some disk"


class Store:
    """The store of a recordings folder; it need not exist."""

    def __init__(self, recordings: Path) -> None:
        self._folder = recordings / FOLDER

    def path(self, digest: str) -> Path:
        """Return the path of a content, whether or not it is there.

        Raises:
            RecordingError: it is not a digest; anything else could lead out of the store.
        """
        if not DIGEST.fullmatch(digest):
            raise RecordingError(f"found the digest {digest[:80]!r}, expected 64 hexadecimal digits.")
        return self._folder / "objects" / digest[:2] / digest

    def has(self, digest: str, size: int) -> bool:
        """Return whether a content of this size is there."""
        try:
            return self.path(digest).stat().st_size == size
        except OSError:
            return False

    def put(self, run: str, content: bytes | memoryview | Path, expected: str = "") -> tuple[str, int]:
        """Store a content that a run refers to; return its digest and its number of bytes.

        Args:
            content: the bytes, or a file with them.
            expected: its digest, if it is known.

        Raises:
            StorageError: the file cannot be read, or the store cannot be written.
        """
        if not isinstance(content, Path):
            return self._put(run, [content], expected)
        try:
            stream = open_regular(content)
        except OSError as error:
            raise StorageError(f"{content}: cannot be read ({error.strerror}).") from error
        with stream:
            return self._put(run, iter(partial(stream.read, _PIECE), b""), expected)

    def _put(self, run: str, pieces: Iterable[bytes | memoryview], expected: str) -> tuple[str, int]:
        with storage_errors(self._folder, _ADVICE):
            (self._folder / "objects").mkdir(parents=True, exist_ok=True)
            fresh = self._folder / "objects" / f".{secrets.token_hex(8)}"
            try:
                digest, size = _write(fresh, pieces)
                if expected and digest != expected:
                    raise RecordingError(
                        f"checkpoint {expected[:16]}…: found content {digest[:16]}…: it was changed."
                    )
                path = self.path(digest)
                with self._locked():
                    self._refer(run, [digest])
                    path.parent.mkdir(exist_ok=True)
                    fresh.replace(path)  # also where it is there already: that file may be damaged
            finally:
                fresh.unlink(missing_ok=True)
        return digest, size

    def refer(self, run: str, digests: Iterable[str]) -> None:
        """Note that a run refers to contents, which then stay."""
        if digests := [digest for digest in digests if self.path(digest)]:
            with storage_errors(self._folder, _ADVICE):
                self._folder.mkdir(exist_ok=True)
                with self._locked():
                    self._refer(run, digests)

    def _refer(self, run: str, digests: Iterable[str]) -> None:
        own = set(self.of_run(run))
        if fresh := [digest for digest in dict.fromkeys(digests) if digest not in own]:
            path = self._folder / "runs" / run
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("a", encoding="ascii") as stream:
                # The empty line ends one that was cut off when the machine failed.
                stream.write("\n".join(["", *fresh, ""]))

    def of_run(self, run: str) -> list[str]:
        """Return the digests that a run refers to."""
        try:
            with open_regular(self._folder / "runs" / run) as stream:
                lines = stream.read().decode("ascii", "replace").split()
        except OSError:
            return []
        return [line for line in lines if DIGEST.fullmatch(line)]

    def runs(self) -> list[str]:
        """Return the names of the folders of runs that refer to something."""
        with contextlib.suppress(OSError):
            return sorted(path.name for path in (self._folder / "runs").iterdir())
        return []

    def sizes(self) -> dict[str, int]:
        """Return the bytes of the contents by run; what several runs share counts for the first of them."""
        seen: set[str] = set()
        by_run = {}
        for run in self.runs():
            own = [digest for digest in self.of_run(run) if digest not in seen]
            seen.update(own)
            by_run[run] = sum(map(self._size, own))
        return by_run

    def only_of(self, runs: Iterable[str]) -> dict[str, int]:
        """Return the contents that only these runs refer to, with their bytes."""
        leaving = set(runs)
        known = set(self.runs())
        staying = {digest for run in known - leaving for digest in self.of_run(run)}
        own = {digest for run in known & leaving for digest in self.of_run(run)}
        return {digest: self._size(digest) for digest in sorted(own - staying)}

    def drop(self, run: str) -> int:
        """Forget a run, and remove the contents that no other run refers to; return the bytes freed."""
        if run not in self.runs():
            return 0
        with storage_errors(self._folder), self._locked():
            unused = self.only_of([run])
            for digest in unused:
                self.path(digest).unlink(missing_ok=True)
            (self._folder / "runs" / run).unlink(missing_ok=True)
        return sum(unused.values())

    def clean(self) -> None:
        """Forget runs that are gone, and remove what killed processes left, both after an hour."""
        for run in self.runs():
            if not (self._folder.parent / run).exists() and _is_old(self._folder / "runs" / run):
                self.drop(run)
        for path in (self._folder / "objects").glob(".*"):
            if _is_old(path):
                path.unlink(missing_ok=True)

    def _size(self, digest: str) -> int:
        with contextlib.suppress(OSError):
            return self.path(digest).stat().st_size
        return 0

    def _locked(self) -> FileLock:
        """Return the lock, with which no other process changes what runs refer to."""
        return FileLock(self._folder / "lock")


def _is_old(path: Path) -> bool:
    with contextlib.suppress(OSError):
        return time.time() - path.stat().st_mtime > _LEFT_OVER_SECONDS
    return False


def _write(path: Path, pieces: Iterable[bytes | memoryview]) -> tuple[str, int]:
    """Write a new file, and sync it; return its digest and size."""
    digest = blake3()
    size = 0
    with path.open("xb") as stream:
        for piece in pieces:
            stream.write(piece)
            digest.update(piece)
            size += len(piece)
        stream.flush()
        os.fsync(stream.fileno())
    return digest.hexdigest(), size
