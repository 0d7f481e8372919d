"""Help is complete, correct and quick."""

import inspect
import itertools
import pkgutil
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.shell_completion import ShellComplete
from click.testing import CliRunner

from runner.cli import COMMANDS, cli, commands
from tests.doors import walk

HEAVY = {"numpy", "numba", "gymnasium", "pydantic", "rich", "yaml", "mcap", "google", "blake3", "psutil"}


EVERY = list(walk())
NAMES = [" ".join(path) for path, _ in EVERY]


@pytest.mark.parametrize(("path", "command"), EVERY, ids=NAMES)
def test_help_has_an_example_for_every_command(path, command):
    text = CliRunner().invoke(cli, [*path, "--help"]).stdout
    assert "Example" in text
    assert f"dualtaxi {' '.join(path)}" in text
    assert command.name == path[-1]


def test_every_option_is_explained():
    assert [
        (*path, option.name)
        for path, command in EVERY
        for option in command.params
        if isinstance(option, click.Option) and option.name != "help" and not option.help
    ] == []


def _typed(line):
    """Return the words of the command in a line, up to a pipe or another file."""
    words = shlex.shlex(line.split("   ")[0], posix=True, punctuation_chars="|<>")
    words.whitespace_split, words.commenters = True, ""
    return list(itertools.takewhile(lambda word: not set(word) <= set("|<>"), words))


def _examples():
    for path, command in EVERY:
        for line in inspect.cleandoc(command.help or "").splitlines():
            if line.strip().startswith("dualtaxi "):
                yield pytest.param(_typed(line.strip())[1:], id=" ".join(path) + ": " + line.strip())


@pytest.mark.parametrize("words", list(_examples()))
def test_examples_can_be_typed(words, own_folder):
    for folder in ("others", "recordings"):
        Path(folder).mkdir()
    command = cli
    while isinstance(command, click.Group):
        name, *words = words
        command = command.get_command(click.Context(command), name)
        assert command is not None, name
    command.make_context(name, list(words))


def test_every_module_has_commands():
    listed = {module for section in COMMANDS.values() for module, _ in section.values() if module}
    found = {module.name for module in pkgutil.iter_modules(commands.__path__)}
    assert listed == {name for name in found if not name.startswith("export_")}


def test_the_table_of_commands_is_what_help_shows():
    text = CliRunner().invoke(cli, ["--help"], terminal_width=100).stdout
    for title, section in COMMANDS.items():
        assert f"\n{title}:\n" in text
        for name, (_, about) in section.items():
            assert about.endswith(".")
            assert any(line.split() == [name, *about.split()] for line in text.splitlines())


def test_help_names_the_exit_codes_and_the_folder():
    text = CliRunner().invoke(cli, ["--help"]).stdout
    for values in ("130", "interrupted", "wrong usage", "DUALTAXI_RECORDINGS", "@latest", "NO_COLOR"):
        assert values in text


def test_an_unknown_command_is_refused_with_the_nearest():
    result = CliRunner().invoke(cli, ["shwo"])
    assert result.exit_code == 2
    assert "Did you mean 'show'?" in result.stderr


def test_version():
    result = CliRunner().invoke(cli, ["--version"])
    assert result.stdout.startswith("dualtaxi ")


def _imported(*words):
    """Return the outermost packages that a command imports."""
    program = (
        "import sys\nfrom runner.cli import main\nsys.argv = ['dualtaxi', *sys.argv[1:]]\n"
        "try:\n    main()\nfinally:\n"
        "    print(*{name.partition('.')[0] for name in sys.modules}, file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, words)], capture_output=True, text=True, check=True
    )
    return set(done.stderr.splitlines()[-1].split())


def test_playing_a_job_imports_no_gymnasium(recorded):
    assert "gymnasium" not in _imported("play", "tiny", "--recordings", recorded.recordings)


@pytest.mark.parametrize("word", ["--help", "--version"])
def test_help_imports_nothing_heavy(word):
    assert not _imported(word) & (HEAVY | {"hashlib"})


def test_the_help_of_each_command_imports_nothing_heavy():
    program = (
        "import contextlib, sys\nfrom runner.cli import main\n"
        "for name in sys.argv[1:]:\n"
        "    sys.argv = ['dualtaxi', name, '--help']\n"
        "    with contextlib.suppress(SystemExit):\n        main()\n"
        "    print(name, *{name.partition('.')[0] for name in sys.modules}, file=sys.stderr)\n"
    )
    names = cli.list_commands(click.Context(cli))
    done = subprocess.run([sys.executable, "-c", program, *names], capture_output=True, text=True, check=True)
    imported = {name: set(modules) for name, *modules in map(str.split, done.stderr.splitlines())}
    assert list(imported) == list(names)
    # One process has the modules of all commands before: the first in this list imports them.
    assert [name for name, modules in imported.items() if modules & HEAVY] == []


def test_listing_runs_imports_little(recorded):
    assert not _imported("ls", "--recordings", recorded.recordings) & (HEAVY - {"rich", "psutil"})
    assert not _imported("ls", "--json", "--recordings", recorded.recordings) & HEAVY


def test_the_module_can_be_run():
    done = subprocess.run(
        [sys.executable, "-m", "runner", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("dualtaxi ")


@pytest.mark.parametrize(
    ("words", "incomplete", "expected"),
    [
        (["run", "quick", "--set"], "evaluation.tr", ["evaluation.trials="]),
        (["run", "quick", "--set"], "disc", ["discount="]),
        (["ls"], "mean_l", ["mean_length"]),
        (["ls"], 'status == "fi', ['status == "finished"']),
        (["ls"], "seed < 3 and mean_l", ["seed < 3 and mean_length"]),
        (["prune"], "mean_l", ["mean_length"]),
        (["compare"], "success_p", ["success_percent"]),
        (["when", "tiny"], "max(q[300]) > 3 and vis", ["max(q[300]) > 3 and visits"]),
        (["config", "copy"], "qu", ["quick"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else value,
)
def test_completion_knows_settings_fields_and_shipped_experiments(words, incomplete, expected):
    completed = ShellComplete(cli, {}, "dualtaxi", "_DUALTAXI_COMPLETE").get_completions(words, incomplete)
    assert [item.value for item in completed] == expected


@pytest.mark.parametrize(
    "words",
    [
        ("when", "tiny", "step == 5"),
        ("why", "tiny", "--state", "300", "--action", "0", "--agent", "taxi_1"),
        ("branch", "tiny", "--at", "0:0", "--action", "all"),
        ("qtable", "tiny"),
    ],
    ids=lambda words: words[0],
)
def test_questions_to_a_run_import_what_kernels_need_alone(recorded, words):
    imported = _imported(*words, "--recordings", recorded.recordings)
    assert "numba" in imported
    assert not imported & {"gymnasium", "jinja2", "matplotlib", "pandas", "pyarrow", "rerun", "sqlalchemy"}
