"""The results of a sweep: its trials by value, which parameters mattered, and the best configuration."""

from __future__ import annotations

import itertools
import json
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, Final, get_args

import numpy as np

from runner.analysis import statistics
from runner.analysis.sections import Answer, Grid, Section
from runner.analysis.statistics import Estimate, bounded
from runner.errors import RunnerError
from runner.sweep.importance import Effect, effects_of, effects_of_grid
from runner.sweep.model import Sweep
from runner.sweep.parameters import points_of, samples_of
from runner.sweep.state import read_sweep
from runner.sweep.trials import State, Trial, Trials, best_of, recorded_trials
from runner.util.humanize import UNKNOWN, counted
from runner.util.values import Json

DEFAULT_SHOWN: Final = 20
MIN_SHARE: Final = 0.01
"""Interactions of a smaller share are not listed."""
FRESH_SEEDS: Final = 10
"""Seeds in the file of the best configuration."""


@dataclass(frozen=True)
class Ranked:
    """A trial in the ranking."""

    number: int
    values: Json
    state: State
    median: float | None
    """The median over the seeds; infinite for a level that was never reached; None without a value."""
    iqm: Estimate
    """The interquartile mean over the seeds, and its interval; NaN for fewer than four."""
    low: float | None
    high: float | None
    """The lowest and the highest value of the seeds."""
    seeds: dict[int, float]
    runs: dict[int, str]
    errors: list[str]
    duplicates: list[int]
    """Later trials of the same values, whose runs are the same."""


@dataclass(frozen=True)
class Results(Answer):
    """The results of a sweep so far."""

    sweep: Sweep
    trials: int
    """The number of trials of the whole sweep."""
    ranking: list[Ranked]
    """The finished trials from the best on, then those pruned, unfinished, failed and excluded."""
    suggested: list[Trial]
    """All trials so far, in the order in which they were suggested."""
    best: Trial | None
    shown: int | None = DEFAULT_SHOWN
    """Number of trials in the text; None for all."""

    @property
    def is_whole_grid(self) -> bool:
        """Whether every point of a grid was completed, each seed with a finite value."""
        return (
            self.sweep.file.searched.is_grid
            and len(self.suggested) == points_of(self.sweep.file.parameters.values())
            and all(trial.state == "finished" for trial in self.suggested)
            and all(_is_reached(value) for trial in self.suggested for value in trial.seed_values.values())
        )

    @cached_property
    def effects(self) -> list[Effect]:
        """Shares of the variance that parameters explain, and pairs in a completed grid, the largest first.

        Computed when first read: it takes longer than everything else here.
        """
        parameters = self.sweep.file.parameters
        if self.is_whole_grid:
            return effects_of_grid(parameters, [list(trial.seed_values.values()) for trial in self.suggested])
        unused = {path: samples_of(parameter)[0] for path, parameter in parameters.items()}
        completed = [
            (unused | trial.values, trial.value)
            for trial in self.suggested
            if trial.state == "finished" and trial.value is not None and _is_reached(trial.value)
        ]
        return effects_of(parameters, [values for values, _ in completed], [value for _, value in completed])

    @property
    def best_yaml(self) -> str | None:
        """The best configuration as a file that can be run; None without a finished trial."""
        return None if self.best is None else yaml_of(self.sweep, self.best)

    @property
    def hints(self) -> list[str]:
        """How the best configuration is written."""
        what = self.best and f"the configuration of trial {self.best.number}, with seeds not searched"
        return [f"--write-best FILE writes {what}."] if what else []

    def as_json(self) -> Json:
        """Return objective, ranking and effects, and the number of the best trial."""
        return {
            "name": self.sweep.name,
            "objective": self.sweep.objective.model_dump(mode="json"),
            "trials": self.trials,
            "ranking": [asdict(entry) for entry in self.ranking],
            "effects": [asdict(effect) for effect in self.effects],
            "best": self.best and self.best.number,
        }

    def sections(self) -> list[Section]:
        """Return the ranking, the trials without a value, and what mattered."""
        return [*ranking_sections(self), *effects_sections(self)]

    def write(self, stream: BinaryIO) -> None:
        """Write the best configuration."""
        if self.best_yaml is None:
            raise RunnerError(
                f"the sweep {self.sweep.name!r} has no finished trial yet, so there is no best one."
            )
        stream.write(self.best_yaml.encode())


