"""The catalogue of the service: the index of runs, which one thread updates for all requests."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Final, TypeVar

from runner.errors import RunnerError, RunNotFound
from runner.runs.catalogue.database import Version, version
from runner.runs.catalogue.index import CatalogueIndex, look
from runner.runs.resolve import choose, matching, not_found, of_name, run_of_id
from runner.runs.run import Run

Result = TypeVar("Result")

MIN_INTERVAL: Final = 1.0
"""Folders that were scanned this recently are not scanned again; longer where a scan takes long."""
INTERVAL_FACTOR: Final = 20
"""The interval between scans in units of their duration: they take a twentieth of the time."""
MAX_INTERVAL: Final = 5.0
MAX_AGE: Final = 60.0
"""`can_list` starts a scan if the last one began longer ago."""
FIRST_SCAN_SECONDS: Final = 1.0
"""How long `can_list` waits for the first scan."""
NEVER: Final = float("-inf")
NOTHING: Final = Version(-1, 0)


class Catalogue:
    """The index of recordings folders; a second or so old, and up to date after a change by the service."""

    def __init__(self, roots: Sequence[Path], log: Callable[[str], None] = lambda _: None) -> None:
        self.roots = tuple(roots)
        self._log = log
        self._scanner = ThreadPoolExecutor(1, thread_name_prefix="catalogue")
        self._lock = threading.Lock()
        self._scan: Future[None] | None = None
        self._started = NEVER
        self._changed = NEVER
        self._scanned = NEVER
        self._duration = 0.0
        self._scanned_version = NOTHING

    def close(self) -> None:
        """Wait for the running scan, and start no more."""
        self._scanner.shutdown(cancel_futures=True)

    def version(self) -> Version | None:
        """Return what changes with every change of the index; None if the folders must be scanned first."""
        now, scanned = version(), self._scanned_version
        is_recent = time.monotonic() - self._scanned < 3 * self._interval
        if now is None or not is_recent or self._scanned <= self._changed:
            return None
        if now.file != scanned.file or now.changes < scanned.changes:
            return None
        if time.monotonic() - self._started > self._interval:
            self.start_scan()
        return now

    def changed(self) -> None:
        """Note that a run has changed: later requests see the change."""
        self._changed = time.monotonic()

    def state(self) -> Hashable:
        """Return a key of cached responses, which changes with the runs."""
        return self.version() or self._changed

    def read(self, work: Callable[[CatalogueIndex], Result]) -> Result:
        """Return the result of a function of the index."""
        if self.version() is None:
            self.start_scan().result()
        return look(self.roots, work, self._log, cached=self.version() is not None)

    def can_list(self) -> bool:
        """Return whether runs can be listed, according to the last scan; waits for the first scan only."""
        if self._scanned == NEVER or time.monotonic() - self._started > MAX_AGE:
            self.start_scan()
        latest = self._scan
        try:
            if latest is not None and (self._scanned == NEVER or latest.done()):
                latest.result(FIRST_SCAN_SECONDS)
            for root in filter(os.path.lexists, self.roots):  # a missing one has no runs
                with os.scandir(root) as entries:
                    next(entries, None)
        except (TimeoutError, OSError, RunnerError):
            return False
        return True

    def find(self, name: str) -> Run:
        """Return the run with an id, the beginning of one, a name or `@latest`; never by a path."""
        _refuse_path(name)
        for root in self.roots:
            run = run_of_id(name, root)
            if run is not None:
                return run
        candidates = self.read(lambda index: matching(name, index))
        if len(candidates) != 1:  # it may be newer than the last scan
            candidates = look(self.roots, lambda index: matching(name, index), self._log)
        if not candidates:
            raise self.read(lambda index: not_found(name, index, self.roots[0]))
        return choose(name, candidates).run()

    def find_all(self, name: str) -> list[Run]:
        """Return all runs of a name, the oldest first; else the run that `find` returns."""
        _refuse_path(name)
        alike = self.read(lambda index: of_name(name, index))
        return [candidate.run() for candidate in alike] or [self.find(name)]

    @property
    def _interval(self) -> float:
        return min(max(MIN_INTERVAL, INTERVAL_FACTOR * self._duration), MAX_INTERVAL)

    def start_scan(self) -> Future[None]:
        """Return a scan that starts now, or one that runs and started after the last change."""
        with self._lock:
            if self._scan is None or self._scan.done() or self._started <= self._changed:
                self._started = time.monotonic()
                self._scan = self._scanner.submit(self._do_scan)
            return self._scan

    def _do_scan(self) -> None:
        began = time.monotonic()
        look(self.roots, lambda _: None, self._log)
        self._scanned_version = version() or NOTHING
        self._scanned = began
        self._duration = time.monotonic() - began


def _refuse_path(name: str) -> None:
    if "/" in name or "\\" in name or "\0" in name or name.endswith(".mcap"):
        raise RunNotFound(f"no run {name!r}: expected an id, the beginning of one, a name or @latest.")
