"""Several processes that record one run: the order of what they recorded, killed processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import runner
from runner.execution.verify import verify
from runner.loops.fold import fold_if_over
from runner.recording.reader import open_recording
from runner.runs.run import run_at
from runner.runs.shards import shards_of
from runner.util.processes import start_process
from tests.runner.loops.making import Rooms, dualtaxi
from tests.runner.loops.sharing import FORKED, play, started, work

pytestmark = pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")


def together(folder: Path, delay: float) -> runner.Run:
    """Record a run by its owner and four more processes, of which one evaluates."""
    with runner.record(gymnasium.make("CartPole-v1"), folder, name="joined", config={"lr": 1}) as rec:
        processes = [started(rec.run.folder, f"w{k}", 200 + 70 * k, k, delay) for k in (1, 2, 10)]
        processes.append(started(rec.run.folder, "eval", 120, 7, delay, phase="eval", at=500))
        play(rec, 250, 0, delay)
        for process in processes:
            process.join(60)
            assert process.exitcode == 0
    return rec.run


def test_a_run_is_the_same_whichever_process_is_faster(tmp_path):
    runs = [together(tmp_path, 0.0), together(tmp_path, 0.05)]
    assert runs[0].summary.content_digest == runs[1].summary.content_digest
    assert runs[0].status == "finished"
    with open_recording(runs[0].recording) as recording:
        assert [shard.name for shard in recording.shards] == ["", "eval", "w1", "w2", "w10"]
        assert recording.done()["train_steps"] == 250 + 270 + 340 + 900
        assert recording.done()["eval_steps"] == 120
        # The evaluation stands where its process said, after 500 training steps and those of episodes begun.
        first = next(recording.eval.resets.blocks())[0]
        assert 500 <= first["log_time"] // 10**8 < 800
        values = recording.train.extras.of_episode(3)["value"]
        assert np.array_equal(np.diff(values), np.full(len(values) - 1, 0.5))
        times = [one["log_time"] for one in recording.table("/scalar").decoded()]
        assert times == sorted(times)
        assert len(times) == 3 + sum(-(-steps // 50) for steps in (250, 270, 340, 900))
    assert not shards_of(runs[0])
    assert verify(runs[0].recording).verdict == "reproduced"


def test_episodes_are_put_in_order_of_the_steps_of_their_processes(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path, name="order") as rec:
        for shard in ("b", "a"):  # the order in which they come does not matter
            work(rec.run, shard, 300, 3)
    with open_recording(rec.run.recording) as recording:
        resets = recording.train.resets.array()
    # Both did the same, so each episode of `a` is followed by that of `b`.
    assert resets["environment"].tolist() == [1, 2] * (len(resets) // 2)
    assert (resets["observation"][::2] == resets["observation"][1::2]).all()


MODES = [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED]


@pytest.mark.parametrize("mode", MODES, ids=[mode.name for mode in MODES])
def test_vectors_and_single_environments_share_a_run(tmp_path, mode):
    def envs(n):
        return SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")] * n, autoreset_mode=mode)

    def step(rec, steps, seed):
        rec.action_space.seed(seed)
        rec.reset(seed=seed)
        for _ in range(steps):
            _, _, terminated, truncated, _ = rec.step(rec.action_space.sample())
            if mode == AutoresetMode.DISABLED and (over := terminated | truncated).any():
                rec.reset(options={"reset_mask": over})

    with runner.record_vector(envs(3), tmp_path, name="vectors") as rec:
        with runner.record_vector(envs(2), join=rec.run, shard="two") as two:
            step(two, 90, 5)
        with runner.record_vector(envs(1), join=rec.run, shard="vector-of-one") as alone:
            step(alone, 80, 8)
        work(rec.run, "one", 100, 6, phase="eval")
        step(rec, 120, 1)
    assert rec.run.status == "finished"
    with open_recording(rec.run.recording) as recording:
        assert [(shard.name, shard.environments) for shard in recording.shards] == [
            ("", 3),
            ("one", 1),
            ("two", 2),
            ("vector-of-one", 1),
        ]
        steps = recording.done()["train_steps"]
        taken = 120 * 3 + 90 * 2 + 80
        assert steps < taken if mode == AutoresetMode.NEXT_STEP else steps == taken
    rerun = verify(rec.run.recording)
    assert (rerun.verdict, rerun.steps, rerun.left_out) == ("reproduced", steps + 100, 0)


class Wide(gymnasium.Env):
    """Takes float32 actions, and any others."""

    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.random(2, np.float32), {}

    def step(self, action):
        return (
            self.np_random.random(2, np.float32),
            float(action[0]),
            False,
            self.np_random.random() < 0.1,
            {},
        )


class Parted(Wide):
    """Takes actions of two parts, of which each process has a wide one."""

    action_space = spaces.Dict(a=spaces.Box(-9, 9, (), np.float16), b=spaces.Box(-9, 9, (2,), np.float32))

    def step(self, action):
        return super().step(np.array([action["a"]]))


def test_the_widest_numbers_of_each_part_of_an_action_are_kept(tmp_path):
    dtypes = {"owner": (np.float64, np.float32), "other": (np.float16, np.float64)}
    with runner.record(Parted(), tmp_path, name="owner") as rec:
        other = runner.record(Parted(), join=rec.run, shard="other")
        for own, (a, b) in zip((rec, other), dtypes.values(), strict=True):
            own.reset(seed=0)
            own.step({"a": a(0.1), "b": np.full(2, 0.1, b)})
        other.close()
    with open_recording(rec.run.recording) as recording:
        actions = np.concatenate([block["action"] for block in recording.train.steps.blocks()])
    assert sorted(actions["a"].tolist()) == [float(np.float16(0.1)), 0.1]
    assert sorted(actions["b"][:, 0].tolist()) == [0.1, float(np.float32(0.1))]


def test_the_widest_actions_and_all_extras_are_kept(tmp_path):
    with runner.record(Wide(), tmp_path, name="wide") as rec:
        other = runner.record(Wide(), join=rec.run, shard="other")
        for own, kind, name in ((rec, np.float32, "a"), (other, np.float64, "b")):
            own.reset(seed=0)
            for k in range(30):
                shaped = np.zeros(1 + (own is rec))  # of another shape in each process
                if any(own.step(np.array([k / 7], kind), {name: k, "shaped": shaped})[2:4]):
                    own.reset()
        other.close()
    with open_recording(rec.run.recording) as recording:
        actions = np.concatenate([block["action"] for block in recording.train.steps.blocks()])
        extras = recording.train.extras.at(np.arange(60))
    assert actions.dtype == np.float64
    expected = [np.float32(k / 7) for k in range(30)] + [k / 7 for k in range(30)]
    assert sorted(actions.ravel()) == sorted(map(float, expected))
    assert extras["a"].count() == extras["b"].count() == 30
    assert (extras["a"].mask != extras["b"].mask).all()
    assert (extras["shaped"].shape, extras["shaped (other)"].shape) == ((60, 2), (60, 1))


def test_texts_infos_options_frames_and_checkpoints_come_along(tmp_path):
    def do(rec, seed):
        rec.reset(seed=seed, options={"start": seed})
        rec.action_space.seed(seed)
        for _ in range(20):
            if any(rec.step(rec.action_space.sample())[2:4]):
                rec.reset()
        rec.log("note", f"of {seed}")
        rec.snapshot("weights", np.arange(seed))
        rec.checkpoint("policy", bytes([seed]))

    options = {"info": ["*"], "frames_every": 1}
    with runner.record(Rooms(with_text=True), tmp_path, name="rooms", **options) as rec:
        do(rec, 1)
        with runner.record(Rooms(with_text=True), join=rec.run, shard="two", **options) as two:
            do(two, 2)
    with open_recording(rec.run.recording) as recording:
        given = list(recording.train.reset_options())
        assert [own.options for own in given] == [{"start": 1}, {"start": 2}]
        seeds = np.concatenate([block["seed"] for block in recording.train.resets.rows()])
        assert [int(seeds[own.reset]) for own in given] == [1, 2]
        logs = [one["message"] for one in recording.table("/log").decoded()]
        assert sorted(logs) == ["of 1", "of 2"]
        frames = recording.train.frames.count()
        resets = recording.train.resets.count()
        assert frames == 40 + resets
        missions = {step["next_observation"]["mission"] for step in recording.train.transitions()}
        assert missions
    checkpoints = rec.run.checkpoints()
    assert sorted(checkpoint.load() for checkpoint in checkpoints) == [b"\1", b"\2"]
    with open_recording(rec.run.recording) as recording:
        for episode in range(recording.train.episodes.count()):
            from runner.replay.steps import recorded_frames

            assert len(list(recorded_frames(recording, "train", episode))) > 1


# --- processes that are killed ----------------------------------------------------------------------------


@pytest.mark.parametrize("after", [0.0, 0.3, 1.2])
def test_a_killed_shard_loses_its_last_second_at_most(tmp_path, after):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path, name="killed") as rec:
        process = started(rec.run.folder, "victim", 10**7, 1, 0.02)
        deadline = time.monotonic() + 30
        while not shards_of(rec.run) and time.monotonic() < deadline:
            time.sleep(0.01)
        begun = time.monotonic()
        time.sleep(after)
        os.kill(process.pid, signal.SIGKILL)
        lasted = time.monotonic() - begun
        process.join(30)
        play(rec, 100, 0)
    run = run_at(rec.run.folder)
    assert not shards_of(run)
    with open_recording(run.recording) as recording:
        victim = next((shard for shard in recording.shards if shard.name == "victim"), None)
        steps = 0 if victim is None else victim.train_steps
        assert recording.done()["train_steps"] == 100 + steps
        if lasted > 1.1:
            assert steps > 100
            assert victim.status == "interrupted"
    assert verify(run.recording, sample=5).verdict == "reproduced"


def fail(how: str) -> None:
    """Join the run of the parent process, and crash, with or without a `with`."""
    rec = runner.record(gymnasium.make("CartPole-v1"), join=True)
    play(rec, 101, 1)
    if how == "with":
        with rec:
            raise RuntimeError("worker died")
    raise RuntimeError("worker died")


@pytest.mark.parametrize(
    ("how", "ending", "error"),
    [
        ("with", "failed", "SpawnProcess-2 failed: RuntimeError: worker died"),
        ("without", "interrupted", None),  # the exception is not known to the recording
    ],
)
def test_a_crashed_process_is_named_with_its_exception(tmp_path, how, ending, error):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path, name="crashed") as rec:
        process = start_process(FORKED, fail, how, name="SpawnProcess-2")
        process.join(60)
        play(rec, 100, 0)
    run = run_at(rec.run.folder)
    assert (run.status, run.summary.train_steps) == ("finished", 201)
    shown = dualtaxi(tmp_path, "show", run.run_id).output
    assert f"the one that began the run, SpawnProcess-2; SpawnProcess-2 {ending}" in shown
    assert run.summary.error == error
    with open_recording(run.recording) as recording:
        assert recording.result.error == error


OWNER = """
import sys, time, gymnasium, runner
rec = runner.record(gymnasium.make("CartPole-v1"), sys.argv[1], name="owner")
rec.reset(seed=0)
print(rec.run.run_id, flush=True)
while True:
    if any(rec.step(0)[2:4]):
        rec.reset()
    time.sleep(0.001)
