"""What a user of the Gymnasium environment relies on."""

from __future__ import annotations

import time

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

from dualtaxi import DualTaxiEnv

SMALL = ["+-----+", "|A: :B|", "| | : |", "|C: : |", "+-----+"]
ENV = DualTaxiEnv()
COMPETITIVE = DualTaxiEnv(competitive=True)
OTHER = DualTaxiEnv(map=SMALL)


def trajectory(env: gymnasium.Env, seed: int, steps: int = 60) -> list[tuple]:
    """Return what a fixed sequence of actions meets, episode after episode."""
    choices = np.random.default_rng(0)
    seen = [(env.reset(seed=seed)[0],)]
    for _ in range(steps):
        state, reward, terminated, truncated, info = env.step(int(choices.integers(36)))
        seen.append((state, reward, terminated, truncated, info["prob"], info["action_mask"].tolist()))
        if terminated or truncated:
            seen.append((env.reset()[0],))
    return seen


@pytest.mark.parametrize("competitive", [False, True])
@pytest.mark.parametrize("arguments", [{}, {"map": SMALL, "slip": 0.2}, {"render_mode": "ansi"}], ids=str)
def test_gymnasium_finds_no_fault(competitive, arguments):
    env = gymnasium.make("dualtaxi:DualTaxi-v1", competitive=competitive, **arguments)
    check_env(env.unwrapped)


def test_spaces_are_those_of_the_published_game():
    assert ENV.observation_space == gymnasium.spaces.Discrete(6144)
    assert ENV.action_space == gymnasium.spaces.Discrete(36)
    assert (ENV.agents, ENV.agent_action_counts) == (("taxi_1", "taxi_2"), (6, 6))


def test_an_episode_is_cut_off_after_1500_steps():
    env = gymnasium.make("dualtaxi:DualTaxi-v1")
    env.reset(seed=0)
    north = ENV.encode_action(1, 1)
    cut_off = [env.step(north)[2:4] for _ in range(1500)]
    assert cut_off == [(False, False)] * 1499 + [(False, True)]


@pytest.mark.parametrize("slip", [0.0, 0.4])
def test_the_seed_of_reset_alone_decides_a_trajectory(slip):
    first, second = (gymnasium.make("dualtaxi:DualTaxi-v1", slip=slip) for _ in range(2))
    trajectory(second, seed=99, steps=7)  # a different past
    assert trajectory(first, seed=5) == trajectory(second, seed=5)
    assert trajectory(first, seed=5) != trajectory(first, seed=6)


def test_resets_draw_every_start_state_about_equally_often():
    env = DualTaxiEnv(map=["+---+", "|A:B|", "+---+"])
    env.reset(seed=1)
    counts = np.bincount([env.reset()[0] for _ in range(4000)], minlength=env.observation_space.n)
    expected = 4000 * env.initial_state_distrib
    assert np.array_equal(counts > 0, expected > 0)
    assert np.abs(counts - expected).max() < 5 * np.sqrt(expected.max())


@given(state=st.integers(0, 6143), action=st.integers(0, 35))
@settings(deadline=None)
def test_step_follows_p(state, action):
    for env in (ENV, COMPETITIVE):
        env.s = state
        after, reward, terminated, truncated, info = env.step(action)
        ((probability, next_state, rewards, ends),) = env.P[state][action]
        assert (after, terminated, truncated, info["prob"]) == (next_state, ends, False, probability)
        assert reward == np.sum(rewards)
        assert type(reward) is float


def test_step_with_slip_draws_outcomes_with_the_probabilities_of_p():
    env = DualTaxiEnv(map=SMALL, slip=0.3)
    env.reset(seed=2)
    state = env.encode((1, 1), (0, 2), 0, 1)
    action = env.encode_action(0, 1)
    counts: dict[tuple, int] = {}
    draws = 5000
    for _ in range(draws):
        env.s = state
        after, reward, terminated, _, info = env.step(action)
        outcome = (info["prob"], after, reward, terminated)
        counts[outcome] = counts.get(outcome, 0) + 1
    assert set(counts) == set(env.P[state][action])
    for (probability, *_), count in counts.items():
        spread = np.sqrt(draws * probability * (1 - probability))
        assert abs(count - draws * probability) < 5 * spread


def test_competitive_rewards_are_in_info_and_their_sum_is_the_reward():
    COMPETITIVE.reset(seed=0)
    COMPETITIVE.s = COMPETITIVE.encode((0, 3), (2, 2), 4, 1)
    _, reward, terminated, _, info = COMPETITIVE.step(COMPETITIVE.encode_action(5, 2))
    assert info["rewards"].tolist() == [100, -1]
    assert (reward, terminated) == (99, True)
    info["rewards"][:] = 0  # the user's own
    assert COMPETITIVE.transitions.rewards.any()


def test_cooperative_info_has_no_rewards_of_single_taxis():
    ENV.reset(seed=0)
    assert set(ENV.step(0)[4]) == {"prob", "action_mask"}


@given(state=st.integers(0, 6143))
@settings(deadline=None)
def test_the_mask_leaves_out_walls_and_illegal_actions_and_nothing_else(state):
    mask = ENV.action_mask(state)
    assert mask.dtype == np.int8
    assert mask.any()
    taxis = ENV.decode(state)[:2]
    for action in range(36):
        legal = True
        for taxi, single in enumerate(ENV.decode_action(action)):
            legal &= _is_legal(ENV, taxis[taxi], single, state, taxi)
        assert mask[action] == legal


