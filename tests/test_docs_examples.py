"""The documentation is true: its examples and commands run, and it shows every image."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import shutil
import sys
from pathlib import Path

import gymnasium
import gymnasium.envs.registration
import matplotlib
import pytest
from click.testing import CliRunner

import runner
from runner.cli import cli

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("docs/**/*.md"), *ROOT.glob("README.md")])
_EXAMPLE = re.compile(r"^```(python|sh example)[ \t]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
"""A block marked python, or `sh example`, of commands; one marked `python no-test` is not run."""


_COMMANDS = re.compile(r"^```sh run[ \t]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
"""A block of commands that are run, one per line; a backslash continues a line."""


def examples(page: Path) -> list[tuple[int, str, str]]:
    """Return the line, the language and the text of each example of a page."""
    text = page.read_text(encoding="utf-8")
    return [(text[: found.start(2)].count("\n"), *found.groups()) for found in _EXAMPLE.finditer(text)]


WITH_EXAMPLES = [page for page in PAGES if examples(page)]


@pytest.fixture(scope="session")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A read-only recordings folder with a run of a shipped configuration, with short evaluations."""
    made = tmp_path_factory.mktemp("documented") / "recordings"
    runner.run(ROOT / "configs" / "quick.yaml", overrides=["evaluation.trials=10"], recordings=made)
    return made


@pytest.fixture
def folder(tmp_path: Path, recordings: Path) -> Path:
    """A folder as the pages expect it: with the shipped configurations and a run of one of them."""
    (tmp_path / "configs").symlink_to(ROOT / "configs", target_is_directory=True)
    shutil.copytree(recordings, tmp_path / "recordings")
    return tmp_path


@pytest.fixture
def own_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Restore the registry after an example; other tests register environments of the same names."""
    shipped = {name: spec for name, spec in gymnasium.registry.items() if isinstance(spec.entry_point, str)}
    monkeypatch.setattr(gymnasium.envs.registration, "registry", shipped)


@pytest.mark.usefixtures("own_registry")
@pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")  # of MLflow's tables
@pytest.mark.parametrize("page", WITH_EXAMPLES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_examples_run(page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.delenv("DUALTAXI_RECORDINGS", raising=False)
    matplotlib.use("Agg")
    (recording,) = folder.glob("recordings/*/recording.mcap")
    monkeypatch.setattr(sys, "argv", ["example.py", str(recording)])
    names: dict[str, object] = {"__name__": "example"}
    for line, language, text in examples(page):
        if language == "sh example":
            run_commands(text)
            continue
        code = compile("\n" * line + text, str(page), "exec")
        with contextlib.redirect_stdout(io.StringIO()):
            exec(code, names)


def run_commands(text: str) -> None:
    """Run the commands of a block."""
    for line in filter(None, text.replace("\\\n", "").splitlines()):
        program, *words = shlex.split(line, comments=True)
        assert program == "dualtaxi"
        done = CliRunner().invoke(cli, words)
        assert done.exit_code == (words[0] == "diff"), f"{words}: {done.output}"


WITH_COMMANDS = [page for page in PAGES if _COMMANDS.search(page.read_text(encoding="utf-8"))]


@pytest.mark.parametrize("page", WITH_COMMANDS, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_commands_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "configs").symlink_to(ROOT / "configs", target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DUALTAXI_RECORDINGS", raising=False)
    for block in _COMMANDS.findall(page.read_text(encoding="utf-8")):
        run_commands(block)


def test_every_picture_is_shown_and_every_shown_one_is_there() -> None:
    images = ROOT / "docs" / "images"
    shown = {
        name for page in PAGES for name in re.findall(r"images/([\w.-]+)", page.read_text(encoding="utf-8"))
    }
    assert shown == {image.name for image in images.iterdir()}


def test_there_are_examples() -> None:
    assert ROOT / "docs" / "reading.md" in WITH_EXAMPLES
    assert ROOT / "docs" / "compare.md" in WITH_COMMANDS
