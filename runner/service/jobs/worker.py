"""Doing a job: a configuration seed by seed, a branch, a sweep or an explanation; its process."""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import shlex
import signal
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, TypeVar

from runner.analysis.episodes import EpisodeRef
from runner.archive.places import at_hand
from runner.client.jobs import (
    BestTrial,
    EventData,
    JobEvent,
    LogEvent,
    RunEvent,
    RunProgress,
    StateEvent,
    SweepProgress,
)
from runner.config import ExperimentConfig, from_mapping
from runner.config.model import Job
from runner.debugging.explain import (
    EPISODES,
    RUNS,
    ExplanationBusy,
    answer,
)
from runner.debugging.explanation import summary
from runner.debugging.mixtures import Measurement, MixtureResult
from runner.errors import RunnerError, full_message
from runner.execution.branching import train_branch
from runner.execution.resume import resume
from runner.execution.session import Progress, Report, evaluation_brief, run_job
from runner.recording.reader import open_recording
from runner.runs.resolve import run_of_id
from runner.runs.run import Run, create_run, locked, run_at
from runner.service.jobs.checking import BranchQuestion, ExplainQuestion
from runner.service.jobs.store import QueuedJob, read_values
from runner.service.processes import lower_priority
from runner.service.settings import without_folders
from runner.sweep import state
from runner.sweep.model import from_values
from runner.sweep.running import SweepStatus, run_whole_sweep
from runner.sweep.workers import Workers, worker_pool
from runner.util.compilation import MESSAGE, announced
from runner.util.extras import require
from runner.util.processes import OWN_ONLY
from runner.util.values import Json, as_utf8, finite

T = TypeVar("T")
REPORT_SECONDS: Final = 0.25
OTHER_OWNER_SECONDS: Final = 60.0
"""Time limit for another owner to release a run; on another host it counts as dead after 15 s."""


@dataclass(frozen=True)
class JobSpec:
    """A job, its folder, and where to do it."""

    folder: Path
    job: QueuedJob
    ray: str | None = None
    """The address of the Ray cluster that this process belongs to; None if it belongs to none."""

    @property
    def recordings(self) -> Path:
        """The recordings folder of the job."""
        return self.folder.parents[1]

    @property
    def workers(self) -> int | None:
        """How many processes may train at once; None for as many as the cluster has."""
        return self.job.workers if self.ray is None else None


@dataclass(frozen=True)
class JobChannel:
    """Where a job sends its events, and learns that it must stop."""

    send: Callable[[EventData], None]
    stop: Callable[[], bool]
    """Returns whether the job must stop; called every few milliseconds."""


def until_free(
    attempt: Callable[[], T],
    busy: type[RunnerError],
    stop: Callable[[], bool],
    seconds: float = math.inf,
    waiting: Callable[[], None] = lambda: None,
) -> T:
    """Return the result of a call that is repeated as long as it raises `busy`; `waiting` is called then.

    The error is raised when the job must stop, or after this time.
    """
    deadline = time.monotonic() + seconds
    while True:
        try:
            return attempt()
        except busy:
            if stop() or time.monotonic() > deadline:
                raise
            waiting()
            time.sleep(REPORT_SECONDS)


def wait_for_owners(runs: Iterable[Run], stop: Callable[[], bool]) -> None:
    """Wait until no process owns one of these runs: the workers of a server that was killed are stopping.

    Raises:
        RunnerError: one is still owned after a minute, or when the job must stop.
    """
    for run in runs:
        if run.status == "running":
            until_free(partial(_require_free, run), RunnerError, stop, OTHER_OWNER_SECONDS)


def _require_free(run: Run) -> None:
    with locked(run):
        pass


POLL_SECONDS: Final = 0.5
CLOSE_SECONDS: Final = 10
"""How long the command may take to close its recording before Ray kills it."""
START_SECONDS: Final = 60
"""How long to wait for a cluster that has just started, or whose machines are all busy, to take a job."""
LOG_SECONDS: Final = 5.0
"""How long to wait for the rest of the log of a command that has ended."""
COMMAND: Final = "python -P -m runner run --job"
"""The command without the folder of its job; `-P` imports nothing from the current folder."""


