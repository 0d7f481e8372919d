"""A worker process: runs one job, a configuration seed by seed or a sweep, here or on a Ray cluster."""

from __future__ import annotations

import contextlib
import signal
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

from runner.archive.places import at_hand
from runner.client.jobs import LogEvent, RunEvent, RunProgress, StateEvent
from runner.config import ExperimentConfig, from_mapping
from runner.config.job import Job
from runner.errors import RunnerError
from runner.execution.branching import train_branch
from runner.execution.resume import resume
from runner.execution.session import Progress, evaluation_brief, run_job
from runner.recording.reader import open_recording
from runner.runs.listing import run_at
from runner.runs.resolve import run_of_id
from runner.runs.run import Run, create_run
from runner.service.jobs.channel import (
    REPORT_SECONDS,
    JobChannel,
    JobSpec,
    PipeChannel,
    wait_for_owners,
)
from runner.service.jobs.explanations import run_explain_job
from runner.service.jobs.sweeps import run_sweep_job
from runner.service.processes import lower_priority
from runner.service.settings import without_folders
from runner.sweep.cluster import RayActor, connect, start_actor
from runner.util.compilation import MESSAGE, announced
from runner.util.values import as_utf8

MAX_TEXT: Final = 4000
"""The length of a log line."""


def work(pipe: Connection, spec: JobSpec) -> None:
    """Run a job and report its outcome; the main function of a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C, which reaches every process, is for the server
    lower_priority()
    channel = PipeChannel(pipe)
    signal.signal(signal.SIGTERM, channel.request_stop)
    try:
        with announced(lambda: channel.send(LogEvent(MESSAGE))):
            run = {"sweep": run_sweep_job, "explain": run_explain_job}.get(spec.job.kind, run_config_job)
            run(spec, channel)
        outcome = StateEvent("finished")
    except (RunnerError, OSError, KeyboardInterrupt) as error:
        message = "\n".join([str(error), *getattr(error, "__notes__", [])])
        outcome = StateEvent("failed", as_utf8(without_folders(message, spec.recordings)))
        if channel.stop():  # whatever else was the matter, the next worker meets it again
            outcome = StateEvent("interrupted")
    channel.send(outcome)


def run_config_job(spec: JobSpec, channel: JobChannel) -> None:
    """Run what is left of a configuration's seeds, one after the other."""
    config = from_mapping(spec.values())
    run = run_seed if spec.ray is None else run_seed_on_ray
    for seed in config.seeds:
        if channel.stop() or run(spec, channel, config, seed) != "finished":
            raise KeyboardInterrupt


def run_seed(spec: JobSpec, channel: JobChannel, config: ExperimentConfig, seed: int) -> str:
    """Start or resume a job's run of one seed; return its status."""
    run = _existing_run(spec.recordings / spec.job.run_ids[seed])
    if run is not None and run.status == "finished":
        return run.status
    if run is not None:
        wait_for_owners([run], channel.stop)
        reporter = Reporter(channel, run.run_id, config, seed)
        run = resume(run, spec.job.accept_changes, reporter.report, channel.stop)
    else:
        job = Job(config, seed)
        parent = _parent_of(job, spec.recordings) if spec.job.kind == "branch" else None
        run = create_run(spec.recordings, config, seed, spec.job.name, spec.job.run_ids[seed], parent)
        reporter = Reporter(channel, run.run_id, config, seed)
        if parent is None:
            run = run_job(job, run, reporter.report, channel.stop)
        else:
            with open_recording(parent.recording) as recording:
                run = train_branch(recording, job, run, reporter.report, channel.stop)
    reporter.end()
    return run.status


def _parent_of(job: Job, recordings: Path) -> Run:
    """Return the run that a branch changes, which must still be there."""
    run_id = job.config.branches[-1].run
    parent = run_of_id(run_id, recordings)
    if parent is None:
        raise RunnerError(f"run {run_id}, the parent of this branch, is no longer there.")
    return at_hand(parent)


def _existing_run(folder: Path) -> Run | None:
    with contextlib.suppress(OSError):
        folder.rmdir()  # created by a worker that was killed before it wrote anything
    with contextlib.suppress(RunnerError):
        return run_at(folder) if folder.is_dir() else None
    return None


class Reporter:
    """Sends a run's progress, a few times a second, and each line of its log."""

    def __init__(self, channel: JobChannel, run_id: str, config: ExperimentConfig, seed: int) -> None:
        self._channel = channel
        self._run_id, self._seed, self._seeds = run_id, seed, config.seeds
        self._sent, self._logged = 0.0, 0
        self._progress: Progress | None = None
        channel.send(RunEvent(run_id, seed))

    def report(self, progress: Progress) -> None:
        """Accept the run's progress."""
        self._progress = progress
        if time.monotonic() - self._sent >= REPORT_SECONDS:
            self._sent = time.monotonic()
            self.end()

    def end(self) -> None:
        """Send what has not been sent yet."""
        if (progress := self._progress) is None:
            return
        for text in progress.log[self._logged :]:
            self._channel.send(LogEvent(text[:MAX_TEXT], self._run_id, self._seed))
        self._logged = len(progress.log)
        sent = RunProgress(
            run_id=self._run_id,
            seed=self._seed,
            run=self._seeds.index(self._seed) + 1,
            runs=len(self._seeds),
            episode=progress.episode,
            episodes=progress.episodes,
            train_steps=progress.train_steps,
            eval_steps=progress.eval_steps,
            bytes=progress.bytes_written,
            last_evaluation=evaluation_brief(progress.evaluations[-1]) if progress.evaluations else None,
        )
        self._channel.send(sent)


def run_seed_on_ray(spec: JobSpec, channel: JobChannel, config: ExperimentConfig, seed: int) -> str:
    """Run a seed in a Ray actor, and forward its messages; return the run's status.

    Raises:
        RunnerError: the cluster cannot be reached, the run fails, or the actor dies.
    """
    ray = connect(spec.ray)
    try:
        actor = start_actor(ray)
        result = actor.run.remote(_run_seed_in_actor, spec, config.to_mapping(), seed)
        is_over = False
        while not is_over:
            is_over = bool(ray.wait([result], timeout=REPORT_SECONDS)[0])
            for message in ray.get(actor.take_messages.remote()):
                channel.send(message)
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
    actor: RayActor, spec: JobSpec, values: dict[str, object], seed: int
) -> tuple[str, str]:
    """Run the seed; return the run's status, and the error message if it failed."""
    try:
        return run_seed(spec, actor, from_mapping(values), seed), ""
    except RunnerError as error:
        return "failed", str(error)
