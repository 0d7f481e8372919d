"""Errors begin with "Error:", have the documented exit code, and are JSON for programs that read JSON."""

from __future__ import annotations

import errno
import json
import subprocess
import sys

import gymnasium
import pytest

import runner
from runner.cli import exit_code_of
from runner.errors import StorageError

BAD = "episodes: -1\nfoo: 2\n"


@pytest.fixture
def bad(tmp_path):
    """A configuration with two mistakes."""
    path = tmp_path / "bad.yaml"
    path.write_text(BAD)
    return path


def test_several_problems_follow_the_word_error(command, bad):
    done = command("run", bad)
    first, *problems = done.stderr.splitlines()
    assert (done.exit_code, first) == (2, "Error: 2 problems")
    assert [line.startswith(f"{bad}:") for line in problems] == [True, True]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["show", "nosuch"], "no run 'nosuch'"),
        (["ls", "status:finished"], 'expected status == "finished"'),
        (["ls", "seed ="], "equality is =="),
        (["ls", "--nope"], "--nope"),
        (["ls", "--limit", "x"], "'--limit': found 'x', expected a whole number from 0"),
        (["run", "quick", "--workers", "2.5"], "found '2.5', expected a whole number from 1 to 1024"),
        (["plot", "nosuch", "--smooth", "nan"], "found 'nan', expected a number from 0 to 100"),
        (["play", "nosuch", "--speed", "0"], "found '0', expected a number above 0"),
        (["shwo"], "Did you mean 'show'?"),
        (["push"], "Did you mean 'remote push'?"),
        (["run", "quick", "--set", "initial_q.run=nosuch"], "initial_q.run: no run 'nosuch'"),
        (["run", "quick", "--episodes", "3"], "changed by --set episodes=VALUE"),
        (["du", "--recordings", "nosuch"], "'nosuch' does not exist"),
        (["view", "x", "--size", "foo"], "1600x900"),
    ],
    ids=lambda words: " ".join(words) if isinstance(words, list) else "",
)
def test_an_error_is_text_or_json(command, words, message):
    plain = command(*words)
    assert plain.exit_code == 2
    assert "Error: " in plain.stderr
    assert message in plain.stderr
    if words[0] == "view":
        return  # has nothing to print as JSON
    error = json.loads(command(*words, "--json").stderr.splitlines()[-1])["error"]
    assert message in error["message"]
    assert (error["exit_code"], error["problems"]) == (2, [])


@pytest.mark.parametrize("option", ["--jsno", "-x"])
def test_an_option_that_is_no_setting_is_not_taken_for_one(command, option):
    error = command("run", "quick", option).stderr
    assert f"No such option '{option}'" in error
    assert "--set" not in error


def test_problems_of_a_configuration_are_listed_as_json(command, bad):
    done = command("config", "check", bad, "--json")
    (line,) = done.stderr.splitlines()
    problems = json.loads(line)["error"]["problems"]
    assert [(each["path"], each["line"]) for each in problems] == [("episodes", 1), ("foo", 2)]
    assert done.stdout == ""


def test_runs_that_cannot_be_pushed_are_errors_too(command):
    words = ["remote", "push", "nosuch", "--server", "http://127.0.0.1:9"]
    assert command(*words).exit_code == 2
    assert json.loads(command(*words, "--json").stderr)["error"]["run"] == "nosuch"


def test_an_unwritable_path_is_wrong_usage_and_a_full_disk_is_not():
    for number, code in ((errno.ENOENT, 2), (errno.EACCES, 2), (errno.ENOSPC, 1), (errno.EIO, 1)):
        error = StorageError("cannot be written")
        error.__cause__ = OSError(number, "x")
        assert exit_code_of(error) == code


def test_parent_folders_of_output_are_created(recorded, tmp_path):
    path = tmp_path / "none" / "deep" / "plot.svg"
    assert recorded("plot", "tiny", "-o", path).exit_code == 0
    assert path.is_file()
    (tmp_path / "file").touch()
    assert recorded("plot", "tiny", "-o", tmp_path / "file" / "plot.svg").exit_code == 2


@pytest.mark.parametrize(
    "error",
    [
        ImportError("_dispatcher.so: failed to map segment from shared object"),
        OSError("Could not find/load shared object file 'libllvmlite.so'"),
    ],
)
def test_a_library_for_which_there_is_too_little_memory_has_no_traceback(recorded, monkeypatch, error):
    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr("runner.runs.catalogue.filters.parse", fails)
    done = recorded("ls", "tiny")
    assert done.exit_code == 1
    assert done.stderr.startswith(f"Error: the system refused: {error}. Allow more memory")


@pytest.mark.skipif(sys.platform != "linux", reason="limits of the system")
@pytest.mark.parametrize(
    ("limit", "value", "name", "expected"),
    [("RLIMIT_AS", 300 << 20, "quick", "memory"), ("RLIMIT_NOFILE", 8, "cart", "open files")],
)
def test_a_limit_of_the_system_is_an_error_without_a_traceback(tmp_path, limit, value, name, expected):
    runner.run("quick", overrides=["episodes=2", "evaluation=null"], recordings=tmp_path)
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path, name="cart") as rec:
        rec.reset(seed=0)
        rec.step(0)
    code = (
        "import resource, sys; from runner.cli import main; sys.argv[0] = 'dualtaxi';"
        f"resource.setrlimit(resource.{limit}, ({value}, {value})); main()"
    )
    words = ["verify", name, "--recordings", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, check=False, timeout=120
    )
    assert "Traceback" not in done.stderr
    assert expected in done.stderr.splitlines()[-1]
    assert done.stderr.splitlines()[-1].startswith("Error: ")
    assert done.returncode == 1
