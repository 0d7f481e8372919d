"""The contents of a sweep file, and the sweep that it describes.

A parameter is a list of values to try, or a range of numbers. A strategy is a row of `STRATEGIES`, from which
everything else follows: it proposes values by a sampler of Optuna, asked for a batch at a time. All problems
of a file are reported at once, with line and key.
"""

from __future__ import annotations

import itertools
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Final, Literal, Self

from pydantic import AfterValidator, Discriminator, Field, Tag, ValidationError, model_validator

from runner.config import ConfigError, ExperimentConfig, from_mapping, load
from runner.config.document import Document, Place, Problem, read_yaml, write_yaml
from runner.config.loading import experiment_in, put, read_text
from runner.config.model import SECTION_OF, Name, Seed, SeveralSeeds
from runner.config.schema import Schema, found, problems_at, problems_in, refuse, without_references
from runner.config.sections import ConfigSection, Count, refusal
from runner.config.shipped import config_path
from runner.errors import RunnerError
from runner.util.values import Json, JsonView

if TYPE_CHECKING:
    from optuna.samplers import BaseSampler

MAX_TRIALS: Final = 100_000


def _number_kind(value: object) -> str | None:
    if isinstance(value, float):
        return "number"
    return "integer" if isinstance(value, int) and not isinstance(value, bool) else None


Number = Annotated[
    Annotated[int, Field(ge=-(10**15), le=10**15), Tag("integer")] | Annotated[float, Tag("number")],
    Discriminator(_number_kind),
]


class Range(ConfigSection):
    """Numbers from `low` to `high`, both included; whole ones if both are whole."""

    low: Number = Field(description="The lowest value.")
    high: Number = Field(description="The highest value.")
    log: bool = Field(default=False, description="Draw evenly in the logarithm, for values over magnitudes.")
    step: Number | None = Field(default=None, description="Only low, low + step, ...; required by a grid.")

    @model_validator(mode="after")
    def _is_a_range(self) -> Self:
        if not self.low < self.high:
            raise refusal(("high",), f"found {self.high:g}, expected a number above low, {self.low:g}")
        if self.log and self.low <= 0:
            raise refusal(("low",), f"found {self.low:g}, expected a number above 0: log is true")
        if self.step is not None and self.step <= 0:
            raise refusal(("step",), f"found {self.step:g}, expected a number above 0")
        if self.log and self.step is not None:
            raise refusal(("step",), f"found {self.step:g}, but log is true: leave out one of them")
        return self

    @property
    def is_integer(self) -> bool:
        """Whether its values are whole numbers."""
        return all(isinstance(bound, int) for bound in (self.low, self.high, self.step or 1))

    @property
    def steps(self) -> int:
        """The number of whole steps from `low` up to `high`."""
        low, high, step = (Decimal(str(number)) for number in (self.low, self.high, self.step or 1))
        return int((high - low) / step)

    def at(self, number: int) -> int | float:
        """Return the value after this number of steps, in decimal arithmetic: 0.3, not 0.1 + 0.2."""
        value = Decimal(str(self.low)) + number * Decimal(str(self.step or 1))
        return int(value) if self.is_integer else float(value)

    def nearest(self, value: float) -> int | float:
        """Return the value of whole steps next to one that was added up in floating point."""
        return value if self.step is None else self.at(round((value - self.low) / self.step))

    @property
    def last(self) -> int | float:
        """The highest value that whole steps reach."""
        return self.high if self.step is None else self.at(self.steps)


def _parameter_kind(value: object) -> str | None:
    if isinstance(value, Mapping | Range):
        return "Range"
    return "array" if isinstance(value, list | tuple) else None


_Choices = Annotated[list[object], Field(min_length=1)]
Parameter = Annotated[
    Annotated[_Choices, Tag("array")] | Annotated[Range, Tag("Range")], Discriminator(_parameter_kind)
]
"""The values to try: each of a list, or numbers of a range."""


def count_of(parameter: Parameter) -> int:
    """Return the number of values that a grid tries of a parameter."""
    return parameter.steps + 1 if isinstance(parameter, Range) else len(parameter)


def points_of(parameters: Iterable[Parameter]) -> int:
    """Return the number of points of the grid of these parameters."""
    return math.prod(map(count_of, parameters))


def samples_of(parameter: Parameter) -> Sequence[object]:
    """Return the choices of a parameter, or the first and the last value of its range."""
    return (parameter.at(0), parameter.last) if isinstance(parameter, Range) else parameter


# --- strategies ---------------------------------------------------------------------------------------


