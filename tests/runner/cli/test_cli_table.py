"""`dualtaxi table`, and the other commands that only print."""

import csv
import io
import json
import subprocess
import sys

import pytest
import yaml

from runner.config import from_mapping, json_schema


def test_the_table_of_dualtaxi(command):
    rows = list(csv.DictReader(io.StringIO(command("table").stdout)))
    assert len(rows) == 221_184
    assert list(rows[0]) == ["state", "action", "probability", "next_state", "reward", "is_over"]
    words = "taxi 1 (0,0), taxi 2 (3,2), passenger in taxi 1, destination R"
    (delivered,) = [row for row in rows if (row["state"], row["action"]) == (words, "drop-off + north")]
    assert delivered["next_state"] == "taxi 1 (0,0), taxi 2 (2,2), passenger at R, destination R"
    assert (float(delivered["reward"]), delivered["is_over"]) == (99.0, "True")


def test_the_competitive_table_has_the_reward_of_each(command):
    result = command("table", "--set", "mode=competitive")
    first = next(csv.DictReader(io.StringIO(result.stdout)))
    assert float(first["reward"]) == float(first["reward.taxi_1"]) + float(first["reward.taxi_2"])


def test_json_is_a_line_for_each_row(command):
    lines = command("table", "--env", "tests.runner.corridor:Corridor-v0", "--json").stdout.splitlines()
    assert len(lines) == 5 * 2
    assert json.loads(lines[7]) == {
        "state": "state 3",
        "action": "action 1",
        "probability": 1.0,
        "next_state": "state 4",
        "reward": -1.0,
        "is_over": True,
    }


def test_an_unknown_environment(command):
    result = command("table", "--env", "Nothing-v1")
    assert result.exit_code == 2
    assert "Nothing-v1" in result.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="a POSIX shell")
def test_a_closed_pipe_is_no_error():
    line = f"{sys.executable} -m runner table | head -n 2; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("state,action,")
    assert done.stdout.splitlines()[-1] == "0"
    assert done.stderr == ""


def test_a_configuration_is_checked_and_spelled_out(command, tiny):
    result = command("config", "check", tiny, "--set", "episodes=50")
    assert result.exit_code == 0
    assert "is fine" in result.stdout.splitlines()[0]
    spelled = yaml.safe_load(result.stdout)
    assert spelled["episodes"] == 50
    assert from_mapping(spelled).to_mapping() == spelled
    assert command.json("config", "check", tiny, "--set", "episodes=50")["config"] == spelled


def test_problems_of_a_configuration_have_their_place(command, tmp_path):
    path = tmp_path / "wrong.yaml"
    path.write_text("episodes: 10\nepsilon: 3\nseedd: 1\n")
    result = command("config", "check", path)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert f"{path}:2:" in result.stderr
    assert "Did you mean 'seed'?" in result.stderr


@pytest.mark.parametrize("words", [[], ["--json"]])
def test_the_schema(command, words):
    assert json.loads(command("config", "schema", *words).stdout) == json_schema()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_completion_script(command, shell):
    result = command("completion", shell)
    assert result.exit_code == 0
    assert "_DUALTAXI_COMPLETE" in result.stdout


def _completions(words, incomplete):
    from click.shell_completion import ShellComplete

    from runner.cli import cli

    found = ShellComplete(cli, {}, "dualtaxi", "_DUALTAXI_COMPLETE").get_completions(words, incomplete)
    return [(item.value, item.type) for item in found]


def test_commands_and_runs_and_files_complete(recorded, recorded_run, monkeypatch):
    monkeypatch.setenv("DUALTAXI_RECORDINGS", str(recorded.recordings))
    assert ("show", "plain") in _completions([], "sh")
    assert _completions(["show"], recorded_run.run_id[:2])[0] == (recorded_run.run_id, "plain")
    assert _completions(["show"], "ti") == [("tiny", "plain")]
    assert _completions(["play"], "@") == [("@latest", "plain")]
    assert _completions(["show"], "some/") == [("some/", "file")]
    assert _completions(["run"], "conf")[0][1] == "file"
    assert _completions(["ls", "--recordings"], "rec")[0][1] == "dir"


def test_names_of_several_runs_complete_to_the_newest(command, tiny, monkeypatch):
    for _ in range(2):
        command("run", tiny)
    monkeypatch.setenv("DUALTAXI_RECORDINGS", str(command.recordings))
    assert _completions(["show"], "ti") == [("tiny@latest", "plain")]


def test_completion_is_silent_without_runs(monkeypatch, tmp_path):
    monkeypatch.setenv("DUALTAXI_RECORDINGS", str(tmp_path / "nowhere"))
    assert _completions(["show"], "") == []
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("DUALTAXI_RECORDINGS", str(tmp_path / "file"))
    assert _completions(["show"], "") == []
