"""Parameters that may change while a run learns: a constant, or a schedule.

A schedule is a function of n, the number of episodes (or training steps) before the current one,
counted from 0 over the whole run. These models describe the function; `runner.learning` computes it.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Literal, Self, TypeVar

from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag, model_validator

from runner.config.values import ConfigSection, Count, Fraction, refusal
from runner.errors import nearest
from runner.util.values import Json

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

    def reaches_zero(self) -> bool:
        """Return whether the value is 0 somewhere."""
        return max(self.floor, min(self.start, self.end)) == 0


class Exponential(ConfigSection, json_schema_extra=_names_itself):
    """Decay by a constant factor: `start` * `factor` ** n."""

    schedule: Literal["exponential"] = Field(default="exponential", description="Decay by a constant factor.")
    start: Start
    factor: Annotated[float, Field(gt=0, le=1)] = Field(
        description="What the value is multiplied by after each episode (or step)."
    )
    by: By = "episode"
    floor: Floor = 0.0

    def reaches_zero(self) -> bool:
        """Return whether the value is 0 somewhere; decaying towards 0 is not reaching it."""
        return max(self.floor, self.start) == 0


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

    def reaches_zero(self) -> bool:
        """Return whether the value is 0 somewhere."""
        return max(self.floor, min(value for _, value in self.points)) == 0


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
    if isinstance(value, ConfigSection) and value.reaches_zero():
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
