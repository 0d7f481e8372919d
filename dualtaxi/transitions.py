"""The rules of the game: what a step is worth, and the outcomes of every joint action in every state."""

from __future__ import annotations

import difflib
import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dualtaxi.grid import ACTIONS, AGENTS, DROP_OFF, MOVES, PICKUP, SIDEWAYS, Grid

_TAXI_EVENTS = ("pickup", "drop_off", "wrong_stop", "illegal_pickup", "illegal_drop_off")

EVENT_NAMES = (*(f"{agent}.{event}" for event in _TAXI_EVENTS for agent in AGENTS), "collision")
"""Name of each bit of an event mask: bit i is `EVENT_NAMES[i]`."""

SHARED_CELL_REWARDS = (-0.5, 0.0)
"""Rewards for leaving a cell that both taxis stood in: a state that no legal start leads to."""

MAX_OUTCOMES = 2**25
"""Most (state, action, outcome) entries that are built: about 1.5 GB."""

# The six axes that the rules are written over, before they are folded into [states, joint actions]:
#   (cell of taxi 1, cell of taxi 2, passenger, destination, action of taxi 1, action of taxi 2)
_TAXI_1 = np.s_[:, np.newaxis, :, :, :, np.newaxis]  # [cells, passengers, destinations, actions] of taxi 1
_TAXI_2 = np.s_[np.newaxis, :, :, :, np.newaxis, :]  # the same of taxi 2
_MOVE_1 = np.s_[:, np.newaxis, np.newaxis, np.newaxis, :, np.newaxis]  # [cells, actions] of taxi 1
_MOVE_2 = np.s_[np.newaxis, :, np.newaxis, np.newaxis, np.newaxis, :]


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


@dataclass(frozen=True, eq=False)
class Transitions:
    """Every outcome of every joint action in every state; read-only arrays.

    S states, A joint actions, K = the most outcomes that any pair has, R = 1 (the sum of both taxis'
    rewards) or 2 (one a taxi). Where a pair has fewer than K outcomes, the last ones are padding:
    probability 0 and everything else 0.

    Attributes:
        next_state: int32 [S, A, K].
        probability: float64 [S, A, K], sums to 1 over K.
        rewards: float64 [S, A, K, R].
        terminated: bool [S, A, K].
        events: uint32 [S, A, K], bit i set when event `EVENT_NAMES[i]` happens.
    """

    next_state: NDArray[np.int32]
    probability: NDArray[np.float64]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    events: NDArray[np.uint32]

    def __post_init__(self) -> None:
        for field in fields(self):
            getattr(self, field.name).flags.writeable = False


class Effects(NamedTuple):
    """One taxi's action where no collision undoes it.

    Every array broadcasts to [cells, passengers, destinations, actions].
    """

    reward: NDArray[np.float64]
    passenger: NDArray[np.intp]
    delivers: NDArray[np.bool_]
    events: NDArray[np.uint32]
    illegal: NDArray[np.bool_]


class Way(NamedTuple):
    """One way in which a taxi's actions may turn out."""

    done: NDArray[np.intp]  # [actions]: the action that is done when each is meant
    probability: NDArray[np.float64]  # [actions]


def build_transitions(grid: Grid, rewards: Rewards, slip: float) -> Transitions:
    """Return the transitions with one reward a taxi (R = 2).

    Args:
        grid: The map.
        rewards: What a step is worth.
        slip: Probability that a move goes sideways, half of it to either side, independently for each taxi.

    Raises:
        ValueError: The map is too large for its table to be held in memory.
    """
    ways = _ways(slip)
    count = grid.states * len(ACTIONS) ** 2 * len(ways) ** 2
    if count > MAX_OUTCOMES:
        raise ValueError(
            f"map and slip make {count:,} outcomes ({grid.states:,} states), expected at most "
            f"{MAX_OUTCOMES:,}; use a smaller map, fewer landmarks, or no slip"
        )
    sure = _sure_transitions(grid, rewards)
    return sure if len(ways) == 1 else _with_slip(sure, ways)


