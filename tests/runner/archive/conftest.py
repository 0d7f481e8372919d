"""Runs and archives that several tests read and none changes."""

from __future__ import annotations

import pytest

from runner.archive.writing import write_archive
from runner.recording.reader import open_recording
from tests.runner.recording.making import TAXIS, make_run


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """Return a cache of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """Return a finished run of one learner for two taxis."""
    return make_run(tmp_path_factory.mktemp("recordings"), TAXIS, mode="cooperative")


@pytest.fixture(scope="session")
def archive(run, tmp_path_factory):
    """Return the folder of its archive."""
    folder = tmp_path_factory.mktemp("archive") / run.run_id
    folder.mkdir()
    with open_recording(run.recording) as recording:
        write_archive(recording, folder)
    return folder
