"""One run of a sweep, as a worker runs it: started, resumed, or only read if it is over.

A worker may be killed at any moment, and its task is then run again. Therefore the sweep creates the folder
of a run before a worker starts it, and whatever a worker leaves there is continued.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

from runner.archive.places import at_hand
from runner.config import from_mapping
from runner.config.model import Job
from runner.environments.loading import load_once
from runner.environments.mdp import Mdp
from runner.errors import RecordingError, RunnerError
from runner.execution.resume import resume
from runner.execution.session import Progress, run_job
from runner.recording.labels import LABELS_FILE, Labels, change_labels
from runner.recording.marks import MARKS_FILE
from runner.recording.reader import open_recording
from runner.recording.run_file import owner
from runner.runs.resolve import find_run
from runner.runs.run import RUN_FILE, Run, locked, unless_empty
from runner.sweep.model import Objective
from runner.sweep.objective import Curve, curve_of, readings, should_prune
from runner.sweep.state import PRUNED, is_over
from runner.util.files import replacing, storage_errors
from runner.util.values import Json


@dataclass(frozen=True)
class Task:
    """A run of a sweep: a trial's configuration with a seed."""

    identity: str
    """The identity of its job."""
    seed: int
    config: Json
    trial: int
    """The number of the trial."""
    recordings: str
    objective: Objective
    bounds: Mapping[int, float] = field(default_factory=dict)
    """By episode, the bound below which the run is pruned."""
    run_id: str = ""
    """The run; empty until the sweep creates it, which is before a worker gets the task."""
    accept_changes: bool = False
    """Whether to resume a run that other code started."""
    on_own_disk: bool = False
    """Whether to record on the worker's own disk, and to move the run when it is complete."""
    threads: bool = True
    """Whether the worker has more than one processor, so that recording can run in parallel to learning."""

    def placed(self, threads: bool, on_own_disk: bool = False) -> Task:
        """Return the task for a worker; see `runner.sweep.workers.Work`."""
        return replace(self, threads=threads, on_own_disk=self.on_own_disk or on_own_disk)

    def run(self, stop: Callable[[], bool]) -> Result:
        """Run the task; errors that a user can fix become a failed result.

        `stop` is called every few milliseconds; once it returns True, the run is interrupted.
        """
        try:
            if self.on_own_disk:
                return _run_on_own_disk(self, stop)
            run = _run(self, stop)
            return result_of(run, self.objective) if is_over(run) else Result("interrupted", run.run_id)
        except RunnerError as error:
            exists = (Path(self.recordings) / self.run_id).is_dir()
            return Result("failed", self.run_id if exists else "", error=str(error))


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


def _run_on_own_disk(task: Task, stop: Callable[[], bool]) -> Result:
    """Run a task in a temporary folder of this machine; then move its files into the recordings."""
    target = Path(task.recordings) / task.run_id
    prefix = f"dualtaxi-sweep-{task.run_id}-"
    for left in Path(tempfile.gettempdir()).glob(f"{prefix}*"):  # by a worker that was killed
        shutil.rmtree(left, ignore_errors=True)
    with storage_errors(target), tempfile.TemporaryDirectory(prefix=prefix) as folder:
        working = Path(folder) / task.run_id
        shutil.copytree(target, working)
        result = replace(task, recordings=folder, on_own_disk=False).run(stop)
        if working.is_dir():
            move_files(working, target)
            if result.status == "pruned":
                _mark_pruned(target)
        else:  # nothing was recorded
            shutil.rmtree(target)
    return result


def move_files(source: Path, target: Path) -> None:
    """Replace the files of a run by those of a copy that was continued; labels and marks stay.

    Each file is replaced atomically, `run.json` last: a run that was moved in part is as good as one whose
    process was killed.
    """

    def names(folder: Path) -> set[str]:
        return {
            path.name
            for path in folder.iterdir()
            if path.name not in (LABELS_FILE, MARKS_FILE) and path.suffix != ".lock"
        }

    for name in sorted(names(source), key=lambda name: name == RUN_FILE):
        with replacing(target / name) as fresh:
            shutil.copyfile(source / name, fresh)
    for name in names(target) - names(
        source
    ):  # a replacement that is complete, or what a killed worker copied
        (target / name).unlink()


def result_of(run: Run, objective: Objective) -> Result:
    """Return the result of a finished or pruned run."""
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
    run = find_run(task.run_id, Path(task.recordings))
    if is_over(run):
        return run
    env = task.config["env"]
    mdp = load_once(env["id"], env["kwargs"], task.config["rewards"])
    pruner = _Pruner(task, mdp, stop)
    if run.recording.exists():
        run = resume(run, task.accept_changes, pruner.report, pruner.stop)
    else:
        job = Job(from_mapping(task.config), task.seed)
        with locked(run) as new, unless_empty(new):
            begun = new.update(status="running", owner=owner())
            run = run_job(job, begun, pruner.report, pruner.stop, mdp=mdp, threads=task.threads)
    if pruner.is_pruned and run.status != "finished":
        _mark_pruned(run.folder)
        return Run(run.folder, run.facts)  # with the new tag
    return run


def _mark_pruned(folder: Path) -> None:
    change_labels(folder, lambda now: Labels(now.name, (*now.tags, PRUNED), now.note))


class _Pruner:
    """Stops a run once it falls behind the bounds of its task."""

    def __init__(self, task: Task, mdp: Mdp, stop: Callable[[], bool]) -> None:
        self._task = task
        self._stop = stop
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
