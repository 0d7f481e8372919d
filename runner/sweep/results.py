"""The results of a sweep: its trials by value, which parameters mattered, and the best configuration.

The importance of a parameter is its share of the objective's variance (functional ANOVA): F. Hutter, H. Hoos
and K. Leyton-Brown, "An efficient approach for assessing hyperparameter importance", ICML 2014. A completed
grid is decomposed exactly, into the share of each parameter alone and of each pair beyond that; otherwise
Optuna's random forests estimate the share of each parameter alone. Shares are not normalized: the rest is due
to several parameters together.
"""

from __future__ import annotations

import itertools
import json
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, cast, get_args

import numpy as np

from runner.analysis import statistics
from runner.analysis.sections import Answer, Grid, Section
from runner.analysis.statistics import Estimate, bounded
from runner.errors import RunnerError
from runner.sweep.model import Parameter, Range, Sweep, count_of, points_of, samples_of
from runner.sweep.state import read_sweep
from runner.sweep.trials import State, Trial, Trials, best_of, recorded_trials, require_optuna
from runner.util.arrays import Floats
from runner.util.extras import require
from runner.util.humanize import UNKNOWN, counted
from runner.util.values import Json

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

# --- which parameters mattered ------------------------------------------------------------------------

FORESTS: Final = 30
TREES: Final = 5
MAX_DEPTH: Final = 5
"""Of the trees: without it 500 trials take a minute, and no share changes by more than 0.02."""
RESAMPLES: Final = 200
MIN_TRIALS: Final = 4


@dataclass(frozen=True)
class Effect:
    """The effect on the objective of one parameter, or, in a grid, of two beyond what each does alone."""

    parameters: tuple[str, ...]
    share: float
    """Share of the variance; from forests, the median over them."""
    low: float
    high: float
    """The interval of 95 % of the forests, each of resampled trials; of a whole grid, of resampled seeds."""


def effects_of(
    parameters: Mapping[str, Parameter], trials: Sequence[Mapping[str, object]], values: Sequence[float]
) -> list[Effect]:
    """Return the main effects, found by forests of resampled trials, the largest first.

    Empty for too few trials, or if no value differs.
    The parameters are the values tried, by path; the values are the objective of each trial, finite.
    """
    optuna = require_optuna()
    require("sklearn.ensemble", extra="sweep", purpose="the importance of a sweep's parameters")
    if len(trials) < MIN_TRIALS:
        return []
    names = list(parameters)
    space = {name: _distribution(parameter) for name, parameter in parameters.items()}
    tried = [
        optuna.trial.create_trial(
            params={name: _coded(parameters[name], trial[name]) for name in names},
            distributions=space,
            value=value,
        )
        for trial, value in zip(trials, values, strict=True)
    ]
    rng = np.random.default_rng(0)
    all_shares: list[dict[tuple[str, ...], float]] = []
    for forest in range(FORESTS):
        resampled = rng.integers(0, len(trials), len(trials)).tolist()
        if len({values[trial] for trial in resampled}) > 1:
            study = optuna.create_study()
            study.add_trials([tried[trial] for trial in resampled])
            evaluator = optuna.importance.FanovaImportanceEvaluator(
                n_trees=TREES, max_depth=MAX_DEPTH, seed=forest
            )
            shares = evaluator.evaluate(study, names)
            all_shares.append({(name,): share for name, share in shares.items()})
    return _effects(all_shares)


