"""`dualtaxi run`."""

import json
import re
import subprocess
import sys

import pytest

from runner.cli import progress
from runner.cli.commands import run as run_command
from runner.execution import estimate
from runner.runs.run import list_runs

BESIDES = {"name", "seed", "status", "episodes"}
PROMISED = {
    "run_id",
    "path",
    "content_digest",
    "train_steps",
    "eval_steps",
    "seconds",
    "bytes",
    "last_evaluation",
}


def test_json_is_a_line_for_each_run(command, tiny):
    result = command("run", tiny, "--set", "seeds=[1, 2]", "--json")
    assert result.exit_code == 0
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    assert [line["seed"] for line in lines] == [1, 2]
    for line in lines:
        assert line.keys() == PROMISED | BESIDES
        assert line["last_evaluation"].keys() == {
            "episode",
            "success_percent",
            "mean_length",
            "mean_penalties",
            "mean_return",
        }
        assert line["status"] == "finished"
        assert line["bytes"] > 1000
        assert line["path"].endswith("recording.mcap")
    assert lines[0]["content_digest"] != lines[1]["content_digest"]


def test_the_same_seed_gives_the_same_digest_and_another_id(command, tiny):
    first, second = (command.json("run", tiny, "--seed", 5) for _ in range(2))
    assert first["content_digest"] == second["content_digest"]
    assert first["run_id"] != second["run_id"]
    assert [run.name for run in list_runs(command.recordings)] == ["tiny", "tiny"]


def test_the_summary_has_results_and_what_to_type_next(command, tiny):
    result = command("run", tiny, "--name", "mine")
    (run,) = list_runs(command.recordings)
    assert result.exit_code == 0
    assert run.name == "mine"
    assert run.summary["content_digest"] in result.stdout
    assert f"dualtaxi show {run.run_id}" in result.stdout
    assert f"dualtaxi play {run.run_id} --eval 30:0" in result.stdout
    assert "drop-off" in result.stdout
    assert "\x1b" not in result.output
    assert all(line == line.rstrip() for line in result.stdout.splitlines())


@pytest.mark.parametrize(
    "settings", ["log.window=40", "recording.steps=none", "evaluation=null", "episodes=0"]
)
def test_the_suggested_commands_work(command, tiny, settings):
    result = command("run", tiny, "--set", settings)
    assert "dualtaxi show" in result.stdout
    for line in result.stdout.splitlines():
        if "dualtaxi " in line:
            assert command(*line.partition("dualtaxi ")[2].split()).exit_code == 0


def test_play_is_not_suggested_without_an_episode(command, tiny):
    output = command("run", tiny, "--set", "evaluation=null", "--set", "episodes=0").stdout
    assert "dualtaxi show" in output
    assert "dualtaxi play" not in output


def test_an_unusable_environment_is_refused_before_the_estimate(command, tiny):
    result = command("run", tiny, "--set", "env.kwargs={sloop: 0.1}")
    assert result.exit_code == 2
    assert "sloop" in result.stderr
    assert "about" not in result.stderr


def test_the_estimate_comes_first_and_on_stderr(command, tiny):
    result = command("run", tiny, "--json")
    assert result.stderr.startswith("30 episodes: about ")
    assert "at most 2,000," in result.stderr  # (30 episodes + 4 * 5 trials) * 40 steps
    assert len(result.stdout.splitlines()) == 1


def test_a_small_disk_is_warned_about_without_a_terminal(command, tiny, monkeypatch):
    monkeypatch.setattr(estimate, "free_bytes", lambda _: 1000)
    result = command("run", tiny, "--json")
    assert result.exit_code == 0
    assert "1.0 kB left" in result.stderr


@pytest.mark.parametrize(("answer", "code", "runs"), [("n\n", 1, 0), ("y\n", 0, 1), ("", 130, 0)])
def test_a_small_disk_needs_confirmation_on_a_terminal(command, tiny, monkeypatch, answer, code, runs):
    monkeypatch.setattr(estimate, "free_bytes", lambda _: 1000)
    monkeypatch.setattr(run_command, "_is_interactive", lambda: True)
    result = command("run", tiny, "--json", input=answer)
    assert result.exit_code == code
    assert len(list_runs(command.recordings)) == runs
    assert "Continue?" in result.stderr


def test_problems_of_a_configuration_are_listed_one_per_line(command, tiny):
    result = command("run", tiny, "--set", "episodez=3", "--set", "epsilon=2")
    assert result.exit_code == 2
    assert "epsilon=2: epsilon: found 2" in result.stderr
    assert "Did you mean 'episodes'?" in result.stderr
    assert not command.recordings.exists()


@pytest.mark.parametrize(
    ("env", "message"),
    [
        ("Nothing-v1", "Gymnasium knows no such id"),
        ("CartPole-v1", "no transition table"),
        ("nowhere:Nothing-v1", "no module"),
    ],
)
def test_an_unusable_environment_leaves_no_partial_run(command, tiny, env, message):
    result = command("run", tiny, "--set", f"env={{id: '{env}'}}", "--set", "mode=cooperative")
    assert result.exit_code == 2
    assert message in result.stderr
    assert "Nothing was recorded; the empty run" in result.stderr
    assert list(command.recordings.iterdir()) == []


