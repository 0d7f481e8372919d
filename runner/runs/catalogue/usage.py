"""Disk usage of runs: the files in their folders, and what is cached for them."""

from __future__ import annotations

import contextlib
import heapq
import os
import re
import stat
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from runner.recording.labels import KEEP, LABELS_FILE, LOCK_FILE
from runner.recording.marks import MARKS_FILE, MARKS_LOCK
from runner.runs.catalogue.columns import IndexRow
from runner.runs.catalogue.filters import Filter
from runner.runs.catalogue.index import CatalogueIndex
from runner.runs.checkpoints import Store
from runner.runs.run import RECORDING_FILE, RUN_FILE, RUN_LOCK, UNLISTED
from runner.runs.trust_marks import MARK_FILE
from runner.util.files import (
    CACHED_EPISODES,
    CACHED_EXPORTS,
    CACHED_RECORDINGS,
    RUN_SEPARATOR,
    cache_folder,
)

REMOVED: Final = ".removed-"
"""The prefix of a run's folder from the moment it is removed until its files are deleted."""
KINDS: Final = ("recording", "checkpoints", "exports", "restored", "other")
"""The kinds of bytes."""
FREED_BY: Final = {
    "same_content": ("Duplicates", "The same content was recorded before: `dualtaxi rm` removes runs."),
    "unfinished": (
        "Unfinished",
        "`dualtaxi prune --status interrupted --status failed`, if they are not to be resumed.",
    ),
    "left_over": ("Left over", "Damaged originals that a repair kept, and files of interrupted commands."),
    "cached": ("Cached", "Created again when needed."),
    "explanations": (
        "Explanations",
        "What was trained for them: `dualtaxi prune --explanations` removes it.",
    ),
    "half_removed": ("Half removed", "The next `dualtaxi rm` or `prune` removes the rest."),
}
"""What could be freed, with its heading and how to do it."""

_OWN: Final = frozenset(
    (RUN_FILE, RECORDING_FILE, LABELS_FILE, MARK_FILE, LOCK_FILE, MARKS_FILE, MARKS_LOCK, RUN_LOCK)
)
_LEFT_OVER: Final = re.compile(
    r"recording\.(resuming|repairing|rerecording|restoring)|recording\.damaged-\d+\.mcap"
    r"|\.[0-9a-f]{8}\.(run|labels|marks|trust)\.json|(run|labels)\.[0-9a-f]{8}\.tmp"
)
_COLUMNS: Final = ("root", "entry", "id", "name", "status", "tags", "digest")
"""The columns of the index that `usage_of` needs of a run."""
_KEY: Final = re.compile(r"-[0-9a-f]+(\.\w+)+$")
"""The end of a cached file's name, after the ids."""


@dataclass(slots=True)
class Contents:
    """The bytes in a run's folder."""

    recording: int = 0
    other: int = 0
    """All other files, including foreign ones."""
    left_over: int = 0
    """Those of them that a repair or an interrupted command left."""
    freed: int = 0
    """Freed by removing the run's own files; those with other links free nothing."""
    foreign: list[str] = field(default_factory=list)
    """Names that no run has: the user's own files, folders, links."""


def contents_of(folder: str | Path) -> Contents:
    """Return what is in a run's folder.

    Raises:
        OSError: it cannot be read.
    """
    contents = Contents()
    with os.scandir(folder) as entries:
        for entry in entries:
            try:
                facts = entry.stat(follow_symlinks=False)
            except FileNotFoundError:
                continue
            is_own = stat.S_ISREG(facts.st_mode) and belongs(entry.name)
            size = _size_within(entry.path) if stat.S_ISDIR(facts.st_mode) else facts.st_size
            if entry.name == RECORDING_FILE and is_own:
                contents.recording = size
            else:
                contents.other += size
            if is_own:
                contents.freed += size if facts.st_nlink == 1 else 0
                contents.left_over += size if _LEFT_OVER.fullmatch(entry.name) else 0
            else:
                contents.foreign.append(entry.name)
    contents.foreign.sort()
    return contents


def belongs(name: str) -> bool:
    """Return whether a file of this name in a run's folder is the run's."""
    return name in _OWN or _LEFT_OVER.fullmatch(name) is not None


