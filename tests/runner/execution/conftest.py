"""The run that tests of verification share."""

from __future__ import annotations

import pytest

from tests.runner.recording.making import TAXIS, make_run


@pytest.fixture(scope="session", params=["competitive", "cooperative"])
def run(request, tmp_path_factory):
    """A finished run of each mode, not to be changed."""
    folder = tmp_path_factory.mktemp("verified")
    return make_run(folder, TAXIS, mode=request.param, recording={"chunk_steps": 256})
