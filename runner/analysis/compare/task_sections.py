"""A `TaskComparison` as sections of sentences and tables."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from runner.analysis.compare.sections import interval, number, profile_grid, spread_over
from runner.analysis.compare.statistics import Estimate
from runner.analysis.compare.tasks import AlgorithmResult, TaskComparison
from runner.analysis.sections import Grid, Section
from runner.util.humanize import counted

AGGREGATES: Final[tuple[tuple[str, Callable[[AlgorithmResult], Estimate]], ...]] = (
    ("IQM", lambda result: result.iqm),
    ("median", lambda result: result.median),
    ("mean", lambda result: result.mean),
    ("optimality gap", lambda result: result.optimality_gap),
)
EXPLANATION: Final = (
    "IQM: mean of the middle half of all runs of all environments. Median and mean: over the mean scores of "
    "the environments. Optimality gap: by how much scores fall short of 1; lower is better. P: the chance "
    "that a run of A scores higher than one of B, the mean over environments, equal ones counted half. In "
    "brackets: 95 % percentile intervals of a bootstrap that resamples the seeds of each environment "
    "(Agarwal et al. 2021)."
)


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
            grids(comparison),
        ),
        Section("How to read this", [EXPLANATION]),
    ]


def grids(comparison: TaskComparison) -> list[Grid]:
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
        all_grids.append(profile_grid(comparison.algorithms, comparison.thresholds, "at least"))
    if len(comparison.positions) > 1:
        at = spread_over(len(comparison.positions))
        curves = [(result.label, *(number(result.curve[k]) for k in at)) for result in comparison.algorithms]
        places = (f"{comparison.positions[k]:,.6g}" for k in at)
        all_grids.append(Grid((f"IQM after {comparison.axis}", *places), curves))
    return all_grids
