"""What each outcome of a step is worth to a taxi."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from numbers import Real
from typing import Any


@dataclass(frozen=True)
class Rewards:
    """The reward a taxi gets for a step, by what it did; the defaults are the published values.

    Attributes:
        step: A move (also one against a wall).
        idle_step: A move while the passenger rides in the other taxi.
        pickup: A legal pickup.
        illegal_action: A pickup where no passenger waits, a drop-off without passenger or off the landmarks.
        drop_off: The passenger delivered at the destination.
        wrong_drop_off: The passenger put out at another landmark; `None` means the same as `step`.
        collision: Both taxis would end in one cell; each gets this and nothing else.
    """

    step: float = -2.0
    idle_step: float = -1.0
    pickup: float = 0.0
    illegal_action: float = -10.0
    drop_off: float = 100.0
    wrong_drop_off: float | None = None
    collision: float = -15.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None and field.name == "wrong_drop_off":
                continue
            if not is_number(value) or not math.isfinite(value):
                raise ValueError(f"rewards.{field.name} is {value!r}, expected a finite number")

    @classmethod
    def of(cls, given: Rewards | Mapping[str, Any] | None) -> Rewards:
        """Return `given` as `Rewards`; names that a mapping leaves out keep their defaults.

        Raises:
            ValueError: A name is unknown, or a value is not a finite number.
        """
        if isinstance(given, Rewards):
            return given
        if given is not None and not isinstance(given, Mapping):
            raise ValueError(f"rewards is {given!r}, expected a mapping such as {{'drop_off': 50}}")
        given = dict(given or {})
        names = [field.name for field in fields(cls)]
        for name in given:
            if name not in names:
                near = difflib.get_close_matches(str(name), names, n=1)
                hint = f"did you mean {near[0]!r}? " if near else ""
                raise ValueError(
                    f"rewards has the unknown name {name!r}; {hint}the names are {', '.join(names)}"
                )
        return cls(**given)

    @property
    def put_out(self) -> float:
        """The reward for putting the passenger out at a landmark other than the destination."""
        return self.step if self.wrong_drop_off is None else self.wrong_drop_off


def is_number(value: object) -> bool:
    """Return whether `value` is a real number; True and False, which YAML writes as yes and no, are none."""
    return isinstance(value, Real) and not isinstance(value, bool)
