"""`dualtaxi remote submit` as it is typed."""

from __future__ import annotations

import json

import pytest
import yaml
from click.testing import CliRunner
from served import Served

from runner.cli import cli
from runner.config import load
from runner.runs.run import list_runs
from runner.sweep.loading import load_sweep, self_contained_text

TINY = "env: {id: FrozenLake-v1}\nepisodes: 20\nseeds: [0, 1]\n"


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "icy.yaml"
    path.write_text(TINY)
    return path


def test_a_file_is_done_by_a_server_and_watched(file, tmp_path):
    with Served(tmp_path / "recordings") as server:
        words = ["remote", "submit", str(file), "--server", server.url]
        result = CliRunner().invoke(cli, [*words, "--watch", "--json"])
        assert result.exit_code == 0, result.output
        told = json.loads(result.stdout)
        assert (told["name"], told["state"]) == ("icy", "finished")
        runs = {str(run.seed): run.run_id for run in list_runs(tmp_path / "recordings")}
        assert {str(run["seed"]): run["run_id"] for run in told["begun"]} == runs
        assert "seed 1: finished" in result.stderr
        file.write_text("episodes: many\n")
        refused = CliRunner().invoke(cli, words)
    assert refused.exit_code == 2
    assert "icy.yaml:1:1: episodes: found 'many'" in refused.stderr


def test_a_sweep_whose_base_is_a_file_is_sent_whole(file, tmp_path):
    sweep = tmp_path / "sweep.yaml"
    described = {"base": "icy.yaml", "strategy": "grid", "parameters": {"step_size": [0.1, 0.5]}}
    sweep.write_text(yaml.safe_dump(described))
    assert yaml.safe_load(self_contained_text(sweep)) == load_sweep(sweep).to_mapping()
    assert self_contained_text(file) == TINY
    assert load(file).seeds == (0, 1)


def test_without_a_server_it_is_told(file):
    result = CliRunner().invoke(cli, ["remote", "submit", str(file)], env={"DUALTAXI_SERVER": ""})
    assert result.exit_code == 2
    assert "--server http://localhost:8000" in result.output
