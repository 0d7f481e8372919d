"""The catalogue as the service asks it: the index, looked after by one thread for all who ask."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from runner.errors import RunnerError, RunNotFound
from runner.runs.catalogue.database import Version, version
from runner.runs.catalogue.folders import Depth
from runner.runs.catalogue.index import look
from runner.runs.resolve import choose, matching, not_found, of_name
from runner.runs.run import Run, run_of_id

if TYPE_CHECKING:
    from runner.runs.catalogue.index import Index

Found = TypeVar("Found")

FRESH_SECONDS: Final = 1.0
"""Folders that were looked at so recently are not looked at again; up to five, where that takes long."""
SHARE: Final = 20
"""One part in so many of the time is spent on looking."""
MOST_SECONDS: Final = 5.0
CLOSE_SECONDS: Final = 60.0
"""How often a look also finds files that were changed in place, which takes thrice as long."""
FIRST_SECONDS: Final = 1.0
"""How long `can_list` waits for the first look."""
NEVER: Final = float("-inf")
NOTHING: Final = Version(-1, 0)


class Catalogue:
    """The index of recordings folders; what it tells is a second or so old, or of now after a change here."""

    def __init__(self, roots: Sequence[Path], tell: Callable[[str], None] = lambda _: None) -> None:
        self.roots = tuple(roots)
        self._tell = tell
        self._looker = ThreadPoolExecutor(1, thread_name_prefix="catalogue")
        self._lock = threading.Lock()
        self._look: Future[None] | None = None
        self._asked = self._changed = self._looked = self._looked_closely = NEVER
        self._took = 0.0
        self._seen = NOTHING

    def close(self) -> None:
        """Wait for the look that is under way, and begin none again."""
        self._looker.shutdown(cancel_futures=True)

    def version(self) -> Version | None:
        """Return what changes with every change of what is known; None if that must be looked for first."""
        now = version()
        if now is None or not self._is_known(now):
            return None
        self._look_if_due()
        return now

    def changed(self) -> None:
        """Say that a run is not as it was: whoever asks from now on is told of it as it is."""
        self._changed = time.monotonic()

    def state(self) -> Hashable:
        """Return what an answer depends on: it may be given again while this is the same."""
        return self.version() or self._changed

    def prepare(self) -> None:
        """Begin the first look, so that the first request need not wait for all of it."""
        self._begin_look()

    def read(self, work: Callable[[Index], Found]) -> Found:
        """Return what some work finds in the index.

        Raises:
            StorageError: a recordings folder cannot be read.
        """
        if self.version() is None:
            self._begin_look().result()
        return look(self.roots, work, self._tell, cached=self.version() is not None)

    def can_list(self) -> bool:
        """Return whether runs can be listed, by what the last look found; waits for none but the first."""
        if self._looked == NEVER or time.monotonic() - self._asked > CLOSE_SECONDS:
            self._begin_look()
        latest = self._look
        try:
            if latest is not None and (self._looked == NEVER or latest.done()):
                latest.result(FIRST_SECONDS)
            for root in filter(os.path.lexists, self.roots):  # a missing one has no runs
                with os.scandir(root) as entries:
                    next(entries, None)
        except (TimeoutError, OSError, RunnerError):
            return False
        return True

    def find(self, name: str) -> Run:
        """Return the run that an id, the beginning of one, a name or `@latest` names; no path does.

        Raises:
            RunNotFound: no run matches the name, or several do.
        """
        _refuse_path(name)
        for root in self.roots:
            known = run_of_id(name, root)
            if known is not None:
                return known
        candidates = self.read(lambda index: matching(name, index))
        if len(candidates) != 1:  # it may be newer than the last look
            candidates = look(self.roots, lambda index: matching(name, index), self._tell)
        if not candidates:
            raise self.read(lambda index: not_found(name, index, self.roots[0]))
        return choose(name, candidates).run()

    def find_all(self, name: str) -> list[Run]:
        """Return all runs of a name, the oldest first; else the run that `find` returns.

        Raises:
            RunNotFound: none does, or it is the beginning of several ids.
        """
        _refuse_path(name)
        alike = self.read(lambda index: of_name(name, index))
        return [found.run() for found in alike] or [self.find(name)]

    def _is_known(self, now: Version) -> bool:
        """Return whether a look not long ago saw to it that the index agrees with the folders."""
        recent = time.monotonic() - self._looked < 3 * self._interval
        same_file = now.file == self._seen.file and now.changes >= self._seen.changes
        return recent and same_file and self._looked > self._changed

    @property
    def _interval(self) -> float:
        return min(max(FRESH_SECONDS, SHARE * self._took), MOST_SECONDS)

    def _look_if_due(self) -> None:
        if time.monotonic() - self._asked > self._interval:
            self._begin_look()

    def _begin_look(self) -> Future[None]:
        """Return a look that begins now, or that is under way and began after the last change."""
        with self._lock:
            if self._look is None or self._look.done() or self._asked <= self._changed:
                self._asked = time.monotonic()
                self._look = self._looker.submit(self._do_look)
            return self._look

    def _do_look(self) -> None:
        began = time.monotonic()
        closely = began - self._looked_closely > CLOSE_SECONDS
        look(self.roots, lambda _: None, self._tell, depth=Depth.FILES if closely else Depth.FOLDERS)
        self._seen = version() or NOTHING
        self._looked = began
        if closely:
            self._looked_closely = began
        else:
            self._took = time.monotonic() - began


def _refuse_path(name: str) -> None:
    if "/" in name or "\\" in name or "\0" in name or name.endswith(".mcap"):
        raise RunNotFound(f"no run {name!r}: expected an id, the beginning of one, a name or @latest.")
