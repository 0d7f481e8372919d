"""What all tests share: an own cache folder, drawing without a display, properties without deadlines."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

from runner.service.processes import PRELOADED
from runner.util.processes import process_context

gc.set_threshold(50_000)  # as the command line does it, for the imports of all test modules too
hypothesis.settings.register_profile(
    "untimed", deadline=None, max_examples=40
)  # a loaded machine is no reason to fail
hypothesis.settings.load_profile("untimed")
if sys.platform == "linux":
    os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo reads it when it is imported
process_context(
    (*PRELOADED, "runner.service.app")
)  # as the service does it; else each of its children would import them itself
os.environ["DUALTAXI_CODE"] = "off"  # thousands of runs need not ask git; tests of the user's code turn it on


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the long tests: the last ones to begin are short, so that no worker waits for another."""
    items.sort(key=lambda item: item.get_closest_marker("long") is None)


def pytest_collection_finish() -> None:
    """Leave what the collected tests consist of, millions of objects, out of every search for garbage."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep what the tests leave behind out of the user's cache, and the user's key out of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("XDG_DATA_HOME", str(tmp_path_factory.mktemp("data")))
        yield


@pytest.fixture
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the test in a folder of its own: MuJoCo and MLflow write into the current one."""
    monkeypatch.chdir(tmp_path)
