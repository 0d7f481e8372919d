"""The table of the index, the row of a run in it, and the SQLite database in the user's cache that holds it.

The file is created atomically, and replaced when it is damaged or of another version. It has a rollback
journal, not a write-ahead log: the cache may be on a network disk, and transactions are short.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from runner.errors import RecordingError
from runner.recording.metrics import METRICS
from runner.recording.run_file import EvaluationMetrics
from runner.runs.branches import origin_in
from runner.runs.catalogue.columns import COLUMNS
from runner.runs.run import Run, listed_run
from runner.util.files import cache_folder, replacing
from runner.util.values import JsonView, is_number

if TYPE_CHECKING:
    from runner.util.processes import Tell

_MODES: Final = {"joint team": "cooperative", "per_agent individual": "competitive"}
_DEPTH: Final = 20
_LOGGED: Final = 64
_NAME: Final = 200
"""The most characters of a logged name."""
_TEXT: Final = 4000
"""The most characters of a text, and the most values of a configuration."""

SEED_SHIFT: Final = 2**63
"""Subtracted from a seed, from 0 to 2^64 - 1, so that SQLite's signed integers hold it in order."""
_TYPES: Final = {str: "TEXT", int: "INTEGER", float: "REAL"}
STORED: Final = {
    "root": "TEXT NOT NULL",  # the recordings folder, absolute
    "entry": "TEXT NOT NULL",  # the run's folder in it
    "fingerprint": "TEXT NOT NULL",  # changes with every change of its files
    # whether they had not just changed; if they had, they may change again with the same time
    "stable": "INTEGER NOT NULL",
    "problem": "TEXT",
    "tags": "TEXT",  # a tag a line
    **{column.name: _TYPES[column.type] for column in COLUMNS.values() if column.type},
    "origin": "TEXT",  # what it was branched from: a JSON object
    # The long texts come last, so that SQLite reads the other columns without them.
    "words": "TEXT",  # id, name, configuration's name, tags, note: a line each
    "settings": "TEXT",  # the configuration: a JSON object of dotted paths
}
"""The columns of the table `runs` with their types: a run's folder as it was last read.

A damaged run has a `problem`, other folders have no `id`.
"""


class Sql(NamedTuple):
    """A condition or an order in SQL, with the values of its parameters."""

    text: str
    values: tuple[object, ...] = ()


def row_of(run: Run, size: int | None) -> dict[str, object]:
    """Return the row of a run, by column, without place and fingerprint.

    Args:
        size: bytes of its recording; None if there is none.
    """
    config = run.file.config
    summary = run.summary
    recorded = {} if summary.episodes is not None else _recorded(run)
    last = summary.last_evaluation or EvaluationMetrics()
    done = {**recorded, **summary}
    recent = summary.recent_training or recorded.get("recent_training")
    episodes, train, evaluation = (done.get(key) for key in ("episodes", "train_steps", "eval_steps"))
    logged = islice(summary.logged.items(), _LOGGED)
    config_name = text(config.get("name"))
    environment = config.get("env")
    origin = origin_in(config)
    return {
        "id": run.run_id,
        "name": text(run.name),
        "config": config_name,
        "problem": text(run.problem) or None,
        "seed": run.file.seed if run.has_seed else None,
        "status": text(run.status),
        "tags": "\n".join(run.tags),
        "note": text(run.note),
        "words": text("\n".join([run.run_id, run.name, config_name or "", *run.tags, run.note]), 3 * _TEXT),
        "created": math.floor(run.created.timestamp() * 1000),
        "episodes": episodes,
        "episodes_to_do": run.episodes_to_do,
        "steps": None if train is None or evaluation is None else train + evaluation,
        "train_steps": train,
        "eval_steps": evaluation,
        **{metric.name: last.values.get(metric.name) for metric in METRICS},
        **({} if summary.last_evaluation or not recent else {"mean_return": recent.mean_return}),
        "logged": json.dumps({name: value for name, value in logged if text(name, _NAME) == name}),
        "seconds": summary.seconds,
        "bytes": size,
        "digest": summary.content_digest,
        "parent": None if origin is None else text(origin.run),
        "origin": None if origin is None else json.dumps(asdict(origin)),
        "mode": _MODES.get(f"{config.get('tables')} {config.get('rewards')}"),
        "environment": text(environment.get("id") if isinstance(environment, Mapping) else None),
        "host": text(run.file.provenance.get("host") or run.file.owner.get("host")),
        "git": text(run.file.provenance.get("git")),
        "archive": text(run.archive.target or None),
        "settings": json.dumps(_flat(config)),
    }


