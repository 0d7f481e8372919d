"""The recordings kept for ever are read, verified and time-travelled as on the day they were made."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from runner.analysis.qtable import history_of
from runner.execution.verify import verify
from runner.recording import schema
from runner.recording.reader import open_recording
from tests.data.make import LOOPS, NAMES, TOGETHER, expectations, loop_expectations

DATA = Path(__file__).parents[2] / "data"
EXPECTED = json.loads((DATA / "digests.json").read_text())


@pytest.fixture(params=NAMES)
def name(request):
    return request.param


def test_kept_recordings_have_their_contents(name):
    assert expectations(DATA / f"{name}.mcap") == EXPECTED[name]
    assert (DATA / f"{name}.mcap").stat().st_size < 150_000


@pytest.mark.parametrize("rerun", [False, True], ids=["recorded environment", "installed environment"])
def test_they_are_what_their_jobs_give(name, rerun):
    found = verify(DATA / f"{name}.mcap", rerun=rerun)
    assert found.finding == ""
    assert found.content_digest == EXPECTED[name]["content_digest"]
    assert not any(key.startswith("environment.") for key in found.changes)


def test_they_have_every_kind_of_message(name):
    assert set(EXPECTED[name]["messages"]) == {topic.name for topic in schema.JOB_TOPICS}


def test_each_state_has_its_history(name):
    with open_recording(DATA / f"{name}.mcap") as recording:
        steps = recording.train.steps.array()
        state = int(np.bincount(steps["state"]).argmax())
        history = history_of(recording, state, len(steps))
        assert history.visits[0].sum() == (steps["state"] == state).sum()
        assert history.changed_step.max() < len(steps)


@pytest.mark.parametrize("name", [*LOOPS, *TOGETHER])
def test_what_kept_loops_hold(name):
    path = DATA / f"{name}.mcap"
    assert loop_expectations(path) == EXPECTED[name]
    found = verify(path)
    assert found.finding == ""
    assert found.content_digest == EXPECTED[name]["content_digest"]
    assert path.stat().st_size < 50_000


def test_environments_in_parallel_are_distinguished():
    with open_recording(DATA / "vector.mcap") as recording:
        assert recording.environments == 3
        steps = recording.train.steps.array()
        assert len(steps) == 80 * 3
        assert (~steps["taken"]).any()
    with open_recording(DATA / "game.mcap") as recording:
        played = list(recording.train.transitions())
        assert [int(one["acted"]) for one in played[:3]] == [0b111, 0b110, 0b100]
        assert [int(one["agents_terminated"]) for one in played[:3]] == [0b001, 0b010, 0b100]


def test_kept_loops_have_every_kind_of_message_but_frames():
    kept = {topic for name in (*LOOPS, *TOGETHER) for topic in EXPECTED[name]["messages"]}
    every = {topic.name for topic in schema.KINDS["loop"]}
    others = ("frame", "extra", "actions", "reset_options")
    left_out = {f"/{phase}/{name}" for phase in schema.PHASES for name in others}
    assert kept == every - left_out - {
        "/extra",
        "/checkpoint",
        "/image",
        *(topic.name for topic in schema.MACHINE_TOPICS),
    }
