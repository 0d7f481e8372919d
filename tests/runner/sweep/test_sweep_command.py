"""The command `dualtaxi sweep`."""

from __future__ import annotations

import json
import shlex

import pytest
from click.testing import CliRunner
from sweeping import BASE, Here

import runner
from runner.cli import cli
from runner.config import from_mapping, load
from runner.runs.run import list_runs
from runner.sweep import running, workers


@pytest.fixture
def type_in(tmp_path):
    def typed(*words, code=0):
        result = CliRunner().invoke(cli, ["sweep", *words, "--recordings", str(tmp_path / "runs")])
        assert result.exit_code == code, result.output
        return result

    return typed


def test_a_dry_run_prints_the_plan_and_runs_nothing(type_in, file, tmp_path):
    planned = json.loads(type_in("run", str(file()), "--dry-run", "--json").stdout)
    assert (planned["trials"], planned["runs"]) == (6, 12)
    assert planned["bytes"] == 12 * planned["bytes_per_run"] > 0
    assert not (tmp_path / "runs").exists()
    assert "0.1 to 1" in type_in("run", str(file()), "--dry-run").stdout


def test_a_sweep_runs_and_its_best_configuration_loads(type_in, file, tmp_path):
    path = str(file())
    reply = json.loads(type_in("run", path, "--workers", "1", "--json").stdout)
    assert (reply["done"], reply["failed"], reply["stopped"]) == (12, 0, None)
    assert "--resume continues it" in type_in("run", path, code=2).output
    assert json.loads(type_in("run", path, "--resume", "--json").stdout)["best"] == reply["best"]
    shown = json.loads(type_in("show", "small", "--json").stdout)
    assert shown["best"] == reply["best"]["trial"] == shown["ranking"][0]["number"]
    assert len(shown["ranking"]) == 6
    text = type_in("show", "small").stdout
    assert "median" in text
    medians = [entry["median"] for entry in shown["ranking"]]
    assert ("trials tie for the best" in text) == (medians[0] == medians[1])
    best = tmp_path / "best.yaml"
    type_in("show", "small", "--write-best", str(best))
    assert load(best).step_size == reply["best"]["values"]["step_size"]
    assert load(best).seeds == tuple(range(2, 12))  # the search saw 0 and 1
    assert json.loads(type_in("ls", "--json").stdout) == {"sweeps": ["small"]}


def test_trials_that_tie_for_the_best_are_counted(type_in, file):
    never = {"metric": "success_percent", "at": "first_over", "level": 101, "direction": "minimize"}
    following = type_in("run", str(file(objective=never))).stdout.partition("\nnext ")[2]
    words = shlex.split(following.partition("\n")[0])
    assert "6 trials tie for the best; trial 0 is the first." in CliRunner().invoke(cli, words[1:]).stdout


def test_a_limit_stops_a_sweep_and_a_raised_limit_resumes_it(type_in, file, tmp_path):
    stopped = type_in("run", str(file(limits={"runs": 3})), "--workers", "1", code=1)
    assert "limits.runs: 3 runs were started. --resume continues from there." in stopped.output
    assert len(list_runs(tmp_path / "runs")) == 3
    type_in("run", str(file()), "--workers", "1", "--resume")
    assert len(list_runs(tmp_path / "runs")) == 12


def test_existing_runs_are_finished_despite_a_limit(type_in, file, tmp_path):
    type_in("run", str(file(limits={"runs": 3})), "--workers", "1", code=1)
    first = list_runs(tmp_path / "runs")[-1]
    first.recording.unlink()
    first.update(status="interrupted")
    again = type_in("run", str(file(limits={"runs": 4})), "--workers", "1", "--resume", "--json", code=1)
    assert json.loads(again.stdout)["done"] == 4
    assert {run.status for run in list_runs(tmp_path / "runs")} == {"finished"}


