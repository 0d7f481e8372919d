"""Text that is not UTF-8, in arguments, folder names and command lines in Latin-1."""

from __future__ import annotations

import os
import sys

import pytest

from runner.runs.run import list_runs

LATIN = os.fsdecode(b"caf\xe9")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="file names are bytes there alone")


@pytest.mark.parametrize(
    "words",
    [
        ("label", "@latest", "--note", LATIN),
        ("label", "@latest", "--tag", LATIN),
        ("label", "@latest", "--name", LATIN),
        ("ls", LATIN),
        ("show", LATIN),
    ],
)
def test_an_argument_that_is_not_utf8_is_refused_and_leaves_nothing(recorded, recorded_run, words):
    before = sorted(path.name for path in recorded_run.folder.iterdir() if path.suffix != ".lock")
    result = recorded(*words)
    assert result.exit_code == 2
    assert isinstance(result.exception, SystemExit)
    assert "\\udce9" in result.stderr
    assert sorted(path.name for path in recorded_run.folder.iterdir() if path.suffix != ".lock") == before


@pytest.mark.parametrize("words", [("ls",), ("du",), ("show", "@latest"), ("prune", "--keep-last", "1")])
def test_a_recordings_folder_whose_name_is_not_utf8_is_refused(command, tmp_path, words):
    (tmp_path / LATIN).mkdir()
    result = command(*words, "--recordings", tmp_path / LATIN)
    assert isinstance(result.exception, SystemExit)
    assert "not UTF-8; rename the folder" in result.stderr
    assert "caf\\xe9" in result.stderr


def test_a_run_from_a_folder_whose_name_is_not_utf8_ends_as_any_other(command, tiny, tmp_path, monkeypatch):
    (tmp_path / LATIN).mkdir()
    monkeypatch.chdir(tmp_path / LATIN)
    monkeypatch.setattr(sys, "argv", ["dualtaxi", "run", LATIN])
    monkeypatch.delenv("DUALTAXI_CODE")
    assert command("run", tiny).exit_code == 0
    (run,) = list_runs(command.recordings)
    assert run.status == "finished"
    provenance = command.json("show", run.run_id)["provenance"]
    assert provenance["command"] == "dualtaxi run 'caf\\xe9'"
    assert provenance["directory"].endswith("caf\\xe9")


def test_output_to_a_folder_whose_name_is_not_utf8_is_refused(command, tiny, tmp_path):
    result = command("run", tiny, "--recordings", tmp_path / LATIN)
    assert "not UTF-8" in result.stderr
    assert not (tmp_path / LATIN).exists()
