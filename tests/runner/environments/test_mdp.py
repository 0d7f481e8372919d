"""Environments as arrays: equal to Gymnasium's tables, or refused with the reason."""

from __future__ import annotations

import json
import sys
from dataclasses import fields, replace

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.toy_text.taxi import TaxiEnv
from hypothesis import given, settings
from hypothesis import strategies as st

from runner.config.sections import frozen
from runner.environments.loading import load_mdp
from runner.environments.mdp import Mdp, from_parts
from runner.errors import EnvironmentNotUsable

DUALTAXI = "dualtaxi:DualTaxi-v1"
TABULAR = {
    "DualTaxi": (DUALTAXI, {}),
    "DualTaxi, slipping": (DUALTAXI, {"slip": 0.25}),
    "Taxi": ("Taxi-v4", {}),
    "Taxi in the rain": ("Taxi-v4", {"is_rainy": True}),
    "CliffWalking": ("CliffWalking-v1", {}),
    "CliffWalking, slippery": ("CliffWalking-v1", {"is_slippery": True}),
    "FrozenLake": ("FrozenLake-v1", {"map_name": "8x8"}),
    "FrozenLake, dry": ("FrozenLake-v1", {"is_slippery": False}),
}


@pytest.fixture(scope="module", params=TABULAR)
def loaded(request):
    """Return an environment's arrays, and the environment made by Gymnasium alone."""
    env_id, kwargs = TABULAR[request.param]
    env = gymnasium.make(env_id, **kwargs)
    yield load_mdp(env_id, kwargs), env
    env.close()


def test_arrays_hold_the_table_and_nothing_else(loaded):
    mdp, env = loaded
    table = env.unwrapped.P
    rng = np.random.default_rng(0)
    for state in {*rng.integers(0, mdp.states, 300).tolist(), 0, mdp.states - 1}:
        for action in range(mdp.joint_actions):
            at = state, action
            outcomes = list(
                zip(
                    mdp.probability[at].tolist(),
                    mdp.next_state[at].tolist(),
                    mdp.rewards[at][:, 0].tolist(),
                    mdp.terminated[at].tolist(),
                    strict=True,
                )
            )
            real = len(table[state][action])
            assert outcomes[:real] == [tuple(outcome) for outcome in table[state][action]]
            assert not any(probability for probability, *_ in outcomes[real:])


def test_starts_step_limit_and_sizes_are_the_environments(loaded):
    mdp, env = loaded
    assert mdp.start.tolist() == env.unwrapped.initial_state_distrib.tolist()
    assert mdp.step_limit == (env.spec.max_episode_steps or 0)
    assert (mdp.states, mdp.joint_actions) == (env.observation_space.n, env.action_space.n)


class Unknown(TaxiEnv):
    """An environment with a transition table that nobody has described."""


def test_what_an_environment_does_not_say_is_left_out():
    if "Unknown-v0" not in gymnasium.registry:
        gymnasium.register("Unknown-v0", Unknown)
    taxi = load_mdp("Unknown-v0", {})
    assert (taxi.agents, taxi.action_counts) == (("agent",), (6,))
    assert (taxi.event_names, taxi.success_events, taxi.success_mask) == ((), (), 0)
    assert taxi.penalty_below == -np.inf
    assert taxi.scene is taxi.scene_cells is taxi.scene_carriers is None


def test_dualtaxi_declares_agents_events_and_scene():
    mdp = load_mdp(DUALTAXI, {}, "individual")
    assert (mdp.agents, mdp.action_counts) == (("taxi_1", "taxi_2"), (6, 6))
    assert set(mdp.success_events) <= set(mdp.event_names)
    assert mdp.success_mask == sum(1 << mdp.event_names.index(name) for name in mdp.success_events) > 0
    assert mdp.penalty_below == -2
    assert len(mdp.scene_cells) == len(mdp.scene_carriers) == mdp.states
    assert mdp.scene["rows"] == 4


