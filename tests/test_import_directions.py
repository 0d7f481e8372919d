"""Imports go one way, between the packages of the runner and between its modules, without exceptions."""

from __future__ import annotations

import ast
import functools
import graphlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ORDER = """
    errors util
    config
    environments
    learning planning
    recording
    runs
    replay
    archive
    analysis
    query
    execution
    drawing
    export
    sweep
    client
    loops
    integrations
    debugging
    views
    golden
    service
    api
    cli
"""
RANK = {part: rank for rank, line in enumerate(ORDER.split("\n")) for part in line.split()}
FILES = {
    "runner": sorted((ROOT / "runner").rglob("*.py")),
    "dualtaxi": sorted((ROOT / "dualtaxi").rglob("*.py")),
}


@functools.cache
def imported(file: Path) -> list[tuple[str, ...]]:
    """Return the names that a file imports, anywhere in it, as their parts."""
    return [*_imported(file)]


def _imported(file: Path) -> Iterator[tuple[str, ...]]:
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (tuple(alias.name.split(".")) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: an import relative to its place"
            yield from ((*node.module.split("."), alias.name) for alias in node.names)


def part_of(file: Path) -> str:
    return file.relative_to(ROOT / "runner").parts[0].removesuffix(".py")


def test_every_part_of_the_runner_has_its_place_in_the_order():
    parts = {part_of(file) for file in FILES["runner"]} - {"__init__", "__main__"}
    assert parts == set(RANK), "say in ORDER what a new part may know"


def test_the_page_on_the_architecture_names_every_part():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    layout = page.partition("## The layout")[2].partition("Imports go one way")[0]
    assert {part for part in RANK if not re.search(rf"runner/{part}(\.py|/)`", layout)} == set()


def test_the_page_on_the_architecture_quotes_the_order():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    order = " < ".join(", ".join(line.split()) for line in ORDER.strip().split("\n"))
    assert order in " ".join(page.split())


def module_of(file: Path) -> str:
    """Return the dotted name of a file of the runner."""
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def module_imports() -> dict[str, set[str]]:
    """Return the modules of the runner that each of its modules imports, also late or for types alone."""
    modules = {module_of(file): file for file in FILES["runner"]}
    imports: dict[str, set[str]] = {}
    for module, file in modules.items():
        found = set()
        for names in imported(file):
            dotted = ".".join(names)
            found.add(dotted if dotted in modules else dotted.rpartition(".")[0])
        imports[module] = (found & set(modules)) - {module}
    return imports


@pytest.mark.parametrize("part", RANK)
def test_a_part_imports_only_what_comes_before_it(part):
    wrong = {
        (module, other)
        for module, others in module_imports().items()
        if module.split(".")[1:2] == [part]
        for other in others
        if other == "runner" or RANK[other.split(".")[1]] > RANK[part]
    }
    assert wrong == set()


def test_no_module_imports_itself_by_way_of_others():
    try:
        tuple(graphlib.TopologicalSorter(module_imports()).static_order())
    except graphlib.CycleError as error:
        pytest.fail(" imports ".join(error.args[1]))


def test_the_environment_and_the_runner_do_not_know_each_other():
    for package, other in (("runner", "dualtaxi"), ("dualtaxi", "runner")):
        assert len(FILES[package]) > 5
        assert [file for file in FILES[package] for names in imported(file) if names[0] == other] == []


def roots(folder: str, *, but: str = "") -> set[str]:
    """Return the packages that the files of a folder import; `but` is a pattern of files to leave out."""
    files = [file for file in (ROOT / folder).rglob("*.py") if not file.match(but or "nothing")]
    return {names[0] for file in files for names in imported(file)}


def test_learning_knows_numbers_and_nothing_of_files_clocks_or_commands():
    assert roots("runner/learning", but="compiling.py") - {"runner"} <= {
        "__future__",
        "typing",
        "collections",
        "functools",
        "math",
        "numpy",
        "numba",
    }


def test_recording_knows_nothing_of_learning_or_commands_and_gymnasium_in_few_files():
    assert not roots("runner/recording", but="gym_*.py") & {"numba", "gymnasium", "click", "rich"}


def test_the_environment_needs_numpy_and_gymnasium_and_pettingzoo_in_one_file():
    outside = roots("dualtaxi") - set(sys.stdlib_module_names) - {"dualtaxi"}
    assert outside == {"numpy", "gymnasium", "pettingzoo"}
    with_pettingzoo = {
        file.name for file in FILES["dualtaxi"] for names in imported(file) if names[0] == "pettingzoo"
    }
    assert with_pettingzoo == {"parallel.py"}
