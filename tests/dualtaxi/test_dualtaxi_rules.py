"""The rules one by one, as a reader of the rules would try them on the published map.

+-------+
|R: | :G|
| : | : |
| | : : |
|Y: |B: |
+-------+
"""

from __future__ import annotations

from typing import NamedTuple

import pytest

from dualtaxi import DualTaxiEnv

SOUTH, NORTH, EAST, WEST, PICKUP, DROP_OFF = range(6)
R, G, Y, B, IN_1, IN_2 = range(6)
AT = {R: (0, 0), G: (0, 3), Y: (3, 0), B: (3, 2)}


class Result(NamedTuple):
    """What a step came to."""

    taxi_1: tuple[int, int]
    taxi_2: tuple[int, int]
    passenger: int
    rewards: tuple[float, float]
    ended: bool
    events: set[str]


@pytest.fixture(scope="module")
def play():
    env = DualTaxiEnv(competitive=True)

    def play(taxi_1, taxi_2, *actions, passenger=R, destination=G) -> Result:
        state = env.encode(taxi_1, taxi_2, passenger, destination)
        action = env.encode_action(*actions)
        mask = int(env.transitions.events[state, action, 0])
        ((_, after, rewards, ended),) = env.P[state][action]
        events = {name for i, name in enumerate(env.event_names) if mask >> i & 1}
        then = env.decode(after)
        assert then.destination == destination
        return Result(then.taxi_1, then.taxi_2, then.passenger, rewards, ended, events)

    return play


@pytest.mark.parametrize(
    ("action", "cell"), [(SOUTH, (2, 2)), (NORTH, (0, 2)), (EAST, (1, 3)), (WEST, (1, 2))], ids=str
)
def test_each_move_goes_its_way_unless_a_wall_is_there(play, action, cell):
    result = play((1, 2), (3, 0), action, NORTH)
    assert result == (cell, (2, 0), R, (-2, -2), False, set())


@pytest.mark.parametrize(
    ("cell", "action"),
    [((0, 0), NORTH), ((0, 0), WEST), ((3, 3), SOUTH), ((3, 3), EAST), ((0, 1), EAST), ((0, 2), WEST)],
)
def test_edges_and_walls_hold_a_taxi_for_the_price_of_a_step(play, cell, action):
    assert play(cell, (2, 1), action, EAST) == (cell, (2, 2), R, (-2, -2), False, set())
    assert play((2, 1), cell, EAST, action) == ((2, 2), cell, R, (-2, -2), False, set())


def test_a_legal_pickup_costs_nothing_and_takes_the_passenger_in(play):
    assert play(AT[R], (2, 2), PICKUP, EAST) == (AT[R], (2, 3), IN_1, (0, -2), False, {"taxi_1.pickup"})
    assert play((2, 2), AT[R], EAST, PICKUP) == ((2, 3), AT[R], IN_2, (-2, 0), False, {"taxi_2.pickup"})


@pytest.mark.parametrize(
    ("cell", "passenger"),
    [((1, 1), R), (AT[Y], R), ((1, 1), IN_1), (AT[R], IN_1), (AT[R], IN_2)],
    ids=["empty cell", "other landmark", "aboard already", "aboard, at a landmark", "in the other taxi"],
)
def test_any_other_pickup_is_illegal(play, cell, passenger):
    result = play(cell, (2, 2), PICKUP, EAST, passenger=passenger)
    assert result.passenger == passenger
    assert result.taxi_1 == cell
    assert result.rewards[0] == -10
    assert result.events == {"taxi_1.illegal_pickup"}
    assert not result.ended


def test_delivering_the_passenger_pays_a_hundred_and_ends_the_episode(play):
    result = play(AT[G], (2, 2), DROP_OFF, EAST, passenger=IN_1, destination=G)
    assert result == (AT[G], (2, 3), G, (100, -1), True, {"taxi_1.drop_off"})
    result = play((2, 2), AT[G], EAST, DROP_OFF, passenger=IN_2, destination=G)
    assert result == ((2, 3), AT[G], G, (-1, 100), True, {"taxi_2.drop_off"})


