"""`diff` names the true cause of a difference."""

from __future__ import annotations

import json
import platform
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from runner.analysis.diff import RunDiff, diff
from runner.analysis.diff.divergence import FIELDS, first_difference
from runner.analysis.diff.sections import sections
from runner.analysis.sections import markdown
from runner.cli import cli
from runner.config import from_mapping
from runner.config.model import Job
from runner.environments.naming import states_in_words
from runner.errors import RecordingError
from runner.execution.session import run_job
from runner.recording import schema
from runner.recording.reader import open_recording
from runner.replay.tables import tables_at
from runner.runs import run as runs
from runner.util.differences import Change, changes_in
from tests.runner.altering import altered, without_digest
from tests.runner.analysis.conftest import BASE
from tests.runner.recording.making import stopping_after


@pytest.fixture(scope="module")
def compare(record):
    def compared(*overrides: str) -> RunDiff:
        with open_recording(record()) as a, open_recording(record(*overrides)) as b:
            return diff(a, b, {"success_percent": 1.0})

    return compared


def test_a_name_and_a_compression_change_nothing(compare):
    difference = compare("name=other", "recording.compression=lz4")
    assert difference.same_content
    assert {change.path for change in difference.config} == {
        "name",
        "recording.compression",
        "recording.level",
    }
    assert difference.divergence is None
    assert difference.environment.same


def test_another_seed_starts_elsewhere(compare):
    difference = compare("seed=1")
    assert [(change.path, change.a, change.b) for change in difference.config] == [("seed", 0, 1)]
    assert (difference.divergence.step, difference.cause.kind) == (0, "start")
    assert difference.overlap.equal_episodes == 0


def test_another_discount_is_found_in_the_first_update_that_used_it(compare, record):
    difference = compare("discount=0.9")
    assert difference.cause.kind == "greedy_action"
    update = difference.cause.update
    assert update.rewards_a == update.rewards_b
    with open_recording(record()) as a, open_recording(record("discount=0.9")) as b:
        before = [tables_at(recording, update.step) for recording in (a, b)]
        after = [tables_at(recording, update.step + 1) for recording in (a, b)]
    assert all(np.array_equal(x, y) for x, y in zip(*before, strict=True))
    assert any(not np.array_equal(x, y) for x, y in zip(*after, strict=True))
    assert update.step < difference.divergence.step


def test_the_first_difference_alone_equals_that_of_the_whole(compare, record):
    whole = compare("discount=0.9")
    with open_recording(record()) as a, open_recording(record("discount=0.9")) as b:
        difference = diff(a, b, first=True)
    assert (difference.cause.kind, difference.cause.text) == (whole.cause.kind, whole.cause.text)
    assert (difference.divergence.step, difference.config) == (whole.divergence.step, whole.config)
    assert difference.cause.update is difference.overlap is None
    assert not difference.tables + difference.metrics
    assert difference.evaluation_divergence is None


def test_the_second_tables_quirk_shows_in_the_second_table(compare):
    difference = compare("quirks.second_table_uses_first_action=false")
    assert [change.path for change in difference.config] == ["quirks.second_table_uses_first_action"]
    assert difference.cause.update.agent == "taxi_2"
    assert {table.agent for table in difference.tables if table.largest > 0} == {"taxi_1", "taxi_2"}


def test_another_reward_is_another_environment(compare):
    difference = compare("env.kwargs.rewards.illegal_action=-7")
    assert difference.environment.transitions > 1000
    assert "reward -7" in " ".join(change.b for change in difference.environment.examples)
    assert (difference.cause.kind, difference.divergence.field) == ("transition", "rewards")
    assert "reward -2 and -10 in A, -2 and -7 in B" in difference.cause.text


def test_other_modes_are_compared_as_far_as_they_can_be(compare):
    difference = compare("mode=cooperative", "quirks.second_table_uses_first_action=false")
    assert any("other modes" in note for note in difference.notes)
    assert not any("return" in metric.name for metric in difference.metrics)
    assert difference.divergence is not None
    assert difference.tables == []
    assert difference.metrics


