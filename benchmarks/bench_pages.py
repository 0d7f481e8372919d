"""Time until a browser shows a page, whole, and the first picture of an episode; memory of the service."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import httpx2
import yaml

from benchmarks.bench_catalogue import LISTED, many, one_run
from benchmarks.figures import Figure, figure
from benchmarks.serving import memory_of, percentile, response_times, serving
from runner.service.pictures import IDLE_SECONDS
from runner.util.files import CACHE_VARIABLE

COLD: Final = (1000, 300)
"""Targets in milliseconds: at least, and aim."""
RUN_PAGE: Final = (50, 20)
WHOLE_RUN: Final = (1000, 500)
WHOLE_SWEEP: Final = (3000, 1000)
GROWTH: Final = (10, 5)
"""Targets in percent: at least, and aim."""
PAGES: Final = 1000
CARTPOLE: Final = (1000, 400)
PONG: Final = (2000, 1000)
MEMORY: Final = (500, 300)
"""Targets in MB: at least, and aim."""
LAST_PART: Final = """
const last = Math.max(...performance.getEntries().map((entry) => entry.responseEnd || 0));
return performance.now() - last > 1000 && last;
"""
"""When the last answer came, in milliseconds since the page was requested, once none came for a second."""
LOADED: Final = "return performance.getEntriesByType('navigation')[0].loadEventEnd"
PICTURED: Final = """
document.addEventListener("load", ({ target }) => {
  if (target.matches?.("img.frame")) window.pictured ??= performance.now();
}, true);
"""
"""Keeps the time of the first picture, in milliseconds since the page was requested."""


def measure(quick: bool) -> list[Figure]:
    """Return the milliseconds until a page is loaded, or its first picture shown, each in a new browser."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {CACHE_VARIABLE: f"{folder}/cache"}
        job = one_run(Path(folder, "one"))
        recordings = many(job, Path(folder, "many"), LISTED, recordings=False)
        with serving(recordings, environment=environment) as service:
            response_times(service, ["/api/v1/runs"], clients=1, seconds=0.5)
            times = [_loaded(f"{service.url}/runs") for _ in range(3 if quick else 7)]
        detail = f"{LISTED:,} runs; Chromium with an empty cache, until completely loaded"
        found = [figure("first page, cold", times, "ms", COLD, higher_is_better=False, detail=detail)]
        found += _pages_of_runs(job.parent, [job.name, "loop"], environment, 1 if quick else 5)
        return found + _pictures(Path(folder, "loops"), environment, range(1 if quick else 5))


def _pages_of_runs(
    recordings: Path, runs: list[str], environment: dict[str, str], seconds: float
) -> list[Figure]:
    """Return the milliseconds until a client has the page of a run, of a job and of a loop."""
    _record(recordings, "loop", _cartpole, 60)
    trials = 10 if seconds < 2 else 100
    _sweep(recordings, trials)
    with serving(recordings, environment=environment) as service:
        pages = [f"/runs/{run}" for run in runs]
        milliseconds = [1000 * taken for taken in response_times(service, pages, clients=1, seconds=seconds)]
        whole = [_last_part(f"{service.url}{page}") for page in pages for _ in range(3)]
        study = [_last_part(f"{service.url}/sweeps/sweep") for _ in range(3)]
        before = memory_of(service.process)
        with httpx2.Client(base_url=service.url) as client:
            for k in range(PAGES):
                client.get(pages[k % len(pages)]).raise_for_status()
        growth = 100 * (memory_of(service.process) / before - 1)
    detail = "a job and a loop in turn, one client"
    return [
        figure("page of a run", milliseconds, "ms", RUN_PAGE, higher_is_better=False, detail=detail),
        figure("  99th percentile", [percentile(milliseconds, 99)], "ms", RUN_PAGE, higher_is_better=False),
        figure("  its last part", whole, "ms", WHOLE_RUN, higher_is_better=False, detail="in Chromium"),
        figure(
            f"page of a sweep of {5 * trials} runs, its last part",
            study,
            "ms",
            WHOLE_SWEEP,
            higher_is_better=False,
        ),
        figure(
            f"growth of the server's memory by {PAGES:,} pages", [growth], "%", GROWTH, higher_is_better=False
        ),
    ]


