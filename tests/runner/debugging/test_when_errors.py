"""Expressions and runs that `when` refuses, and what it says of them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

import runner
from runner.cli import cli
from runner.debugging.when import when
from runner.errors import RecordingError, RunnerError
from runner.export.pictures import episode_sketch
from runner.recording import schema
from runner.recording.reader import open_recording
from runner.replay.tables import tables_at
from tests.runner.altering import altered, without_chunk
from tests.runner.loops.making import make, play
from tests.runner.recording.making import LAKE, TAXIS, make_run

SHORT = {"evaluation": None, "log": None, "episodes": 20, "recording": {"chunk_steps": 256}}


@pytest.fixture(scope="module")
def cooperative(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("cooperative"), TAXIS | SHORT, mode="cooperative")


@pytest.fixture(scope="module")
def competitive(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("competitive"), TAXIS | SHORT)


@pytest.mark.parametrize(
    ("expression", "place", "message"),
    [
        ("__import__('os').system('true')", "__import__('os').system", "found a call"),
        ("(lambda: 1)() > 0", "lambda: 1", "found a call"),
        ("q.__class__ > 0", "q.__class__", "expected q.agency"),
        ("step.__class__ > 0", "step.__class__", "expected step alone"),
        ("().__class__ > 0", "()", "expected one of q, greedy"),
        ("[x for x in (1, 2)]", "[x for x in (1, 2)]", "expected comparisons"),
        ("f'{step}' == 1", "f'{step}'", "expected comparisons"),
        ("(step := 3) > 1", "step := 3", "expected comparisons"),
        ("step if step else 1", "step if step else 1", "expected comparisons"),
        ("step ** 999999999 > 1", "step ** 999999999", "found step ** 999999999, expected comparisons"),
        ("9**9", "9**9", "found 9**9, expected comparisons"),
        ("step > 5 & episode > 3", "5 & episode", "write `and`"),
        ("step > 5 && episode > 3", "", "write `and`"),
        ("step << 999999999 > 1", "step << 999999999", "expected comparisons"),
        ("~step > 1", "~step", "found ~step (write `not`)"),
        ("step in 5", "step in 5", "`in` or `is`"),
        ("step in ()", "()", "expected comparisons"),
        ("step == (1, 2)", "(1, 2)", "expected comparisons"),
        ("step is 3", "step is 3", "`in` or `is`"),
        ("max(step, key=abs) > 1", "max(step, key=abs)", "separated by commas"),
        ("max(*q[0]) > 1", "*q[0]", "expected comparisons"),
        ("max() > 1", "max()", "separated by commas"),
        ("abs(step, 1) > 1", "abs(step, 1)", "abs() of one"),
        ("max(step) > 1", "step", "found one value"),
        ("mx(q[0]) > 1", "mx", "Did you mean 'max'?"),
        ("q[0:2] > 1", "0:2", "found state 0:2"),
        ("q[0][1] > 1", "q[0]", "found q[0], expected one of"),
        ("q[0] > 1", "q[0]", "found the values of all actions"),
        ("q > 1", "q", "expected q[STATE, ACTION]"),
        ("visits > 1", "visits", "expected visits[STATE]"),
        ("greedy[0, 1] == 2", "greedy[0, 1]", "expected greedy[STATE]"),
        ("q[0, 1, 2] > 1", "q[0, 1, 2]", "expected q[STATE, ACTION]"),
        ("q[128, 0] > 1", "128", "found state 128, expected one of 0 to 127"),
        ("q[-1, 0] > 1", "-1", "found state -1, expected one of 0 to 127"),
        ("q[True, 0] > 1", "True", "found state True, expected one of 0 to 127, or its name"),
        ("q[0, 36] > 1", "36", "found action 36, expected one of 0 to 35"),
        ("q[1.0, 0] > 1", "1.0", "expected one of 0 to 127, or its name"),
        ("q[step, 0] > 1", "step", "expected one of 0 to 127, or its name"),
        ("q[0, 'north + nroth'] > 1", "'north + nroth'", "Did you mean 'north + north'?"),
        ("greedy[0] == 'pick up'", "'pick up'", "found action 'pick up'"),
        ("q[0, 0] == 'north'", "'north'", "next to an action"),
        ("'a' == 'a'", "'a'", "next to an action"),
        ("step > 'a' + 1", "'a'", "found text"),
        ("q[0, 0] + 1", "q[0, 0] + 1", "expected a condition"),
        ("not step", "step", "expected a condition"),
        ("step and step > 1", "step", "expected a condition"),
        ("step[1] > 1", "step[1]", "expected step alone"),
        ("visist[1] > 1", "visist", "Did you mean 'visits'?"),
        ("step > 1e999", "1e999", "too large"),
        ("step > 99999999999999999999", "99999999999999999999", "too large"),
        (f"step > {'9' * 400}", "9" * 400, "too large"),
        ("9" * 400 + " > step", "9" * 400, "too large"),
        ("q[" + "9" * 400 + ", 0] > 1", "9" * 400, "expected one of 0 to 127"),
        ("q[0, 'norht'] > 1", "'norht'", "Did you mean 'north + north'?"),
        ("greedy[0] + 1 > 3", "greedy[0]", "found an action, expected a number"),
        ("max(greedy[0], 3) > 1", "greedy[0]", "found an action, expected a number"),
        ("-greedy[0] == 1", "greedy[0]", "found an action, expected a number"),
        ("greedy[0]", "greedy[0]", "found an action, expected a condition"),
        ("greedy[0] < 'east + east'", "greedy[0] < 'east + east'", "expected == or !="),
        ("0 < greedy[0] == 1", "0 < greedy[0] == 1", "expected == or !="),
        ("greedy[0] == 3.5", "3.5", "found action 3.5, expected one of 0 to 35, or its name"),
        ("greedy[0] == step", "step", "expected one of 0 to 35, or its name"),
        ("greedy[0] == -1", "-1", "found action -1, expected one of 0 to 35"),
        ("greedy[0] == 36", "36", "found action 36, expected one of 0 to 35"),
        ("step > 1j", "1j", "expected a number"),
        ("step > b'1'", "b'1'", "expected a number"),
        ("step > None", "None", "expected a number"),
        ("step > ...", "...", "expected a number"),
        ("step = 1", "", "equality is =="),
        ("step >", "", "invalid syntax"),
        ("é > 1 and visist[1] > 1", "é", "found é"),
        ("visits['ééé'] > 1", "'ééé'", "found state 'ééé'"),
    ],
)
def test_a_mistake_is_marked_in_the_expression(cooperative, expression, place, message):
    with pytest.raises(RunnerError) as caught:
        runner.when(cooperative, expression)
    text, shown, marks = str(caught.value).split("\n")
    assert text.startswith("expression: ")
    assert message in text
    assert shown == f"  {expression}"
    if place:
        start = expression.index(place)
        assert marks == " " * (2 + start) + "^" * len(place)
    else:
        assert marks.strip() == "^"


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ("", "expected one such as"),
        ("   ", "expected one such as"),
        ("step > 1\x00", "expected one such as"),
        ("step > 1\x1b[31m", "expected one such as"),
        ("1 < 2", "expected a quantity in it that changes"),
        ("(" * 400 + "step" + ")" * 400 + " > 1", ""),
        ("-" * 900 + "1 > step", ""),
        ("not " * 240 + "step > 1", ""),
        ("step > 1 and " * 76 + "step > 2", "parts, expected"),
        ("step > " + "1" * 2000, "expected 1,000 at most"),
    ],
)
def test_an_expression_that_is_none_or_too_large_is_refused(cooperative, expression, message):
    with pytest.raises(RunnerError, match="expression: ") as caught:
        runner.when(cooperative, expression)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ("q[0, 0] > 1", "found q of 2 agents, expected q.taxi_1 or q.taxi_2"),
        ("reward > 1", "expected reward.taxi_1 or reward.taxi_2"),
        ("q.taxi_3[0, 0] > 1", "Did you mean 'taxi_"),
        ("q.taxi_1[0, 'north + east'] > 1", "found action 'north + east'"),
        ("greedy.taxi_1[0] == 'north + east'", "found action 'north + east'"),
        ("greedy.taxi_1[0] == greedy[0]", "not comparable"),
        ("greedy_success.taxi_1[0]", "expected greedy_success alone"),
    ],
)
def test_an_agent_is_named_where_each_has_its_own_table(competitive, expression, message):
    with pytest.raises(RunnerError) as caught:
        runner.when(competitive, expression)
    assert message in str(caught.value)


def test_states_and_actions_have_names_in_any_spelling(cooperative):
    name = runner.when(cooperative, "visits[0] >= 0").states[0][1]
    for expression in (f"q['{name}', 'pickup+drop_off'] <= 0", "q[0, 'pickup + drop-off'] <= 0"):
        found = runner.when(cooperative, expression, every=True)
        assert found.states == ((0, name),)
        assert found.first is not None
        assert found.first.step == 0


def test_a_condition_counts_as_0_or_1_and_a_division_by_zero_is_no_error(cooperative):
    found = runner.when(
        cooperative, "greedy_success[0] + (step >= 10) + True == 2 and 1 / (step - step) > 1e9"
    )
    assert found.first is not None
    assert found.first.step == 10


def test_a_run_without_training_steps_is_named(tmp_path):
    run = make_run(tmp_path, TAXIS | {"log": None, "episodes": 0, "evaluation": {"every": 1, "trials": 1}})
    with pytest.raises(RecordingError, match="has no training steps"):
        when(run, "step > 0")


@pytest.mark.parametrize(
    ("first", "last", "message"),
    [
        (10**9, None, "found no training step 1,000,000,000; there are"),
        ("9" * 5000, None, "EPISODE:T"),
        ("step:20000", None, "found no training step 20,000; there are"),
        ("500:0", None, "found no training episode 500"),
        ("0:5000", None, "found no step 5,000 of training episode 0"),
        ("eval:3000:1", None, "expected a step of training"),
        ("-1", None, "EPISODE:T"),
        ("1" * 5000, None, "EPISODE:T"),
        ("3:x", None, "EPISODE:T such as 120:5, or step:N, a training step by its number."),
        (20, 10, "expected them in order"),
    ],
)
def test_a_step_that_is_none_is_refused(cooperative, first, last, message):
    with pytest.raises(RunnerError, match="found") as caught:
        runner.when(cooperative, "step >= 0", first=first, last=last)
    assert message in str(caught.value)


def test_a_step_may_be_a_number_or_a_place_in_an_episode(cooperative):
    found = runner.when(cooperative, "step >= 0", first="2:3", last="step:500")
    assert (found.first.episode, found.first.t) == (2, 3)
    assert found.held_before is True
    assert found.searched[1] == found.first.step  # without `every` it ends there


def test_a_run_without_steps_says_how_to_record_them(tmp_path):
    run = make_run(tmp_path, TAXIS | SHORT | {"recording": {"steps": "none"}})
    with pytest.raises(RecordingError, match="rerecord"):
        runner.when(run, "visits[0] > 1")


def test_random_agents_have_no_values_but_visits(tmp_path):
    run = make_run(tmp_path, TAXIS | SHORT, algorithm="random", mode="cooperative")
    with pytest.raises(RunnerError, match="random agents learn no Q-values"):
        runner.when(run, "max(q[0]) > 1")
    assert runner.when(run, "step >= 7 and epsilon == 1").first.step == 7


def test_a_greedy_path_needs_success_and_no_chance(tmp_path):
    lake = make_run(tmp_path, LAKE)
    with pytest.raises(RunnerError, match=r"several outcomes|no success events"):
        runner.when(lake, "greedy_success[0]")
    slipping = {"kwargs": TAXIS["env"]["kwargs"] | {"slip": 0.1}}
    slippery = make_run(tmp_path, TAXIS | SHORT, env=slipping)
    with pytest.raises(RunnerError, match="several outcomes"):
        runner.when(slippery, "greedy_success[0]")


def test_a_loop_has_no_tables(tmp_path):
    with runner.record(make("Taxi-v4"), recordings=tmp_path) as rec:
        assert len(list(play(rec, 20))) > 20
    with pytest.raises(RunnerError, match=r"recorded from a training loop, by runner\.record; `when`"):
        runner.when(rec.run, "step > 1")


def test_what_was_lost_is_not_guessed(tmp_path):
    run = make_run(tmp_path, TAXIS | SHORT)
    lost = without_chunk(run.recording, schema.TRAIN_STEP, 1)
    assert lost == 256
    for expression in ("step >= 300", "q.taxi_1[0, 0] > 1e6", "visits[0] < 0"):
        with pytest.raises(RecordingError, match="training steps 256 to 511 were lost"):
            runner.when(run, expression)
        assert runner.when(run, "step >= 0 and not " + expression, last=255).first.step == 0
    with pytest.raises(RecordingError, match="training steps 256 to 511 were lost"):
        runner.when(run, "visits[0] >= 0", first=600)
    assert runner.when(run, "step >= 600", first=600).first.step == 600


def test_steps_that_the_environment_cannot_have_are_refused(cooperative, tmp_path):
    def change(steps):
        steps = steps.copy()
        steps["state"][100] = 10**6
        return steps

    path = altered(cooperative.recording, tmp_path / "bad.mcap", schema.TRAIN_STEP, change)
    with open_recording(path) as recording, pytest.raises(RecordingError, match="found state 1000000"):
        when(recording, "max(q[0]) > 1e6")
    with open_recording(path) as recording:
        (steps,) = recording.train.steps.blocks(100, 101)
        with pytest.raises(RecordingError, match="found state 1000000"):
            episode_sketch(recording, "train", int(steps["episode"][0]), "an episode")


# --- the command --------------------------------------------------------------------------------------------


def command(run, *words):
    return CliRunner().invoke(cli, ["when", str(run.folder), *words])


def test_the_command_prints_the_same_as_text_and_json(cooperative):
    result = runner.when(cooperative, "visits[0] >= 0 and reward < -1", every=True)
    done = command(cooperative, "visits[0] >= 0 and reward < -1", "--all", "--json")
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert [each["start"]["step"] for each in found["intervals"]] == [
        each.start.step for each in result.intervals
    ]
    assert found["intervals"][0]["start"]["at"] == str(result.first.at)
    at = result.first.at
    assert found["intervals"][0]["start"]["replay"] == (
        f"/runs/{cooperative.run_id}/replay/train/{at.episode}?t={at.t + 1}"
    )
    text = command(cooperative, "visits[0] >= 0 and reward < -1", "--all").stdout
    assert f"It holds after {result.steps:,} of the training steps" in text
    assert all(f"{each.start.step:,}" in text for each in result.intervals)
    assert f"--at {result.first.at}" in text


def test_the_command_says_that_it_never_held_and_what_was_at_the_end(cooperative):
    text = command(cooperative, "max(q[0]) > 1000").stdout
    assert "after none of the training steps 0 to" in text
    assert "max(q[0])" in text


def test_the_command_refuses_a_wrong_expression_with_code_2(cooperative):
    done = command(cooperative, "max(q[0]) > ", "--json")
    assert done.exit_code == 2
    assert json.loads(done.stderr.splitlines()[-1])["error"]["message"].endswith("^")


def test_a_notebook_shows_sentences_and_escaped_tables(cooperative):
    page = runner.when(cooperative, "visits[0] >= 0 and 1 < 2", every=True)._repr_html_()
    assert "<p>It holds after" in page
    assert "visits[0] &gt;= 0" in page
    assert page.count("<table>") == 2


def test_many_intervals_are_counted_and_the_first_listed(cooperative, monkeypatch):
    everything = runner.when(cooperative, "step % 2 == 0", every=True)
    monkeypatch.setattr("runner.debugging.when.MAX_INTERVALS", 5)
    found = runner.when(cooperative, "step % 2 == 0", every=True)
    assert found.intervals == everything.intervals[:5]
    assert (found.count, found.steps) == (everything.count, everything.steps)
    assert everything.count == everything.steps > 100


def test_a_branch_has_its_own_epsilon_and_values_from_its_step_on(tmp_path):
    settings = {"epsilon": 0.9, "step_size": 1.0}
    parent = make_run(tmp_path, TAXIS | SHORT)
    branch = make_run(
        tmp_path, TAXIS | SHORT, branches=[{"run": parent.run_id, "step": 700, "settings": settings}]
    )
    assert runner.when(parent, "epsilon == 0.9").first is None
    assert runner.when(branch, "epsilon == 0.9").first.step == 700
    with open_recording(branch.recording) as recording:
        last = tables_at(recording, recording.train.steps.count())[0]
        state, action = map(int, np.unravel_index(last.argmax(), last.shape))
    found = runner.when(branch, f"q.taxi_1[{state}, {action}] >= {last.max()}", first=600, every=True)
    assert found.last.values[0].after == last.max()
