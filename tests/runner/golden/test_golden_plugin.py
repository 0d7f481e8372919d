"""Golden runs as a user has them: a test file of theirs, run by pytest, changed, and run again."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from runner.service.processes import PRELOADED
from runner.util.processes import process_context, start_process

pytestmark = pytest.mark.long

TESTS = """
import gymnasium
import runner

LEARNING_RATE, EPSILON, LOSS = 0.5, 0.2, 0.0

def test_loop(golden):
    with runner.record(gymnasium.make("CartPole-v1"), golden.recordings, config={"lr": LEARNING_RATE}) as env:
        action = 0
        for episode in range(5):
            env.reset(seed=episode)
            over = False
            while not over:
                _, _, terminated, truncated, _ = env.step(action)
                action = 1 - action if LEARNING_RATE < 1 else 1
                over = terminated or truncated
    golden.same_bytes(env.run)

def test_job(golden):
    changes = ["episodes=10", "evaluation.trials=3", f"epsilon={EPSILON}"]
    golden.same_bytes(runner.run("quick", recordings=golden.recordings, overrides=changes))

def test_scores(golden):
    scores = [20.0, 21.0, 19.5, 22.0, 20.5, 21.5, 20.2, 20.9]
    golden.no_worse([score - LOSS for score in scores], margin=2.0)
"""
CHANGED = TESTS.replace("0.5, 0.2, 0.0", "1.5, 0.3, 3.0")
FILES = {"test_loop.mcap", "test_job.mcap", "test_scores.json"}
OPTIONS = ("-q", "-p", "no:cacheprovider")
ENVIRONMENT = {"PYTHONDONTWRITEBYTECODE": "1", "COLUMNS": "200"}

PAGE = Path(__file__).parents[3] / "docs" / "golden-runs.md"


def pytest_over(folder: Path, text: str, *options: str) -> tuple[int, str]:
    """Return the exit code and output of pytest over a folder, with this test file if it is not empty.

    It runs in a process that is forked with all that the tests import, which takes a fraction of the time.
    """
    if text:
        (folder / "test_mine.py").write_text(text)
    (folder / "pytest.ini").touch()
    output = folder.with_name(f"{folder.name}.out")
    words = [*OPTIONS, "-p", "runner.golden.plugin", *options]
    process = start_process(process_context(PRELOADED), run_pytest, folder, words, output)
    process.join()
    return process.exitcode, output.read_text()


def run_pytest(folder: Path, words: list[str], output: Path) -> None:
    """Run pytest in this process, which then ends."""
    os.chdir(folder)
    os.environ.update(ENVIRONMENT, PYTEST_DISABLE_PLUGIN_AUTOLOAD="1")
    os.environ.pop("PYTEST_ADDOPTS", None)
    sys.dont_write_bytecode = True  # files are rewritten within the second that their time stamps tell
    with output.open("w") as file, redirect_stdout(file), redirect_stderr(file):
        code = pytest.main(words)
    sys.exit(int(code))


def pytest_typed(folder: Path) -> tuple[int, str]:
    """Return the same of pytest as users start it, which finds the plugin by itself."""
    environment = os.environ | ENVIRONMENT
    environment.pop("PYTEST_ADDOPTS", None)
    command = [sys.executable, "-m", "pytest", *OPTIONS]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a folder of tests whose golden runs are recorded."""
    folder = tmp_path_factory.mktemp("golden")
    (folder / "test_mine.py").write_text(TESTS)
    (folder / "pytest.ini").touch()
    code, output = pytest_typed(folder)
    assert code == 1
    assert "3 failed" in output
    assert "record it by `pytest --golden-update`" in output
    assert pytest_over(folder, TESTS, "--golden-update")[0] == 0
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / "golden" / "test_mine").iterdir()}


def test_golden_runs_are_kept_next_to_the_test_and_not_written_again_while_they_are_the_same(folder):
    before = contents(folder)
    assert set(before) == FILES
    assert pytest_over(folder, TESTS)[0] == 0
    assert pytest_over(folder, TESTS, "--golden-update")[0] == 0
    assert contents(folder) == before


def test_scores_tell_their_error_rates_when_kept_and_their_p_value_on_request(tmp_path):
    scores = TESTS[: TESTS.index("def test_loop")] + TESTS[TESTS.index("def test_scores") :]
    code, output = pytest_over(tmp_path, scores, "--golden-update")
    assert code == 0
    assert re.search(r"test_scores: with a margin of 2, scores like these fail \d+% of the time", output)
    code, output = pytest_over(tmp_path, "", "-rA")
    assert code == 0
    assert re.search(r"IQM 20\.\d+, golden 20\.\d+, margin 2: p = ", output)


def test_what_changed_fails_with_the_first_difference_its_cause_and_a_page(folder):
    before = contents(folder)
    code, output = pytest_over(folder, CHANGED, "--golden-pages", "pages")
    assert code == 1
    assert "config.lr (0.5 in A, 1.5 in B) differs" in output
    assert (
        "They diverge in training episode 0, at t = 2 (training step 2): action is 0 in A, 1 in B" in output
    )
    assert "epsilon" in output
    assert "They diverge in training episode" in output
    assert "IQM 17.65" in output
    assert "error rate 0.05" in output
    for name in ("test_loop", "test_job"):
        page = folder / "pages" / f"test_mine--{name}.html"
        assert "<html" in page.read_text()
        assert str(page) in output
    assert contents(folder) == before


def test_a_damaged_golden_run_is_reported_and_replaced_on_request(folder):
    kept = folder / "golden" / "test_mine" / "test_loop.mcap"
    whole = kept.read_bytes()
    kept.write_bytes(b"no recording")
    code, output = pytest_over(folder, TESTS, "-k", "loop")
    assert code == 1
    assert "test_loop.mcap" in output
    assert "RecordingError" not in output
    assert pytest_over(folder, TESTS, "-k", "loop", "--golden-update")[0] == 0
    assert pytest_over(folder, TESTS, "-k", "loop")[0] == 0
    assert len(kept.read_bytes()) == pytest.approx(len(whole), abs=500)


def test_the_examples_of_the_guide_pass_and_find_an_environment_that_changed(tmp_path):
    examples = dict(re.findall(r"```python (test_\w+\.py)\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL))
    assert len(examples) == 2
    for name, text in examples.items():
        (tmp_path / name).write_text(text)
    assert "5 passed" in pytest_over(tmp_path, "", "--golden-update")[1]
    for name, changed in (
        ("test_cartpole.py", 'make("CartPole-v1", sutton_barto_reward=True)'),
        ("test_taxi.py", 'make("Taxi-v4", is_rainy=True)'),
    ):
        before, _, after = examples[name].partition("golden.same_environment(lambda: gymnasium.")
        text = before + "golden.same_environment(lambda: gymnasium." + changed + after[after.index(")") + 1 :]
        (tmp_path / name).write_text(text)
    output = pytest_over(tmp_path, "")[1]
    assert "2 failed, 3 passed" in output
    assert "train episode 0, t 0: reward: recorded 1.0, got 0.0" in output
    assert "train episode 0, t 3: observation: recorded 214, got 314" in output
    assert "spec.kwargs.is_rainy: recorded not set, here true" in output
