"""One run of a sweep, as a worker does it: begun, gone on with, or only read when it is finished."""

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
from runner.sweep.readings import Curve, curve_of, readings, should_prune
from runner.sweep.state import PRUNED, is_over


@dataclass(frozen=True)
class Task:
    """A run that is wanted: a trial's configuration with a seed."""

    identity: str
    """Of its job."""
    seed: int
    config: dict[str, Any]
    name: str
    tags: tuple[str, ...]
    recordings: str
    objective: Objective
    bounds: Mapping[int, float] = field(default_factory=dict)
    """By episode what a run must reach, or be given up."""
    run_id: str = ""
    """The run that there is already; empty if it is to be begun."""
    accept_changes: bool = False
    """Whether to go on with a run that other code began."""
    elsewhere: bool = False
    """Whether to record on the worker's own disk, and to move the run when it is whole."""
    threads: bool = True
    """Whether the worker has more than one processor, so that recording may go on beside learning."""


@dataclass(frozen=True)
class Result:
    """What came of a task."""

    status: Literal["finished", "pruned", "interrupted", "failed"]
    run_id: str = ""
    curve: Curve = field(default_factory=dict)
    digest: str = ""
    bytes: int = 0
    seconds: float = 0.0
    """What learning and recording took; of a run that was only read, when it was made."""
    error: str = ""


def do(task: Task, stop: Callable[[], bool]) -> Result:
    """Do a task; what a user can mend comes back as a failed result.

    Args:
        task: what to do.
        stop: asked every few milliseconds whether to stop; the run is then interrupted, its recording kept.
    """
    if task.elsewhere:
        return _do_elsewhere(task, stop)
    try:
        run = _run(task, stop)
        return result_of(run, task.objective) if is_over(run) else Result("interrupted", run.run_id)
    except RunnerError as error:
        return Result("failed", task.run_id, error=str(error))


def _do_elsewhere(task: Task, stop: Callable[[], bool]) -> Result:
    """Do a task in a folder of this machine's own; then move what was recorded where it belongs."""
    recordings = Path(task.recordings)
    try:
        with tempfile.TemporaryDirectory(prefix="dualtaxi-sweep-") as folder:
            own = Path(folder)
            if task.run_id:
                shutil.copytree(recordings / task.run_id, own / task.run_id)
            result = do(replace(task, recordings=folder, elsewhere=False), stop)
            for run in list_runs(own):
                move_whole(run.folder, recordings)
    except OSError as error:
        return Result(
            "failed", task.run_id, error=f"{recordings}: cannot be written ({error.strerror or error})."
        )
    return result


def move_whole(run: Path, recordings: Path) -> None:
    """Put a run's folder among the recordings, in the place of the same one if it is there.

    Raises:
        OSError: that cannot be; the one that was there stays.
    """
    place, mark = recordings / run.name, secrets.token_hex(4)
    fresh, old = (recordings / f".{run.name}.{mark}.{kind}" for kind in ("fresh", "old"))
    try:
        shutil.copytree(run, fresh)
        if place.exists():
            place.rename(old)
        try:
            fresh.rename(place)
        except OSError:
            if old.exists():
                old.rename(place)
            raise
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)


def result_of(run: Run, objective: Objective) -> Result:
    """Return what came of a run that is finished, or was given up.

    Raises:
        RunnerError: its recording cannot be read, or the objective was never recorded.
    """
    path = at_hand(run).recording
    try:
        facts = path.stat()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error
    curve = dict(_curve_of(path, facts.st_size, facts.st_mtime_ns, objective.metric))
    return Result(
        "pruned" if PRUNED in run.tags else "finished",
        run.run_id,
        curve,
        run.summary.content_digest or "",
        facts.st_size,
        run.summary.seconds or 0.0,
    )


@lru_cache(maxsize=4096)
def _curve_of(path: Path, size: int, modified: int, metric: str) -> Curve:  # noqa: ARG001
    """Return the readings of a recording; size and time tell its states apart."""
    with open_recording(path) as recording:
        return curve_of(recording, metric)


def _run(task: Task, stop: Callable[[], bool]) -> Run:
    if task.run_id:
        run = find_run(task.run_id, Path(task.recordings))
        if is_over(run):
            return run
        watch = _Pruning(task, _mdp_of(task), stop)
        return watch.labelled(resume(run, task.accept_changes, watch.report, watch.stop))
    job = Job(from_mapping(task.config), task.seed)
    mdp = _mdp_of(task)
    watch = _Pruning(task, mdp, stop)
    run = create_run(Path(task.recordings), job.config, task.seed, task.name)
    with unless_empty(run):
        change_labels(run.folder, lambda _: Labels(tags=tuple(sorted(task.tags))))
        return watch.labelled(run_job(job, run, watch.report, watch.stop, mdp=mdp, threads=task.threads))


class _Pruning:
    """Gives a run up when it is hopeless."""

    def __init__(self, task: Task, mdp: Mdp, stop: Callable[[], bool]) -> None:
        self._task = task
        self._stop = stop
        joint = task.config["tables"] == "joint" and len(mdp.agents) > 1
        self._agents = ("agency",) if joint else mdp.agents
        self._events = mdp.event_names
        self._curve: Curve = {}
        self._seen = 0
        self._is_pruned = False

    def report(self, progress: Progress) -> None:
        """Look at the evaluations that are new."""
        if not self._task.bounds:
            return
        for metrics in progress.evaluations[self._seen :]:
            read = readings(metrics, metrics.get("optimality"), self._agents, self._events)
            if self._task.objective.metric in read:
                self._curve[metrics["episode"]] = read[self._task.objective.metric]
        self._seen = len(progress.evaluations)
        done = progress.episode >= progress.episodes
        self._is_pruned = not done and should_prune(self._task.objective, self._curve, self._task.bounds)

    def stop(self) -> bool:
        """Return whether the run is to stop."""
        return self._is_pruned or self._stop()

    def labelled(self, run: Run) -> Run:
        """Return a run, tagged if it was given up."""
        if not self._is_pruned or run.status == "finished":
            return run
        change_labels(run.folder, lambda said: Labels(said.name, (*said.tags, PRUNED), said.note))
        return Run(run.folder, run.facts)


def _mdp_of(task: Task) -> Mdp:
    env = task.config["env"]
    return _mdp(env["id"], json.dumps(env["kwargs"], sort_keys=True), task.config["rewards"])


@lru_cache(maxsize=4)
def _mdp(env_id: str, kwargs: str, rewards: str) -> Mdp:
    """Return an environment; a worker loads it once."""
    return load_mdp(env_id, json.loads(kwargs), rewards)
