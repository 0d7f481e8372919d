"""Names of states and actions for people."""

import dataclasses

import numpy as np
import pytest

from runner.environments.loading import load_mdp
from runner.environments.naming import (
    action_names,
    actions_in_words,
    agent_actions,
    event_in_words,
    joint_action,
    spoken,
    states_in_words,
)
from runner.errors import ConfigError


@pytest.fixture(scope="module")
def dualtaxi():
    return load_mdp("dualtaxi:DualTaxi-v1", {})


def test_states_of_dualtaxi(dualtaxi):
    words = states_in_words(dualtaxi)
    # ((((row 1 * 4 + column 1) * 4 + row 2) * 4 + column 2) * 6 + passenger) * 4 + destination
    state = ((((0 * 4 + 0) * 4 + 3) * 4 + 2) * 6 + 0) * 4 + 3
    assert words[state] == "taxi 1 (0,0), taxi 2 (3,2), passenger at R, destination B"
    assert words[state + 5 * 4] == "taxi 1 (0,0), taxi 2 (3,2), passenger in taxi 2, destination B"
    assert len(set(words)) == dualtaxi.states


def test_actions_of_dualtaxi(dualtaxi):
    words = actions_in_words(dualtaxi)
    assert words[0 * 6 + 4] == "south + pickup"
    assert words[5 * 6 + 3] == "drop-off + west"
    assert len(set(words)) == 36
    names = action_names(dualtaxi)
    for action in range(36):
        parts = [names[agent][own] for agent, own in enumerate(agent_actions(dualtaxi, action))]
        assert words[action] == " + ".join(parts)


def test_a_number_with_many_zeros_is_no_way_around_the_bound(dualtaxi):
    assert joint_action(dualtaxi, "035") == 35
    with pytest.raises(ConfigError, match="a number from 0 to 35"):
        joint_action(dualtaxi, "0" * 12 + "99999")


def test_words_can_be_indexed_by_arrays(dualtaxi):
    assert states_in_words(dualtaxi)[dualtaxi.next_state[:3, :2, 0]].shape == (3, 2)


def test_without_a_scene(dualtaxi):
    mdp = dataclasses.replace(dualtaxi, scene=None, scene_cells=None, scene_carriers=None)
    assert states_in_words(mdp)[[0, 6143]].tolist() == ["state 0", "state 6143"]
    assert actions_in_words(mdp)[[0, 35]].tolist() == ["action 0", "action 35"]
    assert action_names(mdp) is None


def test_a_scene_of_another_kind(dualtaxi):
    """One mover, a thing that lies in any cell, no carriers, actions that are not named."""
    scene = {
        "rows": 1,
        "columns": 2,
        "walls": [],
        "actions": [],
        "landmarks": [{"name": "Home", "cell": [0, 1]}],
        "things": [
            {"name": "cat", "label": "cat", "kind": "mover"},
            {"name": "ball", "label": "ball", "kind": "passenger"},
        ],
    }
    mdp = dataclasses.replace(
        dualtaxi, scene=scene, scene_cells=np.array([[0, 0], [1, 1]], np.int16), scene_carriers=None
    )
    assert states_in_words(mdp).tolist() == ["cat (0,0), ball (0,0)", "cat (0,1), ball at Home"]
    assert actions_in_words(mdp)[3] == "action 3"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("taxi_1.drop_off", "taxi 1 drop-off"),
        ("collision", "collision"),
        ("a.illegal_drop_off", "a illegal drop-off"),
    ],
)
def test_events(name, words):
    assert event_in_words(name) == words
    assert spoken("wrong_stop") == "wrong stop"
