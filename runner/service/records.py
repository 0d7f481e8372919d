"""Records in a small JSON file that several processes may change, read again when it changes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from runner.errors import StorageError
from runner.util.files import read_object, storage_errors, write_object

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Record = TypeVar("Record", bound="DataclassInstance")

MAX_FILE_BYTES: Final = 1 << 20
LOCK_SECONDS: Final = 10


class RecordsFile(Generic[Record]):
    """A file `{"KEY": [record, ...]}`, readable by its owner alone.

    Args:
        path: the file; it need not exist.
        key: what the records are called.
        parse: returns a record from its JSON object; raises `ValueError`, `KeyError`, `TypeError` or
            `AttributeError` if it is none.
    """

    def __init__(self, path: Path, key: str, parse: Callable[[Any], Record]) -> None:
        self.path = path
        self._key, self._parse = key, parse
        self._seen: tuple[int, int, int] | None = None
        self._records: tuple[Record, ...] = ()

    def all(self) -> tuple[Record, ...]:
        """Return the records.

        Raises:
            StorageError: the file is there and cannot be read as one of them.
        """
        try:
            facts = self.path.stat()
            seen = (facts.st_mtime_ns, facts.st_size, facts.st_ino)
            if seen != self._seen:
                self._records = self._read()
                self._seen = seen
        except FileNotFoundError:
            self._records, self._seen = (), None
        except OSError as error:
            raise StorageError(f"{self.path}: cannot be read ({error.strerror}).") from error
        return self._records

    def change(self, change: Callable[[tuple[Record, ...]], Iterable[Record]]) -> None:
        """Replace the records by what a function makes of them, while no other process changes them.

        Raises:
            StorageError: the file cannot be written.
        """
        from filelock import FileLock

        with storage_errors(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            with FileLock(self.path.with_suffix(".lock"), timeout=LOCK_SECONDS):
                kept = [dataclasses.asdict(record) for record in change(self.all())]
                write_object(self.path, {self._key: kept}, mode=0o600)

    def _read(self) -> tuple[Record, ...]:
        try:
            return tuple(self._parse(entry) for entry in read_object(self.path, MAX_FILE_BYTES)[self._key])
        except (ValueError, KeyError, TypeError, AttributeError):
            raise StorageError(
                f"{self.path}: found no file of {self._key}; remove it, and make them anew."
            ) from None
