"""The file of the index: one SQLite database in the user's cache.

It is created atomically, and replaced when it is damaged or of another version. It has a rollback journal,
not a write-ahead log: the cache may be on a network disk, and transactions are short.
"""

from __future__ import annotations

import contextlib
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from peewee import SchemaManager, SqliteDatabase

from runner.runs.catalogue.rows import Expression, Row, SqlRow
from runner.util.files import cache_folder, replacing

Report = Callable[[str], None]

INDEX_FILE: Final = "catalogue.sqlite"
_APPLICATION: Final = 0x44546178  # "DTax"
_VERSION: Final = zlib.crc32(",".join(["9", *Row._meta.sorted_field_names]).encode()) >> 1
"""Identifies the columns, and by the number indexes and contents; an index of another version is replaced."""
_HEAD_BYTES: Final = 100
"""The header of an SQLite file; at 24 it has the number of changes."""
_BUSY_SECONDS: Final = 60


def index_path() -> Path:
    """Return the path of the index."""
    return cache_folder() / INDEX_FILE


class Version(NamedTuple):
    """Identifies a state of the index."""

    file: int
    changes: int


def version() -> Version | None:
    """Return the version of the index's contents; None if there is no index that can be read."""
    try:
        with index_path().open("rb", buffering=0) as stream:
            head = stream.read(_HEAD_BYTES)
            return Version(os.fstat(stream.fileno()).st_ino, int.from_bytes(head[24:28], "big"))
    except OSError:
        return None


def open_index(report: Report) -> SqliteDatabase:
    """Open the index; create it first if it is missing, foreign or of another version."""
    path = index_path()
    if not path.exists():
        renew()
    for _ in range(2):
        database = _connected(os.fspath(path))
        if (database.application_id, database.user_version) == (_APPLICATION, _VERSION):
            return database
        database.close()
        report(f"The index {path} is of another version; it is rebuilt.")
        renew()
    raise OSError("another process keeps replacing it")


def renew() -> None:
    """Replace the index by an empty one, unless another process just did."""
    from filelock import FileLock

    path = index_path()
    path.parent.mkdir(parents=True, exist_ok=True)
    before = _identity(path)
    with FileLock(path.with_suffix(".lock"), timeout=_BUSY_SECONDS):
        if _identity(path) != before:
            return
        with replacing(path) as fresh:
            create(os.fspath(fresh)).close()
            path.with_name(f"{path.name}-journal").unlink(missing_ok=True)


def _identity(path: Path) -> tuple[int, int] | None:
    with contextlib.suppress(OSError):
        facts = path.stat()
        return facts.st_ino, facts.st_ctime_ns
    return None


def _connected(path: str) -> SqliteDatabase:
    """Return the database at a path; its writers wait for one another."""
    pragmas = {"busy_timeout": _BUSY_SECONDS * 1000, "synchronous": "normal"}
    database = SqliteDatabase(path, pragmas=pragmas, lock_type="IMMEDIATE", timeout=_BUSY_SECONDS)
    database.connect()
    return database


def create(path: str) -> SqliteDatabase:
    """Return a new, empty index."""
    database = _connected(path)
    SchemaManager(Row, database).create_all()
    database.application_id, database.user_version = _APPLICATION, _VERSION
    return database


def tuples_of(database: SqliteDatabase, query: Expression) -> Iterator[SqlRow]:
    """Return the rows of a query as tuples of SQLite's values, without peewee's conversions."""
    rows: Iterator[SqlRow] = database.execute(query)  # type: ignore[no-untyped-call]
    return rows


def write_rows(database: SqliteDatabase, rows: Sequence[Mapping[str, object]]) -> None:
    """Write whole rows, replacing those of the same folders; within a transaction."""
    fields = Row._meta.sorted_fields
    columns = ", ".join(f'"{field.column_name}"' for field in fields)
    places = ", ".join("?" * len(fields))
    values = [[field.db_value(row[field.name]) for field in fields] for row in rows]
    statement = f"INSERT OR REPLACE INTO {Row._meta.table_name} ({columns}) VALUES ({places})"
    database.connection().executemany(statement, values)  # type: ignore[no-untyped-call]
