"""Disk usage of runs: the files in their folders, and what is cached for them."""

from __future__ import annotations

import contextlib
import os
import re
import stat
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple

from peewee import Case, DatabaseError, Value, chunked, fn

from runner.recording.labels import KEEP, LABELS_FILE, LOCK_FILE
from runner.runs.catalogue.columns import IndexRow
from runner.runs.catalogue.database import open_index
from runner.runs.catalogue.filters import Filter
from runner.runs.catalogue.index import Index
from runner.runs.catalogue.rows import Expression, Row
from runner.runs.locking import RUN_LOCK
from runner.runs.run import RECORDING_FILE, RUN_FILE, UNLISTED
from runner.runs.store import Store
from runner.util.files import EXPORTS, RESTORED, RUN_SEPARATOR, TABLES, cache_folder

REMOVED: Final = ".removed-"
"""The prefix of a run's folder from the moment it is removed until its files are deleted."""
KINDS: Final = ("recording", "checkpoints", "exports", "restored", "other")
"""The kinds of bytes, attributes of `Usage` and `Sums`."""

_OWN: Final = frozenset((RUN_FILE, RECORDING_FILE, LABELS_FILE, LOCK_FILE, RUN_LOCK))
_LEFT_OVER: Final = re.compile(
    r"recording\.(resuming|repairing|rerecording|restoring)|recording\.damaged-\d+\.mcap"
    r"|\.[0-9a-f]{8}\.(run|labels)\.json|(run|labels)\.[0-9a-f]{8}\.tmp"
)
_KEY: Final = re.compile(r"-[0-9a-f]+(\.\w+)+$")
"""The end of a cached file's name, after the ids."""


@dataclass(slots=True)
class Contents:
    """The bytes in a run's folder."""

    recording: int = 0
    other: int = 0
    """All other files, including foreign ones."""
    left_over: int = 0
    """Of these: files left by a repair or an interrupted command."""
    freed: int = 0
    """Freed by removing the run's own files; those with other links free nothing."""
    foreign: list[str] = field(default_factory=list)
    """Names that no run has: the user's own files, folders, links."""


def contents_of(folder: Path) -> Contents:
    """Return what is in a run's folder.

    Raises:
        OSError: it cannot be read.
    """
    found = Contents()
    with os.scandir(folder) as entries:
        for entry in entries:
            try:
                facts = entry.stat(follow_symlinks=False)
            except FileNotFoundError:
                continue
            own = stat.S_ISREG(facts.st_mode) and belongs(entry.name)
            size = _size_within(entry.path) if stat.S_ISDIR(facts.st_mode) else facts.st_size
            if entry.name == RECORDING_FILE and own:
                found.recording = size
            else:
                found.other += size
            if own:
                found.freed += size if facts.st_nlink == 1 else 0
                found.left_over += size if _LEFT_OVER.fullmatch(entry.name) else 0
            else:
                found.foreign.append(entry.name)
    found.foreign.sort()
    return found


def belongs(name: str) -> bool:
    """Return whether a file of this name in a run's folder is the run's."""
    return name in _OWN or _LEFT_OVER.fullmatch(name) is not None


def cached(part: str) -> Counter[str]:
    """Return the bytes cached for each run, by its id; what is for several counts for the first.

    Args:
        part: the folder in the cache: `EXPORTS`, `TABLES` or `RESTORED`.
    """
    found: Counter[str] = Counter()
    with contextlib.suppress(OSError), os.scandir(cache_folder() / part) as entries:
        for entry in entries:
            is_folder = entry.is_dir(follow_symlinks=False)
            size = _size_within(entry.path) if is_folder else entry.stat(follow_symlinks=False).st_size
            found[_KEY.sub("", entry.name).partition(RUN_SEPARATOR)[0]] += size
    return found


def sizes(usages: Sequence[Usage | Sums]) -> dict[str, int]:
    """Return the bytes that runs use together, by kind, and their total."""
    found = {kind: sum(getattr(usage, kind) for usage in usages) for kind in KINDS}
    return found | {"total": sum(found.values())}


