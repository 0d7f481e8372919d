"""The figures of docs/reproduction.md: `python -m benchmarks.reproduction [--seeds N]`.

Runs the tutorial's jobs and ours with several seeds (seconds per job; only metrics are recorded) and prints
the tables of the page: the published figures with our medians and ranges.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import runner
from runner.analysis.evaluations import (
    EvaluationRecord,
    TrainingRecord,
    evaluation_records,
    training_records,
)

CONFIGS: Final = Path(__file__).resolve().parent.parent / "configs"

FINISHED = ("trials finished, of 200", lambda e: e.successes, 0)
LENGTH = ("mean length", lambda e: e.value("mean_length"), 1)
PENALTIES = ("mean penalties", lambda e: e.value("mean_penalties"), 1)
RECENT = ("recent training length", lambda e: e.training.mean_length, 1)
FILLED = ("filled, %", lambda e: min(e.training.of_tables["percent_filled"].values()), 2)
MEASURES: Final = (FINISHED, LENGTH, PENALTIES, RECENT, FILLED)

PUBLISHED: Final[dict[str, dict[int, Sequence[float | None]]]] = {
    "tutorial_cooperative": {0: (0, 1500, 1500, None, None), 49_000: (173, 210.3, 208.6, 63.0, 78.12)},
    "tutorial_competitive": {
        0: (0, 1500, 1500, None, None),
        48_000: (158, 323.4, 322.4, 78.1, 78.125),
        49_000: (143, 435.0, 434.1, 75.1, 78.125),
    },
}
"""Config -> training episodes before the evaluation -> the published value of each of `MEASURES`."""

REWARDS: Final[dict[str, tuple[int, dict[int, int]]]] = {
    "tutorial_cooperative": (
        49_404,
        {-3: 15343, -12: 12055, -4: 11018, -11: 4143, -20: 3906, -30: 1266, -2: 1260, 99: 699}
        | {-10: 185, 90: 125},
    ),
    "tutorial_competitive": (
        49_063,
        {-3: 13928, -12: 13605, -4: 10286, -11: 4542, -20: 3917, -30: 1874, -10: 665, -2: 575}
        | {90: 433, 99: 175},
    ),
}
"""Config -> the episode of a published report, and the counts of rewards in the last 50,000 steps."""

JOBS: Final[dict[str, list[str]]] = {
    "tutorial_cooperative": [],
    "tutorial_competitive": [],
    "tutorial_text_cooperative": [],
    "tutorial_text_competitive": [],
    "tutorial_competitive, its second table corrected": ["quirks.second_table_uses_first_action=false"],
    "cooperative": [],
    "competitive": [],
}


SLIPS: Final[dict[str, list[dict[str, bool]]]] = {
    "tutorial_cooperative": [
        {},
        {"bootstrap_after_termination": False},
        {"epsilon_exploits": False},
    ],
    "tutorial_competitive": [
        {},
        {"bootstrap_after_termination": False},
        {"epsilon_exploits": False},
        {"second_table_uses_first_action": False},
        {"epsilon_exploits": False, "second_table_uses_first_action": False},
    ],
    "cooperative": [{}],
    "competitive": [{}],
}
"""Config -> the corrections to compare, with a label each."""


@dataclass(frozen=True)
class Outcome:
    """The metrics of one run."""

    evaluations: dict[int, EvaluationRecord]
    """By number of training episodes."""
    reports: list[TrainingRecord]


def run(job: str, overrides: Sequence[str], seeds: int) -> list[Outcome]:
    """Run a job with seeds 0, 1, ... and return their metrics."""
    changes = [f"seeds={{first: 0, count: {seeds}}}", "recording.steps=none", *overrides]
    config = CONFIGS / f"{job.partition(',')[0]}.yaml"
    outcomes = []
    with tempfile.TemporaryDirectory() as folder:
        for done in runner.run_all(config, overrides=changes, recordings=folder):
            with runner.open_recording(done.recording) as recording:
                evaluations = evaluation_records(recording)
                reports = training_records(recording)
            outcomes.append(Outcome({e.episode: e for e in evaluations}, reports))
    return outcomes


def spread(values: Iterable[float], digits: int) -> str:
    """Return `median (lowest to highest)`."""
    found = sorted(values)
    low, middle, high = (f"{v:,.{digits}f}" for v in (found[0], statistics.median(found), found[-1]))
    return low if low == high else f"{middle} ({low} to {high})"


def cells(outcomes: list[Outcome], episode: int, measure: tuple[str, Callable[..., Any], int]) -> str:
    """Return median and range of a metric at an evaluation, or a dash if it is undefined."""
    values = [measure[1](outcome.evaluations[episode]) for outcome in outcomes]
    return "–" if None in values else spread(values, measure[2])


def volatility(outcomes: list[Outcome]) -> str:
    """Return the mean change of the success rate between evaluations in the second half, in points."""
    changes = []
    for outcome in outcomes:
        percent = [e.value("success_percent") for _, e in sorted(outcome.evaluations.items())]
        changes += [abs(after - before) for before, after in pairwise(percent[len(percent) // 2 :])]
    return f"{statistics.mean(changes):.1f}"


def table(title: str, heads: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a table in Markdown."""
    print(f"{title}\n")
    for row in (heads, ["---"] * len(heads), *rows):
        print("| " + " | ".join(map(str, row)) + " |")
    print()


