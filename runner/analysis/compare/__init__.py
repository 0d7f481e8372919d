"""Groups of runs against each other, a metric at a time: statistics over seeds.

    groups, notes = grouped([read_series(recording) for recording in recordings])
    comparison = compare(groups, [("success_percent", "")], Moment("last"), notes)

`runner.analysis.statistics` explains the numbers.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from runner.analysis import statistics
from runner.analysis.compare.moments import (
    Moment,
    Seed,
    few_seeds,
    higher_is_better,
    last_episodes,
    measured,
    moment_in_words,
    seed_of,
    seed_order,
    uneven_ends,
    window_notes,
)
from runner.analysis.groups import Group
from runner.analysis.series import full_name, points_of, title_of
from runner.analysis.statistics import Estimate
from runner.errors import RunnerError
from runner.util.arrays import Floats

THRESHOLDS: Final = 101


@dataclass(frozen=True)
class GroupResult:
    """One group's values of one metric, one for each seed that has any."""

    label: str
    seeds: list[Seed]
    run_ids: list[str]
    """In the order of the seeds, which may have several runs each."""
    values: list[float]
    """In the order of the seeds, the mean over the runs of each; infinite for a level never reached."""
    median: float
    iqm: Estimate
    profile: list[float]
    """Share of the runs that are at least as good as each of the metric's thresholds."""
    profile_low: list[float]
    profile_high: list[float]

    @property
    def n(self) -> int:
        """Number of seeds."""
        return len(self.values)


@dataclass(frozen=True)
class PairResult:
    """Two groups at the seeds that both have."""

    a: str
    b: str
    seeds: list[Seed]
    left_out_a: list[Seed]
    """Seeds that only A has."""
    left_out_b: list[Seed]
    median: float
    """Median of the differences A - B, seed by seed; nan without a common seed."""
    iqm: Estimate
    """IQM of the same differences."""
    simultaneous: Estimate
    """The same IQM with an interval that holds together with all others; nan for a single pair."""
    improvement: Estimate
    """Probability that a run of A is better than one of B; higher, where nobody can say what is better."""
    wins: int
    ties: int
    losses: int
    """At how many seeds A is better than B, equal, worse."""
    differences: list[float]
    """A - B in the order of the seeds."""


@dataclass(frozen=True)
class MetricResult:
    """One metric of all groups that have it."""

    metric: str
    line: str
    """An agent such as taxi_1, or another line of the metric; empty if it has one line."""
    title: str
    unit: str
    higher_is_better: bool | None
    groups: list[GroupResult]
    pairs: list[PairResult]
    thresholds: list[float]
    notes: list[str]

    @property
    def name(self) -> str:
        """Metric and line: `mean_return.taxi_1`."""
        return full_name(self.metric, self.line)


@dataclass(frozen=True)
class Comparison:
    """The result of comparing groups."""

    moment: str
    groups: dict[str, list[str]]
    """Label to the ids of its runs."""
    metrics: list[MetricResult]
    notes: list[str]


def compare(
    groups: Sequence[Group], metrics: Sequence[tuple[str, str]], moment: Moment, notes: Sequence[str] = ()
) -> Comparison:
    """Return the statistics of some metrics of groups.

    Args:
        groups: of runs.
        metrics: (metric, line) pairs, as `runner.analysis.series` names them.
        moment: at which the metrics are read.
        notes: sentences to add to the comparison's own.

    Raises:
        MissingExtra: SciPy is not installed.
        RunnerError: no run has a value of any of the metrics.
    """
    statistics.require_scipy()
    results = [_metric(groups, metric, line, moment) for metric, line in metrics]
    if results and not any(metric.groups for metric in results):
        if moment.kind != "position":
            raise RunnerError(f"found nothing to compare: {results[0].notes[0]}.")
        runs = [run for group in groups for run in group.runs]
        known = {at for run in runs for name in metrics for at in points_of(run, *name, aligned=True)}
        before = sorted(at for at in known if at < moment.number)[-1:]
        after = sorted(at for at in known if at > moment.number)[:1]
        nearest = " and ".join(f"{at:,g}" for at in before + after)
        hint = f"; the nearest are those after {nearest}" if nearest else ""
        raise RunnerError(f"moment: found no values after {moment.axis.moment(moment.number)}{hint}.")
    pairs = [pair for metric in results for pair in metric.pairs]
    if len(pairs) > 1:  # their intervals are widened to hold together
        widened = iter(statistics.simultaneous([pair.differences for pair in pairs]))
        results = [
            replace(metric, pairs=[replace(pair, simultaneous=next(widened)) for pair in metric.pairs])
            for metric in results
        ]
    return Comparison(
        moment=moment_in_words(moment, [metric for metric, _ in metrics], groups),
        groups={group.label: [run.run_id for run in group.runs] for group in groups},
        metrics=results,
        notes=[*notes, *_notes(groups, metrics, moment)],
    )


