"""Running experiments from Python: `runner.run` and `runner.run_all`, which the command line uses too.

import runner

run = runner.run("quick", seed=3)
print(run.run_id, run.summary["last_evaluation"])
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Final

from runner.config import ConfigError, ExperimentConfig, from_mapping, load
from runner.config.model import Job, jobs_of
from runner.config.sections import RunTable
from runner.errors import RunNotFound
from runner.runs.run import Run, create_run, recordings_folder, unless_empty
from runner.util.values import checked_name

if TYPE_CHECKING:  # imported late: a run is written to disk before NumPy and Numba are loaded
    from runner.execution.session import Progress

Config = str | os.PathLike[str] | Mapping[str, object] | ExperimentConfig
Handler = Callable[[int, object], object] | int | signal.Handlers | None

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
        seed: the seed, instead of the configuration's; required if that has several.
        overrides: `KEY=VALUE` each, as for `--set`.
        name: the name of the run; the configuration's name by default.
        recordings: the recordings folder: $DUALTAXI_RECORDINGS, or ./recordings, by default.
        report: called with the progress a few times a second.

    Raises:
        ConfigError: the configuration is not valid, or has several seeds and none was chosen.
        EnvironmentNotUsable: the environment is unknown, or has no transition table.
        StorageError: the recordings folder cannot be written, or its disk is full.
        KeyboardInterrupt: it was interrupted; what was recorded is kept.
    """
    experiment = experiment_of(config, overrides, seed)
    if len(experiment.seeds) > 1:
        raise ConfigError(
            f"found {len(experiment.seeds)} seeds, and run() does one: choose it by seed=, or call run_all()."
        )
    return next(_runs(experiment, name, recordings, report, 1))


def run_all(
    config: Config,
    *,
    overrides: Sequence[str] = (),
    name: str | None = None,
    recordings: str | os.PathLike[str] | None = None,
    report: Callable[[Progress], None] = lambda _: None,
    workers: int = 1,
) -> Iterator[Run]:
    """Yield the runs of an experiment in the order of its seeds; errors as for `run`.

    Args:
        config: as for `run`; it may have several seeds.
        overrides: as for `run`.
        name: as for `run`.
        recordings: as for `run`.
        report: as for `run`; with several workers it is called from their threads.
        workers: number of runs to train in parallel, one thread each; the recordings are the same.
    """
    if workers < 1:
        raise ConfigError(f"workers: found {workers}, expected 1 or more.")
    return _runs(experiment_of(config, overrides), name, recordings, report, workers)


def _runs(
    config: ExperimentConfig,
    name: str | None,
    recordings: str | os.PathLike[str] | None,
    report: Callable[[Progress], None],
    workers: int,
) -> Iterator[Run]:
    """Yield the run of each seed; names and folders are checked before heavy packages are imported."""
    run_name, folder = checked_name(name), recordings_folder(recordings)
    jobs = jobs_in(config, folder)
    if workers > 1:
        with interruptible() as interrupt:
            for run in run_parallel(jobs, folder, run_name, workers, interrupt, report):
                if interrupt.came:
                    raise KeyboardInterrupt(f"runs were interrupted; what they recorded is in {folder}")
                yield run
        return
    for job in jobs:
        with interruptible() as interrupt:
            run = _recorded(job, folder, run_name, report, interrupt)
        if interrupt.came:
            raise KeyboardInterrupt(
                f"run {run.run_id} was interrupted; what it recorded is in {run.recording}"
            )
        yield run


def _recorded(
    job: Job, folder: Path, name: str | None, report: Callable[[Progress], None], stop: Callable[[], bool]
) -> Run:
    run = create_run(folder, job.config, job.seed, name)
    with unless_empty(run):
        from runner.execution.session import run_job

        return run_job(job, run, report, stop)


def experiment_of(config: Config, overrides: Sequence[str] = (), seed: int | None = None) -> ExperimentConfig:
    """Return the experiment of a path, a mapping or an experiment, with overrides and a seed.

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
    """Yield the jobs of an experiment, one per seed, all with the same initial table.

    Raises:
        RunnerError: the run with the initial table does not exist.
    """
    if isinstance(config.initial_q, RunTable):
        from runner.execution.session import resolve_initial_q

        try:
            config = resolve_initial_q(config, recordings)
        except RunNotFound as error:
            raise RunNotFound(f"initial_q.run: {error}") from None
    return jobs_of(config)


def run_parallel(
    jobs: Iterable[Job],
    folder: Path,
    name: str | None,
    workers: int,
    stop: Callable[[], bool],
    report: Callable[[Progress], None] = lambda _: None,
) -> Iterator[Run]:
    """Yield the runs of jobs in their order, trained in parallel on one thread each.

    Training releases the interpreter's lock, and each run has its own tables and draws: it records what it
    would record alone. When `stop` returns True, current runs are closed and no others are started.
    """
    is_abandoned = threading.Event()

    def is_stopped() -> bool:
        return is_abandoned.is_set() or stop()

    def do(job: Job) -> Run | None:
        return None if is_stopped() else _recorded(job, folder, name, report, is_stopped)

    pending: deque[Future[Run | None]] = deque()
    with ThreadPoolExecutor(workers, thread_name_prefix="learner") as threads:
        try:
            for job in jobs:
                pending.append(threads.submit(do, job))
                if len(pending) == 2 * workers and (run := pending.popleft().result()):
                    yield run
            yield from filter(None, (future.result() for future in pending))
        finally:
            is_abandoned.set()


class Interrupt:
    """Whether a signal interrupted the process; also callable, as `run_job` needs it."""

    def __init__(self) -> None:
        self.came = False

    def __call__(self) -> bool:
        """Return whether a signal came."""
        return self.came


@contextlib.contextmanager
def interruptible(second: Handler = None) -> Iterator[Interrupt]:
    """Catch the first SIGINT or SIGTERM, so that a run can end properly; the caller checks whether it came.

    Handlers belong to the main thread; on another one nothing is caught.

    Args:
        second: the handler of a second signal; the previous one by default.
    """
    interrupt = Interrupt()
    if threading.current_thread() is not threading.main_thread():
        yield interrupt
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}

    def first(_number: int, _frame: object) -> None:
        interrupt.came = True
        restore(second)

    def restore(replacement: Handler) -> None:
        for number, handler in before.items():
            restored = handler if replacement is None else replacement
            if restored is not None:  # a handler that was not set from Python cannot be set again
                signal.signal(number, restored)

    try:
        for number in _SIGNALS:
            signal.signal(number, first)
        yield interrupt
    finally:
        restore(None)