def test_a_longer_run_continues_where_the_shorter_ends(compare):
    difference = compare("episodes=150", "snapshots.every=30")
    assert difference.cause.kind == "end"
    assert difference.overlap.equal_episodes == 120
    assert difference.overlap.equal_steps == difference.overlap.steps_a
    assert all(table.largest == 0 for table in difference.tables)


def test_visits_to_states_are_those_of_the_steps(compare, record):
    visits = compare("discount=0.9").visits
    counts = []
    for path in (record(), record("discount=0.9")):
        with open_recording(path) as recording:
            states = np.concatenate([block["state"] for block in recording.train.steps.blocks()])
            words = states_in_words(recording.mdp)
            counts.append(np.bincount(states, minlength=len(words)))
    assert (visits.states_a, visits.states_b) == tuple(np.count_nonzero(count) for count in counts)
    shares = [count / count.sum() for count in counts]
    assert visits.alike == pytest.approx(1 - np.abs(shares[0] - shares[1]).sum() / 2)
    assert 0 < visits.alike < 1
    first = int(np.abs(shares[0] - shares[1]).argmax())
    most = visits.most_apart[0]
    assert (most.state, most.a, most.b) == (words[first], counts[0][first], counts[1][first])


def test_a_mapping_empty_in_one_run_is_listed_by_the_entries_of_the_other():
    a, b = {"kwargs": {}, "epsilon": 0.2}, {"kwargs": {"rewards": {"step": -3}}, "epsilon": {"start": 1.0}}
    assert changes_in(a, b) == [
        Change("epsilon", 0.2, None),
        Change("kwargs.rewards.step", None, -3),
        Change("epsilon.start", None, 1.0),
    ]
    assert changes_in({"a": 1, "kwargs": {}}, {"a": 1}) == [Change("kwargs", {}, None)]


def test_ignored_paths_are_listed(record, folder):
    ids = [record(*overrides).parent.name for overrides in ((), ("discount=0.9",))]
    result = CliRunner().invoke(cli, ["diff", *ids, "--recordings", str(folder), "--ignore", "disc*"])
    assert "Note: ignored, though it differs: discount." in result.stdout
    assert "No other setting that determines the content differs." in result.stdout


def test_a_page_and_markdown_are_given_together(record, folder, tmp_path):
    ids, page = [record(*overrides).parent.name for overrides in ((), ("discount=0.9",))], tmp_path / "d.html"
    words = ["diff", *ids, "--recordings", str(folder), "--markdown", "--html", str(page)]
    result = CliRunner().invoke(cli, words)
    assert "## Training" in result.stdout
    assert str(page) in result.stderr
    assert "where the shares differ most" in page.read_text("utf-8")
    assert "| train_steps |" in result.stdout


def test_the_steps_of_an_interrupted_run_are_compared(record, folder):
    config = from_mapping(BASE)
    run = runs.create_run(folder, config, 0)
    run = run_job(Job(config, 0), run, stop=stopping_after(21))
    with open_recording(record()) as a, open_recording(run.recording) as b:
        difference = diff(a, b)
    assert difference.b["status"] == "interrupted"
    assert "B is not finished" in difference.notes[0]
    assert difference.cause is None or difference.cause.kind == "end"


def test_without_steps_only_the_rest_is_compared(compare):
    difference = compare("recording.steps=none", "seed=3")
    assert difference.divergence is None
    assert any("rerecord" in note for note in difference.notes)
    assert difference.metrics
    assert difference.tables


