"""What a worker process does with a job: its runs, one after the other, or its sweep.

It is told by a pipe to stop, and how many processes it may use. When the server is gone the pipe ends, and
the worker stops as well: it closes its recording, so that whoever serves the folder next goes on with it.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from runner.documents import write_whole
from runner.errors import RunnerError
from runner.runs import Run, find_run, new_run_id
from runner.service.queue import CONFIG_FILE, RUNS_FILE, runs_in

if TYPE_CHECKING:
    from runner.execution import Progress
    from runner.sweep.local import Workers
    from runner.sweep.task import Result, Task
    from runner.sweep.trials import Standing

NICENESS: Final = 5
"""Learning gives way to the server, which somebody waits for."""
TELL_SECONDS: Final = 0.25
OTHERS_SECONDS: Final = 60.0
"""How long another owner of a run may take to let go of it; on another host believed dead after 15 s."""
MAX_TEXT: Final = 4000
"""Of one line of a log."""

Tell = Callable[[str, dict[str, Any]], None]


@dataclass(frozen=True)
class Order:
    """A job, as its worker is told."""

    number: int
    kind: str
    name: str
    folder: Path
    """Of the job."""
    recordings: Path
    accept_changes: bool
    retry: bool
    """Whether runs of a sweep that failed are tried again."""
    ray: str | None
    """The address of a cluster of Ray that does the work; None: this machine does."""


@dataclass(frozen=True)
class Outcome:
    """What came of it."""

    state: Literal["finished", "interrupted", "failed"]
    error: str = ""


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
    from runner.learning.compilation import announced

    leave_signals()
    with contextlib.suppress(OSError, AttributeError):  # not on Windows
        os.nice(NICENESS)
    line = Line(pipe)
    signal.signal(signal.SIGTERM, line.end)
    try:
        with announced(lambda: line.tell("log", {"text": "compiling the learning kernel, this once"})):
            outcome = (_do_sweep if order.kind == "sweep" else _do_config)(order, line)
    except RunnerError as error:
        told = "\n".join([str(error), *getattr(error, "__notes__", [])])
        outcome = Outcome("failed", told)
    line.tell("over", outcome)


def _do_config(order: Order, line: Line) -> Outcome:
    from runner.config import from_mapping

    config = from_mapping(_described(order))
    for number, seed in enumerate(config.seeds):
        if line.stop():
            return Outcome("interrupted")
        run = _do_seed(order, line, config, seed, number)
        if run.status != "finished":
            return Outcome("interrupted")
    return Outcome("finished")


def _described(order: Order) -> Any:
    """Return the configuration or the sweep of a job, as plain values."""
    from runner.config.document import read_yaml
    from runner.config.loading import read_text

    path = order.folder / CONFIG_FILE
    return read_yaml(read_text(path), str(path)).value


def _do_seed(order: Order, line: Line, config: Any, seed: int, number: int) -> Run:
    """Do a job's run of one seed, or go on with it."""
    known = _run_of(order, seed)
    if known is not None and known.status == "finished":
        return known
    from runner.execution import run_job
    from runner.job import Job
    from runner.resume import resume
    from runner.runs import create_run

    if known is not None:
        _wait_for_others([known], line.stop)
        telling = Telling(line.tell, known.run_id, seed, number, len(config.seeds))
        run = resume(known, order.accept_changes, telling.report, line.stop)
    else:
        run_id = _intended(order, seed)
        run = create_run(order.recordings, config, seed, run_id=run_id)
        if run.run_id != run_id:
            _note_run(order, seed, run.run_id)
        telling = Telling(line.tell, run.run_id, seed, number, len(config.seeds))
        run = run_job(Job(config, seed), run, telling.report, line.stop)
    telling.end()
    return run


def _run_of(order: Order, seed: int) -> Run | None:
    """Return the run of a seed; None if there is none yet, or none any more."""
    run_id = runs_in(order.folder).get(seed)
    if run_id is None or not (order.recordings / run_id).is_dir():
        return None
    with contextlib.suppress(OSError):
        (order.recordings / run_id).rmdir()  # made, and killed before anything was in it
        return None
    with contextlib.suppress(RunnerError):
        return find_run(str((order.recordings / run_id).absolute()), order.recordings)
    return None


