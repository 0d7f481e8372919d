"""A worker process: does one job, and how it ends."""

from __future__ import annotations

import contextlib
import os
import signal
from typing import Any, Final

from runner.errors import RunnerError
from runner.service.jobs.channel import Line
from runner.service.jobs.ray_worker import do_seed_far
from runner.service.jobs.seeds import do_seed
from runner.service.jobs.spec import Heard, Order, Outcome, described
from runner.service.settings import without_folders

NICENESS: Final = 5
"""Learning gives way to the server, which somebody waits for."""


def leave_signals() -> None:
    """Leave Ctrl-C, which reaches every process of a terminal, to the server."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def do_config(order: Order, line: Heard) -> Outcome:
    """Do what is left of a job that is a configuration.

    Raises:
        RunnerError: a run cannot be done, or not be gone on with.
    """
    from runner.config import from_mapping

    config = from_mapping(described(order))
    for number, seed in enumerate(config.seeds):
        if line.stop():
            return Outcome("interrupted")
        do = do_seed if order.ray is None else do_seed_far
        if do(order, line, config, seed, number) != "finished":
            return Outcome("interrupted")
    return Outcome("finished")


def work(pipe: Any, order: Order) -> None:
    """Do a job, and tell of it; a worker process's main function."""
    from runner.learning.compilation import MESSAGE, announced
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
