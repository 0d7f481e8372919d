"""Actions at a recorded step, played on, against recorded episodes and against values in plain Python."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner

import runner
from runner.analysis.episodes import EpisodeRef
from runner.analysis.evaluations import evaluations_of
from runner.cli import cli
from runner.debugging.what_if import branched, what_if
from runner.errors import ConfigError, RecordingError, RunnerError
from runner.recording.reader import open_recording
from runner.replay.tables import named_tables_at
from tests.runner.recording.making import LAKE, SAMPLED, TAXIS, make_run

TEAM, TWO = {"mode": "cooperative"}, {"mode": "competitive"}
SHARED = {"exploration": "shared", "quirks": {"epsilon_exploits": True}}
BY_STEP = {"epsilon": {"schedule": "linear", "start": 1.0, "end": 0.1, "over": 900, "by": "step"}}
VARIANTS = {
    "team": TEAM,
    "two": TWO | BY_STEP,
    "tutorial": TWO | SHARED,
    "sarsa": TEAM | BY_STEP | {"algorithm": "sarsa"},
    "expected_sarsa": TWO | {"algorithm": "expected_sarsa"},
    "double": TWO | {"algorithm": "double_q_learning", "initial_q": "random"},
    "hysteretic": TWO | {"algorithm": "hysteretic_q_learning"},
    "wolf": TWO | SAMPLED | {"algorithm": "wolf_phc"},
    "random": TWO | SAMPLED | {"algorithm": "random", "exploration": "shared"},
    "lake": LAKE
    | TEAM
    | {"env": {"id": "FrozenLake-v1", "kwargs": {"max_episode_steps": 20, "is_slippery": True}}},
}


@pytest.fixture(scope="module", params=VARIANTS)
def run(request, tmp_path_factory):
    """A run of an algorithm; not to be changed."""
    values = VARIANTS[request.param]
    return make_run(tmp_path_factory.mktemp("runs"), TAXIS, values, seed=4, recording={"chunk_steps": 256})


@pytest.fixture(scope="module")
def taxis(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("taxis"), TAXIS)


def trials(recording):
    """Yield the phase's number of each trial, and its reference."""
    for evaluation in evaluations_of(recording):
        for number in range(evaluation.start, evaluation.stop):
            yield number, EpisodeRef(number - evaluation.start, after=evaluation.after)


