"""Remove runs: list what would go, rename the folder out of sight, then delete its files.

Only files that belong to a run are deleted, no link is followed, and nothing outside the recordings folder is
touched. A run that is running, or tagged `keep`, stays.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import shutil
import time
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Final

from runner.errors import RunnerError, StorageError
from runner.recording.labels import KEEP, LABELS_FILE, are_labels_readable
from runner.recording.run_file import EvaluationMetrics
from runner.runs.catalogue.columns import IndexRow, moment
from runner.runs.catalogue.database import Sql
from runner.runs.catalogue.filters import Filter
from runner.runs.catalogue.index import CatalogueIndex
from runner.runs.catalogue.usage import REMOVED, Contents, belongs, contents_of, strays
from runner.runs.checkpoints import Store
from runner.runs.run import Run, listed_run, locked
from runner.util.files import CACHED_EPISODES, cache_folder
from runner.util.humanize import listed

_STRAY_SECONDS: Final = 60
"""The rest of a removal that is older than this is deleted: no other process is at it any more."""
_COLUMNS: Final = (
    "root",
    "entry",
    "id",
    "name",
    "seed",
    "config",
    "status",
    "tags",
    "success_percent",
    "created",
    "archive",
)
_OLDER: Final = (
    "(root, entry) IN (SELECT root, entry FROM (SELECT root, entry, ROW_NUMBER() OVER "
    "(PARTITION BY config ORDER BY created DESC, id, root) AS place FROM runs "
    "WHERE root IN (SELECT value FROM json_each(?)) AND id IS NOT NULL) WHERE place > ?)"
)
"""The condition to be older than the newest runs of a configuration's name, in some folders."""


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
    refusal: str
    """Why it must not be removed; empty if it may."""

    @property
    def freed(self) -> int:
        """Bytes that removing it frees."""
        return self.contents.freed

    def run(self) -> Run:
        """Return the run as it is now.

        Raises:
            RunNotFound: it was removed in the meantime.
        """
        return listed_run(self.folder, self.run_id)


def plan(run: Run, root: Path, foreign: bool = False) -> Removal:
    """Return the removal of a run.

    Args:
        foreign: also remove foreign files in its folder.
    """
    refusal, contents = _judged(run.folder, _why_not_in(run, root) or _protected(run), foreign)
    evaluation = run.summary.last_evaluation or EvaluationMetrics()
    return Removal(
        run_id=run.run_id,
        name=run.name,
        seed=run.file.seed if run.has_seed else None,
        status=run.status,
        success_percent=evaluation.values.get("success_percent"),
        created=run.created,
        folder=run.folder,
        is_archived=bool(run.archive),
        root=root,
        contents=contents,
        refusal=refusal,
    )


def plan_row(row: IndexRow, foreign: bool) -> Removal:
    """Return the removal of a run by its row in the index, which is quicker for very many runs."""
    folder = Path(row["root"], row["entry"])
    refusal, contents = _judged(folder, _linked(folder) or _unreadable(folder), foreign)
    return Removal(
        run_id=row["id"],
        name=row["name"],
        seed=row["seed"],
        status=row["status"],
        success_percent=row["success_percent"],
        created=moment(row),
        folder=folder,
        is_archived=bool(row["archive"]),
        root=folder.parent,
        contents=contents,
        refusal=refusal,
    )


def _judged(folder: Path, refusal: str, foreign: bool) -> tuple[str, Contents]:
    """Return why a run stays, `refusal` or what its folder holds, and the contents of the folder."""
    contents = Contents()
    if not refusal:
        try:
            contents = contents_of(folder)
        except OSError as error:
            refusal = f"its folder cannot be read ({error.strerror})"
    if contents.foreign and not foreign:
        refusal = (
            f"its folder also has {listed(contents.foreign)}, which no run writes; "
            "move that away, or remove it as well with --foreign-files"
        )
    return refusal, contents


