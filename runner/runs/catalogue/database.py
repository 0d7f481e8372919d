"""The file of the index: one SQLite database in the user's cache.

It is made at one stroke, and thrown away when it is damaged or of another version. It keeps a journal, not a
write-ahead log: users' caches stand on network disks too, and transactions are short.
"""

from __future__ import annotations

import contextlib
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from peewee import SchemaManager, SqliteDatabase

from runner.runs.catalogue.rows import Row
from runner.util.files import cache_folder, replacing

Tell = Callable[[str], None]

INDEX_FILE: Final = "catalogue.sqlite"
_APPLICATION: Final = 0x44546178  # "DTax"
_VERSION: Final = zlib.crc32(",".join(["7", *Row._meta.sorted_field_names]).encode()) >> 1
"""Of the columns, and of indexes and contents (the number before them); another one is thrown away."""
_HEAD_BYTES: Final = 100
"""Of an SQLite file; at 24 stands how often it was changed."""
_BUSY_SECONDS: Final = 60


def index_path() -> Path:
    """Return the path of the index."""
    return cache_folder() / INDEX_FILE


class Version(NamedTuple):
    """What tells one state of the index from another."""

    file: int
    changes: int


def version() -> Version | None:
    """Return what changes with every change of the index; None if there is none that can be read."""
    try:
        with index_path().open("rb", buffering=0) as stream:
            head = stream.read(_HEAD_BYTES)
            return Version(os.fstat(stream.fileno()).st_ino, int.from_bytes(head[24:28], "big"))
    except OSError:
        return None


def opened(tell: Tell) -> SqliteDatabase:
    """Return the index, opened; made first if it is missing, foreign or of another version."""
    path = index_path()
    if not path.exists():
        renew()
    for _ in range(2):
        database = _connected(os.fspath(path))
        if (database.application_id, database.user_version) == (_APPLICATION, _VERSION):
            return database
        database.close()
        tell(f"The index {path} is of another version; it is made anew.")
        renew()
    raise OSError("it changes under our hands")


def renew() -> None:
    """Put an empty index in place of what is there, unless another process just did."""
    from filelock import FileLock

    path = index_path()
    path.parent.mkdir(parents=True, exist_ok=True)
    before = _identity(path)
    with FileLock(path.with_suffix(".lock"), timeout=_BUSY_SECONDS):
        if _identity(path) != before:
            return
        with replacing(path) as fresh:
            made(os.fspath(fresh)).close()
            path.with_name(f"{path.name}-journal").unlink(missing_ok=True)


def _identity(path: Path) -> tuple[int, int] | None:
    with contextlib.suppress(OSError):
        facts = path.stat()
        return facts.st_ino, facts.st_ctime_ns
    return None


def _connected(path: str) -> SqliteDatabase:
    """Return the database of a path, its writers taking turns."""
    pragmas = {"busy_timeout": _BUSY_SECONDS * 1000, "synchronous": "normal"}
    database = SqliteDatabase(path, pragmas=pragmas, lock_type="IMMEDIATE", timeout=_BUSY_SECONDS)
    database.connect()
    return database


def made(path: str) -> SqliteDatabase:
    """Return a new, empty index."""
    database = _connected(path)
    SchemaManager(Row, database).create_all()
    database.application_id, database.user_version = _APPLICATION, _VERSION
    return database


def tuples_of(database: SqliteDatabase, query: Any) -> Iterator[tuple[Any, ...]]:
    """Return what a query finds as SQLite has it: many rows, quickly."""
    found: Iterator[tuple[Any, ...]] = database.execute(query)  # type: ignore[no-untyped-call]
    return found


def write_rows(database: SqliteDatabase, rows: Sequence[Mapping[str, Any]]) -> None:
    """Put whole rows in the index, in place of those of the same folders; within a transaction."""
    fields = Row._meta.sorted_fields
    columns = ", ".join(f'"{field.column_name}"' for field in fields)
    places = ", ".join("?" * len(fields))
    values = [[field.db_value(row[field.name]) for field in fields] for row in rows]
    statement = f"INSERT OR REPLACE INTO {Row._meta.table_name} ({columns}) VALUES ({places})"
    database.connection().executemany(statement, values)  # type: ignore[no-untyped-call]


def keep_usage(database: SqliteDatabase, values: Sequence[tuple[Any, ...]]) -> None:
    """Keep what folders use of the disk, with those that are as they were.

    Args:
        database: the index.
        values: bytes of recording, all else, what is left over, what would be freed; then root, entry, mark
            and fingerprint of the folder.
    """
    statement = (
        f"UPDATE {Row._meta.table_name} SET used_recording=?, used_other=?, used_left_over=?, used_freed=? "
        "WHERE root=? AND entry=? AND mark=? AND fingerprint=?"
    )
    with database.atomic("IMMEDIATE"):
        database.connection().executemany(statement, values)  # type: ignore[no-untyped-call]