def taxi_effects(taxi: int, grid: Grid, rewards: Rewards) -> Effects:
    """Return what each action of one taxi (0 or 1) does, seen from the state before the step."""
    count = len(grid.landmarks)
    cell, passenger, destination, action = np.ogrid[: grid.cells, : count + 2, :count, : len(ACTIONS)]
    landmark = grid.landmark_at[cell]
    aboard, idle = passenger == count + taxi, passenger == count + 1 - taxi
    picks_up = (action == PICKUP) & (landmark == passenger)
    lets_out = (action == DROP_OFF) & aboard & (landmark >= 0)
    delivers = lets_out & (landmark == destination)
    puts_out = lets_out & ~delivers
    illegal_pickup = (action == PICKUP) & ~picks_up
    illegal_drop_off = (action == DROP_OFF) & ~lets_out

    kinds = [picks_up, delivers, puts_out, illegal_pickup, illegal_drop_off]
    worth = [
        rewards.pickup,
        rewards.drop_off,
        rewards.put_out,
        rewards.illegal_action,
        rewards.illegal_action,
    ]
    otherwise = np.where(idle, rewards.idle_step, rewards.step)
    bits = [np.uint32(1 << EVENT_NAMES.index(f"{AGENTS[taxi]}.{event}")) for event in _TAXI_EVENTS]
    return Effects(
        reward=np.select(kinds, [np.float64(value) for value in worth], otherwise),
        passenger=np.select([picks_up, lets_out], [np.intp(count + taxi), landmark], passenger),
        delivers=delivers,
        events=np.select(kinds, bits, np.uint32(0)),
        illegal=illegal_pickup | illegal_drop_off,
    )


def _sure_transitions(grid: Grid, rewards: Rewards) -> Transitions:
    """Return the transitions without slip, one outcome each (K = 1)."""
    taxi_1, taxi_2 = (taxi_effects(taxi, grid, rewards) for taxi in range(len(AGENTS)))
    cell_1, cell_2, passenger, destination = np.ogrid[tuple(slice(n) for n in (*grid.state_shape, 1, 1))][:4]
    after_1, after_2 = grid.cell_after[_MOVE_1], grid.cell_after[_MOVE_2]
    passenger_1, passenger_2 = taxi_1.passenger[_TAXI_1], taxi_2.passenger[_TAXI_2]
    collide = after_1 == after_2
    shared = (cell_1 == cell_2) & ~collide
    undone = collide | shared

    passenger_after = np.where(passenger_1 != passenger, passenger_1, passenger_2)
    passenger_after = np.where(undone, passenger, passenger_after)
    state = _number(grid, cell_1, cell_2, passenger, destination)
    moved = _number(grid, after_1, after_2, passenger_after, destination)
    # The published rules judge a delivery before they look for a collision, so one that a
    # collision undoes still ends the episode.
    ends = taxi_1.delivers[_TAXI_1] | taxi_2.delivers[_TAXI_2] | shared
    happened = np.where(undone, np.uint32(0), taxi_1.events[_TAXI_1] | taxi_2.events[_TAXI_2])
    collision = np.where(collide, np.uint32(1 << EVENT_NAMES.index("collision")), np.uint32(0))
    pay = [
        np.where(collide, rewards.collision, np.where(shared, SHARED_CELL_REWARDS[taxi], earned))
        for taxi, earned in enumerate((taxi_1.reward[_TAXI_1], taxi_2.reward[_TAXI_2]))
    ]
    return Transitions(
        next_state=_fold(grid, np.where(collide, state, moved), np.int32),
        probability=_fold(grid, np.ones(1), np.float64),
        rewards=np.stack([_fold(grid, part, np.float64) for part in pay], axis=-1),
        terminated=_fold(grid, ends, np.bool_),
        events=_fold(grid, happened | collision, np.uint32),
    )


