"""The contents of a sweep file, and the sweep that it describes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, Self

from pydantic import Discriminator, Field, Tag, model_validator

from runner.config import ExperimentConfig, from_mapping
from runner.config.model import SECTION_OF, Name, Seed, SeveralSeeds
from runner.config.values import ConfigSection, Count, refusal
from runner.sweep.parameters import MAX_TRIALS, Parameter
from runner.sweep.strategies import STRATEGIES, Strategy, StrategyName
from runner.util.values import Json, JsonView

At = Literal["last", "best", "area", "first_over"]
Direction = Literal["maximize", "minimize"]


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
        self.searched.check(self.strategy, self.trials, self.parameters)
        if self.pruning is not None and self.objective.at == "first_over":
            raise refusal(("pruning",), "found one, but objective.at is first_over, which can come late")
        return self

    @property
    def searched(self) -> Strategy:
        """How its values are tried."""
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
