"""The names in docs/commands.md exist, and have every view; docs/service.md has every route."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import runner
from runner.service import pages, views
from runner.service.app import create_app
from runner.service.settings import ServiceSettings
from runner.views import shipped_views
from tests.doors import commands, routes

DOCS = Path(__file__).parents[1] / "docs"
TEXT = (DOCS / "commands.md").read_text(encoding="utf-8")
ROWS = [
    [cell.strip().strip("`") for cell in line.strip("|").split("|")]
    for line in TEXT.partition("\n## Names\n")[2].partition("\n## ")[0].splitlines()
    if line.startswith("| ")
][1:]


def as_written(paths):
    """Return paths with parameters as the table writes them."""
    return {re.sub(r"{(\w+)}", lambda name: name[1].upper(), path) for path in paths}


def test_every_name_exists(tmp_path):
    settings = ServiceSettings(recordings=(tmp_path,), tokens=tmp_path / "tokens.json")
    addresses = as_written(create_app(settings).openapi()["paths"])
    page_addresses = as_written(path for _, path in routes([pages.router, views.pages]))
    names = {" ".join(path) for path in commands()}
    for _, command, page, route, name in ROWS:
        assert command in names
        assert not page or page in page_addresses
        assert not route or f"/api/v1{route}" in addresses
        assert not name or name.removeprefix("runner.") in runner.__all__


def test_the_commands_with_csv_and_markdown_are_named():
    json, csv, markdown = (
        {" ".join(path) for path, command in commands().items() if option in options_of(command)}
        for option in ("--json", "--csv", "--markdown")
    )
    text = TEXT.replace("\n", " ")
    (sentence,) = re.findall(r"[^.;]* have `--csv`", text)
    assert set(re.findall("`([a-z ]+)`", sentence)) == csv
    (sentence,) = re.findall(r"Every command with `--json` also has `--markdown`, except ([^,]*),", text)
    assert set(re.findall("`([a-z ]+)`", sentence)) == json - markdown


def test_the_modules_that_the_architecture_names_exist():
    text = (DOCS / "architecture.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`([a-z_]+/[a-z_/]+\.py)`", text))
    folders = (DOCS.parent, Path(runner.__file__).parent)
    assert len(named) > 40
    assert {name for name in named if not any((folder / name).is_file() for folder in folders)} == set()


def options_of(command):
    return {name for parameter in command.params for name in parameter.opts}


@pytest.mark.parametrize("view", [view.name for view in shipped_views() if view.has_tab])
def test_every_view_has_a_row(view):
    address = f"/runs/RUN/{view}"
    assert [view, address, address] in [row[1:4] for row in ROWS]


def test_every_route_is_described(tmp_path):
    settings = ServiceSettings(recordings=(tmp_path,), tokens=tmp_path / "tokens.json")
    text = (DOCS / "service.md").read_text(encoding="utf-8")
    for path in create_app(settings).openapi()["paths"]:
        last = re.findall(r"/[a-z._]+", path)[-1]
        assert last in text, path
