"""An experiment: what a YAML file may contain, and the resolved object that every part of a run uses.

`ExperimentFile` has the shorthands (`mode`, `seed`) and keys that may be left out; `runner.config.loading`
resolves it to an `ExperimentConfig`, where every value is present. With one seed it is a `Job`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, Self, get_args

from blake3 import blake3
from pydantic import AfterValidator, Discriminator, Field, Tag, ValidationError, model_validator

from runner.config.document import write_yaml
from runner.config.sections import (
    Algorithm,
    AlgorithmSection,
    BranchSection,
    ConfigSection,
    Environment,
    EvaluationSection,
    Exploration,
    Hysteretic,
    InitialTable,
    Log,
    NStep,
    Optional,
    Probability,
    Quirks,
    RecordingSection,
    SarsaLambda,
    Snapshots,
    StepSize,
    WolfPhc,
    refusal,
)
from runner.util.values import NAME_EXPECTED, NAME_PATTERN, Json, JsonView

Mode = Literal["cooperative", "competitive"]
Tables = Literal["joint", "per_agent"]
Rewards = Literal["team", "individual"]

MAX_BRANCHES: Final = 1000

LEARNERS: Final[dict[Mode, tuple[Tables, Rewards]]] = {
    "cooperative": ("joint", "team"),
    "competitive": ("per_agent", "individual"),
}
"""The tables and rewards of each mode."""

EXPLORATION: Final[dict[Tables, Exploration]] = {"joint": "shared", "per_agent": "independent"}
"""The default exploration: separate learners explore independently of each other."""

Name = Annotated[str, Field(pattern=NAME_PATTERN, json_schema_extra={"patternErrorMessage": NAME_EXPECTED})]


def _unique(seeds: tuple[int, ...]) -> tuple[int, ...]:
    seen: set[int] = set()
    for position, seed in enumerate(seeds):
        if seed in seen:
            raise refusal((position,), f"found {seed} for the second time, expected each seed once")
        seen.add(seed)
    return seeds


Seed = Annotated[int, Field(ge=0, le=2**64 - 1)]
Seeds = Annotated[
    tuple[Seed, ...],
    Field(strict=False, min_length=1, json_schema_extra={"uniqueItems": True}),
    AfterValidator(_unique),
]


class SeedRange(ConfigSection):
    """Consecutive seeds."""

    first: Seed = Field(default=0, description="The first seed.")
    count: Annotated[int, Field(ge=1, le=100_000)] = Field(description="Number of seeds.")

    @model_validator(mode="after")
    def _last_is_a_seed(self) -> Self:
        if self.first + self.count > 2**64:
            raise refusal(("count",), f"found {self.count}, expected the last seed to stay below 2^64")
        return self


def _seeds_kind(value: object) -> str | None:
    if isinstance(value, Mapping | SeedRange):
        return "SeedRange"
    return "array" if isinstance(value, list | tuple) else None


SeveralSeeds = Annotated[
    Annotated[Seeds, Tag("array")] | Annotated[SeedRange, Tag("SeedRange")], Discriminator(_seeds_kind)
]


def _only_with(section: type[AlgorithmSection]) -> Any:
    return Field(default=None, description=f"Only with algorithm: {section.algorithm}.")


class Settings(ConfigSection):
    """The keys that a file and the resolved experiment share, in the order in which people read them."""

    name: Optional[Name] = Field(
        default=None, description="Name of the runs; the name of the file without its ending unless given."
    )
    env: Environment = Field(default=Environment(), description="The environment and its arguments.")
    tables: Optional[Tables] = Field(
        default=None, description="One table over joint actions, or one for each agent. Follows `rewards`."
    )
    rewards: Optional[Rewards] = Field(
        default=None, description="The team's summed reward for all, or each agent's own. Follows `tables`."
    )
    algorithm: Algorithm = Field(
        default="q_learning",
        description="The learning algorithm (docs/algorithms.md), or random: nothing is learned.",
    )
    episodes: Annotated[int, Field(ge=0, le=10**12)] = Field(
        description="Number of training episodes; 0 only evaluates the initial tables."
    )
    seeds: Optional[SeveralSeeds] = Field(
        default=None, description="Several seeds instead of one: a list, or the first and the number of them."
    )
    step_size: StepSize = Field(
        default=0.1, description="How far an update moves a value towards its target: above 0, at most 1."
    )
    discount: Probability = Field(
        default=0.95, description="How much the next state's value counts, from 0 to 1."
    )
    epsilon: Probability = Field(
        default=0.1, description="The probability of exploring: of acting at random instead of greedily."
    )
    exploration: Optional[Exploration] = Field(
        default=None,
        description="independent (the default with `tables: per_agent`): each agent decides by a draw of its "
        "own whether to explore. shared: one draw decides for all agents, so that they explore at the same "
        "steps, as in the published tutorial. A joint table is one learner: both are the same.",
    )
    initial_q: InitialTable = Field(
        default=0.0,
        description="The Q-tables' first values: a number, random (uniform in [0, 1) or in a range given), "
        "or the tables of a recorded run.",
    )
    hysteretic: Optional[Hysteretic] = _only_with(Hysteretic)
    wolf_phc: Optional[WolfPhc] = _only_with(WolfPhc)
    sarsa_lambda: Optional[SarsaLambda] = _only_with(SarsaLambda)
    n_step: Optional[NStep] = _only_with(NStep)
    evaluation: EvaluationSection | None = Field(
        default=EvaluationSection(every=1000, trials=200),
        description="Greedy trials during training, which never alter it; null for none.",
    )
    log: Log | None = Field(default=Log(), description="Reports on training; null for none.")
    snapshots: Snapshots = Field(
        default=Snapshots(), description="Q-tables in the recording; the first and last are always there."
    )
    recording: RecordingSection = Field(
        default=RecordingSection(), description="What is recorded and how it is packed."
    )
    quirks: Quirks = Field(
        default=Quirks(), description="Deviations of the published tutorial's code, to reproduce its figures."
    )
    branches: Annotated[tuple[BranchSection, ...], Field(strict=False, max_length=MAX_BRANCHES)] = Field(
        default=(),
        description="Steps at which training was changed, as `dualtaxi branch` writes them; the steps before "
        "the first are those of the run that was branched.",
    )


class ExperimentFile(Settings):
    """An experiment as a YAML file describes it."""

    mode: Optional[Mode] = Field(
        default=None,
        description="cooperative (the default): one joint table learns from the summed reward. "
        "competitive: each agent has its own table and reward. "
        "Short for `tables` and `rewards`, which may be given instead.",
    )
    seed: Optional[Seed] = Field(
        default=None, description="The seed of every random draw; 0 unless given. One run."
    )


_BEFORE: Final = {"tables": "mode", "seeds": "seed"}
"""The shorthands of a file, each by the key that it stands before."""
KEYS: Final = tuple(
    key for shared in Settings.model_fields for key in (_BEFORE.get(shared), shared) if key is not None
)
"""The keys of a file in the order in which people read them."""

SECTION_OF: Final[dict[str, type[AlgorithmSection]]] = {
    key: section
    for key, field in Settings.model_fields.items()
    for section in get_args(field.annotation)
    if isinstance(section, type) and issubclass(section, AlgorithmSection)
}
"""The sections that only one algorithm has, by key."""


class ExperimentConfig(Settings):
    """One experiment, resolved: every value is present, checked and frozen.

    Make one with `load` or `from_mapping`. The paths of its attributes are the keys of the file.
    """

    name: Name
    tables: Tables
    rewards: Rewards
    seeds: Seeds
    exploration: Exploration
    """Whether one draw decides for all agents if they explore, or each agent has its own."""

    @property
    def mode(self) -> Mode | None:
        """The mode that `tables` and `rewards` spell out; None for independent learners on one reward."""
        return next((mode for mode, means in LEARNERS.items() if means == (self.tables, self.rewards)), None)

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if (self.tables, self.rewards) == ("joint", "individual"):
            message = "found 'individual', expected 'team': one joint table cannot learn from two rewards"
            raise refusal(("rewards",), message)
        if self.quirks.second_table_uses_first_action and self.tables == "joint":
            message = "needs tables: per_agent (or mode: competitive), found tables: joint"
            raise refusal(("quirks", "second_table_uses_first_action"), message)
        if self.quirks.second_table_uses_first_action and self.algorithm not in ("q_learning", "random"):
            message = f"needs algorithm: q_learning, found algorithm: {self.algorithm}"
            raise refusal(("quirks", "second_table_uses_first_action"), message)
        if self.algorithm == "hysteretic_q_learning" and self.tables == "joint":
            message = (
                "found 'hysteretic_q_learning', which is for learners that do not see each other's actions, "
                "but there is one joint table: set tables: per_agent (and rewards: team) or mode: competitive"
            )
            raise refusal(("algorithm",), message)
        for key, section in SECTION_OF.items():
            if getattr(self, key) is not None and self.algorithm != section.algorithm:
                message = (
                    f"goes with algorithm: {section.algorithm}, found algorithm: {self.algorithm}. Remove it"
                )
                raise refusal((key,), message)
        return self

    @model_validator(mode="after")
    def _branches_fit(self) -> Self:
        for position, branch in enumerate(self.branches):
            try:
                self.from_step(branch.step)
            except ValidationError as error:
                (detail, *_) = error.errors(include_url=False, include_input=False)
                path = (*detail["loc"], *detail.get("ctx", {}).get("path", ()))
                raise refusal(("branches", position, "settings", *path), detail["msg"]) from None
        return self

    def from_step(self, step: int) -> ExperimentConfig:
        """Return the experiment with the settings that training has at a step, and without branches."""
        if not self.branches:
            return self
        changes: dict[str, object] = {}
        for branch in sorted(self.branches, key=lambda branch: branch.step):
            if branch.step <= step:
                changes |= branch.settings.given
        values = {key: value for key, value in self if key not in self._unused}
        return ExperimentConfig.model_validate(values | {"branches": ()} | changes)

    @property
    def _unused(self) -> set[str]:
        """The keys that this experiment has no value for."""
        return {key for key in (*SECTION_OF, "branches") if not getattr(self, key)}

    def to_mapping(self) -> Json:
        """Return plain values, fit for JSON, which `from_mapping` takes back to an equal object.

        Sections of other algorithms are left out, and `branches` if there are none.
        """
        return self.model_dump(mode="json", exclude=self._unused)

    def to_yaml(self) -> str:
        """Return `to_mapping` as YAML, which `load` takes back to an equal object."""
        return write_yaml(self.to_mapping())


NOT_CONTENT = ("name", "seeds", "recording")
"""Keys of a configuration that change neither what is learned nor what is recorded."""


@dataclass(frozen=True)
class Job:
    """One seed of an experiment."""

    config: ExperimentConfig
    seed: int

    @property
    def identity(self) -> str:
        """A hash of the values that determine the content of its recording; the name is none of them."""
        return identity_of(self.config.to_mapping(), self.seed)


def identity_of(config: JsonView, seed: int) -> str:
    """Return the identity of the job of a resolved configuration, given as plain values, and a seed."""
    content = {key: value for key, value in config.items() if key not in NOT_CONTENT} | {"seed": seed}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return blake3(text.encode()).hexdigest()[:32]


def jobs_of(config: ExperimentConfig) -> Iterator[Job]:
    """Yield the jobs of an experiment, one per seed."""
    for seed in config.seeds:
        yield Job(config, seed)