def _intended(order: Order, seed: int) -> str:
    """Return the id of the run that is to be begun, written down before there is one."""
    run_id = new_run_id(order.recordings)
    _note_run(order, seed, run_id)
    return run_id


def _note_run(order: Order, seed: int, run_id: str) -> None:
    noted = runs_in(order.folder) | {seed: run_id}
    write_whole(order.folder / RUNS_FILE, {str(key): value for key, value in noted.items()})


def _wait_for_others(runs: Iterable[Run], stop: Callable[[], bool]) -> None:
    """Wait until no process owns one of these runs: that of a server that was killed is about to stop.

    Raises:
        RunnerError: one still does after a minute.
    """
    deadline = time.monotonic() + OTHERS_SECONDS
    for run in runs:
        while run.status == "running" and not stop():
            if time.monotonic() > deadline:
                owner = run.facts.get("owner", {})
                raise RunnerError(
                    f"run {run.run_id} is still running (process {owner.get('pid')} on {owner.get('host')}); "
                    "resume the job when that has come to its end."
                )
            time.sleep(TELL_SECONDS)
            run = find_run(str(run.folder.absolute()), run.folder.parent)  # noqa: PLW2901


class Telling:
    """Passes a run's progress on, a few times a second, and each line that it logs.

    Args:
        tell: who is told.
        run_id: the run's.
        seed: the run's.
        number: how many runs of the job came before it.
        runs: how many the job has.
    """

    def __init__(self, tell: Tell, run_id: str, seed: int, number: int, runs: int) -> None:
        self._tell = tell
        self._about = {"run_id": run_id, "seed": seed}
        self._of = {"run": number + 1, "runs": runs}
        self._last, self._logged = 0.0, 0
        self._progress: Progress | None = None
        tell("run", self._about)

    def report(self, progress: Progress) -> None:
        """Take in how far the run is."""
        self._progress = progress
        if time.monotonic() - self._last >= TELL_SECONDS:
            self._last = time.monotonic()
            self._pass_on(progress)

    def end(self) -> None:
        """Pass on what is left."""
        if self._progress is not None:
            self._pass_on(self._progress)

    def _pass_on(self, progress: Progress) -> None:
        for text in progress.log[self._logged :]:
            self._tell("log", self._about | {"text": text[:MAX_TEXT]})
        self._logged = len(progress.log)
        self._tell("progress", self._about | self._of | progress_facts(progress))


def progress_facts(progress: Progress) -> dict[str, Any]:
    """Return how far a run is, as plain values."""
    from runner.execution import evaluation_brief

    return {
        "episode": progress.episode,
        "episodes": progress.episodes,
        "train_steps": progress.train_steps,
        "eval_steps": progress.eval_steps,
        "bytes": progress.bytes_written,
        "last_evaluation": evaluation_brief(progress.evaluations[-1]) if progress.evaluations else None,
    }


def _do_sweep(order: Order, line: Line) -> Outcome:
    from runner.sweep import state
    from runner.sweep.loading import from_values
    from runner.sweep.plan import plan_of, require_disk, room
    from runner.sweep.trials import INTERRUPTED, run_sweep

    sweep = from_values(_described(order))
    with _held(order, line.stop):
        there = order.name in state.sweeps_in(order.recordings)
        state.begin(sweep, order.recordings, resume=there, accept_changes=False)
        if order.retry:
            state.forget_failures(order.name, order.recordings)
        _wait_for_others(state.runs_of(order.name, order.recordings).values(), line.stop)
        before = len(state.runs_of(order.name, order.recordings))
        plan = plan_of(sweep)
        require_disk(plan, before, order.recordings)
        telling = _SweepTelling(line)
        with _workers(order, line, plan.runs) as workers:
            _, standing = run_sweep(
                sweep,
                order.recordings,
                workers,
                stop=line.stop,
                report=telling.report,
                room=room(sweep.file.limits, plan, order.recordings, before),
                accept_changes=order.accept_changes,
            )
        telling.tell(standing)
    if standing.stopped == INTERRUPTED and line.stop():
        return Outcome("interrupted")
    if standing.stopped:
        return Outcome("failed", f"stopped: {standing.stopped}")
    if standing.failed:
        return Outcome("failed", f"{standing.failed:,} of {standing.runs:,} runs failed; the sweep says why.")
    return Outcome("finished")


