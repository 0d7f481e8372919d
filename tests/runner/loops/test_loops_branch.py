"""Branches of loops: equal to the parent before the step, with its luck, led by the chosen policy."""

from __future__ import annotations

import json
import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from click.testing import CliRunner
from gymnasium.vector import SyncVectorEnv
from numpy.lib.recfunctions import repack_fields

import runner
from runner.analysis.diff import diff
from runner.analysis.diff.sections import summary
from runner.cli import cli
from runner.errors import CannotRedo, ConfigError, RecordingError, RunnerError
from runner.execution.verify import verify
from runner.recording.reader import open_recording
from runner.runs.branches import origin_in
from runner.runs.catalogue.index import look
from runner.runs.trust_marks import MARK_FILE
from tests.runner.loops.making import Rooms, make, play

# Of Box2D's and PettingZoo's own makers.
pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::UserWarning"),
]

ENVIRONMENTS = {
    "CartPole-v1": (1 - np.arange(2)).tolist(),
    "Taxi-v4": [1, 0, 3, 2, 5, 4],
    "LunarLander-v3": [1, 2, 3, 0],
    "FrozenLake-v1": [2, 3, 0, 1],
}
"""Environments, and for each action another one."""
VALUES = (
    *("t", "state", "action", "next_state", "next_observation", "rewards", "terminated", "truncated"),
    *("acted", "agents_terminated", "agents_truncated"),
)
"""The fields of a step that do not count it over the run."""


def recorded(folder, env, steps=150, **options):
    """Return the run of a loop that plays at random: one seeded reset, then unseeded ones."""
    with runner.record(env, folder, **options) as rec:
        for _ in play(rec, steps):
            pass
    return rec.run


def rows(run, episode, phase="train"):
    """Return the steps of an episode, without what counts them over the run."""
    with open_recording(run.recording) as recording:
        kept = recording.phase(phase).episode_steps(episode)
        return repack_fields(kept[[name for name in kept.dtype.names if name in VALUES]])


def branches_of(run):
    return look([run.folder.parent], lambda index: index.branches(run.run_id))


