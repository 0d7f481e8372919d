"""Any Q-table at any step is the one that the learner had, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import runner
from runner.analysis.qtable import history_of
from runner.environments.loading import load_mdp
from runner.errors import RecordingError
from runner.learning.learner import Learner
from runner.recording import schema
from runner.recording.layout import blank_records, layout_of
from runner.recording.reader import open_recording
from runner.replay.steps import last_step, step_of_episode
from runner.replay.tables import TableReplay, tables_at
from tests.runner.altering import altered, without_chunk
from tests.runner.recording.making import TAXIS, experiment, make_run

SCHEDULES = {
    "epsilon": {"schedule": "linear", "start": 1.0, "end": 0.2, "over": 2000, "by": "step"},
    "step_size": {"schedule": "exponential", "start": 0.9, "factor": 0.97},
}
CONFIGS = {
    "competitive": TAXIS | {"mode": "competitive"},
    "cooperative": TAXIS | {"mode": "cooperative"} | SCHEDULES,
    "quirks": TAXIS
    | {"mode": "competitive", "initial_q": "random", "exploration": "independent"}
    | {"quirks": {"second_table_uses_first_action": True, "bootstrap_after_termination": True}},
}


@pytest.fixture(scope="module", params=CONFIGS)
def run(request, tmp_path_factory):
    """A finished run, not to be changed; with its configuration."""
    folder = tmp_path_factory.mktemp("tables")
    return make_run(folder, CONFIGS[request.param], recording={"chunk_steps": 256})


@pytest.fixture(scope="module")
def config(run):
    return experiment(run.facts["config"])


@pytest.fixture(scope="module")
def steps(run):
    return run.summary["train_steps"]


@pytest.fixture(scope="module")
def live(config):
    """Return a function that returns the tables of a live learner after a number of steps."""
    mdp = load_mdp(config.env.id, config.env.kwargs, config.rewards)

    def at(step: int) -> list[np.ndarray]:
        learner = Learner(config, mdp, 0)
        counts = len(learner.agents), len(mdp.event_names)
        block = blank_records(
            schema.TRAIN_STEP, layout_of("job", *counts).message(schema.TRAIN_STEP), max(step, 1)
        )
        ended = blank_records(
            schema.TRAIN_EPISODE, layout_of("job", *counts).message(schema.TRAIN_EPISODE), 100
        )
        taken = learner.train(block.view(np.recarray), ended.view(np.recarray), 10**6, step)[0] if step else 0
        assert taken == step
        return [learner.table(i).copy() for i in range(len(learner.agents))]

    return at


@settings(
    max_examples=30,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    derandomize=True,
)
@given(data=st.data())
def test_the_table_at_any_step_is_the_learners(run, live, steps, data):
    step = data.draw(st.integers(0, steps))
    with open_recording(run.recording) as recording:
        found, expected = tables_at(recording, step), live(step)
    assert [table.tobytes() for table in found] == [table.tobytes() for table in expected]


def test_a_snapshot_is_the_table_of_its_moment(run, steps):
    with open_recording(run.recording) as recording:
        snapshots = list(recording.snapshots())
        replay = TableReplay(recording)  # from the very first on, past all the others
        for snapshot in snapshots:
            replay.advance(snapshot.step)
            assert replay.tables[snapshot.table].tobytes() == snapshot.values.tobytes()
            assert step_of_episode(recording, snapshot.episode) == snapshot.step
        assert last_step(recording) == steps == snapshots[-1].step


def test_the_greedy_action_is_the_first_of_the_best(run, steps):
    with open_recording(run.recording) as recording:
        replay = TableReplay(recording, steps // 2)
        for i, table in enumerate(replay.tables):
            assert np.array_equal(replay.learner.tables.greedy[i], table.argmax(axis=1))


@pytest.mark.parametrize("share", [0, 0.3, 1])
def test_the_history_of_a_state(run, steps, share):
    step = int(share * steps)
    with open_recording(run.recording) as recording:
        records = np.concatenate([*recording.train.steps.blocks(0, step)] or [empty(recording)])
        states = np.unique(records["state"])[:3].tolist() or [0]
        for state in states:
            found = history_of(recording, state, step)
            expected = history_by_hand(recording, records[records["state"] == state], state)
            assert np.array_equal(found.visits, expected[0])
            assert np.array_equal(found.changed_step, expected[1])
            assert np.array_equal(found.changed_episode, expected[2])
            assert step == 0 or found.visits.any()


def empty(recording):
    return np.empty(0, recording.train.steps.row_dtype)


def history_by_hand(recording, visits, state):
    """Return visits, last changing step and its episode, from the tables before and after each visit."""
    replay = TableReplay(recording)
    shape = replay.learner.model.own_action.shape[1], max(table.shape[1] for table in replay.tables)
    counts, steps, episodes = np.zeros(shape, int), np.full(shape, -1), np.full(shape, -1)
    for record in visits:
        replay.advance(int(record["step"]))
        before = [table[state].copy() for table in replay.tables]
        replay.advance(int(record["step"]) + 1)
        for i, table in enumerate(replay.tables):
            counts[i, replay.learner.model.own_action[record["action"], i]] += 1
            changed = table[state] != before[i]
            steps[i, : len(changed)][changed] = record["step"]
            episodes[i, : len(changed)][changed] = record["episode"]
    return counts, steps, episodes


@pytest.mark.parametrize(
    ("algorithm", "mode"), [("sarsa_lambda", "competitive"), ("n_step_q_learning", "cooperative")]
)
def test_the_history_of_values_that_later_steps_change(tmp_path, algorithm, mode):
    values = {"mode": mode, "algorithm": algorithm, "episodes": 9}
    run = make_run(tmp_path, TAXIS, values, recording={"chunk_steps": 256})
    with open_recording(run.recording) as recording:
        steps = recording.train.steps.array()
        state = int(steps["state"][len(steps) // 2])
        replay = TableReplay(recording)
        changed = np.full((len(replay.tables), replay.tables[0].shape[1]), -1)
        for step in range(len(steps)):
            before = [table[state].copy() for table in replay.tables]
            replay.advance(step + 1)
            for i, table in enumerate(replay.tables):
                changed[i, table[state] != before[i]] = step
        found = history_of(recording, state, len(steps))
    assert found.changed_step.tolist() == changed.tolist()
    assert found.visits.sum(axis=1).tolist() == [(steps["state"] == state).sum()] * len(changed)
    assert (steps["state"][changed[changed >= 0]] != state).any()


def test_without_steps_the_error_names_where_tables_are(tmp_path):
    settings = ["episodes=20", "recording.steps=none", "snapshots.every=10"]
    done = runner.run("configs/quick.yaml", recordings=tmp_path, overrides=settings)
    with open_recording(done.recording) as recording:
        _, middle, last = (snapshot.step for snapshot in recording.snapshots())
        assert len(tables_at(recording, middle)) == 1
        nearest = (
            rf"without steps .* first {middle + 1:,}; `dualtaxi rerecord`.* {middle:,} and {last:,} steps"
        )
        with pytest.raises(RecordingError, match=nearest):
            tables_at(recording, middle + 1)
        with pytest.raises(
            RecordingError, match=f"found {last:,} training steps, expected at least {last + 1:,}"
        ):
            tables_at(recording, last + 1)


def test_what_is_not_there(run, steps):
    with open_recording(run.recording) as recording:
        with pytest.raises(
            RecordingError, match=f"found {steps:,} training steps, expected at least {steps + 1:,}"
        ):
            tables_at(recording, steps + 1)
        with pytest.raises(RecordingError, match="found 60 training episodes, expected at least 61"):
            step_of_episode(recording, 61)
        with pytest.raises(RecordingError, match="cannot go back"):
            TableReplay(recording, 5).advance(4)


def test_without_steps_there_are_the_snapshots(tmp_path):
    run = make_run(tmp_path, TAXIS, recording={"steps": "none"})
    with open_recording(run.recording) as recording:
        assert last_step(recording) == run.summary["train_steps"]
        half = step_of_episode(recording, 30)
        assert tables_at(recording, half)[0].any()
        with pytest.raises(RecordingError, match="`dualtaxi rerecord`"):
            tables_at(recording, half + 1)
        with pytest.raises(RecordingError, match="`dualtaxi rerecord`"):
            history_of(recording, 0, half)


def test_behind_a_hole_there_are_no_tables(tmp_path):
    run = make_run(tmp_path, TAXIS, recording={"chunk_steps": 256}, snapshots={"every": None})
    with open_recording(run.recording) as recording:
        total = recording.train.steps.count()
    first = without_chunk(run.recording, schema.TRAIN_STEP, 1)
    with open_recording(run.recording) as recording:
        assert tables_at(recording, first)
        with pytest.raises(RecordingError, match=f"training steps {first} to .* were lost.*resume"):
            tables_at(recording, total - 1)
        assert tables_at(recording, total)  # the last snapshot


@pytest.mark.parametrize(("field", "value"), [("state", 10**6), ("next_state", 2**31), ("action", 36)])
def test_a_step_that_cannot_be_is_refused(tmp_path, field, value):
    run = make_run(tmp_path, TAXIS)

    def change(records):
        records[field][100] = value
        return records

    path = altered(run.recording, tmp_path / "x.mcap", schema.TRAIN_STEP, change)
    with open_recording(path) as recording, pytest.raises(RecordingError, match=f"found {field} {value}"):
        tables_at(recording, 200)
