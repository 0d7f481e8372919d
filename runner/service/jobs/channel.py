"""The worker's end of the pipe to the server.

By the pipe it is told to stop, and how many processes it may use. When the server is gone the pipe ends, and
the worker stops as well: it closes its recording, so that whoever serves the folder next goes on with it.
"""

from __future__ import annotations

import contextlib
import os
import threading
from typing import Any


class Line:
    """The worker's end of the pipe to the server.

    Args:
        pipe: it.
    """

    def __init__(self, pipe: Any) -> None:
        self.slots = 1
        """How many processes may learn at once."""
        self._pipe = pipe
        self._parent = os.getppid()
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        threading.Thread(target=self._listen, name="line", daemon=True).start()

    def tell(self, kind: str, data: Any) -> None:
        """Tell the server something; nobody listens if it is gone."""
        with self._lock, contextlib.suppress(OSError):
            self._pipe.send((kind, data))

    def stop(self) -> bool:
        """Return whether the worker is to stop."""
        return self._stopping.is_set() or os.getppid() != self._parent

    def end(self, *_: object) -> None:
        """Have the worker stop."""
        self._stopping.set()

    def _listen(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                word, value = self._pipe.recv()
                if word == "slots":
                    self.slots = value
                else:
                    self.end()
        self.end()
