"""Where an export goes: a file or folder that is there when it is whole, and replaces another if asked."""

from __future__ import annotations

import contextlib
import fnmatch
import secrets
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from runner.errors import RunnerError, StorageError
from runner.util.extras import require
from runner.util.files import replacing, storage_errors


def write_new(path: Path, force: bool, write: Callable[[Path], object]) -> None:
    """Have a file written beside its place, and put there when it is whole.

    Raises:
        RunnerError: there is one already and `force` is not given.
        StorageError: it cannot be written.
    """
    require_new(path, force)
    with storage_errors(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            raise StorageError(f"{path}: {path.parent} is a file, expected a folder.") from error
        with replacing(path) as fresh:
            write(fresh)


def require_new(path: Path, force: bool) -> None:
    """Refuse a path at which no file may be written.

    Raises:
        RunnerError: it is a folder, or there is a file already and `force` is not given.
    """
    if path.is_dir():
        raise RunnerError(f"{path}: found a folder, expected a file to write.")
    if path.exists() and not force:
        raise RunnerError(f"{path}: exists already; --force replaces it, or choose another name.")


def write_text_new(path: Path, force: bool, text: str) -> None:
    """Write text to a file, as `write_new` does."""

    def write(fresh: Path) -> None:
        fresh.write_text(text, encoding="utf-8")

    write_new(path, force, write)


@contextlib.contextmanager
def new_folder(path: Path, force: bool, ours: Sequence[str]) -> Iterator[Path]:
    """Give a hidden folder beside a place; put it there when all went well.

    Args:
        path: the place.
        force: replace a folder that is there, if it holds nothing but files of ours.
        ours: patterns of the paths of the files that the export writes.

    Raises:
        RunnerError: something is there and is not to be replaced.
        StorageError: the folder cannot be written.
    """
    _check_place(path, force, ours)
    fresh = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    old = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with storage_errors(path):
            fresh.mkdir(parents=True)
            yield fresh
            if path.exists():
                path.rename(old)
            fresh.rename(path)
    finally:
        for folder in (fresh, old):
            shutil.rmtree(folder, ignore_errors=True)


def _check_place(path: Path, force: bool, ours: Sequence[str]) -> None:
    if not path.exists():
        return
    if not path.is_dir():
        raise RunnerError(f"{path}: found a file, expected a place for a folder; choose another by -o.")
    if not force:
        raise RunnerError(f"{path}: exists already; --force replaces it, or choose another by -o.")
    for file in path.rglob("*"):
        name = file.relative_to(path).as_posix()
        if not file.is_dir() and not any(fnmatch.fnmatchcase(name, pattern) for pattern in ours):
            raise RunnerError(
                f"{path}: holds {name}, which no export wrote; --force leaves such a folder alone."
            )


def require_pyarrow(purpose: str) -> None:
    """Raise an error that says what is missing, if what writes tables is not installed.

    Raises:
        MissingExtra: it is not.
    """
    require("pyarrow", extra="archive", purpose=purpose)
