"""What uses the disk: the files in runs' folders, and what is cached for them."""

from __future__ import annotations

import contextlib
import os
import re
import stat
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

from peewee import Case, DatabaseError, Value, chunked, fn

from runner.recording.labels import KEEP, LABELS_FILE, LOCK_FILE
from runner.runs.catalogue.columns import with_originals
from runner.runs.catalogue.database import keep_usage, opened
from runner.runs.catalogue.filters import Filter
from runner.runs.catalogue.index import Index
from runner.runs.catalogue.rows import Row
from runner.runs.locking import RUN_LOCK
from runner.runs.run import RECORDING_FILE, RUN_FILE
from runner.util.files import EXPORTS, RESTORED, RUN_SEPARATOR, TABLES, cache_folder

REMOVED: Final = ".removed-"
"""What the folder of a run is called from the moment it is removed until its files are."""

_OWN: Final = frozenset((RUN_FILE, RECORDING_FILE, LABELS_FILE, LOCK_FILE, RUN_LOCK))
_LEFT_OVER: Final = re.compile(
    r"recording\.(anew|repairing|rerecording|restoring)|recording\.damaged-\d+\.mcap"
    r"|\.[0-9a-f]{8}\.(run|labels)\.json|(run|labels)\.[0-9a-f]{8}\.tmp"
)
_KEY: Final = re.compile(r"-[0-9a-f]+(\.\w+)+$")
"""What follows the ids in the name of a cached file."""


@dataclass(slots=True)
class Contents:
    """What is in a run's folder, in bytes; links to elsewhere and files with other names count as nothing."""

    recording: int = 0
    other: int = 0
    """All else, what is strange too."""
    left_over: int = 0
    """Of that: what a repair or an interrupted command left behind."""
    freed: int = 0
    """What removing the run's own files would free."""
    strange: list[str] = field(default_factory=list)
    """Names that are no run's: files of the user's own, folders, links."""


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
                found.strange.append(entry.name)
    found.strange.sort()
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
    for name, size in _sizes(cache_folder() / part):
        found[_KEY.sub("", name).partition(RUN_SEPARATOR)[0]] += size
    return found


@dataclass(frozen=True)
class Usage:
    """What a run uses of the disk, in bytes."""

    row: dict[str, Any]
    """The run, as the index has it."""
    contents: Contents
    exports: int
    restored: int

    @property
    def total(self) -> int:
        """All of it."""
        return self.contents.recording + self.contents.other + self.exports + self.restored

    @classmethod
    def of(cls, row: dict[str, Any], exports: Mapping[str, int], restored: Mapping[str, int]) -> Usage:
        """Return the usage of a run that the index keeps, given the bytes cached by id."""
        contents = Contents(
            row["used_recording"], row["used_other"], row["used_left_over"], row["used_freed"]
        )
        return cls(row, contents, exports.get(row["id"], 0), restored.get(row["id"], 0))


USED_BY: Final = (
    *("root", "entry", "id", "name", "status", "tags", "digest", "fingerprint", "mark", "settled"),
    *("used_recording", "used_other", "used_left_over", "used_freed"),
)
"""The columns of the index that a `Usage` needs."""


@dataclass
class Sums:
    """Bytes that several runs use together."""

    runs: int = 0
    """How many runs these are."""
    recording: int = 0
    exports: int = 0
    restored: int = 0
    other: int = 0
    same_content: int = 0
    """What removing runs whose content another run recorded first would free; without protected runs."""
    unfinished: int = 0
    """What removing interrupted and failed runs would free; without protected runs."""
    left_over: int = 0
    """What repairs and interrupted commands left behind; without protected runs."""

    def by_kind(self) -> dict[str, int]:
        """Return the bytes by what they are, and their total."""
        kinds = {
            "recording": self.recording,
            "exports": self.exports,
            "restored": self.restored,
            "other": self.other,
        }
        return {**kinds, "total": sum(kinds.values())}

    def freeable(self, recordings: Sequence[Path]) -> dict[str, int]:
        """Return the bytes that could be freed, by what they are.

        Args:
            recordings: the folders searched for runs whose removal was cut off.
        """
        cut_off = [contents_of(stray) for root in recordings for stray in strays(root)]
        return {
            "same_content": self.same_content,
            "unfinished": self.unfinished,
            "left_over": self.left_over,
            "cached": self.exports + self.restored,
            "half_removed": sum(contents.recording + contents.other for contents in cut_off),
        }

    def add(self, usage: Usage) -> None:
        """Add a run whose folder was measured just now."""
        row, contents = usage.row, usage.contents
        self.runs += 1
        self.recording += contents.recording
        self.other += contents.other
        if KEEP in row["tags"].split() or row["status"] == "running":
            return
        self.left_over += contents.left_over
        self.same_content += contents.freed if row["same_as"] else 0
        self.unfinished += contents.freed if row["status"] in ("interrupted", "failed") else 0


def sizes(usages: Iterable[Usage]) -> dict[str, int]:
    """Return the bytes that a few runs use, by what they are, and their total."""
    sums = Sums()
    for usage in usages:
        sums.recording += usage.contents.recording
        sums.exports += usage.exports
        sums.restored += usage.restored
        sums.other += usage.contents.other
    return sums.by_kind()


