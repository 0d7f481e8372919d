"""Starts Chromium for tests of pages."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

import pytest

if TYPE_CHECKING:
    from selenium import webdriver

ARGUMENTS: Final = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--window-size=1300,1000",
    "--enable-unsafe-swiftshader",  # WebGL without a graphics card
)


def chromium_programs() -> tuple[str | None, str | None]:
    """Return the paths of Chromium and its driver; skip the test where they are not installed."""
    names = ("chromium-headless-shell", "chromium", "chromium-browser")  # the first needs a fifth less time
    program = next(filter(None, map(shutil.which, names)), None)
    driver = shutil.which("chromedriver")
    if (program is None or driver is None) and "DUALTAXI_CI" not in os.environ:
        pytest.skip("needs Debian's chromium and chromium-driver")
    return program, driver


@contextlib.contextmanager
def chromium() -> Iterator[webdriver.Chrome]:
    """Start Chromium, whose log holds its requests and errors; skip the test where it is not installed."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    program, driver = chromium_programs()
    options = webdriver.ChromeOptions()
    options.binary_location = program
    for argument in ARGUMENTS:
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    with webdriver.Chrome(options=options, service=Service(driver)) as browser:
        yield browser
