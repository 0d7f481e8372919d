"""Why a Q-value is what it is: the sum of recorded rewards and initial values, times their weights."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import runner
from runner.cli import cli
from runner.debugging import why
from runner.debugging.why import EpisodesPart
from runner.errors import ConfigError, RecordingError, RunnerError, StorageError
from runner.recording.reader import open_recording
from runner.replay.tables import tables_at
from tests.runner.learning.harness import FOLLOWED, LINEAR, RULES
from tests.runner.learning.linear import LinearTwin
from tests.runner.recording.making import LAKE, TAXIS, make_run

PLAIN = {key: value for key, value in TAXIS.items() if key not in ("mode", "evaluation")}
PLAIN |= {"episodes": 25, "evaluation": None}
STEP = "12:7"
"""A step in the middle of an episode."""
SCHEDULES = {
    "step_size": LINEAR | {"over": 300, "by": "step"},
    "epsilon": LINEAR | {"over": 20},
    "discount": {"schedule": "exponential", "start": 0.97, "floor": 0.05, "factor": 0.9997, "by": "step"},
}
BRANCHES = [
    {"run": "parent", "step": 300, "settings": {"discount": 0.5, "step_size": 0.9}},
    {"run": "other", "step": 613, "settings": {"epsilon": 0.0}, "actions": {"taxi_1": "pickup"}},
]
CASES = {name: RULES[name] for name in ("cooperative", "every quirk", "initially random", "slipping")}
CASES |= FOLLOWED | {"branches": {"branches": BRANCHES}}
CASES |= {f"{name}, schedules": rules | SCHEDULES for name, rules in FOLLOWED.items() if " " not in name}


def last_steps(run, count):
    """Return the last training steps, and the number of all."""
    with open_recording(run.recording) as recording:
        total = recording.train.steps.count()
        return recording.train.steps.array(total - count, total), total


@pytest.mark.parametrize("case", CASES)
def test_the_sum_is_the_value(case, tmp_path, monkeypatch):
    monkeypatch.setattr(why, "STEPS_AT_ONCE", 100)
    run = make_run(tmp_path, PLAIN, CASES[case])
    steps, total = last_steps(run, 1)
    with open_recording(run.recording) as recording:
        tables = tables_at(recording, total)
        own = recording.mdp.own_actions
    for agent, table in zip(recording.agents, tables, strict=True):
        action = int(steps["action"][0])
        action = action if len(tables) == 1 else int(own[action, recording.agents.index(agent)])
        for at in (None, STEP):
            found = runner.why(run, state=int(steps["state"][0]), action=action, agent=agent, at=at)
            assert found.total == pytest.approx(found.value, rel=1e-9, abs=1e-12)
            parts = found.rewarded.contribution + found.initial.contribution
            assert found.total == pytest.approx(parts, rel=1e-12)
            for several in (found.rewards, found.episodes):
                assert sum(part.contribution for part in several) == pytest.approx(
                    found.rewarded.contribution, rel=1e-9, abs=1e-12
                )
                assert sum(part.weight for part in several) == pytest.approx(found.rewarded.weight)
            if at is None:
                assert found.value == table[int(steps["state"][0]), action]


@pytest.mark.parametrize("case", ["cooperative", "double of two, random", "hysteretic, changing", "sarsa"])
def test_steps_are_those_that_plain_python_finds(case, tmp_path):
    run = make_run(tmp_path, PLAIN, CASES[case], episodes=8)
    steps, total = last_steps(run, 1)
    with open_recording(run.recording) as recording:
        config = runner.ExperimentConfig.model_validate_json(json.dumps(recording.config))
        twin = LinearTwin(config, recording.mdp, 0)
    twin.train(10**6, total)
    state, joint = int(steps["state"][0]), int(steps["action"][0])
    for i, agent in enumerate(recording.agents):
        action = twin._own(joint)[i]
        expected = twin.tables[i][state][action]
        found = runner.why(run, state=state, action=action, agent=agent, limit=1000)
        assert found.value == expected.value
        rewards = [weight for name, weight in expected.weights.items() if name[0] == "step"]
        assert found.counted == np.count_nonzero(rewards)
        for part in found.steps:
            step = twin.training.steps[part.step]
            assert part.weight == pytest.approx(expected.weights["step", part.step], rel=1e-9)
            assert part.contribution == pytest.approx(part.weight * step.rewards[i], rel=1e-12)
            assert (part.at, part.state, part.action) == (f"{step.episode}:{step.t}", step.state, step.action)
        sizes = [abs(part.contribution) for part in found.steps]
        assert sizes == sorted(sizes, reverse=True)
        initial = sum(weight for name, weight in expected.weights.items() if name[0] == "initial")
        assert found.initial.weight == pytest.approx(initial, rel=1e-9)


def test_the_initial_tables_of_another_run_count(tmp_path):
    source = make_run(tmp_path, PLAIN, {"algorithm": "double_q_learning"})
    transfer = {"initial_q": {"run": source.run_id, "step": 500}, "algorithm": "double_q_learning"}
    run = make_run(tmp_path, PLAIN, transfer, episodes=3)
    found = runner.why(run, at="0:0", state=5, action=3)
    assert found.total == found.value == found.initial.contribution
    assert (found.initial.weight, found.counted, found.steps) == (1.0, 0, ())
    with open_recording(source.recording) as recording:
        (table,) = tables_at(recording, 500)
    steps, _ = last_steps(run, 40)
    known = [step for step in steps if table[step["state"], step["action"]]]
    assert known
    for step in known:
        found = runner.why(run, state=int(step["state"]), action=int(step["action"]))
        assert found.total == pytest.approx(found.value, rel=1e-9, abs=1e-12)
        assert found.initial.contribution != 0


def test_the_value_before_a_step_is_that_of_its_state_and_action(tmp_path):
    run = make_run(tmp_path, PLAIN, mode="competitive")
    with open_recording(run.recording) as recording:
        step = recording.train.episode_steps(12)[7]
        own = recording.mdp.own_actions[int(step["action"])]
        (_, table) = tables_at(recording, int(step["step"]))
    found = runner.why(run, at=STEP, agent="taxi 2")
    assert (found.state, found.action, found.step) == (step["state"], own[1], step["step"])
    assert found.value == table[found.state, found.action]


def test_the_largest_steps_do_not_depend_on_the_parts_they_are_read_in(tmp_path, monkeypatch):
    run = make_run(tmp_path, PLAIN)
    found = runner.why(run, at="20:3")
    monkeypatch.setattr(why, "STEPS_AT_ONCE", 64)
    assert runner.why(run, at="20:3") == found
    assert runner.why(run, at="20:3", limit=3).steps == found.steps[:3]


def test_moves_are_those_of_the_agent_with_all_of_the_weight(tmp_path):
    run = make_run(tmp_path, PLAIN, mode="competitive")
    found = runner.why(run, at=STEP, agent="taxi_2")
    assert len({move.thing for move in found.moves}) == 1
    assert sum(move.weight for move in found.moves) == pytest.approx(found.rewarded.weight)
    assert found.picture.startswith("<svg")
    run = make_run(tmp_path, PLAIN)
    (step,), _ = last_steps(run, 1)
    both = runner.why(run, state=int(step["state"]), action=int(step["action"]))
    assert len({move.thing for move in both.moves}) == 2


def test_an_environment_without_a_scene_has_no_moves(tmp_path):
    run = make_run(tmp_path, {"env": {"id": "tests.runner.corridor:Corridor-v0"}, "episodes": 9})
    found = runner.why(run, state="state 3", action="action 1")
    assert (found.moves, found.picture) == ((), "")
    assert found.total == pytest.approx(found.value, rel=1e-9)


def test_a_policy_is_no_sum_and_the_answer_says_so(tmp_path):
    assert "policy" in runner.why(make_run(tmp_path, PLAIN, algorithm="wolf_phc"), at=STEP).note
    assert not runner.why(make_run(tmp_path, PLAIN), at=STEP).note


def test_values_that_many_steps_change_are_not_explained(tmp_path):
    run = make_run(tmp_path, PLAIN, algorithm="n_step_q_learning")
    with pytest.raises(RunnerError, match=r"`why` cannot follow n_step_q_learning.* q_learning"):
        runner.why(run, at=STEP)


def test_an_update_that_cannot_be_followed_is_refused_and_not_called_rounding(tmp_path, monkeypatch):
    run = make_run(tmp_path, PLAIN, {"algorithm": "n_step_q_learning"})
    known = why.ALGORITHMS["n_step_q_learning"]
    monkeypatch.setitem(why.ALGORITHMS, "n_step_q_learning", known._replace(remember=None))
    with pytest.raises(RunnerError, match=r"add up to .*, but the table has .*n_step_q_learning does not"):
        runner.why(run, at=STEP)


def test_the_answer_says_whether_the_sum_is_the_value_and_leaves_out_episodes_without_weight(tmp_path):
    run = make_run(tmp_path, PLAIN)
    found = runner.why(run, at=STEP)
    exact, *_ = replace(found, total=found.value).sections()[1:]
    assert exact.sentences[0] == "It equals the table's value."
    assert replace(found, total=found.value + 1e-9).sections()[1].sentences[0].startswith("It differs")
    parts = (EpisodesPart(0.5, 2.0, 0, 10), EpisodesPart(0.0, 0.0, 10, 20), EpisodesPart(0.5, 0.0, 20, 30))
    *_, episodes = replace(found, episodes=parts).sections()
    assert [row[0] for grid in episodes.grids for row in grid.rows] == ["0 to 9", "20 to 29"]
    assert episodes.sentences == ["1 of 3 stretches of episodes have no weight and are left out."]


def test_a_notebook_shows_it_in_a_frame(tmp_path):
    html = runner.why(make_run(tmp_path, PLAIN), at=STEP)._repr_html_()
    assert html.startswith("<iframe")
    assert "not a counterfactual" in html


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"state": 5, "action": "nort + south"}, r"Did you mean 'north \+ south'"),
        ({"state": 5, "action": 36}, "0 to 35"),
        ({"state": 128, "action": 0}, "0 to 127"),
        ({"state": "taxi 1 (0,0), taxi 2 (0,0), passenger at A, destination", "action": 0}, "Did you mean"),
        ({"state": 5}, "expected both"),
        ({"state": 5, "action": 0, "agent": "taxi_1"}, "expected agency"),
        ({"at": "3:100000"}, "no step 100,000"),
        ({"at": "300:0"}, "no training episode 300"),
        ({"at": "eval:7:0:0"}, "evaluation"),
        ({"at": "soon"}, "EPISODE:T"),
        ({"at": STEP, "limit": -1}, "0 to 100,000"),
    ],
)
def test_bad_input(arguments, expected, cooperative):
    with pytest.raises(RunnerError, match=expected):
        runner.why(cooperative, **arguments)


@pytest.fixture(scope="module")
def cooperative(tmp_path_factory):
    """Return a run of one table."""
    return make_run(tmp_path_factory.mktemp("cooperative"), PLAIN)


def test_several_learners_need_a_name(taxis):
    with pytest.raises(ConfigError, match="taxi_1 or taxi_2"):
        runner.why(taxis, state=5, action=0)
    with pytest.raises(ConfigError, match="Did you mean 'taxi_2'"):
        runner.why(taxis, state=5, action=0, agent="taxy_2")


def test_runs_that_cannot_answer(tmp_path):
    without = make_run(tmp_path, PLAIN, recording={"steps": "none"})
    with pytest.raises(RecordingError, match="rerecord"):
        runner.why(without, state=5, action=0)
    random = make_run(tmp_path, PLAIN, algorithm="random")
    with pytest.raises(RunnerError, match="no Q-values"):
        runner.why(random, state=5, action=0)


def test_a_loop_is_refused_and_told_what_serves(tmp_path):
    import gymnasium

    with runner.record(gymnasium.make("FrozenLake-v1"), tmp_path) as env:
        env.reset(seed=0)
        env.step(0)
    with pytest.raises(RunnerError, match="dualtaxi values"):
        runner.why(env.run, state=5, action=0)


def test_a_damaged_recording_is_reported(tmp_path):
    run = make_run(tmp_path, LAKE, episodes=200)
    data = bytearray(run.recording.read_bytes())
    with open_recording(run.recording) as recording:
        offset = recording.train.steps.entry(0).offset
    data[offset + 80] ^= 0xFF
    run.recording.write_bytes(data)
    with pytest.raises(RecordingError, match="repair"):
        runner.why(run, state=5, action=0)


def test_a_folder_of_temporary_files_that_cannot_be_written_is_named(cooperative, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    with pytest.raises(StorageError, match=r"temporary file.*TMPDIR"):
        runner.why(cooperative, state=0, action=0)


def test_the_command_prints_what_python_returns(cooperative):
    recordings = ["--recordings", str(cooperative.folder.parent)]
    (step,), _ = last_steps(cooperative, 1)
    words = ["why", cooperative.run_id, "--state", str(step["state"]), "--action", str(step["action"])]
    answer = CliRunner().invoke(cli, [*words, *recordings, "--json"], catch_exceptions=False)
    assert answer.exit_code == 0
    found = runner.why(cooperative, state=int(step["state"]), action=int(step["action"]))
    assert json.loads(answer.stdout) == json.loads(json.dumps(found.as_json()))
    text = CliRunner().invoke(cli, [*words, *recordings, "--limit", "2"], catch_exceptions=False).stdout
    assert f"{found.value:.9g} after {found.step:,} training steps" in text
    assert found.steps[1].at in text
    assert "not a counterfactual" in text
    assert text.index("The steps that add or take most") < text.index("By reward")
    for words, message in (
        (["--state", "5000", "--action", "0"], "5000"),
        (["--state", "5"], "found no state or no action, expected both, or a step to take them from"),
        (["--at", STEP, "--limit", "-1"], "--limit"),
    ):
        wrong = CliRunner().invoke(cli, ["why", cooperative.run_id, *words, *recordings])
        assert wrong.exit_code == 2
        assert message in wrong.stderr
