"""Environments whose actions and observations vary in size, for the tests of spaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

import runner


@dataclass
class Hand:
    """Some cards."""

    cards: list[int]


class Hands(spaces.Space[Hand]):
    """A space of hands, which is registered."""

    def sample(self, mask: Any = None, probability: Any = None) -> Hand:
        return Hand(self.np_random.integers(0, 52, self.np_random.integers(1, 6)).tolist())

    def contains(self, x: Any) -> bool:
        return isinstance(x, Hand)


runner.register_space(Hands, to_json=lambda hand: hand.cards, from_json=Hand)

NUMBERS = spaces.Box(-np.inf, np.inf, (2,), np.float32)
PAIR = spaces.Dict({"a": spaces.Discrete(3), "b": spaces.Tuple((NUMBERS, spaces.Text(5)))})
SPACES: dict[str, spaces.Space[Any]] = {
    "sequence": spaces.Sequence(NUMBERS),
    "stacked": spaces.Sequence(NUMBERS, stack=True),
    "sequence of dictionaries": spaces.Sequence(PAIR),
    "one of": spaces.OneOf([spaces.Discrete(4, start=-2), NUMBERS, spaces.Sequence(spaces.MultiBinary(3))]),
    "graph": spaces.Graph(NUMBERS, spaces.Discrete(5)),
    "graph without edges": spaces.Graph(spaces.Discrete(7), None),
    "registered": Hands(),
    "nested": spaces.Dict(
        {
            "graph": spaces.Graph(NUMBERS, NUMBERS),
            "both": spaces.Tuple((spaces.Sequence(spaces.Discrete(9)), Hands(), NUMBERS)),
        }
    ),
}


class Varied(gymnasium.Env[Any, Any]):
    """Returns the last action as observation, and a reward that depends on every number in it."""

    def __init__(self, name: str) -> None:
        self.observation_space = self.action_space = SPACES[name]

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        self.t = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        assert action in self.action_space
        self.t += 1
        noise = float(self.np_random.random())
        return action, _sum(action) + noise, self.t == 7, False, {}


def _sum(value: Any) -> float:
    if isinstance(value, dict):
        return sum(_sum(part) for part in value.values())
    if isinstance(value, Hand):
        return float(sum(value.cards))
    if isinstance(value, tuple):
        return sum(_sum(part) for part in value if part is not None)
    if isinstance(value, str):
        return float(len(value))
    assert np.asarray(value).dtype != np.float64
    return float(np.sum(np.asarray(value, np.float64)))