def remove(removal: Removal, foreign: bool = False) -> None:
    """Remove a run.

    Raises:
        RunnerError: it must not be removed, or another process is using it; it is unchanged.
        StorageError: the folder cannot be written; the rest of the run is out of sight.
    """
    run = removal.run()
    # It may have been tagged, or resumed, while the user was confirming.
    refusal = removal.refusal or _protected(run)
    if refusal:
        raise RunnerError(f"run {run.run_id} stays: {refusal}.")
    with locked(run, archived=True):
        pass  # no other process uses it
    hidden = removal.root / f"{REMOVED}{run.folder.name}-{secrets.token_hex(4)}"
    try:
        run.folder.rename(hidden)
        try:
            with locked(replace(run, folder=hidden), archived=True):
                pass  # nor has any begun to
        except RunnerError:
            hidden.rename(run.folder)
            raise
        _delete(hidden, foreign)
        Store(removal.root).drop(run.folder.name)
    except OSError as error:
        raise StorageError(f"{error.filename or hidden}: cannot be removed ({error.strerror}).") from error


def clean(root: Path, removed: Collection[str] = ()) -> None:
    """Delete what removed runs leave: contents that only they refer to, indexes, rests of earlier removals.

    Args:
        removed: the ids of the runs that were removed.
    """
    if removed:
        for index in (cache_folder() / CACHED_EPISODES).glob("*.parquet"):
            if index.name.partition("-")[0] in removed:
                index.unlink(missing_ok=True)
    for stray in strays(root):
        with contextlib.suppress(OSError):
            if time.time() - stray.stat().st_mtime > _STRAY_SECONDS:
                _delete(stray, foreign=False)
    Store(root).clean()


def contents_freed(removals: Sequence[Removal]) -> int:
    """Return the bytes of the contents of checkpoints that removing these runs frees."""
    names: dict[Path, list[str]] = {}
    for removal in removals:
        names.setdefault(removal.root, []).append(removal.folder.name)
    return sum(sum(Store(root).only_of(run_ids).values()) for root, run_ids in names.items())


@dataclass(frozen=True)
class Criteria:
    """Which runs to remove: those that meet all of these."""

    filter: Filter
    older_than: float | None
    """Seconds since they began."""
    keep_last: int | None
    """The number of newest runs of each configuration's name to keep."""
    statuses: tuple[str, ...]
    """Their status; any if empty, but `archived` only if named."""


def unwanted(index: CatalogueIndex, criteria: Criteria, now: float) -> tuple[list[IndexRow], Counter[str]]:
    """Return the rows that meet the criteria, and how many more do but are protected, by reason."""
    run_filter = criteria.filter
    if criteria.older_than is not None:
        latest = int((now - criteria.older_than) * 1000)
        run_filter = run_filter.also(Sql("created < ?", (latest,)))
    if criteria.keep_last is not None:
        run_filter = run_filter.also(Sql(_OLDER, (json.dumps(index.roots), criteria.keep_last)))
    going = []
    staying = Counter[str]()
    for row in index.select(run_filter, columns=_COLUMNS):
        if criteria.statuses and row["status"] not in criteria.statuses:
            continue
        if row["status"] == "running":
            staying["running"] += 1
        elif KEEP in row["tags"].split():
            staying[f"tagged {KEEP}"] += 1
        elif row["status"] == "archived" and not criteria.statuses:
            staying["archived"] += 1
        else:
            going.append(row)
    return going, staying


def _why_not_in(run: Run, root: Path) -> str:
    """Return why a run cannot be removed from a recordings folder, or an empty text."""
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
    if not are_labels_readable(folder):
        return f"{folder / LABELS_FILE} cannot be read, and may say {KEEP}; repair it, or remove that file"
    return ""


def _delete(folder: Path, foreign: bool) -> None:
    """Delete the run's files in a folder, foreign ones first if `foreign`, and the folder."""
    with os.scandir(folder) as entries:
        in_order = sorted(entries, key=lambda entry: belongs(entry.name))
    for entry in in_order:
        if entry.is_dir(follow_symlinks=False):
            if foreign:
                shutil.rmtree(entry.path)
        elif foreign or belongs(entry.name):
            Path(entry.path).unlink(missing_ok=True)
    folder.rmdir()
