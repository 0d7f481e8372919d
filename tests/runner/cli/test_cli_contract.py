"""Rules that hold for every command: its JSON is an object, and its exit codes are the documented ones."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace

import click
import gymnasium
import pytest
import yaml
from click.testing import CliRunner

import runner
from runner.cli import cli
from runner.cli.commands.server import Server
from runner.cli.parameter_types import RunName
from runner.client.jobs import JobStatus, RunOfJob
from runner.errors import ExitCode
from runner.recording.rewriting import rewrite
from runner.runs.resolve import find_run
from tests.doors import commands

EVERY = commands()
WITH_JSON = {
    path: command for path, command in EVERY.items() if any(p.name == "as_json" for p in command.params)
}

LISTS = {
    "ls": "runs",
    "checkpoints": "checkpoints",
    "du": "runs",
    "config ls": "configs",
    "sweep ls": "sweeps",
    "token ls": "tokens",
    "remote push": "runs",
    "remote jobs": "jobs",
}
"""Commands whose result is a list, and the name of the list."""
WRITING = {
    "plot": "{run} -o {folder}/plot.svg",
    "report": "{run} -o {folder}/report.html",
    "config copy": "quick -o {folder}/mine.yaml",
    "export rerun": "{run} -o {folder}/a.rrd",
    "export mcap": "{run} -o {folder}/a.mcap",
    "export film": "{run} -o {folder}/a.gif",
    "export csv": "{run} -o {folder}/csv",
    "export parquet": "{run} -o {folder}/parquet",
    "export minari": "{run} --phase eval -o {folder}/minari",
    "export tensorboard": "{run} -o {folder}/tensorboard",
    "qtable": "{run} --state 0 -o {folder}/table.npy",
    "checkpoint get": "{loop} -o {folder}/policy.bin",
    "values": "{loop} --episode 0 --checkpoint @0 --policy {policy} -o {folder}/values.csv",
}
"""Commands whose JSON lists the files that they wrote, and what is typed after them."""
LOOPS = {"checkpoints": "{loop}", "branch": "{loop} --at 0:2 --recordings {folder}/branches"}
WITHOUT_JSON = ("view", "completion", "serve")
"""Commands that print an address, a script or nothing."""
LINES = ("run", "play", "table", "archive")
"""Commands that print one object per line."""
WORDS = {
    "run": "{tiny}",
    "sweep run": "{sweep} --dry-run",
    "sweep show": "small",
    "resume": "@latest",
    "evaluate": "@latest --trials 2",
    "rerecord": "@latest",
    "show": "@latest",
    "episodes": "@latest --stop 5",
    "evaluations": "@latest",
    "code": "@latest",
    "play": "{run} --speed 1000",
    "console": "@latest --search x",
    "system": "@latest",
    "diff": "@latest @latest",
    "compare": "@latest other@latest",
    "verify": "@latest",
    "table": "--env FrozenLake-v1",
    "when": "{run} step>=1",
    "why": "{run} --at 0:1 --agent taxi_1",
    "explain": "{tiny} {patient} --seeds 2",
    "label": "@latest --tag good",
    "mark": "{run} 0:1 seen",
    "find": "length>0 --limit 2",
    "sql": "VALUES(1)",
    "rm": "@latest --dry-run",
    "prune": "--keep-last 0 --dry-run",
    "repair": "@latest",
    "init": "{folder}/start",
    "config check": "{tiny}",
    "archive": "@latest --to {folder}/archive",
    "restore": "other",
    "import": "{recording} --as-new",
    "remote push": "@latest",
    "remote pull": "@latest",
    "remote submit": "{tiny}",
    "remote watch": "1",
    "remote cancel": "1",
    "remote resume": "1",
    "token create": "laptop",
    "token revoke": "laptop",
}
"""What is typed after a command; nothing for the others."""
HOSTILE = "a\x1b]0;owned\x1b\\\x9b31m\x7f\u202eb"
"""Sets the title of a terminal, begins a red text, and turns the direction of writing."""
RUNS = [RunOfJob(3, "k3v9m2xq")]
JOB = JobStatus(number=1, kind="config", name="tiny", state="finished", runs=1, created="", begun=RUNS)


def always_left(content, *spaces):
    """Return the policy of the loop's checkpoint."""
    return lambda observation: ("left", "right").index(content.decode())