def results_of(name: str, recordings: Path) -> Results:
    """Return the results of a sweep so far.

    Raises:
        RunnerError: there is none of this name, or its file is damaged.
    """
    sweep = read_sweep(name, recordings)
    statistics.require_scipy()
    trials = Trials(sweep)
    suggested = list(recorded_trials(trials, recordings))
    best = best_of(suggested, sweep)
    return Results(sweep, trials.search.trials, ranking(sweep, suggested), suggested, best)


def _is_reached(value: float) -> bool:
    return abs(value) < statistics.NEVER


def ranking(sweep: Sweep, trials: Sequence[Trial]) -> list[Ranked]:
    """Return the trials, the best first; those of the same values once."""
    by_values: defaultdict[str, list[Trial]] = defaultdict(list)
    for trial in trials:
        by_values[json.dumps(trial.values, sort_keys=True)].append(trial)
    order = get_args(State)

    def key(trials: list[Trial]) -> tuple[int, float, int]:
        first = trials[0]
        rank = math.inf if first.value is None else -sweep.objective.sign * first.value
        return order.index(first.state), rank, first.number

    return [_ranked(*same) for same in sorted(by_values.values(), key=key)]


def _ranked(trial: Trial, *duplicates: Trial) -> Ranked:
    by_seed = dict(sorted(trial.seed_values.items()))
    values = np.array([value for value in by_seed.values() if not math.isnan(value)])
    return Ranked(
        trial.number,
        trial.values,
        trial.state,
        None if trial.value is None else bounded(trial.value),
        statistics.interquartile_mean(values),
        bounded(values.min()) if len(values) else None,
        bounded(values.max()) if len(values) else None,
        {seed: bounded(value) for seed, value in by_seed.items()},
        {seed: result.run_id for seed, result in sorted(trial.results.items())},
        trial.errors,
        [same.number for same in duplicates],
    )


def yaml_of(sweep: Sweep, trial: Trial) -> str:
    """Return a trial's configuration as a file that can be run, with seeds that the search has not seen.

    Its runs record steps, so that they can be replayed.
    """
    name = f"{sweep.name}_best"
    seeds = fresh_seeds(sweep.seeds)
    config = sweep.config(trial.values | {"name": name, "recording.steps": "all", "seeds": seeds})
    result = f"{objective_text(trial.value)}, the median over {len(trial.results)} seeds"
    return (
        f"# Trial {trial.number} of the sweep {sweep.name}: {values_text(trial.values)}.\n"
        f"# {sweep.objective.description}: {result}.\n"
        "# The best of many trials is also the luckiest on the seeds by which it was chosen. The seeds\n"
        "# below are new: expect the results that they give.\n"
    ) + config.to_yaml()


def fresh_seeds(searched: Sequence[int]) -> list[int]:
    """Return `FRESH_SEEDS` seeds that are not among those searched: the next larger ones, if possible."""
    first = max(searched) + 1
    if first + FRESH_SEEDS <= 2**64:
        return list(range(first, first + FRESH_SEEDS))
    used = set(searched)
    return list(itertools.islice((seed for seed in itertools.count() if seed not in used), FRESH_SEEDS))


# --- as text ------------------------------------------------------------------------------------------


def ranking_sections(results: Results) -> list[Section]:
    """Return the ranking and the trials without a value as sections."""
    ranked = results.ranking[: results.shown]
    grid = _ranking_grid(results.sweep, ranked)
    result = [Section(f"Sweep {results.sweep.name}", _heading(results, len(ranked)), [grid])]
    for state, title in (("failed", "Failed"), ("excluded", "Excluded: these values contradict each other")):
        by_error: defaultdict[str, list[str]] = defaultdict(list)
        for entry in results.ranking:
            if entry.state == state:
                by_error[entry.errors[0]].append(str(entry.number))
        if by_error:
            lines = [f"Trial {', '.join(numbers)}: {error}" for error, numbers in by_error.items()]
            result.append(Section(title, lines))
    return result