def _check_search(strategy: str, trials: int | None, _: Mapping[str, Parameter]) -> None:
    if trials is None:
        raise refusal(("trials",), f"missing, expected a whole number: {strategy} has no end")


def _check_grid(_: str, trials: int | None, parameters: Mapping[str, Parameter]) -> None:
    if trials is not None:
        raise refusal(("trials",), f"found {trials}, but a grid tries all of its points")
    for name, parameter in parameters.items():
        if isinstance(parameter, Range) and parameter.step is None and not parameter.is_integer:
            raise refusal(("parameters", name), "found a range without step: a grid needs one")
        if isinstance(parameter, Range) and parameter.log:
            raise refusal(("parameters", name, "log"), "found true, but a grid has steps")
    if points_of(parameters.values()) > MAX_TRIALS:
        message = (
            f"found a grid of more points than {MAX_TRIALS:,}: take larger steps, or a strategy that "
            "tries some of them"
        )
        raise refusal(("parameters",), message)


@dataclass(frozen=True)
class Strategy:
    """How the values of trials are found."""

    text: str
    """The values that it tries, for the help of the key `strategy` and the documentation."""
    sampler: Callable[[ModuleType, int, int], BaseSampler]
    """Returns the sampler, from the module `optuna.samplers`, the size of a batch and a seed of 32 bits."""
    check: Callable[[str, int | None, Mapping[str, Parameter]], None] = _check_search
    """Refuses a number of trials, or parameters, that do not fit the strategy, which has this name."""
    is_grid: bool = False
    """Whether it tries every point of a grid, rather than a number of trials."""
    is_adaptive: bool = True
    """Whether its suggestions depend on earlier results, so that it is asked for one batch at a time."""
    skips_repeats: bool = False
    """Whether it draws again what it suggested before, unless the sweep has `repeats`."""


STRATEGIES: Final = {
    "grid": Strategy(
        "all combinations",
        lambda samplers, _, seed: samplers.RandomSampler(seed=seed),  # its points are given to Optuna
        _check_grid,
        is_grid=True,
        is_adaptive=False,
    ),
    "random": Strategy(
        "`trials` combinations, drawn independently",
        lambda samplers, _, seed: samplers.RandomSampler(seed=seed),
        is_adaptive=False,
    ),
    "tpe": Strategy(
        "`trials` combinations, by a tree-structured Parzen estimator of good values",
        lambda samplers, batch, seed: samplers.TPESampler(seed=seed, n_startup_trials=2 * batch),
        skips_repeats=True,
    ),
    "genetic": Strategy(
        "`trials` combinations, by the genetic algorithm NSGA-II; a batch is a generation",
        lambda samplers, batch, seed: samplers.NSGAIISampler(population_size=max(2, batch), seed=seed),
    ),
}
"""By the name in a sweep's file."""


def _known(name: str) -> str:
    if name not in STRATEGIES:
        raise ValueError(name)  # reported by the choices of the schema
    return name


StrategyName = Annotated[str, AfterValidator(_known), Field(json_schema_extra={"enum": [*STRATEGIES]})]
"""The name of a strategy."""


At = Literal["last", "best", "area", "first_over"]
Direction = Literal["maximize", "minimize"]


# --- the contents of a sweep file ---------------------------------------------------------------------


class Objective(ConfigSection):
    """The value of a trial: the median over its seeds of a metric at a moment."""

    metric: str = Field(
        default="success_percent",
        min_length=1,
        description="A recorded metric, such as success_percent, mean_length, mean_return.taxi_1 or "
        "exact.success_percent.",
    )
    at: At = Field(
        default="last",
        description="last: the last evaluation. best: the best one. area: the mean over training, by area "
        "under the curve. first_over: the number of episodes until `level` is first reached.",
    )
    level: float | None = Field(default=None, description="The level for first_over.")
    direction: Direction = Field(
        default="maximize", description="Whether larger or smaller values are better."
    )

    @model_validator(mode="after")
    def _level_goes_with_first_over(self) -> Self:
        if self.at == "first_over" and self.level is None:
            raise refusal(("level",), "found null, expected a number: at is first_over")
        if self.at == "first_over" and self.direction == "maximize":
            message = "found 'maximize', expected 'minimize': first_over counts episodes until a level"
            raise refusal(("direction",), message)
        if self.at != "first_over" and self.level is not None:
            raise refusal(("level",), f"found {self.level:g}, but at is {self.at}: only first_over has one")
        return self

    @property
    def sign(self) -> float:
        """1 if more is better, else -1."""
        return 1.0 if self.direction == "maximize" else -1.0

    @property
    def description(self) -> str:
        """The objective as text: `exact.success_percent, last, maximize`."""
        at = f"first at {self.level:g}" if self.at == "first_over" else self.at
        return f"{self.metric}, {at}, {self.direction}"