def usage_of(
    read: Callable[[Callable[[Index], _Parts]], _Parts], chosen: Filter, limit: int | None
) -> tuple[list[Usage], Sums]:
    """Return the runs that use most of the disk, the largest first, and the sums over all runs.

    SQLite adds up and sorts what the index keeps. Folders that it knows nothing of, or that changed, are
    measured here, after the index was read: that may take long, and must not keep others from writing to it.

    Args:
        read: does some work on the index and returns what came of it, as `look` does.
        chosen: which runs.
        limit: how many of the largest runs to return at most; all if None.
    """
    exports, restored = cached(EXPORTS) + cached(TABLES), cached(RESTORED)
    with_cache = {*exports, *restored}
    parts = read(lambda index: _parts(index, chosen, with_cache, limit))
    fresh, sums = [], parts.sums
    found = {(row["root"], row["entry"]): Usage.of(row, exports, restored) for row in parts.kept}
    measured = []
    for row in parts.unknown:
        contents = _contents(row)
        if row["settled"] and row["status"] != "running" and not contents.strange:
            fresh.append((row, contents))
        usage = Usage(row, contents, exports[row["id"]], restored[row["id"]])
        sums.add(usage)
        measured.append(usage)
    if fresh:
        _keep(fresh)
    every = [*found.values(), *measured]
    sums.exports = sum(usage.exports for usage in every)
    sums.restored = sum(usage.restored for usage in every)
    every.sort(key=lambda usage: (-usage.total, usage.row["id"]))
    return every[:limit], sums


class _Parts(NamedTuple):
    """What the index knows of the runs' usage."""

    sums: Sums
    """Over the runs whose usage it keeps; without cached files."""
    kept: list[dict[str, Any]]
    """Of these runs: the largest, and all that have cached files."""
    unknown: list[dict[str, Any]]
    """The runs whose folders have to be measured."""


def _parts(index: Index, chosen: Filter, with_cache: set[str], limit: int | None) -> _Parts:
    is_kept = Row.used_recording.is_null(False)
    sums = Sums(*index.sums(chosen.also(is_kept), _columns(index)))
    own = Row.used_recording + Row.used_other
    kept = index.largest(chosen.also(is_kept), own, limit, USED_BY)
    if limit is not None:  # a run that is small by itself may have large files in the cache
        for ids in chunked(sorted(with_cache), 500):
            kept += index.select(chosen.also(is_kept & Row.id.in_(ids)), columns=USED_BY)
    unknown = index.select(chosen.also(Row.used_recording.is_null()), columns=USED_BY)
    with_originals([*kept, *unknown], index)
    return _Parts(sums, kept, unknown)


def _columns(index: Index) -> list[Any]:
    """Return the sums that make the fields of `Sums`, in their order."""
    line = "\n"
    protected = fn.INSTR(Value(line).concat(Row.tags).concat(line), f"{line}{KEEP}{line}") > 0
    free = ~protected & (Row.status != "running")

    def total(condition: Any, column: Any) -> Any:
        return fn.SUM(Case(None, [(condition, column)], 0))

    return [
        fn.COUNT(Row.entry),
        fn.SUM(Row.used_recording),
        Value(0),
        Value(0),
        fn.SUM(Row.used_other),
        total(free & index.is_copy(), Row.used_freed),
        total(free & Row.status.in_(("interrupted", "failed")), Row.used_freed),
        total(free, Row.used_left_over),
    ]


def _keep(fresh: Sequence[tuple[dict[str, Any], Contents]]) -> None:
    """Keep in the index what was found in folders, where it still has them as they were; if it can be."""
    values = [
        (
            *(each.recording, each.other, each.left_over, each.freed),
            *(row["root"], row["entry"], row["mark"], row["fingerprint"]),
        )
        for row, each in fresh
    ]
    with contextlib.suppress(DatabaseError, OSError), contextlib.closing(opened(lambda _: None)) as database:
        keep_usage(database, values)


def strays(root: Path) -> list[Path]:
    """Return the folders of runs that were being removed when the command doing so was ended."""
    try:
        with os.scandir(root) as entries:
            return sorted(
                Path(entry.path)
                for entry in entries
                if entry.name.startswith(REMOVED) and entry.is_dir(follow_symlinks=False)
            )
    except OSError:
        return []


def _contents(row: dict[str, Any]) -> Contents:
    try:
        return contents_of(Path(row["root"], row["entry"]))
    except OSError:
        return Contents()  # removed just now


def _sizes(folder: Path) -> Iterator[tuple[str, int]]:
    """Yield name and bytes of what is in a folder; nothing if it is not there."""
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                is_folder = entry.is_dir(follow_symlinks=False)
                yield (
                    entry.name,
                    _size_within(entry.path) if is_folder else entry.stat(follow_symlinks=False).st_size,
                )
    except OSError:
        return


def _size_within(folder: str) -> int:
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            try:
                total += os.lstat(os.path.join(place, name)).st_size  # noqa: PTH118
            except OSError:
                continue
    return total
