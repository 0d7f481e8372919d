"""No process imports a file of the current folder, whatever it is called."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import gymnasium
import pytest

import runner

pytestmark = pytest.mark.long

DEPENDENCIES = """
    PIL av blake3 click cloudpickle dualtaxi fastapi filelock google gymnasium isal jinja2 llvmlite lz4
    matplotlib mcap msgspec numba numpy optuna platformdirs psutil pyarrow pydantic pygame rich runner scipy
    sitecustomize sklearn typing_extensions usercustomize uvicorn yaml zstandard
"""
HOSTILE = """\
import pathlib
pathlib.Path({folder!r}, "IMPORTED").open("a").write(__name__ + "\\n")
raise RuntimeError(__name__)
"""
SWEEP = """\
base: {name: icy, env: {id: FrozenLake-v1}, episodes: 20, evaluation: {every: 10, trials: 2}}
strategy: grid
objective: {metric: mean_return}
parameters: {discount: [0.9, 0.8]}
seeds: [0]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a file named like each module of Python and each dependency."""
    folder = tmp_path_factory.mktemp("hostile")
    for name in {*sys.stdlib_module_names, *DEPENDENCIES.split()}:
        (folder / f"{name}.py").write_text(HOSTILE.format(folder=str(folder)))
    return folder


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    with runner.record(gymnasium.make("CartPole-v1"), folder, name="pole") as env:
        env.reset(seed=1)
        while not any(env.step(0)[2:4]):
            pass
    return folder


def dualtaxi(folder, recordings, *words):
    """Return how to start the installed command in a folder."""
    program = Path(sys.executable).with_name("dualtaxi")
    start = [program] if program.exists() else [sys.executable, "-P", "-m", "runner"]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONSAFEPATH"}
    environment |= {"DUALTAXI_RECORDINGS": str(recordings)}
    return {"args": [*start, *map(str, words)], "cwd": folder, "env": environment}


def imported(folder):
    with contextlib.suppress(FileNotFoundError):
        return (folder / "IMPORTED").read_text().split()
    return []


def test_commands_with_child_processes_import_nothing_from_the_current_folder(folder, recordings, tmp_path):
    (tmp_path / "sweep.yaml").write_text(SWEEP)
    for words in (
        ("verify", "pole"),
        ("branch", "pole", "--at", "0:1", "--action", "0", "--policy", "random"),
        ("report", "pole", "-o", tmp_path / "report.html"),
        ("sweep", "run", tmp_path / "sweep.yaml", "--workers", "2"),
    ):
        done = subprocess.run(
            **dualtaxi(folder, recordings, *words), capture_output=True, text=True, check=False, timeout=120
        )
        assert imported(folder) == [], words
        assert done.returncode == 0, done.stdout + done.stderr


def requested(url, data=None):
    request = urllib.request.Request(url, data, {"Origin": url.partition("/api")[0]})
    with urllib.request.urlopen(request, timeout=60) as answer:
        return answer.read()


def test_a_server_and_its_jobs_import_nothing_from_the_current_folder(folder, recordings):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    api = f"http://127.0.0.1:{port}/api/v1"
    with subprocess.Popen(
        **dualtaxi(folder, recordings, "serve", "--port", port), stderr=subprocess.DEVNULL
    ) as server:
        try:
            deadline = time.monotonic() + 60
            while time.monotonic() < deadline:
                with contextlib.suppress(urllib.error.URLError, ConnectionError):
                    requested(f"http://127.0.0.1:{port}/readyz")
                    break
                time.sleep(0.1)
            runs = json.loads(requested(f"{api}/runs"))["runs"]
            run = next(run["run_id"] for run in runs if run["name"] == "pole")
            pictures = requested(f"{api}/runs/{run}/replay/train/0/pictures?start=0&steps=3")
            begin = 4 + int.from_bytes(pictures[:4], "big")
            assert pictures[begin : begin + 3] in (b"\xff\xd8\xff", b"\x89PN")
            config = {"name": "icy", "env": {"id": "FrozenLake-v1"}, "episodes": 20}
            number = json.loads(requested(f"{api}/jobs", json.dumps(config).encode()))["number"]
            while json.loads(requested(f"{api}/jobs/{number}"))["state"] in ("queued", "running"):
                assert time.monotonic() < deadline
                time.sleep(0.1)
            assert json.loads(requested(f"{api}/jobs/{number}"))["state"] == "finished"
        finally:
            server.terminate()
            server.wait(30)
    assert imported(folder) == []


@pytest.mark.parametrize("start", [["-c", "import main_of_ours"], ["-m", "main_of_ours"]])
def test_the_folder_that_python_puts_first_is_not_handed_to_children(start, tmp_path):
    (tmp_path / "only_here.py").write_text("")
    (tmp_path / "main_of_ours.py").write_text(
        "import importlib.util\n"
        "from runner.util.processes import ChildProcess\n"
        "assert importlib.util.find_spec('only_here')\n"
        "with ChildProcess(10**9) as child:\n"
        "    print(child.call(importlib.util.find_spec, 30, 'only_here'))\n"
    )
    done = subprocess.run(
        [sys.executable, *start], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.stdout == "None\n", done.stderr
