"""Syncs finished recordings to disk in groups, off the thread that learns; the interpreter's end waits.

The operating system has every byte of a closed file, so a killed process loses none of them. Syncing protects
them from a power failure; it takes milliseconds a file, and hardly more for many files at once.
"""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing.util
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Final

from runner.util.files import sync

GROUP_SECONDS: Final = 1.0
"""How long finished files wait for others."""
_THREADS: Final = 8
"""How many files are synced at once: a journal commits them together."""

Failed = Callable[[OSError], None]
"""Takes the error of a file that could not be synced; called from any thread."""


class Syncer:
    """The finished files of this process that are not known to be on disk yet."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all files, as in a forked process: they belong to the other one."""
        self._waiting: deque[tuple[Path, Failed]] = deque()  # safe without a lock
        self._lock = threading.Lock()  # for the fields below; never held while files are synced
        self._syncing = threading.Lock()  # held until all are on disk: who waits for it waits for them
        self._thread: threading.Thread | None = None
        self._is_exiting = False
        self._ends_with_process = False

    def add(self, path: Path, failed: Failed) -> None:
        """Sync a finished file within seconds; at once if the interpreter ends."""
        self._waiting.append((path.absolute(), failed))
        with self._lock:
            if self._thread is None and not self._is_exiting:
                self._thread = threading.Thread(target=self._serve, name="recording-sync", daemon=True)
                self._thread.start()
            if not self._ends_with_process and multiprocessing.parent_process() is not None:
                # a child of multiprocessing ends without `atexit`
                multiprocessing.util.Finalize(None, self.exit, exitpriority=0)
                self._ends_with_process = True
        if self._is_exiting:
            self.sync()

    def sync(self) -> None:
        """Return when every file that was added is on disk."""
        with self._syncing:
            helpers = []
            with contextlib.suppress(RuntimeError):  # no thread can be started while the interpreter ends
                for _ in range(min(_THREADS, len(self._waiting)) - 1):
                    helper = threading.Thread(target=self._sync_waiting, name="recording-sync", daemon=True)
                    helper.start()
                    helpers.append(helper)
            self._sync_waiting()
            for helper in helpers:
                helper.join()

    def exit(self) -> None:
        """Sync every file before the interpreter ends, and later ones at once."""
        with self._lock:
            self._is_exiting = True
        self.sync()

    def _serve(self) -> None:
        while True:
            time.sleep(GROUP_SECONDS)
            self.sync()
            with self._lock:
                if not self._waiting:
                    self._thread = None
                    return

    def _sync_waiting(self) -> None:
        while True:
            try:
                path, failed = self._waiting.popleft()
            except IndexError:
                return
            try:
                sync(path)
            except FileNotFoundError:
                continue  # it was removed since
            except OSError as error:
                with contextlib.suppress(Exception):  # the other files are synced, whatever comes of this one
                    failed(error)


SYNCER: Final = Syncer()
atexit.register(SYNCER.exit)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=SYNCER.clear)