def test_an_invalid_name_is_refused(command, tiny):
    result = command("run", tiny, "--name", "a b")
    assert result.exit_code == 2
    assert "name: found 'a b'" in result.stderr
    assert not command.recordings.exists()


def test_a_folder_that_cannot_be_written(command, tiny, tmp_path):
    command.recordings = tmp_path / "tiny.yaml"
    result = command("run", tiny)
    assert result.exit_code == 2
    assert "cannot be written" in result.stderr
    assert "--recordings" in result.stderr


@pytest.mark.parametrize("seed", ["-1", "x", 2**64])
def test_an_invalid_seed_is_refused(command, tiny, seed):
    assert command("run", tiny, "--seed", seed).exit_code == 2


def test_without_evaluation(command, tiny):
    values = command.json("run", tiny, "--set", "evaluation=null")
    assert values["last_evaluation"] is None
    assert values["eval_steps"] == 0
    result = command("run", tiny, "--set", "evaluation=null")
    assert "--episode 0" in result.stdout


def test_an_unknown_success_rate_is_null(command, tiny):
    env = "env={id: tests.runner.corridor:Corridor-v0}"
    words = ("run", tiny, "--set", env, "--set", "mode=cooperative")
    assert command.json(*words)["last_evaluation"]["success_percent"] is None
    assert "–" in command(*words).stdout


def test_a_run_is_on_disk_before_heavy_imports(tiny, tmp_path):
    program = (
        "import sys\nimport runner.runs.run as runs\nmake = runs.create_run\n"
        "def spy(*args):\n    run = make(*args)\n    assert (run.folder / 'run.json').is_file()\n"
        "    print(*sys.modules, file=sys.stderr)\n    sys.exit(5)\n"
        "runs.create_run = spy\nfrom runner.cli import main\n"
        "sys.argv = ['dualtaxi', *sys.argv[1:]]\nmain()"
    )
    words = ["run", str(tiny), "--recordings", str(tmp_path / "recordings")]
    done = subprocess.run(
        [sys.executable, "-c", program, *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 5, done.stderr
    assert not {"numpy", "numba", "gymnasium", "rich"} & set(done.stderr.split())


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("run", "{tiny}"), r"\d+/30  +.*steps/s"),
        (("sweep", "run", "{sweep}", "--workers", "1"), r"\d of 2 runs, \d running, .*so far"),
        (("export", "film", "{run}", "-o", "{folder}/film.gif", "--width", "160"), r"\d of \d+ frames"),
    ],
)
def test_without_a_terminal_a_line_now_and_then_shows_that_work_goes_on(
    recorded, recorded_run, tmp_path, tiny, monkeypatch, words, line
):
    sweep = tmp_path / "small.yaml"
    sweep.write_text("base: tiny.yaml\nstrategy: grid\nseeds: [0]\nparameters: {discount: [0.5, 0.9]}\n")
    typed = [word.format(tiny=tiny, sweep=sweep, run=recorded_run.folder, folder=tmp_path) for word in words]
    into = [] if words[0] == "export" else ["--recordings", tmp_path / "recordings"]
    assert not re.search(line, recorded(*typed, *into).stderr)  # a minute has not passed
    monkeypatch.setattr(progress, "LINE_SECONDS", 0)
    into = ["--force"] if words[0] == "export" else ["--recordings", tmp_path / "others"]
    done = recorded(*typed, *into)
    assert done.exit_code == 0, done.output
    assert re.search(line, done.stderr), done.stderr


def test_the_label_of_a_line_may_have_braces(capsys, monkeypatch):
    monkeypatch.setattr(progress, "LINE_SECONDS", 0)
    with progress.bytes_line("pulling {run}") as report:
        report(1, 2000)
    assert capsys.readouterr().err == "pulling {run}  1 of 2,000 bytes\n"


def test_the_steps_of_a_run_are_in_the_range_of_the_estimate(command):
    done = command("run", "cliff_walking")
    low, high = re.search(
        r"episodes: about ([\d.]+) thousand to ([\d.]+) thousand steps", done.stderr
    ).groups()
    (run,) = list_runs(command.recordings)
    steps = run.summary["train_steps"] + run.summary["eval_steps"]
    assert float(low) * 1000 <= steps <= float(high) * 1000


def test_a_branch_of_training_names_the_recorded_action(command, tiny):
    command("run", tiny)
    action = json.loads(command("play", "tiny", "--episode", 1, "--json").stdout.splitlines()[2])["action"]
    for number, is_recorded in ((action, True), ((action + 1) % 36, False)):
        done = command("branch", "tiny", "--at", "1:2", "--action", number, "--name", f"branch{number}")
        assert done.exit_code == 0, done.output
        assert (f"{number} is the recorded action at 1:2" in done.stderr) == is_recorded
