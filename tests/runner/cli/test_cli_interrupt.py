"""Interrupted runs end properly."""

import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

import runner
from runner.api import interruptible
from runner.runs.run import create_run, list_runs, unless_empty

LONG = ("--set", "episodes=100000000", "--set", "evaluation=null")

posix = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals to send")


def _heeding():
    """Restore SIGINT, which a shell ignores for background processes."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _while_it_trains(recordings: Path, process: subprocess.Popen[str]) -> None:
    """Wait until the recording has grown."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and process.poll() is None:
        if any(
            run.recording.is_file() and run.recording.stat().st_size > 1_000_000
            for run in list_runs(recordings)
        ):
            return
        time.sleep(0.02)
    pytest.fail(f"it never trained: {process.communicate()}")


@posix
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_run_properly(tiny, tmp_path, number):
    recordings = tmp_path / "recordings"
    words = ["run", str(tiny), *LONG, "--recordings", str(recordings), "--json"]
    process = subprocess.Popen(
        [sys.executable, "-m", "runner", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=_heeding,  # noqa: PLW1509 - no threads here
    )
    _while_it_trains(recordings, process)
    process.send_signal(number)
    out, err = process.communicate(timeout=30)

    values = json.loads(out)
    (run,) = list_runs(recordings)
    assert process.returncode == 130, err
    assert "Interrupted: " in err
    assert str(run.recording) in err
    assert "Traceback" not in err
    assert run.status == values["status"] == "interrupted"
    with runner.open_recording(run.recording) as recording:
        assert recording.file.finished
        assert recording.result["content_digest"] == values["content_digest"]
        assert len(recording.train.episodes.array()) == values["episodes"] > 0


class Interrupting:
    """A report that sends its own process a signal, once."""

    def __init__(self, number: int) -> None:
        self.number: int | None = number

    def __call__(self, _progress: object) -> None:
        if self.number is not None:
            number, self.number = self.number, None
            signal.raise_signal(number)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_from_python_an_interrupt_raises_after_the_file_is_closed(tiny, tmp_path, number):
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt, match="was interrupted; what it recorded is in"):
        runner.run(tiny, overrides=LONG[1::2], recordings=tmp_path / "runs", report=Interrupting(number))
    (run,) = list_runs(tmp_path / "runs")
    assert run.status == "interrupted"
    assert run.summary["content_digest"]
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_signals_are_caught_only_on_the_main_thread(tiny, tmp_path):
    found = []
    before = signal.getsignal(signal.SIGINT)

    def work():
        report = lambda _: found.append(signal.getsignal(signal.SIGINT))  # noqa: E731
        found.append(runner.run(tiny, recordings=tmp_path / "runs", report=report).status)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found[-1] == "finished"
    assert set(found[:-1]) == {before}


def test_the_second_signal_is_not_caught():
    came = []
    with interruptible(second=lambda number, _: came.append(number)) as interrupt:
        assert not interrupt()
        signal.raise_signal(signal.SIGINT)
        assert interrupt()
        assert came == []
        signal.raise_signal(signal.SIGTERM)
    assert came == [signal.SIGTERM]


def test_the_second_signal_has_the_previous_handler_by_default():
    with interruptible():
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("recorded", [False, True])
def test_only_an_empty_run_is_removed(tiny, tmp_path, recorded):
    run = create_run(tmp_path / "runs", runner.api.experiment_of(tiny), 3)
    if recorded:
        run.recording.write_bytes(b"something")

    def fail():
        with unless_empty(run):
            raise RuntimeError("no")

    with pytest.raises(RuntimeError) as caught:
        fail()
    assert run.folder.exists() == recorded
    assert bool(getattr(caught.value, "__notes__", [])) != recorded


@posix
@pytest.mark.parametrize("module", ["click", "runner.errors", "runner.api"])
def test_a_signal_during_imports_prints_no_traceback(tiny, tmp_path, module):
    """The signal arrives while this module is imported."""
    program = f"""
import signal, sys

class Signalling:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, Signalling())
from runner.__main__ import main
sys.argv[1:] = {["run", str(tiny), "--recordings", str(tmp_path / "recordings")]!r}
main()
"""
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=_heeding,
    )
    assert (done.returncode, done.stdout) == (130, ""), done.stderr
    assert "Traceback" not in done.stderr
