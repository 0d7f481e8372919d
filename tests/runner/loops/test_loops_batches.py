"""Steps that come in batches: recorded as those of a vector environment, and refused with reasons."""

from __future__ import annotations

import json

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import runner
from runner.errors import ConfigError, RecordingError, RunnerError
from runner.execution.verify import verify
from tests.runner.loops.making import dualtaxi, make

STEPS = 700


def rollout(env_id, mode, steps=STEPS, n=3):
    """Return a vector, its first observations, and everything that its steps returned, [T, N, ...]."""
    envs = SyncVectorEnv([lambda: make(env_id)] * n, autoreset_mode=mode)
    envs.action_space.seed(0)
    first, _ = envs.reset(seed=0)
    rows = []
    for _ in range(steps):
        actions = envs.action_space.sample()
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        final = np.zeros_like(observations)
        for i in np.flatnonzero(terminated | truncated) if "final_obs" in infos else ():
            final[i] = infos["final_obs"][i]
        rows.append((observations.copy(), actions, rewards, terminated, truncated, final))
    return envs, first, [np.array(column) for column in zip(*rows, strict=True)]


def content(run):
    """Return the digests of a run's topics but that of resets, whose seeds only the environment knows."""
    return {name: digest for name, digest in run.summary.topic_digests.items() if name != "/train/reset"}


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("env_id", ["CartPole-v1", "FrozenLake-v1"])
def test_batches_are_recorded_as_the_same_steps_one_by_one(tmp_path, env_id, mode):
    envs, first, (observations, *others, final) = rollout(env_id, mode)
    same = SyncVectorEnv([lambda: make(env_id)] * 3, autoreset_mode=mode)
    with runner.record_vector(same, tmp_path) as one_by_one:
        one_by_one.reset(seed=0)
        for actions in others[0]:
            one_by_one.step(actions)
    more = {"final_observations": final} if mode == AutoresetMode.SAME_STEP else {}
    whole = np.concatenate([first[np.newaxis], observations])
    resets = set()
    for cuts, has_first in (([STEPS], False), ([1, 333, 366], False), ([100, 599, 1], True)):
        with runner.record_batches(envs, tmp_path) as rec:
            if not has_first:
                rec.reset(first)
            begin = 0
            for steps in cuts:
                part = slice(begin, begin + steps)
                seen = whole[begin : begin + steps + 1] if has_first else observations[part]
                rec.batch(
                    seen,
                    *(each[part] for each in others),
                    **{name: each[part] for name, each in more.items()},
                )
                begin += steps
        assert content(rec.run) == content(one_by_one.run)
        assert rec.run.summary.episodes > 10
        assert verify(rec.run.recording).finding == ""
        resets.add(rec.run.summary.topic_digests["/train/reset"])
    assert len(resets) == 1


def test_the_environments_need_only_a_name_and_their_arrays(tmp_path):
    _, first, (observations, actions, rewards, terminated, truncated, _) = rollout(
        "CartPole-v1", AutoresetMode.NEXT_STEP, 300
    )
    with runner.record_batches("jax/Pole", tmp_path, autoreset_mode="NextStep", seed=3) as rec:
        with pytest.raises(RunnerError, match="found no batch so far"):
            rec.log("loss", 1.0)
        with rec.phase("eval"):
            rec.reset(first)
            rec.batch(observations, actions, rewards.astype(np.float32), terminated.astype(np.float32))
        rec.log("loss", 1.0)
        rec.batch(
            {"pole": np.concatenate([first[np.newaxis], observations])}["pole"],
            actions,
            rewards,
            terminated,
            truncated,
            extras={"value": rewards * 2, "logits": np.ones((300, 3, 2), np.float32)},
        )
    assert verify(rec.run.recording).finding == ""
    with runner.open_recording(rec.run.recording) as recording:
        described = json.loads(recording.run["spaces"])
        steps = recording.train.steps.array()
        assert steps["next_observation"].reshape(300, 3, 4).tolist() == observations.tolist()
        assert steps["action"].reshape(300, 3).tolist() == actions.tolist()
        assert recording.train.extras.count == 900
        assert recording.train.extras.of_episode(0)["value"].tolist()[0] == 2.0
        assert described["observation"] | {"low": 0, "high": 0} == {
            "type": "Box",
            "dtype": "<f4",
            "shape": [4],
            "low": 0,
            "high": 0,
        }
    name = rec.run.run_id
    for words in (
        ["ls"],
        ["show", name],
        ["verify", name],
        ["plot", name, "-o", str(tmp_path / "a.png")],
        ["play", name, "--episode", "0"],
        ["report", name, "-o", str(tmp_path / "a.html")],
        ["diff", name, name],
    ):
        done = dualtaxi(tmp_path, *words)
        assert done.exit_code == 0, (words, done.output)


