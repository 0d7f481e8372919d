"""Fixtures of the tests of the command line: a caller, and a recordings folder with a run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

import runner
from runner.cli import cli
from runner.runs.run import Run

TINY = """\
name: tiny
mode: competitive
env: {id: "dualtaxi:DualTaxi-v1", kwargs: {max_episode_steps: 40}}
episodes: 30
seed: 3
evaluation: {every: 10, trials: 5}
log: {every_steps: 200, window: 100}
"""
"""Takes milliseconds: 30 episodes of at most 40 steps, evaluations after 0, 10, 20 and 30."""


class Command:
    """The command line, called in this process, with a recordings folder."""

    def __init__(self, recordings: Path) -> None:
        self.recordings = recordings

    def __call__(self, *words: object, **kwargs: object) -> Result:
        return CliRunner().invoke(
            cli, list(map(str, words)), env={"DUALTAXI_RECORDINGS": str(self.recordings)}, **kwargs
        )

    def json(self, *words: object) -> object:
        """Return the object that a command prints with --json."""
        result = self(*words, "--json")
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout)


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """The file of a tiny experiment."""
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY)
    return path


@pytest.fixture(scope="session")
def command_in() -> type[Command]:
    """The command line of a recordings folder."""
    return Command


@pytest.fixture
def command(tmp_path: Path) -> Command:
    """The command line with an empty recordings folder."""
    return Command(tmp_path / "recordings")


@pytest.fixture(scope="session")
def recorded_run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A finished run of the tiny experiment, alone in its recordings folder; not to be changed."""
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "tiny.yaml").write_text(TINY)
    return runner.run(folder / "tiny.yaml", recordings=folder / "recordings")


@pytest.fixture
def recorded(recorded_run: Run) -> Command:
    """The command line with the folder of the recorded run."""
    return Command(recorded_run.folder.parent)
