"""Time until a browser with an empty cache shows the first page, with ten thousand runs."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Final

from benchmarks.bench_catalogue import LISTED, many, one_run
from benchmarks.figures import Figure, figure
from benchmarks.serving import response_times, serving
from runner.util.files import CACHE_VARIABLE

COLD: Final = (1000, 300)
"""Targets in milliseconds: at least, and aim."""
LOADED: Final = "return performance.getEntriesByType('navigation')[0].loadEventEnd"


def measure(quick: bool) -> list[Figure]:
    """Return the milliseconds until the page is loaded, each time in a new browser."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {CACHE_VARIABLE: f"{folder}/cache"}
        recordings = many(one_run(Path(folder, "one")), Path(folder, "many"), LISTED, recordings=False)
        with serving(recordings, environment=environment) as service:
            response_times(service, ["/api/v1/runs"], clients=1, seconds=0.5)
            times = [_loaded(f"{service.url}/runs") for _ in range(3 if quick else 7)]
    detail = f"{LISTED:,} runs; Chromium with an empty cache, until completely loaded"
    return [figure("first page, cold", times, "ms", COLD, higher_is_better=False, detail=detail)]


def _loaded(address: str) -> float:
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service
    from selenium.webdriver.support.ui import WebDriverWait

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or shutil.which("chromium-browser") or ""
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver") or ""))
    try:
        driver.get(address)
        whole = WebDriverWait(driver, 60).until(lambda d: d.execute_script(LOADED))
        return float(whole)
    finally:
        driver.quit()
