"""Views and exports of installed packages: commands, routes and pages, as docs/plugins.md describes them."""

import functools
import json
import multiprocessing
import os
import re
import subprocess
import sys
from pathlib import Path

import httpx2
import pytest

import runner
from tests.runner.service.served import Served

pytestmark = pytest.mark.long

get = functools.partial(httpx2.get, timeout=60)
DOCS = Path(__file__).parents[2] / "docs" / "plugins.md"


@pytest.fixture
def environment(tmp_path, monkeypatch):
    """Install the package of the docs into a folder that Python looks at."""
    project, module = re.findall(r"```(?:toml|python)\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)
    site = tmp_path / "site"
    metadata = site / "long_episodes-1.0.dist-info"
    metadata.mkdir(parents=True)
    (site / "long_episodes.py").write_text(module)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: long-episodes\nVersion: 1.0\n")
    points = re.findall(r'entry-points\."(.*?)"\]\n(\w+) = "(.*?)"', project)
    (metadata / "entry_points.txt").write_text(
        "".join(f"[{group}]\n{name} = {value}\n" for group, name, value in points)
    )
    monkeypatch.syspath_prepend(site)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(site), *sys.path[1:]]))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return site


@pytest.fixture
def run(tmp_path):
    return runner.run("quick", overrides=["episodes=50", "evaluation=null"], recordings=tmp_path / "runs")


def dualtaxi(*words, code=0):
    done = subprocess.run(
        [sys.executable, "-m", "runner", *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == code, done.stderr
    return done.stdout if code == 0 else done.stderr


def test_an_installed_view_and_export_are_commands(environment, run, tmp_path):
    with runner.open_recording(run.recording) as recording:
        lengths = recording.train.episodes.array()["length"].tolist()
    assert re.search(r"longest +From the package long-episodes", dualtaxi("--help"))
    assert re.search(r"lengths +From the package long-episodes", dualtaxi("export", "--help"))
    assert "--count N" in dualtaxi("longest", "--help")
    answer = json.loads(dualtaxi("longest", str(run.folder), "--count", "3", "--json"))["lengths"]
    assert sorted(answer.values()) == sorted(lengths)[-3:]
    assert "| episode | steps |" in dualtaxi("longest", str(run.folder), "--markdown")
    file = tmp_path / "out.txt"
    dualtaxi("export", "lengths", str(run.folder), "-o", str(file))
    assert [int(line) for line in file.read_text().split()] == lengths
    assert "exists already" in dualtaxi("export", "lengths", str(run.folder), "-o", str(file), code=2)


def test_an_installed_view_and_export_are_served(environment, run):
    with Served(run.folder.parent, context=multiprocessing.get_context("spawn")) as served:
        address = f"/runs/{run.run_id}"
        page = get(f"{served.url}{address}/longest?count=2").raise_for_status().text
        assert page.count(f'href="{address}/replay/train/') == 2
        assert f'href="{address}/longest"' in get(f"{served.url}{address}").text
        api = f"{served.url}/api/v1{address}"
        assert len(get(f"{api}/longest?count=2").json()["lengths"]) == 2
        file = get(f"{api}/exports/lengths").raise_for_status()
        assert len(file.text.split()) == 50
        assert file.headers["content-disposition"].endswith(".txt")
        assert f'href="/api/v1{address}/exports/lengths"' in get(f"{served.url}{address}/config").text
        assert get(f"{api}/exports/others").status_code == 404


def test_an_installed_view_may_be_a_command_of_a_group(environment, run):
    with (environment / "long_episodes.py").open("a") as module:
        module.write(
            "def names(sweep):\n    return Longest({sweep[0]: len(sweep)})\n"
            'NAMES = View("sweep names", "Names", names, subject="sweep")\n'
        )
    points = environment / "long_episodes-1.0.dist-info" / "entry_points.txt"
    points.write_text(
        "[dualtaxi.views]\nsweep names = long_episodes:NAMES\nsweep run = long_episodes:NAMES\n"
    )
    assert re.search(r"ls +List .*\n +names +From the package long-episodes", dualtaxi("sweep", "--help"))
    assert json.loads(dualtaxi("sweep", "names", "small", "--json"))["lengths"] == {"small": 2}
    assert "--dry-run" in dualtaxi("sweep", "run", "--help")


def test_a_plugin_that_cannot_be_used_is_named(environment, run):
    module = environment / "long_episodes.py"
    module.write_text("import no_such_module")
    message = dualtaxi("longest", str(run.folder), code=2)
    assert "longest: long_episodes:LONGEST of the package long-episodes cannot be imported" in message
    module.write_text("LONGEST = LENGTHS = 3  # Python compiles a file again if its size differs")
    message = dualtaxi("longest", str(run.folder), code=2)
    assert (
        "longest: found 3 at long_episodes:LONGEST of the package long-episodes, expected a View" in message
    )
    assert "long-episodes" in dualtaxi("--help")


def test_names_that_are_shipped_stay(environment, run):
    points = environment / "long_episodes-1.0.dist-info" / "entry_points.txt"
    points.write_text("[dualtaxi.views]\nwhen = long_episodes:LONGEST\n")
    assert "From the package" not in dualtaxi("--help")
    assert "EXPRESSION" in dualtaxi("when", "--help")
    with Served(run.folder.parent, context=multiprocessing.get_context("spawn")) as served:
        get(f"{served.url}/runs/{run.run_id}/when").raise_for_status()
