"""Mixtures of two configurations: the settings in which they differ, and mixtures trained without recording.

Mixtures are trained on the workers of sweeps. A run is trained up to its end and evaluated there once, in the
trials of the evaluation that a recorded run has at that episode: its readings are those of the recorded run.
What was measured is kept in a file, by the identity of its job, and never measured again.
"""

from __future__ import annotations

import contextlib
import copy
import itertools
import json
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Final, Self

import numpy as np
from blake3 import blake3
from pydantic import FiniteFloat, TypeAdapter, ValidationError

from runner.config import ConfigError, ExperimentConfig, from_mapping
from runner.config.model import LEARNERS, SECTION_OF, identity_of
from runner.environments.loading import load_mdp, load_once
from runner.environments.mdp import Mdp
from runner.errors import EnvironmentNotUsable, RunnerError
from runner.execution.session import configured_tables, evaluation_metrics
from runner.learning.learner import Learner
from runner.planning.exact import ExactEvaluator
from runner.recording import schema
from runner.recording.layout import blank_records, layout_of
from runner.runs.branches import training_branches
from runner.sweep.task import readings
from runner.sweep.workers import Workers
from runner.util import __version__
from runner.util.arrays import Floats
from runner.util.differences import Change
from runner.util.files import storage_errors
from runner.util.humanize import listed, setting
from runner.util.processes import Stop
from runner.util.values import Json, JsonView, finite

MAX_ALL: Final = 8
"""The most settings of which all mixtures are run."""
_MAX_SETTINGS: Final = 12
"""The most settings that are explained."""
_MEASURING: Final = ("evaluation", "log", "snapshots", "recording")
"""Sections that change what is measured and recorded, and not what is learned."""
_MIXED_INSIDE: Final = ("env", "env.kwargs", "quirks", *SECTION_OF)
"""Sections whose settings can differ one by one; the others are one setting each."""
_VALUES: Final = "values.jsonl"
_MAX_LINE: Final = 1 << 20
_MAX_BYTES: Final = 1 << 30
"""The most bytes of a file of values that are read."""
_TASK_SECONDS: Final = 0.4
"""The time that a task should take: seeds are trained in batches, so that handing them over costs little."""
_BLOCK_STEPS: Final = 4096
_WAIT_SECONDS: Final = 0.2
Readings = Mapping[str, float | None]
"""The metrics of an evaluation by name; None for one that is not finite."""


# --- settings that differ -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Factor:
    """One setting that differs, or several that only make sense together."""

    name: str
    changes: tuple[Change, ...]
    """The values in A and B by path; None for a section that one of them does not have."""

    @property
    def a(self) -> str:
        """Its value in A as text."""
        return self._values("a")

    @property
    def b(self) -> str:
        """Its value in B as text."""
        return self._values("b")

    def _values(self, side: str) -> str:
        values = {change.path: getattr(change, side) for change in self.changes}
        learners = (values.get("tables"), values.get("rewards"))
        modes = [mode for mode, means in LEARNERS.items() if means == learners]
        if modes:
            del values["tables"], values["rewards"]
        texts = (_branches(value) if path == "branches" else setting(value) for path, value in values.items())
        return ", ".join([*modes, *texts])


@dataclass(frozen=True)
class Mixing:
    """Two configurations, and the settings in which they differ."""

    a: ExperimentConfig
    b: ExperimentConfig
    """The second, with the sections of A that only measure and record."""
    factors: tuple[Factor, ...]
    notes: tuple[str, ...]
    """Which settings are not mixed, and which are only mixed together."""

    @property
    def everything(self) -> int:
        """The number of the mixture that is B."""
        return (1 << len(self.factors)) - 1

    def config(self, mixture: int) -> ExperimentConfig:
        """Return the configuration of a mixture: the values of B where its bits are 1, else those of A."""
        paths = [change.path for factor in self.chosen(mixture) for change in factor.changes]
        return from_mapping(_mixed(self.a.to_mapping(), self.b.to_mapping(), paths))

    def chosen(self, mixture: int) -> list[Factor]:
        """Return the settings that have the values of B in a mixture."""
        return [factor for i, factor in enumerate(self.factors) if mixture >> i & 1]

    def in_words(self, mixture: int) -> str:
        """Describe a mixture, for errors."""
        names = ", ".join(factor.name for factor in self.chosen(mixture)) or "none"
        return f"the mixture with these settings of B: {names}"