def print_moments(job: str, outcomes: list[Outcome]) -> None:
    """Print the published evaluations and ours."""
    rows = [
        (f"{episode:,}", measure[0], "–" if value is None else value, cells(outcomes, episode, measure))
        for episode, values in PUBLISHED[job].items()
        for measure, value in zip(MEASURES, values, strict=True)
    ]
    table(f"**{job}**, {len(outcomes)} seeds", ("episodes", "measure", "published", "here"), rows)


def print_rewards(job: str, outcomes: list[Outcome]) -> None:
    """Print a published reward distribution and that of our nearest reports."""
    episode, published = REWARDS[job]
    near = [min(o.reports, key=lambda report: abs(report.episode - episode)) for o in outcomes]
    counts = [dict(report.reward_counts) for report in near]
    rows = [
        (f"{reward:+}", f"{n:,}", spread([c.get(reward, 0) for c in counts], 0))
        for reward, n in sorted(published.items())
    ]
    title = f"**{job}**, rewards of the last 50,000 training steps, near episode {episode:,}"
    table(title, ("reward of the step", "published", "here"), rows)


def print_curves(found: dict[str, list[Outcome]]) -> None:
    """Print the success rate during training."""
    at = (0, 1000, 2000, 5000, 10_000, 20_000, 30_000, 40_000, 50_000)
    rows = []
    for job, outcomes in found.items():
        medians = [
            f"{statistics.median(o.evaluations[episode].value('success_percent') for o in outcomes):.1f}"
            if episode in outcomes[0].evaluations
            else ""
            for episode in at
        ]
        rows.append((job, *medians, volatility(outcomes)))
    heads = ("episodes", *(f"{episode:,}" for episode in at), "changes by")
    table("**Learning curves**, success rate, median over seeds", heads, rows)


def print_ends(found: dict[str, list[Outcome]]) -> None:
    """Print the final metrics of each job."""
    rows = []
    for job, outcomes in found.items():
        last = max(outcomes[0].evaluations)
        rows.append((job, f"{last:,}", *(cells(outcomes, last, measure) for measure in MEASURES)))
    table("**At the end of training**", ("job", "episodes", *(measure[0] for measure in MEASURES)), rows)


def print_corrections(seeds: int) -> None:
    """Print the effect of correcting each error, evaluated from every start state."""
    rows = []
    for job, ways in SLIPS.items():
        for corrected in ways:
            changes = [f"quirks.{name}={str(value).lower()}" for name, value in corrected.items()]
            outcomes = run(job, ["evaluation={every: 100000, trials: 2880, start: each}", *changes], seeds)
            last = [outcome.evaluations[max(outcome.evaluations)] for outcome in outcomes]
            percent = spread([evaluation.value("success_percent") for evaluation in last], 1)
            length = spread([evaluation.value("mean_length") for evaluation in last], 1)
            rows.append((job, " and ".join(corrected) or "nothing", percent, length))
    heads = ("job", "corrected", "success, %", "mean length")
    table("**From each of the 2,880 start states**, after training", heads, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=10, help="How many, from 0.")
    seeds = parser.parse_args().seeds
    found = {job: run(job, overrides, seeds) for job, overrides in JOBS.items()}
    for job in PUBLISHED:
        print_moments(job, found[job])
    for job in REWARDS:
        print_rewards(job, found[job])
    print_curves(found)
    print_ends(found)
    print_corrections(seeds)


if __name__ == "__main__":
    main()
