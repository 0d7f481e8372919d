"""What an experiment is: the frozen object every part of a run is given.

Every value is present and no shorthand is left; what a file may say is in `runner.config.file`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from runner.config.schedules import Probability, StepSize
from runner.config.sections import (
    Environment,
    Evaluation,
    Hysteretic,
    InitialTable,
    Log,
    Quirks,
    Recording,
    Snapshots,
    WolfPhc,
)
from runner.config.values import Section, refusal
from runner.util.values import NAME_EXPECTED, NAME_PATTERN

Mode = Literal["cooperative", "competitive"]
Algorithm = Literal[
    "q_learning",
    "sarsa",
    "expected_sarsa",
    "double_q_learning",
    "hysteretic_q_learning",
    "wolf_phc",
    "random",
]
Tables = Literal["joint", "per_agent"]
Rewards = Literal["team", "individual"]
Exploration = Literal["shared", "independent"]

LEARNERS: dict[Mode, tuple[Tables, Rewards]] = {
    "cooperative": ("joint", "team"),
    "competitive": ("per_agent", "individual"),
}
"""What each mode is short for."""

EXPLORATION: dict[Tables, Exploration] = {"joint": "shared", "per_agent": "independent"}
"""The exploration of a file that does not name one: separate learners explore independently of each other."""

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


OWN_SECTIONS: dict[str, tuple[Algorithm, Section]] = {
    "hysteretic": ("hysteretic_q_learning", Hysteretic()),
    "wolf_phc": ("wolf_phc", WolfPhc()),
}
"""Sections that only one algorithm has: by key, which one, and what it is unless given."""


class Settings(Section):
    """What a file and the resolved experiment say in the same words."""

    env: Environment = Field(default=Environment(), description="The environment and its arguments.")
    algorithm: Algorithm = Field(
        default="q_learning", description="What learns (docs/algorithms.md), or random: nothing learns."
    )
    episodes: Annotated[int, Field(ge=0, le=10**12)] = Field(
        description="How many episodes to train for; 0 only evaluates the initial tables."
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
    initial_q: InitialTable = Field(
        default=0.0,
        description="The Q-tables' first values: a number, random (uniform in [0, 1) or in a range given), "
        "or the tables of a recorded run.",
    )
    evaluation: Evaluation | None = Field(
        default=Evaluation(every=1000, trials=200),
        description="Greedy trials during training, which never alter it; null for none.",
    )
    log: Log | None = Field(default=Log(), description="Reports on training; null for none.")
    snapshots: Snapshots = Field(
        default=Snapshots(), description="Q-tables in the recording; the first and last are always there."
    )
    recording: Recording = Field(default=Recording(), description="What is recorded and how it is packed.")
    quirks: Quirks = Field(
        default=Quirks(), description="The published tutorial's code taken at its word, to get its figures."
    )


class ExperimentConfig(Settings):
    """One experiment, resolved: every value present and checked, nothing to be changed.

    Make one with `load` or `from_mapping`. The paths of its attributes are the keys of the file.
    """

    name: Name
    tables: Tables
    rewards: Rewards
    exploration: Exploration
    """Whether one draw decides for all agents if they explore, or each agent has its own."""
    seeds: Seeds
    hysteretic: Hysteretic | None = None
    """Present if, and only if, the algorithm is Hysteretic Q-learning."""
    wolf_phc: WolfPhc | None = None
    """Present if, and only if, the algorithm is WoLF-PHC."""

    @property
    def mode(self) -> Mode | None:
        """The mode that `tables` and `rewards` spell out; None for independent learners on one reward."""
        return next((mode for mode, means in LEARNERS.items() if means == (self.tables, self.rewards)), None)

    @property
    def competitive(self) -> bool:
        """What the environment's `competitive` argument must be: whether each agent has its own reward."""
        return self.rewards == "individual"

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
        for key, (algorithm, _) in OWN_SECTIONS.items():
            if getattr(self, key) is not None and self.algorithm != algorithm:
                message = f"goes with algorithm: {algorithm}, found algorithm: {self.algorithm}. Remove it"
                raise refusal((key,), message)
        return self

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values, fit for JSON, which `from_mapping` takes back to an equal object.

        Sections of other algorithms are left out.
        """
        values = self.model_dump(
            mode="json", exclude={key for key in OWN_SECTIONS if getattr(self, key) is None}
        )
        return {key: values[key] for key in KEYS if key in values}

    def to_yaml(self) -> str:
        """Return `to_mapping` as YAML, which `load` takes back to an equal object."""
        from runner.config.document import write_yaml

        return write_yaml(self.to_mapping())


KEYS = (
    *("name", "env", "mode", "tables", "rewards", "algorithm", "episodes", "seed", "seeds"),
    *("step_size", "discount", "epsilon", "exploration", "initial_q", "hysteretic", "wolf_phc"),
    *("evaluation", "log", "snapshots", "recording", "quirks"),
)
"""The keys of a file in the order in which people read them."""
