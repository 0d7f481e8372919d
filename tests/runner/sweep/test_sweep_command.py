"""`dualtaxi sweep` as it is typed."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from runner.cli import cli
from runner.config import load
from runner.runs import list_runs
from runner.sweep import plan


@pytest.fixture
def type_in(tmp_path):
    def typed(*words, code=0):
        result = CliRunner().invoke(cli, ["sweep", *words, "--recordings", str(tmp_path / "runs")])
        assert result.exit_code == code, result.output
        return result

    return typed


def test_a_dry_run_says_what_would_run_and_runs_nothing(type_in, file, tmp_path):
    said = json.loads(type_in(str(file()), "--dry-run", "--json").stdout)
    assert (said["trials"], said["runs"]) == (6, 12)
    assert said["bytes"] == 12 * said["bytes_a_run"] > 0
    assert not (tmp_path / "runs").exists()
    assert "0.1 to 1" in type_in(str(file()), "--dry-run").stdout


def test_a_sweep_is_run_shown_and_its_best_is_a_configuration(type_in, file, tmp_path):
    path = str(file())
    told = json.loads(type_in(path, "--workers", "1", "--json").stdout)
    assert (told["done"], told["failed"], told["stopped"]) == (12, 0, None)
    assert "--resume goes on with it" in type_in(path, code=2).output
    assert json.loads(type_in(path, "--resume", "--json").stdout)["best"] == told["best"]
    shown = json.loads(type_in("show", "small", "--json").stdout)
    assert shown["best"] == told["best"]["trial"] == shown["ranking"][0]["number"]
    assert len(shown["ranking"]) == 6
    assert "median" in type_in("show", "small").stdout
    best = tmp_path / "best.yaml"
    type_in("show", "small", "--best", str(best))
    assert load(best).step_size == told["best"]["values"]["step_size"]
    assert json.loads(type_in("ls", "--json").stdout) == ["small"]


def test_a_limit_stops_it_and_a_raised_one_goes_on(type_in, file, tmp_path):
    stopped = type_in(str(file(limits={"runs": 3})), "--workers", "1", code=1)
    assert "limits.runs: 3 runs were begun. --resume goes on from there." in stopped.output
    assert len(list_runs(tmp_path / "runs")) == 3
    type_in(str(file()), "--workers", "1", "--resume")
    assert len(list_runs(tmp_path / "runs")) == 12


def test_a_disk_that_is_too_small_is_told_before_anything_runs(type_in, file, monkeypatch, tmp_path):
    monkeypatch.setattr(plan, "free_bytes", lambda _: 1000)
    assert "12 runs need about" in type_in(str(file()), code=1).output
    assert list_runs(tmp_path / "runs") == []


def test_an_unknown_sweep_is_told_with_the_nearest(type_in, file):
    assert "`dualtaxi sweep FILE` begins one" in type_in("show", "smal", code=2).output
    type_in(str(file(limits={"runs": 1})), "--workers", "1", code=1)
    assert "Did you mean 'small'?" in type_in("show", "smal", code=2).output


def test_a_misspelt_command_is_no_file(type_in):
    assert "No such command 'shwo'" in type_in("shwo", "small", code=2).output
    assert "nothing.yaml: no such file" in type_in("nothing.yaml", code=2).output


def test_without_ray_it_is_told(type_in, file, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    assert "pip install 'dualtaxi[ray]'" in type_in(str(file()), "--ray", code=2).output
