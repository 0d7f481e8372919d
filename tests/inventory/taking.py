"""Takes the inventory of pages, commands, routes and names over the folder of `fixture`."""

from __future__ import annotations

import base64
import contextlib
import itertools
import os
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Final, Self

import pytest
from selenium.webdriver.remote.webdriver import WebDriver

from runner.debugging.explanation import explanations_in
from runner.runs.run import UNLISTED, list_runs
from runner.service.app import create_app
from runner.service.settings import ServiceSettings
from tests.inventory.fixture import make_runs, same_everywhere
from tests.inventory.forms import ADDRESSES, COMMANDS, REPORTS, ROUTE_RUNS, ROUTES
from tests.inventory.reading import (
    COUNT_REQUESTS,
    Lines,
    Mask,
    key_paths,
    read_command,
    read_help,
    read_names,
    read_page,
)
from tests.runner.service.served import Served
from tests.waiting import until

ENVIRONMENT: Final = {"DUALTAXI_CODE": "off", "MUJOCO_GL": "egl", "COLUMNS": "200", "NO_COLOR": "1"}
CLOSE: Final = """
for (const node of document.querySelectorAll("details[data-was-closed]")) node.open = false;
return document.body.scrollHeight;
"""
"""Closes what was opened to be read; returns the height of the page."""
WINDOW: Final = {"width": 1440, "height": 8000, "deviceScaleFactor": 0.1, "mobile": False}
"""Shows whole pages, drawn small: nobody looks at them, and drawing takes long."""
WIDTHS: Final = (1440, 390)
THEMES: Final = ("light", "dark")


class Shop(contextlib.ExitStack):
    """A folder with runs of every kind, and a service over it; a context manager."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder
        self.recordings = folder / "recordings"
        self.out = folder / "out"

    def __enter__(self) -> Self:
        super().__enter__()
        self.out.mkdir(parents=True)
        patch = self.enter_context(pytest.MonkeyPatch.context())
        for name in ("XDG_CACHE_HOME", "XDG_DATA_HOME", "XDG_CONFIG_HOME", "XDG_STATE_HOME"):
            patch.setenv(name, str(self.folder / name))
        for name, value in ENVIRONMENT.items():
            patch.setenv(name, value)
        self.enter_context(same_everywhere())
        self.runs = make_runs(self.recordings)
        (explanation,) = explanations_in(self.recordings)
        self.pair = explanation.split("/")[0]
        self.served = self.enter_context(Served(self.recordings))
        self.served.post("/jobs", "name: queued\nmode: cooperative\nepisodes: 20\nseed: 0\n")
        self.served.until(lambda jobs: jobs[1]["state"] == "finished", 600)
        until(
            bool,
            lambda: self.served.get("/runs?filter=name == 'queued' and status == 'finished'")["runs"],
            600,
        )
        patch.setenv("DUALTAXI_RECORDINGS", str(self.recordings))
        return self

    @property
    def mask(self) -> Mask:
        """What masks the ids of all runs that there are now, folders, and the explanation's name."""
        folders = (self.recordings, self.recordings / UNLISTED)
        ids = {run.run_id: f"RUN-{run.name}" for folder in folders for run in list_runs(folder)}
        names = {run.run_id: name.upper() for name, run in self.runs.items()}
        paths = {
            os.environ["XDG_CACHE_HOME"]: "CACHE",
            str(self.folder): "FOLDER",
            str(Path.cwd()): "CURRENT",
        }
        return Mask({self.pair: "PAIR"} | paths | ids | names)

    def filled(self, text: str) -> str:
        """Return an address or command with the ids of runs in place of their names in braces."""
        for name, run in self.runs.items():
            text = text.replace(f"{{{name}}}", run.run_id)
        words = {
            "pair": self.pair,
            "files": self.folder,
            "out": self.out,
            "url": self.served.url,
        }
        for name, word in words.items():
            text = text.replace(f"{{{name}}}", str(word))
        return text

    @property
    def addresses(self) -> dict[str, str]:
        """The pages: their addresses, as inventoried -> as the browser opens them."""
        files = {name: f"file://{self.folder / name}" for name in REPORTS}
        return {page: self.served.url + self.filled(page) for page in ADDRESSES} | files


def take_pages(shop: Shop, browser: WebDriver) -> Lines:
    """Return what every page shows."""
    _prepare(shop, browser)
    mask = shop.mask
    return {page: read_page(browser, address, mask) for page, address in shop.addresses.items()}


def _prepare(shop: Shop, browser: WebDriver) -> None:
    """Write the pages that commands write, and let the browser count requests and show whole pages."""
    for name, words in REPORTS.items():
        lines = read_command(shlex.split(shop.filled(f"{words} {shop.folder / name}")), lambda: shop.mask)
        assert (shop.folder / name).exists(), lines
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", WINDOW)
    browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": COUNT_REQUESTS})


def take_commands(shop: Shop, _: WebDriver) -> Lines:
    """Return the help of every command, and what typical ones print."""
    typed = {
        f"dualtaxi {words}".strip(): read_command(shlex.split(shop.filled(words)), lambda: shop.mask)
        for words in COMMANDS
    }
    return read_help() | typed


def take_routes(shop: Shop, _: WebDriver) -> Lines:
    """Return every route with its parameters, and the keys of JSON answers."""
    settings = ServiceSettings(recordings=(shop.recordings,), tokens=shop.folder / "tokens.json")
    described = create_app(settings).openapi()["paths"]
    routes: Lines = {
        f"{method.upper()} {path}": sorted(
            f"parameter: {each['name']} in {each['in']}" for each in route.get("parameters", ())
        )
        for path, methods in described.items()
        for method, route in methods.items()
    }
    for route in ROUTES:
        for name in ROUTE_RUNS if "{run}" in route else ("",):
            asked = route.replace("{run}", f"{{{name}}}")
            answer = shop.served.client.get(shop.filled(asked))
            keys = shop.mask.lines(f"key: {path}" for path in key_paths(answer.json()))
            routes[f"GET /api/v1{asked}"] = [f"status {answer.status_code}", *keys]
    return routes


def take_names(_: Shop, __: WebDriver) -> Lines:
    """Return the public names of the package."""
    return read_names()


FILES: Final[dict[str, Callable[[Shop, WebDriver], Lines]]] = {
    "pages.txt": take_pages,
    "routes.txt": take_routes,
    "names.txt": take_names,
    "commands.txt": take_commands,  # which records runs, so it comes last
}
"""The files of the inventory, and what takes the lines of each."""


def screenshots(shop: Shop, browser: WebDriver, folder: Path) -> None:
    """Write a picture of every page, at most 4000 pixels of it, wide and narrow, light and dark."""
    folder.mkdir(parents=True, exist_ok=True)
    _prepare(shop, browser)
    mask = shop.mask
    for theme, width in itertools.product(THEMES, WIDTHS):
        features = [{"name": "prefers-color-scheme", "value": theme}]
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        metrics = {"width": width, "height": 4000, "deviceScaleFactor": 1, "mobile": width < 500}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        for number, (page, address) in enumerate(shop.addresses.items()):
            read_page(browser, address, mask)
            name = "".join(letter if letter.isalnum() else "-" for letter in page).strip("-") or "home"
            height = browser.execute_script(CLOSE)
            clip = {"x": 0, "y": 0, "width": width, "height": min(height, 4000), "scale": 1}
            shot = browser.execute_cdp_cmd("Page.captureScreenshot", {"clip": clip})
            file = folder / f"{number:02}-{name}-{width}-{theme}.png"
            file.write_bytes(base64.b64decode(shot["data"]))
