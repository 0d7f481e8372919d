"""A worker process: the pipe to the server, and how it ends.

By the pipe it is told to stop, and how many processes it may use. When the server is gone the pipe ends, and
the worker stops as well: it closes its recording, so that whoever serves the folder next goes on with it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from typing import Any, Final

from runner.errors import RunnerError
from runner.service.jobs.spec import Order, Outcome
from runner.service.settings import without_folders

NICENESS: Final = 5
"""Learning gives way to the server, which somebody waits for."""


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


def leave_signals() -> None:
    """Leave Ctrl-C, which reaches every process of a terminal, to the server."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def work(pipe: Any, order: Order) -> None:
    """Do a job, and tell of it; a worker process's main function."""
    from runner.learning.compilation import MESSAGE, announced
    from runner.service.jobs.seeds import do_config
    from runner.service.jobs.sweeps import do_sweep

    leave_signals()
    with contextlib.suppress(OSError, AttributeError):  # not on Windows
        os.nice(NICENESS)
    line = Line(pipe)
    signal.signal(signal.SIGTERM, line.end)
    try:
        with announced(lambda: line.tell("log", {"text": MESSAGE})):
            outcome = (do_sweep if order.kind == "sweep" else do_config)(order, line)
    except RunnerError as error:
        told = "\n".join([str(error), *getattr(error, "__notes__", [])])
        outcome = Outcome("failed", without_folders(told, order.recordings))
    line.tell("over", outcome)