def test_a_run_without_training_steps_gets_no_hint_to_rerecord_it(compare):
    notes = " ".join(compare("episodes=0").notes)
    assert "B has no training steps" in notes
    assert "rerecord" not in notes


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_an_altered_step_is_the_first_difference(record, data):
    with open_recording(record()) as recording:
        blocks = list(recording.train.steps.blocks())
    steps = np.concatenate(blocks)
    at = data.draw(st.integers(0, len(steps) - 1))
    field = data.draw(st.sampled_from(FIELDS))
    altered = steps.copy()
    value = altered[field][at]
    altered[field][at] = ~value if altered[field].dtype == bool else value + 1
    size = data.draw(st.integers(1, 3000))
    cut = (altered[first : first + size] for first in range(0, len(altered), size))
    left, right = first_difference(iter(blocks), cut)
    assert left["step"].tolist() == right["step"].tolist() == [at]
    assert left[field][0].tolist() != right[field][0].tolist()


@pytest.fixture(scope="module")
def small(folder):
    """A recording of some thousand steps, to be copied with a step altered."""
    config = from_mapping(
        {"episodes": 30, "mode": "competitive", "env": {"kwargs": {"max_episode_steps": 60}}}
        | {"evaluation": {"every": 15, "trials": 5}, "snapshots": {"every": 10}}
    )
    return run_job(Job(config, 0), runs.create_run(folder, config, 0)).recording


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_the_diff_of_an_altered_copy_names_step_and_field(small, tmp_path, data):
    with open_recording(small) as recording:
        at = data.draw(st.integers(0, recording.train.steps.count() - 1))
        bounds = {"state": recording.mdp.states, "next_state": recording.mdp.states, "action": 36}
    field = data.draw(st.sampled_from(["state", "action", "next_state", "rewards", "terminated", "explored"]))

    def alter(steps):
        value = steps[field][at]
        steps[field][at] = (value + 1) % bounds[field] if field in bounds else not value.any()
        return steps

    copy = altered(small, tmp_path / "copy.mcap", schema.TRAIN_STEP, alter, result=without_digest)
    with open_recording(small) as a, open_recording(copy) as b:
        difference = diff(a, b)
    assert (difference.divergence.step, difference.divergence.field) == (at, field)
    assert f"training step {at:,}" in "\n".join(markdown(sections(difference)))
    assert difference.cause is not None
    assert difference.overlap.equal_steps >= difference.overlap.compared_steps - 1
    copy.unlink()


