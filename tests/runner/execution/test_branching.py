"""Branches of training: the parent's steps before the change, its luck after it, and a run as every other."""

from __future__ import annotations

import shutil
from functools import cache

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

import runner
from runner.analysis.diff import diff
from runner.analysis.diff.sections import summary
from runner.analysis.episodes import reference_to, training_step
from runner.cli import cli
from runner.config import from_mapping
from runner.config.model import Job
from runner.errors import ConfigError, RecordingError, RunnerError
from runner.execution.branching import branch_training
from runner.execution.rerecord import evaluate, rerecord
from runner.execution.resume import resume
from runner.execution.session import run_job
from runner.execution.verify import verify
from runner.learning.learner import Learner
from runner.recording.reader import open_recording
from runner.replay.tables import TableReplay
from runner.runs.branches import TrainingOrigin
from runner.runs.catalogue.index import look
from runner.runs.run import create_run
from tests.runner.recording.making import LAKE, SAMPLED, TAXIS, make_run, middle_of, stopping_after, training

ALGORITHMS = ("q_learning", "sarsa", "expected_sarsa", "double_q_learning", "wolf_phc")
"""Those of one table and of several; Hysteretic Q-learning is only for several."""
SCHEDULES = {
    "constant": 0.3,
    "by episode": {"schedule": "linear", "start": 1.0, "end": 0.1, "over": 8},
    "by step": {"schedule": "exponential", "start": 0.9, "factor": 0.99, "by": "step"},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the recordings folder of all parents."""
    return tmp_path_factory.mktemp("parents")


@pytest.fixture(scope="module")
def parent_of(folder):
    """Return the function that returns a parent of a configuration, which is trained once."""

    @cache
    def parent(mode, algorithm, schedule="constant", steps="all"):
        values = {"mode": mode, "algorithm": algorithm, "epsilon": SCHEDULES[schedule], "episodes": 12}
        return make_run(folder, TAXIS, SAMPLED, recording={"steps": steps, "chunk_steps": 256}, **values)

    return parent


@pytest.fixture
def parent(parent_of):
    """Return a parent with a table for each of two agents."""
    return parent_of("competitive", "q_learning")


def other_action(run, step, agent=0):
    """Return another action of an agent than the recorded one."""
    with open_recording(run.recording) as recording:
        return (int(recording.mdp.own_actions[training(run, step, step + 1)["action"][0], agent]) + 1) % 6


def first_difference(a, b):
    """Return the number of the first training step at which two runs differ."""
    left, right = training(a), training(b)
    shared = min(len(left), len(right))
    differs = [x.tobytes() != y.tobytes() for x, y in zip(left[:shared], right[:shared], strict=True)]
    return differs.index(True) if True in differs else shared


# --- the property that makes a branch a branch --------------------------------------------------------


@given(
    mode=st.sampled_from(["cooperative", "competitive"]),
    algorithm=st.sampled_from([*ALGORITHMS, "hysteretic_q_learning", "random"]),
    schedule=st.sampled_from(sorted(SCHEDULES)),
    share=st.floats(0, 1, exclude_max=True),
    keeps_action=st.booleans(),
)
@settings(max_examples=20, deadline=None)
def test_a_branch_without_a_change_has_its_parents_content(
    parent_of, tmp_path_factory, mode, algorithm, schedule, share, keeps_action
):
    run = parent_of("competitive" if algorithm == "hysteretic_q_learning" else mode, algorithm, schedule)
    step, action = int(share * run.summary.train_steps), None
    if keeps_action and algorithm == "q_learning":  # each algorithm compiles a kernel for this
        action = int(training(run, step, step + 1)["action"][0])
    branch = branch_training(run, at=step, action=action, recordings=tmp_path_factory.mktemp("branch"))
    assert branch.run.summary.content_digest == run.summary.content_digest
    assert branch.run.status == "finished"


@pytest.mark.parametrize(
    ("mode", "algorithm", "changes"),
    [
        ("competitive", "q_learning", ["epsilon=0.9"]),
        (
            "cooperative",
            "q_learning",
            ["step_size={schedule: linear, start: 0.9, end: 0.1, over: 300, by: step}"],
        ),
        ("competitive", "sarsa", ["epsilon=0.8", "discount=0.5"]),
        ("cooperative", "expected_sarsa", ["epsilon=0.8"]),
        ("competitive", "double_q_learning", ["step_size=0.9"]),
        ("competitive", "hysteretic_q_learning", ["hysteretic.decrease=0.9"]),
        ("competitive", "wolf_phc", ["wolf_phc.win=0.01"]),
        ("competitive", "sarsa_lambda", ["sarsa_lambda.trace_decay=0.5", "discount=0.5"]),
        ("cooperative", "n_step_q_learning", ["step_size=0.9", "discount=0.5"]),
        ("competitive", "q_learning", ["exploration=shared"]),
        ("competitive", "q_learning", ["quirks.second_table_uses_first_action=true"]),
    ],
)
def test_settings_change_from_the_step_on(parent_of, tmp_path, mode, algorithm, changes):
    run = parent_of(mode, algorithm)
    step = middle_of(run)
    branch = branch_training(run, at=step, overrides=changes, recordings=tmp_path).run
    assert training(branch, 0, step).tobytes() == training(run, 0, step).tobytes()
    assert branch.summary.content_digest != run.summary.content_digest
    assert (found := verify(branch.recording)).sound, found.finding
    with open_recording(branch.recording) as recording:
        replay = TableReplay(recording)
        for each in (step // 2, step, step + 1, branch.summary.train_steps):
            replay.advance(each)
        tables = replay.learner.snapshot()
        last = [table.values for table in recording.snapshots(0, len(tables))][-len(tables) :]
    for replayed, recorded in zip(tables, last, strict=True):
        assert np.array_equal(replayed, recorded)


def test_a_changed_action_is_taken_at_its_step_alone(parent, tmp_path):
    step, steps = middle_of(parent), training(parent)
    action = other_action(parent, step)
    branch = branch_training(parent, at=step, action={"taxi_1": action}, recordings=tmp_path)
    assert str(branch.at) == f"{steps['episode'][step]}:{steps['t'][step]}"
    assert first_difference(parent, branch.run) == step
    with open_recording(branch.run.recording) as recording:
        own = recording.mdp.own_actions
    taken = training(branch.run, step, step + 1)
    assert own[taken["action"][0]].tolist() == [action, int(own[steps["action"][step], 1])]
    assert taken["explored"] == steps["explored"][step]  # the draw was the same


def test_draws_that_the_change_does_not_touch_are_the_same(parent, tmp_path):
    step = middle_of(parent, 0.3)
    branch = branch_training(
        parent, at=step, action={"taxi_2": str(other_action(parent, step, 1))}, recordings=tmp_path
    )
    ours, theirs = (
        {(int(s["episode"]), int(s["t"])): s for s in training(run)} for run in (parent, branch.run)
    )
    shared = ours.keys() & theirs.keys()
    assert len(shared) > 500
    assert all(ours[key]["explored"] == theirs[key]["explored"] for key in shared)
    assert all(ours[key]["state"] == theirs[key]["state"] for key in shared if key[1] == 0)
    both = [key for key in shared if ours[key]["explored"] == 3]
    assert both
    assert all(
        ours[key]["action"] == theirs[key]["action"]
        for key in both
        if key != (branch.at.episode, branch.at.t)
    )


def test_a_joint_action_is_named_or_numbered(parent_of, tmp_path):
    run = parent_of("cooperative", "q_learning")
    with open_recording(run.recording) as recording:
        step = training_step(recording, runner.analysis.episodes.EpisodeRef(3, 4))
    branches = [
        branch_training(run, at=at, action=action, recordings=tmp_path)
        for at, action in (("3:4", "north + drop-off"), (step, {"taxi 1": "north", "taxi_2": "drop_off"}))
    ]
    assert {branch.run.summary.content_digest for branch in branches} == {
        branches[0].run.summary.content_digest
    }
    assert branches[0].origin == branches[1].origin
    assert dict(branches[0].origin.actions) == {"taxi_1": "north", "taxi_2": "drop-off"}


# --- a run as every other -----------------------------------------------------------------------------


def test_a_branch_of_a_branch_names_both(parent, tmp_path):
    late, early = middle_of(parent, 0.7), middle_of(parent, 0.3)
    first = branch_training(parent, at=late, overrides=["epsilon=0.9"], recordings=tmp_path).run
    second = branch_training(
        first, at=early, action={"taxi_1": other_action(parent, early)}, recordings=tmp_path
    ).run
    assert [(each["run"], each["step"]) for each in second.file.config["branches"]] == [
        (parent.run_id, late),
        (first.run_id, early),
    ]
    assert first_difference(first, second) == early
    with open_recording(second.recording) as recording:
        learner = Learner(from_mapping(recording.config), recording.mdp, 0)
    assert [segment.start for segment in map(learner.segment_at, (0, early, late))] == [0, early, late]
    assert verify(second.recording).sound
    assert branch_training(second, at=late, recordings=tmp_path).run.summary.content_digest == (
        second.summary.content_digest
    )


def test_a_branch_names_the_settings_that_changed_alone(parent, tmp_path):
    late, early = middle_of(parent, 0.7), middle_of(parent, 0.3)
    first = branch_training(
        parent, at=late, overrides=["quirks.second_table_uses_first_action=true"], recordings=tmp_path
    )
    second = branch_training(
        first.run, at=early, overrides=["quirks.bootstrap_after_termination=true"], recordings=tmp_path
    )
    assert first.origin.changes.startswith("quirks.second_table_uses_first_action true")
    assert second.origin.changes.startswith("quirks.bootstrap_after_termination true")
    assert "epsilon_exploits" not in first.origin.changes + second.origin.changes


def test_an_interrupted_branch_is_resumed(parent, tmp_path):
    step, options = middle_of(parent, 0.2), {"overrides": ["epsilon=0.8"], "recordings": tmp_path}
    whole = branch_training(parent, at=step, **options).run
    part = branch_training(parent, at=step, stop=stopping_after(3), **options).run
    assert part.status == "interrupted"
    assert resume(part).summary.content_digest == whole.summary.content_digest
    # an interrupted or resumed run is a parent as well
    assert branch_training(part, at=3, recordings=tmp_path).run.summary.content_digest == (
        whole.summary.content_digest
    )


def test_a_run_without_steps_is_branched_and_rerecorded(parent_of, tmp_path):
    bare, whole = (parent_of("competitive", "q_learning", steps=steps) for steps in ("none", "all"))
    step = middle_of(whole)
    with open_recording(whole.recording) as a, open_recording(bare.recording) as b:
        assert reference_to(a, step) == reference_to(b, step)
        at = str(reference_to(b, step))
    branches = [
        branch_training(run, at=at, overrides=["epsilon=0.8"], recordings=tmp_path).run
        for run in (bare, whole)
    ]
    assert rerecord(branches[0]).summary.content_digest == branches[1].summary.content_digest
    with_steps = branch_training(
        bare, at=step, overrides=["epsilon=0.8", "recording.steps=all"], recordings=tmp_path
    ).run
    assert with_steps.summary.content_digest == branches[1].summary.content_digest
    assert len(training(with_steps)) == with_steps.summary.train_steps


def test_a_transferred_table_needs_its_run_no_more(tmp_path):
    source = make_run(tmp_path, LAKE)
    config = from_mapping(LAKE | {"initial_q": {"run": source.run_id}, "epsilon": 0.4, "name": "transferred"})
    run = run_job(Job(config, 1), create_run(tmp_path, config, 1))
    shutil.rmtree(source.folder)
    same = branch_training(run, at=20, recordings=tmp_path).run
    assert same.summary.content_digest == run.summary.content_digest
    shutil.rmtree(run.folder)
    assert verify(same.recording).sound
    assert (
        branch_training(same, at="2:1", overrides=["epsilon=0.9"], recordings=tmp_path).run.status
        == "finished"
    )


def test_training_can_go_on_after_the_end(parent, tmp_path):
    end = parent.summary.train_steps
    longer = branch_training(parent, at=end, episodes=16, overrides=["epsilon=0.9"], recordings=tmp_path).run
    assert longer.summary.episodes == 16
    assert training(longer, 0, end).tobytes() == training(parent).tobytes()
    with pytest.raises(ConfigError, match=r"found 12, expected more than 12: .* `--episodes N` trains more"):
        branch_training(parent, at=end, recordings=tmp_path)


def test_an_evaluation_of_a_branch_is_no_branch(parent, tmp_path):
    branch = branch_training(parent, at=50, overrides=["epsilon=0.8"], recordings=tmp_path).run
    assert "branches" not in evaluate(branch, tmp_path, trials=2).file.config


# --- where it is seen ---------------------------------------------------------------------------------


def test_the_difference_of_parent_and_branch_is_the_branch(parent, tmp_path):
    step = middle_of(parent)
    acted = branch_training(
        parent, at=step, action={"taxi_1": other_action(parent, step)}, recordings=tmp_path
    )
    curious = branch_training(parent, at=step + 5, overrides=["epsilon=0.9"], recordings=tmp_path)
    with (
        open_recording(parent.recording) as a,
        open_recording(acted.run.recording) as b,
        open_recording(curious.run.recording) as c,
    ):
        for found, text in ((diff(a, b), "B is a branch of A"), (diff(b, a), "A is a branch of B")):
            assert (found.cause.kind, found.divergence.step) == ("branch", step)
            assert found.cause.text == f"{text}, {acted.origin}; training is the same for {step:,} steps"
            assert found.cause.text in summary(found)
        later = diff(a, c, first=True)
        assert later.divergence.step >= step + 5
        assert later.cause.text.startswith(f"B is a branch of A, {curious.origin}; training is the same for ")
        assert " in A, " in later.cause.text or "A explored" in later.cause.text
        siblings = diff(b, c, first=True)
        assert siblings.cause.text.startswith(
            f"Both are branches of run {parent.run_id}: A {acted.origin}, B "
        )
    assert {change.path for change in found.config} == {"branches"}


def test_branches_are_listed_as_a_tree(folder, parent, tmp_path):
    root = runner.Run(shutil.copytree(parent.folder, tmp_path / parent.run_id), parent.facts)
    first = branch_training(root, at=9, overrides=["epsilon=0.8"], name="first", recordings=tmp_path)
    second = branch_training(first.run, at=8, overrides=["epsilon=0.7"], recordings=tmp_path)
    third = branch_training(root, at=7, recordings=tmp_path)

    def tree(node):
        return {node.run: [tree(each) for each in node.branches]}

    ids = [each.run.run_id for each in (first, second, third)]
    whole = {root.run_id: [{ids[0]: [{ids[1]: []}]}, {ids[2]: []}]}
    for run_id in (root.run_id, *ids):
        assert tree(look([tmp_path], lambda index, name=run_id: index.branch_tree(name))) == whole
    assert look([tmp_path], lambda index: index.branches(root.run_id)) == {
        ids[2]: third.origin,
        ids[0]: first.origin,
    }
    shutil.rmtree(root.folder)
    found = look([tmp_path], lambda index: index.branch_tree(ids[1]))
    assert (found.run, found.name, found.status) == (root.run_id, None, "removed")
    assert (
        found.branches[0].branches[0].origin
        == second.origin
        == TrainingOrigin(ids[0], 8, {}, {"epsilon": 0.7})
    )


# --- what cannot be branched --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "message", "options"),
    [
        (RecordingError, "found no training step 99,999; there are", {"at": 99_999}),
        (RecordingError, "found no training episode 99; there are 12", {"at": "99:0"}),
        (RecordingError, "found no step 90 of training episode 1, which has", {"at": "1:90"}),
        (RunnerError, "expected a step of training", {"at": "eval:0:0:0"}),
        (RunnerError, "expected EPISODE:T", {"at": "here"}),
        (ConfigError, "Did you mean 'taxi_1'", {"at": 5, "action": {"taxi_11": "north"}}),
        (
            ConfigError,
            "expected an action of taxi 1: .* Did you mean 'north'",
            {"at": 5, "action": {"taxi_1": "nort"}},
        ),
        (ConfigError, "a number from 0 to 5", {"at": 5, "action": {"taxi_1": 6}}),
        (ConfigError, "expected a joint action: ", {"at": 5, "action": "north"}),
        (ConfigError, "epsilo: unknown key. Did you mean 'epsilon'", {"at": 5, "overrides": ["epsilo=1"]}),
        (
            ConfigError,
            "epsilon: found 2, expected a number from 0 to 1",
            {"at": 5, "overrides": ["epsilon=2"]},
        ),
        (
            ConfigError,
            "env: cannot change at a step",
            {"at": 5, "overrides": ["env.kwargs.max_episode_steps=9"]},
        ),
        (ConfigError, "algorithm: cannot change at a step", {"at": 5, "overrides": ["algorithm=sarsa"]}),
        (ConfigError, "seeds: cannot change at a step", {"at": 5, "overrides": ["seed=3"]}),
        (
            ConfigError,
            "tables: cannot change at .*; step_size, discount, epsilon, exploration, quirks can",
            {"at": 5, "overrides": ["mode=cooperative"]},
        ),
        (ConfigError, "episodes: found 1, expected more than 3", {"at": "3:1", "episodes": 1}),
        (ConfigError, "name: found '..'", {"at": 5, "name": ".."}),
    ],
)
def test_what_cannot_be_branched_leaves_no_run(parent, tmp_path, error, message, options):
    with pytest.raises(error, match=message):
        branch_training(parent, recordings=tmp_path, **options)
    assert not list(tmp_path.iterdir())


def test_the_command_says_that_nothing_is_changed(parent, tmp_path):
    words = ["branch", str(parent.folder), "--at", f"step:{middle_of(parent)}", "--recordings", str(tmp_path)]
    same, other = (CliRunner().invoke(cli, [*words, *more]) for more in ((), ("--set", "epsilon=0.9")))
    assert (same.exit_code, other.exit_code) == (0, 0), same.output + other.output
    assert f"nothing is changed, so the branch repeats run {parent.run_id}" in same.stderr
    assert "nothing is changed" not in other.stderr


def test_a_branch_that_only_goes_on_says_for_how_long(parent, tmp_path):
    branch = branch_training(
        parent, at=parent.summary.train_steps, episodes=14, recordings=tmp_path, name="more"
    )
    assert str(branch.origin).endswith("nothing changed, 14 episodes in all")
    (found,) = look([tmp_path], lambda index: index.branches(parent.run_id)).values()
    assert str(found) == str(branch.origin)


def test_the_summary_of_a_difference_names_the_branch_alone(parent, tmp_path):
    own = branch_training(parent, at=middle_of(parent), overrides=["epsilon=0.9"], recordings=tmp_path).run
    with open_recording(own.recording) as a, open_recording(parent.recording) as b:
        found = diff(a, b)
    assert "A is a branch of B" in summary(found)
    assert "No setting" not in summary(found)
    (change,) = found.config
    assert change.a.startswith(f"{parent.run_id} at training step ")
