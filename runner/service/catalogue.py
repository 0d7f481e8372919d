"""The catalogue of the service: the index of runs, compared with the folders now and then."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, TypeVar

from runner.errors import RunNotFound
from runner.runs.catalogue.index import CatalogueIndex, look
from runner.runs.resolve import choose, matching, not_found, of_name, run_of_id
from runner.runs.run import Run

Result = TypeVar("Result")

CHECK_SECONDS: Final = 2.0
"""Time between two comparisons with the folders, which take 10 us for each run."""


class Catalogue:
    """The index of recordings folders: seconds old, and up to date after a change by the service."""

    def __init__(self, roots: Sequence[Path], log: Callable[[str], None] = lambda _: None) -> None:
        self.roots = tuple(roots)
        self._log = log
        self._lock = threading.Lock()
        self._check_at = 0.0
        """When the folders are compared with the index again (monotonic seconds)."""

    def changed(self) -> None:
        """Note that a run has changed: later requests see the change."""
        self._check_at = 0.0

    def read(self, work: Callable[[CatalogueIndex], Result]) -> Result:
        """Return the result of a function of the index.

        Raises:
            StorageError: a folder cannot be read.
        """
        with self._lock:  # requests of the same moment share a comparison
            if time.monotonic() >= self._check_at:
                self._check_at = time.monotonic() + CHECK_SECONDS  # first, as a run may change meanwhile
                look(self.roots, lambda _: None, self._log)
        return look(self.roots, work, self._log, cached=True)

    def find(self, name: str) -> Run:
        """Return the run with an id, the beginning of one, a name or `@latest`; never by a path."""
        _refuse_path(name)
        for root in self.roots:
            run = run_of_id(name, root)
            if run is not None:
                return run
        candidates = self.read(lambda index: matching(name, index))
        if len(candidates) != 1:  # it may be newer than the last comparison
            self.changed()
            candidates = self.read(lambda index: matching(name, index))
        if not candidates:
            raise self.read(lambda index: not_found(name, index, self.roots[0]))
        return choose(name, candidates).run()

    def find_all(self, name: str) -> list[Run]:
        """Return all runs of a name, the oldest first; else the run that `find` returns."""
        _refuse_path(name)
        alike = self.read(lambda index: of_name(name, index))
        return [candidate.run() for candidate in alike] or [self.find(name)]


def _refuse_path(name: str) -> None:
    if "/" in name or "\\" in name or "\0" in name or name.endswith(".mcap"):
        raise RunNotFound(f"no run {name!r}: expected an id, the beginning of one, a name or @latest.")