@contextlib.contextmanager
def _held(order: Order, stop: Callable[[], bool]) -> Iterator[None]:
    """Keep every other process from doing the sweep; wait for one that is about to stop.

    Raises:
        RunnerError: one still does it after a minute.
    """
    from runner.sweep import state

    deadline = time.monotonic() + OTHERS_SECONDS
    with contextlib.ExitStack() as stack:
        while True:
            try:
                stack.enter_context(state.held(order.name, order.recordings))
                break
            except state.SweepBusy:
                if time.monotonic() > deadline or stop():
                    raise
                time.sleep(TELL_SECONDS)
        yield


@contextlib.contextmanager
def _workers(order: Order, line: Line, runs: int) -> Iterator[Workers]:
    """Give those who do a sweep's runs: this machine's within the slots, or a cluster's."""
    if order.ray is not None:
        from runner.sweep.cluster import RayWorkers

        with RayWorkers(None, order.ray, runs) as remote:
            yield remote
        return
    from runner.sweep.local import LocalWorkers

    with LocalWorkers(runs) as local:
        yield Sharing(local, line)


class Sharing:
    """Workers of whom no more are busy than there are slots just now.

    Args:
        workers: they.
        line: says how many; is told how many are busy.
    """

    def __init__(self, workers: Workers, line: Line) -> None:
        self._workers, self._line = workers, line
        self._busy, self._told = 0, (0, 0)

    @property
    def idle(self) -> int:
        """How many more tasks can be given."""
        slots = self._line.slots
        self._tell(slots)
        return max(0, min(self._workers.idle, slots - self._busy))

    def give(self, task: Task) -> None:
        """Have an idle worker do a task."""
        self._busy += 1
        self._tell(self._line.slots)
        self._workers.give(task)

    def collect(self, seconds: float) -> list[tuple[Task, Result | None]]:
        """Return what is done, waiting so long for it; None for a worker that died, and was replaced."""
        done = self._workers.collect(seconds)
        self._busy -= len(done)
        self._tell(self._line.slots)
        return done

    def stop(self) -> None:
        """Have every worker close its recording and return its task as interrupted."""
        self._workers.stop()

    def _tell(self, slots: int) -> None:
        """Say how many slots are heeded, and how many are taken, if that has changed."""
        if self._told != (slots, self._busy):
            self._told = slots, self._busy
            self._line.tell("slots", max(slots, self._busy))


class _SweepTelling:
    """Passes a sweep's standing on, a few times a second, and each trial that is the best so far."""

    def __init__(self, line: Line) -> None:
        self._line = line
        self._last, self._best = 0.0, -1

    def report(self, standing: Standing) -> None:
        """Take in how the sweep stands."""
        if time.monotonic() - self._last >= TELL_SECONDS:
            self._last = time.monotonic()
            self.tell(standing)

    def tell(self, standing: Standing) -> None:
        """Pass it on."""
        best = standing.best
        if best is not None and best.number != self._best:
            self._best = best.number
            text = f"trial {best.number} is the best so far: {best.value:g}"
            self._line.tell("log", {"text": text})
        self._line.tell(
            "progress",
            {
                "done": standing.done,
                "runs": standing.runs,
                "running": standing.running,
                "pruned": standing.pruned,
                "failed": standing.failed,
                "bytes": standing.bytes,
                "best": best and {"trial": best.number, "value": _known(best.value), "values": best.values},
            },
        )


def _known(value: float | None) -> float | None:
    """Return a value that JSON has a word for; None for a level that was never reached."""
    return value if value is not None and math.isfinite(value) else None
