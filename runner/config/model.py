"""What an experiment is: the frozen object every part of a run is given, and what a file may say.

`ExperimentFile` is the form of a file, with its shorthands (`mode`, `seed`) and what may be left out;
the JSON Schema describes it. `ExperimentConfig` is what it means: every value present, no shorthand.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    PlainSerializer,
    PlainValidator,
    Tag,
    WithJsonSchema,
    model_validator,
)

from runner.config.schedules import Probability, StepSize
from runner.config.values import Count, FrozenMapping, Section, frozen, plain, refusal

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

LEARNERS: dict[Mode, tuple[Tables, Rewards]] = {
    "cooperative": ("joint", "team"),
    "competitive": ("per_agent", "individual"),
}
"""What each mode is short for."""

NAME_PATTERN = r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}$"
NAME_EXPECTED = "1 to 100 letters, digits, '_', '.' or '-', not starting with '.' or '-'"
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


def _environment_arguments(value: object) -> FrozenMapping:
    if not isinstance(value, Mapping):
        raise ValueError
    if "competitive" in value:
        message = "is never set by hand: it follows from `mode` (or `rewards`). Remove it and set `mode`"
        raise refusal(("competitive",), message)
    arguments = frozen(value)
    assert isinstance(arguments, FrozenMapping)
    return arguments


class Environment(Section):
    """Which environment, and what it is made with."""

    id: str = Field(
        default="dualtaxi:DualTaxi-v1",
        min_length=1,
        description="The Gymnasium id; what stands before a colon is the module to import for it.",
    )
    kwargs: Annotated[
        FrozenMapping,
        PlainValidator(_environment_arguments),
        PlainSerializer(plain),
        WithJsonSchema({"type": "object", "propertyNames": {"not": {"const": "competitive"}}, "default": {}}),
    ] = Field(
        default_factory=lambda: FrozenMapping({}),
        description="Arguments of the environment. `competitive` is not one: it follows from the rewards.",
    )


class UniformRange(Section):
    """Where random initial values are drawn from: uniform in [low, high)."""

    low: float = Field(default=0.0, description="The lowest value.")
    high: float = Field(default=1.0, description="The bound above; never drawn itself.")

    @model_validator(mode="after")
    def _has_width(self) -> Self:
        if not self.low < self.high:
            raise refusal(("high",), f"found {self.high:g}, expected a number above low, {self.low:g}")
        return self


class RandomTable(Section):
    """Initial values drawn at random, each cell on its own."""

    random: UniformRange = Field(description="Where the values are drawn from.")


class RunTable(Section):
    """Initial values taken from a recorded run."""

    run: str = Field(min_length=1, description="The recorded run: its name, id or file.")
    step: Annotated[int, Field(ge=0, le=10**12)] | None = Field(
        default=None, description="The training step to take the table at; null is the last."
    )


def _table_kind(value: object) -> str | None:
    if isinstance(value, Section):
        return type(value).__name__
    if isinstance(value, Mapping) and value:
        return "RandomTable" if "random" in value else "RunTable"
    return "number" if isinstance(value, int | float) else None


def _spelled_out(value: object) -> object:
    return {"random": {}} if value == "random" else value


_InitialTable = Annotated[
    Annotated[float, Tag("number")]
    | Annotated[RandomTable, Tag("RandomTable")]
    | Annotated[RunTable, Tag("RunTable")],
    Discriminator(_table_kind),
]
InitialTable = Annotated[
    _InitialTable,
    BeforeValidator(_spelled_out, json_schema_input_type=Literal["random"] | _InitialTable),
]


def _trial_start(value: object) -> object:
    state = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**31
    if value in ("random", "each") or state:
        return value
    raise refusal((), f"found {value!r:.60}, expected 'random', 'each', or a state's number from 0")


TrialStart = Annotated[
    Literal["random", "each"] | int,
    PlainValidator(_trial_start),
    WithJsonSchema({"anyOf": [{"enum": ["random", "each"]}, {"type": "integer", "minimum": 0}]}),
]


class Evaluation(Section):
    """When the greedy policy is tried out, and how often each time."""

    every: Count = Field(description="Training episodes between evaluations.")
    trials: Annotated[int, Field(ge=1, le=10**6)] = Field(description="Greedy episodes in an evaluation.")
    start: TrialStart = Field(
        default="random",
        description="The states that trials start in: random, as training episodes do; each of the "
        "environment's start states in turn; or the state of this number.",
    )
    exact: bool = Field(
        default=False,
        description="Whether the greedy policy is measured exactly besides, over all start states and "
        "against the optimum, from the environment's transition table. Needs a discount below 1 for "
        "discounted values; with 1 these are not a number.",
    )


class Log(Section):
    """When training reports on itself, and over what."""

    every_steps: Count = Field(default=50_000, description="Training steps between reports.")
    window: Annotated[int, Field(ge=1, le=10**8)] = Field(
        default=50_000, description="How many of the last training steps the reward distribution counts."
    )
    episodes: Annotated[int, Field(ge=1, le=10**6)] = Field(
        default=50, description="How many of the last episodes the mean length is taken over."
    )


class Snapshots(Section):
    """When the Q-tables are written to the recording as they are."""

    every: Count | None = Field(
        default=None,
        description="Training episodes between snapshots; null takes only those before and after training. "
        "A table at any other step is computed from the nearest snapshot and the recorded steps.",
    )


class Recording(Section):
    """What the recording holds, and how it is packed."""

    steps: Literal["all", "none"] = Field(
        default="all", description="Whether environment steps are recorded: all, or none (measures only)."
    )
    compression: Literal["zstd", "lz4", "none"] = Field(
        default="zstd", description="How the chunks of a recording are compressed."
    )
    level: Annotated[int, Field(ge=-7, le=19)] | None = Field(
        default_factory=lambda chosen: 3 if chosen.get("compression") == "zstd" else None,
        description="The level of zstd, from -7 (fast) to 19 (small); 3 unless given. Only with zstd.",
    )
    index: Literal["message", "chunk"] = Field(
        default="message",
        description="message: every message, as some readers need. chunk: only chunks, 16 bytes a step less.",
    )
    chunk_steps: Annotated[int, Field(ge=256, le=65_536)] = Field(
        default=16_384, description="The most steps in one chunk; fewer when chunks are flushed by the clock."
    )

    @model_validator(mode="after")
    def _level_goes_with_zstd(self) -> Self:
        if self.level is None and self.compression == "zstd":
            raise refusal(("level",), "found null, expected a whole number from -7 to 19: zstd has a level")
        if self.level is not None and self.compression != "zstd":
            message = (
                f"found {self.level}, but compression is {self.compression}: only zstd has levels. Remove it"
            )
            raise refusal(("level",), message)
        return self


class Quirks(Section):
    """Where the code of the published tutorial differs from its text; each off unless asked for."""

    epsilon_exploits: bool = Field(
        default=False,
        description="Take epsilon as the probability of exploiting: the agents explore with 1 - epsilon.",
    )
    second_table_uses_first_action: bool = Field(
        default=False,
        description="Update the second agent's table at the first agent's action. Needs tables: per_agent.",
    )
    bootstrap_after_termination: bool = Field(
        default=False,
        description="Add the discounted value of the next state to the target even after termination.",
    )


class Hysteretic(Section):
    """Hysteretic Q-learning's second step size; the first is `step_size`."""

    decrease: Probability = Field(
        default=0.01,
        description="The step size of updates that lower a value, from 0 to 1; those that raise it take "
        "`step_size`, which is to be the greater.",
    )


