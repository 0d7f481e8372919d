"""RLlib's env runners record one run: training, evaluation, results, a killed runner, trials of Tune."""

from __future__ import annotations

import json
import os
import signal
import time

import numpy as np
import pytest

import runner
from runner.errors import RunnerError
from runner.execution.verify import verify
from runner.recording.reader import open_recording
from runner.runs.shards import shards_of
from runner.runs.trust_marks import MARK_FILE

ray = pytest.importorskip("ray")
rllib_games = pytest.importorskip("tests.integrations.rllib_games")


@pytest.fixture(scope="module", autouse=True)
def cluster():
    ray.shutdown()  # a cluster of another test may have fewer processors, and these would be waited for
    ray.init(num_cpus=4, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


def configured(recording, **env_runners):
    from ray.rllib.algorithms.ppo import PPOConfig

    return (
        PPOConfig()
        .environment("CartPole-v1")
        .env_runners(num_env_runners=2, num_envs_per_env_runner=2, **env_runners)
        .training(train_batch_size=400, minibatch_size=100, num_epochs=1, lr=0.001)
        .debugging(seed=3)
        .callbacks(recording)
    )


def test_env_runners_and_evaluation_make_one_run(recordings):
    from runner.integrations.rllib import Recording

    recording = Recording(recordings, name="ppo", config={"mine": 1}, checkpoint_every=2)
    config = configured(recording).evaluation(
        evaluation_interval=1, evaluation_num_env_runners=1, evaluation_duration=2
    )
    algorithm = config.build_algo()
    (live,) = runner.list_runs(recordings)
    assert live.status == "running"
    results = [algorithm.train() for _ in range(3)]
    assert [shard.run_id for shard in shards_of(live)] == ["env-runner-1", "env-runner-2", "evaluation-1"]
    algorithm.stop()

    (run,) = runner.list_runs(recordings)
    assert (run.status, run.name, run.seed) == ("finished", "ppo", 3)
    assert run.summary.train_steps == results[-1]["num_env_steps_sampled_lifetime"]
    assert run.file.config["config"]["lr"] == 0.001
    assert run.file.config["config"]["algorithm"] == "PPO"
    assert run.file.config["config"]["mine"] == 1
    logged = run.summary.logged
    assert logged["training_iteration"] == 3
    assert not any("timer" in name or "throughput" in name for name in logged)
    with open_recording(run.recording) as recording:
        assert [(shard.name, shard.environments) for shard in recording.shards] == [
            ("", 1),
            ("env-runner-1", 2),
            ("env-runner-2", 2),
            ("evaluation-1", 2),
        ]
        returns = [
            (one["step"], one["value"])
            for one in recording.table("/scalar").decoded()
            if one["name"] == "env_runners/episode_return_mean"
        ]
        ended = recording.train.episodes.array()
        assert {len(block) for block in recording.eval.resets.blocks()}
    steps = [result["num_env_steps_sampled_lifetime"] for result in results]
    expected = [result["env_runners"]["episode_return_mean"] for result in results]
    assert returns == list(zip(steps, expected, strict=True))
    ended_by_themselves = int(np.count_nonzero(ended["terminated"] | ended["truncated"]))
    assert ended_by_themselves == results[-1]["env_runners"]["num_episodes_lifetime"]
    assert len(run.checkpoints()) == 2
    redone = verify(run.recording)
    assert (redone.verdict, redone.left_out) == ("reproduced", 0)
    assert redone.steps == run.summary.train_steps + run.summary.eval_steps


def test_an_env_runner_that_is_killed_is_replaced(recordings):
    from runner.integrations.rllib import Recording

    config = configured(Recording(recordings)).fault_tolerance(
        restart_failed_env_runners=True, delay_between_env_runner_restarts_s=0
    )
    algorithm = config.build_algo()
    algorithm.train()
    time.sleep(1.2)  # what is older than a second is kept
    pids = algorithm.env_runner_group.foreach_env_runner(lambda _: os.getpid(), local_env_runner=False)
    os.kill(pids[0], signal.SIGKILL)
    (live,) = runner.list_runs(recordings)
    deadline = time.monotonic() + 300  # Ray takes as long to restart one as the machine does
    while len(shards_of(live)) < 3 and time.monotonic() < deadline:
        algorithm.train()
        time.sleep(1)
    algorithm.train()
    algorithm.stop()
    (run,) = runner.list_runs(recordings)
    assert run.status == "finished"
    with open_recording(run.recording) as recording:
        shards = {shard.name: shard for shard in recording.shards}
    assert len(shards) == 4
    assert sorted(shard.status for shard in shards.values()) == [
        "finished",
        "finished",
        "finished",
        "interrupted",
    ]
    killed = next(shard for shard in shards.values() if shard.status == "interrupted")
    assert killed.train_steps > 100
    assert sum(shard.train_steps for shard in shards.values()) == run.summary.train_steps
    assert verify(run.recording).verdict == "reproduced"


def test_without_env_runners_the_algorithm_steps_itself(recordings):
    from runner.integrations.rllib import Recording

    config = configured(Recording(recordings)).env_runners(num_env_runners=0)
    algorithm = config.build_algo()
    algorithm.train()
    algorithm.stop()
    (run,) = runner.list_runs(recordings)
    assert run.summary.train_steps >= 400
    assert run.name == "PPO-CartPole-v1"


def test_a_trial_of_tune_is_a_run(recordings):
    from ray import tune

    from runner.integrations.rllib import Recording

    config = configured(Recording(recordings)).env_runners(num_env_runners=1)
    config = config.training(lr=tune.grid_search([0.001, 0.01]))
    results = tune.Tuner(
        "PPO",
        param_space=config,
        run_config=tune.RunConfig(
            stop={"training_iteration": 1}, storage_path=str(recordings.parent / "tune"), verbose=0
        ),
    ).fit()
    assert not results.errors
    runs = runner.list_runs(recordings)
    assert sorted(run.file.config["config"]["lr"] for run in runs) == [0.001, 0.01]
    assert all(run.name.startswith("PPO_CartPole-v1") for run in runs), [run.name for run in runs]
    assert {run.status for run in runs} <= {"finished", "interrupted"}
    assert all(run.summary.train_steps >= 400 for run in runs)


@pytest.mark.parametrize(
    ("game", "make"), [(rllib_games.at_once, rllib_games.at_once), (rllib_games.in_turns, None)]
)
def test_agents_with_policies_of_their_own_and_a_shared_one(recordings, game, make):
    from ray.tune.registry import register_env

    from runner.integrations.rllib import Recording

    register_env("spread", game)
    own = {"agent_0": "first", "agent_1": "second"}
    ended_episodes = recordings.parent / "ended"

    def note_returns(*, episode, prev_episode_chunks, env_runner, **_):
        returns = dict.fromkeys(env_runner.env.envs[0].possible_agents, 0.0)
        for chunk in (*prev_episode_chunks, episode):
            for agent, agent_episode in chunk.agent_episodes.items():
                returns[agent] += agent_episode.get_return()
        if not env_runner.config.in_evaluation:
            with ended_episodes.open("a") as file:
                file.write(json.dumps(list(returns.values())) + "\n")

    recording = Recording(recordings, make=make, checkpoint_every=1)
    config = (
        configured(recording)
        .callbacks(recording, on_episode_end=note_returns)
        .environment("spread")
        .multi_agent(
            policies={"first", "second", "shared"},
            policy_mapping_fn=lambda agent, *_, **__: own.get(agent, "shared"),
        )
        .evaluation(evaluation_interval=1, evaluation_num_env_runners=1, evaluation_duration=2)
    )
    algorithm = config.build_algo()
    results = [algorithm.train() for _ in range(2)]
    algorithm.stop()

    (run,) = runner.list_runs(recordings)
    assert (run.status, run.name) == ("finished", "PPO-spread")
    assert run.summary.train_steps == results[-1]["num_env_steps_sampled_lifetime"]
    assert sorted(run.file.config["config"]["policies"]) == ["first", "second", "shared"]
    assert sorted({one.name for one in run.checkpoints()}) == ["first", "second", "shared"]
    assert "env_runners/module_episode_returns_mean/shared" in run.summary.logged
    with open_recording(run.recording) as recorded:
        assert recorded.agents == ("agent_0", "agent_1", "agent_2", "agent_3")
        names = ["env-runner-1.0", "env-runner-1.1", "env-runner-2.0", "env-runner-2.1", "evaluation-1.0"]
        assert [shard.name for shard in recorded.shards][1:6] == names
        steps = recorded.train.steps.array()
        ended = recorded.train.episodes.array()
    assert (steps["acted"] == 0b1111).all() == (game is rllib_games.at_once)
    over = ended[ended["terminated"] | ended["truncated"]]
    assert len(over) == results[-1]["env_runners"]["num_episodes_lifetime"]
    expected = [json.loads(line) for line in ended_episodes.read_text().splitlines()]
    np.testing.assert_allclose(sorted(over["returns"].tolist()), sorted(expected))
    redone = verify(run.recording, trust=True)
    assert (redone.verdict, redone.left_out) == ("reproduced", 0)
    assert redone.steps == run.summary.train_steps + run.summary.eval_steps


@pytest.mark.parametrize("number", [0, 1])
def test_what_an_env_runner_cannot_record_is_an_error_of_the_algorithm(recordings, number):
    from runner.integrations.rllib import Recording

    config = configured(Recording(recordings, frames_every=5)).env_runners(num_env_runners=number)
    with pytest.raises(RunnerError, match="render_mode"):
        config.build_algo()
    (run,) = runner.list_runs(recordings)
    assert run.status == "failed"


@pytest.mark.parametrize("is_registered", [False, True])
def test_a_game_is_made_again_from_its_configuration(recordings, is_registered):
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.connectors.env_to_module.flatten_observations import FlattenObservations
    from ray.rllib.examples.envs.classes.multi_agent.rock_paper_scissors import RockPaperScissors
    from ray.tune.registry import register_env

    from runner.integrations.rllib import Recording

    register_env("game", lambda config: RockPaperScissors(config))  # noqa: PLW0108 - a function without a name
    config = (
        PPOConfig()
        .environment("game" if is_registered else RockPaperScissors, env_config={"sheldon_cooper_mode": True})
        .env_runners(
            num_env_runners=0,
            env_to_module_connector=lambda *_, **__: FlattenObservations(multi_agent=True),
        )
        .multi_agent(policies={"shared"}, policy_mapping_fn=lambda *_, **__: "shared")
        .training(train_batch_size=100, minibatch_size=50, num_epochs=1)
        .debugging(seed=3)
        .callbacks(Recording(recordings))
    )
    algorithm = config.build_algo()
    algorithm.train()
    algorithm.stop()
    (run,) = runner.list_runs(recordings)
    name = "PPO-game" if is_registered else "PPO-RockPaperScissors"
    assert (run.name, run.summary.train_steps) == (name, 100)
    if is_registered:  # by a function that has no name
        assert 'name a function that makes it: make="module:function"' in verify(run.recording).reason
        return
    assert verify(run.recording).verdict == "reproduced"
    (run.folder / MARK_FILE).unlink()
    assert "trust" in verify(run.recording).reason
    assert verify(run.recording, trust=True).verdict == "reproduced"
