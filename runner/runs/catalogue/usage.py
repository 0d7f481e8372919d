"""What uses the disk: the files in runs' folders, and what is cached for them."""

from __future__ import annotations

import contextlib
import os
import re
import stat
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from peewee import DatabaseError

from runner.recording.labels import KEEP, LABELS_FILE, LOCK_FILE
from runner.runs.catalogue.database import keep_usage, opened
from runner.runs.locking import RUN_LOCK
from runner.runs.run import RECORDING_FILE, RUN_FILE
from runner.util.cache import EXPORTS, RESTORED, RUN_SEPARATOR, TABLES, cache_folder

REMOVED: Final = ".removed-"
"""What the folder of a run is called from the moment it is removed until its files are."""

_OWN: Final = frozenset((RUN_FILE, RECORDING_FILE, LABELS_FILE, LOCK_FILE, RUN_LOCK))
_LEFT_OVER: Final = re.compile(
    r"recording\.(anew|repairing|rerecording|restoring)|recording\.damaged-\d+\.mcap|(run|labels)\.[0-9a-f]{8}\.tmp"
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


USED_BY: Final = (
    *("root", "entry", "id", "name", "status", "tags", "digest", "problem", "fingerprint", "mark", "settled"),
    *("used_recording", "used_other", "used_left_over", "used_freed"),
)
"""The columns of the index that `usages` needs."""


def usages(rows: Sequence[dict[str, Any]]) -> list[Usage]:
    """Return what runs use of the disk, the largest first.

    What is found in a folder is kept in the index: it is looked at again when something in it changed.
    """
    exports, restored = cached(EXPORTS) + cached(TABLES), cached(RESTORED)
    found, fresh = [], []
    for row in rows:
        contents = _kept_contents(row)
        if contents is None:
            contents = _contents(row)
            if row["settled"] and row["status"] != "running" and not contents.strange:
                fresh.append((row, contents))
        found.append(Usage(row, contents, exports[row["id"]], restored[row["id"]]))
    if fresh:
        _keep(fresh)
    return sorted(found, key=lambda usage: (-usage.total, usage.row["id"]))


def _kept_contents(row: dict[str, Any]) -> Contents | None:
    if row["used_recording"] is None:
        return None
    return Contents(row["used_recording"], row["used_other"], row["used_left_over"], row["used_freed"])


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


def totals(found: Sequence[Usage]) -> dict[str, int]:
    """Return the bytes that runs use, by what they are."""
    return {
        "recording": sum(usage.contents.recording for usage in found),
        "exports": sum(usage.exports for usage in found),
        "restored": sum(usage.restored for usage in found),
        "other": sum(usage.contents.other for usage in found),
        "total": sum(usage.total for usage in found),
    }


def freeable_of(found: Sequence[Usage], recordings: Sequence[Path]) -> dict[str, int]:
    """Return the bytes that could be freed, by what they are; not those of runs that are to stay."""
    free = [u for u in found if KEEP not in u.row["tags"].split() and u.row["status"] != "running"]
    cut_off = [contents_of(stray) for root in recordings for stray in strays(root)]
    return {
        "same_content": sum(u.contents.freed for u in free if u.row["same_as"]),
        "unfinished": sum(u.contents.freed for u in free if u.row["status"] in ("interrupted", "failed")),
        "left_over": sum(u.contents.left_over for u in free),
        "cached": sum(u.exports + u.restored for u in found),
        "half_removed": sum(contents.recording + contents.other for contents in cut_off),
    }


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
