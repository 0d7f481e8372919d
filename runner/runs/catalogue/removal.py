"""Removing runs: first what would go and why not, then a rename out of sight, then file by file.

Only files that belong to a run are removed, no link is followed, and nothing outside the recordings folder
is touched. A run that is running, or tagged `keep`, stays.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from runner.errors import RunnerError, RunNotFound, StorageError
from runner.recording.labels import KEEP, LABELS_FILE, are_readable
from runner.runs.catalogue.columns import moment
from runner.runs.catalogue.filters import Filter
from runner.runs.catalogue.index import Index
from runner.runs.catalogue.rows import Row
from runner.runs.catalogue.usage import REMOVED, Contents, belongs, contents_of, strays
from runner.runs.locking import locked
from runner.runs.run import Run, runs_in
from runner.util.humanize import listed

_STRAY_SECONDS: Final = 60
_PRUNED_BY: Final = (
    *("root", "entry", "id", "name", "seed", "config", "status", "tags"),
    *("success_percent", "created", "archive"),
)


@dataclass(frozen=True, slots=True)
class Removal:
    """A run that may be removed, in few bytes: there may be very many."""

    run_id: str
    name: str
    seed: int | None
    status: str
    success_percent: float | None
    created: datetime
    folder: Path
    is_archived: bool
    root: Path
    contents: Contents
    refusal: str = ""
    """Why it is not to be removed; empty if it may."""

    @property
    def freed(self) -> int:
        """Bytes that the disk gets back."""
        return self.contents.freed

    def run(self) -> Run:
        """Return the run as it is now.

        Raises:
            RunNotFound: it is no more.
        """
        for run in runs_in(self.folder):
            return run
        raise RunNotFound(f"run {self.run_id} was removed just now.")


def plan(run: Run, root: Path, force: bool = False) -> Removal:
    """Return what removing a run means.

    Args:
        run: what is to go.
        root: the recordings folder it must be in.
        force: whether strange files in its folder go with it.
    """
    refusal = _misplaced(run, root) or _protected(run)
    contents, refusal = (Contents(), refusal) if refusal else _measured(run.folder, force)
    last = run.summary.last_evaluation
    return Removal(
        run_id=run.run_id,
        name=run.name,
        seed=run.seed if run.has_seed else None,
        status=run.status,
        success_percent=last.values.get("success_percent") if last else None,
        created=run.created,
        folder=run.folder,
        is_archived=bool(run.archive),
        root=root,
        contents=contents,
        refusal=refusal,
    )


def plan_row(row: dict[str, Any], force: bool = False) -> Removal:
    """Return what removing a run would mean, by its row in the index, which is quicker for very many runs.

    This is for showing only: before runs are removed, `plan` reads their own files.

    Args:
        row: of a run that `unwanted` returned.
        force: whether strange files in its folder go with it.
    """
    root = Path(row["root"])
    folder = root / row["entry"]
    contents, refusal = Contents(), _linked(folder) or _unreadable(folder)
    if not refusal:
        contents, refusal = _measured(folder, force)
    return Removal(
        run_id=row["id"],
        name=row["name"],
        seed=row["seed"],
        status=row["status"],
        success_percent=row["success_percent"],
        created=moment(row),
        folder=folder,
        is_archived=bool(row["archive"]),
        root=root,
        contents=contents,
        refusal=refusal,
    )


def _measured(folder: Path, force: bool) -> tuple[Contents, str]:
    """Return what is in a run's folder, and why it cannot be removed with that, or nothing."""
    try:
        contents = contents_of(folder)
    except OSError as error:
        return Contents(), f"its folder cannot be read ({error.strerror})"
    if contents.strange and not force:
        return contents, (
            f"its folder also has {listed(contents.strange)}, which no run writes; "
            "move that away, or remove it as well with --force"
        )
    return contents, ""


def remove(removal: Removal, force: bool = False) -> None:
    """Remove a run.

    Args:
        removal: what `plan` said of it.
        force: whether strange files in its folder go with it.

    Raises:
        RunnerError: it is not to be removed, or a process began to work on it meanwhile; it is as before.
        StorageError: the folder cannot be written; what is left of the run is out of sight.
    """
    run = removal.run()
    # It may have been tagged, or begun again, while its owner was asked.
    refusal = removal.refusal or _protected(run)
    if refusal:
        raise RunnerError(f"run {run.run_id} stays: {refusal}.")
    with locked(run, archived=True):
        pass  # nobody else works on it
    hidden = removal.root / f"{REMOVED}{run.folder.name}-{secrets.token_hex(4)}"
    try:
        run.folder.rename(hidden)
        try:
            with locked(replace(run, folder=hidden), archived=True):
                pass  # nor did anybody begin to
        except RunnerError:
            hidden.rename(run.folder)
            raise
        _delete(hidden, force)
    except OSError as error:
        raise StorageError(f"{error.filename or hidden}: cannot be removed ({error.strerror}).") from error