def steps_at(length):
    """Return some steps of an episode: the first, the last and two between."""
    return sorted({0, length // 3, 2 * length // 3, length - 1})


def test_the_recorded_action_of_a_trial_leads_exactly_where_it_did(run):
    with open_recording(run.recording) as recording:
        for number, place in trials(recording):
            steps = recording.eval.episode_steps(number)
            (record,) = recording.eval.episodes.array(number, number + 1)
            for t in steps_at(len(steps)):
                at = EpisodeRef(place.episode, t, place.after)
                found = branched(recording, at, int(steps[t]["action"]))
                assert found.steps.tobytes() == steps.tobytes()
                assert found.outcome.returns == tuple(record["returns"].tolist())
                assert found.outcome.length == record["length"]
                assert (found.outcome.end == "success") == record["success"]
                assert found.outcome.end == "success" or record[found.outcome.end]


def test_each_action_leads_where_its_own_episode_says(run):
    with open_recording(run.recording) as recording:
        number, place = list(trials(recording))[-1]
        steps = recording.eval.episode_steps(number)
        at = EpisodeRef(place.episode, len(steps) // 2, place.after)
        found = what_if(recording, at=at)
        assert sorted(row.action for row in found.actions) == list(range(recording.mdp.joint_actions))
        before = steps["rewards"][: at.t].sum(axis=0)
        for row in found.actions:
            played = branched(recording, at, row.action).steps[at.t :]
            assert played[0]["action"] == row.action
            assert played[0]["state"] == found.state == steps[at.t]["state"]
            assert (played["state"][1:] == played["next_state"][:-1]).all()
            assert at.t + len(played) == row.length
            assert before + played["rewards"].sum(axis=0) == pytest.approx(row.returns)
            assert bool(played[-1]["terminated"]) or bool(played[-1]["truncated"])
        (recorded,) = (row for row in found.actions if row.is_recorded)
        assert (recorded.returns, recorded.length, recorded.end) == tuple(vars(found.recorded).values())


def test_training_is_played_on_with_the_same_draws(run):
    """Whatever the agents have learned since, they explore at the same steps, and by the same actions."""
    with open_recording(run.recording) as recording:
        learns = recording.config["algorithm"] != "random"
        for episode in (0, 7, recording.config["episodes"] - 1):
            steps = recording.train.episode_steps(episode)
            for t in steps_at(len(steps)):
                played = branched(recording, EpisodeRef(episode, t), int(steps[t]["action"])).steps[t:]
                common = min(len(played), len(steps) - t)
                known = slice(t, t + common)
                assert (played["explored"][:common] == steps["explored"][known]).all()
                every = 2 ** len(recording.agents) - 1
                drawn = steps["explored"][known] == every
                assert (played["action"][:common][drawn] == steps["action"][known][drawn]).all()
                assert (played["step"][:common] == steps["step"][known]).all()
                assert played[0].tobytes() == steps[t].tobytes()
                if not learns:
                    assert played.tobytes() == steps[t:].tobytes()


def plain_policy(config, mdp, held, epsilon):
    """Return the probability of each joint action in each state, by loops over actions of agents."""
    widths = [len(tables["q"][0]) for tables in held]
    policy = []
    for state in range(mdp.states):
        own = []
        for tables, width in zip(held, widths, strict=True):
            row = list(tables["q"][state])
            own.append([float(action == row.index(max(row))) for action in range(width)])
            if config["algorithm"] == "wolf_phc":
                own[-1] = [p / math.fsum(tables["policy"][state]) for p in tables["policy"][state]]
            if config["exploration"] == "independent":
                own[-1] = [epsilon / width + (1 - epsilon) * p for p in own[-1]]
        joint = [1.0]
        for choice in own:
            joint = [p * q for p in joint for q in choice]
        if config["exploration"] == "shared":
            joint = [epsilon / len(joint) + (1 - epsilon) * p for p in joint]
        policy.append([1 / len(joint)] * len(joint) if config["algorithm"] == "random" else joint)
    return policy


def backed_up(mdp, rewards, values, discount, state, action):
    """Return the value of an action from those of the states after it."""
    total = 0.0
    for k in range(mdp.next_state.shape[2]):
        after = 0.0 if mdp.terminated[state, action, k] else values[mdp.next_state[state, action, k]]
        total += mdp.probability[state, action, k] * (rewards[state, action, k] + discount * after)
    return total


def plain_values(mdp, rewards, discount, choose):
    """Return the fixed point of `choose` over the values of a state's actions, by sweeps over the states."""
    values, change = [0.0] * mdp.states, 1.0
    while change > 1e-12:
        change = 0.0
        for state in range(mdp.states):
            actions = [
                backed_up(mdp, rewards, values, discount, state, action)
                for action in range(mdp.joint_actions)
            ]
            new = choose(state, actions)
            change, values[state] = max(change, abs(new - values[state])), new
    return values


@pytest.mark.parametrize("at", ["eval:6:1:0", "3:1", "eval:12:0:2"])
@pytest.mark.parametrize("slippery", [True, False])
def test_values_and_regret_are_those_of_plain_python(tmp_path, at, slippery):
    kwargs = {"max_episode_steps": 20, "is_slippery": slippery}
    run = make_run(
        tmp_path,
        LAKE,
        env={"id": "FrozenLake-v1", "kwargs": kwargs},
        epsilon=0.3,
        discount=0.8,
        step_size=0.5,
    )
    check_values(run, at, epsilon=0.0 if at.startswith("eval") else 0.3)


@pytest.mark.parametrize("name", ["team", "tutorial", "hysteretic", "wolf", "random"])
@pytest.mark.parametrize("at", ["eval:40:1:1", "30:3"])
def test_values_of_several_agents_are_those_of_plain_python(tmp_path, name, at):
    tiny = {"kwargs": {"map": ["+---+", "|A:B|", "+---+"], "max_episode_steps": 90}}
    run = make_run(tmp_path, TAXIS, VARIANTS[name], env=tiny, discount=0.6)
    epsilon = 0.0 if at.startswith("eval") else 0.6 if name == "tutorial" else 0.4
    check_values(run, at, epsilon)


def check_values(run, at, epsilon):
    found = runner.what_if(run, at=at)
    assert found.epsilon == pytest.approx(1.0 if run.facts["config"]["algorithm"] == "random" else epsilon)
    with open_recording(run.recording) as recording:
        mdp, config, discount = recording.mdp, recording.config, found.discount
        held = named_tables_at(recording, found.tables_step)
        policy = plain_policy(config, mdp, held, epsilon)
        learners = len(recording.agents)

        def mean(state, actions):
            return sum(p * value for p, value in zip(policy[state], actions, strict=True))

        for learner in range(learners):
            rewards = mdp.rewards_of(learners)[..., learner]
            values = plain_values(mdp, rewards, discount, mean)
            for row in found.actions:
                own = backed_up(mdp, rewards, values, discount, found.state, row.action)
                assert row.values[learner] == pytest.approx(own, abs=1e-8)
                assert row.probability == pytest.approx(policy[found.state][row.action])
        team = mdp.rewards.sum(axis=-1)
        best = plain_values(mdp, team, discount, lambda _, actions: max(actions))
        optimal = [
            backed_up(mdp, team, best, discount, found.state, action) for action in range(mdp.joint_actions)
        ]
        for row in found.actions:
            assert row.optimal_value == pytest.approx(optimal[row.action], abs=1e-8)
            assert row.regret == pytest.approx(max(optimal) - optimal[row.action], abs=1e-8)
            if config["algorithm"] == "random":
                assert row.learned == ()
                continue
            parts = np.unravel_index(row.action, [table["q"].shape[1] for table in held])
            own = [table["q"][found.state, part] for table, part in zip(held, parts, strict=True)]
            assert list(row.learned) == own


def test_an_environment_without_a_step_limit_is_played_for_a_bounded_time(tmp_path, monkeypatch):
    monkeypatch.setattr("runner.debugging.what_if.MAX_STEPS", 50)
    run = make_run(
        tmp_path,
        {"env": {"id": "tests.runner.corridor:Corridor-v0", "kwargs": {"max_episode_steps": None}}},
        episodes=3,
        epsilon=1.0,
        evaluation=None,
        discount=1.0,
    )
    found = runner.what_if(run, at="0:0")
    assert {row.values for row in found.actions} == {(None,)}
    assert [row.regret for row in found.actions] == [None, None]
    assert any("discount of 1" in note for note in found.notes)


@pytest.mark.parametrize(
    ("at", "actions", "error", "message"),
    [
        ("eval:20:0:5000", "all", RecordingError, "steps, from 0; found no step 5,000"),
        ("eval:20:9:0", "all", RecordingError, "found no trial 9"),
        ("eval:21:0:0", "all", RecordingError, "the nearest after 20"),
        ("60:0", "all", RecordingError, "no training episode 60"),
        ("0:0", "norht+east", ConfigError, "Did you mean 'north"),
        ("0:0", "36", ConfigError, "0 to 35"),
        ("0:0", "-1", ConfigError, "south \\+ south; south"),
        ("0;0", "all", RunnerError, "EPISODE:T"),
    ],
)
def test_what_is_not_there_is_refused(taxis, at, actions, error, message):
    with pytest.raises(error, match=message):
        runner.what_if(taxis, at=at, actions=[actions])


def test_runs_without_steps_say_how_to_record_them(tmp_path):
    run = make_run(tmp_path, TAXIS, recording={"steps": "none"})
    with pytest.raises(RecordingError, match=f"rerecord {run.run_id}"):
        runner.what_if(run, at="eval:20:0:0")


def test_a_damaged_step_is_refused(taxis, tmp_path):
    data = bytearray(taxis.recording.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 64] = bytes(64)
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data)
    with open_recording(damaged) as recording, pytest.raises(RecordingError):
        [what_if(recording, at=EpisodeRef(k)) for k in range(60)]


def test_the_command_prints_a_table_and_json(taxis):
    def invoke(*options):
        words = ["branch", taxis.run_id, "--recordings", str(taxis.folder.parent), "--at", "eval:40:1:2"]
        result = CliRunner().invoke(cli, [*words, *options])
        assert result.exit_code == 0, result.output
        return result.stdout

    text = invoke("--action", "all")
    (heading,) = (line for line in text.splitlines() if line.startswith("action"))
    for word in ("return taxi 1", "value taxi 2", "optimal", "regret"):
        assert word in heading
    assert text.count("(recorded)") == 1
    found = json.loads(invoke("--action", "all", "--json"))
    assert found == json.loads(json.dumps(runner.what_if(taxis, at="eval:40:1:2").as_json()))
    one = json.loads(invoke("--action", "south+pickup", "--json"))
    assert one["actions"] == [row for row in found["actions"] if row["name"] == "south + pickup"]


@pytest.mark.parametrize("words", [("--at", "3:1", "--action", "all"), ("--at", "eval:40:1:2")])
@pytest.mark.parametrize(
    "option", ["--set=epsilon=0.1", "--name=more", "--episodes=50", "--policy=random", "--seed=0"]
)
def test_an_option_of_a_new_run_is_refused_where_none_is_recorded(taxis, words, option):
    result = CliRunner().invoke(cli, ["branch", str(taxis.folder), *words, option])
    assert result.exit_code == 2
    assert f"{option.partition('=')[0]}: nothing is trained or recorded" in result.output


def test_an_action_of_one_agent_stands_for_the_joint_actions_that_have_it(taxis):
    names = [row.name for row in runner.what_if(taxis, at="eval:40:1:2", actions=["taxi_1=north"]).actions]
    assert len(names) == 6
    assert all(name.startswith("north + ") for name in names)
    both = runner.what_if(taxis, at="eval:40:1:2", actions=["taxi 1=1", "taxi_2=east"])
    assert [row.name for row in both.actions] == ["north + east"]
    with pytest.raises(ConfigError, match="expected taxi_1 or taxi_2"):
        runner.what_if(taxis, at="eval:40:1:2", actions=["taxi_3=north"])


def test_a_training_step_after_the_last_is_refused_by_its_number(taxis):
    steps = taxis.summary.train_steps
    result = CliRunner().invoke(
        cli, ["branch", str(taxis.folder), "--at", f"step:{steps}", "--action", "all"]
    )
    assert result.exit_code == 2
    assert f"found no training step {steps:,}; there are {steps:,}, from 0 to {steps - 1:,}" in result.output


def test_of_very_many_actions_the_best_and_the_recorded_are_played(taxis, monkeypatch):
    whole = runner.what_if(taxis, at="0:1")
    monkeypatch.setattr("runner.debugging.what_if.MAX_ACTIONS", 5)
    found = runner.what_if(taxis, at="0:1")
    recorded = next(row.action for row in whole.actions if row.is_recorded)
    best = [row.action for row in whole.actions if row.action != recorded][:4]
    assert {row.action for row in found.actions} == {recorded, *best}
    assert (whole.left_out, found.left_out) == (0, 31)
    assert any("31 joint actions of lower value" in note for note in found.notes)
    assert found.matrix() == ""
