"""Doing a job: a configuration seed by seed, a branch, a sweep or an explanation; its process."""

from __future__ import annotations

import contextlib
import signal
import threading
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

from runner.client.jobs import EventData, LogEvent, RunEvent, RunProgress, StateEvent
from runner.config import ExperimentConfig, from_mapping
from runner.config.job import Job
from runner.errors import RunnerError, full_message
from runner.execution.branching import train_branch
from runner.execution.resume import resume
from runner.execution.session import Progress, Report, evaluation_brief, run_job
from runner.recording.reader import open_recording
from runner.runs.listing import run_at
from runner.runs.run import Run, create_run
from runner.service.jobs.branches import parent_in, run_episode_job
from runner.service.jobs.channel import JobChannel, JobSpec, wait_for_owners
from runner.service.jobs.cluster import do_on_cluster
from runner.service.jobs.explanations import run_explain_job
from runner.service.jobs.sweeps import run_sweep_job
from runner.service.processes import lower_priority
from runner.service.settings import without_folders
from runner.util.compilation import MESSAGE, announced
from runner.util.values import as_utf8

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
            _DOING.get(spec.job.kind, run_config_job)(spec, channel)
        return StateEvent("finished")
    except (RunnerError, OSError, KeyboardInterrupt) as error:
        if channel.stop():  # whatever else was the matter, the next worker meets it again
            return StateEvent("interrupted")
        return StateEvent("failed", as_utf8(without_folders(full_message(error), spec.recordings)))


_DOING: Final = {"sweep": run_sweep_job, "explain": run_explain_job, "episode": run_episode_job}


def run_config_job(spec: JobSpec, channel: JobChannel) -> None:
    """Run what is left of a configuration's seeds, one after the other."""
    config = from_mapping(spec.values())
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
