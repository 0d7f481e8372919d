"""The sections of an experiment, such as `evaluation`, and parameters that may change while it runs.

A section is a frozen mapping of known keys. Its validators refuse a value with the path of its key. The
arguments of an environment are free: anything that JSON and YAML can hold.

A schedule is a function of n, the number of episodes (or training steps) before the current one,
counted from 0 over the whole run. These models describe the function; `runner.learning` computes it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Final, Literal, Self, TypeVar, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    GetCoreSchemaHandler,
    PlainSerializer,
    PlainValidator,
    Tag,
    WithJsonSchema,
    model_serializer,
    model_validator,
)
from pydantic_core import CoreSchema, PydanticCustomError

from runner.config.document import MAX_DEPTH, Path
from runner.errors import nearest
from runner.util.packing import (
    CODECS,
    MAX_CHUNK_STEPS,
    MIN_CHUNK_STEPS,
    Compression,
    Index,
    Packing,
)
from runner.util.values import Json

# --- what sections consist of ---------------------------------------------------------------------------

REFUSED = "refused"
"""The type of the errors of `refusal`; their message is shown to users unchanged."""

Count = Annotated[int, Field(ge=1, le=10**12)]
"""A number of episodes or steps, bounded so that sums and products of them fit in 64 bits."""

Fraction = Annotated[float, Field(ge=0, le=1)]


T = TypeVar("T")


class _NotNull:
    """Validates `X | None` as X: None is the default of a key that is left out, and no value of its own."""

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        return handler.generate_schema(get_args(source)[0])


Optional = Annotated[T | None, _NotNull()]
"""A key that may be left out, but not be null."""


class ConfigSection(BaseModel):
    """A frozen mapping of a configuration; unknown keys, wrong types, NaN and infinity are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


def refusal(path: Path, message: str) -> PydanticCustomError:
    """Return the error a validator raises to refuse the value at `path` below its own."""
    return PydanticCustomError(REFUSED, "{message}", {"message": message, "path": path})


class FrozenMapping(Mapping[str, Any]):
    """A read-only mapping that can be hashed, pickled and unpacked with `**`."""

    __slots__ = ("_items",)

    def __init__(self, items: Mapping[str, Any]) -> None:
        self._items = dict(items)

    def __getitem__(self, key: str) -> object:
        return self._items[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)

    def __hash__(self) -> int:
        return hash(frozenset(self._items.items()))

    def __repr__(self) -> str:
        return repr(self._items)


def frozen(value: object, path: Path = ()) -> object:
    """Return `value` with read-only mappings and lists; refuse what JSON cannot hold."""
    if len(path) > MAX_DEPTH:
        raise refusal(path[:1], f"nested deeper than {MAX_DEPTH} levels")
    if isinstance(value, Mapping):
        return FrozenMapping({_text(key, path): frozen(item, (*path, key)) for key, item in value.items()})
    if isinstance(value, list | tuple):
        return tuple(frozen(item, (*path, position)) for position, item in enumerate(value))
    if isinstance(value, str):
        return _text(value, path)
    if isinstance(value, int) and not -(2**63) <= value < 2**64:
        raise refusal(path, "found a whole number of more than 64 bits, expected one that fits")
    if value is None or isinstance(value, int) or (isinstance(value, float) and math.isfinite(value)):
        return value
    what = "a number that is not finite" if isinstance(value, float) else f"a Python {type(value).__name__}"
    raise refusal(path, f"found {what}, expected text, a number, true, false, null, a list or a mapping")