def middle_of(run, episode):
    return len(rows(run, episode)) // 2


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Return runs by environment."""
    folder = tmp_path_factory.mktemp("branching")
    return {name: recorded(folder, make(name), 450) for name in ENVIRONMENTS}


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_without_another_action_a_branch_equals_its_parent_to_the_byte(runs, name, tmp_path):
    run = runs[name]
    for at in (f"0:{middle_of(run, 0)}", f"1:{middle_of(run, 1)}"):
        branch = runner.branch(run, at=at, recordings=tmp_path)
        assert rows(branch.run, 0).tobytes() == rows(run, branch.origin.episode).tobytes()
        assert branch.outcome == branch.parent
        assert branch.parent.end in ("terminated", "truncated")


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_another_action_changes_nothing_before_it_and_is_done_again_with_its_luck(runs, name, tmp_path):
    run = runs[name]
    t = middle_of(run, 1)
    before = rows(run, 1)
    other = ENVIRONMENTS[name][int(before["action"][t])]
    branch = runner.branch(run, at=f"1:{t}", action=other, policy="random", seed=4, recordings=tmp_path)
    own = rows(branch.run, 0)
    assert own[:t].tobytes() == before[:t].tobytes()
    assert own["action"][t] == other
    assert verify(branch.run.recording).sound
    back = runner.branch(branch.run, at=f"0:{t}", action=int(before["action"][t]), recordings=tmp_path)
    assert rows(back.run, 0)[: t + 1].tobytes() == before[: t + 1].tobytes()


def test_the_luck_after_a_branch_is_that_of_the_parent(runs, tmp_path):
    """On slippery ice the same draw decides between three directions: its number is the same."""
    run = runs["FrozenLake-v1"]
    table = gymnasium.make("FrozenLake-v1").unwrapped.P
    parent = rows(run, 2)
    branch = runner.branch(run, at="2:0", action=(int(parent["action"][0]) + 2) % 4, recordings=tmp_path)
    own = rows(branch.run, 0)
    slips = []
    for each in (parent[0], own[0]):
        outcomes = [outcome[1] for outcome in table[int(each["state"])][int(each["action"])]]
        slips.append({i for i, state in enumerate(outcomes) if state == each["next_state"]})
    assert slips[0] & slips[1]


def test_policies_recorded_constant_and_of_the_user(runs, tmp_path, monkeypatch):
    run = runs["CartPole-v1"]
    (tmp_path / "pole_agent.py").write_text("def balance(o):\n    return int(o[2] + o[3] > 0)\n")
    monkeypatch.chdir(tmp_path)
    t = middle_of(run, 0)
    constant = runner.branch(run, at=f"0:{t}", action=1, policy="constant", recordings=tmp_path)
    assert (rows(constant.run, 0)["action"][t:] == 1).all()
    named = runner.branch(run, at=f"0:{t}", action="Right", policy="constant", recordings=tmp_path)
    assert rows(named.run, 0).tobytes() == rows(constant.run, 0).tobytes()
    balanced = runner.branch(run, at="0:2", policy="pole_agent:balance", recordings=tmp_path, max_steps=300)
    assert balanced.outcome.length == 302
    assert balanced.outcome.end == "stopped after 300 steps"
    assert balanced.run.status == "finished"
    ended = runner.branch(balanced.run, at="0:301", action=0, recordings=tmp_path)
    assert ended.outcome.end == "the recorded actions ran out"
    words = [
        "branch",
        str(balanced.run.folder),
        "--at",
        "0:301",
        "--action",
        "0",
        "--recordings",
        str(tmp_path),
    ]
    assert "--policy random, constant or MODULE:FUNCTION plays on" in CliRunner().invoke(cli, words).stderr


def test_the_recorded_action_is_named(runs, tmp_path):
    run = runs["CartPole-v1"]
    action = int(rows(run, 0)["action"][3])

    def messages(*words):
        done = CliRunner().invoke(cli, ["branch", str(run.folder), "--recordings", str(tmp_path), *words])
        assert done.exit_code == 0, done.output
        return done.stderr

    assert f"{action} is the recorded action at 0:3" in messages("--at", "0:3", "--action", str(action))
    assert "is the recorded" not in messages("--at", "0:3", "--action", str(1 - action))


def test_a_branch_says_where_it_comes_from_and_its_parent_lists_it(runs, tmp_path):
    run = runs["CartPole-v1"]
    folder = run.folder.parent
    branch = runner.branch(run, at="1:2", action="1", policy="random", recordings=folder, name="tried")
    assert branch.run.name == "tried"
    assert origin_in(branch.run.file.config) == branch.origin
    assert (branch.origin.run, branch.origin.at, branch.origin.action) == (run.run_id, "1:2", "1")
    assert branches_of(run) == {branch.run.run_id: branch.origin}
    again = runner.branch(run, at="1:2", action="1", policy="random", recordings=folder)
    assert rows(again.run, 0).tobytes() == rows(branch.run, 0).tobytes()
    assert list(branches_of(run)) == [again.run.run_id, branch.run.run_id]
    assert branches_of(branch.run) == {}


def test_the_difference_of_parent_and_branch_is_the_branch(runs, tmp_path):
    run = runs["FrozenLake-v1"]
    t = middle_of(run, 1)
    action = (int(rows(run, 1)["action"][t]) + 1) % 4
    branch = runner.branch(run, at=f"1:{t}", action=action, recordings=tmp_path)
    with open_recording(run.recording) as a, open_recording(branch.run.recording) as b:
        for found, which in ((diff(a, b), "B is a branch of A"), (diff(b, a), "A is a branch of B")):
            place = found.divergence.episode, found.divergence.t, found.divergence.field
            assert place == (1, t, "action")
            assert found.cause.kind == "branch"
            name = ("left", "down", "right", "up")[action]
            assert found.cause.text == f"{which}, at 1:{t}, action {action} ({name}), then recorded"
            lead = summary(found)
            assert lead.startswith(f"The content differs. {which}, at 1:{t}, action {action}")
            assert found.cause.text in lead
        same = runner.branch(run, at=f"1:{t}", recordings=tmp_path)
        with open_recording(same.run.recording) as c:
            assert diff(a, c).divergence is None


def test_a_branch_carries_the_settings_of_its_parent_and_its_origin_is_one_row(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path, name="pole", config={"lr": 3e-4}) as env:
        list(play(env, 50, 0))
    branch = runner.branch(env.run, at="0:5", action=0, policy="random", recordings=tmp_path)
    again = runner.branch(branch.run, at="0:5", action=1, policy="random", recordings=tmp_path)
    assert branch.run.file.config["config"]["lr"] == again.run.file.config["config"]["lr"] == 3e-4
    with open_recording(env.run.recording) as a, open_recording(branch.run.recording) as b:
        changes = {change.path: change.b for change in diff(a, b).config}
    assert changes == {"config.origin": f"{env.run.run_id} {branch.origin}", "name": "pole.branch"}


def test_the_command_and_what_show_lists(runs, tmp_path):
    run = recorded(tmp_path, make("CartPole-v1"), 40)

    def command(*words):
        done = CliRunner().invoke(cli, [*words, "--recordings", str(tmp_path)])
        assert done.exit_code == 0, done.output
        return done.stdout

    printed = json.loads(command("branch", run.run_id, "--at", "0:3", "--action", "1", "--json"))
    assert printed["origin"]["action"] == "1"
    assert printed["parent"]["length"] == len(rows(run, 0))
    words = ["branch", run.run_id, "--at", "0:3", "--action", "all", "--recordings", str(tmp_path)]
    refused = CliRunner().invoke(cli, words)
    assert refused.exit_code == 2
    assert "each action is a branch of its own" in refused.output
    repeated = CliRunner().invoke(cli, ["branch", run.run_id, "--at", "0:3", "--recordings", str(tmp_path)])
    assert f"nothing is changed, so the branch repeats run {run.run_id}" in repeated.stderr
    text = command("branch", run.run_id, "--at", "0:3", "--action", "0", "--policy", "constant")
    assert re.search(r"parent +\w+ .*terminated\nbranch +\w+ .*terminated", text)
    assert f"dualtaxi diff {run.run_id}" in text
    assert printed["run_id"] in json.loads(command("show", run.run_id, "--json"))["branches"]
    assert "at 0:3, action 0 (left), then constant" in command("show", run.run_id)
    assert f"of run {run.run_id} at 0:3, action 1" in command("show", printed["run_id"])


def test_the_path_of_a_branch_begins_with_the_folder_as_given(runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = runner.branch(runs["CartPole-v1"], at="0:3", action=1, recordings="mine").run
    assert run.folder == Path("mine", run.run_id)


def test_a_dict_space_takes_json(tmp_path):
    run = recorded(tmp_path, Rooms(), 60, make="tests.runner.loops.making:Rooms")
    (run.folder / MARK_FILE).unlink()
    with pytest.raises(CannotRedo, match="--trust"):
        runner.branch(run, at="0:1", recordings=tmp_path)
    given = '{"go": 2, "push": [0.25]}'
    branch = runner.branch(run, at="1:1", action=given, recordings=tmp_path, trust=True)
    own, before = rows(branch.run, 0), rows(run, 1)
    assert own[:1].tobytes() == before[:1].tobytes()
    assert own["action"][1].tolist() == (2, [0.25])
    assert json.loads(branch.origin.action) == json.loads(given)
    for text, message in {
        '{"go": 2}': "expected an object with go, push",
        "{": "expected JSON",
        '{"go": 4, "push": [0]}': r"action\['go'\]: found 4, expected 0 to 3",
        '{"go": 1, "push": [2]}': r"action\['push'\]\[0\]: found 2, expected 0 to 1",
    }.items():
        with pytest.raises(ConfigError, match=message):
            runner.branch(run, at="1:1", action=text, recordings=tmp_path, trust=True)


def test_numbers_of_a_box(tmp_path):
    run = recorded(tmp_path, gymnasium.make("Pendulum-v1"), 30)
    branch = runner.branch(run, at="0:5", action="-1.5", policy="constant", recordings=tmp_path, max_steps=3)
    assert rows(branch.run, 0)["action"][5:].tolist() == [[-1.5]] * 3
    with pytest.raises(ConfigError, match=r"action\[0\]: found 3, expected -2 to 2"):
        runner.branch(run, at="0:5", action="3", recordings=tmp_path)


def test_a_sub_environment_of_a_vector(tmp_path):
    envs = SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")] * 3)
    with runner.record_vector(envs, tmp_path) as rec:
        rec.action_space.seed(0)
        rec.reset(seed=3)
        for _ in range(120):
            rec.step(rec.action_space.sample())
    for episode in (1, 5):
        same = runner.branch(rec.run, at=f"{episode}:4", recordings=tmp_path)
        assert rows(same.run, 0).tobytes() == rows(rec.run, episode).tobytes()
        assert same.outcome == same.parent
    with pytest.raises(RecordingError, match="has no training episode"):
        runner.branch(rec.run, at="400:0", recordings=tmp_path)


def test_a_game_of_several_agents(tmp_path):
    env = pytest.importorskip("mpe2.simple_spread_v3").parallel_env(max_cycles=10)
    with runner.record_parallel(env, tmp_path) as rec:
        for seed in (3, None):
            rec.reset(seed=seed)
            while rec.agents:
                rec.step({agent: (i + 1) % 5 for i, agent in enumerate(rec.agents)})
    same = runner.branch(rec.run, at="1:4", recordings=tmp_path)
    assert rows(same.run, 0).tobytes() == rows(rec.run, 1).tobytes()
    branch = runner.branch(
        rec.run, at="1:4", action="agent_1=no action", policy="constant", recordings=tmp_path
    )
    assert "agent_1 no action" in str(branch.origin)
    own = rows(branch.run, 0)
    assert own[:4].tobytes() == rows(rec.run, 1)[:4].tobytes()
    assert [tuple(each) for each in own["action"][4:].tolist()] == [(1, 0, 3)] * 6
    assert set(branch.outcome.returns) == {"agent_0", "agent_1", "agent_2"}
    expected = "expected AGENT=VALUE of an agent that acts at this step: agent_0, agent_1, agent_2."
    for action, message in (
        ("1", f"found '1', {expected}"),
        ("agnt_0=1", f"found 'agnt_0', {expected} Did you mean 'agent_0'"),
        ({"agent_1": 1, "agnt_2": 1}, f"found 'agnt_2', {expected} Did you mean 'agent_2'"),
    ):
        with pytest.raises(ConfigError, match=message):
            runner.branch(rec.run, at="1:4", action=action, recordings=tmp_path)
    twice = ["--action", "agent_1=1", "--action", "agent_1=2"]
    words = ["branch", rec.run.run_id, "--at", "1:4", *twice, "--recordings", str(tmp_path)]
    result = CliRunner().invoke(cli, words)
    assert (result.exit_code, "found an agent twice" in result.stderr) == (2, True)


def test_steps_of_evaluation_names_of_actions_and_an_episode_that_was_cut(tmp_path):
    with runner.record(make("Taxi-v4"), tmp_path) as rec, rec.phase("eval"):
        for steps in (200, 3):
            rec.reset(seed=2)
            for _ in range(steps):
                rec.step(0)
        with rec.phase("train"):
            rec.reset(seed=2)
            rec.step(0)
    branch = runner.branch(rec.run, at="eval:0:0:1", action="North", policy="constant", recordings=tmp_path)
    assert rows(branch.run, 0, "eval")["action"][:3].tolist() == [0, 1, 1]
    assert branch.parent.end == branch.outcome.end == "truncated"
    cut = runner.branch(rec.run, at="0:0", action="west", recordings=tmp_path)
    assert (cut.parent.end, cut.outcome.end) == ("unfinished", "the recorded actions ran out")
    with pytest.raises(ConfigError, match="or a name: south, north, east"):
        runner.branch(rec.run, at="eval:0:0:1", action="nord", recordings=tmp_path)


def test_what_cannot_be_branched_leaves_no_run(runs, tmp_path):
    run = runs["CartPole-v1"]
    length = len(rows(run, 0))
    for error, message, options in (
        (RecordingError, f"no step {length} of training episode 0; it has {length}", {"at": f"0:{length}"}),
        (RecordingError, "found no evaluation after 3 episodes", {"at": "eval:3:0:0"}),
        (RunnerError, "expected EPISODE:T", {"at": "here"}),
        (ConfigError, "action: found '2', expected 0 to 1", {"at": "0:1", "action": "2"}),
        (ConfigError, "expected recorded, random, constant", {"at": "0:1", "policy": "best"}),
        (ConfigError, "cannot be imported", {"at": "0:1", "policy": "no_such_module:act"}),
        (ConfigError, "seed: found -1, expected 0 or more", {"at": "0:1", "policy": "random", "seed": -1}),
    ):
        with pytest.raises(error, match=message):
            runner.branch(run, recordings=tmp_path, **options)
    job = runner.run("quick", overrides=["episodes=2", "evaluation.trials=1"], recordings=tmp_path / "own")
    with pytest.raises(ConfigError, match="policy, seed and max_steps are for loops"):
        runner.branch(job, at="0:1", policy="random", recordings=tmp_path)
    for message, options in (
        ("are for runs that were trained here", {"at": "0:1", "overrides": ["epsilon=0.1"]}),
        ("expected EPISODE:T: the steps of a loop", {"at": "step:7"}),
    ):
        with pytest.raises(ConfigError, match=message):
            runner.branch(run, recordings=tmp_path, **options)

    class Hidden(Rooms):
        """Has no name by which it could be imported."""

    own = recorded(tmp_path / "own", Hidden())
    with pytest.raises(CannotRedo, match="cannot be imported"):
        runner.branch(own, at="0:1", recordings=tmp_path)
    assert [each.name for each in tmp_path.iterdir()] == ["own"]


def test_an_environment_that_is_not_the_recorded_one_is_found_out(tmp_path, monkeypatch):
    env = gymnasium.make("CartPole-v1")
    run = recorded(tmp_path, env, 40, make="tests.runner.loops.test_loops_branch:heavier")
    with pytest.raises(CannotRedo, match=r"train episode 0, t 5: reward: recorded 1.0, got 2.0"):
        runner.branch(run, at="0:8", recordings=tmp_path, trust=True)


def heavier():
    env = gymnasium.make("CartPole-v1")

    class Own(gymnasium.Wrapper):
        t = 0

        def reset(self, **kwargs):
            self.t = 0
            return self.env.reset(**kwargs)

        def step(self, action):
            self.t += 1
            observation, reward, *rest = self.env.step(action)
            return observation, reward + (self.t > 5), *rest

    return Own(env)
