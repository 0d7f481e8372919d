"""Workers that kill themselves: the first attempts at the first jobs die, each at another moment."""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import signal
from pathlib import Path

from runner.execution import session
from runner.sweep import task as tasks
from runner.sweep.workers import RayActor

MOMENTS = ("before the task", "before the recording", "empty recording", "training", "before the result")
MOVING = (*MOMENTS, "before moving", "moved in part")


def die(*_, **__):
    os.kill(os.getpid(), signal.SIGKILL)


def arrange(moment):
    """Make this process die when it comes to this moment of the task that it runs next."""
    if moment == "before the recording":
        tasks.run_job = die
    elif moment == "empty recording":
        session.describe = die
    elif moment == "training":
        tasks._Pruner.report = lambda _, progress: progress.episode and die()
    elif moment == "before moving":
        tasks.move_files = die
    elif moment == "moved in part":
        copyfile = shutil.copyfile
        shutil.copyfile = lambda path, to, **options: (
            die() if str(to).endswith(".run.json") else copyfile(path, to, **options)
        )


def run_dying(notes, moments, task, stop):
    """Run a task as `Task.run`; the first attempt at the nth job dies at the nth moment."""
    try:
        (notes / task.identity).mkdir()
    except FileExistsError:
        return task.run(stop)
    number = next(n for n in itertools.count() if is_first(notes / f"attempt {n}"))
    if number >= len(moments):
        return task.run(stop)
    moment = moments[number]
    (notes / f"died {moment}").touch()
    if moment == moments[0]:
        die()
    arrange(moment)
    task.run(stop)
    return die()


def is_first(path):
    try:
        path.mkdir()
    except FileExistsError:
        return False
    return True


def attempt(task, stop):
    """Run a task as `Task.run`, and die as the environment variables say."""
    return run_dying(Path(os.environ["DYING_NOTES"]), os.environ["DYING_MOMENTS"].split(","), task, stop)


def serve(pipe, stopping):
    """Run tasks as `runner.sweep.workers.serve` does, and die."""
    with contextlib.suppress(EOFError):
        while True:
            pipe.send(attempt(pipe.recv(), stopping.is_set))


class DyingActor(RayActor):
    """Dies while it runs a task."""

    def run(self, task):
        return attempt(task, self._stopping.is_set)