def _is_legal(env, cell, action, state, taxi) -> bool:
    _, _, passenger, _ = env.decode(state)
    landmarks = [(0, 0), (0, 3), (3, 0), (3, 2)]
    row, column = cell
    if action < 2:
        return row < 3 if action == 0 else row > 0
    if action < 4:
        walls = {((0, 1), (0, 2)), ((1, 1), (1, 2)), ((2, 0), (2, 1)), ((3, 1), (3, 2))}
        neighbour = (row, column + (1 if action == 2 else -1))
        return 0 <= neighbour[1] <= 3 and tuple(sorted((cell, neighbour))) not in walls
    if action == 4:
        return passenger < 4 and landmarks[passenger] == cell
    return passenger == 4 + taxi and cell in landmarks


def test_the_mask_in_info_is_that_of_the_state_and_the_users_own():
    state, info = ENV.reset(seed=3)
    assert np.array_equal(info["action_mask"], ENV.action_mask(state))
    info["action_mask"][:] = 0
    assert ENV.action_mask(state).any()
    state, _, _, _, info = ENV.step(0)
    assert np.array_equal(info["action_mask"], ENV.action_mask(state))


def test_masked_sampling_never_meets_an_illegal_action():
    env = DualTaxiEnv(competitive=True)
    env.action_space.seed(0)
    _, info = env.reset(seed=0)
    for _ in range(300):
        _, _, ended, _, info = env.step(env.action_space.sample(info["action_mask"]))
        assert -10 not in info["rewards"]
        if ended:
            _, info = env.reset()


@given(state=st.integers(0, 6143))
def test_decode_undoes_encode(state):
    assert ENV.encode(*ENV.decode(state)) == state


@given(data=st.data())
def test_encode_undoes_decode_on_another_map(data):
    cell = st.tuples(st.integers(0, 2), st.integers(0, 2))
    fields = data.draw(st.tuples(cell, cell, st.integers(0, 4), st.integers(0, 2)))
    assert OTHER.decode(OTHER.encode(*fields)) == fields


def test_encode_numbers_states_as_published():
    assert ENV.encode((1, 2), (3, 0), 5, 2) == ((((1 * 4 + 2) * 4 + 3) * 4 + 0) * 6 + 5) * 4 + 2
    assert ENV.decode(6143) == ((3, 3), (3, 3), 5, 3)


@given(first=st.integers(0, 5), second=st.integers(0, 5))
def test_joint_actions_have_the_first_taxi_most_significant(first, second):
    action = ENV.encode_action(first, second)
    assert action == first * 6 + second
    assert ENV.decode_action(action) == (first, second)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: ENV.encode((4, 0), (0, 0), 0, 1),
            r"row of taxi_1 is 4, expected a whole number from 0 to 3",
        ),
        (lambda: ENV.encode((0, 0), (0, -1), 0, 1), r"column of taxi_2 is -1"),
        (lambda: ENV.encode((0, 0), (0, 1), 6, 1), r"passenger is 6, .* 0 to 5"),
        (lambda: ENV.encode((0, 0), (0, 1), 0, 4), r"destination is 4, .* 0 to 3"),
        (lambda: ENV.encode((0, 0), (0, 1), 0.5, 1), r"passenger is 0.5"),
        (lambda: ENV.decode(6144), r"state is 6144, .* 0 to 6143"),
        (lambda: ENV.decode_action(36), r"joint action is 36, .* 0 to 35"),
        (lambda: ENV.encode_action(0, 6), r"action of taxi_2 is 6"),
    ],
)
def test_numbers_out_of_range_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_step_refuses_an_unknown_action_and_leaves_the_game_alone():
    state, _ = ENV.reset(seed=0)
    with pytest.raises(ValueError, match="joint action is 36"):
        ENV.step(36)
    assert ENV.s == state


def test_nothing_happens_before_the_first_reset():
    env = DualTaxiEnv("ansi")
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(0)
    with pytest.raises(ResetNeeded, match="reset"):
        env.render()


def test_the_tables_cannot_be_written_to():
    arrays = [*vars(ENV.transitions).values(), ENV.initial_state_distrib, ENV.scene_cells, ENV.scene_carriers]
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


def test_changes_to_one_instance_do_not_affect_another():
    plain = DualTaxiEnv()
    before = trajectory(plain, seed=4)
    strange = DualTaxiEnv(rewards={"step": 7, "collision": 3}, map=SMALL, slip=1.0, competitive=True)
    strange.reset(seed=0)
    strange.P[0][0].clear()
    strange.scene["landmarks"].clear()
    for env in (plain, DualTaxiEnv()):
        assert trajectory(env, seed=4) == before
        assert len(env.P[0][0]) == 1
        assert len(env.scene["landmarks"]) == 4
    assert len(strange.scene["landmarks"]) == 3


def test_changing_p_changes_no_step():
    env = DualTaxiEnv(map=SMALL)
    before = trajectory(env, seed=8)
    for actions in env.P.values():
        actions.clear()
    assert trajectory(env, seed=8) == before


def test_an_environment_is_made_quickly():
    DualTaxiEnv()
    times = []
    for _ in range(5):
        start = time.perf_counter()
        DualTaxiEnv()
        times.append(time.perf_counter() - start)
    assert min(times) < 0.1  # about 0.01 s; P, which takes 0.3 s, must not be built
