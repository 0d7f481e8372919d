"""A number that knows what it was made of, and the algorithms in plain Python with such numbers."""

from __future__ import annotations

import functools
from collections.abc import Hashable, Mapping
from typing import Any

from tests.runner.learning.twin import Step, Twin


@functools.total_ordering
class Linear:
    """A weighted sum of named numbers; arithmetic keeps its value exact and follows the weights."""

    __hash__ = None

    def __init__(self, value: float, weights: Mapping[Hashable, float]) -> None:
        self.value, self.weights = value, weights

    def __add__(self, other: Linear | float) -> Linear:
        if not isinstance(other, Linear):
            return Linear(self.value + other, self.weights)
        names = {*self.weights, *other.weights}
        return Linear(
            self.value + other.value,
            {name: self.weights.get(name, 0.0) + other.weights.get(name, 0.0) for name in names},
        )

    __radd__ = __add__

    def __mul__(self, factor: float) -> Linear:
        return Linear(self.value * factor, {name: weight * factor for name, weight in self.weights.items()})

    __rmul__ = __mul__

    def __truediv__(self, divisor: float) -> Linear:
        return Linear(self.value / divisor, {name: weight / divisor for name, weight in self.weights.items()})

    def __sub__(self, other: Linear | float) -> Linear:
        if not isinstance(other, Linear):
            return Linear(self.value - other, self.weights)
        negative = Linear(0.0, {name: -weight for name, weight in other.weights.items()})
        return Linear(self.value - other.value, (self + negative).weights)

    def __eq__(self, other: object) -> bool:
        return self.value == _value(other)

    def __lt__(self, other: object) -> bool:
        return self.value < _value(other)

    def __float__(self) -> float:
        return self.value


def _value(number: Any) -> float:
    return number.value if isinstance(number, Linear) else number


class LinearTwin(Twin):
    """The twin whose Q-values know the weights of rewards, `("step", number)`, and of initial values.

    These are named `("initial", table, state, action)`; tables are counted from 0, and there are two of
    Double Q-learning. Each reward counts for its own learner.
    """

    def __init__(self, config: Any, mdp: Any, seed: int) -> None:
        super().__init__(config, mdp, seed)
        is_double = config.algorithm == "double_q_learning"
        for number, tables in enumerate(self.doubles if is_double else [self.tables]):
            for table in tables:
                for state, row in enumerate(table):
                    for action, value in enumerate(row):
                        row[action] = Linear(value, {("initial", number, state, action): 1.0})
        for i, table in enumerate(self.tables if is_double else []):
            for state, row in enumerate(table):
                for action in range(len(row)):
                    row[action] = self._mean(i, state, action)

    def _learn(self, step: Step, step_size: float, discount: float) -> None:
        rewards = [Linear(reward, {("step", step.step): 1.0}) for reward in step.rewards]
        super()._learn(step._replace(rewards=rewards), step_size, discount)
