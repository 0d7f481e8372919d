"""The recordings kept for ever are read, verified and time-travelled as on the day they were made."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from runner.analysis.tables import history_of
from runner.recording import open as open_recording
from runner.recording import schema
from runner.verify import verify
from tests.data.make import NAMES, expectations

DATA = Path(__file__).parents[1] / "data"
EXPECTED = json.loads((DATA / "digests.json").read_text())


@pytest.fixture(params=NAMES)
def name(request):
    return request.param


def test_what_they_hold(name):
    assert expectations(DATA / f"{name}.mcap") == EXPECTED[name]
    assert (DATA / f"{name}.mcap").stat().st_size < 150_000


@pytest.mark.parametrize("rerun", [False, True], ids=["recorded environment", "installed environment"])
def test_they_are_what_their_jobs_give(name, rerun):
    found = verify(DATA / f"{name}.mcap", rerun=rerun)
    assert found.finding == ""
    assert found.content_digest == EXPECTED[name]["content_digest"]
    assert not any(key.startswith("environment.") for key in found.provenance)


def test_they_have_every_kind_of_message(name):
    assert set(EXPECTED[name]["messages"]) == {topic.name for topic in schema.TOPICS} - {"/eval/optimality"}


def test_each_state_has_its_history(name):
    with open_recording(DATA / f"{name}.mcap") as recording:
        steps = np.concatenate(list(recording.blocks(schema.TRAIN_STEP)))
        state = int(np.bincount(steps["state"]).argmax())
        history = history_of(recording, state, len(steps))
        assert history.visits[0].sum() == (steps["state"] == state).sum()
        assert history.changed_step.max() < len(steps)
