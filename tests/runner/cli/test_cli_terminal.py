"""On a terminal: colours, a progress line, and neither with NO_COLOR or a pipe."""

import os
import re
import subprocess
import sys

import numba
import pytest

from runner.environments.loading import load_mdp
from runner.learning.model import build_model
from runner.recording.reader import open_recording
from runner.util.compilation import announced

pty = pytest.importorskip("pty", reason="a POSIX terminal", exc_type=ImportError)


def _typed(words, recordings, keys=b"", once="", **environment):
    """Return the output of a command on a terminal of 80 columns; keys are pressed once it shows a text."""
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "runner", *map(str, words)],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env=os.environ
        | {"DUALTAXI_RECORDINGS": str(recordings), "TERM": "xterm-256color", "COLUMNS": "80"}
        | environment,
    )
    os.close(theirs)
    shown = b""
    while True:
        try:
            part = os.read(ours, 4096)
        except OSError:  # Linux says so when the other end is closed
            break
        if not part:
            break
        shown += part
        if keys and once.encode() in shown:
            os.write(ours, keys)
            keys = b""
    os.close(ours)
    assert process.wait(timeout=60) == 0, shown
    return shown.decode()


def test_a_run_shows_its_progress(command, tiny):
    shown = _typed(["run", tiny, "--set", "episodes=3000"], command.recordings)
    assert "/3,000" in shown
    assert "steps/s" in shown


def test_colours_only_repeat_the_text(recorded):
    words = ["play", "tiny", "--episode", 0, "--speed", 1000]
    coloured = _typed(words, recorded.recordings, keys=b"q", once="the end")
    plain = _typed(words, recorded.recordings, keys=b"q", once="the end", NO_COLOR="1")
    assert "\x1b[1;38;5" in coloured or "\x1b[1;30;48" in coloured
    assert "[1;38;5" not in plain
    assert "48;5" not in plain
    assert "step 1 of " in plain


@pytest.mark.parametrize("words", [["ls"], ["show", "tiny"]])
def test_without_colours_nothing_is_lost(recorded, words):
    assert "38;5" not in _typed(words, recorded.recordings, NO_COLOR="1")


def test_a_compilation_is_announced_once_when_it_happens():
    import numba

    @numba.njit
    def first(x):
        return x + 1

    @numba.njit
    def second(x):
        return first(x) + 1

    values = []
    with announced(lambda: values.append("now")):
        assert values == []
        assert second(1) == 3
        assert values == ["now"]
        assert second(1) == 3
    with announced(lambda: values.append("again")):
        assert second(2) == 4
    assert values == ["now"]


def test_a_cached_kernel_is_not_announced(command, tiny):
    command("run", tiny)
    done = subprocess.run(
        [sys.executable, "-m", "runner", "run", str(tiny), "--recordings", str(command.recordings)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "ompil" not in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("words", "stages"),
    [
        (["diff", "tiny", "tiny", "--html", "{folder}/diff.html"], ["comparing", "writing"]),
        (["compare", "tiny", "tiny2"], ["reading runs", "computing intervals"]),
        (["export", "tensorboard", "tiny", "-o", "{folder}/events"], ["writing events"]),
        (["qtable", "tiny", "--episode", 5], ["replaying recorded steps"]),
        (["sql", "SELECT run FROM runs", "--parquet", "-"], ["reading", "writing"]),
    ],
    ids=lambda words: words[0],
)
def test_long_commands_show_a_spinner(command, tiny, tmp_path, words, stages):
    command("run", tiny)
    command("run", tiny, "--name", "tiny2", "--set", "discount=0.5")
    shown = _typed([str(each).format(folder=tmp_path) for each in words], command.recordings)
    assert [stage for stage in stages if stage not in shown] == []


def test_a_kernel_serves_a_fresh_environment_and_a_recorded_one(recorded_run):
    with open_recording(recorded_run.recording) as recording:
        fresh = load_mdp(
            recording.config["env"]["id"], recording.config["env"]["kwargs"], recording.config["rewards"]
        )
        kinds = [numba.typeof(build_model(mdp, "per_agent")) for mdp in (fresh, recording.mdp)]
    assert kinds[0] == kinds[1]


def test_play_pauses_steps_and_quits(recorded):
    words = ["play", "tiny", "--episode", 0, "--speed", 0.01]  # a step in 100 s: only keys move it
    shown = _typed(words, recorded.recordings, keys=b" nn\x1b[C\x1b[Dbq", once="q: quit")
    steps = [int(step) for step in re.findall(r"step (\d+) of", shown)]
    assert [step for i, step in enumerate(steps) if i == 0 or step != steps[i - 1]] == [0, 1, 2, 3, 2, 1]
    assert "paused" in shown


def test_play_waits_at_the_end_and_can_start_once_more(recorded):
    words = ["play", "tiny", "--episode", 0, "--speed", 1000]
    shown = _typed(words, recorded.recordings, keys=b"bn\x1b[Crq", once="the end")
    steps = [int(step) for step in re.findall(r"step (\d+) of", shown)]
    last = max(steps)
    tail = steps[steps.index(last) :]
    assert [step for i, step in enumerate(tail) if i == 0 or step != tail[i - 1]] == [last, last - 1, last, 0]
    assert "q: quit" not in shown.rpartition("step 0 of")[2]


@pytest.mark.parametrize(
    "words", [["qtable", "tiny", "--state", 300], ["du"], ["ls"]], ids=lambda words: words[0]
)
def test_a_narrow_terminal_truncates_no_number_and_no_heading(recorded, words):
    shown = _typed(words, recorded.recordings, COLUMNS="60")
    assert "…" not in shown
