"""Rewards, map and slip: each changes what it should and nothing else; bad ones are refused by name."""

from __future__ import annotations

import json

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualtaxi import DEFAULT_MAP, DualTaxiEnv, Rewards

PLAIN = DualTaxiEnv(competitive=True)
SOUTH, NORTH, EAST, WEST, PICKUP, DROP_OFF = range(6)
# How often each reward is paid in the published table, found by its value.
PAID = {
    "step": -2.0,
    "idle_step": -1.0,
    "pickup": 0.0,
    "illegal_action": -10.0,
    "drop_off": 100.0,
    "collision": -15.0,
}


@pytest.fixture(scope="module")
def slippery():
    return DualTaxiEnv(slip=0.2)


def has_event(env: DualTaxiEnv, name: str) -> np.ndarray:
    return (env.transitions.events & (1 << env.event_names.index(name))) != 0


def outcomes_of(env: DualTaxiEnv, state: int, *actions: int) -> list[tuple[float, int, float, bool]]:
    """Return what P holds for two actions, without the wait for the whole of P."""
    table, action = env.transitions, env.encode_action(*actions)
    return [
        (probability, int(after), float(rewards.sum()), bool(ends))
        for probability, after, rewards, ends in zip(
            table.probability[state, action].tolist(),
            table.next_state[state, action],
            table.rewards[state, action],
            table.terminated[state, action],
            strict=True,
        )
        if probability > 0
    ]


def bare(*rows: str) -> list[str]:
    """Return rows in a frame."""
    frame = "+" + "-" * (len(rows[0]) - 2) + "+"
    return [frame, *rows, frame]


@pytest.mark.parametrize("name", PAID)
def test_a_reward_changes_where_it_is_paid_and_nowhere_else(name):
    # Only a wrong stop is worth a step by default, and leaving a shared cell pays 0 as a pickup does.
    env = DualTaxiEnv(competitive=True, rewards={name: 777, "wrong_drop_off": -2.0})
    apart = PLAIN.scene_cells[:, 0] != PLAIN.scene_cells[:, 1]
    old, new = PLAIN.transitions.rewards[apart], env.transitions.rewards[apart]
    expected = np.where(old == PAID[name], 777, old)
    for taxi, agent in enumerate(env.agents):
        wrong_stop = has_event(env, f"{agent}.wrong_stop")[apart]
        expected[..., taxi] = np.where(wrong_stop, -2, expected[..., taxi])
    assert np.array_equal(new, expected)
    for part in ("next_state", "probability", "terminated", "events"):
        assert np.array_equal(getattr(env.transitions, part), getattr(PLAIN.transitions, part))


def test_a_wrong_stop_costs_a_step_by_default():
    for rewards, worth in (({}, -2), ({"step": -3}, -3), ({"step": -3, "wrong_drop_off": -50}, -50)):
        env = DualTaxiEnv(competitive=True, rewards=rewards)
        wrong_stop = has_event(env, "taxi_1.wrong_stop")
        assert wrong_stop.any()
        assert set(env.transitions.rewards[..., 0][wrong_stop]) == {worth}


def test_rewards_may_be_a_mapping_or_rewards():
    as_mapping = DualTaxiEnv(rewards={"drop_off": 50})
    as_rewards = DualTaxiEnv(rewards=Rewards(drop_off=50))
    assert as_mapping.rewards == as_rewards.rewards
    assert np.array_equal(as_mapping.transitions.rewards, as_rewards.transitions.rewards)


@pytest.mark.parametrize(
    ("rewards", "message"),
    [
        ({"dropoff": 50}, r"unknown name 'dropoff'; did you mean 'drop_off'\? the names are step, idle_step"),
        ({"zzz": 1}, r"unknown name 'zzz'; the names are"),
        ({"step": "-2"}, r"rewards.step is '-2', expected a finite number"),
        ({"step": float("nan")}, r"rewards.step is nan"),
        ({"collision": float("inf")}, r"rewards.collision is inf"),
        ({"pickup": True}, r"rewards.pickup is True"),
        ({"step": None}, r"rewards.step is None"),
        ([1, 2], r"rewards is \[1, 2\], expected a mapping"),
    ],
)
def test_bad_rewards_are_refused(rewards, message):
    with pytest.raises(ValueError, match=message):
        DualTaxiEnv(rewards=rewards)


@pytest.mark.parametrize("slip", [-0.1, 1.1, float("nan"), float("inf"), "0.1", True, None])
def test_a_slip_that_is_no_probability_is_refused(slip):
    with pytest.raises(ValueError, match=r"slip is .*, expected a probability from 0 to 1"):
        DualTaxiEnv(slip=slip)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"render_mode": "human"}, r"render_mode is 'human', expected one of ansi, rgb_array"),
        ({"competitive": "no"}, r"competitive is 'no', expected True or False"),
    ],
)
def test_other_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        DualTaxiEnv(**arguments)


def test_slip_turns_a_move_to_either_side_half_as_often_each(slippery):
    env = slippery
    state = env.encode((1, 2), (3, 3), 0, 1)
    outcomes = outcomes_of(env, state, NORTH, PICKUP)
    where = {env.decode(after).taxi_1: probability for probability, after, _, _ in outcomes}
    # West of (1, 2) is a wall: who slips there stays.
    assert where == pytest.approx({(0, 2): 0.8, (1, 3): 0.1, (1, 2): 0.1})