@dataclass(frozen=True)
class Usage:
    """The disk usage of a run, in bytes."""

    row: IndexRow
    """The run's row in the index."""
    contents: Contents
    checkpoints: int
    """The contents of its checkpoints; what several runs share counts for one of them."""
    exports: int
    restored: int

    @property
    def recording(self) -> int:
        """Bytes of its recording."""
        return self.contents.recording

    @property
    def other(self) -> int:
        """Bytes of the other files in its folder."""
        return self.contents.other

    @property
    def total(self) -> int:
        """All bytes."""
        return self.recording + self.other + self.checkpoints + self.exports + self.restored


COLUMNS_OF_USAGE: Final = (
    *("root", "entry", "id", "name", "status", "tags", "digest", "fingerprint", "mark", "stable"),
    *("used_recording", "used_other", "used_left_over", "used_freed"),
)
"""The columns of the index that a `Usage` needs."""


@dataclass
class Sums:
    """The disk usage of several runs together, in bytes."""

    runs: int = 0
    recording: int = 0
    other: int = 0
    same_content: int = 0
    """Freed by removing runs whose content another run recorded first; not counting protected runs."""
    unfinished: int = 0
    """Freed by removing interrupted and failed runs; not counting protected runs."""
    left_over: int = 0
    """Left by repairs and interrupted commands; not counting protected runs."""
    checkpoints: int = 0
    exports: int = 0
    restored: int = 0

    def by_kind(self) -> dict[str, int]:
        """Return the bytes by kind, and their total."""
        return sizes([self])

    def freeable(self, recordings: Sequence[Path]) -> dict[str, int]:
        """Return the bytes that could be freed, by reason.

        Args:
            recordings: the folders searched for runs whose removal was interrupted.
        """
        interrupted = [contents_of(stray) for root in recordings for stray in strays(root)]
        return {
            "same_content": self.same_content,
            "unfinished": self.unfinished,
            "left_over": self.left_over,
            "cached": self.exports + self.restored,
            "explanations": sum(_size_within(str(root / UNLISTED.parent)) for root in recordings),
            "half_removed": sum(contents.recording + contents.other for contents in interrupted),
        }

    def add(self, usage: Usage) -> None:
        """Add a run whose folder was measured just now, without its cached files."""
        row, contents = usage.row, usage.contents
        self.runs += 1
        self.recording += contents.recording
        self.other += contents.other
        if KEEP in row["tags"].split() or row["status"] == "running":
            return
        self.left_over += contents.left_over
        self.same_content += contents.freed if row["same_as"] else 0
        self.unfinished += contents.freed if row["status"] in ("interrupted", "failed") else 0


def usage_of(
    read: Callable[[Callable[[Index], _Stored]], _Stored], chosen: Filter, limit: int | None
) -> tuple[list[Usage], Sums]:
    """Return the runs that use most of the disk, the largest first, and the sums over all runs.

    SQLite adds up and sorts what the index has. Folders that are new or changed are measured here, after the
    index was read: that may take long, and must not keep others from writing to it.

    Args:
        read: calls some work with the index and returns its result, as `look` does.
    """
    exports, restored = cached(EXPORTS) + cached(TABLES), cached(RESTORED)
    contents_in = lru_cache(lambda root: Store(Path(root)).sizes())

    def read_index(index: Index) -> _Stored:
        with_more = {*exports, *restored}.union(*map(contents_in, index.roots))
        return _stored(index, chosen, with_more, limit)

    stored = read(read_index)

    def usage(row: IndexRow, contents: Contents) -> Usage:
        kept = contents_in(row["root"]).get(row["entry"], 0)
        return Usage(row, contents, kept, exports[row["id"]], restored[row["id"]])

    found = {
        (row["root"], row["entry"]): usage(row, Contents(*(row[name] for name in COLUMNS_OF_USAGE[-4:])))
        for row in stored.measured
    }
    every, sums, measured = list(found.values()), stored.sums, []
    for row in stored.unmeasured:
        try:
            contents = contents_of(Path(row["root"], row["entry"]))
        except OSError:
            contents = Contents()  # removed just now
        if row["stable"] and row["status"] != "running" and not contents.foreign:
            measured.append((row, contents))
        every.append(usage(row, contents))
        sums.add(every[-1])
    if measured:
        _store(measured)
    sums.checkpoints = sum(each.checkpoints for each in every)
    sums.exports = sum(each.exports for each in every)
    sums.restored = sum(each.restored for each in every)
    every.sort(key=lambda usage: (-usage.total, usage.row["id"]))
    return every[:limit], sums