def test_individual_rewards_are_a_column_an_agent_and_team_rewards_their_sum():
    team, individual = load_mdp(DUALTAXI, {}), load_mdp(DUALTAXI, {}, "individual")
    assert team.rewards.shape[-1] == 1
    assert individual.rewards.shape[-1] == 2
    assert np.array_equal(team.summed_rewards, individual.summed_rewards)
    assert np.array_equal(individual.rewards_of(2), individual.rewards)
    assert np.array_equal(team.rewards_of(2)[..., 1], team.summed_rewards)


def test_the_step_limit_can_be_set_as_gymnasium_lets_one():
    assert load_mdp("CliffWalking-v1", {"max_episode_steps": 50}).step_limit == 50


def test_description_and_arrays_make_the_same_mdp_again(loaded):
    mdp, _ = loaded
    again = from_parts(json.loads(json.dumps(mdp.description())), mdp.arrays())
    for field in fields(Mdp):
        first, second = getattr(mdp, field.name), getattr(again, field.name)
        if isinstance(first, np.ndarray):
            assert first.dtype == second.dtype
            assert np.array_equal(first, second)
        elif field.name in ("kwargs", "scene"):
            assert json.dumps(first) == json.dumps(second)
        else:
            assert first == second, field.name


REFUSED = {
    "no such id": ("Taxy-v4", {}, r"'Taxy-v4'.*knows no such id.*'Taxi-v4'"),
    "nothing near": ("Zzzzzzzz-v0", {}, r"'Zzzzzzzz-v0'.*knows no such id\.$"),
    "an old version": ("Taxi-v3", {}, r"'Taxi-v3'.*Did you mean 'Taxi-v4'\?"),
    "an old version of a module's": ("dualtaxi:DualTaxi-v0", {}, r"Did you mean 'dualtaxi:DualTaxi-v1'\?"),
    "no such module": ("nosuchmodule:Taxi-v4", {}, r"no module 'nosuchmodule'.*install.*env\.id"),
    "no such part of a module": ("dualtaxi.nosuch:Taxi-v4", {}, r"no module 'dualtaxi.nosuch'"),
    "no table": ("CartPole-v1", {}, r"'CartPole-v1' offers no transition table.*Taxi-v4"),
    "no table, but discrete": ("Blackjack-v1", {}, r"'Blackjack-v1' offers no transition table"),
    "unknown argument": ("Taxi-v4", {"colour": "red"}, r"cannot be made with colour='red'.*colour"),
    "bad value": (DUALTAXI, {"slip": 2}, r"cannot be made with slip=2: slip is 2, expected"),
    "bad reward": (
        DUALTAXI,
        frozen({"rewards": {"pickupp": 1}}),
        r"cannot be made with rewards={'pickupp': 1}.*did you mean 'pickup'",
    ),
    "bad map": (DUALTAXI, {"map": ["+-+"]}, r"cannot be made with map="),
    "bad map of another": ("FrozenLake-v1", {"map_name": "9x9"}, r"cannot be made with map_name='9x9'"),
}


@pytest.mark.parametrize("case", REFUSED)
@pytest.mark.filterwarnings("ignore:.*WARN")
def test_an_environment_that_cannot_be_used_is_refused_with_the_reason(case):
    env_id, kwargs, message = REFUSED[case]
    with pytest.raises(EnvironmentNotUsable, match=f"(?s){message}"):
        load_mdp(env_id, kwargs)


RAISING = {
    "as it is imported": (
        "names = {}\nnames['goal']",
        r"cannot be imported \(KeyError: 'goal' \(town\.py, line 2\)",
    ),
    "as it is read": ("def (", r"cannot be imported \(SyntaxError: .*town\.py, line 1"),
    "as it is made": (
        "import gymnasium\ndef made():\n    raise KeyError('goal')\ngymnasium.register('Town-v0', made)",
        r"cannot be made with no arguments: KeyError: 'goal' \(town\.py, line 3\)",
    ),
    "as it is made, by chance": (
        "import gymnasium\ngymnasium.register('Town-v0', lambda: 1 / 0)",
        r"cannot be made with no arguments: ZeroDivisionError",
    ),
    "as configured": (
        "import gymnasium\nfrom gymnasium.envs.toy_text import FrozenLakeEnv\n"
        "class Town(FrozenLakeEnv):\n    @property\n    def agents(self):\n        raise OSError('shut')\n"
        "gymnasium.register('Town-v0', Town)",
        r"cannot be read \(OSError: shut\); docs/architecture",
    ),
    "as it is closed": (
        "import gymnasium\nfrom gymnasium.envs.toy_text import FrozenLakeEnv\n"
        "class Town(FrozenLakeEnv):\n    def close(self):\n        raise RuntimeError('shut')\n"
        "gymnasium.register('Town-v0', Town)",
        r"cannot be read \(RuntimeError: shut\); docs/architecture",
    ),
}