def _notes(groups: Sequence[Group], metrics: Sequence[tuple[str, str]], moment: Moment) -> Iterator[str]:
    """Yield what limits the comparison of these groups: environments, metrics, equal contents, few seeds."""
    environments = dict.fromkeys(
        (group.label, run.environment) for group in groups for run in group.runs if run.environment
    )
    if len({env_id for _, env_id in environments}) > 1:
        where = ", ".join(f"{env_id} in {label}" for label, env_id in environments)
        yield (
            f"the environments differ ({where}): their figures do not measure the same; normalised, by "
            "`minmax` or a table of scores, algorithms are compared that all ran in the same environments"
        )
    names = [metric for metric, _ in metrics]
    if moment.kind == "last" and all(name.startswith("training.") for name in names):
        yield (
            f"training is compared, {moment_in_words(moment, names, groups)}; "
            "the moment `area` takes the mean over all of it"
        )
    yield from window_notes(groups, names, moment)
    digests = {
        group.label: sorted((run.seed or 0, run.content_digest) for run in group.runs)
        for group in groups
        if all(run.content_digest for run in group.runs)
    }
    for a, b in itertools.combinations(digests, 2):
        if digests[a] == digests[b]:
            yield f"{a} and {b} are identical: their runs have the same content, seed by seed"
    seeds = {group.label: len({seed_of(run) for run in group.runs}) for group in groups}
    yield from few_seeds(groups, seeds)


def _metric(groups: Sequence[Group], metric: str, line: str, moment: Moment) -> MetricResult:
    notes: list[str] = []
    by_label = {group.label: measured(group, metric, line, moment, groups, notes) for group in groups}
    run_ids = {label: ids for label, (by_seed, ids) in by_label.items() if by_seed}
    present = {label: by_label[label][0] for label in run_ids}
    title, unit = title_of(metric)
    better = higher_is_better(metric, groups)
    if moment.kind == "last":
        notes += uneven_ends(groups, metric, line)
    if moment.level is not None:
        better = False
        title = f"{title}: first at {moment.level:g}"
        unit = moment.axis.label
        for label, by_seed in present.items():
            reached = sum(value < statistics.NEVER for value in by_seed.values())
            notes.append(f"{label}: {reached} of {len(by_seed)} seeds reach it")
    if moment.kind == "last" and (episodes := last_episodes(metric, groups)):
        title = f"{title}, {episodes}"
    sign = -1.0 if better is False else 1.0
    numbers = {value for by_seed in present.values() for value in by_seed.values()}
    finite = sorted(value for value in numbers if abs(value) < statistics.NEVER)
    # Evenly spaced levels from the worst value to the best; few where there are few values.
    levels = np.linspace(finite[0], finite[-1], THRESHOLDS) if len(finite) > 1 else np.array(finite)
    thresholds = levels[:: int(sign)]
    return MetricResult(
        metric=metric,
        line=line,
        title=title,
        unit=unit,
        higher_is_better=better,
        groups=[
            _group(label, by_seed, run_ids[label], thresholds, sign) for label, by_seed in present.items()
        ],
        pairs=[_pair(a, present[a], b, present[b], sign) for a, b in itertools.combinations(present, 2)],
        thresholds=thresholds.tolist(),
        notes=notes,
    )


def _group(
    label: str, by_seed: Mapping[Seed, float], run_ids: list[str], thresholds: Floats, sign: float
) -> GroupResult:
    numbers = np.array(list(by_seed.values()))
    reached = sign * numbers >= sign * thresholds[:, np.newaxis]
    shares = statistics.bootstrap_means(reached.astype(np.float64))
    return GroupResult(
        label=label,
        seeds=list(by_seed),
        run_ids=run_ids,
        values=[statistics.bounded(value) for value in numbers.tolist()],
        median=statistics.median(numbers),
        iqm=statistics.interquartile_mean(numbers),
        profile=[share.value for share in shares],
        profile_low=[share.low for share in shares],
        profile_high=[share.high for share in shares],
    )


def _pair(
    a: str, ours: Mapping[Seed, float], b: str, theirs: Mapping[Seed, float], sign: float
) -> PairResult:
    seeds = sorted(ours.keys() & theirs.keys(), key=seed_order)
    left, right = (np.array([by_seed[seed] for seed in seeds]) for by_seed in (ours, theirs))
    difference = left - right
    return PairResult(
        a=a,
        b=b,
        seeds=seeds,
        left_out_a=sorted(ours.keys() - theirs.keys(), key=seed_order),
        left_out_b=sorted(theirs.keys() - ours.keys(), key=seed_order),
        median=statistics.median(difference) if seeds else np.nan,
        iqm=statistics.interquartile_mean(difference),
        simultaneous=Estimate(),
        improvement=statistics.improvement(sign * left, sign * right) if seeds else Estimate(),
        wins=int((sign * difference > 0).sum()),
        ties=int((difference == 0).sum()),
        losses=int((sign * difference < 0).sum()),
        differences=difference.tolist(),
    )
