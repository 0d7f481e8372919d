"""Training mixtures of two configurations on the workers of sweeps, without recording them.

A run is trained up to its end and evaluated there once, in the trials of the evaluation that a recorded run
has at that episode: its readings are those of the recorded run. What was measured is kept in a file, by the
identity of its job, and never measured again.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Final, Self

import numpy as np
from blake3 import blake3
from pydantic import FiniteFloat, TypeAdapter, ValidationError

from runner.config import ExperimentConfig, from_mapping
from runner.config.model import identity_of
from runner.debugging.factors import Mixing
from runner.environments.loading import load_once
from runner.environments.mdp import Mdp
from runner.errors import RunnerError
from runner.execution.session import configured_tables, evaluation_metrics
from runner.learning.learner import Learner
from runner.planning.evaluation import ExactEvaluator
from runner.recording import schema
from runner.recording.layout import blank_records, layout_of
from runner.sweep.objective import readings
from runner.sweep.workers import Workers
from runner.util import __version__
from runner.util.arrays import Floats
from runner.util.files import storage_errors
from runner.util.processes import Stop
from runner.util.values import Json, finite

VALUES: Final = "values.jsonl"
MAX_LINE: Final = 1 << 20
MAX_BYTES: Final = 1 << 30
"""Bytes of a file of values that are read."""
TASK_SECONDS: Final = 0.4
"""The time that a task should take: seeds are trained in batches, so that handing them over costs little."""
_BLOCK_STEPS: Final = 4096
_WAIT_SECONDS: Final = 0.2

Readings = Mapping[str, float | None]
"""The metrics of an evaluation by name; None for one that is not finite."""


@dataclass(frozen=True)
class MixtureResult:
    """The result of a task."""

    readings: Mapping[int, Readings] = field(default_factory=dict)
    """By seed; seeds that were not finished are missing."""
    seconds: float = 0.0
    """The time that the last of them took."""
    error: str = ""


@dataclass(frozen=True)
class Measurement:
    """A task: train a configuration with some seeds to its end, and evaluate there."""

    mixture: int
    config: Json
    seeds: tuple[int, ...]
    recordings: str

    def placed(self, threads: bool, on_own_disk: bool = False) -> Self:  # noqa: ARG002
        """Return the task: it runs in one thread, and writes nothing."""
        return self

    def run(self, stop: Stop) -> MixtureResult:
        """Return what was measured; errors that a user can fix become a result."""
        by_seed: dict[int, Readings] = {}
        seconds = 0.0
        try:
            config = from_mapping(self.config)
            for seed in self.seeds:
                began = time.perf_counter()
                measured = measure(config, seed, Path(self.recordings), stop)
                if measured is None:
                    break
                by_seed[seed] = measured
                seconds = time.perf_counter() - began
        except RunnerError as error:
            return MixtureResult(by_seed, seconds, str(error))
        return MixtureResult(by_seed, seconds)


def measure(
    config: ExperimentConfig, seed: int, recordings: Path, stop: Stop = lambda: False
) -> Readings | None:
    """Train an experiment with a seed to its end, in memory, and return the readings there; None if stopped.

    The experiment has an evaluation; the run with its initial tables is looked for in the recordings folder.
    """
    plan = config.evaluation
    assert plan is not None
    mdp = load_once(config.env.id, config.env.kwargs, config.rewards)
    learner = Learner(config, mdp, seed, configured_tables(config, mdp, recordings))
    layout = layout_of("job", len(learner.agents), len(mdp.event_names))
    steps, episodes = (
        blank_records(topic, layout.message(topic), _BLOCK_STEPS)
        for topic in (schema.TRAIN_STEP, schema.TRAIN_EPISODE)
    )
    while learner.episode < config.episodes:
        if stop():
            return None
        learner.train(steps, episodes, config.episodes, 2**62)
    number = -(-config.episodes // plan.every)
    first = number * plan.trials
    learner.begin_evaluation(first)
    done = first
    trials = []
    while done < first + plan.trials:
        if stop():
            return None
        _, ended = learner.evaluate(steps, episodes, first + plan.trials)
        trials.append(episodes[:ended].copy())
        done += ended
    metrics = evaluation_metrics(learner, number, np.concatenate(trials))
    exact = None
    if plan.exact:
        exact = ExactEvaluator(mdp, len(learner.agents)).measure(learner.policy, metrics["discount"])
        exact |= {"evaluation": number, "episode": config.episodes}
    read: Readings = finite(readings(metrics, exact, learner.agents, mdp.event_names))
    return read


@lru_cache(maxsize=16)
def _environment_digest(mdp: Mdp) -> str:
    """Return the digest of an environment's arrays, which its code determines."""
    digest = blake3()
    for name, array in sorted(mdp.arrays().items()):
        digest.update(name.encode() + array.tobytes())
    return digest.hexdigest()[:16]


