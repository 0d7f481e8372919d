"""One run of a sweep: how a worker starts, resumes or only reads it, and what it is worth.

A worker may be killed at any moment, and its task is then run again. Therefore the sweep creates the folder
of a run before a worker starts it, and whatever a worker leaves there is continued.
"""

from __future__ import annotations

import itertools
import math
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np

from runner.analysis.axes import first_crossing, mean_height
from runner.analysis.evaluations import evaluation_record
from runner.analysis.series import (
    evaluation_readings,
    exact_readings,
    full_name,
    training_readings,
)
from runner.analysis.statistics import NEVER
from runner.archive.places import at_hand
from runner.config import from_mapping
from runner.config.model import Job
from runner.environments.loading import load_once
from runner.environments.mdp import Mdp
from runner.errors import RecordingError, RunnerError, nearest
from runner.execution.resume import resume
from runner.execution.session import Progress, run_job
from runner.recording import schema
from runner.recording.labels import LABELS_FILE, Labels, change_labels
from runner.recording.marks import MARKS_FILE
from runner.recording.messages import Message
from runner.recording.metrics import is_higher_better
from runner.recording.reader import Recording, open_recording
from runner.recording.run_file import owner
from runner.runs.resolve import find_run
from runner.runs.run import RUN_FILE, Run, locked, unless_empty
from runner.sweep.model import Objective
from runner.sweep.state import PRUNED, is_over
from runner.util.files import replacing, storage_errors
from runner.util.values import Json

Curve = dict[int, float]
"""Reading by training episode."""


# --- what it is worth ---------------------------------------------------------------------------------


def curve_of(recording: Recording, metric: str) -> Curve:
    """Return the finite readings of a metric at the evaluations of a recording."""
    agents = recording.agents
    events = recording.environment["event_names"]
    exact = {
        measures["evaluation"]: measures for measures in recording.table(schema.OPTIMALITY_TOPIC).decoded()
    }
    evaluations = [
        (metrics["episode"], readings(metrics, exact.get(metrics["evaluation"]), agents, events))
        for metrics in recording.eval.all_metrics()
    ]
    curve = {episode: read[metric] for episode, read in evaluations if metric in read}
    if not curve:
        raise never_recorded(metric, {name for _, read in evaluations for name in read})
    return {episode: reading for episode, reading in curve.items() if math.isfinite(reading)}


def readings(
    metrics: Message, exact: Message | None, agents: Sequence[str], events: Sequence[str]
) -> dict[str, float]:
    """Return the readings of an evaluation by name; `mean_return` without an agent if there is but one."""
    record = evaluation_record(metrics, agents, events)
    by_metric = evaluation_readings(record)
    if record.training:
        by_metric |= training_readings(record.training)
    if exact is not None:
        by_metric |= exact_readings(exact, agents)
    flat = {
        full_name(metric, line): value for metric, lines in by_metric.items() for line, value in lines.items()
    }
    alone = {metric: next(iter(lines.values())) for metric, lines in by_metric.items() if len(lines) == 1}
    return flat | alone


def never_recorded(metric: str, known: set[str]) -> RunnerError:
    """Return the error of an objective that no evaluation has."""
    if not known:
        return RunnerError(
            f"objective.metric: found {metric!r}, which was never recorded: there are no evaluations. "
            "Set `evaluation` in the base."
        )
    hint = nearest(metric, known)
    if metric.startswith("exact.") and not any(name.startswith("exact.") for name in known):
        hint = " Set `evaluation: {exact: true}` in the base for exact measures."
    listed = ", ".join(sorted(name for name in known if not name.startswith("training.reward.")))
    return RunnerError(
        f"objective.metric: found {metric!r}, which was never recorded, expected one of {listed}.{hint}"
    )


def value_of(objective: Objective, curve: Curve) -> float:
    """Return the value of a run; NEVER for a level that is not reached; NaN without a reading."""
    if not curve:
        return math.nan
    episodes = sorted(curve)
    values = [curve[episode] for episode in episodes]
    match objective.at:
        case "last":
            return values[-1]
        case "best":
            return objective.sign * max(objective.sign * value for value in values)
        case "area":
            if len(values) == 1:
                return values[0]
            return mean_height(episodes, values)
        case "first_over":
            assert objective.level is not None
            rising = is_higher_better(objective.metric, has_goal=True)
            at = first_crossing(curve, objective.level, rising)
            return NEVER if at is None else float(at)


def pruning_bounds(objective: Objective, curves: Sequence[Curve], percentile: float) -> Curve:
    """Return by episode the bound that the best reading of a run so far must reach.

    A run may be worse than a `percentile` of the finished trials, whose readings the curves are.
    """
    bests: dict[int, list[float]] = {}
    for curve in curves:
        episodes = sorted(curve)
        best = itertools.accumulate((objective.sign * curve[episode] for episode in episodes), max)
        for episode, value in zip(episodes, best, strict=True):
            bests.setdefault(episode, []).append(value)
    return {
        episode: objective.sign * float(np.percentile(values, 100 - percentile))
        for episode, values in sorted(bests.items())
    }


def should_prune(objective: Objective, curve: Curve, bounds: Mapping[int, float]) -> bool:
    """Return whether the best reading so far is worse than the bound at the last episode that has one."""
    passed = [episode for episode in bounds if curve and episode <= max(curve)]
    if not passed:
        return False
    at = max(passed)
    best = max((objective.sign * value for episode, value in curve.items() if episode <= at), default=-np.inf)
    return bool(best < objective.sign * bounds[at])


# --- running it ---------------------------------------------------------------------------------------


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