def require_job_api() -> Any:
    """Return the module of Ray's job API, with all that it needs."""
    return require("ray.job_submission", "aiohttp", extra="ray", purpose="`serve --ray`")


def do_on_cluster(spec: JobSpec, address: str, channel: JobChannel) -> StateEvent | None:
    """Have a cluster do what is left of a job, and forward its events; return its outcome.

    None if the command died, perhaps with its machine. What a killed server left on the cluster is stopped.
    """
    folder = os.fspath(spec.folder)
    try:
        client = require_job_api().JobSubmissionClient(address)
        for job in client.list_jobs():
            if (job.metadata or {}).get("folder") == folder and not job.status.is_terminal():
                client.stop_job(job.submission_id)
        submission = _submitted(
            client,
            channel,
            entrypoint=f"{COMMAND} {shlex.quote(folder)}",
            entrypoint_num_cpus=1 if spec.job.run_ids else 0,
            runtime_env={"env_vars": {OWN_ONLY: "1", "RAY_JOB_STOP_WAIT_TIME_S": str(CLOSE_SECONDS)}},
            metadata={"folder": folder},
        )
        return asyncio.run(_follow(client, submission, channel))
    except (OSError, RuntimeError, RunnerError) as error:
        return StateEvent("failed", f"--ray: the cluster at {address} does not do this job: {error}")


def _submitted(client: Any, channel: JobChannel, **job: object) -> str:
    """Submit a job and return its number; where Ray asks for another try later, try for a minute."""
    end = time.monotonic() + START_SECONDS
    while True:
        try:
            return str(client.submit_job(**job))
        except RuntimeError as error:
            if "try again later" not in str(error) or channel.stop() or time.monotonic() > end:
                raise
        time.sleep(POLL_SECONDS)


async def _follow(client: Any, submission: str, channel: JobChannel) -> StateEvent | None:
    """Forward the events of a command until it has ended; return its outcome."""
    log = asyncio.create_task(_forward(client, submission, channel))
    while not client.get_job_status(submission).is_terminal():
        if channel.stop():
            client.stop_job(submission)
        await asyncio.sleep(POLL_SECONDS)
    with contextlib.suppress(OSError, RuntimeError):  # the machine with the log is gone
        async with asyncio.timeout(LOG_SECONDS):
            if (outcome := await log) is not None:
                return outcome
    if channel.stop():
        return StateEvent("interrupted")
    channel.send(LogEvent(f"Ray: {client.get_job_info(submission).message}"))
    return None


async def _forward(client: Any, submission: str, channel: JobChannel) -> StateEvent | None:
    """Send the events in the log of a command, whose other lines are what libraries print."""
    rest, outcome = "", None
    async for text in client.tail_job_logs(submission):
        *lines, rest = (rest + text).split("\n")
        for line in lines:
            with contextlib.suppress(RunnerError):
                data = JobEvent.from_line(line).data
                if isinstance(data, StateEvent):
                    outcome = data
                else:
                    channel.send(data)
    return outcome


MAX_TEXT: Final = 4000
"""The length of a log line."""


