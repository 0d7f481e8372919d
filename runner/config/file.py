"""What a file may say of an experiment: its shorthands (`mode`, `seed`), and what may be left out.

The JSON Schema describes this form; `runner.config.loading` spells it out as an `ExperimentConfig`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Self

from pydantic import BeforeValidator, Discriminator, Field, Tag, model_validator

from runner.config.model import Exploration, Mode, Name, Rewards, Seed, Seeds, Settings, Tables
from runner.config.sections import Hysteretic, WolfPhc
from runner.config.values import Section, refusal


class SeedRange(Section):
    """Consecutive seeds."""

    first: Seed = Field(default=0, description="The first seed.")
    count: Annotated[int, Field(ge=1, le=100_000)] = Field(description="How many seeds.")

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


def _not_null(value: object) -> object:
    if value is None:
        raise ValueError
    return value


def _given(kind: object) -> BeforeValidator:
    """Keep null out of a file: a key's None means that the file leaves it out."""
    return BeforeValidator(_not_null, json_schema_input_type=kind)


class ExperimentFile(Settings):
    """An experiment as a YAML file describes it."""

    name: Annotated[Name | None, _given(Name)] = Field(
        default=None, description="What the runs are called: the file's name without its ending unless given."
    )
    mode: Annotated[Mode | None, _given(Mode)] = Field(
        default=None,
        description="cooperative (the default): one joint table learns from the summed reward. "
        "competitive: each agent has its own table and reward. "
        "Short for `tables` and `rewards`, which may be given instead.",
    )
    tables: Annotated[Tables | None, _given(Tables)] = Field(
        default=None, description="One table over joint actions, or one for each agent. Follows `rewards`."
    )
    rewards: Annotated[Rewards | None, _given(Rewards)] = Field(
        default=None,
        description="The team's summed reward for all, or each agent's own. Follows `tables`.",
    )
    exploration: Annotated[Exploration | None, _given(Exploration)] = Field(
        default=None,
        description="independent (the default with `tables: per_agent`): each agent decides by a draw of its "
        "own whether to explore. shared: one draw decides for all agents, so that they explore at the same "
        "steps, as in the published tutorial. A joint table is one learner: both are the same.",
    )
    hysteretic: Annotated[Hysteretic | None, _given(Hysteretic)] = Field(
        default=None, description="Only with algorithm: hysteretic_q_learning."
    )
    wolf_phc: Annotated[WolfPhc | None, _given(WolfPhc)] = Field(
        default=None, description="Only with algorithm: wolf_phc."
    )
    seed: Annotated[Seed | None, _given(Seed)] = Field(
        default=None, description="What every random draw follows from; 0 unless given. One run."
    )
    seeds: Annotated[SeveralSeeds | None, _given(SeveralSeeds)] = Field(
        default=None, description="Several seeds instead of one: a list, or the first and how many."
    )