def clean(root: Path) -> None:
    """Remove what is left of runs whose removal was cut off."""
    for stray in strays(root):
        with contextlib.suppress(OSError):
            if time.time() - stray.stat().st_mtime > _STRAY_SECONDS:
                _delete(stray, force=False)


@dataclass(frozen=True)
class Wish:
    """Which runs are not wanted any more: those for which all of this holds."""

    filter: Filter
    older_than: float | None = None
    """Seconds since they began."""
    keep_last: int | None = None
    """They are not among so many newest of their configuration's name."""
    statuses: tuple[str, ...] = ()
    """One of these; any if empty, but `archived` only if named."""


def unwanted(index: Index, wish: Wish, now: float) -> tuple[list[dict[str, Any]], Counter[str]]:
    """Return the rows that a wish is about, and how many of those are protected, by reason.

    Args:
        index: of the recordings folders.
        wish: which runs.
        now: seconds since 1970, of which ages are counted.
    """
    condition = wish.filter.condition
    if wish.older_than is not None:
        old = Row.created < int((now - wish.older_than) * 1000)
        condition = old if condition is None else condition & old
    rows = index.select(Filter(condition, wish.filter.settings), columns=_PRUNED_BY)
    spared = set() if wish.keep_last is None else _newest(index, wish.keep_last)
    rows = [row for row in rows if (row["root"], row["entry"]) not in spared]
    rows = [row for row in rows if row["status"] in wish.statuses or not wish.statuses]
    reasons = [_reason(row, wish) for row in rows]
    kept = Counter(reason for reason in reasons if reason)
    return [row for row, reason in zip(rows, reasons, strict=True) if not reason], kept


def _newest(index: Index, count: int) -> set[tuple[str, str]]:
    """Return the places of the newest runs of each configuration's name."""
    seen: Counter[str | None] = Counter()
    found = set()
    for row in index.rows(Filter(None), columns=("root", "entry", "config")):
        if seen[row["config"]] < count:
            found.add((row["root"], row["entry"]))
        seen[row["config"]] += 1
    return found


def _reason(row: dict[str, Any], wish: Wish) -> str:
    if row["status"] == "running":
        return "running"
    if KEEP in row["tags"].split():
        return f"tagged {KEEP}"
    return "archived" if row["status"] == "archived" and "archived" not in wish.statuses else ""


def _misplaced(run: Run, root: Path) -> str:
    """Return why a run is none that can be removed from a recordings folder, or nothing."""
    if run.stands_alone:
        return f"{run.recording} stands alone; remove the file yourself"
    if linked := _linked(run.folder):
        return linked
    if run.folder.parent != root and run.folder.resolve().parent != root.resolve():
        return f"{run.folder} is not in {root}; name its folder by --recordings"
    return ""


def _linked(folder: Path) -> str:
    if folder.is_symlink():
        return f"{folder} is a link to {folder.readlink()}; remove the link yourself"
    return ""


def _protected(run: Run) -> str:
    if run.status == "running":
        return "it is running; wait for its end, or interrupt it"
    if KEEP in run.tags:
        return f"it is tagged {KEEP}; `dualtaxi label {run.run_id} --untag {KEEP}` unlocks it"
    return _unreadable(run.folder)


def _unreadable(folder: Path) -> str:
    if not are_readable(folder):
        return f"{folder / LABELS_FILE} cannot be read, and may say {KEEP}; mend it, or remove that file"
    return ""


def _delete(folder: Path, force: bool) -> None:
    """Delete the run's files in a folder, strange ones before if they are to go, and the folder."""
    with os.scandir(folder) as entries:
        found = sorted(entries, key=lambda entry: belongs(entry.name))
    for entry in found:
        if entry.is_dir(follow_symlinks=False):
            if force:
                shutil.rmtree(entry.path)
        elif force or belongs(entry.name):
            Path(entry.path).unlink(missing_ok=True)
    folder.rmdir()


def total(removals: Sequence[Removal]) -> int:
    """Return the bytes that removals free together."""
    return sum(removal.freed for removal in removals)