class Mixtures:
    """The readings of mixtures, measured by workers when they are needed, and kept in a folder.

    `report` is called several times a second with the number of runs done, and of those known to be needed.
    """

    def __init__(
        self,
        mixing: Mixing,
        seeds: Sequence[int],
        recordings: Path,
        folder: Path,
        workers: Workers[Measurement, MixtureResult],
        report: Callable[[int, int], None],
    ) -> None:
        self.mixing = mixing
        self.seeds = tuple(seeds)
        self.workers = workers
        self._recordings = recordings
        self._path = folder / VALUES
        self._report = report
        self._kept = {known.job: known for known in _kept(self._path)}
        self.in_file = sum(earlier.seed in self.seeds for earlier in self._kept.values())
        """Runs in the file that have one of the seeds, of whatever mixtures."""
        self._jobs: dict[int, list[str]] = {}
        """Mixture to the identities of its runs, by the order of the seeds."""
        self.trained = 0
        """Runs that were trained now, not read from the file."""

    @property
    def seconds(self) -> float:
        """The time that a run takes of a processor, on average; 0 if none was trained."""
        jobs = (job for jobs in self._jobs.values() for job in jobs)
        times = [self._kept[job].seconds for job in jobs if job in self._kept]
        return sum(times) / max(1, len(times))

    def complete(self) -> list[int]:
        """Return the mixtures of which all seeds were measured."""
        return [mixture for mixture in self._jobs if len(self.readings(mixture)) == len(self.seeds)]

    def known(self, mixtures: Sequence[int]) -> int:
        """Return the number of runs of mixtures that need not be trained."""
        return sum(len(self.readings(mixture)) for mixture in mixtures)

    def readings(self, mixture: int) -> list[Readings]:
        """Return the readings of a mixture that were measured, by the order of the seeds."""
        return [self._kept[job].readings for job in self._jobs_of(mixture) if job in self._kept]

    def _jobs_of(self, mixture: int) -> list[str]:
        """Return what determines the readings of each run: its job, and the code of its environment."""
        if mixture not in self._jobs:
            config = self.mixing.config(mixture)
            environment = _environment_digest(load_once(config.env.id, config.env.kwargs, config.rewards))
            values = config.to_mapping()
            self._jobs[mixture] = [
                f"{identity_of(values, seed)}-{environment}-{__version__}" for seed in self.seeds
            ]
        return self._jobs[mixture]

    def values(self, mixtures: Sequence[int], metric: str) -> Floats:
        """Return the values of a metric in mixtures, [mixtures, seeds].

        Raises:
            RunnerError: a mixture does not have it, or not as a finite number.
        """
        rows = []
        for mixture in mixtures:
            row = [read.get(metric) for read in self.readings(mixture)]
            if None in row:
                raise RunnerError(
                    f"metric: {metric!r} has no finite value in {self.mixing.in_words(mixture)}. Choose a "
                    "metric that every mixture has, such as success_percent."
                )
            rows.append(row)
        return np.array(rows, np.float64)

    def measure(self, mixtures: Sequence[int], seeds: int | None = None) -> None:
        """Measure mixtures with all seeds, or the first `seeds`, if they are not known yet."""
        waiting = deque(self._tasks(mixtures, self.seeds[:seeds]))
        left = sum(len(task.seeds) for task in waiting)
        busy = 0
        died = list[Measurement]()
        while waiting or busy:
            while waiting and self.workers.idle:
                self.workers.submit(waiting.popleft())
                busy += 1
            self._report(self.trained, self.trained + left)
            for task, result in self.workers.collect(_WAIT_SECONDS):
                busy -= 1
                if result is None and task not in died:
                    died.append(task)
                    waiting.append(task)
                    continue
                if result is None or result.error:
                    reason = "its worker died twice" if result is None else result.error
                    raise RunnerError(f"{self.mixing.in_words(task.mixture)}: {reason}")
                left -= len(result.readings)
                self.trained += len(result.readings)
                self._keep(task, result)
        self._report(self.trained, self.trained)

    def _tasks(self, mixtures: Sequence[int], seeds: Sequence[int]) -> Iterator[Measurement]:
        """Yield tasks for what is not known."""
        batch = max(1, round(TASK_SECONDS / self.seconds)) if self.seconds else len(seeds)
        for mixture in mixtures:
            missing = [
                seed
                for seed, job in zip(seeds, self._jobs_of(mixture), strict=False)
                if job not in self._kept
            ]
            config = self.mixing.config(mixture).to_mapping() if missing else {}
            for start in range(0, len(missing), batch):
                some = tuple(missing[start : start + batch])
                yield Measurement(mixture, config, some, str(self._recordings))

    def _keep(self, task: Measurement, measured: MixtureResult) -> None:
        """Append readings to the file: a line each, with the identity of the job."""
        jobs = dict(zip(self.seeds, self._jobs_of(task.mixture), strict=True))
        lines = []
        for seed, read in measured.readings.items():
            known = self._kept[jobs[seed]] = _Known(jobs[seed], dict(read), measured.seconds, seed)
            lines.append(_LINES.dump_json(known).decode() + "\n")
        with storage_errors(self._path), self._path.open("a", encoding="utf-8") as file:
            file.writelines(lines)


@dataclass(frozen=True)
class _Known:
    """A run in the file of values."""

    job: str
    readings: dict[str, FiniteFloat | None]
    seconds: FiniteFloat
    seed: object = None


_LINES: Final = TypeAdapter(_Known)


def _kept(path: Path) -> Iterator[_Known]:
    """Yield what a file has of each run, without damaged lines."""
    try:
        with path.open("rb") as file:
            while file.tell() < MAX_BYTES and (line := file.readline(MAX_LINE)):
                with contextlib.suppress(ValidationError):
                    yield _LINES.validate_json(line)
    except OSError:
        return
