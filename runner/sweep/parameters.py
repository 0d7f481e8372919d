"""The parameters of a sweep: the values to try, each of a list, or numbers of a range."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from decimal import Decimal
from typing import Annotated, Final, Self

from pydantic import Discriminator, Field, Tag, model_validator

from runner.config.values import ConfigSection, refusal

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