class _Stored(NamedTuple):
    """What the index has of the runs' usage."""

    sums: Sums
    """Over the measured runs; without cached files."""
    measured: list[IndexRow]
    """Of the measured runs: the largest, and all that have cached files."""
    unmeasured: list[IndexRow]
    """The runs whose folders have to be measured."""


def _stored(index: Index, chosen: Filter, with_cache: set[str], limit: int | None) -> _Stored:
    is_measured = Row.used_recording.is_null(False)
    sums = Sums(*index.sums(chosen.also(is_measured), _summed(index)))
    own = Row.used_recording + Row.used_other
    measured = index.largest(chosen.also(is_measured), own, limit, COLUMNS_OF_USAGE)
    if limit is not None:  # a run that is small by itself may have large files in the cache
        for ids in chunked(sorted(with_cache), 500):
            measured += index.select(chosen.also(is_measured & Row.id.in_(ids)), columns=COLUMNS_OF_USAGE)
    unmeasured = index.select(chosen.also(Row.used_recording.is_null()), columns=COLUMNS_OF_USAGE)
    index.with_same_as([*measured, *unmeasured])
    return _Stored(sums, measured, unmeasured)


def _summed(index: Index) -> list[object]:
    """Return the sums for the fields of `Sums`, in their order, without the last two."""
    line = "\n"
    protected = fn.INSTR(Value(line).concat(Row.tags).concat(line), f"{line}{KEEP}{line}") > 0
    free = ~protected & (Row.status != "running")

    def total(condition: Expression, column: Expression) -> Expression:
        return fn.SUM(Case(None, [(condition, column)], 0))

    return [
        fn.COUNT(Row.entry),
        fn.SUM(Row.used_recording),
        fn.SUM(Row.used_other),
        total(free & index.is_copy(), Row.used_freed),
        total(free & Row.status.in_(("interrupted", "failed")), Row.used_freed),
        total(free, Row.used_left_over),
    ]


def _store(measured: Sequence[tuple[IndexRow, Contents]]) -> None:
    """Store what was measured in the index, if it can be written; not of folders that changed since."""
    statement = (
        f"UPDATE {Row._meta.table_name} SET used_recording=?, used_other=?, used_left_over=?, used_freed=? "
        "WHERE root=? AND entry=? AND mark=? AND fingerprint=?"
    )
    values = [
        (
            *(contents.recording, contents.other, contents.left_over, contents.freed),
            *(row["root"], row["entry"], row["mark"], row["fingerprint"]),
        )
        for row, contents in measured
    ]
    with (
        contextlib.suppress(DatabaseError, OSError),
        contextlib.closing(open_index(lambda _: None)) as database,
        database.atomic("IMMEDIATE"),
    ):
        database.connection().executemany(statement, values)  # type: ignore[no-untyped-call]


def strays(root: Path) -> list[Path]:
    """Return the folders of runs whose removal was interrupted."""
    with contextlib.suppress(OSError), os.scandir(root) as entries:
        return sorted(
            Path(entry.path)
            for entry in entries
            if entry.name.startswith(REMOVED) and entry.is_dir(follow_symlinks=False)
        )
    return []


def _size_within(folder: str) -> int:
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):
                total += os.lstat(os.path.join(place, name)).st_size  # noqa: PTH118
    return total
