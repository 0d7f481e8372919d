"""The file of the index: one SQLite database in the user's cache.

It is created atomically, and replaced when it is damaged or of another version. It has a rollback journal,
not a write-ahead log: the cache may be on a network disk, and transactions are short.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from runner.runs.catalogue.rows import SEED_SHIFT, STORED
from runner.util.files import cache_folder, replacing

if TYPE_CHECKING:
    from runner.util.processes import Tell

INDEX_FILE: Final = "catalogue.sqlite"
_APPLICATION: Final = 0x44546178  # "DTax"
_SCHEMA: Final = (
    f"CREATE TABLE runs ({', '.join(' '.join(column) for column in STORED.items())}, "
    "PRIMARY KEY (root, entry)) WITHOUT ROWID",
    "CREATE INDEX runs_states ON runs (root, entry, fingerprint, mark, stable, status)",
    "CREATE INDEX runs_ids ON runs (id)",
    "CREATE INDEX runs_digests ON runs (digest)",
    "CREATE INDEX runs_parents ON runs (parent)",
    "CREATE INDEX runs_names ON runs (root, created, id, name, seed)",
)
_VERSION: Final = zlib.crc32("10".join(_SCHEMA).encode()) >> 1
"""Identifies the schema, and by the number the contents; an index of another version is replaced."""
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


def open_index(report: Tell) -> sqlite3.Connection:
    """Open the index; create it first if it is missing, foreign or of another version."""
    path = index_path()
    for _ in range(2):
        if (seen := identity()) is None:
            renew(None)
            seen = identity()
        database = _connected(os.fspath(path))
        pragmas = [pragma(database, name) for name in ("application_id", "user_version")]
        if pragmas == [_APPLICATION, _VERSION]:
            return database
        database.close()
        report(f"The index {path} is of another version; it is rebuilt.")
        renew(seen)
    raise OSError("another process keeps replacing it")


def renew(seen: int | None) -> None:
    """Replace the index by an empty one, unless another process did since it was seen.

    Args:
        seen: its identity before it was found to be unusable; None if there was none.
    """
    from filelock import FileLock

    path = index_path()
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_suffix(".lock"), timeout=_BUSY_SECONDS):
        if identity() != seen:
            return
        with replacing(path) as fresh:
            create(os.fspath(fresh)).close()
            path.with_name(f"{path.name}-journal").unlink(missing_ok=True)


def identity() -> int | None:
    """Return what tells the file of the index from one that replaces it; None if there is no index."""
    with contextlib.suppress(OSError):
        return index_path().stat().st_ino
    return None


def _connected(path: str) -> sqlite3.Connection:
    """Return the database at a path; its writers wait for one another."""
    database = sqlite3.connect(path, timeout=_BUSY_SECONDS, isolation_level=None)
    database.execute("PRAGMA synchronous = NORMAL")
    return database


def create(path: str) -> sqlite3.Connection:
    """Return a new, empty index."""
    database = _connected(path)
    for statement in _SCHEMA:
        database.execute(statement)
    database.execute(f"PRAGMA application_id = {_APPLICATION}")
    database.execute(f"PRAGMA user_version = {_VERSION}")
    return database


def pragma(database: sqlite3.Connection, name: str) -> int:
    """Return the value of a pragma."""
    return int(database.execute(f"PRAGMA {name}").fetchone()[0])


@contextlib.contextmanager
def transaction(database: sqlite3.Connection, kind: Literal["DEFERRED", "IMMEDIATE"]) -> Iterator[None]:
    """Make the block a transaction, or a part of the one that has begun."""
    if database.in_transaction:
        yield
        return
    database.execute(f"BEGIN {kind}")
    with database:
        yield


def write_rows(database: sqlite3.Connection, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write whole rows, replacing those of the same folders; within a transaction."""
    places = ", ".join(f":{name}" for name in STORED)
    database.executemany(f"INSERT OR REPLACE INTO runs VALUES ({places})", map(_storable, rows))


def _storable(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row as SQLite takes it: its whole numbers have 64 bits with a sign."""
    names = [name for name, kind in STORED.items() if kind == "REAL" and row[name] is not None]
    seed = None if row["seed"] is None else row["seed"] - SEED_SHIFT
    return {**row, **{name: float(row[name]) for name in names}, "seed": seed}