def test_nested_observations_and_actions_of_a_continuous_space(tmp_path):
    draws = np.random.default_rng(0)
    seen = {
        "eye": draws.random((51, 4, 3)),
        "arm": (draws.integers(0, 9, (51, 4)), draws.random((51, 4)) < 0.5),
    }
    actions, rewards = draws.random((50, 4, 2)), draws.random((50, 4))
    ends = draws.random((50, 4)) < 0.1
    ends[1:] &= ~ends[:-1]  # the step after an end only resets the environment
    with runner.record_batches("Robot", tmp_path, autoreset_mode="NextStep") as rec:
        rec.batch(seen, actions, rewards, ends)
    assert verify(rec.run.recording).finding == ""
    with runner.open_recording(rec.run.recording) as recording:
        steps = next(recording.train.steps.blocks())
        assert (steps["next_observation"]["eye"].reshape(50, 4, 3) == seen["eye"][1:]).all()
        assert (steps["next_observation"]["arm"]["0"].reshape(50, 4) == seen["arm"][0][1:]).all()
        assert (steps["next_observation"]["arm"]["1"].reshape(50, 4) == seen["arm"][1][1:]).all()
        assert (steps["action"].reshape(50, 4, 2) == actions).all()  # float64, as they came
        returns = recording.train.episodes.array()["returns"]
    total, expected, was_over = np.zeros(4), [], np.zeros(4, bool)
    for t in range(50):
        total = np.where(was_over, 0.0, total + rewards[t])
        was_over = ends[t]
        expected += total[was_over].tolist()
        total[was_over] = 0.0
    assert returns[:, 0].tolist() == expected


def test_unknown_last_observations_are_nan_with_a_warning_and_refused_of_whole_numbers(tmp_path):
    ends = np.zeros((5, 2), bool)
    ends[2, 1] = True
    rec = runner.record_batches("gym/Pole", tmp_path, autoreset_mode="SameStep")
    with rec, pytest.warns(RuntimeWarning, match="pass final_observations"):
        rec.batch(np.ones((6, 2, 3)), np.zeros((5, 2), int), np.ones((5, 2)), ends)
    with runner.open_recording(rec.run.recording) as recording:
        steps = next(recording.train.steps.blocks())["next_observation"]
        assert np.isnan(steps[5]).all()
        assert np.isfinite(np.delete(steps, 5, axis=0)).all()
    rec = runner.record_batches("gym/Grid", tmp_path, autoreset_mode="SameStep")
    with rec, pytest.raises(ConfigError, match="final_observations: found none"):
        rec.batch(np.ones((6, 2, 3), int), np.zeros((5, 2), int), np.ones((5, 2)), ends)