class Pruning(ConfigSection):
    """When a run is stopped early: its best reading so far is worse than that of most trials by then."""

    after: Count = Field(description="Number of training episodes before a run may be pruned.")
    trials: Count = Field(default=5, description="Number of finished trials before any run may be pruned.")
    percentile: Annotated[float, Field(gt=0, lt=100)] = Field(
        default=50.0,
        description="Prune runs that are worse than this share of the finished trials, in percent.",
    )


class SweepLimits(ConfigSection):
    """Limits at which a sweep stops; it can be resumed after they are raised."""

    runs: Count | None = Field(default=None, description="Maximum number of runs.")
    seconds: Annotated[float, Field(gt=0)] | None = Field(default=None, description="Maximum time.")
    disk: Count | None = Field(default=None, description="Maximum bytes of all its recordings.")


_Base = Annotated[
    Annotated[str, Tag("path")] | Annotated[dict[str, object], Tag("mapping")],
    Discriminator(lambda value: {str: "path", dict: "mapping"}.get(type(value))),
]


class SweepFile(ConfigSection):
    """A sweep as a YAML file describes it."""

    name: Name | None = Field(
        default=None, description="Name of the sweep; the name of the file without its ending unless given."
    )
    base: _Base = Field(
        description="The experiment: a configuration, or the path of one, relative to this file."
    )
    strategy: StrategyName = Field(
        description=" ".join(f"{name}: {strategy.text}." for name, strategy in STRATEGIES.items())
    )
    parameters: Annotated[dict[str, Parameter], Field(min_length=1)] = Field(
        description="By path of the configuration, such as evaluation.trials: a list, or low and high."
    )
    trials: Annotated[int, Field(ge=1, le=MAX_TRIALS)] | None = Field(
        default=None, description="Number of trials; a grid tries all of its points."
    )
    batch: Annotated[int, Field(ge=1, le=10_000)] = Field(
        default=10,
        description="Number of trials suggested at once; a generation, if genetic. Suggestions depend on the "
        "batches before, and therefore not on the number of workers.",
    )
    seeds: SeveralSeeds = Field(
        default=(0,), description="Seeds of every trial: a list, or the first and the number of them."
    )
    repeats: bool = Field(
        default=False,
        description="Whether tpe may suggest values again, as in sweeps from before this key existed.",
    )
    search_seed: Seed = Field(default=0, description="Seed of the search.")
    objective: Objective = Field(default=Objective(), description="The value to optimize.")
    pruning: Pruning | None = Field(
        default=None, description="When to stop runs that fall behind; null: never."
    )
    limits: SweepLimits = Field(default=SweepLimits(), description="Limits at which the sweep stops.")
    recording: Json = Field(
        default_factory=lambda: {"steps": "none"},
        description="Overrides of the base's `recording`. By default steps are not recorded; `dualtaxi "
        "rerecord` records those of single runs later.",
    )

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        self.search_strategy.check(self.strategy, self.trials, self.parameters)
        if self.pruning is not None and self.objective.at == "first_over":
            raise refusal(("pruning",), "found one, but objective.at is first_over, which can come late")
        return self

    @property
    def search_strategy(self) -> Strategy:
        """How the values of its trials are found."""
        return STRATEGIES[self.strategy]


@dataclass(frozen=True)
class Sweep:
    """A sweep, checked against its configuration."""

    name: str
    file: SweepFile
    """The file with the whole base, without the defaults that depend on a parameter of the sweep."""
    base: ExperimentConfig
    """The experiment, with the sweep's seeds and recording."""

    @property
    def objective(self) -> Objective:
        """The value to optimize."""
        return self.file.objective

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds of every trial."""
        return self.base.seeds

    @property
    def start_of_trials(self) -> dict[str, object]:
        """The base as plain values, which a trial's values override."""
        assert isinstance(self.file.base, dict)
        return self.file.base

    def config(self, values: JsonView) -> ExperimentConfig:
        """Return the experiment with these values of the parameters."""
        changes = [f"{path}={json.dumps(value)}" for path, value in self.applicable(values).items()]
        return from_mapping(self.start_of_trials, changes)

    def applicable(self, values: Mapping[str, object]) -> dict[str, object]:
        """Return the values without those in the section of another algorithm than the one they name."""
        if "algorithm" not in values:
            return dict(values)  # the configuration reports sections of other algorithms
        others = {key for key, section in SECTION_OF.items() if section.algorithm != values["algorithm"]}
        return {path: value for path, value in values.items() if path.partition(".")[0] not in others}

    def to_mapping(self) -> Json:
        """Return plain values, fit for JSON and YAML, from which `from_values` builds an equal sweep."""
        return self.file.model_dump(mode="json") | {"name": self.name}


