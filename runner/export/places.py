"""Files and folders that an export writes: they appear complete, and replace others only if allowed."""

from __future__ import annotations

import contextlib
import fnmatch
import os
import shutil
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from runner.errors import RunnerError, StorageError
from runner.util.files import replacing, storage_errors

_MARK: Final = "dualtaxi-export-"
"""What the names of temporary files begin with, after the dot."""
_IDLE_SECONDS: Final = 3600


@contextlib.contextmanager
def new_file(path: Path, force: bool) -> Iterator[Path]:
    """Yield a temporary path next to `path`; the file there becomes `path` if the block succeeds.

    Raises:
        StorageError: it cannot be written.
    """
    require_new(path, force)
    with storage_errors(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            raise StorageError(f"{path}: {path.parent} is a file, expected a folder.") from error
        _remove_left_over(path.parent)
        with replacing(path, _MARK) as temporary:
            yield temporary


def _remove_left_over(folder: Path) -> None:
    """Remove the temporary files of killed exports: those that nothing was written to for an hour."""
    for file in folder.glob(f".{_MARK}*"):
        with contextlib.suppress(OSError):
            if not file.is_dir() and time.time() - file.lstat().st_mtime > _IDLE_SECONDS:
                file.unlink()


def require_new(path: Path, force: bool) -> None:
    """Refuse a path at which no file may be written.

    Raises:
        RunnerError: it is a folder, or there is a file already and `force` is not set.
    """
    if path.is_dir():
        raise RunnerError(f"{path}: found a folder, expected a file to write.")
    if path.exists() and not force:
        raise RunnerError(f"{path}: exists already; --force replaces it, or choose another name.")


def write_text_new(path: Path, force: bool, text: str) -> None:
    """Write text to a file, as `new_file` does."""
    with new_file(path, force) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def new_folder(path: Path, force: bool, patterns: Sequence[str]) -> Iterator[Path]:
    """Yield a hidden folder next to `path`, which becomes `path` if the block succeeds.

    With `force` it replaces a folder that holds nothing but exported files: those whose relative paths match
    `patterns`.
    """
    if path.exists():
        _require_replaceable(path, force, patterns)
    temporary = path.with_name(f".{path.name}.{os.urandom(4).hex()}")
    old = path.with_name(f".{path.name}.{os.urandom(4).hex()}")
    try:
        with storage_errors(path):
            temporary.mkdir(parents=True)
            yield temporary
            if path.exists():
                path.rename(old)
            temporary.rename(path)
    finally:
        for folder in (temporary, old):
            shutil.rmtree(folder, ignore_errors=True)


def _require_replaceable(path: Path, force: bool, patterns: Sequence[str]) -> None:
    if not path.is_dir():
        raise RunnerError(f"{path}: found a file, expected a folder; choose another by -o.")
    if not force:
        raise RunnerError(f"{path}: exists already; --force replaces it, or choose another by -o.")
    for file in path.rglob("*"):
        name = file.relative_to(path).as_posix()
        if not file.is_dir() and not any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns):
            raise RunnerError(
                f"{path}: holds {name}, which no export wrote; --force leaves such a folder alone."
            )