def plain(value: object) -> Any:
    """Return a frozen value as dictionaries and lists, which the caller may change."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


def _text(value: object, path: Path) -> str:
    if not isinstance(value, str):
        raise refusal(path, f"found the key {value!r}, expected text")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise refusal(path, f"found {value!r}, expected text that UTF-8 can hold") from None
    return value


# --- schedules ------------------------------------------------------------------------------------------

By = Annotated[
    Literal["episode", "step"], Field(description="What n counts: training episodes, or training steps.")
]
Floor = Annotated[Fraction, Field(description="The value never falls below this.")]
Start = Annotated[Fraction, Field(description="The value at n = 0.")]
Point = Annotated[
    tuple[Annotated[int, Field(ge=0, le=10**12)], Fraction], Field(strict=False, description="[n, value]")
]


def _names_itself(schema: Json) -> None:
    """Require the key `schedule` in a file, where it distinguishes the kinds; in Python the class does."""
    schema["required"] = ["schedule", *schema.get("required", [])]


class Linear(ConfigSection, json_schema_extra=_names_itself):
    """A straight line from `start` at n = 0 to `end` at n = `over`, and `end` from there on."""

    schedule: Literal["linear"] = Field(default="linear", description="A straight line, then constant.")
    start: Start
    end: Fraction = Field(description="The value at n = `over` and after.")
    over: Count = Field(description="How many episodes (or steps) the line takes.")
    by: By = "episode"
    floor: Floor = 0.0


class Exponential(ConfigSection, json_schema_extra=_names_itself):
    """Decay by a constant factor: `start` * `factor` ** n."""

    schedule: Literal["exponential"] = Field(default="exponential", description="Decay by a constant factor.")
    start: Start
    factor: Annotated[float, Field(gt=0, le=1)] = Field(
        description="What the value is multiplied by after each episode (or step)."
    )
    by: By = "episode"
    floor: Floor = 0.0


class Piecewise(ConfigSection, json_schema_extra=_names_itself):
    """Straight lines between points [n, value], and the last point's value from there on."""

    schedule: Literal["piecewise"] = Field(default="piecewise", description="Lines between points.")
    points: tuple[Point, ...] = Field(
        strict=False,
        min_length=1,
        description="Points [n, value]: the first at n = 0, each later than the one before.",
    )
    by: By = "episode"
    floor: Floor = 0.0

    @model_validator(mode="after")
    def _positions_increase(self) -> Self:
        if self.points[0][0] != 0:
            raise refusal(
                ("points", 0, 0), f"found {self.points[0][0]}, expected 0: the first point's position"
            )
        for index, (before, after) in enumerate(pairwise(self.points), start=1):
            if after[0] <= before[0]:
                message = f"found {after[0]}, expected a position after the one before, {before[0]}"
                raise refusal(("points", index, 0), message)
        return self


Schedule = Linear | Exponential | Piecewise
SCHEDULES: dict[str, str] = {"linear": "Linear", "exponential": "Exponential", "piecewise": "Piecewise"}


def _kind(value: object) -> str | None:
    """Return the tag of the branch of `value`, which is also the branch's name in the JSON Schema."""
    if isinstance(value, ConfigSection):
        return type(value).__name__
    if isinstance(value, Mapping):
        schedule = value.get("schedule")
        return SCHEDULES.get(schedule) if isinstance(schedule, str) else None
    return "number" if isinstance(value, int | float) else None


def _names_its_schedule(value: object) -> object:
    """Refuse a mapping without a valid kind of schedule, which would fit no branch."""
    if not isinstance(value, Mapping) or _kind(value):
        return value
    *most, last = map(repr, SCHEDULES)
    kinds = f"{', '.join(most)} or {last}"
    if "schedule" not in value:
        raise refusal(("schedule",), f"missing, expected {kinds}")
    given = value["schedule"]
    if not isinstance(given, str):
        raise refusal(("schedule",), f"expected {kinds}")
    hint = nearest(given, SCHEDULES)
    raise refusal(("schedule",), f"found {given[:60]!r}, expected {kinds}{'.' if hint else ''}{hint}")


def _stays_positive(value: float | Schedule) -> float | Schedule:
    match value:
        case Linear():
            lowest = min(value.start, value.end)
        case Exponential():
            lowest = value.start  # decaying towards 0 is not reaching it
        case Piecewise():
            lowest = min(height for _, height in value.points)
        case _:
            return value
    if max(value.floor, lowest) == 0:
        raise refusal((), "found a schedule that reaches 0, expected values above 0: set its floor")
    return value


N = TypeVar("N")
_OrSchedule = Annotated[
    Annotated[N, Tag("number")]
    | Annotated[Linear, Tag("Linear")]
    | Annotated[Exponential, Tag("Exponential")]
    | Annotated[Piecewise, Tag("Piecewise")],
    Discriminator(_kind),
    BeforeValidator(_names_its_schedule),
]

Probability = _OrSchedule[Fraction]
"""A number from 0 to 1, or a schedule of such."""

StepSize = Annotated[_OrSchedule[Annotated[float, Field(gt=0, le=1)]], AfterValidator(_stays_positive)]
"""A number above 0 and at most 1, or a schedule of such."""


# --- the sections ---------------------------------------------------------------------------------------


def _environment_arguments(value: object) -> FrozenMapping:
    if not isinstance(value, Mapping):
        raise ValueError
    if "competitive" in value:
        message = "is never set by hand: it follows from `mode` (or `rewards`). Remove it and set `mode`"
        raise refusal(("competitive",), message)
    arguments = frozen(value)
    assert isinstance(arguments, FrozenMapping)
    return arguments


