"""What came of a sweep: its trials by value, what mattered, and the best configuration."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np

from runner.analysis.compare import statistics
from runner.analysis.compare.statistics import Estimate
from runner.analysis.sections import Grid, Section
from runner.sweep.importance import Effect, effects_of, effects_of_grid
from runner.sweep.model import Sweep
from runner.sweep.trials import State, Trial, Trials, best_of, recorded

SHOWN: Final = 20
SMALLEST_SHOWN: Final = 0.01
"""Interactions of a smaller share are not listed."""
CONFIRMING: Final = 10
"""Seeds in the file of the best configuration."""


@dataclass(frozen=True)
class Ranked:
    """A trial beside the others."""

    number: int
    values: dict[str, Any]
    state: State
    median: float | None
    """Over the seeds; infinite for a level never reached; None without a value."""
    iqm: Estimate
    """The interquartile mean over the seeds, and its interval; nan for fewer than four."""
    low: float | None
    high: float | None
    """The lowest and the highest of the seeds."""
    seeds: dict[int, float]
    runs: dict[int, str]
    errors: list[str]
    again: list[int]
    """Later trials that tried the same values, and so are the same."""


@dataclass(frozen=True)
class Results:
    """What is known of a sweep."""

    sweep: Sweep
    trials: int
    """How many there are to be."""
    ranking: list[Ranked]
    """The finished ones from the best on, then those given up, unfinished, failed and excluded."""
    found: list[Trial]
    """All trials so far, in the order they were suggested."""
    best: Trial | None

    @cached_property
    def effects(self) -> list[Effect]:
        """Shares of the variance explained by each parameter and each pair, the largest first.

        Computed when first read: it takes longer than everything else here.

        Raises:
            MissingExtra: scikit-learn is not installed.
        """
        parameters = self.sweep.file.parameters
        if _is_whole_grid(self.sweep, self.found):
            return effects_of_grid(parameters, [list(trial.seed_values.values()) for trial in self.found])
        completed = [
            (trial.values, trial.value)
            for trial in self.found
            if trial.state == "finished" and trial.value is not None and abs(trial.value) < statistics.NEVER
        ]
        return effects_of(parameters, [values for values, _ in completed], [value for _, value in completed])

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
    return Results(sweep, trials.search.trials, ranking(sweep, found), found, best_of(found, sweep))


def _is_whole_grid(sweep: Sweep, trials: Sequence[Trial]) -> bool:
    """Return whether every point of a grid was completed, each seed with a finite value."""
    return (
        sweep.file.strategy == "grid"
        and len(trials) == sweep.file.grid_points
        and all(trial.state == "finished" for trial in trials)
        and all(abs(value) < statistics.NEVER for trial in trials for value in trial.seed_values.values())
    )


def ranking(sweep: Sweep, trials: Sequence[Trial]) -> list[Ranked]:
    """Return the trials, the best first; those of the same values once."""
    order = get_args(State)
    alike: dict[str, list[Trial]] = {}
    for trial in trials:
        alike.setdefault(json.dumps(trial.values, sort_keys=True), []).append(trial)

    def key(same: list[Trial]) -> tuple[int, float, int]:
        state, value = same[0].state, same[0].value
        return (
            order.index(state),
            math.inf if value is None else -sweep.objective.sign * value,
            same[0].number,
        )

    return [_ranked(same) for same in sorted(alike.values(), key=key)]


def yaml_of(sweep: Sweep, trial: Trial) -> str:
    """Return a trial's configuration as a file that can be run, with seeds that the search has not seen.

    It records steps, to be looked at.
    """
    config = sweep.config(
        trial.values
        | {"name": f"{sweep.name}_best", "recording.steps": "all", "seeds": fresh_seeds(sweep.seeds)}
    )
    seeds = len(trial.results)
    head = (
        f"# Trial {trial.number} of the sweep {sweep.name}: {words(trial.values)}.\n"
        f"# {sweep.objective.described}: {reading(trial.value)}, the median over {seeds} seeds.\n"
        "# The best of many trials is also the luckiest on the seeds that it was chosen by, so the seeds\n"
        "# below are others: what comes out of them is what to expect.\n"
    )
    return head + config.to_yaml()


def fresh_seeds(searched: Sequence[int]) -> list[int]:
    """Return `CONFIRMING` seeds that are not among those searched: the next ones, if there are."""
    first = max(searched) + 1
    if first + CONFIRMING <= 2**64:
        return list(range(first, first + CONFIRMING))
    used = set(searched)
    return list(itertools.islice((seed for seed in itertools.count() if seed not in used), CONFIRMING))


def sections(results: Results, shown: int | None = SHOWN) -> list[Section]:
    """Return the results as sections of text.

    Args:
        results: of a sweep.
        shown: how many trials; None for all.

    Raises:
        MissingExtra: scikit-learn is not installed.
    """
    return [*ranking_sections(results, shown), *effects_sections(results)]


def ranking_sections(results: Results, shown: int | None = SHOWN) -> list[Section]:
    """Return the ranking and the trials without a value as sections of text; arguments as for `sections`."""
    ranked = results.ranking[:shown]
    grid = _ranking_grid(results.sweep, ranked)
    found = [Section(f"Sweep {results.sweep.name}", _heading(results, len(ranked)), [grid])]
    for state, title in (("failed", "Failed"), ("excluded", "Left out: these values do not go together")):
        told = _errors([entry for entry in results.ranking if entry.state == state])
        found += [Section(title, told)] if told else []
    return found


def effects_sections(results: Results) -> list[Section]:
    """Return main effects and interactions as a table; none if too little is known.

    Small interactions are left out.

    Raises:
        MissingExtra: scikit-learn is not installed.
    """
    if not results.effects:
        return []
    shown = [
        effect for effect in results.effects if len(effect.parameters) == 1 or effect.share >= SMALLEST_SHOWN
    ]
    rows = [
        (
            " x ".join(effect.parameters),
            "alone" if len(effect.parameters) == 1 else "together, beyond each alone",
            f"{100 * effect.share:.0f} %",
            f"{100 * effect.low:.0f} to {100 * effect.high:.0f} %",
        )
        for effect in shown
    ]
    rest = max(0.0, 1.0 - sum(effect.share for effect in results.effects))
    completed = sum(1 + len(entry.again) for entry in results.ranking if entry.state == "finished")
    whole = results.sweep.file.strategy == "grid" and completed == results.sweep.file.grid_points
    source = (
        "over the grid, all of whose points were completed; the interval is over resampled seeds"
        if whole
        else f"over the whole search space, as random forests predict it from the {completed} completed "
        "trials; trials that were given up or failed do not count, and the interval is over forests of "
        "resampled trials"
    )
    said = [
        f"Shares of the objective's variance (functional ANOVA) {source}. Shares are not normalised"
        + (
            f": about {100 * rest:.0f} % are left to three and more parameters."
            if len(results.sweep.file.parameters) > 2
            else "."
        )
    ]
    left_out = len(results.effects) - len(shown)
    said += [f"{left_out} pairs of less than {100 * SMALLEST_SHOWN:.0f} % are left out."] if left_out else []
    return [Section("What mattered", said, [Grid(("parameter", "", "share", "95 %"), rows)])]


def _errors(entries: Sequence[Ranked]) -> list[str]:
    """Return why trials came to nothing, those of one reason together."""
    alike: dict[str, list[str]] = {}
    for entry in entries:
        alike.setdefault(entry.errors[0], []).append(str(entry.number))
    return [f"Trial {', '.join(numbers)}: {error}" for error, numbers in alike.items()]


def _heading(results: Results, shown: int) -> list[str]:
    """Return what there was of a sweep, and what its ranking shows."""
    sweep, ranking = results.sweep, results.ranking
    states = [entry.state for entry in ranking for _ in range(1 + len(entry.again))]
    told = ", ".join(f"{states.count(s)} {s}" for s in get_args(State) if s in states) or "none begun"
    again = sum(len(entry.again) for entry in ranking)
    seeds = "1 seed" if len(sweep.seeds) == 1 else f"{len(sweep.seeds)} seeds"
    return [
        f"{sweep.file.strategy}, {results.trials:,} trials ({told}), {seeds} each. "
        f"Objective: {sweep.objective.described}.",
        *([f"{again} trials tried values again, and are shown once."] if again else []),
        *([f"The best {shown} of {len(ranking):,}; --all shows all."] if shown < len(ranking) else []),
    ]


def _ranking_grid(sweep: Sweep, ranked: Sequence[Ranked]) -> Grid:
    """Return the ranking as a table; the interquartile mean only where there are seeds enough."""
    means = any(not math.isnan(entry.iqm.value) for entry in ranked)
    headings = ("trial", "median", "range", *(("IQM", "95 % interval") if means else ()))
    return Grid(
        (*headings, *sweep.file.parameters, "state"),
        [
            (
                str(entry.number),
                reading(entry.median),
                _between(entry.low, entry.high),
                *((reading(entry.iqm.value), _between(entry.iqm.low, entry.iqm.high)) if means else ()),
                *(spoken(value) for value in entry.values.values()),
                entry.state,
            )
            for entry in ranked
        ],
    )


def words(values: Mapping[str, Any]) -> str:
    """Return values in words: `step_size 0.25, discount 0.9`."""
    return ", ".join(f"{path} {spoken(value)}" for path, value in values.items())


def spoken(value: Any) -> str:
    """Return a value in a few characters, as a configuration would have it."""
    if isinstance(value, float):
        return f"{value:.4g}"
    return value if isinstance(value, str) else json.dumps(value)


def _between(low: float | None, high: float | None) -> str:
    return f"{reading(low)} to {reading(high)}" if reading(low) else ""


def reading(value: float | None) -> str:
    """Return what a trial is worth in words: `never` for a level that was not reached."""
    if value is None or math.isnan(value):
        return ""
    return "never" if math.isinf(statistics.bounded(value)) else f"{value:,.4g}"


def _ranked(alike: list[Trial]) -> Ranked:
    trial, *later = alike
    values = {seed: trial.seed_values[seed] for seed in sorted(trial.seed_values)}
    known = np.array([value for value in values.values() if not math.isnan(value)])
    return Ranked(
        trial.number,
        trial.values,
        trial.state,
        None if trial.value is None else statistics.bounded(trial.value),
        statistics.interquartile_mean(known),
        statistics.bounded(known.min()) if len(known) else None,
        statistics.bounded(known.max()) if len(known) else None,
        {seed: statistics.bounded(value) for seed, value in values.items()},
        {seed: trial.results[seed].run_id for seed in sorted(trial.results)},
        trial.errors,
        [same.number for same in later],
    )
