"""Fixtures of the service's tests: some runs, and a client of an application for them."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import yaml
from loop_replays import record_loops, serving
from served import Served
from starlette.testclient import TestClient
from uploading import start

import runner
from runner.client.outbox import outbox_folder
from runner.service.app import create_app
from runner.service.settings import ServiceSettings
from runner.service.uploads import Uploads

if TYPE_CHECKING:
    from selenium import webdriver

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recordings folder with two small runs that differ in their seed, `first` and `second`."""
    folder = tmp_path_factory.mktemp("recorded")
    config = yaml.safe_load((ROOT / "configs" / "quick.yaml").read_text(encoding="utf-8"))
    config |= {"episodes": 60, "seeds": 1, "evaluation": {"every": 10, "trials": 20}}
    config["env"] = {
        "kwargs": {"max_episode_steps": 300}
    }  # most trials of so short a training last that long
    for seed, name in enumerate(("first", "second")):
        runner.run(config | {"name": name}, seed=seed, recordings=folder)
    return folder


@pytest.fixture(scope="session")
def loops(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recordings folder with the loops of `record_loops`, not to be changed."""
    folder = tmp_path_factory.mktemp("loops") / "recordings"
    record_loops(folder)
    return folder


@pytest.fixture(scope="module")
def loops_client(loops: Path) -> Iterator[TestClient]:
    """Return a client of a service for those loops."""
    with serving(loops) as client:
        yield client


@pytest.fixture
def recordings(recorded: Path, tmp_path: Path) -> Path:
    """Return a copy of those runs, to be changed at will."""
    return Path(shutil.copytree(recorded, tmp_path / "recordings"))


@pytest.fixture
def settings(recordings: Path, tmp_path: Path) -> ServiceSettings:
    return ServiceSettings(recordings=(recordings,), tokens=tmp_path / "tokens.json")


@pytest.fixture
def connect() -> Iterator[Callable[..., TestClient]]:
    """Return a function that connects a client to a service; by default as a page of its own."""
    opened = []

    def make(settings: ServiceSettings, **headers: str) -> TestClient:
        client = TestClient(
            create_app(settings),
            base_url="http://localhost",
            headers=headers or {"Origin": "http://localhost"},
            raise_server_exceptions=False,
        )
        opened.append(client)
        return client.__enter__()

    yield make
    for client in opened:
        client.__exit__(None, None, None)


@pytest.fixture
def client(connect: Callable[..., TestClient], settings: ServiceSettings) -> TestClient:
    """Return a client of a service over those runs."""
    return connect(settings)


@pytest.fixture
def page(browser: webdriver.Chrome, served: str) -> Iterator[Callable[[str], webdriver.Chrome]]:
    """Return a function that opens a page of the service `served`.

    Afterwards there must be no error, except for a configuration that is wrong, and no request elsewhere.
    """
    browser.get("about:blank")  # leaves the page of another test, of another service
    for kind in ("browser", "performance"):
        browser.get_log(kind)

    def open_page(address: str) -> webdriver.Chrome:
        browser.get(served + address)
        return browser

    yield open_page
    wrong = [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
    assert [each for each in wrong if not ("/submit" in each and " 422 " in each)] == []
    log = " ".join(entry["message"] for entry in browser.get_log("performance"))
    requested = set(re.findall(r'"url":"(\w+://[^"/]+)', log))
    assert {address for address in requested if address.startswith(("http", "ws"))} <= {served}


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Return a server that receives runs; not to be stopped."""
    with Served(tmp_path_factory.mktemp("server") / "runs") as started:
        yield started


@pytest.fixture(scope="session")
def served_folder(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recordings folder that `served` serves: copies of the two runs, to be marked at most."""
    return Path(shutil.copytree(recorded, tmp_path_factory.mktemp("served") / "recordings"))


@pytest.fixture(scope="session")
def served(served_folder: Path) -> Iterator[str]:
    """Return the address of a service in a process of its own."""
    with Served(served_folder) as started:
        yield started.url
    assert "Traceback" not in started.log.read_text()


@pytest.fixture
def own_server(tmp_path: Path) -> Iterator[Served]:
    """Return a server that may be killed; it is not started yet."""
    made = Served(tmp_path / "theirs")
    yield made
    made.stop()


@pytest.fixture
def outbox(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the outbox of this user, who has no token and no server."""
    for name in ("DUALTAXI_TOKEN", "DUALTAXI_TOKEN_FILE", "DUALTAXI_SERVER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return outbox_folder()


@pytest.fixture
def uploads(tmp_path: Path) -> Iterator[Uploads]:
    """Return the uploads of a service without runs."""
    made = start(tmp_path / "runs", spare_bytes=0)
    yield made
    made.close()
