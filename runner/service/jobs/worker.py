"""A worker process: runs one job, a configuration seed by seed or a sweep, here or on a Ray cluster."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol

from runner.errors import RunnerError
from runner.runs.run import Run, run_at
from runner.service.settings import without_folders

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from pathlib import Path

    from runner.config import ExperimentConfig
    from runner.execution.session import Progress
    from runner.sweep.cluster import RayActor

REPORT_SECONDS: Final = 0.25
OTHER_OWNER_SECONDS: Final = 60.0
"""Time limit for another owner to release a run; on another host it counts as dead after 15 s."""
MAX_TEXT: Final = 4000
"""The length of a log line."""
NICENESS: Final = 5
"""Training yields to the server, whose users are waiting."""


@dataclass(frozen=True)
class JobSpec:
    """What a worker process needs to know of a job."""

    number: int
    kind: str
    name: str
    values: dict[str, Any]
    """The configuration or sweep, every value present."""
    run_ids: dict[int, str]
    """The run ids reserved for a configuration, by seed."""
    recordings: Path
    accept_changes: bool
    """Whether to resume runs that were started by other code."""
    retry: bool
    """Whether to repeat failed runs of a sweep."""
    ray: str | None
    """The address of the Ray cluster that runs the job; None for this machine."""


@dataclass(frozen=True)
class Outcome:
    """The result of a job."""

    state: Literal["finished", "interrupted", "failed"]
    error: str = ""


class JobChannel(Protocol):
    """Where a run sends its messages, and learns that it must stop."""

    def send(self, kind: str, data: Any) -> None:
        """Send a message to the server."""

    def stop(self) -> bool:
        """Return whether the run must stop."""


class PipeChannel:
    """The worker's end of the pipe to the server.

    The server sends how many processes the job may use, and when to stop. If the server dies, the worker
    stops as well: it closes its recording, so that the next server of the folder can resume it.
    """

    def __init__(self, pipe: Connection) -> None:
        self.slots = 1
        """How many processes may train at once."""
        self._pipe = pipe
        self._parent = os.getppid()
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        threading.Thread(target=self._receive, name="channel", daemon=True).start()

    def send(self, kind: str, data: Any) -> None:
        """Send a message to the server; nothing happens if it is gone."""
        with self._lock, contextlib.suppress(OSError):
            self._pipe.send((kind, data))

    def stop(self) -> bool:
        """Return whether the job must stop."""
        return self._stopping.is_set() or os.getppid() != self._parent

    def request_stop(self, *_: object) -> None:
        """Stop the job; also a handler of signals."""
        self._stopping.set()

    def _receive(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                kind, value = self._pipe.recv()
                if kind == "slots":
                    self.slots = value
                else:
                    self.request_stop()
        self.request_stop()


def work(pipe: Connection, spec: JobSpec) -> None:
    """Run a job and report its outcome; the main function of a worker process."""
    from runner.learning.compilation import MESSAGE, announced
    from runner.service.jobs.sweeps import run_sweep_job

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C, which reaches every process, is for the server
    with contextlib.suppress(OSError, AttributeError):  # not on Windows
        os.nice(NICENESS)
    channel = PipeChannel(pipe)
    signal.signal(signal.SIGTERM, channel.request_stop)
    try:
        with announced(lambda: channel.send("log", [{"text": MESSAGE}])):
            outcome = (run_sweep_job if spec.kind == "sweep" else run_config_job)(spec, channel)
    except RunnerError as error:
        message = "\n".join([str(error), *getattr(error, "__notes__", [])])
        outcome = Outcome("failed", without_folders(message, spec.recordings))
    channel.send("over", outcome)


def run_config_job(spec: JobSpec, channel: JobChannel) -> Outcome:
    """Run what is left of a configuration's seeds, one after the other.

    Raises:
        RunnerError: a run failed or cannot be resumed.
    """
    from runner.config import from_mapping

    config = from_mapping(spec.values)
    for number, seed in enumerate(config.seeds):
        run = run_seed if spec.ray is None else run_seed_on_ray
        if channel.stop() or run(spec, channel, config, seed, number) != "finished":
            return Outcome("interrupted")
    return Outcome("finished")


def run_seed(spec: JobSpec, channel: JobChannel, config: ExperimentConfig, seed: int, number: int) -> str:
    """Start or resume a job's run of one seed; return its status."""
    from runner.config.job import Job
    from runner.execution.resume import resume
    from runner.execution.session import run_job
    from runner.runs.run import create_run

    run = _existing_run(spec.recordings / spec.run_ids[seed])
    if run is not None and run.status == "finished":
        return run.status
    if run is not None:
        wait_for_owners([run], channel.stop)
        reporter = Reporter(channel, run.run_id, seed, number, len(config.seeds))
        run = resume(run, spec.accept_changes, reporter.report, channel.stop)
    else:
        run = create_run(spec.recordings, config, seed, run_id=spec.run_ids[seed])
        reporter = Reporter(channel, run.run_id, seed, number, len(config.seeds))
        run = run_job(Job(config, seed), run, reporter.report, channel.stop)
    reporter.end()
    return run.status