def effects_sections(results: Results) -> list[Section]:
    """Return the effects of parameters as a table; nothing if there are too few trials.

    Small interactions are left out.
    """
    effects = results.effects
    if not effects:
        return []
    shown = [effect for effect in effects if len(effect.parameters) == 1 or effect.share >= MIN_SHARE]
    rows = [
        (
            " x ".join(effect.parameters),
            "alone" if len(effect.parameters) == 1 else "together, beyond each alone",
            f"{100 * effect.share:.0f} %",
            f"{100 * effect.low:.0f} to {100 * effect.high:.0f} %",
        )
        for effect in shown
    ]
    if results.is_whole_grid:
        source = "over the grid, all of whose points were completed; the interval is over resampled seeds"
    else:
        completed = sum(trial.state == "finished" for trial in results.suggested)
        source = (
            f"over the whole search space, as random forests predict it from the {completed} completed "
            "trials; pruned and failed trials do not count, and the interval is over forests of resampled "
            "trials"
        )
    note = f"Shares of the objective's variance (functional ANOVA) {source}. Shares are not normalized"
    largest, several = (2, "three and more") if results.is_whole_grid else (1, "several")
    if len(results.sweep.file.parameters) > largest:
        rest = max(0.0, 1.0 - sum(effect.share for effect in effects))
        note += f": about {100 * rest:.0f} % are left to {several} parameters together"
    notes = [f"{note}."]
    if hidden := len(effects) - len(shown):
        notes.append(f"{hidden} pairs of less than {100 * MIN_SHARE:.0f} % are left out.")
    return [Section("What mattered", notes, [Grid(("parameter", "", "share", "95 %"), rows)])]


def _heading(results: Results, shown: int) -> list[str]:
    sweep, ranking = results.sweep, results.ranking
    states = [trial.state for trial in results.suggested]
    counts = [f"{states.count(state)} {state}" for state in get_args(State) if state in states]
    duplicates = sum(len(entry.duplicates) for entry in ranking)
    tied = [entry for entry in ranking if entry.state == "finished" and entry.median == ranking[0].median]
    return [
        f"{sweep.file.strategy}, {results.trials:,} trials ({', '.join(counts) or 'none started'}), "
        f"{counted(len(sweep.seeds), 'seed')} each. Objective: {sweep.objective.description}.",
        *([f"{duplicates} trials repeated earlier values, and are listed with them."] if duplicates else []),
        *([f"{len(tied)} trials tie for the best; trial {tied[0].number} is the first."] if tied[1:] else []),
        *([f"The best {shown} of {len(ranking):,}; --all shows all."] if shown < len(ranking) else []),
    ]


def _ranking_grid(sweep: Sweep, ranked: Sequence[Ranked]) -> Grid:
    """Return the ranking as a table; the interquartile mean only where there are enough seeds."""
    has_means = any(not math.isnan(entry.iqm.value) for entry in ranked)
    headings = ("trial", "median", "range", *(("IQM", "95 % interval") if has_means else ()))
    rows = []
    for entry in ranked:
        iqm = entry.iqm
        rows.append(
            (
                str(entry.number),
                objective_text(entry.median),
                _between(entry.low, entry.high),
                *((objective_text(iqm.value), _between(iqm.low, iqm.high)) if has_means else ()),
                *(
                    value_text(entry.values[path]) if path in entry.values else UNKNOWN
                    for path in sweep.file.parameters
                ),
                entry.state,
            )
        )
    return Grid((*headings, *sweep.file.parameters, "state"), rows, status="state")


def values_text(values: Mapping[str, object]) -> str:
    """Return values as text: `step_size 0.25, discount 0.9`."""
    return ", ".join(f"{path} {value_text(value)}" for path, value in values.items())


def value_text(value: object) -> str:
    """Return a value in a few characters, as in a configuration."""
    if isinstance(value, float):
        return f"{value:.4g}"
    return value if isinstance(value, str) else json.dumps(value)


def _between(low: float | None, high: float | None) -> str:
    return f"{objective_text(low)} to {objective_text(high)}" if objective_text(low) else ""


def objective_text(value: float | None) -> str:
    """Return the value of a trial as text: `never` for a level that was not reached, empty without one."""
    if value is None or math.isnan(value):
        return ""
    return "never" if math.isinf(bounded(value)) else f"{value:,.4g}"
