"""Takes the inventory of pages, commands, routes and names over the folder of `fixture`."""

from __future__ import annotations

import base64
import contextlib
import os
import shlex
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, Self

from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.remote.webdriver import WebDriver

from runner.debugging.explanation_files import explanations_in
from runner.runs.listing import list_runs
from runner.runs.run import UNLISTED
from runner.service.app import create_app
from runner.service.settings import Settings
from tests.inventory.fixture import make_runs
from tests.inventory.forms import COMMANDS, PAGES, ROUTE_RUNS, ROUTES, RUN_PAGES
from tests.inventory.reading import (
    Lines,
    Mask,
    key_paths,
    read_command,
    read_help,
    read_names,
    read_page,
)
from tests.runner.service.served import Served

WIDTHS: Final = (1440, 390)
THEMES: Final = ("light", "dark")


class Shop:
    """The folder of runs, and a service over it; a context manager."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.recordings = folder / "recordings"
        self.out = folder / "out"

    def __enter__(self) -> Self:
        self.out.mkdir(parents=True)
        self.runs = make_runs(self.recordings)
        (self.explanation,) = explanations_in(self.recordings)
        self.served = Served(self.recordings)
        self.served.start()
        config = "name: queued\nmode: cooperative\nepisodes: 20\nseed: 0\n"
        self.served.post("/jobs", config)
        self.served.until(lambda jobs: jobs[1]["state"] == "finished")
        return self

    def __exit__(self, *_: object) -> None:
        self.served.stop()

    @property
    def mask(self) -> Mask:
        """What masks the ids of all runs that there are now, folders, and the explanation's name."""
        folders = (self.recordings, self.recordings / UNLISTED, self.out / "branches")
        ids = {run.run_id: f"RUN-{run.name}" for folder in folders for run in list_runs(folder)}
        names = {run.run_id: name.upper() for name, run in self.runs.items()}
        caches = {os.environ.get("XDG_CACHE_HOME", "-"): "CACHE"}
        paths = caches | {str(self.folder): "FOLDER", str(Path.cwd()): "CURRENT"}
        explanation = {self.explanation: "EXPLANATION", self.explanation.split("/")[0]: "EXPLANATION"}
        return Mask(explanation | paths | ids | names)

    def filled(self, text: str) -> str:
        """Return an address or command with the ids of runs in place of their names in braces."""
        for name, run in self.runs.items():
            text = text.replace(f"{{{name}}}", run.run_id)
        return text.replace("{explanation}", self.explanation).replace("{out}", str(self.out))

    @property
    def addresses(self) -> dict[str, str]:
        """The pages: their addresses, as inventoried -> as the browser opens them."""
        pages = {page: self.filled(page) for page in PAGES}
        for ending, names in RUN_PAGES.items():
            pages |= {
                f"/runs/{{{name}}}{ending}": f"/runs/{self.runs[name].run_id}{ending}" for name in names
            }
        pages["/queue/1"] = "/queue/1"
        return pages


@contextlib.contextmanager
def chromium() -> Iterator[WebDriver]:
    """Start a browser."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or "chromium"
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1440,8000"):
        options.add_argument(argument)
    with webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver"))) as browser:
        yield browser


def take_pages(shop: Shop, browser: WebDriver) -> Lines:
    """Return what every page shows."""
    mask = shop.mask
    return {
        page: read_page(browser, shop.served.url + address, mask) for page, address in shop.addresses.items()
    }


def take_commands(shop: Shop, _: WebDriver) -> Lines:
    """Return the help of every command, and what typical ones print."""
    before = {name: os.environ.get(name) for name in ("DUALTAXI_RECORDINGS", "COLUMNS", "NO_COLOR")}
    os.environ |= {"DUALTAXI_RECORDINGS": str(shop.recordings), "COLUMNS": "200", "NO_COLOR": "1"}
    try:
        typed = {
            f"dualtaxi {words}": read_command(shlex.split(shop.filled(words)), lambda: shop.mask)
            for words in COMMANDS
        }
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)
    return read_help() | typed


def take_routes(shop: Shop, _: WebDriver) -> Lines:
    """Return every route with its parameters, and the keys of JSON answers."""
    settings = Settings(recordings=(shop.recordings,), tokens=shop.folder / "tokens.json")
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
    """Write a picture of every page, wide and narrow, light and dark."""
    folder.mkdir(parents=True, exist_ok=True)
    for theme in THEMES:
        features = [{"name": "prefers-color-scheme", "value": theme}]
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        for width in WIDTHS:
            metrics = {"width": width, "height": 1000, "deviceScaleFactor": 1, "mobile": width < 500}
            browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
            for number, (page, address) in enumerate(shop.addresses.items()):
                read_page(browser, shop.served.url + address, shop.mask)
                name = "".join(letter if letter.isalnum() else "-" for letter in page).strip("-") or "home"
                height = browser.execute_script("return document.documentElement.scrollHeight")
                clip = {"x": 0, "y": 0, "width": width, "height": min(height, 4000), "scale": 1}
                shot = browser.execute_cdp_cmd(
                    "Page.captureScreenshot", {"clip": clip, "captureBeyondViewport": True}
                )
                file = folder / f"{number:02}-{name}-{width}-{theme}.png"
                file.write_bytes(base64.b64decode(shot["data"]))