@pytest.mark.parametrize("case", RAISING)
def test_errors_of_a_user_module_are_reported_with_their_place(case, tmp_path, monkeypatch):
    source, message = RAISING[case]
    (tmp_path / "town.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "town", raising=False)
    monkeypatch.setattr(gymnasium, "registry", dict(gymnasium.registry))
    monkeypatch.setattr(gymnasium.envs.registration, "registry", gymnasium.registry)
    with pytest.raises(EnvironmentNotUsable, match=f"(?s){message}"):
        load_mdp("town:Town-v0", {})


def test_individual_rewards_need_an_environment_that_pays_its_agents_one_by_one():
    with pytest.raises(EnvironmentNotUsable, match="rewards: team"):
        load_mdp("Taxi-v4", {}, "individual")


@pytest.fixture(scope="module")
def lake():
    """Return an environment without events and scene."""
    known = load_mdp("FrozenLake-v1", {})
    unknown = {"events": known.events * 0, "event_names": (), "success_events": ()}
    return replace(known, **unknown, scene=None, scene_cells=None, scene_carriers=None)


def _with_cell(array: np.ndarray, value: float) -> np.ndarray:
    changed = array.copy()
    changed.flat[3] = value
    return changed


CONTRADICTIONS = {
    "a state too many": lambda mdp: {"next_state": _with_cell(mdp.next_state, mdp.states)},
    "a negative state": lambda mdp: {"next_state": _with_cell(mdp.next_state, -1)},
    "no states": lambda mdp: {"next_state": mdp.next_state[:0]},
    "two axes": lambda mdp: {"next_state": mdp.next_state[:, :, 0]},
    "a probability of 2": lambda mdp: {"probability": _with_cell(mdp.probability, 2.0)},
    "probabilities of another shape": lambda mdp: {"probability": mdp.probability[:-1]},
    "events of another shape": lambda mdp: {"events": mdp.events[:, :-1]},
    "a negative probability": lambda mdp: {"probability": mdp.probability * -1},
    "probability nan": lambda mdp: {"probability": _with_cell(mdp.probability, np.nan)},
    "no reward axis": lambda mdp: {"rewards": mdp.rewards[..., 0]},
    "two rewards for one agent": lambda mdp: {"rewards": np.repeat(mdp.rewards, 2, axis=-1)},
    "reward nan": lambda mdp: {"rewards": _with_cell(mdp.rewards, np.nan)},
    "reward infinite": lambda mdp: {"rewards": _with_cell(mdp.rewards, np.inf)},
    "starts nowhere": lambda mdp: {"start": mdp.start * 0},
    "starts beyond the states": lambda mdp: {"start": np.append(mdp.start, 0.0)},
    "more actions than joint actions": lambda mdp: {"action_counts": (5,)},
    "an agent without actions": lambda mdp: {"agents": ("a", "b"), "action_counts": (4,)},
    "fewer actions than none": lambda mdp: {"agents": ("a", "b"), "action_counts": (-2, -2)},
    "no agents": lambda mdp: {"agents": (), "action_counts": ()},
    "an unnamed success": lambda mdp: {"success_events": ("goal",)},
    "too many events": lambda mdp: {"event_names": tuple(f"event {n}" for n in range(32))},
    "a negative step limit": lambda mdp: {"step_limit": -1},
    "cells for other states": lambda mdp: {"scene_cells": np.zeros((3, 1), np.int16)},
}


@pytest.mark.parametrize("case", CONTRADICTIONS)
def test_arrays_that_contradict_each_other_are_refused(case, lake):
    broken = replace(lake, **CONTRADICTIONS[case](lake))
    with pytest.raises(EnvironmentNotUsable, match="'FrozenLake-v1'"):
        from_parts(broken.description(), broken.arrays())


@pytest.mark.parametrize(
    ("case", "found"),
    [
        ("a state too many", r"name states, 0 to 15; found 0 to 16\."),
        ("two axes", r"three axes; found an array of int32, shape \(16, 4\)\."),
        ("a probability of 2", r"add up to 1; found values from 0 on, sums 1\.0 to "),
        ("reward infinite", r"finite; found inf\."),
        ("an unnamed success", r"some of the events \(\); found \('goal',\)\."),
        ("an agent without actions", r"found \(4,\)\."),
        ("too many events", r"at most 31 events; found 32\."),
        ("a negative step limit", r"from 0; found -1\."),
        ("no agents", r"1 to \d+ agents; found 0\."),
    ],
)
def test_errors_name_what_was_found(case, found, lake):
    broken = replace(lake, **CONTRADICTIONS[case](lake))
    with pytest.raises(EnvironmentNotUsable, match=found):
        from_parts(broken.description(), broken.arrays())


def test_errors_name_what_is_wrong_with_a_scene(lake):
    with pytest.raises(EnvironmentNotUsable, match=r"a scene must have .*; found rows\."):
        from_parts(lake.description() | {"scene": {"rows": 3}}, lake.arrays())


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"rows": 0}, "found 0 as rows, expected a whole number >= 1"),
        ({"columns": 2**14, "rows": 3}, "at most 32,767 cells"),
        ({"walls": {1}}, "Object of type set is not JSON serializable"),
        ({"walls": [[[0, 0]]]}, r"found \[\[0, 0\]\] as walls\[0\], expected a list of length >= 2"),
        ({"walls": [[[0, 0], [99, 0]]]}, r"within 4 rows and 4 columns; found \[99, 0\]"),
        (
            {"landmarks": [{"name": "a", "cell": [0, 0], "colour": "red"}]},
            "'red' as landmarks.* expected a text",
        ),
        ({"landmarks": [{"name": "a", "cell": [0, -1], "colour": "#000000"}]}, "found -1 as landmarks"),
        ({"things": [{"name": "a\n", "label": "a", "kind": "mover"}]}, r"must be printable; found 'a\\n'"),
        ({"things": [{"name": "a", "label": "", "kind": "mover"}]}, "found '' as things"),
        ({"actions": [{"name": "a", "move": [1, 2, 3]}]}, r"found \[1, 2, 3\] as actions\[0\].move"),
        ({"actions": [{"move": None}]}, "expected the key name"),
    ],
)
def test_an_impossible_value_in_a_scene_is_named(change, reason):
    known = load_mdp("FrozenLake-v1", {})
    with pytest.raises(EnvironmentNotUsable, match=reason):
        from_parts(known.description() | {"scene": known.scene | change}, known.arrays())


