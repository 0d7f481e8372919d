"""Recordings that several tests read and none changes."""

import pytest

from tests.runner.recording.making import LAKE, TAXIS, make_run


@pytest.fixture(scope="session")
def taxis(tmp_path_factory):
    """Return a run of two learners, its steps in many chunks."""
    return make_run(tmp_path_factory.mktemp("taxis"), TAXIS, recording={"chunk_steps": 256})


@pytest.fixture(scope="session")
def lake(tmp_path_factory):
    """Return a run of one learner in a small environment."""
    return make_run(tmp_path_factory.mktemp("lake"), LAKE)
