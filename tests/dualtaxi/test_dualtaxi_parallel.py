"""The competitive game in PettingZoo, and packages that may be missing."""

from __future__ import annotations

import subprocess
import sys
import warnings

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

pytest.importorskip("pettingzoo")

with warnings.catch_warnings(
    action="ignore", category=DeprecationWarning
):  # PettingZoo's own, about its games
    from pettingzoo.test import parallel_api_test, parallel_seed_test, seed_test
from pettingzoo.utils import parallel_to_aec

from dualtaxi import DualTaxiEnv
from dualtaxi.parallel import DualTaxiParallelEnv


@pytest.mark.parametrize("arguments", [{}, {"slip": 0.2}, {"max_steps": 20}], ids=str)
def test_pettingzoo_finds_no_fault(arguments):
    parallel_api_test(DualTaxiParallelEnv(**arguments), num_cycles=200)


@pytest.mark.parametrize("slip", [0.0, 0.2])
def test_pettingzoo_seed_test_passes(slip):
    def make() -> DualTaxiParallelEnv:
        return DualTaxiParallelEnv(map=["+---+", "|A: |", "| :B|", "+---+"], slip=slip)

    parallel_seed_test(make, num_cycles=100)
    seed_test(lambda: parallel_to_aec(make()), num_cycles=50)


def test_it_plays_the_competitive_game():
    env, game = DualTaxiParallelEnv(slip=0.2), DualTaxiEnv(competitive=True, slip=0.2)
    choices = np.random.default_rng(0)
    observations, infos = env.reset(seed=9)
    state, _ = game.reset(seed=9)
    for _ in range(300):
        assert observations == {"taxi_1": state, "taxi_2": state}
        assert env.state().tolist() == [state]
        first, second = choices.integers(6, size=2).tolist()
        observations, rewards, terminated, truncated, infos = env.step({"taxi_1": first, "taxi_2": second})
        state, _, ended, _, info = game.step(first * 6 + second)
        assert list(rewards.values()) == info["rewards"].tolist()
        assert terminated == {"taxi_1": ended, "taxi_2": ended}
        assert not any(truncated.values())
        both = np.logical_and.outer(infos["taxi_1"]["action_mask"], infos["taxi_2"]["action_mask"])
        assert np.array_equal(both.ravel(), info["action_mask"])
        if ended:
            observations, infos = env.reset()
            state, _ = game.reset()


def test_an_episode_is_cut_off_for_both_at_once():
    env = DualTaxiParallelEnv(max_steps=3)
    north = {"taxi_1": 1, "taxi_2": 1}
    for _ in range(2):  # the second episode is as long as the first
        env.reset(seed=0)
        ends = [env.step(north)[3] for _ in range(3)]
        assert [set(end.values()) for end in ends] == [{False}, {False}, {True}]
        assert env.agents == []
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(north)


def test_the_published_limit_is_the_default():
    assert DualTaxiParallelEnv().max_steps == 1500


@pytest.mark.parametrize("actions", [{"taxi_1": 0}, {"taxi_1": 0, "taxi_2": 0, "taxi_3": 0}, {}], ids=str)
def test_each_taxi_must_act_and_no_other(actions):
    env = DualTaxiParallelEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"expected one for each of \['taxi_1', 'taxi_2'\]"):
        env.step(actions)


@pytest.mark.parametrize("max_steps", [0, 1.5, True])
def test_a_limit_that_is_no_number_of_steps_is_refused(max_steps):
    with pytest.raises(ValueError, match="max_steps is"):
        DualTaxiParallelEnv(max_steps=max_steps)


def test_it_renders():
    env = DualTaxiParallelEnv("rgb_array")
    env.reset(seed=0)
    assert env.render().ndim == 3


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_the_environment_needs_none_of_the_optional_packages():
    absent = "import sys; sys.modules.update(dict.fromkeys(['matplotlib', 'pandas', 'pettingzoo', 'PIL']))\n"
    done = run(
        absent + "import gymnasium as g; e = g.make('dualtaxi:DualTaxi-v1', render_mode='rgb_array')\n"
        "e.reset(seed=0); print(e.render().shape[2])"
    )
    assert (done.stdout.strip(), done.stderr) == ("3", "")


def test_without_pettingzoo_the_error_names_the_extra():
    done = run("import sys; sys.modules['pettingzoo'] = None\nimport dualtaxi.parallel")
    assert done.returncode == 1
    assert "pip install 'pettingzoo>=1.25'" in done.stderr
