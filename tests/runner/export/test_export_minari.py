"""Minari datasets of recorded loops: Minari reads what the loop observed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from click.testing import CliRunner
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import runner
from runner.cli import cli
from runner.recording.gym_spaces import recorded_space, restore_space
from tests.runner.loops.making import NAMES, Rooms, make, play

pytest.importorskip("minari")


def exported(run: Any, folder: Path, monkeypatch: Any, *words: str) -> tuple[Any, str]:
    """Return the dataset of a run, as Minari loads it, and the output of the command."""
    import minari

    call = ["export", "minari", str(run.recording), "-o", str(folder / "minari"), *words]
    done = CliRunner().invoke(cli, call)
    assert done.exit_code == 0, done.output
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    return minari.load_dataset(f"{run.name}-{run.run_id}-v0"), done.output


def same(space: gymnasium.Space[Any], found: Any, seen: list[Any]) -> None:
    """Assert that the values of a space in a dataset equal those observed."""
    if isinstance(space, spaces.Dict):
        for name, part in space.spaces.items():
            same(part, found[name], [value[name] for value in seen])
    elif isinstance(space, spaces.Tuple):
        for i, part in enumerate(space.spaces):
            same(part, found[i], [value[i] for value in seen])
    elif isinstance(space, spaces.Text):
        assert list(found) == seen
    else:
        np.testing.assert_array_equal(found, np.array(seen))


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"CliffWalking-v1"}))  # at random it does not end
def test_observations_and_actions_equal_those_of_the_loop(name, tmp_path, monkeypatch):
    env = make(name)
    with runner.record(env, tmp_path, name="loop") as rec:
        entries = list(play(rec, 300))
    dataset, _ = exported(rec.run, tmp_path, monkeypatch)
    episodes: list[list[Any]] = []
    for entry in entries:
        if entry[0] == "reset":
            episodes.append([entry])
        else:
            episodes[-1].append(entry)
    ended = [one for one in episodes if len(one) > 1 and (one[-1][4] or one[-1][5])]
    found = list(dataset.iterate_episodes())
    assert len(found) == len(ended) > 0
    for episode, ((_, _, first), *steps) in zip(found, ended, strict=True):
        same(env.observation_space, episode.observations, [first, *(step[2] for step in steps)])
        same(env.action_space, episode.actions, [step[1] for step in steps])
        np.testing.assert_array_equal(episode.rewards, [step[3] for step in steps])
        np.testing.assert_array_equal(episode.terminations, [step[4] for step in steps])
        np.testing.assert_array_equal(episode.truncations, [step[5] for step in steps])
    assert dataset.storage.get_episode_metadata([0]).__next__().get("seed") == ended[0][0][1]
    if not name.startswith("Rooms"):
        assert dataset.recover_environment().spec.id == name


def test_an_episode_that_minari_cannot_store_is_named_by_its_number(tmp_path, monkeypatch):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path) as env:
        for seed in range(4):
            env.reset(seed=seed)
            while not any(env.step(0)[2:4]):
                pass

    def refuse(storage, episodes):
        next(episodes)
        raise ValueError("it is too large")

    monkeypatch.setattr("minari.dataset._storages.hdf5_storage.HDF5Storage.update_episodes", refuse)
    call = ["export", "minari", str(env.run.recording), "-o", str(tmp_path / "minari"), "--episodes", "2..4"]
    assert (
        "train episode 2 cannot be stored by Minari (it is too large)" in CliRunner().invoke(cli, call).output
    )


def test_the_users_own_environment_of_no_listed_package_is_specified(tmp_path, monkeypatch):
    spec = gymnasium.envs.registration.EnvSpec("own/Rooms-v0", entry_point="tests.runner.loops.making:Rooms")
    monkeypatch.setitem(gymnasium.registry, "own/Rooms-v0", spec)
    with runner.record(gymnasium.make("own/Rooms-v0"), tmp_path, name="own") as rec:
        list(play(rec, 40))
    dataset, output = exported(rec.run, tmp_path, monkeypatch)
    assert "did not record" not in output
    assert dataset.recover_environment().spec.id == "own/Rooms-v0"


def test_images_are_exported_exactly(tmp_path, monkeypatch):
    class Camera(Rooms):
        def __init__(self) -> None:
            super().__init__()
            self.observation_space = spaces.Box(0, 255, (32, 32, 3), np.uint8)

    with runner.record(Camera(), tmp_path, name="camera") as rec:
        entries = list(play(rec, 40))
    dataset, _ = exported(rec.run, tmp_path, monkeypatch)
    (first, *_) = dataset.iterate_episodes()
    seen = [entry[2] for entry in entries]
    np.testing.assert_array_equal(first.observations, seen[: len(first.observations)])


def test_an_episode_that_was_reset_before_its_end_is_marked_truncated_and_reported(tmp_path, monkeypatch):
    with runner.record(make("CartPole-v1"), tmp_path, name="loop") as rec:
        rec.reset(seed=1)
        rec.reset(seed=2)
        first = rec.reset(seed=3)[0]
        for _ in range(3):
            rec.step(0)
        rec.reset()
        rec.step(1)
    dataset, output = exported(rec.run, tmp_path, monkeypatch)
    (episode,) = dataset.iterate_episodes()
    assert episode.truncations.tolist() == [False, False, True]
    np.testing.assert_array_equal(episode.observations[0], first)
    assert "1 episodes were reset before their end" in output
    assert "The last training episode never ended" in output


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.name)
def test_parallel_environments_give_whole_episodes_each(mode, n, tmp_path, monkeypatch):
    """Each equals the episode of a single environment with the same seed and actions."""
    envs = SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")] * n, autoreset_mode=mode)
    with runner.record_vector(envs, tmp_path, name="loop", chunk_steps=256) as rec:
        rec.reset(seed=7)
        over = np.zeros(n, np.bool_)
        for _ in range(400):
            if mode == AutoresetMode.DISABLED and over.any():
                rec.reset(options={"reset_mask": over})
            _, _, terminated, truncated, _ = rec.step(np.ones(n, np.int64))
            over = terminated | truncated
    dataset, _ = exported(rec.run, tmp_path, monkeypatch)
    assert dataset.recover_environment().spec.id == "CartPole-v1"
    found = list(dataset.iterate_episodes())
    assert len(found) == rec.run.summary["messages"]["/train/episode"]
    alone = gymnasium.make("CartPole-v1")
    for k in range(n):
        mine = [alone.reset(seed=7 + k)[0]]
        over = False
        while not over:
            seen, _, over, _, _ = alone.step(1)
            mine.append(seen)
        assert any(np.array_equal(mine, episode.observations) for episode in found)
    assert all(len(one.observations) == len(one.rewards) + 1 for one in found)
    assert all(one.terminations[-1] for one in found)


def test_selected_episodes_of_a_game(tmp_path, monkeypatch):
    from dualtaxi.parallel import DualTaxiParallelEnv

    with runner.record_parallel(DualTaxiParallelEnv(max_steps=9), tmp_path, name="game") as rec:
        for seed in range(5):
            rec.reset(seed=seed)
            while rec.agents:
                rec.step({agent: rec.action_space(agent).sample() for agent in rec.agents})
    dataset, _ = exported(rec.run, tmp_path, monkeypatch, "--episodes", "1:3")
    assert [int(one["seed"]) for one in dataset.storage.get_episode_metadata([0, 1])] == [1, 2]
    for episode in dataset.iterate_episodes():
        assert set(episode.actions) == {"taxi_1", "taxi_2"}
        np.testing.assert_array_equal(episode.infos["rewards"][1:].sum(axis=1), episode.rewards)
        assert episode.infos["acted"][1:].tolist() == [3] * 9


def test_a_phase_without_an_episode_is_refused(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path) as rec:
        rec.reset()
        rec.step(0)
    for phase in ("train", "eval"):
        done = CliRunner().invoke(
            cli, ["export", "minari", str(rec.run.recording), "-o", str(tmp_path / "m"), "--phase", phase]
        )
        assert done.exit_code == 2
        assert f"no {phase} episode that ended" in done.output


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1.5, np.inf, (2, 3), np.float32),
        spaces.Box(np.array([-np.inf, 0]), np.array([0, 2]), dtype=np.float64),
        spaces.Box(0, 2**64 - 1, (), np.uint64),
        spaces.Discrete(5, start=-3),
        spaces.MultiDiscrete([[2, 3], [4, 5]]),
        spaces.MultiBinary((2, 2)),
        spaces.Dict({"a": spaces.Tuple((spaces.Discrete(2), spaces.MultiBinary(3)))}),
    ],
    ids=str,
)
def test_a_space_is_restored_from_its_description(space):
    assert restore_space(recorded_space(space).describe()) == space
