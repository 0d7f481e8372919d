"""The rules of the game, as arrays over every state and joint action."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dualtaxi.encoding import AGENTS, Encoding
from dualtaxi.grid import ACTIONS, DROP_OFF, MOVES, PICKUP, SIDEWAYS, Grid
from dualtaxi.rewards import Rewards

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


class Branch(NamedTuple):
    """One direction that an action may take: as meant, or slipped to one of the two sides."""

    cell_after: NDArray[np.intp]  # [cells, actions]
    probability: NDArray[np.float64]  # [actions]


def build_transitions(grid: Grid, encoding: Encoding, rewards: Rewards, slip: float) -> Transitions:
    """Return the transitions with one reward a taxi (R = 2).

    Args:
        grid: The map.
        encoding: The numbering of the map's states.
        rewards: What a step is worth.
        slip: Probability that a move goes sideways, half of it to either side, independently for each taxi.

    Raises:
        ValueError: The map is too large for its table to be held in memory.
    """
    ways = branches(grid, slip)
    count = encoding.states * len(ACTIONS) ** 2 * len(ways) ** 2
    if count > MAX_OUTCOMES:
        raise ValueError(
            f"map and slip make {count:,} outcomes ({encoding.states:,} states), expected at most "
            f"{MAX_OUTCOMES:,}; use a smaller map, fewer landmarks, or no slip"
        )
    effects = (taxi_effects(0, grid, rewards), taxi_effects(1, grid, rewards))
    outcomes = [_joint_outcome(encoding, rewards, pair, effects) for pair in itertools.product(ways, ways)]
    return outcomes[0] if len(outcomes) == 1 else _merge_identical(outcomes)


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


def branches(grid: Grid, slip: float) -> list[Branch]:
    """Return the directions that actions may take, those that no action ever takes left out."""
    moves = np.arange(len(ACTIONS)) < len(MOVES)
    ways = [Branch(grid.cell_after, np.where(moves, 1.0 - slip, 1.0))]
    for side in range(2):
        turned = [SIDEWAYS[move][side] for move in range(len(MOVES))]
        ways.append(Branch(grid.cell_after[:, [*turned, PICKUP, DROP_OFF]], np.where(moves, slip / 2, 0.0)))
    return [way for way in ways if way.probability.any()]


def _joint_outcome(
    encoding: Encoding, rewards: Rewards, ways: tuple[Branch, Branch], effects: tuple[Effects, Effects]
) -> Transitions:
    """Return the one outcome (K = 1) in which the two taxis go their given ways."""
    cell_1, cell_2, passenger, destination = np.ogrid[tuple(slice(n) for n in (*encoding.shape, 1, 1))][:4]
    after_1, after_2 = ways[0].cell_after[_MOVE_1], ways[1].cell_after[_MOVE_2]
    passenger_1, passenger_2 = effects[0].passenger[_TAXI_1], effects[1].passenger[_TAXI_2]
    collide = after_1 == after_2
    shared = (cell_1 == cell_2) & ~collide
    undone = collide | shared

    passenger_after = np.where(passenger_1 != passenger, passenger_1, passenger_2)
    passenger_after = np.where(undone, passenger, passenger_after)
    state = _number(encoding, cell_1, cell_2, passenger, destination)
    moved = _number(encoding, after_1, after_2, passenger_after, destination)
    # The published rules judge a delivery before they look for a collision, so one that a
    # collision undoes still ends the episode.
    ends = effects[0].delivers[_TAXI_1] | effects[1].delivers[_TAXI_2] | shared
    happened = np.where(undone, np.uint32(0), effects[0].events[_TAXI_1] | effects[1].events[_TAXI_2])
    collision = np.where(collide, np.uint32(1 << EVENT_NAMES.index("collision")), np.uint32(0))
    pay = [
        np.where(collide, rewards.collision, np.where(shared, SHARED_CELL_REWARDS[taxi], earned))
        for taxi, earned in enumerate((effects[0].reward[_TAXI_1], effects[1].reward[_TAXI_2]))
    ]
    return Transitions(
        next_state=_fold(encoding, np.where(collide, state, moved), np.int32),
        probability=_fold(encoding, np.outer(ways[0].probability, ways[1].probability), np.float64),
        rewards=np.stack([_fold(encoding, part, np.float64) for part in pay], axis=-1),
        terminated=_fold(encoding, ends, np.bool_),
        events=_fold(encoding, happened | collision, np.uint32),
    )


def _number(encoding: Encoding, *axes: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return state numbers from (cell 1, cell 2, passenger, destination); see `Encoding.shape`."""
    number = axes[0]
    for axis, count in zip(axes[1:], encoding.shape[1:], strict=True):
        number = number * count + axis
    return number