def _sweep(recordings: Path, trials: int) -> None:
    """Run a sweep of short runs, five of each trial."""
    evaluation = {"every": 50, "trials": 10}
    values = {
        "name": "sweep",
        "base": {"env": {"id": "FrozenLake-v1"}, "episodes": 100, "evaluation": evaluation},
        "strategy": "random",
        "trials": trials,
        "parameters": {"step_size": {"low": 0.01, "high": 1.0}, "discount": {"low": 0.9, "high": 0.999}},
        "seeds": {"count": 5},
    }
    file = recordings.with_name("sweep.yaml")
    file.write_text(yaml.safe_dump(values), encoding="utf-8")
    words = ["sweep", "run", str(file), "--workers", "2", "--recordings", str(recordings)]
    subprocess.run([sys.executable, "-m", "runner", *words], capture_output=True, check=True)


def _pictures(recordings: Path, environment: dict[str, str], repetitions: range) -> list[Figure]:
    """Return the milliseconds until the first picture of an episode without recorded frames."""
    _record(recordings, "cartpole", _cartpole, 60)
    _record(recordings, "pong", _pong, 1 + len(repetitions))
    found, memory = [], 0.0
    with serving(recordings, environment=environment) as service:
        for name, target in (("cartpole", CARTPOLE), ("pong", PONG)):
            addresses = [f"{service.url}/runs/{name}/replay/train/{1 + i}" for i in repetitions]
            _pictured(f"{service.url}/runs/{name}/replay/train/0")  # once to warm up
            memory = memory_of(service.process)
            times = [_pictured(address) for address in addresses]
            title = f"first picture of an episode, {name}"
            detail = "no frames recorded: the environment is made again in a new process; empty cache"
            found.append(figure(title, times, "ms", target, higher_is_better=False, detail=detail))
            time.sleep(IDLE_SECONDS + 1)  # until the processes of these pages have ended
    detail = "the service while a page shows pictures of Pong, with the process that draws them"
    used = figure("memory with pictures", [memory], "MB", MEMORY, higher_is_better=False, detail=detail)
    return [*found, used]


def _record(recordings: Path, name: str, make: Callable[[], Any], episodes: int) -> None:
    import runner

    with runner.record(make(), recordings, name=name, seed=1) as env:
        env.action_space.seed(1)
        for episode in range(episodes):
            env.reset(seed=1 if episode == 0 else None)
            over = False
            while not over:
                *_, terminated, truncated, _ = env.step(env.action_space.sample())
                over = terminated or truncated


def _cartpole() -> Any:
    import gymnasium

    return gymnasium.make("CartPole-v1")


def _pong() -> Any:
    import ale_py
    import gymnasium
    from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation

    gymnasium.register_envs(ale_py)
    return FrameStackObservation(AtariPreprocessing(gymnasium.make("ALE/Pong-v5", frameskip=1)), 4)


def _loaded(address: str) -> float:
    with _browser() as driver:
        driver.get(address)
        return _waited(driver, LOADED)


def _last_part(address: str) -> float:
    with _browser() as driver:
        driver.get(address)
        return _waited(driver, LAST_PART)


def _pictured(address: str) -> float:
    with _browser() as driver:
        driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": PICTURED})
        driver.get(address)
        return _waited(driver, "return window.pictured")


def _waited(driver: Any, script: str) -> float:
    from selenium.webdriver.support.ui import WebDriverWait

    return float(WebDriverWait(driver, 60).until(lambda d: d.execute_script(script)))


@contextlib.contextmanager
def _browser() -> Iterator[Any]:
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or shutil.which("chromium-browser") or ""
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver") or ""))
    try:
        yield driver
    finally:
        driver.quit()
