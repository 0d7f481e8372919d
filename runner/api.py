"""Running experiments from Python: `runner.run` and `runner.run_all`, and what the command line shares.

import runner

run = runner.run("quick", seed=3)
print(run.run_id, run.summary["last_evaluation"])
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from runner.config import ConfigError, ExperimentConfig, RunTable, from_mapping, load
from runner.config.job import Job, jobs_of
from runner.runs.run import Run, create_run, recordings_folder, unless_empty
from runner.util.values import checked_name

if TYPE_CHECKING:  # both are imported late: a run is to stand on disk before NumPy and Numba are loaded
    from runner.execution.session import Progress

Config = str | os.PathLike[str] | Mapping[str, Any] | ExperimentConfig
Handler = Callable[[int, Any], Any] | int | signal.Handlers | None

_SIGNALS: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGBREAK") if hasattr(signal, name)
)


def run(
    config: Config,
    *,
    seed: int | None = None,
    overrides: Sequence[str] = (),
    name: str | None = None,
    recordings: str | os.PathLike[str] | None = None,
    report: Callable[[Progress], None] = lambda _: None,
) -> Run:
    """Train, evaluate and record one run, and return it when it is finished.

    On the main thread SIGINT (Ctrl-C) and SIGTERM close the recording properly before they raise.

    Args:
        config: the path of a YAML file, the same as a mapping, or an `ExperimentConfig`.
        seed: the seed, instead of the configuration's; needed where that has several.
        overrides: `KEY=VALUE` each, as `--set` takes them.
        name: what the run is called; the configuration's name unless given.
        recordings: the folder for it: $DUALTAXI_RECORDINGS, or ./recordings, unless given.
        report: called with the progress a few times a second.

    Raises:
        ConfigError: the configuration cannot be used, or has several seeds and none was chosen.
        EnvironmentNotUsable: the environment is unknown, or has no transition table.
        StorageError: the recordings folder cannot be written, or its disk is full.
        KeyboardInterrupt: it was interrupted; what was recorded is kept.
    """
    experiment = experiment_of(config, overrides, seed)
    if len(experiment.seeds) > 1:
        raise ConfigError(
            f"found {len(experiment.seeds)} seeds, and run() does one: choose it by seed=, or call run_all()."
        )
    return next(_run_jobs(experiment, name, recordings, report))


def run_all(
    config: Config,
    *,
    overrides: Sequence[str] = (),
    name: str | None = None,
    recordings: str | os.PathLike[str] | None = None,
    report: Callable[[Progress], None] = lambda _: None,
    workers: int = 1,
) -> Iterator[Run]:
    """Yield the runs of an experiment in the order of its seeds; arguments and errors as for `run`.

    Args:
        config: as for `run`; it may have several seeds.
        overrides: as for `run`.
        name: as for `run`.
        recordings: as for `run`.
        report: as for `run`; with several at once it is called from their threads.
        workers: number of runs to train in parallel, one thread each. What they record is the same.
    """
    if workers < 1:
        raise ConfigError(f"workers: found {workers}, expected 1 or more.")
    experiment = experiment_of(config, overrides)
    if workers == 1:
        return _run_jobs(experiment, name, recordings, report)
    return _run_parallel(experiment, name, recordings, report, workers)


def experiment_of(config: Config, overrides: Sequence[str] = (), seed: int | None = None) -> ExperimentConfig:
    """Return the experiment that a path, a mapping or an experiment means, with overrides and seed put in.

    Raises:
        ConfigError: it does not describe an experiment.
    """
    changes = [*overrides, *([] if seed is None else [f"seed={seed}"])]
    if isinstance(config, ExperimentConfig):
        return from_mapping(config.to_mapping(), changes) if changes else config
    if isinstance(config, Mapping):
        return from_mapping(config, changes)
    return load(config, changes)


def jobs_in(config: ExperimentConfig, recordings: Path) -> Iterator[Job]:
    """Yield the jobs of an experiment, one a seed; all begin with the same table, if it is a run's.

    Raises:
        RunnerError: it begins with the table of a run that is not there.
    """
    if isinstance(config.initial_q, RunTable):
        from runner.execution.initial_tables import resolve_initial_q

        config = resolve_initial_q(config, recordings)
    return jobs_of(config)


def run_parallel(
    jobs: Iterable[Job],
    folder: Path,
    name: str | None,
    workers: int,
    stop: Callable[[], bool],
    report: Callable[[Progress], None] = lambda _: None,
) -> Iterator[Run]:
    """Yield the runs of jobs in their order, several learning side by side, each on a thread of its own.

    Learning releases the interpreter's lock, and a run has its own tables and draws: what it records is
    what it would record alone. Once `stop` says True, runs under way are closed, and no other is begun.
    """
    from collections import deque
    from concurrent.futures import Future, ThreadPoolExecutor

    left = threading.Event()

    def stopped() -> bool:
        return left.is_set() or stop()

    def do(job: Job) -> Run | None:
        if stopped():
            return None
        from runner.execution.session import run_job

        run = create_run(folder, job.config, job.seed, name)
        with unless_empty(run):
            return run_job(job, run, report, stopped)

    under_way: deque[Future[Run | None]] = deque()
    with ThreadPoolExecutor(workers, thread_name_prefix="learner") as threads:
        try:
            for job in jobs:
                under_way.append(threads.submit(do, job))
                if len(under_way) == 2 * workers and (run := under_way.popleft().result()):
                    yield run
            yield from (run for each in under_way if (run := each.result()))
        finally:
            left.set()


class Interrupt:
    """Whether the process was told to stop."""

    def __init__(self) -> None:
        self.came = False

    def __call__(self) -> bool:
        """Return whether it was, as `run_job` asks."""
        return self.came


@contextlib.contextmanager
def interruptible(second: Handler = None) -> Iterator[Interrupt]:
    """Catch the first SIGINT or SIGTERM, so that a run can end properly; the caller looks whether it came.

    Args:
        second: the handler of a second signal: the one from before, unless given.

    Handlers belong to the main thread; on another one nothing is caught.
    """
    interrupt = Interrupt()
    if threading.current_thread() is not threading.main_thread():
        yield interrupt
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}

    def first(_number: int, _frame: Any) -> None:
        interrupt.came = True
        for number, handler in before.items():
            _handle(number, handler if second is None else second)

    try:
        for number in _SIGNALS:
            signal.signal(number, first)
        yield interrupt
    finally:
        for number, handler in before.items():
            _handle(number, handler)


def _handle(number: int, handler: Handler) -> None:
    """Set a signal's handler; one that was not set from Python (None) cannot be set again."""
    if handler is not None:
        signal.signal(number, handler)


