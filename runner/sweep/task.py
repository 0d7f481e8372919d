"""One run of a sweep, as a worker runs it: started, resumed, or only read if it is over."""

from __future__ import annotations

import json
import secrets
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from runner.archive.places import at_hand
from runner.config import from_mapping
from runner.config.job import Job
from runner.environments.loading import load_mdp
from runner.environments.mdp import Mdp
from runner.errors import RecordingError, RunnerError
from runner.execution.resume import resume
from runner.execution.session import Progress, run_job
from runner.recording.labels import Labels, change_labels
from runner.recording.reader import open_recording
from runner.runs.resolve import find_run
from runner.runs.run import Run, create_run, list_runs, unless_empty
from runner.sweep.model import Objective
from runner.sweep.objective import Curve, curve_of, readings, should_prune
from runner.sweep.state import PRUNED, is_over
from runner.util.files import storage_errors


@dataclass(frozen=True)
class Task:
    """A run of a sweep: a trial's configuration with a seed."""

    identity: str
    """The identity of its job."""
    seed: int
    config: dict[str, Any]
    name: str
    tags: tuple[str, ...]
    recordings: str
    objective: Objective
    bounds: Mapping[int, float] = field(default_factory=dict)
    """By episode, the bound below which the run is pruned."""
    run_id: str = ""
    """The existing run to resume; empty to start a new one."""
    accept_changes: bool = False
    """Whether to resume a run that other code started."""
    on_own_disk: bool = False
    """Whether to record on the worker's own disk, and to move the run when it is complete."""
    threads: bool = True
    """Whether the worker has more than one processor, so that recording can run in parallel to learning."""


@dataclass(frozen=True)
class Result:
    """The result of a task."""

    status: Literal["finished", "pruned", "interrupted", "failed"]
    run_id: str = ""
    curve: Curve = field(default_factory=dict)
    digest: str = ""
    bytes: int = 0
    seconds: float = 0.0
    """The time that learning and recording took, also of a run that was only read."""
    error: str = ""


def run_task(task: Task, stop: Callable[[], bool]) -> Result:
    """Run a task; errors that a user can fix become a failed result.

    Args:
        task: the run.
        stop: called every few milliseconds; once it returns True, the run is interrupted.
    """
    try:
        if task.on_own_disk:
            return _run_on_own_disk(task, stop)
        run = _run(task, stop)
        return result_of(run, task.objective) if is_over(run) else Result("interrupted", run.run_id)
    except RunnerError as error:
        return Result("failed", task.run_id, error=str(error))


def _run_on_own_disk(task: Task, stop: Callable[[], bool]) -> Result:
    """Run a task in a temporary folder of this machine; then move its run into the recordings."""
    recordings = Path(task.recordings)
    with storage_errors(recordings), tempfile.TemporaryDirectory(prefix="dualtaxi-sweep-") as folder:
        own = Path(folder)
        if task.run_id:
            shutil.copytree(recordings / task.run_id, own / task.run_id)
        result = run_task(replace(task, recordings=folder, on_own_disk=False), stop)
        for run in list_runs(own):
            move_whole(run.folder, recordings)
    return result


def move_whole(run: Path, recordings: Path) -> None:
    """Copy a run's folder into the recordings, where it replaces an older copy at once.

    Raises:
        OSError: it cannot be copied; the older copy stays.
    """
    target, suffix = recordings / run.name, secrets.token_hex(4)
    fresh, old = (recordings / f".{run.name}.{suffix}.{kind}" for kind in ("fresh", "old"))
    try:
        shutil.copytree(run, fresh)
        if target.exists():
            target.rename(old)
        try:
            fresh.rename(target)
        except OSError:
            if old.exists():
                old.rename(target)
            raise
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)


def result_of(run: Run, objective: Objective) -> Result:
    """Return the result of a finished or pruned run.

    Raises:
        RunnerError: its recording cannot be read, or the objective was never recorded.
    """
    path = at_hand(run).recording
    try:
        stat = path.stat()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error
    return Result(
        "pruned" if PRUNED in run.tags else "finished",
        run.run_id,
        dict(_curve_of(path, stat.st_size, stat.st_mtime_ns, objective.metric)),
        run.summary.content_digest or "",
        stat.st_size,
        run.summary.seconds or 0.0,
    )


@lru_cache(maxsize=4096)
def _curve_of(path: Path, size: int, modified: int, metric: str) -> Curve:  # noqa: ARG001
    """Return the readings of a recording; its size and time are in the key of the cache."""
    with open_recording(path) as recording:
        return curve_of(recording, metric)


def _run(task: Task, stop: Callable[[], bool]) -> Run:
    recordings = Path(task.recordings)
    run = find_run(task.run_id, recordings) if task.run_id else None
    if run is not None and is_over(run):
        return run
    env = task.config["env"]
    mdp = _load_mdp(env["id"], json.dumps(env["kwargs"], sort_keys=True), task.config["rewards"])
    pruner = _Pruner(task, mdp, stop)
    if run is not None:
        run = resume(run, task.accept_changes, pruner.report, pruner.stop)
    else:
        job = Job(from_mapping(task.config), task.seed)
        run = create_run(recordings, job.config, task.seed, task.name)
        with unless_empty(run):
            change_labels(run.folder, lambda _: Labels(tags=tuple(sorted(task.tags))))
            run = run_job(job, run, pruner.report, pruner.stop, mdp=mdp, threads=task.threads)
    if pruner.is_pruned and run.status != "finished":
        change_labels(run.folder, lambda now: Labels(now.name, (*now.tags, PRUNED), now.note))
        return Run(run.folder, run.facts)
    return run


@lru_cache(maxsize=4)
def _load_mdp(env_id: str, kwargs: str, rewards: str) -> Mdp:
    """Return an environment, which a worker loads once."""
    return load_mdp(env_id, json.loads(kwargs), rewards)


class _Pruner:
    """Stops a run once it falls behind the bounds of its task."""

    def __init__(self, task: Task, mdp: Mdp, stop: Callable[[], bool]) -> None:
        self._task, self._stop = task, stop
        joint = task.config["tables"] == "joint" and len(mdp.agents) > 1
        self._agents = ("agency",) if joint else mdp.agents
        self._events = mdp.event_names
        self._curve: Curve = {}
        self._evaluations_read = 0
        self.is_pruned = False

    def report(self, progress: Progress) -> None:
        """Compare the new evaluations with the bounds; an observer for `run_job`."""
        if not self._task.bounds:
            return
        objective = self._task.objective
        for metrics in progress.evaluations[self._evaluations_read :]:
            read = readings(metrics, metrics.get("optimality"), self._agents, self._events)
            if objective.metric in read:
                self._curve[metrics["episode"]] = read[objective.metric]
        self._evaluations_read = len(progress.evaluations)
        is_done = progress.episode >= progress.episodes
        self.is_pruned = not is_done and should_prune(objective, self._curve, self._task.bounds)

    def stop(self) -> bool:
        """Return whether the run must stop."""
        return self.is_pruned or self._stop()
