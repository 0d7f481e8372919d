"""Recorded loops as the files of other tools: films, tables, Rerun, MCAP, archives."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas
import pytest
from click.testing import CliRunner
from gymnasium.vector import SyncVectorEnv

import runner
from runner.cli import cli
from runner.recording.reader import open_recording
from tests.runner.loops.making import drive, dualtaxi, make


def test_the_grid_of_a_loop_becomes_a_film(folder, tmp_path):
    done = dualtaxi(folder, "export", "film", "lake", "-o", str(tmp_path / "trial.gif"))
    assert done.exit_code == 0, done.output
    played = dualtaxi(folder, "play", "lake").stdout.splitlines()[0]
    assert "trial 0 of the evaluation after" in played
    assert played.removeprefix("lake, seed 0: ") in done.stdout
    done = dualtaxi(folder, "export", "film", "lake", "--episode", "2", "-o", str(tmp_path / "film.gif"))
    assert done.exit_code == 0, done.output
    with open_recording(runner.find_run("lake", folder).recording) as recording:
        steps = len(recording.train.episode_steps(2))
    assert f"training episode 2, scene, {steps + 1} frames" in done.stdout


def test_episodes_of_a_vector_are_exported_with_their_own_steps_and_resets(tmp_path):
    envs = SyncVectorEnv([lambda: make("CartPole-v1")] * 3)
    with runner.record_vector(envs, tmp_path / "runs") as rec:
        drive(rec, 30)
        for k in range(90):
            rec.step(np.array([0, 1, 0]), extras={"k": np.arange(3) + k, "text": ["a", "b", "c"]})
    folder = str(tmp_path / "tables")
    words = ["export", "parquet", rec.run.run_id, "--episodes", "2..5", "-o", folder]
    done = dualtaxi(tmp_path / "runs", *words)
    assert done.exit_code == 0, done.output
    steps, resets, ended, extras = (
        pandas.read_parquet(f"{folder}/{name}.parquet") for name in ("steps", "resets", "episodes", "extras")
    )
    places = ["step", "episode", "environment", "t"]
    assert extras[places].equals(steps[steps["step"] >= 90][places].reset_index(drop=True))
    assert extras["extra_k"].tolist() == [step // 3 - 30 + step % 3 for step in extras["step"]]
    frame = runner.frames.episodes(rec.run)
    both = ["episode", "environment", "first_step", "last_step", "length"]
    assert frame[both].iloc[2:5].to_numpy().tolist() == ended[both].to_numpy().tolist()
    assert ended["episode"].tolist() == [2, 3, 4]
    with open_recording(rec.run.recording) as recording:
        episodes = [recording.train.episode(number) for number in (2, 3, 4)]
        numbers = np.concatenate([episode.numbers() for episode in episodes])
    assert steps["step"].tolist() == sorted(numbers.tolist())
    assert sorted(resets["environment"]) == sorted(episode.environment for episode in episodes)


def test_a_loop_is_exported_and_imported_with_the_same_content(folder, tmp_path):
    file = str(tmp_path / "rooms.mcap")
    assert dualtaxi(folder, "export", "mcap", "rooms", "-o", file).exit_code == 0
    done = CliRunner().invoke(cli, ["import", file, "--recordings", str(tmp_path / "there")])
    assert done.exit_code == 0, done.output
    there = runner.find_run("rooms", tmp_path / "there")
    assert there.summary["content_digest"] == runner.find_run("rooms", folder).summary["content_digest"]


@pytest.mark.parametrize("name", ["lake", "pole", "rooms"])
def test_a_loop_is_archived_shown_and_restored(folder, name, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    there = Path(shutil.copytree(folder, tmp_path / "loops"))
    digest = runner.find_run(name, there).summary["content_digest"]
    reply = json.loads(dualtaxi(there, "archive", name, "--remove", "--json").stdout)
    assert reply["content_digest"] == digest
    assert reply["removed"]
    assert dualtaxi(there, "plot", name, "-o", str(tmp_path / "plot.svg")).exit_code == 0
    original = runner.find_run(name, folder).recording
    assert dualtaxi(there, "diff", name, str(original)).exit_code == 0
    assert dualtaxi(there, "restore", name).exit_code == 0
    assert runner.find_run(name, there).summary["content_digest"] == digest
    assert dualtaxi(there, "verify", name).exit_code == 0


@pytest.mark.parametrize("form", ["csv", "parquet"])
@pytest.mark.parametrize("name", ["lake", "pole", "rooms"])
def test_a_loops_steps_are_exported_as_tables(folder, form, name, tmp_path):
    done = dualtaxi(folder, "export", form, name, "-o", str(tmp_path / "tables"))
    assert done.exit_code == 0, done.output
    read = pandas.read_csv if form == "csv" else pandas.read_parquet
    steps, resets = (read(tmp_path / "tables" / f"{table}.{form}") for table in ("steps", "resets"))
    with open_recording(runner.find_run(name, folder).recording) as recording:
        seen = [step for phase in ("train", "eval") for step in recording.phase(phase).transitions()]
        count = recording.train.resets.count()
    steps = steps.sort_values("position")
    assert steps["t"].tolist() == [step["t"] for step in seen]
    assert steps["reward"].tolist() == [step["rewards"][0] for step in seen]
    assert len(resets.query("phase == 'train'")) == count
    if name == "pole":
        numbers = steps[[f"next_observation_{i}" for i in range(4)]].to_numpy(np.float32)
        np.testing.assert_array_equal(numbers, [step["next_observation"] for step in seen])
    if name == "rooms":
        missions = [step["next_observation"]["mission"] for step in seen]
        assert steps["next_observation_mission"].fillna("").tolist() == missions


@pytest.mark.parametrize("name", ["lake", "pole", "rooms"])
def test_rerun_gets_what_a_loop_recorded(folder, name, tmp_path):
    from rerun.chunk import RrdReader

    exported = dualtaxi(folder, "export", "rerun", name, "-o", str(tmp_path / "loop.rrd"))
    assert exported.exit_code == 0, exported.output
    assert "400 of 400 training steps" in exported.output
    store = RrdReader(str(tmp_path / "loop.rrd")).store()
    paths = {str(column.entity_path) for column in store.schema().component_columns()}
    assert {"/train/return", "/eval/return", "/train/reward", "/logged/loss", "/log"} <= paths
    assert ("/train/grid/things" in paths) == (name == "lake")
    assert ("/train/observation" in paths) == (name == "pole")
    if name == "pole":
        chunks = store.stream().filter(content="/train/observation").to_chunks()
        (static,) = [chunk.to_record_batch() for chunk in chunks if chunk.is_static]
        colours = static.column("SeriesLines:colors")[0].as_py()
        assert len(set(colours)) == len(colours) == 4, "no two lines look alike"
        assert static.column("SeriesLines:aggregation_policy")[0].as_py() == [5], "lowest and highest"


def test_rerun_gets_a_loop_of_a_single_step_and_episode(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path, name="single") as env:
        env.reset(seed=0)
        env.step(0)
    words = [sys.executable, "-m", "runner", "export", "rerun", "single", "-o", str(tmp_path / "single.rrd")]
    words += ["--recordings", str(tmp_path)]
    exported = subprocess.run(words, check=False, capture_output=True, text=True)
    assert exported.returncode == 0, exported.stderr
    assert "1 of 1 training steps" in exported.stderr