def _existing_run(folder: Path) -> Run | None:
    with contextlib.suppress(OSError):
        folder.rmdir()  # created by a worker that was killed before it wrote anything
    with contextlib.suppress(RunnerError):
        return run_at(folder) if folder.is_dir() else None
    return None


def wait_for_owners(runs: Iterable[Run], stop: Callable[[], bool]) -> None:
    """Wait until no process owns one of these runs: the workers of a server that was killed are stopping.

    Raises:
        RunnerError: one is still owned after a minute.
    """
    deadline = time.monotonic() + OTHER_OWNER_SECONDS
    for run in runs:
        while run.status == "running" and not stop():
            if time.monotonic() > deadline:
                owner = run.file.owner
                raise RunnerError(
                    f"run {run.run_id} is still running (process {owner.get('pid')} on {owner.get('host')}); "
                    "resume the job when that has ended."
                )
            time.sleep(REPORT_SECONDS)
            run = run_at(run.folder)  # noqa: PLW2901


class Reporter:
    """Sends a run's progress, a few times a second, and each line of its log.

    Args:
        channel: where to send it.
        run_id: the run's id.
        seed: the run's seed.
        number: how many runs of the job came before it.
        runs: the number of runs of the job.
    """

    def __init__(self, channel: JobChannel, run_id: str, seed: int, number: int, runs: int) -> None:
        self._channel = channel
        self._run = {"run_id": run_id, "seed": seed}
        self._position = {"run": number + 1, "runs": runs}
        self._sent, self._logged = 0.0, 0
        self._progress: Progress | None = None
        channel.send("run", self._run)

    def report(self, progress: Progress) -> None:
        """Accept the run's progress."""
        self._progress = progress
        if time.monotonic() - self._sent >= REPORT_SECONDS:
            self._sent = time.monotonic()
            self.end()

    def end(self) -> None:
        """Send what has not been sent yet."""
        from runner.execution.session import evaluation_brief

        if (progress := self._progress) is None:
            return
        if lines := progress.log[self._logged :]:
            self._channel.send("log", [self._run | {"text": text[:MAX_TEXT]} for text in lines])
        self._logged = len(progress.log)
        last = evaluation_brief(progress.evaluations[-1]) if progress.evaluations else None
        facts = {
            "episode": progress.episode,
            "episodes": progress.episodes,
            "train_steps": progress.train_steps,
            "eval_steps": progress.eval_steps,
            "bytes": progress.bytes_written,
            "last_evaluation": last,
        }
        self._channel.send("progress", self._run | self._position | facts)


def run_seed_on_ray(
    spec: JobSpec, channel: JobChannel, config: ExperimentConfig, seed: int, number: int
) -> str:
    """Run a seed in a Ray actor, and forward its messages; return the run's status.

    Raises:
        RunnerError: the cluster cannot be reached, the run fails, or the actor dies.
    """
    from runner.sweep.cluster import connect, start_actor

    ray = connect(spec.ray)
    try:
        actor = start_actor(ray)
        result = actor.run.remote(_run_seed_in_actor, spec, config.to_mapping(), seed, number)
        is_over = False
        while not is_over:
            is_over = bool(ray.wait([result], timeout=REPORT_SECONDS)[0])
            for kind, data in ray.get(actor.take_messages.remote()):
                channel.send(kind, data)
            if channel.stop():
                actor.request_stop.remote()
        status, error_message = ray.get(result)
    except ray.exceptions.RayError as error:
        raise RunnerError(f"--ray: the actor of seed {seed} is gone: {error}") from error
    finally:
        ray.shutdown()
    if error_message:
        raise RunnerError(error_message)
    return str(status)


def _run_seed_in_actor(
    actor: RayActor, spec: JobSpec, values: dict[str, Any], seed: int, number: int
) -> tuple[str, str]:
    """Run the seed; return the run's status, and the error message if it failed."""
    from runner.config import from_mapping

    try:
        return run_seed(spec, actor, from_mapping(values), seed, number), ""
    except RunnerError as error:
        return "failed", str(error)