# --- reading a sweep file -----------------------------------------------------------------------------

MAX_NAME: Final = 50
"""The longest name of a sweep, which is part of a tag of its runs."""
_LEARNERS: Final = {"mode", "tables", "rewards"}
_MAX_COMBINATIONS: Final = 64
"""Maximum number of combinations tried to find values that are valid together."""
Checks = Mapping[str, Callable[[ExperimentConfig], object]]
"""By key of a configuration, such as `env`, a function that may refuse its value by a `RunnerError`."""
NO_CHECKS: Final[Checks] = {}


def load_sweep(path: str | os.PathLike[str], name: str | None = None, checks: Checks = NO_CHECKS) -> Sweep:
    """Return the sweep that a YAML file describes, or a shipped one such as `modes`.

    The name replaces the one in the file, or the file's own without its ending. The `ConfigError` of a bad
    file has a line for each problem, with file, line, column and key; `checks` as for `from_text`.
    """
    file = config_path(path)
    document = read_yaml(read_text(file), str(file))
    return _checked(_sweep(document, name, file.stem, file.parent), document, checks)


def from_text(text: str, source: str, checks: Checks = NO_CHECKS) -> Sweep:
    """Return the sweep that the text of a file describes, which cannot name another file as its base.

    `source` is the file's name, for messages and as the default name of the sweep; errors as of `load_sweep`.
    The checks are called with the base, and with experiments before their environments are made.
    """
    document = read_yaml(text, source)
    return _checked(_sweep(document, None, Path(source).stem, None), document, checks)


def from_values(values: Mapping[str, object]) -> Sweep:
    """Return the sweep that plain values describe, as `Sweep.to_mapping` returns them.

    Its parameters were checked when it was loaded; no environment is made to check them again.
    """
    return _sweep(Document(dict(values)), None, "sweep", Path())


def self_contained_text(path: str | os.PathLike[str]) -> str:
    """Return the text of an experiment or a sweep, with a base that is another file written out."""
    text = read_text(Path(path))
    values = read_yaml(text, str(path)).value
    if isinstance(values, Mapping) and isinstance(values.get("base"), str):
        return write_yaml(load_sweep(path).to_mapping())
    return text


@cache
def _schema() -> Schema:
    return without_references(SweepFile.model_json_schema())


def _sweep(document: Document, name: str | None, stem: str, folder: Path | None) -> Sweep:
    if not isinstance(document.value, Mapping):
        problem = Problem(
            (), f"found {found(document.value)}, expected keys and values, such as base and trials"
        )
        raise refuse([*document.problems, problem], document)
    if "base" not in document.value and "episodes" in document.value:
        message = "found an experiment, expected a sweep: `dualtaxi run` runs it"
        raise refuse([Problem((), message)], document)
    try:
        file = SweepFile.model_validate(dict(document.value))
        problems = document.problems
    except ValidationError as error:
        problems = [*document.problems, *problems_in(error, document.value, _schema())]
    if problems:
        errors = [refuse(problems, document)]
        if isinstance(document.value.get("base"), Mapping):
            try:
                experiment_in(_part(document, "base"), (), stem, named_by=repr(stem))
            except ConfigError as error:
                errors.append(error)
        raise _combined(errors)
    sweep_name = name or file.name or stem
    if len(sweep_name) > MAX_NAME:
        message = f"found {len(sweep_name)} characters, expected at most {MAX_NAME}: runs carry it"
        raise refuse([Problem(("name",), message)], Document(name) if name else document)
    base, values = _base(file, document, sweep_name, folder)
    resolved = file.model_copy(update={"name": sweep_name, "base": values})
    return Sweep(sweep_name, resolved, base)


def _combined(errors: Sequence[ConfigError]) -> ConfigError:
    """Return one error with the lines and problems of several, each once."""
    lines = dict.fromkeys(line for error in errors for line in str(error).split("\n"))
    problems = dict.fromkeys(problem for error in errors for problem in error.problems)
    return ConfigError("\n".join(lines), tuple(problems))


