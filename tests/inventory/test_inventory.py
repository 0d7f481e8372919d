"""Every page, command, route and name that users know is still there, and what is new is written down."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from runner.service import pages
from runner.service.app import create_app, login_pages
from runner.service.settings import ServiceSettings
from tests.browsing import chromium_programs
from tests.doors import commands, routes
from tests.inventory.forms import ADDRESSES, COMMANDS, PARTS, ROUTES, UNTYPED


@pytest.mark.long
@pytest.mark.timeout(900)
def test_every_form_is_as_inventoried():
    chromium_programs()
    # In a process of its own: what serves pages keeps the environment in which its helpers were started.
    command = [sys.executable, "-m", "tests.inventory"]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.fail(done.stdout + done.stderr[-4000:], pytrace=False)


def without(paths, addresses):
    """Return the paths of routes that no address has."""
    known = [address.partition("?")[0] for address in addresses]
    patterns = {path: re.sub(r"\{\w+(:path)?\}", "[^/]+", path) for path in paths}
    return [
        path for path, pattern in patterns.items() if not any(re.fullmatch(pattern, each) for each in known)
    ]


def test_every_page_is_inventoried():
    paths = {path for method, path in routes([pages.router, login_pages]) if method == "GET"}
    assert without(paths - {*PARTS}, ADDRESSES) == [], "add an address to PAGES, or the route to PARTS"


def test_every_route_with_json_is_inventoried(tmp_path):
    app = create_app(ServiceSettings(recordings=(tmp_path,), tokens=tmp_path / "tokens.json"))
    answers = {
        path.removeprefix("/api/v1"): methods["get"]["responses"]["200"].get("content", {})
        for path, methods in app.openapi()["paths"].items()
        if "get" in methods
    }
    paths = [path for path, content in answers.items() if "application/json" in content]
    assert without(paths, [*ROUTES, "/healthz", "/readyz"]) == [], "add an address to ROUTES"


def test_every_command_is_typed_with_text_and_json():
    typed = [f"{words} " for words in COMMANDS]
    for path, command in commands().items():
        name = " ".join(path)
        those = [words for words in typed if words.startswith(f"{name} ")]
        has_json = any(parameter.name == "as_json" for parameter in command.params)
        assert not has_json or any("--json" in words for words in those), f"add `{name} --json` to COMMANDS"
        assert name in UNTYPED or any("--json" not in words for words in those), f"add `{name}` to COMMANDS"