def test_trials_start_from_the_table_of_a_run(type_in, file, tmp_path):
    parameters = {"initial_q": [0, {"run": "start"}]}
    path = str(file(strategy="grid", trials=None, parameters=parameters, seeds=[0]))
    assert "small.yaml:20:5: parameters.initial_q[1]: no run 'start'" in type_in("run", path, code=2).output
    runner.run(from_mapping(BASE, name="start"), recordings=tmp_path / "runs")
    type_in("run", path, "--workers", "1")
    type_in("run", path, "--workers", "1", "--resume")
    assert len(list_runs(tmp_path / "runs")) == 3


def test_runs_that_are_tried_need_a_step(type_in, file, tmp_path):
    for number, name in enumerate(("first", "second")):
        runner.run(from_mapping(BASE | {"seeds": [number]}, name=name), recordings=tmp_path / "runs")
    tried = {"initial_q.run": ["first", "second"]}
    given = {"strategy": "grid", "trials": None, "seeds": [0]}
    without = str(file(**given, base=BASE | {"initial_q": {"run": "first"}}, parameters=tried))
    assert "found runs without a step" in type_in("run", without, code=2).output
    path = str(file(**given, parameters=tried | {"initial_q.step": [100]}))
    type_in("run", path, "--workers", "1")
    type_in("run", path, "--workers", "1", "--resume")
    assert len(list_runs(tmp_path / "runs")) == 4


def test_a_full_disk_is_reported_before_anything_runs(type_in, file, monkeypatch, tmp_path):
    with monkeypatch.context() as small:
        small.setattr(running, "free_bytes", lambda _: 1000)
        output = type_in("run", str(file()), code=1).output
    assert "12 runs need about" in output
    assert "and 1.0 kB are free" in output
    assert list_runs(tmp_path / "runs") == []
    type_in("run", str(file()), "--workers", "1")  # it has not begun, so nothing is to be resumed


def test_a_level_that_is_never_reached_is_printed_as_never(type_in, file, tmp_path):
    objective = {"metric": "success_percent", "at": "first_over", "level": 101, "direction": "minimize"}
    path = str(file(strategy="random", trials=1, seeds=[0], objective=objective))
    assert "never in trial 0" in type_in("run", path, "--workers", "1").stdout
    assert json.loads(type_in("run", path, "--resume", "--json").stdout)["best"]["value"] is None
    best = tmp_path / "best.yaml"
    type_in("show", "small", "--write-best", str(best))
    assert ": never, the median" in best.read_text()
    plotted = CliRunner().invoke(cli, ["plot", "small", "--recordings", str(tmp_path / "runs")])
    assert "none of its 1 finished trials reached success_percent, first at 101" in plotted.output


def test_an_unknown_sweep_is_refused_with_the_nearest_name(type_in, file):
    assert "`dualtaxi sweep run FILE` starts one" in type_in("show", "smal", code=2).output
    type_in("run", str(file(limits={"runs": 1})), "--workers", "1", code=1)
    assert "Did you mean 'small'?" in type_in("show", "smal", code=2).output
    assert "Its sweeps: small." in type_in("show", "hyperparameters", code=2).output


def test_a_misspelt_command_is_not_taken_for_a_file(type_in):
    assert "Did you mean 'show'?" in type_in("shwo", "small", code=2).output
    assert "nothing.yaml: no such file" in type_in("run", "nothing.yaml", code=2).output


def test_output_of_ray_goes_to_stderr(type_in, file, monkeypatch):
    class Talking(Here):
        def __enter__(self):
            print("(raylet) A worker died")
            return self

        def __exit__(self, *_):
            pass

    monkeypatch.setattr(workers, "RayWorkers", lambda *_: Talking())
    reply = type_in("run", str(file()), "--ray", "--json")
    assert json.loads(reply.stdout)["done"] == 12
    assert "(raylet) A worker died" in reply.stderr


def test_a_missing_ray_is_reported(type_in, file, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    assert "[ray]" in type_in("run", str(file()), "--ray", code=2).output
    assert json.loads(type_in("ls", "--json").stdout) == {"sweeps": []}


def test_where_there_are_no_sweeps_stdout_is_empty(type_in):
    reply = type_in("ls")
    assert (reply.stdout, reply.stderr) == ("", "No sweeps yet. `dualtaxi sweep run FILE` starts one.\n")
