"""What tests of several parts share: a browser, and runs that none of them changes."""

from __future__ import annotations

import pytest

from tests import browsing
from tests.runner.recording.making import LAKE, TAXIS, make_run


@pytest.fixture(scope="session")
def taxis(tmp_path_factory):
    """Return a run of two learners, its steps in many chunks."""
    return make_run(tmp_path_factory.mktemp("taxis"), TAXIS, recording={"chunk_steps": 256})


@pytest.fixture(scope="session")
def lake(tmp_path_factory):
    """Return a run of one learner in a small environment."""
    return make_run(tmp_path_factory.mktemp("lake"), LAKE)


@pytest.fixture(scope="session")
def chromium():
    """Return Chromium, whose log holds its requests and errors."""
    with browsing.chromium() as started:
        yield started


@pytest.fixture(scope="module")
def browser(chromium):
    """Return Chromium as if just started: no page open, no cookies, empty logs."""
    chromium.get("about:blank")  # the last page still asks the server of another module, which has ended
    chromium.execute_cdp_cmd("Network.clearBrowserCookies", {})
    for log in ("browser", "performance"):
        chromium.get_log(log)
    return chromium
