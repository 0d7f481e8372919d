"""Loops of which only the actions were recorded: what is left, what comes again, and what is refused."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import textwrap
import time

import gymnasium
import numpy as np
import pytest
from click.testing import CliRunner
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TransformReward
from making import Leaving, Rooms
from starlette.testclient import TestClient

import runner
from runner.cli import cli
from runner.errors import CannotRedo, ConfigError, Diverged, RecordingError, RunnerError
from runner.execution.rerecord import rerecord
from runner.execution.verify import verify
from runner.export.reports.report import render_report
from runner.recording.integrity import survey
from runner.recording.reader import open_recording
from runner.recording.recorder import Recorder
from runner.recording.steps import packed, unpacked
from runner.replay.steps import whole_steps
from runner.runs.trust_marks import MARK_FILE
from runner.service.app import create_app
from runner.service.settings import ServiceSettings
from tests.runner.replay import loops as replayed
from tests.waiting import until


def single(env_id, steps=1500):
    """Return a function that records training with resets in between, and evaluation."""

    def play(folder, **options):
        with runner.record(gymnasium.make(env_id), folder, seed=3, **options) as rec:
            rec.action_space.seed(0)
            over = True
            for k in range(steps):
                if over or k % 97 == 0:
                    rec.reset(seed=5 if k == 0 else None)
                *_, terminated, truncated, _ = rec.step(rec.action_space.sample())
                over = terminated or truncated
                if k % 400 == 399:
                    with rec.phase("eval"):
                        rec.reset(seed=k)
                        for _ in range(7):
                            rec.step(rec.action_space.sample())
                    over = True
        return rec.run

    return play


def vector(mode):
    def play(folder, **options):
        envs = SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")] * 3, autoreset_mode=mode)
        with runner.record_vector(envs, folder, **options) as rec:
            rec.reset(seed=1)
            rec.action_space.seed(0)
            for k in range(300):
                rec.step(rec.action_space.sample())
                if k == 150:
                    rec.reset()
        return rec.run

    return play


def game(folder, **options):
    from mpe2 import simple_spread_v3

    with runner.record_parallel(simple_spread_v3.parallel_env(max_cycles=12), folder, **options) as rec:
        for agent in rec.possible_agents:
            rec.action_space(agent).seed(0)
        for episode in range(5):
            rec.reset(seed=episode)
            while rec.agents:
                rec.step({agent: rec.action_space(agent).sample() for agent in rec.agents})
    return rec.run


LOOPS = {
    "states": single("Taxi-v4"),
    "arrays": single("CartPole-v1"),
    "continuous": single("Pendulum-v1"),
    "next step": vector("NextStep"),
    "same step": vector("SameStep"),
    "game": game,
}


@pytest.fixture(scope="module", params=LOOPS)
def runs(request, tmp_path_factory):
    """Return a loop recorded whole, and the same by its actions alone."""
    folder, play = tmp_path_factory.mktemp("actions"), LOOPS[request.param]
    return play(folder, name="whole"), play(folder, name="actions", steps="actions")


def test_the_content_is_that_of_whole_steps_which_come_again(runs, tmp_path):
    whole, actions = runs
    digest = whole.summary["content_digest"]
    assert actions.summary["content_digest"] == digest
    with open_recording(actions.recording) as recording, open_recording(whole.recording) as full:
        assert not any(phase.steps for phase in recording.phases)
        for phase in ("train", "eval"):
            assert recording.phase(phase).steps.total() == full.phase(phase).steps.count()
            kept = list(recording.phase(phase).steps.rows())
            assert len(kept) <= 1, "the blocks that were flushed in between are one"
            steps = list(full.phase(phase).steps.blocks())
            for name in kept[0].dtype.names if kept else ():
                if name != "digest":
                    found = np.concatenate([block[name] for block in kept])
                    assert found.tobytes() == np.concatenate([block[name] for block in steps]).tobytes()
    assert verify(actions.recording).sound
    rerun = verify(actions.recording)
    assert (rerun.verdict, rerun.left_out) == ("reproduced", 0)
    assert rerun.steps == verify(whole.recording).steps
    after = rerecord(actions)
    assert after.summary["content_digest"] == digest
    assert verify(after.recording).content_digest == digest
    with open_recording(after.recording) as recording, open_recording(whole.recording) as full:
        assert not recording.leaves_out_steps
        for phase in ("train", "eval"):
            topic = full.table(f"/{phase}/step").topic
            parts = [[block.tobytes() for block in each.table(topic).blocks()] for each in (recording, full)]
            assert b"".join(parts[0]) == b"".join(parts[1])
    assert rerecord(after).summary == after.summary, "there is nothing left to do"


def test_rerecord_says_which_episodes_cannot_be_rerun(tmp_path):
    options = {"make": replayed.twisted, "steps": "actions", "name": "twisted"}
    with runner.record(replayed.twisted(), tmp_path, **options) as rec:
        for seed in (None, None, 7, None):
            rec.reset(seed=seed)
            for _ in range(10):
                rec.step(0)
    found = verify(rec.run.recording, trust=True)
    assert (found.verdict, found.steps, found.left_out) == ("reproduced", 20, 20)
    size = rec.run.recording.stat().st_size
    with pytest.raises(CannotRedo, match="20 steps of training cannot be rerun, from its episode 0 on"):
        rerecord(rec.run, trust=True)
    assert rec.run.recording.stat().st_size == size


def test_steps_of_actions_alone_are_found_by_number_and_not_taken_for_none(tmp_path, monkeypatch):
    run = single("CartPole-v1")(tmp_path, steps="actions", chunk_steps=256)
    unpacked_blocks = []
    monkeypatch.setattr(
        "runner.recording.steps.unpacked",
        lambda fields, *more: unpacked_blocks.append(fields["step"]) or unpacked(fields, *more),
    )
    with open_recording(run.recording) as recording:
        steps = recording.train.steps
        (rows,) = steps.numbered(range(1030, 1033))
        assert rows["step"].tolist() == [1030, 1031, 1032]
        assert unpacked_blocks[0] == 1024, "none before the first that is asked for"
        for read in (steps.count, steps.array, lambda: next(steps.blocks(1030))):
            with pytest.raises(RecordingError, match="has only the actions of the steps in /train/step"):
                read()
        assert steps.total() == 1500


def test_one_episode_comes_again_alone(tmp_path):
    run = single("CartPole-v1")(tmp_path, steps="actions")
    with open_recording(run.recording) as recording:
        (steps,) = runner.replay.environment.rerun(recording, "train", [9])
        assert steps.difference is None
        assert len(steps.recorded) == recording.train.episodes.array(9, 10)["length"][0]


def test_replays_make_its_steps_again(tmp_path):
    for steps in ("all", "actions"):
        single("Taxi-v4", steps=500)(tmp_path, name=steps, steps=steps)

    def said(*words):
        done = CliRunner().invoke(cli, [*words, "--recordings", str(tmp_path)])
        assert done.exit_code == 0, done.output
        return done.stdout

    shown = [said("play", name, "--episode", "2", "--json") for name in ("all", "actions")]
    assert shown[0] == shown[1]
    said("export", "film", "actions", "--best", "-o", str(tmp_path / "x.gif"))
    text, _ = render_report([runner.list_runs(tmp_path)[0].recording])
    assert "No episode of run" not in text
    settings = ServiceSettings(recordings=(tmp_path,), tokens=tmp_path / "tokens.json")
    with TestClient(create_app(settings), base_url="http://localhost") as client:
        addresses = [f"/api/v1/runs/{name}/replay/train/2" for name in ("all", "actions")]
        first, again = (client.get(address).json()["episode"] for address in addresses)
    assert first == again


class Other(gymnasium.Wrapper):
    """Gives another reward at one step."""

    def __init__(self, env, at=-1):
        super().__init__(env)
        self.at, self.taken = at, 0

    def step(self, action):
        observation, reward, *rest = self.env.step(action)
        self.taken += 1
        return observation, reward + (self.taken == self.at), *rest


def test_another_reward_is_found_in_its_episode(tmp_path, monkeypatch):
    with runner.record(Other(gymnasium.make("CartPole-v1"), at=70), tmp_path, steps="actions") as rec:
        rec.reset(seed=0)
        for _ in range(200):
            *_, terminated, truncated, _ = rec.step(1)
            if terminated or truncated:
                rec.reset()
    with open_recording(rec.run.recording) as recording:
        make = lambda: gymnasium.make("CartPole-v1")  # noqa: E731
        difference = [steps.difference for steps in runner.replay.environment.rerun(recording, make=make)][-1]
        ends = recording.train.episodes.array()["last_step"]
    assert difference.field == "digest of the episode so far"
    assert difference.step == ends[np.searchsorted(ends, 69)]


def test_without_actions_nothing_comes_again(tmp_path):
    play = single("CartPole-v1")
    run, whole = play(tmp_path, steps="none"), play(tmp_path)
    assert run.summary["content_digest"] == whole.summary["content_digest"]
    assert verify(run.recording).sound
    with pytest.raises(RunnerError, match="without its actions"):
        rerecord(run)
    rerun = verify(run.recording)
    assert (rerun.verdict, rerun.reason) == ("consistent", "No steps were recorded.")
    shown = CliRunner().invoke(cli, ["play", run.run_id, "--recordings", str(tmp_path)])
    assert shown.exit_code
    assert "without its actions a loop's environment cannot be rerun" in " ".join(shown.output.split())
    assert "rerecord" not in shown.output


def test_values_that_vary_in_size_need_whole_steps(tmp_path):
    with pytest.raises(ConfigError, match="vary in size"):
        runner.record(Rooms(with_text=True), tmp_path, steps="actions")
    with pytest.raises(ConfigError, match="steps: found 'some', expected all, actions or none"):
        runner.record(gymnasium.make("CartPole-v1"), tmp_path, steps="some")
    assert not runner.list_runs(tmp_path)


class Biased(gymnasium.Env):
    """Keeps its argument in no attribute."""

    observation_space = action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, bias=0.0):
        self.reward = 1 + bias

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return 1, self.reward, False, False, {}


class BiasedGame(Leaving):
    """The same as a game."""

    def __init__(self, bias=0.0):
        super().__init__()
        self.reward = 1 + bias


def record_batch(folder, **options):
    spaces = {"observation_space": Biased.observation_space, "action_space": Biased.action_space}
    with runner.record_batches("biased", folder, autoreset_mode="NextStep", **spaces, **options) as rec:
        rec.batch(np.zeros((4, 2), int), np.zeros((3, 2), int), np.ones((3, 2)), np.zeros((3, 2), bool))
    return rec


@pytest.mark.parametrize(
    ("record", "why"),
    [
        (lambda *a, **o: runner.record(Biased(), *a, **o), "Biased could not be recorded"),
        (lambda *a, **o: runner.record(TransformReward(Biased(), abs), *a, **o), "argument func"),
        (
            lambda *a, **o: runner.record_vector(SyncVectorEnv([Biased]), *a, **o),
            "Biased could not be recorded",
        ),
        (lambda *a, **o: runner.record_parallel(BiasedGame(), *a, **o), "BiasedGame could not be recorded"),
        (record_batch, "known by its name alone"),
    ],
)
def test_actions_alone_need_an_environment_that_can_be_made_again(record, why, tmp_path):
    with pytest.raises(ConfigError, match=f'steps: .*expected "all".*{why}.*make="module:function"'):
        record(tmp_path, steps="actions")
    assert not runner.list_runs(tmp_path)
    with pytest.warns(RuntimeWarning, match="recorded are whole steps") as warned:
        rec = record(tmp_path, steps="actions", on_error="warn")
    rec.close()
    assert len(warned) == 1
    assert rec.run.summary["steps_recorded"]
    rec = record(tmp_path, steps="actions", make=f"{__name__}:Biased")
    rec.close()
    assert not rec.run.summary["steps_recorded"]


@pytest.mark.parametrize("on_error", ["raise", "warn"])
def test_actions_alone_need_an_environment_for_evaluation_that_can_be_made_again(tmp_path, on_error):
    pole = gymnasium.make("CartPole-v1")
    with (
        runner.record(pole, tmp_path, steps="actions", on_error=on_error) as rec,
        pytest.raises(ConfigError, match="argument func"),
    ):
        runner.record(TransformReward(gymnasium.make("CartPole-v1"), abs), into=rec, phase="eval")


def test_an_environment_of_ones_own_is_not_imported(tmp_path):
    with runner.record(Rooms(), tmp_path, steps="actions") as rec:
        rec.reset(seed=0)
        rec.step(rec.action_space.sample())
    (rec.run.folder / MARK_FILE).unlink()
    before = rec.run.recording.read_bytes()
    with pytest.raises(CannotRedo):
        rerecord(rec.run)
    assert rec.run.recording.read_bytes() == before
    assert [path.name for path in rec.run.folder.iterdir() if "rerecording" in path.name] == []


def test_a_killed_loop_keeps_its_actions_up_to_the_last_second(tmp_path):
    script = textwrap.dedent("""
        import sys, time, gymnasium, runner
        with runner.record(gymnasium.make("CartPole-v1"), sys.argv[1], steps="actions") as rec:
            rec.action_space.seed(0)
            rec.reset(seed=0)
            while True:
                *_, terminated, truncated, _ = rec.step(rec.action_space.sample())
                if terminated or truncated:
                    rec.reset()
                time.sleep(0.0005)
        """)
    process = subprocess.Popen([sys.executable, "-c", script, str(tmp_path)])
    try:
        until(
            lambda runs: runs and runs[0].recording.exists() and runs[0].recording.stat().st_size > 40_000,
            lambda: runner.list_runs(tmp_path),
        )
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    (run,) = runner.list_runs(tmp_path)
    rerun = verify(run.recording)
    assert (rerun.verdict, rerun.act) == ("interrupted", "rerun")
    assert rerun.steps > 100
    with pytest.raises(RunnerError, match="cut off"):
        rerecord(run)


def test_it_takes_less_than_a_byte_a_step_in_long_episodes(tmp_path):
    def size(steps):
        with runner.record(
            gymnasium.make("MountainCar-v0", max_episode_steps=500), tmp_path, steps="actions"
        ) as rec:
            rec.action_space.seed(0)
            for k in range(steps):
                if k % 500 == 0:
                    rec.reset(seed=0 if k == 0 else None)
                rec.step(rec.action_space.sample())
        return rec.run.recording.stat().st_size

    assert (size(40_000) - size(20_000)) / 20_000 < 1


def test_a_disk_without_space_for_both_keeps_the_small_chunks(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("runner.recording.rewriting.RecordingFile", fail)
    run = single("CartPole-v1")(tmp_path, steps="actions")
    assert sorted(path.name for path in run.folder.iterdir()) == ["recording.mcap", "run.json", "trust.json"]
    with open_recording(run.recording) as recording:
        assert len(list(recording.train.steps.rows())) > 1
    assert verify(run.recording).verdict == "reproduced"


@pytest.mark.parametrize("end", [False, True])
def test_chunks_that_cannot_be_read_when_a_recording_ends_keep_the_original(tmp_path, end):
    env = runner.record(gymnasium.make("CartPole-v1"), tmp_path, steps="actions")
    env.action_space.seed(0)
    env.reset(seed=0)
    for step in range(3000):
        if any(env.step(env.action_space.sample())[2:4]):
            env.reset()
        if step % 1000 == 999:
            time.sleep(0.7)  # a chunk is written
    path = env.run.recording
    chunks = list(survey(path).chunks)
    with path.open("r+b") as file:
        file.seek(chunks[-1 if end else 1].offset)
        file.write(b"\xff")  # a kind of record that no reader knows: a walk ends here
    with pytest.raises(RecordingError, match="to copy, expected"):
        env.close()
    assert [file.name for file in path.parent.glob(".*.mcap")] == []
    assert len(survey(path).chunks) == chunks.index(chunks[-1 if end else 1])


def test_a_changed_action_is_found(tmp_path, monkeypatch):
    run = single("CartPole-v1", steps=300)(tmp_path, steps="actions")
    from runner.replay import recorded

    original = recorded.pieces

    def changed(*arguments, **keywords):
        for piece in original(*arguments, **keywords):
            if piece.phase == "train" and len(piece.rows) > 50:
                piece.rows["action"][40] ^= 1
            yield piece

    monkeypatch.setattr("runner.execution.rerecord.pieces", changed)
    from runner.execution.rerecord import _rerecord_loop

    with pytest.raises((CannotRedo, Diverged)):
        _rerecord_loop(run.recording, tmp_path / "fresh.mcap", trust=False)


def test_an_episode_of_which_actions_were_lost_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("runner.recording.recorder.packed", lambda rows, n: packed(rows[5:], n))
    env = gymnasium.make("FrozenLake-v1", is_slippery=False)
    with runner.record(env, tmp_path, steps="actions") as rec:
        rec.reset(seed=1)
        for _ in range(100):  # at the edge, where nothing happens
            rec.step(0)
    with open_recording(rec.run.recording) as recording:
        assert recording.train.episode(0).numbers().tolist() == list(range(100))
        with pytest.raises(RecordingError, match="steps of training episode 0 were lost"):
            whole_steps(recording, "train", 0)


def test_wide_actions_of_many_environments_stay_readable(tmp_path):
    space = gymnasium.spaces.Box(-1, 1, (1024,), np.float64)
    draws = np.random.default_rng(0)
    with runner.record_batches(
        "wide",
        tmp_path,
        observation_space=gymnasium.spaces.Box(-1, 1, (2,), np.float32),
        action_space=space,
        autoreset_mode="NextStep",
        steps="actions",
        make="gymnasium:make_vec",
    ) as rec:
        rec.reset(np.zeros((16, 2), np.float32))
        actions = draws.uniform(-1, 1, (600, 16, 1024))
        zeros = np.zeros((600, 16))
        rec.batch(np.zeros((600, 16, 2), np.float32), actions, zeros, zeros > 1, zeros > 1)
    with open_recording(rec.run.recording) as recording:
        found = np.concatenate([rows["action"] for rows in recording.train.steps.rows()])
    assert found.tobytes() == actions.reshape(-1, 1024).tobytes()


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [("environment", 7, "environment"), ("taken", False, "taken"), ("t", 3, "t"), ("episode", 9, "episode")],
)
def test_forged_turns_of_actions_alone_are_damage(tmp_path, monkeypatch, name, value, expected):
    put = Recorder.put

    def forged(recorder, topic, columns, positions):
        if topic.name == "/train/step":
            columns = {**columns, name: np.array(columns[name])}
            columns[name][10:] = value
        put(recorder, topic, columns, positions)

    monkeypatch.setattr(Recorder, "put", forged)
    envs = SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")] * 2)
    with runner.record_vector(envs, tmp_path, steps="actions") as rec:
        rec.reset(seed=0)
        for _ in range(12):
            rec.step(np.ones(2, np.int64))
    monkeypatch.undo()
    found = verify(rec.run.recording, trust=True)
    assert found.verdict == "damaged"
    assert f": {expected}: found" in found.finding


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("steps", ["all", "actions"])
def test_a_vector_without_observations_is_verified(tmp_path, mode, steps):
    envs = SyncVectorEnv([Blind, Blind], autoreset_mode=mode)
    with runner.record_vector(envs, tmp_path, steps=steps) as rec:
        rec.reset(seed=0)
        for _ in range(9):
            over = rec.step(np.ones(2, np.int64))[2]
            if mode == AutoresetMode.DISABLED and over.any():
                rec.reset(options={"reset_mask": over})
    found = verify(rec.run.recording)
    assert (found.sound, found.finding) == (True, "")


class Blind(gymnasium.Env):
    """An environment whose observations have no numbers."""

    observation_space, action_space = gymnasium.spaces.Box(-1, 1, (0,)), gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._t = 0
        return np.zeros(0, np.float32), {}

    def step(self, action):
        self._t += 1
        return np.zeros(0, np.float32), float(self.np_random.random()), self._t == 4, False, {}
