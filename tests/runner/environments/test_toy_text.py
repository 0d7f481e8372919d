"""Gymnasium's grid worlds: scenes and events against the environments, and the shipped configurations."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import pytest

import runner
from runner.environments.loading import load_mdp
from runner.environments.naming import states_in_words
from runner.errors import EnvironmentNotUsable
from runner.execution.verify import verify

CONFIGS = Path(__file__).parents[3] / "configs"
WORLDS = {
    "taxi": ("Taxi-v4", {}),
    "rain": ("Taxi-v4", {"is_rainy": True}),
    "ice": ("FrozenLake-v1", {"is_slippery": True}),
    "large lake": ("FrozenLake-v1", {"map_name": "8x8", "is_slippery": False}),
    "own lake": ("FrozenLake-v1", {"desc": ["SFH", "FFG"], "reward_schedule": [5, -2, -1]}),
    "cliff": ("CliffWalking-v1", {"max_episode_steps": 100}),
    "windy cliff": ("CliffWalking-v1", {"is_slippery": True, "max_episode_steps": 100}),
}


def happened(mdp, state, action, successor, reward, over):
    """Return the events of the outcome that is this one."""
    for k in np.flatnonzero(mdp.probability[state, action] > 0):
        same = (
            mdp.next_state[state, action, k],
            mdp.rewards[state, action, k, 0],
            mdp.terminated[state, action, k],
        )
        if same == (successor, reward, over):
            return {n for bit, n in enumerate(mdp.event_names) if mdp.events[state, action, k] >> bit & 1}
    raise AssertionError("an outcome that is not in the table")


def walk(world, steps=2000):
    """Yield the steps of a random walk in the real environment with the events that the adapter names."""
    env_id, kwargs = WORLDS[world]
    mdp, env = load_mdp(env_id, kwargs), gymnasium.make(env_id, **kwargs)
    state, _ = env.reset(seed=7)
    env.action_space.seed(7)
    for _ in range(steps):
        action = int(env.action_space.sample())
        successor, reward, terminated, truncated, _ = env.step(action)
        yield (
            env.unwrapped,
            state,
            action,
            reward,
            happened(mdp, state, action, successor, reward, terminated),
            successor,
        )
        state = env.reset()[0] if terminated or truncated else successor
    env.close()


@pytest.mark.parametrize("world", ["taxi", "rain"])
def test_taxi_events_are_what_the_rewards_say(world):
    seen = set()
    for env, state, action, reward, events, successor in walk(world, 20_000):
        aboard, aboard_after = env.decode(state)[2] == 4, env.decode(successor)[2] == 4
        expected = set()
        if action == 4:
            expected = {"illegal_pickup"} if reward == -10 else {"pickup"}
            assert ("pickup" in expected) == (aboard_after and not aboard)
        elif action == 5:
            expected = {20: {"drop_off"}, -10: {"illegal_drop_off"}}.get(reward, {"wrong_stop"})
        assert events == expected
        seen |= events
    assert seen == {"pickup", "drop_off", "wrong_stop", "illegal_pickup", "illegal_drop_off"}


@pytest.mark.parametrize("world", ["ice", "large lake", "own lake"])
def test_lake_events_are_the_tiles_that_are_entered(world):
    named = {b"G": {"goal"}, b"H": {"hole"}}
    for env, _, _, _, events, successor in walk(world):
        assert events == named.get(bytes(env.desc.ravel()[successor]), set())


@pytest.mark.parametrize("world", ["cliff", "windy cliff"])
def test_cliff_events_are_falls_and_the_goal(world):
    for _, _, _, reward, events, successor in walk(world):
        assert events == ({"fall"} if reward == -100 else {"goal"} if successor == 47 else set())


@pytest.mark.parametrize("world", WORLDS)
def test_moves_on_the_scene_are_what_the_environment_does(world):
    """A sure move leads where the scene's moves and walls say, or nowhere."""
    mdp = load_mdp(*WORLDS[world])
    scene = mdp.scene
    walls = {frozenset(map(tuple, wall)) for wall in scene["walls"]}
    for state in range(mdp.states):
        here = divmod(int(mdp.scene_cells[state, 0]), scene["columns"])
        for number, action in enumerate(scene["actions"]):
            sure = mdp.probability[state, number].max() == 1
            over = mdp.terminated[state, number, 0] and mdp.next_state[state, number, 0] == state
            if not sure or over or action["move"] is None or mdp.rewards[state, number, 0, 0] == -100:
                continue
            there = (here[0] + action["move"][0], here[1] + action["move"][1])
            inside = 0 <= there[0] < scene["rows"] and 0 <= there[1] < scene["columns"]
            free = inside and frozenset((here, there)) not in walls
            found = divmod(int(mdp.scene_cells[mdp.next_state[state, number, 0], 0]), scene["columns"])
            assert found == (there if free else here)


def test_a_taxis_states_are_the_environments():
    mdp, env = load_mdp("Taxi-v4", {}), gymnasium.make("Taxi-v4").unwrapped
    words = states_in_words(mdp)
    for state in range(mdp.states):
        row, column, passenger, goal = env.decode(state)
        where = "in taxi" if passenger == 4 else f"at {'RGYB'[passenger]}"
        assert words[state] == f"taxi ({row},{column}), passenger {where}, destination {'RGYB'[goal]}"
    assert ((mdp.scene_carriers[:, 1] == 0) == [env.decode(s)[2] == 4 for s in range(500)]).all()


def test_a_fickle_passenger_is_refused():
    with pytest.raises(
        EnvironmentNotUsable, match=r"fickle_passenger=True.*outside of the transition table.*False"
    ):
        load_mdp("Taxi-v4", {"fickle_passenger": True})


SHIPPED = {"taxi": 95, "frozen_lake": 100, "frozen_lake_slippery": 65, "cliff_walking": 100}


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_configurations_learn_and_are_verified(name, tmp_path):
    run = runner.run(CONFIGS / f"{name}.yaml", recordings=tmp_path)
    assert run.summary["last_evaluation"]["success_percent"] >= SHIPPED[name]
    found = verify(run.recording, rerun=True)
    assert found.sound, found.finding
