"""The transition table as a whole: the published one at the defaults, well formed at any parameters."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualtaxi import DualTaxiEnv

PUBLISHED = "539e350492c4712e2efcd347cf9389d8186bd0b5a383f80d1a5b5e18b3a874cd"
SMALL = ["+---+", "|A: |", "| |B|", "+---+"]

probabilities = st.sampled_from([0.0, 0.1, 0.5, 1.0]) | st.floats(0, 1)


@pytest.fixture(scope="module")
def competitive():
    return DualTaxiEnv(competitive=True)


@pytest.fixture(scope="module")
def cooperative():
    return DualTaxiEnv()


def digest(env: DualTaxiEnv) -> str:
    """SHA-256 over next state (int16), both rewards (float32) and termination, little-endian, C order."""
    table = env.transitions
    parts = (table.next_state.astype("<i2"), table.rewards.astype("<f4"), table.terminated.astype("?"))
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def test_the_defaults_are_the_published_table(competitive):
    assert digest(competitive) == PUBLISHED


def test_the_arrays_have_the_promised_shapes_and_types(competitive, cooperative):
    for env, rewards in ((cooperative, 1), (competitive, 2)):
        table = env.transitions
        assert table.next_state.shape == table.probability.shape == (6144, 36, 1)
        assert table.terminated.shape == table.events.shape == (6144, 36, 1)
        assert table.rewards.shape == (6144, 36, 1, rewards)
        kinds = (table.next_state, table.probability, table.rewards, table.terminated, table.events)
        assert [array.dtype.name for array in kinds] == ["int32", "float64", "float64", "bool", "uint32"]


def test_the_cooperative_game_differs_in_nothing_but_the_sum_of_rewards(competitive, cooperative):
    theirs, ours = competitive.transitions, cooperative.transitions
    assert np.array_equal(ours.rewards[..., 0], theirs.rewards.sum(axis=-1))
    for name in ("next_state", "probability", "terminated", "events"):
        assert np.array_equal(getattr(ours, name), getattr(theirs, name))


def test_episodes_start_uniformly_over_2880_states(cooperative):
    starts = cooperative.initial_state_distrib
    assert starts.shape == (6144,)
    assert set(np.unique(starts)) == {0.0, 1 / 2880}
    assert starts.sum() == pytest.approx(1)
    for state in np.flatnonzero(starts):
        taxi_1, taxi_2, passenger, destination = cooperative.decode(int(state))
        assert taxi_1 != taxi_2
        assert passenger in {0, 1, 2, 3} - {destination}


def test_no_state_with_both_taxis_in_one_cell_is_ever_reached(cooperative):
    reached = np.zeros(6144, dtype=bool)
    frontier = np.flatnonzero(cooperative.initial_state_distrib)
    while frontier.size:
        reached[frontier] = True
        after = np.unique(cooperative.transitions.next_state[frontier])
        frontier = after[~reached[after]]
    assert reached.sum() > 2880
    assert all(s.taxi_1 != s.taxi_2 for s in map(cooperative.decode, np.flatnonzero(reached).tolist()))


def test_p_agrees_with_the_arrays(competitive, cooperative):
    for env in (competitive, cooperative):
        table = env.transitions
        assert len(env.P) == 6144
        assert {len(actions) for actions in env.P.values()} == {36}
        for state in range(0, 6144, 29):
            for action in range(36):
                (probability, next_state, reward, terminated), *more = env.P[state][action]
                assert not more
                assert (probability, next_state) == (1.0, table.next_state[state, action, 0])
                assert np.array_equal(np.atleast_1d(reward), table.rewards[state, action, 0])
                assert terminated is bool(table.terminated[state, action, 0])


def test_rewards_in_p_are_a_number_or_a_pair(competitive, cooperative):
    assert isinstance(cooperative.P[0][0][0][2], float)
    first, second = competitive.P[0][0][0][2]
    assert isinstance(first, float)
    assert isinstance(second, float)


@given(slip=probabilities, competitive=st.booleans())
@settings(max_examples=25, deadline=None)
def test_outcomes_are_distinct_sum_to_one_and_are_padded_at_the_end(slip, competitive):
    env = DualTaxiEnv(map=SMALL, slip=slip, competitive=competitive)
    table = env.transitions
    assert np.allclose(table.probability.sum(axis=2), 1, rtol=0, atol=1e-12)
    real = table.probability > 0
    assert np.array_equal(real, np.sort(real, axis=2)[..., ::-1])
    assert real[..., -1].any()  # no column of nothing but padding
    padding = ~real
    for name in ("next_state", "rewards", "terminated", "events"):
        assert not getattr(table, name)[padding].any()
    for actions in env.P.values():
        for outcomes in actions.values():
            assert len({outcome[1:] for outcome in outcomes}) == len(outcomes)


def test_p_with_slip_agrees_with_the_arrays():
    env = DualTaxiEnv(map=SMALL, slip=0.3)
    table = env.transitions
    for state, actions in env.P.items():
        for action, outcomes in actions.items():
            real = np.flatnonzero(table.probability[state, action])
            assert [o[0] for o in outcomes] == table.probability[state, action, real].tolist()
            assert [o[1] for o in outcomes] == table.next_state[state, action, real].tolist()
            assert [o[2] for o in outcomes] == table.rewards[state, action, real, 0].tolist()
            assert [o[3] for o in outcomes] == table.terminated[state, action, real].tolist()


def test_success_is_exactly_a_summed_reward_above_ten(cooperative):
    table = cooperative.transitions
    success = sum(1 << cooperative.event_names.index(name) for name in cooperative.success_events)
    assert np.array_equal((table.events & success) != 0, table.rewards[..., 0] > 10)


def test_events_account_for_the_rewards(competitive):
    """Each taxi's reward follows from its event bits, outside the states with both in one cell."""
    bit = {name: 1 << i for i, name in enumerate(competitive.event_names)}
    table = competitive.transitions
    places = competitive.scene_cells
    apart = places[:, 0] != places[:, 1]
    events = table.events[apart][..., 0]
    for number, taxi in enumerate(competitive.agents):
        rewards = table.rewards[apart][..., 0, number]
        worth = {
            "pickup": 0,
            "drop_off": 100,
            "wrong_stop": -2,
            "illegal_pickup": -10,
            "illegal_drop_off": -10,
        }
        named = np.zeros(events.shape, dtype=bool)
        for name, value in worth.items():
            has = (events & bit[f"{taxi}.{name}"]) != 0
            assert has.any()
            assert set(rewards[has]) == {value}
            named |= has
        collision = (events & bit["collision"]) != 0
        assert set(rewards[collision]) == {-15}
        assert not (named & collision).any()
        assert set(rewards[~named & ~collision]) == {-2, -1}