class WolfPhc(Section):
    """How fast WoLF-PHC moves its policy towards the greedy action: it wins or learns fast."""

    win: StepSize = Field(
        default=0.05,
        description="How much probability an update moves while the policy wins; at most `lose`.",
    )
    lose: StepSize = Field(default=0.2, description="How much it moves while the policy loses.")

    @model_validator(mode="after")
    def _wins_slowly(self) -> Self:
        if isinstance(self.win, float) and isinstance(self.lose, float) and self.win > self.lose:
            raise refusal(("win",), f"found {self.win:g}, expected at most lose, {self.lose:g}")
        return self


OWN_SECTIONS: dict[str, tuple[Algorithm, Section]] = {
    "hysteretic": ("hysteretic_q_learning", Hysteretic()),
    "wolf_phc": ("wolf_phc", WolfPhc()),
}
"""Sections that only one algorithm has: by key, which one, and what it is unless given."""


class _Settings(Section):
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
    exploration: Literal["shared", "independent"] = Field(
        default="shared",
        description="Whether one draw decides for all agents if they explore, or each agent has its own.",
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


class ExperimentConfig(_Settings):
    """One experiment, resolved: every value present and checked, nothing to be changed.

    Make one with `load` or `from_mapping`. The paths of its attributes are the keys of the file.
    """

    name: Name
    tables: Tables
    rewards: Rewards
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
        draws = self.algorithm in ("random", "wolf_phc")
        if draws and self.evaluation is not None and self.evaluation.exact:
            message = (
                f"found true, but the algorithm is {self.algorithm}, which draws: only a greedy policy is "
            )
            message += "measured exactly"
            raise refusal(("evaluation", "exact"), message)
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


_SeveralSeeds = Annotated[
    Annotated[Seeds, Tag("array")] | Annotated[SeedRange, Tag("SeedRange")], Discriminator(_seeds_kind)
]


def _not_null(value: object) -> object:
    if value is None:
        raise ValueError
    return value


def _given(kind: object) -> BeforeValidator:
    """Keep null out of a file: a key's None means that the file leaves it out."""
    return BeforeValidator(_not_null, json_schema_input_type=kind)


class ExperimentFile(_Settings):
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
    hysteretic: Annotated[Hysteretic | None, _given(Hysteretic)] = Field(
        default=None, description="Only with algorithm: hysteretic_q_learning."
    )
    wolf_phc: Annotated[WolfPhc | None, _given(WolfPhc)] = Field(
        default=None, description="Only with algorithm: wolf_phc."
    )
    seed: Annotated[Seed | None, _given(Seed)] = Field(
        default=None, description="What every random draw follows from; 0 unless given. One run."
    )
    seeds: Annotated[_SeveralSeeds | None, _given(_SeveralSeeds)] = Field(
        default=None, description="Several seeds instead of one: a list, or the first and how many."
    )


KEYS = (
    *("name", "env", "mode", "tables", "rewards", "algorithm", "episodes", "seed", "seeds"),
    *("step_size", "discount", "epsilon", "exploration", "initial_q", "hysteretic", "wolf_phc"),
    *("evaluation", "log", "snapshots", "recording", "quirks"),
)
"""The keys of a file in the order in which people read them."""