class Environment(ConfigSection):
    """A Gymnasium environment."""

    id: str = Field(
        default="dualtaxi:DualTaxi-v1",
        min_length=1,
        description="The Gymnasium id; the part before a colon is a module to import first.",
    )
    kwargs: Annotated[
        FrozenMapping,
        PlainValidator(_environment_arguments),
        PlainSerializer(plain),
        WithJsonSchema({"type": "object", "propertyNames": {"not": {"const": "competitive"}}, "default": {}}),
    ] = Field(
        default_factory=lambda: FrozenMapping({}),
        description="Arguments of the environment, except `competitive`, which depends on the rewards.",
    )


class UniformRange(ConfigSection):
    """The range of random initial values: uniform in [low, high)."""

    low: float = Field(default=0.0, description="The lowest value.")
    high: float = Field(default=1.0, description="The upper bound, which is never drawn itself.")

    @model_validator(mode="after")
    def _has_width(self) -> Self:
        if not self.low < self.high:
            raise refusal(("high",), f"found {self.high:g}, expected a number above low, {self.low:g}")
        return self


class RandomTable(ConfigSection):
    """Random initial values, drawn for each cell."""

    random: UniformRange = Field(description="The range of the values.")


class RunTable(ConfigSection):
    """Initial values taken from a recorded run."""

    run: str = Field(min_length=1, description="The recorded run: its name, id or file.")
    step: Annotated[int, Field(ge=0, le=10**12)] | None = Field(
        default=None, description="The training step to take the table at; null is the last."
    )


def _table_kind(value: object) -> str | None:
    if isinstance(value, ConfigSection):
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
    _InitialTable, BeforeValidator(_spelled_out, json_schema_input_type=Literal["random"] | _InitialTable)
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


class EvaluationSection(ConfigSection):
    """When the greedy policy is evaluated, and in how many trials."""

    every: Count = Field(description="Training episodes between evaluations.")
    trials: Annotated[int, Field(ge=1, le=10**6)] = Field(description="Greedy episodes in an evaluation.")
    start: TrialStart = Field(
        default="random",
        description="The start states of trials. random: as in training episodes. each: the environment's "
        "start states in turn. A number: this state.",
    )
    exact: bool = Field(
        default=False,
        description="Also compute exact measures of the evaluated policy from the environment's transition "
        "table, over all start states and against the optimum: of the greedy policy, or with wolf_phc and "
        "random of the policy that actions are drawn from. Discounted values are NaN with discount 1.",
    )


class Log(ConfigSection):
    """Reports on training."""

    every_steps: Count = Field(default=50_000, description="Training steps between reports.")
    window: Annotated[int, Field(ge=1, le=10**8)] = Field(
        default=50_000, description="Number of last training steps in the reward distribution."
    )
    episodes: Annotated[int, Field(ge=1, le=10**6)] = Field(
        default=50, description="Number of last episodes in the mean length."
    )


class Snapshots(ConfigSection):
    """When whole Q-tables are written to the recording."""

    every: Count | None = Field(
        default=None,
        description="Training episodes between snapshots; null for only those before and after training. "
        "A table at any other step is computed from the nearest snapshot and the recorded steps.",
    )


_LEVELS: Final = sorted(level for codec in CODECS.values() for level in codec.levels)


class RecordingSection(ConfigSection):
    """The contents of the recording, and how it is packed."""

    steps: Literal["all", "none"] = Field(
        default="all", description="Whether to record environment steps: all, or none (only measures)."
    )
    compression: Compression = Field(
        default=Packing.compression, description="Compression of the chunks of a recording."
    )
    level: Annotated[int, Field(ge=_LEVELS[0], le=_LEVELS[-1])] | None = Field(
        default_factory=lambda chosen: CODECS[chosen.get("compression", "none")].default_level,
        description="Level of zstd, from -7 (fast) to 19 (small); 3 unless given. Only with zstd.",
    )
    index: Index = Field(
        default=Packing.index,
        description="message: index every message, as some readers need. chunk: only chunks, 16 bytes a step "
        "less.",
    )
    chunk_steps: Annotated[int, Field(ge=MIN_CHUNK_STEPS, le=MAX_CHUNK_STEPS)] = Field(
        default=Packing.chunk_steps,
        description="Maximum steps in a chunk; chunks that are flushed by time have fewer.",
    )
    code: bool = Field(
        default=True,
        description="Whether to record the code that runs: git commit and changes, script, arguments.",
    )
    system: bool = Field(
        default=True,
        description="Whether to record the use of processor, memory, GPUs, disk and network, once a second.",
    )
    console: bool = Field(
        default=True, description="Whether to record the output of the process, at most 10 MB of it."
    )

    @model_validator(mode="after")
    def _level_is_of_the_codec(self) -> Self:
        levels = CODECS[self.compression].levels
        if levels and self.level not in levels:
            found = "null" if self.level is None else self.level
            raise refusal(
                ("level",),
                f"found {found}, expected a whole number from {levels[0]} to {levels[-1]}: "
                f"{self.compression} has a level",
            )
        if self.level is not None and not levels:
            with_levels = ", ".join(name for name, codec in CODECS.items() if codec.levels)
            raise refusal(
                ("level",),
                f"found {self.level}, but compression is {self.compression}: only {with_levels} has levels. "
                "Remove it",
            )
        return self

    @property
    def packing(self) -> Packing:
        """How the recording is packed, for the recorder."""
        return Packing(self.compression, self.level or 0, self.index, self.chunk_steps)


