"""Histograms over training count what was recorded, of jobs and of loops with any actions."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import runner
from runner.analysis.axes import EPISODES, STEPS, UPDATES
from runner.analysis.histograms import histograms
from runner.errors import RecordingError
from runner.export.plots.training import constants_in, heatmap_plots
from runner.recording.reader import open_recording


class Made(gymnasium.Env):
    """Ends after five steps, with rewards of its own, in any spaces."""

    def __init__(self, action_space, rewards=(1.0,), observation_space=None):
        self.action_space, self._rewards = action_space, rewards
        self.observation_space = observation_space or gymnasium.spaces.Discrete(2)
        self._steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._observation(), {}

    def step(self, action):
        self._steps += 1
        reward = self._rewards[self._steps % len(self._rewards)]
        return self._observation(), reward, self._steps % 5 == 0, False, {}

    def _observation(self):
        is_text = isinstance(self.observation_space, gymnasium.spaces.Text)
        return "a" * (1 + self._steps % 3) if is_text else self._steps % 2


def recorded(folder, env, steps=100, **options):
    """Record steps of an environment, and return its actions."""
    rec = runner.record(env, recordings=folder, name="made", seed=1, **options)
    rec.action_space.seed(1)
    rec.reset(seed=1)
    actions = []
    for _ in range(steps):
        actions.append(rec.action_space.sample())
        *_, terminated, truncated, _ = rec.step(actions[-1])
        if terminated or truncated:
            rec.reset()
    rec.close()
    return actions


def found_in(folder, axis=STEPS):
    (run,) = runner.list_runs(folder)
    with open_recording(run.recording) as recording:
        found, notes = histograms(recording, axis)
    maps = "".join(plot.picture for plot in heatmap_plots(found))
    drawn = [each for each in found if 1 < len(each.names) < 10]
    assert all(f">{name}</text>" in maps for each in drawn for name in each.names)
    return {(each.quantity, each.line): each for each in found}, notes


def test_a_constant_is_a_sentence_and_no_picture(tmp_path):
    recorded(tmp_path, gymnasium.make("CartPole-v1"))
    (run,) = runner.list_runs(tmp_path)
    with open_recording(run.recording) as recording:
        found, _ = histograms(recording, STEPS)
    assert constants_in(found) == ["Rewards in training: always 1."]
    assert not any("Rewards in training" in plot.picture for plot in heatmap_plots(found))


def counted(histogram, start, stop, value):
    """Return how often a distinct value was counted between two edges."""
    first, last = histogram.edges.index(start), histogram.edges.index(stop)
    return sum(row[histogram.values.index(value)] for row in histogram.counts[first:last])


def test_a_job_has_the_counts_of_its_steps_and_episodes(taxis):
    with open_recording(taxis.recording) as recording:
        found, notes = histograms(recording, STEPS)
        by_name = {(each.quantity, each.line): each for each in found}
        steps = np.concatenate([block.copy() for block in recording.train.steps.blocks()])
        episodes = recording.train.episodes.array()
        own = recording.mdp.own_actions[steps["action"]]
    assert notes == []
    middle = by_name["action", "taxi_2"].edges[10]
    before = steps["step"] < middle
    for value, name in enumerate(("south", "north", "east", "west", "pickup", "drop-off")):
        histogram = by_name["action", "taxi_2"]
        assert histogram.names[value] == name
        assert counted(histogram, 0, middle, value) == (own[before, 1] == value).sum()
    assert sum(map(sum, by_name["length", ""].counts)) == len(episodes)
    returns = by_name["return", "taxi_1"]
    assert (returns.values[0], returns.values[-1]) == (
        episodes["returns"][:, 0].min(),
        episodes["returns"][:, 0].max(),
    )
    rows = np.searchsorted(returns.values, episodes["returns"][:, 0], "right") - 1
    assert (
        np.array(returns.counts).sum(axis=0).tolist() == np.bincount(rows.clip(0, 29), minlength=30).tolist()
    )


def test_steps_are_counted_in_the_stretch_of_their_episode(taxis):
    with open_recording(taxis.recording) as recording:
        found, _ = histograms(recording, EPISODES)
        lengths = recording.train.episodes.array()["length"]
    (rewards, *_) = (histogram for histogram in found if histogram.quantity == "reward")
    edges = np.array(rewards.edges[:-1], int)
    assert list(map(sum, rewards.counts)) == np.add.reduceat(lengths, edges).tolist()


def test_named_and_started_actions_of_a_loop_are_counted(tmp_path):
    actions = recorded(
        tmp_path,
        Made(gymnasium.spaces.Discrete(3, start=5), observation_space=gymnasium.spaces.Box(0, 1, ())),
    )
    found, notes = found_in(tmp_path)
    histogram = found["action", ""]
    assert notes == []
    assert histogram.values == [5, 6, 7]
    assert [counted(histogram, 0, histogram.edges[-1], value) for value in (5, 6, 7)] == np.bincount(actions)[
        5:
    ].tolist()
    assert found["reward", ""].values == [1]
    assert found["length", ""].values == [5]


def test_names_are_those_of_the_environment(tmp_path):
    recorded(tmp_path, gymnasium.make("CartPole-v1"))
    found, _ = found_in(tmp_path, EPISODES)
    assert found["action", ""].names == ["left", "right"]


def test_each_part_of_an_action_has_its_own_and_the_first_six_are_drawn(tmp_path):
    space = gymnasium.spaces.Dict(
        {"move": gymnasium.spaces.Box(-1, 1, (7,)), "say": gymnasium.spaces.MultiDiscrete([2, 3])}
    )
    recorded(tmp_path, Made(space))
    found, notes = found_in(tmp_path)
    assert [line for quantity, line in found if quantity == "action"] == [f"move[{i}]" for i in range(6)]
    assert notes == ["Of 9 parts of an action the first 6 have a histogram."]
    histogram = found["action", "move[0]"]
    assert histogram.names == []
    assert len(histogram.values) == 31
    assert sum(map(sum, histogram.counts)) == 100


def test_steps_that_vary_in_size_are_counted(tmp_path):
    actions = recorded(
        tmp_path, Made(gymnasium.spaces.Discrete(4), observation_space=gymnasium.spaces.Text(5))
    )
    found, _ = found_in(tmp_path)
    histogram = found["action", ""]
    assert [sum(row[k] for row in histogram.counts) for k in range(4)] == np.bincount(
        actions, minlength=4
    ).tolist()


def test_actions_that_are_texts_are_left_out_with_a_note(tmp_path):
    recorded(tmp_path, Made(gymnasium.spaces.Text(3, min_length=1)), steps=20)
    found, notes = found_in(tmp_path)
    assert not [key for key in found if key[0] == "action"]
    assert notes == ["Actions have no histogram, as they are not numbers of one shape."]


def test_rewards_that_are_not_finite_are_left_out_and_counted(tmp_path):
    recorded(tmp_path, Made(gymnasium.spaces.Discrete(2), rewards=(1.0, float("inf"), float("nan"), -1.0)))
    found, notes = found_in(tmp_path)
    assert found["reward", ""].values == [-1, 1]
    assert found["reward", ""].left_out == 50
    assert "50 values of reward are left out" in " ".join(notes)


def test_a_run_of_actions_alone_has_no_rewards_and_says_so(tmp_path):
    env = runner.record(
        gymnasium.make("CartPole-v1"), recordings=tmp_path, name="alone", seed=1, steps="actions"
    )
    env.reset(seed=1)
    for step in range(60):
        *_, terminated, truncated, _ = env.step(step % 2)
        if terminated or truncated:
            env.reset()
    env.close()
    found, notes = found_in(tmp_path)
    assert {quantity for quantity, _ in found} == {"return", "length", "action"}
    assert [sum(row[k] for row in found["action", ""].counts) for k in range(2)] == [30, 30]
    assert notes == ["Rewards have no histogram, as no whole steps of training were recorded."]


def test_without_steps_there_are_histograms_of_episodes(tmp_path):
    config = {"env": {"id": "FrozenLake-v1"}, "episodes": 30, "recording": {"steps": "none"}}
    runner.run(config | {"name": "none"}, recordings=tmp_path)
    found, notes = found_in(tmp_path)
    assert {quantity for quantity, _ in found} == {"return", "length"}
    assert notes == ["Rewards have no histogram, as no whole steps of training were recorded."]


def test_a_run_without_the_axis_or_without_steps_is_no_error(tmp_path):
    recorded(tmp_path, gymnasium.make("CartPole-v1"), steps=0)
    found, _ = found_in(tmp_path)
    assert found == {}
    with pytest.raises(RecordingError, match="has no axis of updates"):
        found_in(tmp_path, UPDATES)
