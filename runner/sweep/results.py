"""What came of a sweep: its trials by value, what mattered, and the best configuration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from runner.analysis.compare import statistics
from runner.analysis.compare.statistics import Estimate
from runner.analysis.sections import Grid, Section
from runner.sweep.model import Sweep
from runner.sweep.trials import Trial, Trials, best_of, recorded

SHOWN: Final = 20


@dataclass(frozen=True)
class Ranked:
    """A trial beside the others."""

    number: int
    values: dict[str, Any]
    state: str
    median: float | None
    """Over the seeds; infinite for a level never reached; None without a value."""
    iqm: Estimate
    """The interquartile mean over the seeds, and its interval; nan for fewer than four."""
    seeds: dict[int, float]
    runs: dict[int, str]
    errors: list[str]


@dataclass(frozen=True)
class Results:
    """What is known of a sweep."""

    sweep: Sweep
    trials: int
    """How many there are to be."""
    ranking: list[Ranked]
    """The finished ones from the best on, then those that were given up, unfinished or failed."""
    importance: dict[str, float]
    """How much each parameter decides; summing up to 1, or empty."""
    best: Trial | None

    @property
    def best_yaml(self) -> str | None:
        """The best configuration as a file that can be run; None without a finished trial."""
        return None if self.best is None else yaml_of(self.sweep, self.best)


def results_of(sweep: Sweep, recordings: Path) -> Results:
    """Return what came of a sweep so far.

    Raises:
        RunnerError: a run cannot be read.
        MissingExtra: Optuna or SciPy is not installed.
    """
    statistics.require_scipy()
    trials = Trials(sweep)
    found = list(recorded(trials, recordings))
    return Results(
        sweep, trials.search.trials, ranking(sweep, found), trials.search.importance(), best_of(found, sweep)
    )


def ranking(sweep: Sweep, trials: Sequence[Trial]) -> list[Ranked]:
    """Return the trials, the best first."""
    order = ("finished", "pruned", "unfinished", "failed")

    def key(trial: Trial) -> tuple[int, float, int]:
        value = trial.value
        return (
            order.index(trial.state),
            math.inf if value is None else -sweep.objective.sign * value,
            trial.number,
        )

    return [_ranked(trial) for trial in sorted(trials, key=key)]


def yaml_of(sweep: Sweep, trial: Trial) -> str:
    """Return a trial's configuration as a file that can be run, recording as the base does."""
    config = sweep.config(trial.values)
    head = (
        f"# Trial {trial.number} of the sweep {sweep.name}: {words(trial.values)}.\n"
        f"# {sweep.objective.described}: {trial.value:g}, the median over {len(trial.results)} seeds.\n"
    )
    return head + config.to_yaml()


def sections(results: Results, shown: int | None = SHOWN) -> list[Section]:
    """Return the results as sections of text.

    Args:
        results: of a sweep.
        shown: how many trials; None for all.
    """
    ranked = results.ranking[:shown]
    counts = {
        state: sum(r.state == state for r in results.ranking) for state in ("finished", "pruned", "failed")
    }
    told = ", ".join(f"{count} {state}" for state, count in counts.items() if count) or "none finished"
    sweep = results.sweep
    left = len(results.ranking) - len(ranked)
    heading = [
        f"{sweep.file.strategy}, {results.trials:,} trials ({told}), {len(sweep.seeds)} seeds each. "
        f"Objective: {sweep.objective.described}.",
        *([f"The best {len(ranked)} of {len(results.ranking):,}; --all shows all."] if left else []),
    ]
    grid = Grid(
        ("trial", "median", "IQM", "95 % interval", *sweep.file.parameters, "state"),
        [_row(entry) for entry in ranked],
    )
    errors = [f"Trial {entry.number}: {entry.errors[0]}" for entry in ranked if entry.errors]
    found = [
        Section(f"Sweep {sweep.name}", heading, [grid]),
        *([Section("Failed", errors)] if errors else []),
    ]
    if results.importance:
        shares = [(path, f"{100 * share:.0f} %") for path, share in results.importance.items()]
        found.append(
            Section(
                "What mattered",
                ["Share of what decides (PED-ANOVA)."],
                [Grid(("parameter", "share"), shares)],
            )
        )
    return found


def words(values: Mapping[str, Any]) -> str:
    """Return values in words: `step_size 0.25, discount 0.9`."""
    return ", ".join(f"{path} {spoken(value)}" for path, value in values.items())


def spoken(value: Any) -> str:
    """Return a value in a few characters."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _row(entry: Ranked) -> tuple[str, ...]:
    low, high = _number(entry.iqm.low), _number(entry.iqm.high)
    return (
        str(entry.number),
        _number(entry.median),
        _number(entry.iqm.value),
        f"{low} to {high}" if low else "",
        *(spoken(value) for value in entry.values.values()),
        entry.state,
    )


def _number(value: float | None) -> str:
    if value is None or math.isnan(value):
        return ""
    return "never" if math.isinf(value) else f"{value:,.4g}"


def _ranked(trial: Trial) -> Ranked:
    values = {seed: trial.seed_values[seed] for seed in sorted(trial.seed_values)}
    known = np.array([value for value in values.values() if not math.isnan(value)])
    return Ranked(
        trial.number,
        trial.values,
        trial.state,
        None if trial.value is None else statistics.bounded(trial.value),
        statistics.interquartile_mean(known),
        {seed: statistics.bounded(value) for seed, value in values.items()},
        {seed: trial.results[seed].run_id for seed in sorted(trial.results)},
        trial.errors,
    )
