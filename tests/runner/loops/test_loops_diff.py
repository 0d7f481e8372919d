"""Differences and comparisons of recorded loops."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

import runner
from runner.analysis.diff import can_compare_steps, diff
from runner.recording.reader import open_recording
from tests.runner.loops.making import dualtaxi, make, play


def test_diff_names_the_step_at_which_loops_diverge(folder):
    same = dualtaxi(folder, "diff", "lake", "again")
    assert same.exit_code == 0
    assert "the same, to the last byte" in same.stdout
    differing = json.loads(dualtaxi(folder, "diff", "lake", "other", "--json").stdout)
    divergence = differing["divergence"]
    with (
        open_recording(runner.find_run("lake", folder).recording) as a,
        open_recording(runner.find_run("other", folder).recording) as b,
    ):
        left, right = (next(recording.train.steps.blocks()) for recording in (a, b))
    names = [name for name in left.dtype.names if not name.startswith("tag_")]
    first = next(k for k in range(len(left)) if left[k][names].tolist() != right[k][names].tolist())
    assert divergence["step"] == first
    assert divergence["field"] in ("state", "action", "next_state")
    foreign = dualtaxi(folder, "diff", "pole", "rooms")
    assert foreign.exit_code == 1
    assert "other spaces" in foreign.stdout
    everything = dualtaxi(folder, "diff", "pole", "rooms", "--all").stdout
    assert not re.search(r"^(Training|Evaluation|Q-tables)$", everything, re.MULTILINE)
    assert "Environment" in everything


def test_the_metrics_of_loops_are_compared(tmp_path):
    for name, steps in (("a", 10), ("b", 20)):
        env = gymnasium.make("CartPole-v1", max_episode_steps=steps)
        with runner.record(env, tmp_path, name=name) as rec:
            list(play(rec, 50))
            with rec.phase("eval"):
                rec.reset(seed=1)
                truncated, step = False, 0
                while not truncated:
                    _, _, terminated, truncated, _ = rec.step(step % 2)
                    assert not terminated
                    step += 1
    table = json.loads(dualtaxi(tmp_path, "diff", "a", "b", "--target", "mean_return=15", "--json").stdout)
    returns = next(metric for metric in table["metrics"] if metric["name"] == "mean_return")
    assert (returns["end_a"], returns["end_b"]) == (10, 20)
    ((_, crossings),) = returns["crossings"].items()
    assert crossings[0] is None
    assert crossings[1] is not None
    training = {m["name"]: m["end_a"] for m in table["metrics"] if m["name"].startswith("training.")}
    with open_recording(runner.find_run("a", tmp_path).recording) as a:
        episodes = a.train.episodes.array()
    assert training["training.mean_length"] == pytest.approx(episodes["length"].mean())
    assert training["training.mean_return"] == pytest.approx(episodes["returns"].mean())
    costs = {change["path"] for change in table["costs"]}
    assert costs <= {"train_steps", "eval_steps", "episodes", "bytes", "seconds"}
    assert dualtaxi(tmp_path, "diff", "a", "b", "--target", "success=1").exit_code == 2


@pytest.mark.parametrize("first", [True, False])
def test_a_job_and_a_loop_over_the_same_states_are_compared_step_by_step(tmp_path, first):
    cliff = {"id": "CliffWalking-v1", "kwargs": {"max_episode_steps": 40}}
    job = runner.run({"episodes": 2, "env": cliff, "evaluation": None}, recordings=tmp_path)
    with open_recording(job.recording) as recording:
        rows = [row for block in recording.train.steps.blocks() for row in block]

    def differences(changed: int | None) -> list[object]:
        with runner.record(gymnasium.make(cliff["id"], **cliff["kwargs"]), tmp_path) as rec:
            rec.reset(seed=1)
            for number, row in enumerate(rows):
                rec.step((int(row["action"]) + (number == changed)) % 4)
                if row["terminated"] or row["truncated"]:
                    rec.reset()
        with open_recording(job.recording) as a, open_recording(rec.run.recording) as b:
            found = [diff(*pair, first=first).divergence for pair in ((a, b), (b, a))]
            assert can_compare_steps(a, b)
        return [divergence and (divergence.step, divergence.field) for divergence in found]

    assert differences(None) == [None, None]
    assert differences(7) == [(7, "action")] * 2


def test_diff_names_an_episode_of_a_vector_by_its_number_among_all(tmp_path):
    runs = []
    for last in (1, 0):
        envs = SyncVectorEnv([lambda: make("CartPole-v1")] * 3)
        with runner.record_vector(envs, tmp_path) as rec:
            rec.reset(seed=3)
            rec.action_space.seed(1)
            for k in range(60):
                actions = rec.action_space.sample()
                actions[2] = last if k == 40 else actions[2]
                rec.step(actions)
        runs.append(rec.run)
    first = json.loads(dualtaxi(tmp_path, "diff", *(run.run_id for run in runs), "--json").stdout)
    divergence = first["divergence"]
    assert divergence["step"] == 40 * 3 + 2
    with open_recording(runs[0].recording) as recording:
        episode = recording.train.episode(divergence["episode"])
        assert (episode.environment, episode.one(divergence["t"])["step"]) == (2, divergence["step"])


def test_loops_that_have_their_seed_among_their_settings_are_one_group(tmp_path):
    for seed in (1, 2):
        for rate in (0.1, 0.2):
            args = {"seed": seed, "lr": rate}
            with runner.record(make("CartPole-v1"), tmp_path, name="pole", seed=seed, config=args) as env:
                list(play(env, 50, seed))
    reply = json.loads(dualtaxi(tmp_path, "compare", "pole", "--json").stdout)
    assert {label: len(ids) for label, ids in reply["groups"].items()} == {
        "pole, config.lr=0.1": 2,
        "pole, config.lr=0.2": 2,
    }
    dualtaxi(tmp_path, "plot", "pole", "-o", str(tmp_path / "plot.svg"))
    assert (tmp_path / "plot.svg").read_text().count("2 runs: ") == 2


def diff_of_two(folder: Path, tested: int = 0, logged: float = 0.0) -> str:
    """Record the loops `one` and `two`, which may differ in evaluation and logs; return their diff."""
    for name, seed, value in (("one", 0, 0.0), ("two", tested, logged)):
        with runner.record(make("CartPole-v1"), folder, name=name) as env:
            list(play(env, 50, 0))
            with env.phase("eval"):
                list(play(env, 50, seed))
            env.log("loss", value)
    reply = dualtaxi(folder, "diff", "one", "two")
    assert reply.exit_code == 1
    return str(reply.stdout)


def test_diff_names_the_step_at_which_evaluations_of_loops_diverge(tmp_path):
    reply = diff_of_two(tmp_path, tested=1)
    assert "Training took the same steps, evaluation did not." in reply
    assert "They diverge in the reset before evaluation step 0 of A, in the evaluation after" in reply
    diverged = json.loads(dualtaxi(tmp_path, "diff", "one", "two", "--json").stdout)
    assert (diverged["divergence"], diverged["evaluation_divergence"]["step"]) == (None, 0)
    page = tmp_path / "diff.html"
    assert dualtaxi(tmp_path, "diff", "one", "two", "--html", str(page)).exit_code == 1
    printed = dualtaxi(tmp_path, "diff", "one", "two", "--html", "-")
    assert (printed.exit_code, printed.stdout) == (1, page.read_text())
    assert "in the reset before evaluation step 0 of A, in the evaluation after" in page.read_text()
    assert "Q-tables" not in page.read_text()


def test_long_values_are_shown_where_they_differ(tmp_path):
    numbers = list(range(100))
    for last in (7, 8):
        config = {"layers": [*numbers, last, *numbers]}
        with runner.record(gymnasium.make("CartPole-v1"), tmp_path, name=f"of{last}", config=config) as rec:
            list(play(rec, 3))
    text = dualtaxi(tmp_path, "diff", "of7", "of8").stdout
    (row,) = (line for line in text.splitlines() if line.startswith("config.layers"))
    assert "98, 99, 7, 0" in row
    assert "98, 99, 8, 0" in row
    assert len(row) < 200
    (change, _) = json.loads(dualtaxi(tmp_path, "diff", "of7", "of8", "--json").stdout)["config"]
    assert change["a"] == [*numbers, 7, *numbers]


def test_diff_names_the_topics_that_differ_between_loops_of_equal_steps(tmp_path):
    reply = diff_of_two(tmp_path, logged=1.0)
    assert "all steps are the same; what differs is in /scalar." in reply


class Pictures(gymnasium.Env[Any, Any]):
    """Observes many numbers, of which one is an argument."""

    observation_space = gymnasium.spaces.Dict({"picture": gymnasium.spaces.Box(0, 255, (9, 9), np.uint8)})
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, number: int) -> None:
        self.number = number

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return {"picture": np.zeros((9, 9), np.uint8)}, {}

    def step(self, action: Any) -> Any:
        picture = np.zeros((9, 9), np.uint8)
        picture[3, 4] = self.number
        return {"picture": picture}, 0.0, True, False, {}


class Starts(gymnasium.Env[Any, Any]):
    """Starts one of its episodes at a given value, and is constant otherwise."""

    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, start: float) -> None:
        self.start, self.episode = start, -1

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.episode, self.t = self.episode + 1, 0
        return np.full(2, self.start if self.episode == 2 else 0, np.float32), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        return np.ones(2, np.float32), 0.0, self.t == 3, False, {}


def test_diff_names_the_reset_in_which_loops_diverge(tmp_path):
    for start, actions in ((0.25, 0), (0.75, 0), (0.5, 1)):
        with runner.record(Starts(start), tmp_path, name=f"at{start:g}") as env:
            for episode in range(4):
                env.reset()
                for _ in range(3):
                    env.step(actions if episode == 2 else 0)
    for other in ("0.75", "0.5"):  # the actions of the last differ too, but after the reset
        reply = dualtaxi(tmp_path, "diff", "at0.25", f"at{other}").stdout
        assert (
            "diverge in the reset before training step 6, in training episode 2: observation is [0.25, "
            in reply
        )
        assert f" in A, [{other}, " in reply
    diverged = json.loads(dualtaxi(tmp_path, "diff", "at0.25", "at0.5", "--json").stdout)["divergence"]
    assert (diverged["step"], diverged["episode"], diverged["field"]) == (6, 2, "reset.observation")


def test_diff_names_the_frame_that_differs(tmp_path):
    for number in (7, 8):
        with runner.record(Pictures(number), tmp_path, name=f"of{number}") as env:
            env.reset()
            env.step(1)
    divergence = json.loads(dualtaxi(tmp_path, "diff", "of7", "of8", "--json").stdout)["divergence"]
    assert (divergence["field"], divergence["a"], divergence["b"]) == ("next_observation.picture[3, 4]", 7, 8)


def made_pole() -> Any:
    """Return the environment of `record_pole` without the scale of its rewards."""
    return gymnasium.make("CartPole-v1")


def record_pole(folder: Path, name: str, steps: str = "all", change: int = -1, scale: float = 1.0) -> str:
    """Record three CartPole episodes whose rewards are scaled from step 20 on; return the run's id.

    Args:
        folder: of the recordings.
        name: of the run.
        steps: what is recorded of them.
        change: the step with the opposite action.
        scale: of the rewards.
    """
    env = gymnasium.make("CartPole-v1")
    taken = 0
    env = gymnasium.wrappers.TransformReward(env, lambda reward: reward * (scale if taken > 20 else 1.0))
    with runner.record(env, folder, name=name, steps=steps, code=False, make=made_pole) as rec:
        rec.reset(seed=0)
        episodes = 0
        while episodes < 3:
            taken += 1
            *_, terminated, _, _ = rec.step(taken % 2 if taken != change + 1 else 1 - taken % 2)
            if terminated:
                rec.reset()
                episodes += 1
    return rec.run.run_id


def test_loops_recorded_by_their_actions_diverge_where_these_do(tmp_path):
    for name, options in {"whole": {}, "a": {"steps": "actions"}, "none": {"steps": "none"}}.items():
        record_pole(tmp_path, name, **options)
    other = record_pole(tmp_path, "b", "actions", change=17)
    text = dualtaxi(tmp_path, "diff", "a", "b").stdout
    assert "Training takes the same actions for 17 steps." in text
    assert "diverge in training episode 0, at t = 17 (training step 17): action is 0 in A, 1 in B." in text
    assert f"B holds the actions of its steps alone, which are compared; `dualtaxi rerecord {other}`" in text
    assert "all steps are the same" not in text
    dualtaxi(tmp_path, "diff", "a", "b", "--html", str(tmp_path / "diff.html"))
    assert "action is 0 in A, 1 in B" in (tmp_path / "diff.html").read_text()
    reply = dualtaxi(tmp_path, "diff", "whole", "b").stdout
    assert "action is 0 in A, 1 in B." in reply
    assert "A holds" not in reply
    for same in ("a", "none"):
        reply = dualtaxi(tmp_path, "diff", "whole", same)
        assert (reply.exit_code, "the same, to the last byte" in reply.stdout) == (0, True)
        assert "Note" not in reply.stdout
    reply = dualtaxi(tmp_path, "diff", "none", "b").stdout
    assert "A holds no steps, so none are compared: they were left out (steps: none), and without" in reply
    assert "diverge" not in reply
    assert "all actions are the same" not in reply


def test_other_rewards_of_loops_recorded_by_their_actions_are_found(tmp_path):
    for name, scale in (("a", 1.0), ("b", 2.0)):
        record_pole(tmp_path, name, "actions", scale=scale)
    divergence = json.loads(dualtaxi(tmp_path, "diff", "a", "b", "--json").stdout)["divergence"]
    assert divergence["field"] == "digest"
    assert divergence["a"] != divergence["b"]
    with open_recording(runner.find_run("a", tmp_path).recording) as recording:
        ends = recording.train.episodes.array()["last_step"]
    episode = int(np.searchsorted(ends, 20))
    assert (divergence["episode"], divergence["step"]) == (episode, ends[episode])
    text = dualtaxi(tmp_path, "diff", "a", "b").stdout
    assert (
        f"They diverge in training episode {episode}, at training step {ends[episode]} at the latest: the act"
        in text
    )


def test_a_loop_that_goes_on_longer_is_named_as_such(tmp_path):
    for name, steps in (("long", 2), ("short", 1)):
        with runner.record(gymnasium.make("CartPole-v1"), tmp_path, name=name, code=False) as env:
            env.reset(seed=0)
            for _ in range(steps):
                env.step(0)
    text = dualtaxi(tmp_path, "diff", "long", "short").stdout
    assert "Training is the same for 1 step." in text
    assert (
        "They diverge in training episode 0, at t = 1 (training step 1): A has that step, B ended before it."
        in text
    )
    assert "Note: how a loop learns is not recorded" in text


def test_diff_compares_checkpoints_which_part_before_the_steps_do(tmp_path):
    for name, weights in (("one", [1, 2, 3]), ("two", [1, 5, 6])):
        with runner.record(make("CartPole-v1"), tmp_path, name=name) as env:
            for number in range(3):
                list(play(env, 20, 0))
                env.checkpoint("agent", bytes([weights[number]]))
    text = dualtaxi(tmp_path, "diff", "one", "two").stdout
    assert "of the checkpoints of both runs, 2 of 3 differ, the first of them agent@40" in text
