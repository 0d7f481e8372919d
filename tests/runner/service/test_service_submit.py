"""The command `dualtaxi remote submit`."""

from __future__ import annotations

import json

import pytest
import yaml
from click.testing import CliRunner
from served import Served

from runner.cli import cli
from runner.config import load
from runner.runs.run import list_runs
from runner.sweep.model import load_sweep, self_contained_text

TINY = "env: {id: FrozenLake-v1}\nepisodes: 20\nseeds: [0, 1]\n"


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "icy.yaml"
    path.write_text(TINY)
    return path


@pytest.mark.long
def test_a_file_is_submitted_and_watched(file, tmp_path):
    with Served(tmp_path / "recordings") as server:
        words = ["remote", "submit", str(file), "--server", server.url]
        result = CliRunner().invoke(cli, [*words, "--watch", "--json"])
        assert result.exit_code == 0, result.output
        job = json.loads(result.stdout)
        assert (job["name"], job["state"]) == ("icy", "finished")
        runs = {str(run.seed): run.run_id for run in list_runs(tmp_path / "recordings")}
        assert {str(run["seed"]): run["run_id"] for run in job["begun"]} == runs
        assert "seed 1: finished" in result.stderr
        file.write_text("episodes: many\n")
        refused = CliRunner().invoke(cli, words)
    assert refused.exit_code == 2
    assert "icy.yaml:1:1: episodes: found 'many'" in refused.stderr


def test_a_sweep_is_sent_with_its_base(file, tmp_path):
    sweep = tmp_path / "sweep.yaml"
    described = {"base": "icy.yaml", "strategy": "grid", "parameters": {"step_size": [0.1, 0.5]}}
    sweep.write_text(yaml.safe_dump(described))
    assert yaml.safe_load(self_contained_text(sweep)) == load_sweep(sweep).to_mapping()
    assert self_contained_text(file) == TINY
    assert load(file).seeds == (0, 1)


def test_a_missing_server_is_reported(file):
    result = CliRunner().invoke(cli, ["remote", "submit", str(file)], env={"DUALTAXI_SERVER": ""})
    assert result.exit_code == 2
    assert "--server http://localhost:8000" in result.output