def _fold(encoding: Encoding, values: NDArray[Any], dtype: type[np.generic]) -> NDArray[Any]:
    """Return values over the six axes as an array of their own, [states, joint actions, 1]."""
    count = len(ACTIONS)
    whole = np.broadcast_to(values, (*encoding.shape, count, count))
    return np.array(whole, dtype=dtype, order="C").reshape(encoding.states, count * count, 1)


def _merge_identical(outcomes: list[Transitions]) -> Transitions:
    """Return one set of transitions: outcomes that differ in nothing made one, padding put last."""
    # Within one state and joint action the reward follows from what happened, so it need not be compared.
    keys = [
        o.next_state[..., 0].astype(np.int64) << 32 | o.events[..., 0] << 1 | o.terminated[..., 0]
        for o in outcomes
    ]
    chances = [o.probability[..., 0].copy() for o in outcomes]
    for later in range(1, len(outcomes)):
        for earlier in range(later):
            same = (keys[earlier] == keys[later]) & (chances[earlier] > 0)
            chances[earlier] += np.where(same, chances[later], 0.0)
            chances[later][same] = 0.0
    probability = np.stack(chances, axis=-1)
    real = probability > 0
    order = np.argsort(~real, axis=-1, kind="stable")[..., : real.sum(axis=-1).max()]
    real = np.take_along_axis(real, order, axis=-1)

    def ordered(values: NDArray[Any]) -> NDArray[Any]:
        return np.where(real, np.take_along_axis(values, order, axis=-1), np.zeros((), values.dtype))

    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(o, name) for o in outcomes], axis=2)

    pay = joined("rewards")
    return Transitions(
        next_state=ordered(joined("next_state")),
        probability=ordered(probability),
        rewards=np.stack([ordered(pay[..., taxi]) for taxi in range(len(AGENTS))], axis=-1),
        terminated=ordered(joined("terminated")),
        events=ordered(joined("events")),
    )


def summed(transitions: Transitions) -> Transitions:
    """Return the transitions with the sum of both taxis' rewards in place of the pair (R = 1)."""
    total = transitions.rewards.sum(axis=-1, keepdims=True)
    return Transitions(
        transitions.next_state, transitions.probability, total, transitions.terminated, transitions.events
    )


def legal_actions(grid: Grid, encoding: Encoding) -> NDArray[np.bool_]:
    """Return which actions of each taxi hit no wall and are no illegal pickup or drop-off, [S, 2, 6]."""
    cells, count = np.arange(grid.cells), len(ACTIONS)
    blocked = (grid.cell_after == cells[:, np.newaxis]) & (np.arange(count) < len(MOVES))
    legal = np.empty((*encoding.shape, len(AGENTS), count), dtype=np.bool_)
    for taxi in range(len(AGENTS)):
        allowed = ~(taxi_effects(taxi, grid, Rewards()).illegal | blocked[:, np.newaxis, np.newaxis, :])
        legal[..., taxi, :] = np.expand_dims(allowed, axis=1 - taxi)
    return legal.reshape(encoding.states, len(AGENTS), count)


def start_distribution(encoding: Encoding) -> NDArray[np.float64]:
    """Return the probability of starting in each state, float64 [S].

    Uniform over states with the taxis in different cells and the passenger waiting at a landmark
    other than the destination.
    """
    cell_1, cell_2, passenger, destination = np.ogrid[tuple(slice(n) for n in encoding.shape)]
    waiting = (passenger < encoding.landmarks) & (passenger != destination)
    starts = np.broadcast_to((cell_1 != cell_2) & waiting, encoding.shape).ravel()
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