@pytest.mark.parametrize("episode", [0, 10**6, -5])
def test_steps_out_of_order_are_an_error(small, tmp_path, episode):
    def alter(steps):
        steps["episode"][len(steps) // 2] = episode
        return steps

    copy = altered(small, tmp_path / "copy.mcap", schema.TRAIN_STEP, alter, result=without_digest)
    with open_recording(small) as a, open_recording(copy) as b, pytest.raises(RecordingError, match="order"):
        diff(a, b)


def test_equal_streams_have_no_difference_however_they_are_cut(record):
    with open_recording(record()) as recording:
        blocks = list(recording.train.steps.blocks())
    steps = np.concatenate(blocks)
    cut = (steps[first : first + 777] for first in range(0, len(steps), 777))
    assert first_difference(iter(blocks), cut) == (None, None)


def test_markdown_tables_have_as_many_cells_as_headings(compare):
    lines = list(markdown(sections(compare("discount=0.9"), everything=True)))
    assert "## Training" in lines
    for above, line in pairwise(lines):
        if above.startswith("|") and line.startswith("|"):
            assert above.count(" | ") == line.count(" | ")


def test_of_a_long_text_that_continues_in_one_run_the_end_is_shown(compare):
    text = "a" * 200
    difference = replace(compare(), config=[Change("note", text, f"{text} and b")])
    (row,) = sections(difference)[1].grids[0].rows
    assert row == ("note", f"…{'a' * 20}", f"…{'a' * 20} and b")


def test_the_command_prints_what_differs_and_exits_with_1(record, folder):
    ids = [record(*overrides).parent.name for overrides in ((), ("discount=0.9",), ("name=other",))]
    run = CliRunner().invoke
    result = run(cli, ["diff", ids[0], ids[1], "--recordings", str(folder)])
    assert result.exit_code == 1
    assert "They diverge in training episode" in result.stdout
    assert "discount (0.8 in A, 0.9 in B) differs" in result.stdout
    assert "Why that update differs: the discount was 0.8 in A, 0.9 in B." in result.stdout
    as_json = run(cli, ["diff", ids[0], ids[1], "--recordings", str(folder), "--json", "--ignore", "disc*"])
    assert json.loads(as_json.stdout)["config"] == []
    assert json.loads(as_json.stdout)["cause"]["kind"] == "greedy_action"
    assert json.loads(as_json.stdout)["alike"] == {}
    words = ["diff", *ids[:2], "--recordings", str(folder), "--all"]
    alike = json.loads(run(cli, [*words, "--json", "--ignore", "e*"]).stdout)["alike"]
    assert "discount" not in alike["config"], "it differs"
    assert "env.id" not in alike["config"], "it is to be ignored"
    assert (alike["config"]["step_size"], alike["provenance"]["python"]) == (0.1, platform.python_version())
    assert "step_size" in run(cli, words).stdout
    assert "step_size" not in result.stdout
    same = run(cli, ["diff", ids[0], ids[2], "--recordings", str(folder)])
    assert same.exit_code == 0, same.output
    for words in ([ids[0], ids[2]], [*ids[:2], "--first"]):
        aimed = run(cli, ["diff", *words, "--recordings", str(folder), "--target", "success_percent=80"])
        assert "no metrics are compared, so the levels of targets are not looked for" in aimed.stdout
    unknown = run(cli, ["diff", ids[0], ids[1], "--recordings", str(folder), "--target", "sucess_percent=80"])
    assert unknown.exit_code == 2
    assert "Did you mean" in unknown.stderr
    wrong = run(cli, ["diff", ids[0], "nothing", "--recordings", str(folder)])
    assert wrong.exit_code == 2


class TestIndependentExploration:
    """Each learner explores by its own draw: `explored` has a bit for each."""

    FIRST_OF_TWO = 0b01

    @pytest.fixture
    def cause_after(self, record, tmp_path):
        """Return the cause of a difference, after a change to a step in which taxi 1 alone explored."""

        def cause_of_change(change):
            path = record("exploration=independent")
            with open_recording(path) as whole:
                explored = np.concatenate([block["explored"] for block in whole.train.steps.blocks()])
            step = int(np.flatnonzero(explored == self.FIRST_OF_TWO)[20])

            def changed(records):
                change(records[step : step + 1])
                return records

            forged = altered(
                path, tmp_path / "forged.mcap", schema.TRAIN_STEP, changed, result=without_digest
            )
            with open_recording(path) as a, open_recording(forged) as b:
                difference = diff(a, b, first=True)
            assert difference.divergence.step == step
            return difference.cause

        return cause_of_change

    def test_another_action_of_an_exploring_learner_is_random(self, cause_after):
        cause = cause_after(lambda step: np.copyto(step["action"], (step["action"] + 6) % 36))
        assert cause.kind == "random_action"
        assert cause.text.startswith("the same learners explored")

    def test_another_action_of_a_learner_that_did_not_explore_is_greedy(self, cause_after):
        cause = cause_after(
            lambda step: np.copyto(step["action"], step["action"] // 6 * 6 + (step["action"] + 1) % 6)
        )
        assert cause.kind == "greedy_action"

    def test_another_exploring_learner_is_reported(self, cause_after):
        cause = cause_after(lambda step: step["explored"].fill(0b10))
        assert cause.kind == "exploration"
        assert cause.text == "other learners explored: taxi 1 explored in A, taxi 2 explored in B"

    def test_exploration_of_both_learners_is_reported(self, cause_after):
        cause = cause_after(lambda step: step["explored"].fill(0b11))
        assert cause.text == "other learners explored: taxi 1 explored in A, all learners explored in B"

    def test_the_cause_of_a_real_difference_is_in_the_tables(self, record):
        setting = "exploration=independent"
        with open_recording(record(setting)) as a, open_recording(record(setting, "discount=0.9")) as b:
            difference = diff(a, b)
        assert difference.cause.kind == "greedy_action"
        assert difference.cause.update is not None