anything = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**20), 10**20) | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=4,
)
DESCRIBED = sorted(load_mdp("FrozenLake-v1", {}).description())


@settings(deadline=None, max_examples=60)
@given(name=st.sampled_from(DESCRIBED), value=anything, left_out=st.booleans())
def test_any_environment_metadata_is_accepted_or_refused(name, value, left_out, lake):
    description = json.loads(json.dumps(lake.description()))
    description[name] = value
    if left_out:
        del description[name]
    try:
        mdp = from_parts(description, lake.arrays())
    except EnvironmentNotUsable:
        return
    assert not left_out
    assert mdp.states == 16


@pytest.mark.parametrize("name", [field.name for field in fields(Mdp) if "NDArray" in str(field.type)])
@pytest.mark.parametrize("change", [lambda a: a[:0], lambda a: a.astype("S9"), lambda a: a[..., None], None])
def test_whatever_arrays_a_recording_holds_are_taken_or_refused(name, change, lake):
    arrays = lake.arrays()
    if change is None:
        arrays.pop(name, None)
    else:
        arrays[name] = change(arrays.get(name, np.zeros((3, 2))))
    optional = change is None and name.startswith("scene")
    if optional:
        assert from_parts(lake.description(), arrays).states == 16
    else:
        with pytest.raises(EnvironmentNotUsable):
            from_parts(lake.description(), arrays)