def mix(a: ExperimentConfig, b: ExperimentConfig, at: int | None = None, exact: bool = False) -> Mixing:
    """Return the settings in which two experiments differ, grouped so that they can be mixed.

    The experiments are compared after `at` training episodes, by default at the end of each; `exact` asks for
    exact measures in evaluations.

    Raises:
        RunnerError: they differ in no setting, in too many, or in settings that cannot be mixed; or one of
            them trains fewer episodes than `at`.
    """
    for name, config in (("A", a), ("B", b)):
        if at is not None and at > config.episodes:
            raise RunnerError(
                f"at: found {at:,}, but {name} trains {config.episodes:,} episodes: choose an episode that "
                "both reach."
            )
    ours, theirs = a.to_mapping(), b.to_mapping()
    notes: list[str] = []
    measuring = [key for key in _MEASURING if ours[key] != theirs[key]]
    if measuring:
        notes.append(f"{listed(measuring)} only measure and record: those of A are used in all mixtures")
    if ours["evaluation"] is None:
        ours["evaluation"] = theirs["evaluation"] or {"every": 1000, "trials": 200}
        notes.append("A has no evaluation: that of B is used, or else one of 200 trials")
    ours["evaluation"] |= {"exact": True} if exact else {}
    shared = {key: ours[key] for key in (*_MEASURING, "name", "seeds")}
    shared |= {"episodes": at} if at is not None else {}
    a, b = (from_mapping(values | shared) for values in (ours, theirs))
    factors = [Factor(change.path, (change,)) for change in _changes(a.to_mapping(), b.to_mapping())]
    if not factors:
        same = f" ({'; '.join(notes)})" if notes else ""
        raise RunnerError(
            f"A and B differ in no setting that changes what is learned{same}: there is nothing to explain. "
            "`dualtaxi diff` compares two runs in everything else."
        )
    mixing = _grouped(Mixing(a, b, tuple(factors), tuple(notes)))
    if len(mixing.factors) > _MAX_SETTINGS:
        names = ", ".join(factor.name for factor in mixing.factors)
        raise RunnerError(
            f"A and B differ in {len(mixing.factors)} settings, expected at most {_MAX_SETTINGS}: {names}. "
            "Explain in two steps, by a configuration that has some of the settings of each."
        )
    return mixing


def _changes(a: JsonView, b: JsonView, prefix: str = "") -> Iterator[Change]:
    """Yield the settings that differ; sections in which values can be mixed one by one are entered."""
    for key in dict.fromkeys([*a, *b]):
        path = f"{prefix}{key}"
        left = a.get(key)
        right = b.get(key)
        if left == right:
            continue
        if (
            path in _MIXED_INSIDE
            and isinstance(left, Mapping)
            and isinstance(right, Mapping)
            and not (path == "env" and left["id"] != right["id"])
        ):
            yield from _changes(left, right, f"{path}.")
        else:
            yield Change(path, left, right)


def _mixed(a: Json, b: JsonView, paths: Sequence[str]) -> Json:
    """Return the values of A with those of B at some paths; a key that B does not have is removed."""
    mixed = copy.deepcopy(a)
    for path in paths:
        *sections, key = path.split(".") if path.count(".") < 2 else path.split(".", 2)
        here, there = mixed, b
        for section in sections:
            here, there = here[section], there[section]
        if key in there:
            here[key] = there[key]
        else:
            here.pop(key, None)
    return mixed


def _grouped(mixing: Mixing) -> Mixing:
    """Return the mixing with settings merged until each of its mixtures is valid."""
    notes = list(mixing.notes)
    for mixture in (0, mixing.everything):
        if problem := _problem(mixing, mixture):
            raise problem
    while len(mixing.factors) > 1:
        count = len(mixing.factors)
        checked = range(2**count) if count <= _MAX_SETTINGS else _outer(count)
        wrong = next((mixture for mixture in checked if _problem(mixing, mixture)), None)
        if wrong is None:
            break
        i, j = _conflict(mixing, wrong)
        first, second = (mixing.factors[k] for k in sorted((i, j)))
        changes = first.changes + second.changes
        name = f"{first.name} + {second.name}"
        merged = Factor("mode" if name == "tables + rewards" else name, changes)
        reason = str(_problem(mixing, wrong)).splitlines()[-1]
        notes.append(f"{first.name} and {second.name} only go together, and count as one setting ({reason})")
        rest = [factor for factor in mixing.factors if factor not in (first, second)]
        mixing = Mixing(mixing.a, mixing.b, (merged, *rest), tuple(notes))
    return mixing