def test_putting_the_passenger_out_at_another_landmark_costs_a_step(play):
    result = play(AT[Y], (2, 2), DROP_OFF, EAST, passenger=IN_1, destination=G)
    assert result == (AT[Y], (2, 3), Y, (-2, -1), False, {"taxi_1.wrong_stop"})


@pytest.mark.parametrize(
    ("cell", "passenger"),
    [((1, 1), IN_1), ((1, 1), R), (AT[G], R), (AT[R], R), (AT[G], IN_2)],
    ids=["aboard, no landmark", "nobody, no landmark", "nobody, destination", "waiting here", "in the other"],
)
def test_any_other_drop_off_is_illegal(play, cell, passenger):
    result = play(cell, (2, 2), DROP_OFF, EAST, passenger=passenger)
    assert result.passenger == passenger
    assert result.rewards[0] == -10
    assert result.events == {"taxi_1.illegal_drop_off"}
    assert not result.ended


def test_a_taxi_pays_less_while_the_passenger_rides_in_the_other(play):
    assert play((1, 0), (2, 2), EAST, EAST, passenger=IN_1).rewards == (-2, -1)
    assert play((1, 0), (2, 2), EAST, EAST, passenger=IN_2).rewards == (-1, -2)
    assert play((1, 0), (2, 2), WEST, WEST, passenger=IN_2).rewards == (-1, -2)  # also against a wall


@pytest.mark.parametrize(
    ("taxi_1", "taxi_2", "action_1", "action_2"),
    [
        ((1, 0), (3, 0), SOUTH, NORTH),
        ((1, 0), (1, 1), EAST, PICKUP),
        ((0, 0), (1, 0), NORTH, NORTH),
        ((0, 0), (0, 1), PICKUP, WEST),
    ],
    ids=["both into one cell", "into a taxi at work", "into a taxi at the edge", "into a taxi at pickup"],
)
def test_a_collision_undoes_the_step_and_is_its_only_event(play, taxi_1, taxi_2, action_1, action_2):
    result = play(taxi_1, taxi_2, action_1, action_2)
    assert result == (taxi_1, taxi_2, R, (-15, -15), False, {"collision"})


def test_a_delivery_undone_by_a_collision_still_ends_the_episode(play):
    result = play(AT[G], (1, 3), DROP_OFF, NORTH, passenger=IN_1, destination=G)
    assert result == (AT[G], (1, 3), IN_1, (-15, -15), True, {"collision"})


def test_a_wrong_stop_undone_by_a_collision_ends_nothing(play):
    result = play(AT[Y], (2, 0), DROP_OFF, SOUTH, passenger=IN_1, destination=G)
    assert result == (AT[Y], (2, 0), IN_1, (-15, -15), False, {"collision"})


def test_taxis_that_change_places_do_not_collide(play):
    assert play((1, 0), (1, 1), EAST, WEST) == ((1, 1), (1, 0), R, (-2, -2), False, set())


def test_following_into_a_cell_that_becomes_free_is_no_collision(play):
    assert play((1, 0), (1, 1), EAST, SOUTH) == ((1, 1), (2, 1), R, (-2, -2), False, set())


def test_leaving_a_shared_cell_ends_the_episode_and_changes_no_passenger(play):
    assert play((1, 0), (1, 0), EAST, SOUTH) == ((1, 1), (2, 0), R, (-0.5, 0), True, set())
    assert play(AT[R], AT[R], PICKUP, SOUTH) == (AT[R], (1, 0), R, (-0.5, 0), True, set())


def test_staying_in_a_shared_cell_is_a_collision(play):
    assert play((1, 0), (1, 0), PICKUP, WEST) == ((1, 0), (1, 0), R, (-15, -15), False, {"collision"})
