"""Joining a run that another process records."""

from __future__ import annotations

import multiprocessing
import os

import gymnasium
import pytest
from gymnasium.vector import AsyncVectorEnv

import runner
from runner.errors import ConfigError, RunnerError
from runner.execution.verify import verify
from runner.recording.reader import open_recording
from runner.runs.run import list_runs, run_at
from runner.runs.shards import RUN_VARIABLE, shards_of
from tests.runner.loops.sharing import play, run_all, work

pytestmark = pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")


def test_sixteen_processes_join_at_once(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path, name="many") as rec:
        context = multiprocessing.get_context("fork")
        run_all(*(context.Process(target=work, args=(rec.run, "same", 20, k)) for k in range(16)))
        names = [shard.run_id for shard in shards_of(rec.run)]
        assert names == ["same", *(f"same-{n}" for n in range(2, 17))]
    with open_recording(rec.run.recording) as recording:
        assert len(recording.shards) == 17
        assert recording.done()["train_steps"] == 320
    assert len(list_runs(tmp_path)) == 1


def test_a_run_is_joined_by_id_prefix_name_folder_or_variable(tmp_path, monkeypatch):
    monkeypatch.setenv("DUALTAXI_RECORDINGS", str(tmp_path))
    with runner.record(gymnasium.make("CartPole-v1"), name="named") as rec:
        assert os.environ[RUN_VARIABLE] == str(rec.run.folder.absolute())
        run = rec.run
        ways = [run.run_id, run.run_id[:5], "named", str(run.folder), run.folder, run, True]
        for k, way in enumerate(ways):
            work(way, f"w{k}", 10, k)
    assert RUN_VARIABLE not in os.environ
    with open_recording(rec.run.recording) as recording:
        assert len(recording.shards) == 1 + len(ways)


def test_a_run_can_be_joined_again_after_a_later_one_has_ended(tmp_path, monkeypatch):
    monkeypatch.delenv(RUN_VARIABLE, raising=False)
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path, name="training") as training:
        with runner.record(gymnasium.make("CartPole-v1"), tmp_path, name="other"):
            pass
        with runner.record(gymnasium.make("CartPole-v1"), join=True) as worker:
            pass
    assert worker.run.folder.is_relative_to(training.run.folder)
    assert RUN_VARIABLE not in os.environ


def recorded_here(run):
    return lambda: runner.record(gymnasium.make("CartPole-v1"), join=run)


def test_the_workers_of_an_async_vector_are_named_by_their_numbers(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path, name="async") as rec:
        envs = AsyncVectorEnv([recorded_here(rec.run)] * 3, context="fork")
        envs.action_space.seed(0)
        envs.reset(seed=0)
        for _ in range(50):
            envs.step(envs.action_space.sample())
        envs.close()
    with open_recording(rec.run.recording) as recording:
        names = [shard.name for shard in recording.shards]
    assert names == ["", *(f"Worker-AsyncVectorEnv-{k}" for k in range(3))]


def test_mistakes_of_joining_are_named(tmp_path, monkeypatch):
    def env():
        return gymnasium.make("CartPole-v1")

    monkeypatch.delenv(RUN_VARIABLE, raising=False)
    with pytest.raises(ConfigError, match="found no DUALTAXI_RUN"):
        runner.record(env(), join=True)
    with pytest.raises(RunnerError, match="no run 'nothing'"):
        runner.record(env(), tmp_path, join="nothing")
    actions = runner.record(env(), tmp_path, steps="actions")
    with pytest.raises(RunnerError, match="is recorded with steps 'actions', expected all"):
        runner.record(env(), join=actions.run)
    actions.close()
    rec = runner.record(env(), tmp_path, name="mistakes")
    with pytest.raises(ConfigError, match="expected the spaces and agents of run"):
        runner.record(gymnasium.make("MountainCar-v0"), join=rec.run)
    with pytest.raises(ConfigError, match="name, seed or config"):
        runner.record(env(), join=rec.run, name="other")
    with pytest.raises(ConfigError, match="without join"):
        runner.record(env(), shard="w")
    with pytest.raises(ConfigError, match="1 to 80 letters"):
        runner.record(env(), join=rec.run, shard="a/b")
    with pytest.raises(ConfigError, match="1 to 80 letters"):
        runner.record(env(), join=rec.run, shard=".hidden")  # which nothing would find
    with pytest.raises(ConfigError, match="join: found 3"):
        runner.record(env(), join=3)
    two = runner.record(env(), join=rec.run, shard="w")
    with pytest.raises(ConfigError, match="at_step: found -1"):
        two.at_step(-1)
    two.reset(seed=0)
    two.step(0)
    with pytest.raises(RunnerError, match="found training steps of this process"):
        two.at_step(5)
    two.close()
    rec.close()
    with pytest.raises(RunnerError, match="is finished, expected one that is still being recorded"):
        runner.record(env(), join=rec.run)


def test_a_job_cannot_be_joined(tmp_path):
    job = runner.run("quick", overrides=["episodes=2", "evaluation=null"], recordings=tmp_path)
    with pytest.raises(RunnerError, match="is a job"):
        runner.record(gymnasium.make("Taxi-v4"), join=job)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork on this system")
def test_the_owner_may_end_before_its_shards(tmp_path, monkeypatch):
    monkeypatch.setattr("runner.loops.loop_run.OWNER_WAITS", 0.1)
    rec = runner.record(gymnasium.make("CartPole-v1"), tmp_path, name="early")
    two = runner.record(gymnasium.make("CartPole-v1"), join=rec.run, shard="late")
    play(two, 50, 1)
    play(rec, 50, 2)
    rec.close()
    assert rec.run.summary.train_steps == 50
    assert len(shards_of(rec.run)) == 1
    assert (rec.run.status, run_at(rec.run.folder).status) == ("running", "running")
    with pytest.raises(RunnerError, match="is finished, expected"):
        runner.record(gymnasium.make("CartPole-v1"), join=rec.run)
    play(two, 50, 1)
    two.close()
    run = run_at(rec.run.folder)
    assert (run.status, run.summary.train_steps) == ("finished", 150)


def test_evaluations_right_after_each_other_are_recorded_in_full(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path, name="quick") as rec:
        evaluator = runner.record(gymnasium.make("CartPole-v1"), join=rec.run, phase="eval")
        for evaluation in range(3):
            evaluator.at_step(100 * evaluation)
            play(evaluator, 20, seed=evaluation)
        evaluator.close()
    rerun = verify(rec.run.recording)
    assert (rerun.verdict, rerun.steps) == ("reproduced", 60)
