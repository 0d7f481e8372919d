"""Every algorithm's run can be rewound, resumed, verified and played, as Q-learning's can."""

from __future__ import annotations

import os
from typing import get_args

import numpy as np
import pytest

from runner.config.sections import Algorithm
from runner.environments.loading import load_mdp
from runner.execution.rerecord import evaluate
from runner.execution.resume import resume
from runner.execution.verify import verify
from runner.learning.algorithms import ALGORITHMS as DEFINITIONS
from runner.learning.learner import Learner
from runner.recording import schema
from runner.recording.layout import blank_records, layout_of
from runner.recording.reader import open_recording
from runner.replay.tables import TableReplay, named_tables_at, tables_at
from tests.runner.learning import harness
from tests.runner.recording.making import SAMPLED, TAXIS, copy_of, experiment, make_run

TEAM = {"mode": "cooperative"}
TWO = {"mode": "competitive", "exploration": "independent"}
ALGORITHMS = {
    "sarsa": TEAM,
    "expected_sarsa": TWO,
    "double_q_learning": TWO | {"initial_q": "random"},
    "hysteretic_q_learning": TWO,
    "wolf_phc": TWO | SAMPLED,
    "sarsa_lambda": TWO,
    "n_step_q_learning": TEAM,
}
KINDS = {
    "double_q_learning": ["q", "q_1", "q_2"],
    "wolf_phc": ["q", "policy", "average_policy", "visits"],
}


@pytest.fixture(scope="module", params=ALGORITHMS)
def algorithm(request):
    """Return an algorithm's name."""
    return request.param


@pytest.fixture(scope="module")
def run(algorithm, tmp_path_factory):
    """A finished run of seed 3, not to be changed; it has snapshots of three moments."""
    values = TAXIS | ALGORITHMS[algorithm] | {"algorithm": algorithm}
    return make_run(tmp_path_factory.mktemp("runs"), values, seed=3, recording={"chunk_steps": 256})


def live(run, step):
    """Return a learner of the run's job after a number of steps."""
    config = experiment(run.facts["config"])
    mdp = load_mdp(config.env.id, config.env.kwargs, config.rewards)
    learner = Learner(config, mdp, 3)
    counts = len(learner.agents), len(mdp.event_names)
    steps, episodes = (
        blank_records(topic, layout_of("job", *counts).message(topic), step + 1).view(np.recarray)
        for topic in (schema.TRAIN_STEP, schema.TRAIN_EPISODE)
    )
    if step:
        assert learner.train(steps, episodes, 10**6, step)[0] == step
    return learner


def same(found, learner):
    """Compare all that learners hold, bit for bit."""
    assert len(found) == len(learner.agents)
    for i, held in enumerate(found):
        expected = learner.named_tables(i)
        assert list(held) == list(expected)
        for name, array in held.items():
            assert array.tobytes() == expected[name].tobytes(), name


def test_what_is_held_at_any_step_is_what_the_learner_held(run):
    rng = np.random.default_rng(0)
    with open_recording(run.recording) as recording:
        for step in [0, 1, run.summary["train_steps"], *rng.integers(0, run.summary["train_steps"], 10)]:
            same(named_tables_at(recording, int(step)), live(run, int(step)))


def test_a_snapshot_holds_all_that_the_learner_held(algorithm, run):
    kinds = KINDS.get(algorithm, ["q"])
    with open_recording(run.recording) as recording:
        learners = len(recording.agents)
        snapshots = list(recording.snapshots(0, learners * len(kinds)))
        assert [table.table for table in snapshots] == [*range(learners * len(kinds))] * 3
        for table in snapshots:
            kind, i = divmod(table.table, learners)
            expected = live(run, table.step)
            assert table.agent == expected.agents[i]
            assert table.values.tobytes() == expected.named_tables(i)[kinds[kind]].tobytes()
        shown = list(recording.snapshots())
        assert [table.table for table in shown] == [*range(learners)] * 3


def test_the_tables_from_the_first_snapshot_on_pass_through_all_the_others(run):
    with open_recording(run.recording) as recording:
        replay = TableReplay(recording)
        for snapshot in recording.snapshots():
            replay.advance(snapshot.step)
            assert replay.tables[snapshot.table].tobytes() == snapshot.values.tobytes()


def test_it_is_verified(run):
    assert verify(run.recording).sound


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_it_is_resumed_where_it_was_cut_off_and_verified(run, share, tmp_path):
    cut = copy_of(run, tmp_path, summary={})
    os.truncate(cut.recording, int(share * cut.recording.stat().st_size))
    done = resume(cut)
    assert done.summary["content_digest"] == run.summary["content_digest"]
    assert verify(done.recording).sound


def test_what_it_learned_is_played_again(algorithm, run, tmp_path):
    played = evaluate(run, tmp_path, trials=20, seed=1)
    assert verify(played.recording).sound
    with open_recording(run.recording) as recording:
        learned = live(run, recording.train.steps.count())
    with open_recording(played.recording) as recording:
        same(named_tables_at(recording, 0), learned)
        steps = recording.eval.steps.array()
        own = learned.model.own_action[steps["action"]]
    assert not steps["explored"].any()
    for i, table in enumerate(learned.named_tables(j) for j in range(len(learned.agents))):
        if algorithm == "wolf_phc":
            assert (table["policy"][steps["state"], own[:, i]] > 0).all()
        else:
            assert np.array_equal(own[:, i], table["q"].argmax(axis=1)[steps["state"]])


def test_another_algorithm_can_start_from_its_q_tables(run, tmp_path):
    with open_recording(run.recording) as recording:
        tables = tables_at(recording, run.summary["train_steps"])
    for other, values in ALGORITHMS.items():
        if values["mode"] != ALGORITHMS[run.facts["config"]["algorithm"]]["mode"]:
            continue
        going_on = make_run(
            *(tmp_path / other, TAXIS | values),
            algorithm=other,
            episodes=5,
            initial_q={"run": str(run.recording)},
        )
        with open_recording(going_on.recording) as recording:
            held = named_tables_at(recording, 0)
        for table, one in zip(tables, held, strict=True):
            assert one["q"].tobytes() == table.tobytes()
        assert verify(going_on.recording).sound


@pytest.mark.parametrize("algorithm", ["wolf_phc", "random"])
def test_a_policy_that_draws_is_measured_exactly(algorithm, tmp_path):
    values = TAXIS | TWO | SAMPLED | {"algorithm": algorithm}
    evaluation = {"every": 20, "trials": 400, "exact": True}
    done = make_run(tmp_path, values, seed=2, evaluation=evaluation, recording={"steps": "none"})
    with open_recording(done.recording) as recording:
        exact = list(recording.table(schema.OPTIMALITY_TOPIC).decoded())[-1]
        sampled = list(recording.eval.all_metrics())[-1]
    assert exact["success_percent"] == pytest.approx(sampled["success_percent"], abs=7.5)
    gains = [best - own for own, best in zip(exact["values"], exact["best_responses"], strict=True)]
    assert min(gains) > -1e-9
    assert verify(done.recording).sound


def test_every_algorithm_is_defined_and_compared_with_plain_python():
    names = set(get_args(Algorithm))
    assert names == set(DEFINITIONS)
    compared = {values["algorithm"] for values in harness.ALGORITHMS.values()}
    assert names - compared == {"q_learning", "random"}  # `harness.RULES` are of Q-learning