def _conflict(mixing: Mixing, wrong: int) -> tuple[int, int]:
    """Return two settings to merge: one of B and one of A, without either of which a mixture is valid."""
    numbers = range(len(mixing.factors))
    pairs = [(i, j) for i in numbers for j in numbers if wrong >> i & 1 and not wrong >> j & 1]

    def mended(pair: tuple[int, int]) -> int:
        tried = wrong | 1 << pair[1], wrong & ~(1 << pair[0])
        return sum(_problem(mixing, mixture) is None for mixture in tried)

    return max(pairs, key=mended)


def _outer(count: int) -> Iterator[int]:
    """Yield the mixtures in which at most two settings differ from the others."""
    for subset in itertools.chain(*(itertools.combinations(range(count), size) for size in (1, 2))):
        mixture = sum(1 << i for i in subset)
        yield from (mixture, 2**count - 1 - mixture)


def _problem(mixing: Mixing, mixture: int) -> RunnerError | None:
    """Return why a mixture cannot be run; None if it can."""
    try:
        config = mixing.config(mixture)
    except ConfigError as error:
        return error
    kwargs = json.dumps(config.to_mapping()["env"]["kwargs"], sort_keys=True)
    try:
        _require_environment(config.env.id, kwargs, config.rewards)
    except (ConfigError, EnvironmentNotUsable) as error:
        return error
    return None


@cache
def _require_environment(env_id: str, kwargs: str, rewards: str) -> None:
    load_mdp(env_id, json.loads(kwargs), rewards)


def _branches(value: object) -> str:
    """Return branches of training in a few words: `epsilon 0.5 from step 100,000`."""
    texts = (
        f"{branch.changes} {'from' if branch.settings else 'at'} step {branch.step:,}"
        for branch in training_branches({"branches": value})
    )
    return "; ".join(texts) or "none"


# --- training -----------------------------------------------------------------------------------------


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
        self._path = folder / _VALUES
        self._report = report
        self._kept = {run.job: run for run in _read_kept(self._path)}
        self.in_file = sum(run.seed in self.seeds for run in self._kept.values())
        """Runs in the file with one of the seeds, of any mixture."""
        self._jobs: dict[int, list[str]] = {}
        """Mixture to the identities of its runs, in the order of the seeds."""
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
        """Return the readings of a mixture that were measured, in the order of the seeds."""
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
        batch = max(1, round(_TASK_SECONDS / self.seconds)) if self.seconds else len(seeds)
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
            known = self._kept[jobs[seed]] = _KeptRun(jobs[seed], dict(read), measured.seconds, seed)
            lines.append(_LINE.dump_json(known).decode() + "\n")
        with storage_errors(self._path), self._path.open("a", encoding="utf-8") as file:
            file.writelines(lines)


@lru_cache(maxsize=16)
def _environment_digest(mdp: Mdp) -> str:
    """Return the digest of an environment's arrays, which its code determines."""
    digest = blake3()
    for name, array in sorted(mdp.arrays().items()):
        digest.update(name.encode() + array.tobytes())
    return digest.hexdigest()[:16]


@dataclass(frozen=True)
class _KeptRun:
    """A line of the file of values: what a run measured."""

    job: str
    readings: dict[str, FiniteFloat | None]
    seconds: FiniteFloat
    seed: object = None


_LINE: Final = TypeAdapter(_KeptRun)


def _read_kept(path: Path) -> Iterator[_KeptRun]:
    """Yield the runs in a file of values, without damaged lines."""
    try:
        with path.open("rb") as file:
            while file.tell() < _MAX_BYTES and (line := file.readline(_MAX_LINE)):
                with contextlib.suppress(ValidationError):
                    yield _LINE.validate_json(line)
    except OSError:
        return