def _run_jobs(
    config: ExperimentConfig,
    name: str | None,
    recordings: str | os.PathLike[str] | None,
    report: Callable[[Progress], None],
) -> Iterator[Run]:
    """Yield a run a seed; the folder is checked and the run stands on disk before anything heavy."""
    called, folder = checked_name(name), recordings_folder(recordings)
    for job in jobs_in(config, folder):
        yield _run_job(job, folder, called, report)


def _run_parallel(
    config: ExperimentConfig,
    name: str | None,
    recordings: str | os.PathLike[str] | None,
    report: Callable[[Progress], None],
    workers: int,
) -> Iterator[Run]:
    called, folder = checked_name(name), recordings_folder(recordings)
    with interruptible() as interrupt:
        for run in run_parallel(jobs_in(config, folder), folder, called, workers, interrupt, report):
            if interrupt.came:
                raise KeyboardInterrupt(f"runs were interrupted; what they recorded is in {folder}")
            yield run


def _run_job(job: Job, folder: Path, name: str | None, report: Callable[[Progress], None]) -> Run:
    with interruptible() as interrupt:
        run = create_run(folder, job.config, job.seed, name)
        with unless_empty(run):
            from runner.execution.session import run_job

            run = run_job(job, run, report, interrupt)
    if interrupt.came:
        raise KeyboardInterrupt(f"run {run.run_id} was interrupted; what it recorded is in {run.recording}")
    return run
