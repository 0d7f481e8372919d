"""A `Comparison`, and a `TaskComparison`, as sections of sentences and tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from runner.analysis.compare import Comparison, GroupResult, MetricResult, PairResult
from runner.analysis.compare.tasks import AlgorithmResult, TaskComparison
from runner.analysis.sections import Grid, Section
from runner.analysis.statistics import FEWEST_TOGETHER, Estimate
from runner.util.humanize import counted, listed

_MAX_PAIRS: Final = 6
"""Pairs of groups whose outcome is a sentence."""
_MAX_LEVELS: Final = 5
"""Points of a performance profile, or of a curve, that are printed."""
EXPLANATION: Final = (
    "IQM: interquartile mean, of the middle half of the seeds. In brackets: 95 % percentile bootstrap "
    "intervals (Agarwal et al. 2021). Differences are taken seed by seed, as runs of one seed share their "
    "draws. P: the probability that a run of A does better than one of B, over all pairs of their seeds, "
    "equal ones counted half, with a score interval (Newcombe 2006). Intervals at 95 % hold one by one: of "
    "twenty such, one is wrong on average. Those under 'together' hold all at once, over all pairs and "
    f"metrics compared (t intervals of trimmed means; from {FEWEST_TOGETHER} seeds on)."
)
AGGREGATES: Final[tuple[tuple[str, Callable[[AlgorithmResult], Estimate]], ...]] = (
    ("IQM", lambda result: result.iqm),
    ("median", lambda result: result.median),
    ("mean", lambda result: result.mean),
    ("optimality gap", lambda result: result.optimality_gap),
)
TASKS_EXPLANATION: Final = (
    "IQM: mean of the middle half of all runs of all environments. Median and mean: over the mean scores of "
    "the environments. Optimality gap: by how much scores fall short of 1; lower is better. P: the chance "
    "that a run of A scores higher than one of B, the mean over environments, equal ones counted half. In "
    "brackets: 95 % percentile intervals of a bootstrap that resamples the seeds of each environment "
    "(Agarwal et al. 2021)."
)


# --- groups of runs -----------------------------------------------------------------------------------


def sections(comparison: Comparison) -> list[Section]:
    """Return the text of a comparison."""
    rows = [(label, str(len(ids)), listed(ids)) for label, ids in comparison.groups.items()]
    notes = [f"Note: {note}." for note in comparison.notes]
    sentences = [*summary(comparison), f"Values are read: {comparison.moment}.", *notes]
    first = Section("Groups", sentences, [Grid(("group", "runs", ""), rows)])
    return [
        first,
        *(_metric(metric) for metric in comparison.metrics),
        Section("How to read this", [EXPLANATION]),
    ]


def summary(comparison: Comparison) -> list[str]:
    """Return the outcome of the first metric, a sentence for each of the first pairs of groups."""
    for metric in comparison.metrics:
        if metric.pairs:
            pairs = [pair for pair in metric.pairs if pair.seeds]
            more = len(pairs) - _MAX_PAIRS
            left_out = [f"The table has {counted(more, 'more pair')}."] if more > 0 else []
            return [_pair_in_words(metric, pair) for pair in pairs[:_MAX_PAIRS]] + left_out
    return []


def _pair_in_words(metric: MetricResult, pair: PairResult) -> str:
    word = "higher" if metric.higher_is_better is None else "better"
    if pair.ties == len(pair.seeds):
        return f"{metric.title}, in {metric.unit}: {pair.a} and {pair.b} are equal at all {pair.ties} seeds."
    first, second, count = pair.a, pair.b, pair.wins
    if pair.losses > pair.wins:
        first, second, count = pair.b, pair.a, pair.losses
    equal = f", equal at {pair.ties}" if pair.ties else ""
    by = ""
    if math.isfinite(pair.iqm.value):
        by = f"; IQM of {pair.a} - {pair.b}: {number(pair.iqm.value, True)}, 95 % {interval(pair.iqm, True)}"
    return (
        f"{metric.title}, in {metric.unit}: {first} is {word} than {second} at {count} of {len(pair.seeds)} "
        f"seeds{equal}{by}."
    )


def _metric(metric: MetricResult) -> Section:
    """Return the text of one metric, with a few points of its performance profile."""
    better = {True: "higher is better", False: "lower is better", None: "neither is better as such"}
    line = f", {metric.line.replace('_', ' ')}" if metric.line else ""
    groups = [
        (group.label, str(group.n), number(group.median), number(group.iqm.value), interval(group.iqm))
        for group in metric.groups
    ]
    grids = [Grid(("", "n", "median", "IQM", "95 %"), groups)]
    if metric.pairs:
        word = "higher" if metric.higher_is_better is None else "better"
        count = f"{word} / equal / {'lower' if word == 'higher' else 'worse'}"
        together = any(not math.isnan(pair.simultaneous.value) for pair in metric.pairs)
        headings = (
            "A - B, seed by seed",
            "seeds",
            "median",
            "IQM",
            "95 %",
            *(["together"] if together else []),
            f"P(A {word})",
            "95 %",
            count,
        )
        grids.append(Grid(headings, [_pair(pair, together) for pair in metric.pairs]))
    if len(metric.thresholds) > 1:
        sign = "at most" if metric.higher_is_better is False else "at least"
        grids.append(_profile_grid(metric.groups, metric.thresholds, sign))
    sentences = [f"{metric.name}, in {metric.unit}; {better[metric.higher_is_better]}."]
    sentences += [f"Note: {note}." for note in (*metric.notes, *unpaired(metric.pairs))]
    return Section(metric.title + line, sentences, grids)


def unpaired(pairs: Sequence[PairResult]) -> list[str]:
    """Return which seeds are left out of the pairs, a sentence each."""
    sentences = []
    for pair in pairs:
        against = f"{pair.a} against {pair.b} without"
        for label, other, seeds in ((pair.a, pair.b, pair.left_out_a), (pair.b, pair.a, pair.left_out_b)):
            if run_ids := [seed for seed in seeds if isinstance(seed, str)]:
                sentences.append(
                    f"{against} {listed(run_ids)} of {label}: only runs with a seed can be paired"
                )
            if numbers := [str(seed) for seed in seeds if not isinstance(seed, str)]:
                sentences.append(f"{against} seed {listed(numbers)}, which {label} has and {other} lacks")
    return sentences


def _pair(pair: PairResult, together: bool) -> tuple[str, ...]:
    few = "too few seeds" if len(pair.seeds) < FEWEST_TOGETHER else ""
    return (
        f"{pair.a} - {pair.b}",
        str(len(pair.seeds)),
        number(pair.median, signed=True),
        number(pair.iqm.value, signed=True),
        interval(pair.iqm, signed=True),
        *([few or interval(pair.simultaneous, signed=True)] if together else []),
        number(pair.improvement.value),
        interval(pair.improvement),
        f"{pair.wins} / {pair.ties} / {pair.losses}",
    )


# --- algorithms over environments ---------------------------------------------------------------------


def task_sections(comparison: TaskComparison) -> list[Section]:
    """Return the text of a comparison over environments."""
    rows = [
        (
            task,
            number(bounds.zero),
            number(bounds.one),
            *(
                f"{number(float(np.mean(result.scores[task])))} ({result.seeds[task]})"
                for result in comparison.algorithms
            ),
        )
        for task, bounds in comparison.tasks.items()
    ]
    labels = [f"{result.label}, mean (seeds)" for result in comparison.algorithms]
    headings = ("environment", "score 0 at", "score 1 at", *labels)
    pairs = (
        f"{pair.a} scores higher than {pair.b} with a probability of {number(pair.probability.value)}, 95 % "
        f"{interval(pair.probability)}, over {counted(len(comparison.tasks), 'environment')}."
        for pair in comparison.improvements
    )
    notes = (f"Note: {note}." for note in comparison.notes)
    return [
        Section("Algorithms", [*pairs, *notes], [Grid(headings, rows)]),
        Section(
            f"Normalised scores: {comparison.title}",
            [f"{comparison.metric}, {comparison.moment}; normalised by {comparison.normalised_by}."],
            _task_grids(comparison),
        ),
        Section("How to read this", [TASKS_EXPLANATION]),
    ]


def _task_grids(comparison: TaskComparison) -> list[Grid]:
    """Return the aggregates, the probabilities of improvement, profiles and curves as tables."""
    headings = [heading for name, _ in AGGREGATES for heading in (name, "95 %")]
    rows = [
        (
            result.label,
            str(sum(result.seeds.values())),
            *(text for _, of in AGGREGATES for text in (number(of(result).value), interval(of(result)))),
        )
        for result in comparison.algorithms
    ]
    all_grids = [Grid(("", "runs", *headings), rows)]
    if comparison.improvements:
        pairs = [
            (pair.a, pair.b, number(pair.probability.value), interval(pair.probability))
            for pair in comparison.improvements
        ]
        all_grids.append(Grid(("A", "B", "P(A higher)", "95 %"), pairs))
    if len(comparison.thresholds) > 1:
        all_grids.append(_profile_grid(comparison.algorithms, comparison.thresholds, "at least"))
    if len(comparison.positions) > 1:
        at = _spread_over(len(comparison.positions))
        curves = [(result.label, *(number(result.curve[k]) for k in at)) for result in comparison.algorithms]
        places = (f"{comparison.positions[k]:,.6g}" for k in at)
        all_grids.append(Grid((f"IQM after {comparison.axis}", *places), curves))
    return all_grids


# --- parts of both ------------------------------------------------------------------------------------


def _profile_grid(
    results: Sequence[GroupResult] | Sequence[AlgorithmResult], thresholds: Sequence[float], sign: str
) -> Grid:
    """Return a few points of performance profiles; the sign is `at least` or `at most`."""
    at = _spread_over(len(thresholds))
    rows = [(result.label, *(f"{100 * result.profile[k]:.0f} %" for k in at)) for result in results]
    return Grid((f"share of runs {sign}", *(number(thresholds[k]) for k in at)), rows)


def _spread_over(count: int) -> list[int]:
    """Return the indices of a few of `count` points, evenly spread from the first to the last."""
    points: list[int] = np.unique(np.linspace(0, count - 1, _MAX_LEVELS).round().astype(int)).tolist()
    return points


def number(value: float, signed: bool = False) -> str:
    """Return a number with three or more digits that count; a level that is not reached is infinite."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return ("+∞" if value > 0 else "-∞") if signed else "never"
    digits = 0 if abs(value) >= 1000 else 1 if abs(value) >= 100 else 2
    return f"{value:{'+' if signed else ''},.{digits}f}"


def interval(estimate: Estimate, signed: bool = False) -> str:
    """Return an interval: `[1.2, 3.4]`."""
    if math.isnan(estimate.low):
        return "–"
    return f"[{number(estimate.low, signed)}, {number(estimate.high, signed)}]"