def made_hostile(folder):
    """Put control characters of terminals into the texts of a run, as nobody's recorder does."""
    run, fresh = find_run(str(folder)), folder / "fresh.mcap"
    rewrite(run.recording, fresh, lambda _, entries: entries | {"git.branch": HOSTILE, HOSTILE: "x"})
    fresh.replace(run.recording)
    facts = json.loads((folder / "run.json").read_text()) | {"name": HOSTILE, "host": HOSTILE}
    facts["config"] |= {"name": HOSTILE, HOSTILE: HOSTILE}
    facts["provenance"] = {HOSTILE: HOSTILE, "git": HOSTILE, "command": HOSTILE}
    facts["summary"] |= {"error": HOSTILE, "logged": {HOSTILE: 1.0}}
    (folder / "run.json").write_text(json.dumps(facts))
    (folder / "labels.json").write_text(json.dumps({"note": HOSTILE, "tags": ["good"]}))
    mark = {"at": "0:1", "episode": 0, "text": HOSTILE, "tags": [], "created": "2026-11-27T08:00:00.123Z"}
    (folder / "marks.json").write_text(json.dumps({"marks": [mark]}))


def controls(text):
    """Return the control characters in an output, except colours and the moves of a live display."""
    own = re.compile(r"\r?\x1b\[([\d;]*[mA]|2K|\?25[lh])")
    return set(re.findall(r"[\0-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e]", own.sub("", text)))


@pytest.fixture(scope="module")
def place(tmp_path_factory, recorded_run, command_in):
    """A folder with two runs, an archive of one, and a sweep."""
    folder = tmp_path_factory.mktemp("contract")
    recordings = folder / "recordings"
    shutil.copytree(recorded_run.folder, recordings / recorded_run.run_id)
    made_hostile(recordings / recorded_run.run_id)
    tiny = folder / "tiny.yaml"
    shutil.copy(recorded_run.folder.parents[1] / "tiny.yaml", tiny)
    command = command_in(recordings)
    other = command.json("run", tiny, "--set", "discount=0.5", "--name", "other")
    command.json("archive", other["run_id"], "--to", folder / "archived", "--remove")
    with runner.record(gymnasium.make("CartPole-v1"), folder / "loops", name="loop") as loop:
        loop.checkpoint("policy", b"left")
        loop.reset(seed=0)
        while not any(loop.step(0)[2:4]):
            pass
    made_hostile(loop.run.folder)
    patient = folder / "patient.yaml"
    patient.write_text(yaml.safe_dump(yaml.safe_load(tiny.read_text()) | {"discount": 0.99}))
    sweep = folder / "small.yaml"
    sweep.write_text("base: tiny.yaml\nstrategy: grid\nseeds: [0]\nparameters: {discount: [0.5, 0.9]}\n")
    done = command("sweep", "run", sweep, "--workers", 1)
    assert done.exit_code == 0, done.output
    return SimpleNamespace(
        folder=folder,
        command=command,
        tiny=tiny,
        patient=patient,
        sweep=sweep,
        recording=recorded_run.recording,
        run=recorded_run.run_id,
        loop=loop.run.folder,
        policy=f"{__name__}:always_left",
    )