BATCH = (np.ones((5, 2, 3), np.float32), np.zeros((5, 2), int), np.ones((5, 2)), np.zeros((5, 2), bool))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({0: np.ones((4, 2, 3), np.float32)}, RecordingError, r"shape \(4, 2, 3\), expected \(5, 2, 3\)"),
        ({0: np.ones((5, 3, 3), np.float32)}, RecordingError, r"shape \(5, 3, 3\), expected \(5, 2, 3\)"),
        ({0: np.zeros((6, 2, 3), np.float32)}, ConfigError, "not the last observations"),
        ({0: np.full((5, 2, 3), "a")}, RecordingError, "not of the environment's observation space"),
        ({1: np.zeros((5, 3), int)}, RecordingError, r"action of shape \(5, 3\), expected \(5, 2\)"),
        ({1: np.full((5, 2), 2**40)}, None, ""),
        ({2: np.ones(5)}, ConfigError, r"rewards: found float64 of shape \(5,\), expected numbers \[T, N\]"),
        ({2: np.ones((5, 3))}, ConfigError, r"terminated: .* expected booleans of the shape \(5, 3\)"),
        ({3: np.full((5, 2), 0.5)}, ConfigError, "terminated: found float64"),
        ({4: np.zeros((2, 5), bool)}, ConfigError, r"truncated: found bool of shape \(2, 5\)"),
    ],
)
def test_what_does_not_fit_is_refused_whole(tmp_path, change, error, message):
    with runner.record_batches("Name", tmp_path, autoreset_mode="NextStep") as rec:
        rec.reset(np.zeros((2, 3), np.float32))
        rec.batch(*BATCH)
        wrong = list(BATCH)
        for place, value in change.items():
            wrong[place : place + 1] = [value]
        if error is None:
            rec.batch(*wrong)
        else:
            with pytest.raises(error, match=message):
                rec.batch(*wrong)
        rec.batch(*BATCH)
    assert rec.run.summary["train_steps"] == (20 if error else 30)
    assert verify(rec.run.recording).finding == ""


def test_resets_and_modes_are_checked(tmp_path):
    final = {"final_observations": BATCH[0]}
    with runner.record_batches("A", tmp_path, autoreset_mode="NextStep") as rec:
        with pytest.raises(ResetNeeded):
            rec.batch(*BATCH)
        rec.reset(BATCH[0][0])
        with pytest.raises(ConfigError, match='autoreset_mode="NextStep", expected none'):
            rec.batch(*BATCH, **final)
        with pytest.raises(ConfigError, match="extras: found shape"):
            rec.batch(*BATCH, extras={"value": np.ones((2, 5))})
        rec.batch(*BATCH)
    assert rec.run.summary["train_steps"] == 10
    ended = (*BATCH[:3], np.ones((5, 2), bool))
    with runner.record_batches("B", tmp_path, autoreset_mode="Disabled") as rec:
        rec.reset(BATCH[0][0])
        with pytest.raises(RecordingError, match="step 1 of a batch in environment 0 after the end"):
            rec.batch(*ended)
        rec.batch(*(each[-1:] for each in ended))
        with pytest.raises(RecordingError, match="step 0 of a batch"):
            rec.batch(*BATCH)
        rec.reset(BATCH[0][0])
        rec.batch(*BATCH)
    assert rec.run.summary.episodes == 2
    with pytest.raises(ConfigError, match="autoreset_mode: found None"):
        runner.record_batches("C", tmp_path)
    with pytest.raises(ConfigError, match="found str, expected a space"):
        runner.record_batches("C", tmp_path, action_space="two", autoreset_mode="NextStep")
    envs = SyncVectorEnv([lambda: make("CartPole-v1")])
    with pytest.raises(ConfigError, match="which has its own"):
        runner.record_batches(envs, tmp_path, action_space=spaces.Discrete(2))


def test_a_recorder_that_fails_does_not_end_the_training_if_that_is_wished(tmp_path):
    wrong = (BATCH[0], np.zeros((5, 3), int), *BATCH[2:])
    with runner.record_batches("A", tmp_path, autoreset_mode="NextStep", on_error="warn") as rec:
        assert not rec.should_stop
        rec.reset(BATCH[0][0])
        rec.batch(*BATCH)
        assert not rec.should_stop
        with pytest.warns(RuntimeWarning, match=r"recording stopped at step 10.*shape \(5, 3\)"):
            rec.batch(*wrong)
        rec.batch(*BATCH)
    assert rec.run.facts["status"] == "failed"
    assert rec.run.summary["train_steps"] == 10


def test_what_cannot_be_made_again_says_why_and_a_joined_shard_is_read_with_the_run(tmp_path):
    with runner.record_batches("A", tmp_path, autoreset_mode="NextStep") as rec:
        rec.reset(BATCH[0][0])
        rec.batch(*BATCH)
        with runner.record_batches("A", autoreset_mode="NextStep", join=rec.run) as other:
            other.reset(BATCH[0][0])
            other.batch(*BATCH)
    with runner.open_recording(rec.run.recording) as recording:
        assert "recorded in batches" in recording.maker.reason
        assert recording.result["train_steps"] == 20