def cached(part: str) -> Counter[str]:
    """Return the bytes cached for each run, by its id; what is for several counts for the first.

    Args:
        part: the folder in the cache, such as `CACHED_EXPORTS`.
    """
    by_run: Counter[str] = Counter()
    with contextlib.suppress(OSError), os.scandir(cache_folder() / part) as entries:
        for entry in entries:
            is_folder = entry.is_dir(follow_symlinks=False)
            size = _size_within(entry.path) if is_folder else entry.stat(follow_symlinks=False).st_size
            by_run[_KEY.sub("", entry.name).partition(RUN_SEPARATOR)[0]] += size
    return by_run


class Usage(NamedTuple):
    """The disk usage of a run."""

    row: IndexRow
    """The run's row in the index, with `same_as`."""
    bytes: dict[str, int]
    """By kind, and their total. What several runs share of checkpoints counts for one of them."""


@dataclass
class Sums:
    """The disk usage of several runs together."""

    runs: int = 0
    bytes: dict[str, int] = field(default_factory=lambda: dict.fromkeys((*KINDS, "total"), 0))
    """By kind, and their total."""
    freed: Counter[str] = field(default_factory=Counter)
    """Bytes of unprotected runs that could be freed, by reason: the first three in `FREED_BY`."""

    def freeable(self, recordings: Sequence[Path]) -> dict[str, int]:
        """Return the bytes that could be freed, by reason.

        Args:
            recordings: the folders searched for runs whose removal was interrupted.
        """
        interrupted = [contents_of(stray) for root in recordings for stray in strays(root)]
        return {
            "same_content": self.freed["same_content"],
            "unfinished": self.freed["unfinished"],
            "left_over": self.freed["left_over"],
            "cached": self.bytes["exports"] + self.bytes["restored"],
            "explanations": sum(_size_within(str(root / UNLISTED.parent)) for root in recordings),
            "half_removed": sum(contents.recording + contents.other for contents in interrupted),
        }

    def add(self, usage: Usage, contents: Contents) -> None:
        """Add a run."""
        row = usage.row
        self.runs += 1
        for kind, count in usage.bytes.items():
            self.bytes[kind] += count
        if KEEP in row["tags"].split() or row["status"] == "running":
            return
        self.freed["left_over"] += contents.left_over
        self.freed["same_content"] += contents.freed if row["same_as"] else 0
        self.freed["unfinished"] += contents.freed if row["status"] in ("interrupted", "failed") else 0


def usage_of(
    read: Callable[[Callable[[CatalogueIndex], list[IndexRow]]], list[IndexRow]],
    run_filter: Filter,
    limit: int | None,
) -> tuple[list[Usage], Sums]:
    """Return the runs that use most of the disk, the largest first, and the sums over all runs.

    The folders are measured after the index was read: that may take long, and must not keep others from
    writing to it.

    Args:
        read: calls some work with the index and returns its result, as `look` does.
    """
    exports = cached(CACHED_EXPORTS) + cached(CACHED_EPISODES)
    restored = cached(CACHED_RECORDINGS)
    rows = read(lambda index: index.with_same_as(index.select(run_filter, columns=_COLUMNS)))
    checkpoints = {root: Store(Path(root)).sizes() for root in {row["root"] for row in rows}}
    sums = Sums()

    def measured() -> Iterator[Usage]:
        for row in rows:
            root, entry, run_id = row["root"], row["entry"], row["id"]
            try:
                contents = contents_of(f"{root}{os.sep}{entry}")
            except OSError:
                contents = Contents()  # removed just now
            shared = checkpoints[root].get(entry, 0)
            counts = (contents.recording, shared, exports[run_id], restored[run_id], contents.other)
            usage = Usage(row, dict(zip(KINDS, counts, strict=True)) | {"total": sum(counts)})
            sums.add(usage, contents)
            yield usage

    largest = heapq.nsmallest(
        len(rows) if limit is None else limit,
        measured(),
        key=lambda usage: (-usage.bytes["total"], usage.row["id"]),
    )
    return largest, sums


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
