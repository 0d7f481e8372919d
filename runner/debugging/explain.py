"""Which settings make the difference between two runs or configurations: mixtures of them are trained.

    explanation = runner.explain("tutorial_cooperative", "tutorial_text_cooperative", at=5000)
    for setting in explanation.settings:
        print(setting.name, setting.share)

A mixture has some settings of the one and the others of the other. Two short runs show the first step at
which the strongest setting changed what was learned.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from blake3 import blake3

from runner.analysis.diff import can_compare_steps
from runner.analysis.diff.causes import find_cause
from runner.analysis.diff.divergence import training_divergence
from runner.analysis.diff.sections import where_in_words
from runner.analysis.diff.updates import replay_to
from runner.archive.places import opened
from runner.config import ExperimentConfig, from_mapping, load
from runner.config.model import Job, identity_of
from runner.config.shipped import shipped
from runner.debugging.explanation import FOLDER, LOCK, TAG, Explanation, FirstStep, Side, write_explanation
from runner.debugging.game import Game, SamplingPlan, interactions_of, mixture_bounds, settings_of
from runner.debugging.mixtures import (
    MAX_ALL,
    Measurement,
    Mixing,
    MixtureResult,
    Mixtures,
    Readings,
    measure,
    mix,
)
from runner.environments.naming import spoken
from runner.errors import RunnerError, RunNotFound, nearest
from runner.execution.session import resolve_initial_q, run_job
from runner.recording.labels import Labels
from runner.replay.trust import require_may_train
from runner.runs.catalogue.removal import plan, remove
from runner.runs.resolve import find_run
from runner.runs.run import UNLISTED, Run, acquired, list_runs, new_run, recordings_folder, require_trained
from runner.sweep.workers import Workers, worker_pool
from runner.util.processes import Stop
from runner.util.values import JsonView

DEFAULT_SEEDS: Final = 20
MAX_SEEDS: Final = 10_000
_PROBES: Final = 2
"""Seeds of A and of B that are trained first, to see how long a run takes; the first one loads kernels."""
_EPISODES: Final = (100, 1000, 10_000)
"""Lengths of the short runs in which the first step that differs is looked for, one after the other."""

Source = str | os.PathLike[str] | JsonView | ExperimentConfig | Run
Report = Callable[[int, int, str], None]
"""Called several times a second with how many are done, of how many, and of what: `RUNS`, then `EPISODES`."""
RUNS: Final = "runs trained"
EPISODES: Final = "episodes of two short runs recorded"


class ExplanationBusy(RunnerError):
    """Another process computes the explanation."""


def explain(
    a: Source,
    b: Source,
    *,
    metric: str | None = None,
    at: int | None = None,
    seeds: int = DEFAULT_SEEDS,
    workers: int | None = None,
    ray: str | None = None,
    recordings: str | os.PathLike[str] | None = None,
    report: Report = lambda *_: None,
    planned: Callable[[SamplingPlan], None] = lambda _: None,
    stop: Stop = lambda: False,
    trust: bool = False,
) -> Explanation:
    """Train mixtures of two configurations, and return which settings make the difference between them.

    Interrupted, it keeps what was trained: called again, it continues. The result is kept in the recordings
    folder, too.

    Args:
        a: a run or a configuration, the file of a configuration, or the name of a run or of a shipped
            configuration.
        b: another, as `a`.
        metric: the metric of an evaluation; by default the success rate, or the mean return if the
            environment does not define success.
        at: training episodes after which the metric is read; by default at the end of each configuration.
        seeds: number of seeds of each mixture, counted from the seed of A.
        workers: maximum number of processes; one per processor by default.
        ray: the address of a cluster of Ray, or empty for this machine; None for no Ray.
        recordings: the recordings folder: $DUALTAXI_RECORDINGS, or ./recordings, by default.
        report: called several times a second with how many runs are trained, of how many, and what is
            counted; at last with the episodes of the two short runs that show the first step.
        planned: called with what will be trained, before it is.
        stop: called several times a second; return True to stop.
        trust: whether environments of runs may be made that `runner.replay.trust` refuses.

    Raises:
        CannotRedo: an environment may not be made.
        RunnerError: nothing differs, or too much; they cannot be mixed; a mixture does not have the metric.
        KeyboardInterrupt: it was interrupted, or `stop` returned True.
    """
    folder = recordings_folder(recordings)
    question = ask(a, b, metric=metric, at=at, seeds=seeds, recordings=folder, trust=trust)
    pool: Workers[Measurement, MixtureResult]
    with worker_pool(workers, ray, 2**MAX_ALL) as pool:
        return answer(question, pool, report, planned, stop)


@dataclass(frozen=True)
class Question:
    """What is to be explained."""

    name: str
    """The folder of what is known of the two."""
    a: Side
    b: Side
    mixing: Mixing
    seeds: tuple[int, ...]
    metric: str | None
    at: int | None
    recordings: Path
    notes: tuple[str, ...]

    @property
    def mixtures(self) -> tuple[int, int]:
        """How many mixtures are run, at least and at most."""
        return mixture_bounds(len(self.mixing.factors))


def ask(
    a: Source,
    b: Source,
    *,
    metric: str | None,
    at: int | None,
    seeds: int,
    recordings: Path,
    trust: bool = False,
    require: Callable[[ExperimentConfig], None] = lambda _: None,
) -> Question:
    """Return what is to be explained; arguments and errors as for `explain`.

    `require` is called with each configuration before anything is read that it names; it may refuse.
    """
    if not 1 <= seeds <= MAX_SEEDS:
        raise RunnerError(f"seeds: found {seeds}, expected 1 to {MAX_SEEDS:,}.")
    if at is not None and at < 1:
        raise RunnerError(f"at: found {at}, expected a number of training episodes from 1 on.")
    (side_a, config_a, first), (side_b, config_b, other) = (
        _resolved(source, recordings, trust, require) for source in (a, b)
    )
    mixing = mix(config_a, config_b, at, exact=(metric or "").startswith("exact."))
    notes = list(mixing.notes)
    if first != other:
        notes.append(f"all mixtures have the same seeds, though A has seed {first} and B seed {other}")
    values = [mixing.a.to_mapping(), mixing.b.to_mapping()]
    digest = blake3(json.dumps(values, sort_keys=True).encode()).hexdigest()[:8]
    names = [re.sub(r"[^A-Za-z0-9_.-]", "_", side.name).lstrip(".-")[:40] for side in (side_a, side_b)]
    seed_numbers = tuple(range(first, first + seeds) if first + seeds <= 2**64 else range(seeds))
    name = f"{'-'.join(names)}-{digest}"
    return Question(name, side_a, side_b, mixing, seed_numbers, metric, at, recordings, tuple(notes))


def answer(
    question: Question,
    pool: Workers[Measurement, MixtureResult],
    report: Report = lambda *_: None,
    planned: Callable[[SamplingPlan], None] = lambda _: None,
    stop: Stop = lambda: False,
) -> Explanation:
    """Return the explanation of a question, trained by some workers; see `explain`."""
    began = time.monotonic()
    mixing = question.mixing
    folder = question.recordings
    results = folder / FOLDER / question.name
    busy = ExplanationBusy("another process computes the same explanation; try again when it has finished.")
    lock = acquired(results / LOCK, busy)

    def report_runs(done: int, total: int) -> None:
        if stop():
            raise KeyboardInterrupt("what was trained is kept")
        report(done, total, RUNS)

    try:
        mixtures = Mixtures(mixing, question.seeds, folder, results, pool, report_runs)
        ends = (0, mixing.everything)
        if not mixtures.known(ends):
            check_metric(question)
        mixtures.measure(ends, _PROBES)
        sides = [mixtures.readings(end)[0] for end in ends]
        game = Game(mixtures, _metric_of(sides, question.metric))
        planned(game.plan())
        players = game.players()
        settings = settings_of(game, players)
        step = None
        if settings[0].share is not None:
            strongest = next(i for i, factor in enumerate(mixing.factors) if factor.name == settings[0].name)
            step = _first_step(
                mixing,
                strongest,
                question.seeds[0],
                folder,
                question.name,
                lambda done, total: report(done, total, EPISODES),
                stop,
            )
        explanation = Explanation(
            name=f"{question.name}/{re.sub(r'[^A-Za-z0-9_.-]+', '_', game.metric)}",
            a=question.a,
            b=question.b,
            metric=game.metric,
            at=question.at,
            episodes=mixing.a.episodes,
            seeds=question.seeds,
            method="all mixtures" if len(mixing.factors) <= MAX_ALL else "delta debugging",
            value_a=game.mean(0),
            value_b=game.mean(mixing.everything),
            difference=game.difference,
            settings=settings,
            interactions=interactions_of(game, players),
            smallest=game.smallest(players),
            mixtures=tuple(game.mixture(number) for number in game.ordered()),
            first_step=step,
            notes=question.notes,
            trained=mixtures.trained,
            seconds=time.monotonic() - began,
        )
        write_explanation(explanation, folder)
        return explanation
    finally:
        lock.release()


def _resolved(
    source: Source, recordings: Path, trust: bool, require: Callable[[ExperimentConfig], None]
) -> tuple[Side, ExperimentConfig, int]:
    """Return the name, the configuration and the first seed of a run or a configuration.

    Raises:
        RunnerError: there is none, or it is a loop, whose learning is the user's own.
    """
    if isinstance(source, Mapping):
        source = from_mapping(source)
    if isinstance(source, str | os.PathLike):
        path = Path(source)
        experiments = [
            name for name, configuration in shipped().items() if configuration.kind == "experiment"
        ]
        if path.suffix in (".yaml", ".yml") or os.fspath(source) in experiments:
            source = load(path)
        else:
            try:
                source = find_run(os.fspath(source), recordings)
            except RunNotFound as error:
                hint = (
                    nearest(path.name, experiments) or " `dualtaxi config ls` lists those that are shipped."
                )
                raise RunNotFound(f"{error}\nThere is no configuration of this name either.{hint}") from error
    if isinstance(source, ExperimentConfig):
        require(source)
        return Side(source.name), resolve_initial_q(source, recordings), source.seeds[0]
    require_trained(
        source,
        is_trained=True,
        refusal=f"run {source.run_id} was recorded from a training loop of your own, which cannot be trained "
        f"here with other settings. `dualtaxi diff {source.run_id} OTHER` shows in what two loops differ "
        "and where they diverge, and `dualtaxi compare` compares many.",
    )
    require_may_train(source.recording, source.file.config, trust)
    config = from_mapping(source.file.config)
    require(config)
    return Side(source.name, source.run_id), resolve_initial_q(config, recordings), source.seed


def check_metric(question: Question) -> None:
    """Check that evaluations of A and of B have the metric, by an episode of each.

    Rewards are not checked: `training.reward.VALUE` depends on what was received.
    """
    mixing, metric = question.mixing, question.metric
    if metric is None or metric.startswith("training.reward"):
        return
    sides = []
    for number in (0, mixing.everything):
        values = mixing.config(number).to_mapping()
        short = from_mapping(values | {"episodes": 1, "evaluation": values["evaluation"] | {"trials": 1}})
        sides.append(dict.fromkeys(measure(short, 0, question.recordings) or (), 0.0))
    _metric_of(sides, metric)


def _metric_of(sides: Sequence[Readings], metric: str | None) -> str:
    """Return the metric: the one that was chosen, the success rate, or the mean return.

    The sides are the readings of A and of B.

    Raises:
        RunnerError: there is no such metric in evaluations of A and of B.
    """
    shared = {name for name in sides[0] if all(side.get(name) is not None for side in sides)}
    candidates = [metric] if metric is not None else ["success_percent", "mean_return"]
    for name in candidates:
        if name in shared:
            return name
    names = ", ".join(sorted(name for name in shared if not name.startswith("training.reward.")))
    raise RunnerError(
        f"metric: found {metric or 'none'!r}, expected one that evaluations of both have: {names}."
        f"{nearest(metric or '', shared)}"
    )


# --- the first step that differs ----------------------------------------------------------------------


def _first_step(
    mixing: Mixing,
    number: int,
    seed: int,
    recordings: Path,
    name: str,
    report: Callable[[int, int], None],
    stop: Stop,
) -> FirstStep:
    """Record A with and without one setting of B, until they differ; return where they do.

    If they do not, all settings of B with and without this one are recorded. The runs are not listed among
    those of the recordings folder: they are found by their ids, and have the name of the explanation as a
    tag. `report` is called a few times a second with the episodes recorded, and of how many; `stop` is called
    every few milliseconds, and returns True to stop.

    Raises:
        KeyboardInterrupt: `stop` returned True.
    """
    bit = 1 << number
    setting = mixing.factors[number].name
    folder = recordings / UNLISTED
    tag = TAG.format(name)
    made = {identity_of(run.file.config, run.seed): run for run in list_runs(folder) if tag in run.tags}
    pairs = [(0, bit, f"Changing {setting} alone in A")]
    if mixing.everything != bit:
        others = f"Changing {setting} when all other settings are as in B"
        pairs.append((mixing.everything - bit, mixing.everything, others))
    limit = min(mixing.a.episodes, mixing.b.episodes)
    for before, after, what in pairs:
        for episodes in sorted({min(limit, count) for count in _EPISODES}):
            runs = []
            for part, (mixture, word) in enumerate(((before, "without"), (after, "with"))):
                plain = {"episodes": episodes, "evaluation": None, "recording": {"console": False}}
                job = Job(from_mapping(mixing.config(mixture).to_mapping() | plain), seed)
                run = made.get(job.identity)
                if run is not None and run.status != "finished":
                    _discard(run)
                    run = None
                if run is None:
                    title = re.sub(r"[^A-Za-z0-9_.]+", "-", f"{word}-{setting}")[:100]
                    labels = Labels(tags=(tag,))
                    run = new_run(folder, job.config.to_mapping(), seed, title, labels=labels)
                    done = part * episodes
                    total = 2 * episodes
                    run = run_job(job, run, lambda now: report(done + now.episode, total), stop)  # noqa: B023
                    if run.status != "finished":
                        _discard(run)
                        raise KeyboardInterrupt("what was trained is kept")
                runs.append(run)
            difference = _difference(runs[0], runs[1], setting, what)
            if difference is not None:
                return difference
            for run in runs:
                _discard(run)
    sentence = (
        f"Neither alone nor last did {setting} change a step in {min(limit, _EPISODES[-1]):,} episodes."
    )
    return FirstStep(setting, "", "", None, None, None, (sentence,))


def _discard(run: Run) -> None:
    """Remove a run that shows nothing; one that a user keeps, or another process uses, stays."""
    with contextlib.suppress(RunnerError):
        remove(plan(run, run.folder.parent))


def _difference(before: Run, after: Run, setting: str, what: str) -> FirstStep | None:
    """Return where two runs differ first, and what is known of it; None if they do not differ."""
    with opened(before) as a, opened(after) as b:
        if not can_compare_steps(a, b):
            sentence = f"{what} changes the states or actions, so that no steps can be compared."
            return FirstStep(setting, a.run_id, b.run_id, None, None, None, (sentence,))
        divergence = training_divergence(a, b)
        sentences = []
        if divergence is not None and divergence.a_step is not None and divergence.b_step is not None:
            cause = find_cause(divergence, a, b)
            sentences.append(f"Training diverges {where_in_words(divergence)}: {cause.text}.")
            update = cause.update
            place = (divergence.step, divergence.episode, divergence.t)
        elif a.agents == b.agents:  # the first update that differs though all steps are the same
            steps = min(recording.train.steps.count() for recording in (a, b))
            update = replay_to(a, b, steps)[1]
        else:
            update = None
        if update is not None:
            record = next(a.train.steps.blocks(update.step, update.step + 1))[0]
            place = update.step, update.episode, int(record["t"])
            sentences.insert(
                0,
                f"{spoken(update.agent)}'s value of {update.action} in the state ({update.state}) became "
                f"{update.b:.6g} instead of {update.a:.6g}: {'; '.join(update.reasons)}.",
            )
        if not sentences:
            return None
    step, episode, t = place
    first = (
        f"{what} first changed an update at training step {step:,}, in episode {episode:,} at t = {t} "
        f"(runs {before.run_id} without it and {after.run_id} with it, which are recorded)."
    )
    return FirstStep(setting, before.run_id, after.run_id, step, episode, t, (first, *sentences))