@pytest.fixture(autouse=True)
def server(monkeypatch, tmp_path, recorded_run, own_folder):
    """Stand in for a server, and keep tokens in a folder of the test."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    pulled = SimpleNamespace(run=recorded_run, content_digest="0" * 64, already=True)
    client = SimpleNamespace(
        url="http://localhost",
        push=lambda *_: SimpleNamespace(run_id="k3v9m2xq", already=False),
        pull=lambda *_: pulled,
        submit=lambda *_: JOB,
        jobs=lambda *_: [JOB],
        job=lambda _: JOB,
        watch=lambda _: [],
        cancel=lambda _: JOB,
        resume=lambda *_: JOB,
    )
    monkeypatch.setattr(Server, "client", lambda *_: contextlib.nullcontext(client))


def test_every_command_with_json_is_tested():
    assert {*WORDS, *LISTS, *WRITING} <= {" ".join(path) for path in WITH_JSON}
    assert {" ".join(path) for path in EVERY.keys() - WITH_JSON.keys()} == {*WITHOUT_JSON}


@pytest.mark.parametrize("path", WITH_JSON, ids=" ".join)
def test_json_is_an_object_or_one_per_line(place, path):
    name = " ".join(path)
    words = (WORDS | WRITING | LOOPS).get(name, "").format(**vars(place)).split()
    if name == "token revoke":
        place.command("token", "create", "laptop")
    if name == "restore":  # the test of control characters may have restored it
        place.command("archive", "other", "--to", place.folder / "archived", "--remove")
    done = place.command(*path, *words, "--json")
    assert done.exit_code in (ExitCode.OK, ExitCode.DIFFERENT), done.output
    assert not controls(done.output)
    objects = (
        [json.loads(line) for line in done.stdout.splitlines()]
        if name in LINES
        else [json.loads(done.stdout)]
    )
    assert objects
    assert all(isinstance(each, dict) for each in objects)
    if name in LISTS:
        assert isinstance(objects[0][LISTS[name]], list)
    if name in WRITING:
        assert objects[0]["files"]
        for file in objects[0]["files"]:
            assert Path(file["path"]).is_absolute()
            assert Path(file["path"]).stat().st_size == file["bytes"]


@pytest.mark.parametrize("path", WITH_JSON, ids=" ".join)
def test_no_control_character_of_a_recording_reaches_a_terminal(place, path, monkeypatch, tmp_path):
    monkeypatch.setenv("FORCE_COLOR", "1")
    at_once = vars(place) | {"folder": tmp_path}
    words = (WORDS | WRITING | LOOPS).get(" ".join(path), "").format(**at_once).split()
    done = place.command(*path, *words, color=True)
    assert "Traceback" not in done.output
    assert not controls(done.output)


@pytest.mark.parametrize(
    "words", [("show",), ("code",), ("ls",), ("du",), ("label",), ("play", "--episode", 0)]
)
def test_control_characters_are_visible(place, words):
    command, *options = words
    shown = place.command(command, *([place.loop] if command not in ("ls", "du") else []), *options)
    assert "\\u001b]0;owned\\u001b\\\\u009b31m\\u007f\\u202eb" in shown.stdout, shown.output


@pytest.mark.parametrize("path", EVERY, ids=" ".join)
def test_wrong_usage_has_the_documented_exit_code(path):
    done = CliRunner().invoke(cli, [*path, "--nope"])
    assert done.exit_code == ExitCode.USAGE
    assert done.stdout == ""
    if path in WITH_JSON:
        error = json.loads(CliRunner().invoke(cli, [*path, "--nope", "--json"]).stderr.splitlines()[-1])[
            "error"
        ]
        assert error["exit_code"] == ExitCode.USAGE


def takes_runs(command):
    arguments = [parameter for parameter in command.params if isinstance(parameter, click.Argument)]
    return any(isinstance(argument.type, RunName) and argument.name != "names" for argument in arguments)


@pytest.mark.parametrize("path", [path for path in EVERY if takes_runs(EVERY[path])], ids=" ".join)
def test_an_unknown_run_has_the_documented_exit_code(place, path):
    words = ["nosuchrun"] * (2 if path in (("diff",), ("when",), ("explain",)) else 1)
    done = place.command(*path, *words)
    assert done.exit_code == ExitCode.USAGE, done.output
    assert "no run 'nosuchrun'" in done.stderr


def test_exit_codes_are_explained_by_help():
    lines = [
        line.split() for line in CliRunner().invoke(cli, ["--help"], terminal_width=200).stdout.splitlines()
    ]
    for code in ExitCode:
        assert [str(int(code)), *code.explanation.split()] in lines


OF_THE_COMMAND = (
    "accept-changes",
    "at",
    "dry-run",
    "episode",
    "episodes",
    "eval",
    "name",
    "output",
    "phase",
    "policy",
    "port",
    "ray",
    "seed",
    "start",
    "to",
)
"""Options that mean the same thing, in words that fit the command."""


def meanings():
    """Return the meanings of each option by name, as help states them up to the first stop."""
    found = defaultdict(set)
    for command in EVERY.values():
        for option in command.params:
            if isinstance(option, click.Option):
                text = re.split(r"[:;.]|  \[", option.help or "")[0].replace("A folder", "The folder")
                for name in option.opts:
                    found[name].add((text, option.type.name))
    return found


def test_an_option_has_one_meaning():
    several = {name for name, texts in meanings().items() if len(texts) > 1}
    assert several <= {"-o", "--sort", *(f"--{each}" for each in OF_THE_COMMAND)}


def test_a_wrong_target_is_named_as_it_is_typed(place):
    for command in ("diff", "compare"):
        done = place.command(command, "@latest", "@latest", "--target", "far")
        assert done.exit_code == ExitCode.USAGE
        assert "'--target': found 'far', expected METRIC=LEVEL" in done.stderr
