"""Files: opened only if regular, read within bounds, replaced atomically; the user's cache.

Files and folders that an export writes appear complete, and replace others only if allowed.
"""

from __future__ import annotations

import contextlib
import errno
import fnmatch
import json
import os
import shutil
import stat
import time
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import BinaryIO, Final

from runner.errors import RunnerError, StorageError
from runner.util.values import Json, JsonView, without_surrogates

CACHE_VARIABLE: Final = "XDG_CACHE_HOME"
CACHED_EXPORTS: Final = "rerun"
"""The folder of the cache with exports for the Rerun viewer; their names begin with the ids of their runs."""
RUN_SEPARATOR: Final = "+"
"""Separates the ids of several runs in the name of an export; no id contains it."""
CACHED_RECORDINGS: Final = "restored"
"""The folder of the cache with recordings restored from archives; their names begin with the run's id."""
CACHED_EPISODES: Final = "episodes"
"""The folder of the cache with the index of episodes; the names of its files begin with the run's id."""
_BINARY: Final = getattr(os, "O_BINARY", 0)
"""On Windows, leaves line ends as they are."""
_to_json: Final = json.JSONEncoder(ensure_ascii=False).encode


def is_installed(path: str, is_script: bool = False) -> bool:
    """Return whether a file or folder is Python's own, or was installed, and is not the user's.

    Args:
        is_script: whether scripts that were installed count, such as `jupyter`.
    """
    parts = Path(path).parts
    return (
        "site-packages" in parts
        or "dist-packages" in parts
        or path.endswith(".zip")
        or f"{path}{os.sep}".startswith(
            _folders_of("stdlib", "platstdlib", *(["scripts"] if is_script else []))
        )
    )


@cache
def _folders_of(*names: str) -> tuple[str, ...]:
    """Return the folders of Python and of the user with these names of `sysconfig`."""
    import sysconfig

    schemes = (sysconfig.get_default_scheme(), sysconfig.get_preferred_scheme("user"))
    return tuple({sysconfig.get_path(name, scheme) + os.sep for scheme in schemes for name in names})


def cache_folder() -> Path:
    """Return the project's folder in the user's cache; it need not exist."""
    base = os.environ.get(CACHE_VARIABLE)
    return (Path(base) if base else Path.home() / ".cache") / "dualtaxi"


def remove_oldest(folder: Path, pattern: str, keep: int) -> None:
    """Remove the files of a pattern in a folder, but for those that were used last."""
    used = []
    for path in folder.glob(pattern):
        with contextlib.suppress(FileNotFoundError):  # another process removed it meanwhile
            facts = path.stat()
            used.append((max(facts.st_atime, facts.st_mtime), path))
    for _, old in sorted(used, reverse=True)[keep:]:
        old.unlink(missing_ok=True)


def open_regular(path: str | os.PathLike[str], follow_link: bool = True) -> BinaryIO:
    """Return a regular file, opened for reading.

    Anything else is refused: opening a pipe would wait for its writer, and a device never ends.

    Raises:
        OSError: it cannot be read, or is not a regular file.
    """
    flags = getattr(os, "O_NONBLOCK", 0) | (0 if follow_link else getattr(os, "O_NOFOLLOW", 0))
    descriptor = os.open(path, os.O_RDONLY | flags | _BINARY)
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    raise OSError(errno.EINVAL, "it is not a regular file", os.fspath(path))


def hash_of(path: Path) -> tuple[int, str]:
    """Return size and BLAKE3 of a file; it is read, not mapped, so that little of it is in memory at a time.

    Raises:
        OSError: it cannot be read.
    """
    import hashlib  # loads OpenSSL

    from blake3 import blake3  # listing runs does not need it

    with open_regular(path) as stream:
        digest = hashlib.file_digest(stream, blake3)  # type: ignore[arg-type] # its update returns itself
        return stream.tell(), digest.hexdigest()


def read_object(path: str | os.PathLike[str], max_bytes: int) -> Json:
    """Return the JSON object in a file; numbers that are not finite become None.

    Raises:
        OSError: it cannot be read.
        ValueError: it is longer than `max_bytes`, or holds no JSON object.
    """
    with open_regular(path) as stream:
        data = stream.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise ValueError(f"it is longer than {max_bytes:,} bytes")
    try:
        value = without_surrogates(json.loads(data, parse_constant=lambda _: None), data)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if not isinstance(value, dict):
        raise ValueError("it holds no JSON object")
    return value


def write_object(path: Path, value: JsonView, mode: int = 0o666) -> None:
    """Replace a file by one with this JSON object; `mode` is its permissions, less the process's mask.

    Raises:
        OSError: it cannot be written; it is as before.
    """
    # A line for each key: with `indent`, `json` takes much longer.
    lines = [f" {_to_json(key)}: {_to_json(part)}" for key, part in value.items()]
    data = ("{\n" + ",\n".join(lines) + "\n}\n").encode()
    with replacing(path) as fresh:
        descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _BINARY, mode)
        try:
            write_all(descriptor, data)
        finally:
            os.close(descriptor)


def write_all(descriptor: int, data: bytes) -> None:
    """Write bytes to an open file, all of them.

    Raises:
        OSError: it failed; the first ones may be written.
    """
    left = memoryview(data)
    while left:
        left = left[os.write(descriptor, left) :]


@contextlib.contextmanager
def replacing(path: Path, mark: str = "") -> Iterator[Path]:
    """Yield a free, hidden path in the same folder; the file written there then replaces the one at `path`.

    A reader sees the old file or the new one. If the block fails, the old one stays.

    Args:
        mark: what the hidden name begins with.

    Raises:
        OSError: the file cannot be replaced.
    """
    fresh = path.with_name(f".{mark}{os.urandom(4).hex()}.{path.name}")
    try:
        yield fresh
        fresh.replace(path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            fresh.unlink()
        raise


@contextlib.contextmanager
def storage_errors(path: str | os.PathLike[str], advice: str = "") -> Iterator[None]:
    """Raise an `OSError` of the block as a `StorageError` that says what to do next.

    The `Timeout` of a `FileLock` is an `OSError` too: catch it within the block.

    Args:
        advice: the end of the message, such as `free some disk`.

    Raises:
        StorageError: there was one.
    """
    try:
        yield
    except OSError as error:
        reason = f"{os.fspath(path)}: cannot be written ({error.strerror or error})"
        raise StorageError(f"{reason}; {advice}." if advice else f"{reason}.") from error


def require_room(folder: Path, needed: int, spare: int = 0) -> None:
    """Raise an error if the disk of a folder has no room for some bytes, with others to spare.

    Raises:
        StorageError: it has less.
    """
    free = max(shutil.disk_usage(folder).free - spare, 0)
    if needed > free:
        raise StorageError(f"{folder}: found room for {free:,} bytes, expected {needed:,}; free some disk.")


def sync(path: Path) -> None:
    """Write a file, or the names in a folder, to disk.

    Raises:
        OSError: it could not.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


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
