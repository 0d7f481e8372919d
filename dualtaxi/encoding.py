"""States and joint actions as integers, and back."""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import NamedTuple

from dualtaxi.grid import ACTIONS

AGENTS = ("taxi_1", "taxi_2")
"""The two taxis; the first is the most significant in a joint action."""


class State(NamedTuple):
    """A state taken apart.

    Attributes:
        taxi_1: (row, column) of taxi 1.
        taxi_2: (row, column) of taxi 2.
        passenger: Number of the landmark where the passenger waits; the number of landmarks means "in
            taxi 1", one more "in taxi 2".
        destination: Number of the landmark where the passenger wants to go.
    """

    taxi_1: tuple[int, int]
    taxi_2: tuple[int, int]
    passenger: int
    destination: int


@dataclass(frozen=True)
class Encoding:
    """How the states of one map are numbered: mixed radix, the first field of `State` most significant.

    Attributes:
        rows: Number of rows of the map.
        columns: Number of columns of the map.
        landmarks: Number of landmarks of the map.
    """

    rows: int
    columns: int
    landmarks: int

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(cells of taxi 1, cells of taxi 2, passenger places, destinations): C order numbers the states."""
        cells = self.rows * self.columns
        return cells, cells, self.landmarks + 2, self.landmarks

    @property
    def states(self) -> int:
        """Number of states."""
        cells, _, places, destinations = self.shape
        return cells * cells * places * destinations

    def encode(
        self, taxi_1: tuple[int, int], taxi_2: tuple[int, int], passenger: int, destination: int
    ) -> int:
        """Return the number of a state, given as the fields of `State`.

        Raises:
            ValueError: A field is outside its range.
        """
        cells, _, places, destinations = self.shape
        number = self._cell("taxi_1", taxi_1) * cells + self._cell("taxi_2", taxi_2)
        number = number * places + _checked("passenger", passenger, places)
        return number * destinations + _checked("destination", destination, destinations)

    def decode(self, state: int) -> State:
        """Return the fields of state number `state`.

        Raises:
            ValueError: There is no such state.
        """
        cells, _, places, destinations = self.shape
        rest, destination = divmod(_checked("state", state, self.states), destinations)
        rest, passenger = divmod(rest, places)
        cell_1, cell_2 = divmod(rest, cells)
        return State(divmod(cell_1, self.columns), divmod(cell_2, self.columns), passenger, destination)

    def _cell(self, taxi: str, place: tuple[int, int]) -> int:
        row, column = place
        row = _checked(f"row of {taxi}", row, self.rows)
        return row * self.columns + _checked(f"column of {taxi}", column, self.columns)


def encode_action(action_1: int, action_2: int) -> int:
    """Return the joint action, action_1 * 6 + action_2, of the two taxis' actions.

    Raises:
        ValueError: An action is outside 0 to 5.
    """
    count = len(ACTIONS)
    first = _checked("action of taxi_1", action_1, count)
    return first * count + _checked("action of taxi_2", action_2, count)


def decode_action(action: int) -> tuple[int, int]:
    """Return the actions of taxi 1 and taxi 2 in a joint action.

    Raises:
        ValueError: The joint action is outside 0 to 35.
    """
    return divmod(_checked("joint action", action, len(ACTIONS) ** 2), len(ACTIONS))


def _checked(name: str, value: int, count: int) -> int:
    """Return `value` as an int; refuse one that is not in range(count)."""
    try:
        number = operator.index(value)
    except TypeError:
        number = -1
    if not 0 <= number < count:
        raise ValueError(f"{name} is {value!r}, expected a whole number from 0 to {count - 1}")
    return number