def work(pipe: Connection, spec: JobSpec, cluster: str | None = None) -> None:
    """Do a job, or have a Ray cluster do it; the main function of a worker process.

    Events go through the pipe. The server sends one message: that the job must stop. If the server dies, the
    worker stops as well: it closes its recording, so that the next server of the folder can resume it.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C, which reaches every process, is for the server
    lower_priority()
    stopping, lock = threading.Event(), threading.Lock()

    def wait_for_stop() -> None:
        with contextlib.suppress(EOFError, OSError):
            pipe.recv()
        stopping.set()

    def send(event: EventData) -> None:
        with lock, contextlib.suppress(OSError):  # the server is gone
            pipe.send(event)

    signal.signal(signal.SIGTERM, lambda *_: stopping.set())
    threading.Thread(target=wait_for_stop, daemon=True).start()
    channel = JobChannel(send, stopping.is_set)
    outcome = do_job(spec, channel) if cluster is None else do_on_cluster(spec, cluster, channel)
    if outcome is not None:
        send(outcome)


def do_job(spec: JobSpec, channel: JobChannel) -> StateEvent:
    """Do what is left of a job, and return its outcome; a worker and the option --job call this."""
    try:
        with announced(lambda: channel.send(LogEvent(MESSAGE))):
            kinds = {"sweep": run_sweep_job, "explain": run_explain_job, "episode": run_episode_job}
            kinds.get(spec.job.kind, run_config_job)(spec, channel)
        return StateEvent("finished")
    except (RunnerError, OSError, KeyboardInterrupt) as error:
        if channel.stop():  # whatever else was the matter, the next worker meets it again
            return StateEvent("interrupted")
        return StateEvent("failed", as_utf8(without_folders(full_message(error), spec.recordings)))


def run_config_job(spec: JobSpec, channel: JobChannel) -> None:
    """Run what is left of a configuration's seeds, one after the other."""
    config = from_mapping(read_values(spec.folder))
    for seed in config.seeds:
        if channel.stop() or run_seed(spec, channel, config, seed) != "finished":
            raise KeyboardInterrupt


def run_seed(spec: JobSpec, channel: JobChannel, config: ExperimentConfig, seed: int) -> str:
    """Start or resume a job's run of one seed; return its status."""
    run = _existing_run(spec.recordings / spec.job.run_ids[seed])
    if run is not None and run.status == "finished":
        if seed not in spec.job.started_runs:  # the server was killed before it knew
            channel.send(RunEvent(run.run_id, seed))
        return run.status
    if run is not None:
        wait_for_owners([run], channel.stop)
        report = _reporter(channel, run.run_id, config, seed)
        run = resume(run, spec.job.accept_changes, report, channel.stop)
    else:
        job = Job(config, seed)
        parent = parent_in(spec, job.config.branches[-1].run) if spec.job.kind == "branch" else None
        run = create_run(spec.recordings, config, seed, spec.job.name, spec.job.run_ids[seed], parent)
        report = _reporter(channel, run.run_id, config, seed)
        report(Progress(config.episodes))  # the next one follows when training begins
        if parent is None:
            run = run_job(job, run, report, channel.stop)
        else:
            with open_recording(parent.recording) as recording:
                run = train_branch(recording, job, run, report, channel.stop)
    return run.status


def _existing_run(folder: Path) -> Run | None:
    with contextlib.suppress(OSError):
        folder.rmdir()  # created by a worker that was killed before it wrote anything
    with contextlib.suppress(RunnerError):
        return run_at(folder) if folder.is_dir() else None
    return None


def _reporter(channel: JobChannel, run_id: str, config: ExperimentConfig, seed: int) -> Report:
    """Return the function that sends the progress of a run, and each line of its log."""
    sent = 0

    def report(progress: Progress) -> None:
        nonlocal sent
        for text in progress.log[sent:]:
            channel.send(LogEvent(text[:MAX_TEXT], run_id, seed))
        sent = len(progress.log)
        event = RunProgress(
            run_id,
            seed,
            run=config.seeds.index(seed) + 1,
            runs=len(config.seeds),
            episode=progress.episode,
            episodes=progress.episodes,
            train_steps=progress.train_steps,
            eval_steps=progress.eval_steps,
            bytes=progress.bytes_written,
            last_evaluation=evaluation_brief(progress.evaluations[-1]) if progress.evaluations else None,
        )
        channel.send(event)

    channel.send(RunEvent(run_id, seed))
    return report