"""


def owner(folder) -> tuple[subprocess.Popen, runner.Run]:
    process = subprocess.Popen([sys.executable, "-c", OWNER, str(folder)], stdout=subprocess.PIPE, text=True)
    with process.stdout as output:
        return process, run_at(Path(folder) / output.readline().strip())


def test_the_last_process_folds_when_the_owner_was_killed(tmp_path):
    process, run = owner(tmp_path)
    rec = runner.record(gymnasium.make("CartPole-v1"), join=run, shard="w")
    play(rec, 100, 1)
    time.sleep(0.8)
    process.kill()
    process.wait()
    rec.close()
    run = run_at(run.folder)
    assert run.status == "interrupted"
    assert run.summary.seconds is None  # the time of folding alone would be no time of the run
    assert run.summary.train_steps > 150
    assert not shards_of(run)
    found = verify(run.recording)
    assert (found.verdict, found.act) == ("interrupted", "rerun")


def test_the_next_command_folds_when_all_were_killed(tmp_path):
    process, run = owner(tmp_path)
    worker = started(run.folder, "w", 10**7, 1, 0.02)
    deadline = time.monotonic() + 30
    while not shards_of(run) and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(1.2)
    process.kill()
    worker.kill()
    process.wait()
    worker.join()
    assert [shard.status for shard in shards_of(run)] == ["interrupted"]
    assert "1 shard" in dualtaxi(tmp_path, "show", run.run_id).stderr
    run = run_at(run.folder)
    assert not shards_of(run)
    assert run.summary.train_steps > 300
    assert run.summary.content_digest


def test_a_fold_that_was_killed_is_done_again(tmp_path, monkeypatch):
    rec = runner.record(gymnasium.make("CartPole-v1"), tmp_path, name="fold")
    work(rec.run, "w", 100, 1)
    play(rec, 100, 2)
    from runner.loops import fold

    real = fold.shutil.rmtree
    monkeypatch.setattr(fold.shutil, "rmtree", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        rec.close()  # all was written, but the shards are still there
    monkeypatch.setattr(fold.shutil, "rmtree", real)
    (rec.run.folder / ".recording.mcap.folding").write_bytes(b"half")
    run = fold_if_over(run_at(rec.run.folder))
    assert not shards_of(run)
    with open_recording(run.recording) as recording:
        assert recording.done()["train_steps"] == 200


def test_games_of_several_agents_share_a_run(tmp_path):
    from mpe2 import simple_tag_v3

    def step(rec, seed):
        for episode in range(2):
            rec.reset(seed=seed + episode)
            while rec.agents:
                for agent in rec.agents:
                    rec.action_space(agent).seed(seed)
                rec.step({agent: rec.action_space(agent).sample() for agent in rec.agents})

    with runner.record_parallel(simple_tag_v3.parallel_env(max_cycles=30), tmp_path, name="game") as rec:
        step(rec, 1)
        with runner.record_parallel(simple_tag_v3.parallel_env(max_cycles=30), join=rec.run) as two:
            step(two, 5)
    rerun = verify(rec.run.recording)
    assert (rerun.verdict, rerun.steps, rerun.episodes) == ("reproduced", 120, 4)
    assert verify(rec.run.recording).sound


def test_events_of_a_table_are_counted_over_all_processes(tmp_path):
    with runner.record(gymnasium.make("Taxi-v4"), tmp_path, name="taxi") as rec:
        play(rec, 500, 1)
        with runner.record(gymnasium.make("Taxi-v4"), join=rec.run, shard="two", phase="eval") as two:
            play(two, 500, 2)
    with open_recording(rec.run.recording) as recording:
        assert recording.tabular
        assert recording.train.episodes.array()["penalties"].sum() > 0
        assert recording.result.rewards_off_table == 0
    assert verify(rec.run.recording).sound
    assert verify(rec.run.recording).verdict == "reproduced"