def test_slip_is_independent_for_each_taxi(slippery):
    env = slippery
    state = env.encode((1, 0), (2, 2), 0, 1)
    outcomes = outcomes_of(env, state, EAST, EAST)
    assert sorted(o[0] for o in outcomes) == pytest.approx([0.01] * 4 + [0.08] * 4 + [0.64])
    assert env.transitions.probability.shape[2] == 9


def test_pickup_and_drop_off_never_slip():
    env = DualTaxiEnv(slip=1.0)
    quiet = [env.encode_action(a, b) for a in (PICKUP, DROP_OFF) for b in (PICKUP, DROP_OFF)]
    published = DualTaxiEnv().transitions
    for name in ("next_state", "rewards", "terminated", "events"):
        assert np.array_equal(
            getattr(env.transitions, name)[:, quiet, 0], getattr(published, name)[:, quiet, 0]
        )
    assert (env.transitions.probability[:, quiet, 0] == 1).all()


def test_always_slipping_never_goes_ahead():
    env = DualTaxiEnv(slip=1.0)
    state = env.encode((1, 0), (2, 2), 0, 1)
    outcomes = outcomes_of(env, state, EAST, PICKUP)
    assert {env.decode(o[1]).taxi_1: o[0] for o in outcomes} == {(0, 0): 0.5, (2, 0): 0.5}


def test_slipping_into_the_other_taxi_is_a_collision(slippery):
    env = slippery
    state = env.encode((1, 0), (0, 0), 1, 2)
    outcomes = outcomes_of(env, state, EAST, NORTH)
    (collision,) = [o for o in outcomes if o[2] == -30]
    assert collision[:2] == (pytest.approx(0.1 * (0.8 + 0.1)), state)
    assert sum(o[0] for o in outcomes) == pytest.approx(1)


@given(rows=st.integers(1, 4), columns=st.integers(1, 4), landmarks=st.integers(2, 4), data=st.data())
@settings(max_examples=25, deadline=None)
def test_any_rectangle_with_two_landmarks_is_a_map(rows, columns, landmarks, data):
    if rows * columns < landmarks:
        columns, rows = 2, 2
    cells = data.draw(st.permutations(range(rows * columns)))[:landmarks]
    letters = dict(zip(cells, "KXAR", strict=False))
    text = bare(
        *(
            "|" + ":".join(letters.get(row * columns + column, " ") for column in range(columns)) + "|"
            for row in range(rows)
        )
    )
    env = DualTaxiEnv(map=text)
    states = (rows * columns) ** 2 * (landmarks + 2) * landmarks
    assert env.observation_space.n == len(env.initial_state_distrib) == states
    assert env.transitions.next_state.shape == (states, 36, 1)
    assert env.transitions.next_state.max() < states
    assert [mark["name"] for mark in env.scene["landmarks"]] == [letters[cell] for cell in sorted(cells)]


def test_the_walls_of_a_map_hold():
    env = DualTaxiEnv(map=bare("|A|B|", "| : |"))
    above, below = (env.P[env.encode((row, 0), (1 - row, 1), 0, 1)][EAST * 6 + PICKUP] for row in (0, 1))
    assert env.decode(above[0][1]).taxi_1 == (0, 0)
    assert env.transitions.events[env.encode((1, 0), (0, 1), 0, 1), EAST * 6 + PICKUP, 0] == 1 << (
        env.event_names.index("taxi_2.illegal_pickup")
    )
    assert env.decode(below[0][1]).taxi_1 == (1, 1)


def test_the_map_given_out_is_the_published_one():
    assert np.array_equal(
        DualTaxiEnv(map=list(DEFAULT_MAP), competitive=True).transitions.next_state,
        PLAIN.transitions.next_state,
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("+-+", r"map is '\+-\+', expected a list of strings"),
        ([1, 2, 3], r"expected a list of strings"),
        (7, r"map is 7, expected a list of strings"),
        ([], r"map has 0 lines"),
        (["+--+", "|AB|", "+--+"], r"lines of 4 characters, expected .* odd"),
        (["+---+", "|A:B|", "#---#"], r"map line 2 is '#---#', expected the frame '\+---\+'"),
        (["+---+", "|A:B", "+---+"], r"map line 1 \('\|A:B'\) has 4 characters, expected 5"),
        (bare("|A:B ", "| : |"), r"map line 1 .* without '\|'"),
        (bare("|A:b|"), r"map line 1 .* has 'b' in column 1, expected a space, or a landmark's letter"),
        (bare("|A B|"), r"has ' ' between columns 0 and 1, expected ':' \(open\) or '\|' \(wall\)"),
        (bare("|A: |"), r"map has 1 landmarks, expected at least 2"),
        (bare("|A:A|"), r"landmark 'A' more than once"),
        (bare("|A|B|"), r"wall between columns 0 and 1 in every row"),
        (bare("|A" + ": " * 18 + ":B|", *["| " + ": " * 19 + "|"] * 19), r"use a smaller map"),
    ],
)
def test_bad_maps_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        DualTaxiEnv(map=text)


def test_a_specification_with_parameters_survives_json():
    env = gymnasium.make("dualtaxi:DualTaxi-v1", rewards={"drop_off": 50}, map=list(DEFAULT_MAP), slip=0.5)
    text = env.spec.to_json()
    assert json.loads(text)["kwargs"]["slip"] == 0.5
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(text))
    assert again.unwrapped.rewards.drop_off == 50