def _number(grid: Grid, *axes: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return state numbers from (cell 1, cell 2, passenger, destination); see `Grid.state_shape`."""
    number = axes[0]
    for axis, count in zip(axes[1:], grid.state_shape[1:], strict=True):
        number = number * count + axis
    return number


def _fold(grid: Grid, values: NDArray[Any], dtype: type[np.generic]) -> NDArray[Any]:
    """Return values over the six axes as an array of their own, [states, joint actions, 1]."""
    count = len(ACTIONS)
    whole = np.broadcast_to(values, (*grid.state_shape, count, count))
    return np.array(whole, dtype=dtype, order="C").reshape(grid.states, count * count, 1)


def _ways(slip: float) -> list[Way]:
    """Return the ways actions may turn out: as meant, and to either side; only those that happen."""
    moves = np.arange(len(ACTIONS)) < len(MOVES)
    ways = [Way(np.arange(len(ACTIONS)), np.where(moves, 1.0 - slip, 1.0))]
    for side in range(2):
        turned = np.array([*(sides[side] for sides in SIDEWAYS), PICKUP, DROP_OFF])
        ways.append(Way(turned, np.where(moves, slip / 2, 0.0)))
    return [way for way in ways if way.probability.any()]


def _with_slip(sure: Transitions, ways: list[Way]) -> Transitions:
    """Return the transitions in which what is done may differ from what was meant.

    Outcomes that differ in nothing are made one; padding comes last.
    """
    pairs = list(itertools.product(ways, ways))
    done = [np.add.outer(first.done * len(ACTIONS), second.done).ravel() for first, second in pairs]
    chances = [
        np.tile(np.outer(first.probability, second.probability).ravel(), (len(sure.next_state), 1))
        for first, second in pairs
    ]
    _merge_identical(sure, done, chances)

    taken = [np.nonzero(chance) for chance in chances]
    filled = np.zeros(chances[0].shape, dtype=np.intp)
    places = []
    for pair in taken:
        places.append((*pair, filled[pair]))
        filled[pair] += 1

    def packed(parts: Iterable[NDArray[Any]], like: NDArray[Any]) -> NDArray[Any]:
        whole = np.zeros((*filled.shape, filled.max(), *like.shape[3:]), dtype=like.dtype)
        for part, pair, place in zip(parts, taken, places, strict=True):
            whole[place] = part[pair]
        return whole

    def chosen(values: NDArray[Any]) -> NDArray[Any]:
        return packed((values[:, action, 0] for action in done), values)

    return Transitions(
        next_state=chosen(sure.next_state),
        probability=packed(chances, sure.probability),
        rewards=chosen(sure.rewards),
        terminated=chosen(sure.terminated),
        events=chosen(sure.events),
    )


def _merge_identical(
    sure: Transitions, done: list[NDArray[np.intp]], chances: list[NDArray[np.float64]]
) -> None:
    """Give the chance of each outcome to the first one that is the same; changes `chances`."""
    # A slip turns moves into moves: within a pair equal events mean equal rewards, which need no comparing.
    key = sure.next_state.astype(np.int64) << 32 | sure.events << 1 | sure.terminated
    keys = [key[:, action, 0] for action in done]
    for later, earlier in ((i, j) for i in range(len(keys)) for j in range(i)):
        same = np.nonzero((keys[earlier] == keys[later]) & (chances[earlier] > 0))
        chances[earlier][same] += chances[later][same]
        chances[later][same] = 0.0


def summed(transitions: Transitions) -> Transitions:
    """Return the transitions with the sum of both taxis' rewards in place of the pair (R = 1)."""
    total = transitions.rewards.sum(axis=-1, keepdims=True)
    return Transitions(
        transitions.next_state, transitions.probability, total, transitions.terminated, transitions.events
    )


def legal_actions(grid: Grid) -> NDArray[np.bool_]:
    """Return which actions of each taxi hit no wall and are no illegal pickup or drop-off, [S, 2, 6]."""
    cells, count = np.arange(grid.cells), len(ACTIONS)
    blocked = (grid.cell_after == cells[:, np.newaxis]) & (np.arange(count) < len(MOVES))
    legal = np.empty((*grid.state_shape, len(AGENTS), count), dtype=np.bool_)
    for taxi in range(len(AGENTS)):
        allowed = ~(taxi_effects(taxi, grid, Rewards()).illegal | blocked[:, np.newaxis, np.newaxis, :])
        legal[..., taxi, :] = np.expand_dims(allowed, axis=1 - taxi)
    return legal.reshape(grid.states, len(AGENTS), count)


def start_distribution(grid: Grid) -> NDArray[np.float64]:
    """Return the probability of starting in each state, float64 [S].

    Uniform over states with the taxis in different cells and the passenger waiting at a landmark
    other than the destination.
    """
    cell_1, cell_2, passenger, destination = np.ogrid[tuple(slice(n) for n in grid.state_shape)]
    waiting = (passenger < len(grid.landmarks)) & (passenger != destination)
    starts = np.broadcast_to((cell_1 != cell_2) & waiting, grid.state_shape).ravel()
    return starts / np.count_nonzero(starts)


def transition_table(transitions: Transitions) -> dict[int, dict[int, list[tuple[Any, ...]]]]:
    """Return `P[state][action] = [(probability, next_state, reward, terminated), ...]`.

    The reward is a number where there is one a step, and a tuple of numbers where there is one a taxi.
    """
    states, actions, outcomes = transitions.probability.shape
    flat = transitions.rewards.reshape(states * actions * outcomes, -1)
    reward = flat[:, 0].tolist() if flat.shape[1] == 1 else list(map(tuple, flat.tolist()))
    parts = (transitions.probability, transitions.next_state, transitions.terminated)
    probability, next_state, terminated = (part.ravel().tolist() for part in parts)
    entries = list(zip(probability, next_state, reward, terminated, strict=True))
    table: dict[int, dict[int, list[tuple[Any, ...]]]] = {}
    for state in range(states):
        start = state * actions * outcomes
        rows = (entries[i : i + outcomes] for i in range(start, start + actions * outcomes, outcomes))
        table[state] = {a: [entry for entry in row if entry[0] > 0] for a, row in enumerate(rows)}
    return table