class Quirks(ConfigSection):
    """Differences of the published tutorial's code from its text; each is off by default."""

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


Exploration = Literal["shared", "independent"]

Algorithm = Literal[
    "q_learning",
    "sarsa",
    "expected_sarsa",
    "double_q_learning",
    "hysteretic_q_learning",
    "wolf_phc",
    "sarsa_lambda",
    "n_step_q_learning",
    "random",
]


class AlgorithmSection(ConfigSection):
    """The parameters of one algorithm: a field here is all that the configuration needs of a parameter."""

    algorithm: ClassVar[Algorithm]


class Hysteretic(AlgorithmSection):
    """Hysteretic Q-learning's second step size; the first is `step_size`."""

    algorithm = "hysteretic_q_learning"

    decrease: Probability = Field(
        default=0.01,
        description="The step size of updates that lower a value, from 0 to 1; updates that raise it use "
        "`step_size`, which should be larger.",
    )


class WolfPhc(AlgorithmSection):
    """How fast WoLF-PHC moves its policy towards the greedy action: it wins or learns fast."""

    algorithm = "wolf_phc"

    win: StepSize = Field(
        default=0.05, description="Probability that an update moves while the policy wins; at most `lose`."
    )
    lose: StepSize = Field(
        default=0.2, description="Probability that an update moves while the policy loses."
    )

    @model_validator(mode="after")
    def _wins_slowly(self) -> Self:
        if isinstance(self.win, float) and isinstance(self.lose, float) and self.win > self.lose:
            raise refusal(("win",), f"found {self.win:g}, expected at most lose, {self.lose:g}")
        return self


class SarsaLambda(AlgorithmSection):
    """How far back an update of SARSA(lambda) reaches."""

    algorithm = "sarsa_lambda"

    trace_decay: Probability = Field(
        default=0.9,
        description="Lambda, from 0 to 1: each step multiplies all traces by it and the discount. With 0 "
        "an update changes only the last value, as with sarsa.",
    )


class NStep(AlgorithmSection):
    """How many rewards n-step Q-learning waits for; this cannot change while a run is trained."""

    algorithm = "n_step_q_learning"

    n: Annotated[int, Field(ge=1, le=10_000)] = Field(
        default=4, description="Rewards in a return before the greedy value; 1 is q_learning."
    )


class ChangesSection(ConfigSection):
    """The settings that can change while a run is trained; those that are left out stay as they are."""

    step_size: Optional[StepSize] = Field(default=None, description="As for the whole run.")
    discount: Optional[Probability] = Field(default=None, description="As for the whole run.")
    epsilon: Optional[Probability] = Field(default=None, description="As for the whole run.")
    exploration: Optional[Exploration] = Field(default=None, description="As for the whole run.")
    hysteretic: Optional[Hysteretic] = Field(default=None, description="The whole section.")
    wolf_phc: Optional[WolfPhc] = Field(default=None, description="The whole section.")
    sarsa_lambda: Optional[SarsaLambda] = Field(default=None, description="The whole section.")
    quirks: Optional[Quirks] = Field(default=None, description="The whole section.")

    @property
    def given(self) -> Json:
        """The settings that change, by key."""
        return {key: value for key, value in self if value is not None}

    @model_serializer
    def _mapping(self) -> dict[str, object]:
        return {
            key: value.model_dump(mode="json") if isinstance(value, ConfigSection) else value
            for key, value in self.given.items()
        }


Text = Annotated[str, Field(min_length=1)]
Actions = Annotated[Mapping[Text, Text], AfterValidator(FrozenMapping), PlainSerializer(dict)]


class BranchSection(ConfigSection):
    """One step at which training was changed."""

    run: Text = Field(description="The id of the run that was branched.")
    step: Annotated[int, Field(ge=0, le=10**12)] = Field(
        description="The first training step that may differ, counted from 0."
    )
    actions: Actions = Field(
        default_factory=lambda: FrozenMapping({}),
        description="Agent to the name or number of the action it takes at this step; the others act as they "
        "would.",
    )
    settings: ChangesSection = Field(
        default=ChangesSection(), description="The settings that change from this step on."
    )
