"""Recordings folders as they are now, and how that differs from what the index has of them.

Each run's files are looked at from outside (size and time), and read where they changed.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from peewee import SqliteDatabase, chunked

from runner.catalogue.database import tuples_of
from runner.catalogue.rows import Row, row_of
from runner.labels import LABELS_FILE
from runner.runs import RECORDING_FILE, RUN_FILE, run_entries, runs_in

_SETTLED_NS: Final = 2 * 10**9
"""Files that changed so recently may change again without a trace: they are read again next time."""
_RUN_FILES: Final = (RUN_FILE, LABELS_FILE, RECORDING_FILE)


@dataclass(frozen=True)
class News:
    """What is not yet in the index of a recordings folder."""

    root: str
    changed: list[dict[str, Any]]
    """The rows of the folders that are new, or not as they were."""
    died: list[str]
    """Runs whose process is no more, and could not say so."""
    gone: list[str]
    """Folders that are no more."""


class Folders:
    """Some recordings folders, and the index that is to agree with them."""

    def __init__(self, database: SqliteDatabase, roots: Sequence[str]) -> None:
        self._database = database
        self._roots = roots
        self._found: dict[str, dict[str, Seen]] = {}
        self._read: set[tuple[str, str]] = set()
        """The runs' folders that were read, as root and entry."""

    def news(self) -> list[News]:
        """Return how the folders, as they were when first asked, differ from what is in the index now.

        Raises:
            StorageError: a recordings folder cannot be read.
        """
        if not self._found:
            self._found = {root: dict(_scan(root)) for root in self._roots}
        found = [self._news(root) for root in self._found]
        return [news for news in found if news.changed or news.died or news.gone]

    def write(self, found: Sequence[News]) -> None:
        """Take in what was found; within a transaction."""
        for news in found:
            for rows in chunked(news.changed, 500):
                Row.insert_many(rows).on_conflict_replace().execute(self._database)
            here = Row.root == news.root
            for entries in chunked(news.died, 500):
                died = Row.update(status="interrupted").where(here & Row.entry.in_(entries))
                died.execute(self._database)
            for entries in chunked(news.gone, 500):
                Row.delete().where(here & Row.entry.in_(entries)).execute(self._database)
            self._read |= {(news.root, row["entry"]) for row in news.changed}

    def forget(self) -> None:
        """Forget all about these folders, and about those that are no more."""
        known = [root for (root,) in tuples_of(self._database, Row.select(Row.root).distinct())]
        stale = [root for root in known if root in self._roots or not os.path.isdir(root)]  # noqa: PTH112
        Row.delete().where(Row.root.in_(stale)).execute(self._database)

    def _news(self, root: str) -> News:
        found, known = self._found[root], self._known(root)
        now = time.time_ns()
        changed = [
            entry for entry, seen in found.items() if self._changed(root, entry, seen, known.get(entry))
        ]
        running = [entry for entry, (*_, status) in known.items() if status == "running" and entry in found]
        return News(
            root,
            changed=[_read(root, entry, found[entry], now) for entry in changed],
            died=[entry for entry in set(running) - set(changed) if not _runs(root, entry)],
            gone=[entry for entry in known if entry not in found and _seen(root, entry) is None],
        )

    def _changed(self, root: str, entry: str, seen: Seen, known: tuple[str, int, str | None] | None) -> bool:
        if known is None or known[0] != seen.fingerprint:
            return True
        return not known[1] and (root, entry) not in self._read

    def _known(self, root: str) -> dict[str, tuple[str, int, str | None]]:
        rows = Row.select(Row.entry, Row.fingerprint, Row.settled, Row.status).where(Row.root == root)
        found = tuples_of(self._database, rows)
        return {entry: (mark, settled, status) for entry, mark, settled, status in found}


class Seen(NamedTuple):
    """A run's folder as it looks from outside."""

    fingerprint: str
    changed: int
    """When one of its files last did, in nanoseconds since 1970."""
    size: int | None
    """Bytes of its recording."""


def _scan(root: str) -> Iterator[tuple[str, Seen]]:
    """Yield the folders that have a run's files, by name."""
    for entry in run_entries(Path(root)):
        seen = _seen(root, entry)
        if seen is not None and entry.isprintable():
            yield entry, seen


def _seen(root: str, entry: str) -> Seen | None:
    """Return how a folder looks from outside; None if it has no run's files."""
    marks, changed, size = [], 0, None
    for name in _RUN_FILES:
        try:
            facts = os.stat(f"{root}{os.sep}{entry}{os.sep}{name}")  # noqa: PTH116 - Path takes thrice as long
        except OSError:
            marks.append("")
            continue
        marks.append(f"{facts.st_mtime_ns}.{facts.st_size}.{facts.st_ino}")
        changed = max(changed, facts.st_mtime_ns)
        size = facts.st_size if name == RECORDING_FILE else None
    return Seen(" ".join(marks), changed, size) if marks[0] or marks[2] else None


def _runs(root: str, entry: str) -> bool:
    return any(run.status == "running" for run in runs_in(Path(root, entry)))


def _read(root: str, entry: str, seen: Seen, now: int) -> dict[str, Any]:
    """Return the row of a folder, read now."""
    folder = Path(root, entry)
    settled = seen.changed + _SETTLED_NS < now
    place = {"root": root, "entry": entry, "fingerprint": seen.fingerprint, "settled": settled}
    for run in runs_in(folder):
        return _EMPTY | place | row_of(run, seen.size)
    problem = f"{folder}: neither {RUN_FILE} nor {RECORDING_FILE} can be read as a run's."
    return _EMPTY | place | {"problem": problem}


_EMPTY: Final[dict[str, Any]] = dict.fromkeys(Row._meta.sorted_field_names)
