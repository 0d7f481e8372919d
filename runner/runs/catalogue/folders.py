"""Find and apply the differences between recordings folders and the index.

A quick check notices runs that are new or gone, files that were created, replaced or removed, as all commands
do, and runs that are running: a stat of each run's folder takes 3 us. A whole one, with a stat of each run's
files, takes 10 us, and also notices files that were changed in place. Files are read where something changed.
"""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from runner.recording.labels import LABELS_FILE
from runner.runs.catalogue.database import STORED, row_of, transaction, write_rows
from runner.runs.run import RECORDING_FILE, RUN_FILE, run_entries, run_in

_STABLE_NS: Final = 2 * 10**9
"""Files that changed this recently may change again with the same time: they are read again next time."""
_RUN_FILES: Final = (RUN_FILE, LABELS_FILE, RECORDING_FILE)
_BATCH: Final = 2000
"""Rows in memory at once, written in one transaction."""


class FolderChanges(NamedTuple):
    """How a recordings folder differs from the index; runs are given by the names of their folders."""

    root: str
    changed: list[str]
    """Runs that are new, changed, or whose process was killed."""
    gone: list[str]
    """Runs that were removed."""


class Folders:
    """Some recordings folders, compared with the index."""

    def __init__(
        self,
        database: sqlite3.Connection,
        roots: Sequence[str],
        quick: bool = False,
    ) -> None:
        self._database = database
        self._roots = roots
        self._quick = quick
        self._tokens: dict[str, dict[str, str]] = {}
        """By root and entry, the token of each run's folder at the first check, or when it was read."""
        self._read: dict[str, set[str]] = {root: set() for root in roots}

    def differences(self) -> list[FolderChanges]:
        """Return how the folders, as they were at the first call, differ from the index as it is now."""
        all_differences = [self._difference(root) for root in self._roots]
        return [difference for difference in all_differences if difference.changed or difference.gone]

    def apply(self, found: Sequence[FolderChanges]) -> None:
        """Read what changed and write it to the index, a transaction for each batch."""
        for root, changed, gone in found:
            changed.sort()  # in the order of the table, which then grows at its end
            for start in range(0, len(changed), _BATCH):
                rows = [self._row(root, entry) for entry in changed[start : start + _BATCH]]
                with transaction(self._database, "IMMEDIATE"):
                    write_rows(self._database, rows)
            with transaction(self._database, "IMMEDIATE"):
                removed = [(root, entry) for entry in gone]
                self._database.executemany("DELETE FROM runs WHERE root = ? AND entry = ?", removed)

    def expire(self) -> None:
        """Have all runs of these folders read again, and delete the rows of folders that no longer exist."""
        with transaction(self._database, "IMMEDIATE"):
            for (root,) in self._database.execute("SELECT DISTINCT root FROM runs").fetchall():
                if not os.path.isdir(root):  # noqa: PTH112
                    self._database.execute("DELETE FROM runs WHERE root = ?", (root,))
            expired = "UPDATE runs SET fingerprint = '', mark = '' WHERE root = ?"
            self._database.executemany(expired, [(root,) for root in self._roots])

    def _difference(self, root: str) -> FolderChanges:
        """Return the difference of one folder; entries without files of a run are left out, or gone."""
        stored = "mark" if self._quick else "fingerprint"
        indexed: dict[str, str] = dict(
            self._database.execute(f"SELECT entry, {stored} FROM runs WHERE root = ?", (root,))
        )
        if root not in self._tokens:  # as the folders are at the first check
            entries = [entry for entry in run_entries(Path(root)) if entry.isprintable()]
            self._tokens[root] = {entry: self._token(root, entry) for entry in entries}
        tokens = self._tokens[root]
        changed = [entry for entry, token in tokens.items() if indexed.get(entry) != token]
        unsteady = (
            "SELECT entry, status, stable FROM runs WHERE root = ? AND (status = 'running' OR NOT stable)"
        )
        for entry, status, stable in self._database.execute(unsteady, (root,)):
            if indexed.get(entry) != tokens.get(entry) or entry in self._read[root]:
                continue
            # The recording of a running one grows in place.
            if not stable or self._quick or (status == "running" and not _is_running(root, entry)):
                changed.append(entry)
        there = [entry for entry in changed if _state_of(root, entry) is not None]
        missing = {*indexed} - {*tokens} | {*changed} - {*there}
        gone = [entry for entry in missing if entry in indexed and _state_of(root, entry) is None]
        return FolderChanges(root, there, gone)

    def _token(self, root: str, entry: str) -> str:
        if self._quick:
            return _mark(root, entry)[0]
        seen = _state_of(root, entry)
        return "" if seen is None else seen.fingerprint

    def _row(self, root: str, entry: str) -> dict[str, object]:
        mark, changed = _mark(root, entry)  # before the files: later changes are found next time
        seen = _state_of(root, entry) or State("", 0, None)
        stable = max(changed, seen.changed) + _STABLE_NS < time.time_ns()
        self._tokens[root][entry] = mark if self._quick else seen.fingerprint
        self._read[root].add(entry)
        place = {"root": root, "entry": entry, "fingerprint": seen.fingerprint, "mark": mark}
        if run := run_in(Path(root, entry)):
            return _EMPTY | place | {"stable": stable} | row_of(run, seen.size)
        problem = f"{Path(root, entry)}: neither {RUN_FILE} nor {RECORDING_FILE} can be read as a run."
        return _EMPTY | place | {"stable": stable, "problem": problem}


class State(NamedTuple):
    """The state of a run's files, without reading them."""

    fingerprint: str
    changed: int
    """When one of them last changed, in nanoseconds since 1970."""
    size: int | None
    """Bytes of its recording."""


def _state_of(root: str, entry: str) -> State | None:
    """Return the state of a run's files; None if there are none."""
    marks = []
    changed = 0
    size = None
    for name in _RUN_FILES:
        try:
            facts = os.stat(f"{root}{os.sep}{entry}{os.sep}{name}")  # noqa: PTH116 - Path takes three times as long
        except OSError:
            marks.append("")
            continue
        marks.append(f"{facts.st_mtime_ns}.{facts.st_size}.{facts.st_ino}")
        changed = max(changed, facts.st_mtime_ns)
        size = facts.st_size if name == RECORDING_FILE else None
    return State(" ".join(marks), changed, size) if marks[0] or marks[2] else None


def _mark(root: str, entry: str) -> tuple[str, int]:
    """Return a token that changes when a file in a folder is created, replaced or removed, and that time."""
    try:
        facts = os.stat(f"{root}{os.sep}{entry}")  # noqa: PTH116
    except OSError:
        return "", 0
    return f"{facts.st_mtime_ns}.{facts.st_ino}", facts.st_mtime_ns


def _is_running(root: str, entry: str) -> bool:
    run = run_in(Path(root, entry))
    return run is not None and run.status == "running"


_EMPTY: Final[dict[str, object]] = dict.fromkeys(STORED)