def run_episode_job(spec: JobSpec, channel: JobChannel) -> None:
    """Play the episode on, unless that is done, and log where it led."""
    from runner.debugging.branch import EpisodeBranch, branch_episode  # slow to import

    values: Json = read_values(spec.folder)
    parent = parent_in(spec, values.pop("run"))
    question = BranchQuestion.model_validate(values)
    ((seed, run_id),) = spec.job.run_ids.items()

    def report(steps: int) -> None:
        if channel.stop():
            raise KeyboardInterrupt
        channel.send(RunProgress(run_id, seed, train_steps=steps))

    if not (spec.recordings / run_id).is_dir():
        task = EpisodeBranch(
            at=EpisodeRef.parse(question.at),
            action=question.action,
            policy=question.policy,
            seed=question.seed,
            name=question.name,
            run_id=run_id,
        )
        report(0)  # the environment is made, and brought to the step
        branch = branch_episode(parent, task, spec.recordings, report)
        if branch.is_recorded_action:
            channel.send(LogEvent(f"the action is the one that was recorded at {task.at}"))
        channel.send(LogEvent(f"recorded: {branch.parent}; with the change: {branch.outcome}"))
    channel.send(RunEvent(run_id, seed))


def parent_in(spec: JobSpec, run_id: str) -> Run:
    """Return the run that a job branches, with its recording at hand.

    Raises:
        RunnerError: it is no longer there.
    """
    parent = run_of_id(run_id, spec.recordings)
    if parent is None:
        raise RunnerError(
            f"run {run_id}, the parent of this branch, is no longer there; import it, and resume the job."
        )
    return at_hand(parent)


def run_sweep_job(spec: JobSpec, channel: JobChannel) -> None:
    """Run what is left of a sweep, once no other process runs it."""
    until_free(partial(_run_rest, spec, channel), state.SweepBusy, channel.stop, OTHER_OWNER_SECONDS)


def _run_rest(spec: JobSpec, channel: JobChannel) -> None:
    sweep = from_values(read_values(spec.folder))
    recordings = spec.recordings
    wait_for_owners(state.runs_of(sweep.name, recordings).values(), channel.stop)
    _, status = run_whole_sweep(
        sweep,
        recordings,
        spec.workers,
        spec.ray,
        resume=True,
        retry_failed=spec.job.retry,
        accept_changes=spec.job.accept_changes,
        stop=channel.stop,
        report=_sweep_reporter(channel),
    )
    if status.stopped:
        raise RunnerError(f"stopped: {status.stopped}")
    if status.failed:
        raise RunnerError(
            f"{status.failed:,} of {status.runs:,} runs failed; `dualtaxi sweep show {sweep.name}` says why."
        )


def _sweep_reporter(channel: JobChannel) -> Callable[[SweepStatus], None]:
    """Return the function that sends a sweep's progress, and each trial that is the best one yet."""
    last = -1

    def report(status: SweepStatus) -> None:
        nonlocal last
        best = status.best
        best_trial = None
        if best is not None:
            if best.number != last:
                last = best.number
                channel.send(LogEvent(f"trial {best.number} is the best so far: {best.value:g}"))
            # A level that was never reached is infinite or None; JSON has no infinity.
            best_trial = BestTrial(best.number, finite(best.value), best.values)
        event = SweepProgress(
            done=status.done,
            runs=status.runs,
            running=status.running,
            pruned=status.pruned,
            failed=status.failed,
            bytes=status.bytes,
            best=best_trial,
        )
        channel.send(event)

    return report


BUSY: Final = "busy"
LINES: Final = {
    BUSY: "another job or command is explaining the same two; waiting for it",
    EPISODES: "two short runs are recorded to find the first step that differs",
}
"""Lines of the log, each at the first report of a stage."""


def run_explain_job(spec: JobSpec, channel: JobChannel) -> None:
    """Train what is left of an explanation, and store it."""
    question = ExplainQuestion.model_validate(read_values(spec.folder)).resolved(spec.recordings)
    stages = set[str]()

    def report(done: int, total: int, what: str) -> None:
        if what == RUNS:
            channel.send(SweepProgress(done, total))
        elif what not in stages:
            stages.add(what)
            channel.send(LogEvent(LINES[what]))

    workers: Workers[Measurement, MixtureResult]
    with worker_pool(spec.workers, spec.ray, question.mixtures[1]) as workers:
        result = until_free(
            partial(answer, question, workers, report, stop=channel.stop),
            ExplanationBusy,  # another job or command asks for another metric, or more seeds
            channel.stop,
            waiting=lambda: report(0, 0, BUSY),
        )
    for line in summary(result):
        channel.send(LogEvent(line))
