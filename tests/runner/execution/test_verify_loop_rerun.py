"""`dualtaxi verify` of loops: what it reports, and how it exits."""

from __future__ import annotations

import json
import subprocess
import sys

import gymnasium
import pytest

from runner.runs.resolve import find_run
from runner.runs.trust_marks import MARK_FILE
from tests.runner.loops.making import dualtaxi
from tests.runner.replay import loops
from tests.runner.replay.loops import record


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Return a recordings folder with a loop that comes out again, one that differs, and one that cannot."""
    folder = tmp_path_factory.mktemp("verify-redo")
    record(gymnasium.make("CartPole-v1"), folder, 300, name="pole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loops.Counter, "reward", lambda self: 1.0 + 1e-7)
        record(loops.counter(), folder, 50, name="other", make=loops.counter)
    record(loops.noisy(), folder, 50, name="noisy", make=loops.noisy)
    return folder


def verify(folder, name, *words):
    """Return exit code and output of `dualtaxi verify`."""
    done = dualtaxi(folder, "verify", name, *words)
    return done.exit_code, done.output


def test_a_loop_that_comes_out_again(recordings):
    code, output = verify(recordings, "pole")
    assert code == 0
    assert "reproduced: " in output
    assert "300 steps, every byte" in output
    code, output = verify(recordings, "pole", "--json")
    found = json.loads(output)
    assert (code, found["verdict"], found["finding"]) == (0, "reproduced", None)
    assert (found["steps"], found["difference"]) == (300, None)


def test_some_episodes_of_a_loop(recordings):
    code, output = verify(recordings, "pole", "--sample", "3", "--tolerance", "1e-6")
    assert code == 0
    assert "reproduced: reran 3 of " in output
    assert "within 1e-06" in output


def test_a_loop_that_differs_exits_with_1(recordings):
    code, output = verify(recordings, "other", "--trust")
    assert code == 1
    assert "differs" in output
    assert "train episode 0, t 0: reward: recorded 1.0000001, got 1.0" in output
    code, output = verify(recordings, "other", "--trust", "--json")
    found = json.loads(output)
    assert (code, found["verdict"]) == (1, "differs")
    difference = found["difference"]
    assert (difference["phase"], difference["episode"], difference["t"]) == ("train", 0, 0)
    assert (difference["field"], difference["recorded"], difference["got"]) == ("reward", 1.0000001, 1.0)
    assert verify(recordings, "other", "--trust", "--tolerance", "1e-6")[0] == 0


@pytest.mark.parametrize(
    ("words", "reason"),
    [([], "that is made only with --trust"), (["--trust"], "more than its seed")],
)
def test_a_loop_that_cannot_be_done_again_is_an_error_only_if_that_is_demanded(recordings, words, reason):
    find_run("noisy", recordings).folder.joinpath(MARK_FILE).unlink(missing_ok=True)
    code, output = verify(recordings, "noisy", *words)
    assert code == 0
    assert "consistent: only the file was checked" in output
    assert "cannot be rerun: " in output
    assert "reran" not in output
    assert reason in " ".join(output.split())
    assert verify(recordings, "noisy", *words, "--rerun")[0] == 1
    code, output = verify(recordings, "noisy", *words, "--json")
    found = json.loads(output)
    assert (code, found["verdict"], found["act"]) == (0, "consistent", "checked")


def test_a_loop_that_is_not_to_be_done_again(recordings):
    for name in ("pole", "noisy"):
        code, output = verify(recordings, name, "--no-rerun")
        assert code == 0
        assert "consistent: only the file was checked" in output
        assert "reproduced" not in output


def test_wrong_values_of_options_are_refused(recordings):
    assert verify(recordings, "pole", "--sample", "0")[0] == 2
    assert verify(recordings, "pole", "--tolerance", "-1")[0] == 2


def test_damage_is_reported_and_nothing_is_done_again(recordings, tmp_path):
    run = next(path for path in recordings.glob("*/recording.mcap") if b'"CartPole-v1"' in path.read_bytes())
    data = bytearray(run.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "damaged.mcap").write_bytes(data)
    code, output = verify(recordings, str(tmp_path / "damaged.mcap"))
    assert code == 1
    assert "damaged" in output
    assert "reproduced" not in output


OWN = """
import sys

import gymnasium

import runner

def make_env():
    env = gymnasium.make("CartPole-v1", render_mode="rgb_array")
    return gymnasium.wrappers.TransformReward(env, lambda reward: 2 * reward)

if __name__ == "__main__":
    with runner.record(make_env(), "recordings", name="own", make="own_pole:make_env") as env:
        env.reset(seed=0)
        while not any(env.step(0)[2:4]):
            pass
"""


def test_a_function_of_a_file_in_the_current_folder_makes_the_environment_of_a_trusted_recording(tmp_path):
    (tmp_path / "own_pole.py").write_text(OWN)

    def run(*words):
        return subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)

    done = run(sys.executable, "own_pole.py")
    assert done.returncode == 0, done.stderr
    command = (sys.executable, "-P", "-m", "runner")  # without the current folder, as `dualtaxi`
    assert "reproduced: reran 1 episode, " in run(*command, "verify", "own").stdout
    next(tmp_path.glob(f"recordings/*/{MARK_FILE}")).unlink()
    assert "--trust" in run(*command, "verify", "own").stdout
    assert "reproduced: reran 1 episode, " in run(*command, "verify", "own", "--trust").stdout
    done = run(*command, "export", "film", "own", "--episode", "0", "--trust", "-o", "own.gif")
    assert "pictures drawn again" in done.stdout + done.stderr