def _base(
    file: SweepFile, document: Document, name: str, folder: Path | None
) -> tuple[ExperimentConfig, dict[str, object]]:
    """Return the base with the sweep's name, seeds and recording, and the values that trials start from."""
    if isinstance(file.base, str):
        if folder is None:
            message = f"found the path {file.base!r}, expected the configuration itself: there is no folder"
            raise refuse([Problem(("base",), message)], document)
        path = folder / file.base
        with problems_at(("base",), document, ConfigError):
            text = read_text(path)
        load(path)  # reports every problem at its place in that file
        within = read_yaml(text, str(path))
    else:
        within = _part(document, "base")
    seeds = file.model_dump(mode="json")["seeds"]
    places = _places(document.places, "recording")
    recorded = {key: Document(value, _places(places, key)) for key, value in file.recording.items()}
    put(
        within,
        [
            (("name",), Document(name)),
            (("seeds",), Document(seeds, _places(document.places, "seeds"))),
            *((("recording", key), value) for key, value in recorded.items()),
        ],
    )
    base = experiment_in(within, (), name, named_by=repr(name))
    return base, _start_of_trials(base, given=within.value, parameters=file.parameters)


def _start_of_trials(
    base: ExperimentConfig, given: Mapping[str, object], parameters: Mapping[str, object]
) -> dict[str, object]:
    """Return the base as plain values, without the defaults that depend on a parameter of the sweep.

    The default of `exploration` depends on the learners, and the section of an algorithm on the algorithm:
    where these are searched over, each trial gets the default for its values.
    """
    values = base.to_mapping()
    followers = {"exploration": _LEARNERS} | {key: {"algorithm"} for key in SECTION_OF}
    for key, leaders in followers.items():
        if key not in given and leaders & set(parameters):
            values.pop(key, None)
    return values


def _part(document: Document, key: str) -> Document:
    """Return the part of a document under a key, with its places."""
    return Document(document.value.get(key), _places(document.places, key))


def _places(places: Mapping[tuple[str, ...], Place], key: str) -> dict[tuple[str, ...], Place]:
    return {where[1:]: place for where, place in places.items() if where[:1] == (key,)}


def _checked(sweep: Sweep, document: Document, checks: Checks) -> Sweep:
    """Return the sweep; try every bound and choice of each parameter, with values of the others that fit."""
    from runner.environments.loading import load_mdp

    for key, check in checks.items():
        with problems_at(("base", key), document, RunnerError):
            check(sweep.base)
    if not any(path.split(".")[0] == "env" for path in sweep.file.parameters):
        with problems_at(("base", "env", "id"), document, RunnerError):
            load_mdp(sweep.base.env.id, sweep.base.env.kwargs, sweep.base.rewards)
    errors = []
    for path, parameter in sweep.file.parameters.items():
        for number, sample in enumerate(samples_of(parameter)):
            try:
                experiment = _valid_experiment(sweep, path, sample, document)
                if number == 0 or path.split(".")[0] in ("env", "initial_q"):
                    with problems_at(("parameters", path, number), document, RunnerError):
                        for check in checks.values():
                            check(experiment)
                        load_mdp(experiment.env.id, experiment.env.kwargs, experiment.rewards)
            except ConfigError as error:
                errors.append(error)
    if errors:
        raise _combined(errors)
    return sweep


def _valid_experiment(sweep: Sweep, path: str, sample: object, document: Document) -> ExperimentConfig:
    """Return an experiment with a value of a parameter, and the first values of the others valid with it."""
    samples = {
        key: [sample] if key == path else samples_of(sweep_values)
        for key, sweep_values in sweep.file.parameters.items()
    }
    problem = None
    for values in itertools.islice(itertools.product(*samples.values()), _MAX_COMBINATIONS):
        try:
            return _experiment(sweep, dict(zip(samples, values, strict=True)), document)
        except ConfigError as error:
            problem = problem or error
    assert problem is not None
    raise problem


def _experiment(sweep: Sweep, values: Mapping[str, object], document: Document) -> ExperimentConfig:
    """Return the base with values; errors name the places of the parameters."""
    within = Document(sweep.start_of_trials)
    places = {path: document.place(("parameters", path)) for path in values}
    put(
        within,
        [
            (tuple(path.split(".")), Document(value, {(): place} if (place := places[path]) else {}))
            for path, value in sweep.applicable(values).items()
        ],
    )
    return experiment_in(within, (), sweep.name, named_by=repr(sweep.name))
