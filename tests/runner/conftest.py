"""What tests of several parts share: a browser, and runs that none of them changes."""

from __future__ import annotations

import os
import shutil

import pytest

from tests.runner.recording.making import LAKE, TAXIS, make_run

ARGUMENTS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--window-size=1300,1000",
    "--enable-unsafe-swiftshader",
    "--use-angle=swiftshader",
)


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
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    program = shutil.which("chromium") or shutil.which("chromium-browser")
    driver = shutil.which("chromedriver")
    if (program is None or driver is None) and "DUALTAXI_CI" not in os.environ:
        pytest.skip("needs Debian's chromium and chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    for argument in ARGUMENTS:
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    with webdriver.Chrome(options=options, service=Service(driver)) as started:
        yield started


@pytest.fixture(scope="module")
def browser(chromium):
    """Return Chromium as if just started: no page open, no cookies, empty logs."""
    chromium.get("about:blank")  # the last page still asks the server of another module, which has ended
    chromium.execute_cdp_cmd("Network.clearBrowserCookies", {})
    for log in ("browser", "performance"):
        chromium.get_log(log)
    return chromium