def _recorded(run: Run) -> Mapping[str, Any]:
    """Return the progress of a run that is running or was killed, from its recording; empty if unknown.

    A loop that has not been evaluated also has its `recent_training`.
    """
    from runner.recording.reader import open_recording

    if run.status == "archived":
        return run.archive.done
    if run.status in ("running", "interrupted", "failed") and run.recording.exists():
        with contextlib.suppress(RecordingError), open_recording(run.recording) as recording:
            done = recording.done()
            if not done["eval_steps"] and not recording.train.has_metrics:
                return {**done, "recent_training": recording.train.recent_means()}
            return done
    return {}


def text(value: object, max_length: int = _TEXT) -> str | None:
    """Return a text for SQLite, truncated; None if the value is not a text."""
    if not isinstance(value, str):
        return None
    return value[:max_length].encode(errors="replace").decode()


def _flat(config: JsonView) -> dict[str, object]:
    """Return the plain values in a configuration by dotted path; items of lists by their position."""
    flat: dict[str, object] = {}

    def put(parts: Iterable[tuple[object, object]], path: str, depth: int) -> None:
        for key, value in islice(parts, _TEXT):
            here = f"{path}{key}"
            kind = value.__class__
            if kind is dict or kind is list:
                if depth < _DEPTH:
                    inside: Any = value
                    put(enumerate(inside) if kind is list else inside.items(), f"{here}.", depth + 1)
            elif kind is str:
                flat[here] = text(value)
            elif value is None or kind is bool or is_number(value):
                flat[here] = value

    put(config.items(), "", 1)
    return flat


class Candidate(NamedTuple):
    """A run as the index has it."""

    root: str
    entry: str
    run_id: str
    name: str
    seed: int | None
    milliseconds: int

    @property
    def created(self) -> datetime:
        """When the run began, in UTC."""
        return datetime.fromtimestamp(self.milliseconds / 1000, UTC)

    def run(self, root: Path | None = None) -> Run:
        """Return the run; its path begins with `root`, which names the recordings folder as the user did.

        Raises:
            RunNotFound: it was removed in the meantime.
        """
        return listed_run(Path(root or self.root, self.entry), self.run_id)


INDEX_FILE: Final = "catalogue.sqlite"
_APPLICATION: Final = 0x44546178  # "DTax"
_SCHEMA: Final = (
    f"CREATE TABLE runs ({', '.join(' '.join(column) for column in STORED.items())}, "
    "PRIMARY KEY (root, entry)) WITHOUT ROWID",
    "CREATE INDEX runs_states ON runs (root, entry, fingerprint, stable, status)",
    "CREATE INDEX runs_ids ON runs (id)",
    "CREATE INDEX runs_digests ON runs (digest)",
    "CREATE INDEX runs_parents ON runs (parent)",
    "CREATE INDEX runs_names ON runs (root, created, id, name, seed)",
)
_VERSION: Final = zlib.crc32("11".join(_SCHEMA).encode()) >> 1
"""Identifies the schema, and by the number the contents; an index of another version is replaced."""
_BUSY_SECONDS: Final = 60


def index_path() -> Path:
    """Return the path of the index."""
    return cache_folder() / INDEX_FILE


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
    """Return the identity of the index file, which changes when it is replaced; None if there is no index."""
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
    """Make the block a transaction."""
    database.execute(f"BEGIN {kind}")
    with database:
        yield


def write_row(database: sqlite3.Connection, row: Mapping[str, Any]) -> None:
    """Write a whole row, replacing the one of the same folder; its whole numbers have 64 bits with a sign."""
    places = ", ".join(f":{name}" for name in STORED)
    seed = None if row["seed"] is None else row["seed"] - SEED_SHIFT
    reals = {
        name: float(row[name]) for name, kind in STORED.items() if kind == "REAL" and row[name] is not None
    }
    database.execute(f"INSERT OR REPLACE INTO runs VALUES ({places})", {**row, **reals, "seed": seed})
