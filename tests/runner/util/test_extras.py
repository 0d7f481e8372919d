"""A missing package is installed by a command that fits how the project was installed."""

from __future__ import annotations

import json
import sys
from importlib import metadata
from pathlib import Path

import pytest

from runner.errors import MissingExtra
from runner.util import extras

CLONE = Path(extras.__file__).parents[1]


class Installed:
    """A distribution that says what it was installed from."""

    version = "1.2.3"

    def __init__(self, origin, installer="pip"):
        self.files = {"direct_url.json": origin and json.dumps(origin), "INSTALLER": f"{installer}\n"}

    def read_text(self, name):
        return self.files[name]


@pytest.fixture
def command(monkeypatch, tmp_path):
    """Return the command for the extra `plots`, of a project that was installed from somewhere."""
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "bin" / "python"))
    monkeypatch.chdir(tmp_path)

    def of(origin, installer="pip"):
        monkeypatch.setattr(metadata, "distribution", lambda _: Installed(origin, installer))
        return extras.install_command("plots")

    return of


def test_of_a_clone_with_its_pinned_versions(command, monkeypatch, tmp_path):
    (tmp_path / "constraints.txt").touch()
    origin = {"url": tmp_path.as_uri(), "dir_info": {"editable": True}}
    expected = "bin/python -m pip install --constraint constraints.txt --editable '.[plots]'"
    assert command(origin) == expected
    assert command(origin, "uv").startswith("uv pip install --python bin/python --constraint")


def test_of_a_wheel_from_the_wheel(command):
    origin = {"url": "file:///tmp/dualtaxi-1.2.3-py3-none-any.whl", "archive_info": {}}
    wanted = f"'dualtaxi[plots] @ {origin['url']}'"
    assert command(origin) == f"bin/python -m pip install {wanted}"


def test_of_a_repository_from_the_same_commit(command):
    origin = {"url": "https://example.org/d.git", "vcs_info": {"vcs": "git", "commit_id": "abc"}}
    assert command(origin).endswith("'dualtaxi[plots] @ git+https://example.org/d.git@abc'")


def test_of_an_index_in_the_same_version(command, monkeypatch, tmp_path):
    monkeypatch.setattr(extras, "__file__", str(tmp_path / "site-packages" / "runner" / "extras.py"))
    assert command(None).endswith("'dualtaxi[plots]==1.2.3'")


@pytest.mark.parametrize(
    ("marker", "words"), [("pipx_metadata.json", "pipx install"), ("uv-receipt.toml", "uv tool install")]
)
def test_of_a_tool_by_the_tool(command, tmp_path, marker, words):
    (tmp_path / marker).touch()
    origin = {"url": "file:///tmp/dualtaxi-1.2.3-py3-none-any.whl", "archive_info": {}}
    assert command(origin) == f"{words} --force 'dualtaxi[plots] @ {origin['url']}'"


def test_a_missing_module_is_an_error_with_its_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn", None)
    with pytest.raises(MissingExtra, match=r"a sweep needs scikit-learn, .*\[sweep\]"):
        extras.require("sklearn", extra="sweep", purpose="a sweep")
    assert extras.require("json", "csv", extra="x", purpose="y") is json