def effects_of_grid(
    parameters: Mapping[str, Parameter], seed_values: Sequence[Sequence[float]]
) -> list[Effect]:
    """Return main effects and interactions of a grid whose points were all completed, without a forest.

    `seed_values` is the objective at each seed, finite, of each point; the last parameter changes fastest.
    The interval is over resampled seeds.
    """
    shape = tuple(map(count_of, parameters.values()))
    names = list(parameters)
    rng = np.random.default_rng(0)

    def shares_of(points: Iterable[Floats]) -> dict[tuple[str, ...], float]:
        shares = shares_of_variance(np.array(list(map(np.median, points))).reshape(shape))
        return {tuple(names[axis] for axis in axes): share for axes, share in shares.items()}

    points = list(map(np.asarray, seed_values))
    resampled = [shares_of(rng.choice(values, len(values)) for values in points) for _ in range(RESAMPLES)]
    exact = shares_of(points)
    return _effects([shares for shares in resampled if shares], exact) if exact else []


def shares_of_variance(values: Floats) -> dict[tuple[int, ...], float]:
    """Return the share of the variance over a full grid of each axis, (i,), and of each pair, (i, j).

    The interaction of two axes is the variance of their joint means beyond the two main effects. Empty if
    the values do not vary.
    """
    total = float(values.var())
    axes = range(values.ndim)
    if total <= 1e-12 * max(1.0, float(np.abs(values).max()) ** 2):
        return {}

    def explained(*kept: int) -> float:
        others = tuple(axis for axis in axes if axis not in kept)
        return float(values.mean(axis=others).var()) / total

    shares: dict[tuple[int, ...], float] = {(i,): explained(i) for i in axes}
    for i, j in itertools.combinations(axes, 2):
        shares[i, j] = max(0.0, explained(i, j) - shares[i,] - shares[j,])
    return shares


def _effects(
    resampled: Sequence[Mapping[tuple[str, ...], float]], exact: Mapping[tuple[str, ...], float] | None = None
) -> list[Effect]:
    """Return each exact share, or the median of those resampled, with its interval, the largest first."""
    effects = []
    if resampled:
        for parameters in resampled[0]:
            shares = [shares_of_sample[parameters] for shares_of_sample in resampled]
            low, middle, high = np.quantile(shares, [0.025, 0.5, 0.975]).tolist()
            effects.append(Effect(parameters, exact[parameters] if exact else middle, low, high))
    return sorted(effects, key=lambda effect: -effect.share)


def _distribution(parameter: Parameter) -> BaseDistribution:
    """Return where the coded values of a parameter lie, in the logarithm for one that is drawn from it."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution

    if isinstance(parameter, Range):
        return FloatDistribution(_coded(parameter, parameter.low), _coded(parameter, parameter.last))
    return CategoricalDistribution(list(dict.fromkeys(_coded(parameter, choice) for choice in parameter)))


def _coded(parameter: Parameter, value: object) -> float | str:
    """Return a value for Optuna's fANOVA, which takes no logarithms itself: a number, or a choice as JSON."""
    if isinstance(parameter, Range):
        number = float(cast("float", value))
        return math.log(number) if parameter.log else number
    return json.dumps(value, sort_keys=True)


# --- the results --------------------------------------------------------------------------------------

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
            self.sweep.file.search_strategy.is_grid
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
        if self.best is None:
            return []
        trial = f"the configuration of trial {self.best.number}, with seeds not searched"
        return [f"--write-best FILE writes {trial}."]

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
    effects_shown = [effect for effect in effects if len(effect.parameters) == 1 or effect.share >= MIN_SHARE]
    rows = [
        (
            " x ".join(effect.parameters),
            "alone" if len(effect.parameters) == 1 else "together, beyond each alone",
            f"{100 * effect.share:.0f} %",
            f"{100 * effect.low:.0f} to {100 * effect.high:.0f} %",
        )
        for effect in effects_shown
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
    if hidden := len(effects) - len(effects_shown):
        notes.append(f"{hidden} pairs of less than {100 * MIN_SHARE:.0f} % are left out.")
    return [Section("What mattered", notes, [Grid(("parameter", "", "share", "95 %"), rows)])]


def _heading(results: Results, trials: int) -> list[str]:
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
        *([f"The best {trials} of {len(ranking):,}; --all shows all."] if trials < len(ranking) else []),
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
